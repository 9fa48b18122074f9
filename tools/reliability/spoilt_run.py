"""A run to which faults are done: its start, the levers by which they are done, and its end.

It is a process of its own, which may be killed. Its robots reach their routers through cables
(`tools.reliability.cables`), and live in one world, so that the body of a robot whose process is dead, frozen or cut
off stays in the room.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import secrets
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import msgspec
import numpy as np
import zenoh

from agents.body.kinds import KINDS
from agents.network import messages
from agents.network.endpoints import free_endpoint
from agents.network.keys import Keys
from experiments.definition.experiment import Experiment
from experiments.real_time.conductor import orders
from experiments.real_time.hosts.launcher import RUN, Launcher, Process, tagged
from tools.reliability import spoilt_process
from tools.reliability.cables import Cables
from tools.reliability.run_process import Request
from tools.reliability.spoilt_process import CONDUCTOR, Switch, role_of

Stage = Literal["plain", "two routers", "patient router", "motion capture"]

GARBAGE: Final = 20  # payloads of nonsense at a time, on each key of a victim
LEASE_S: Final = 60.0  # of a patient router, as ROS 2 sets it
END_S: Final = 1.0  # before its time is over: then the conductor lands all robots, and lets none in again
MOCAP_CLOCK: Final = "clock-positioning"


@dataclass(frozen=True)
class Setting:
    """Settings of all rounds."""

    file: Path  # the experiment
    case: str  # its case
    experiment: Experiment  # the same, changes applied
    folder: Path  # where each round gets a folder
    changes: Sequence[str]  # as behind `--set`
    seed: int  # of nonsense, which the script leaves open
    interrupted: Callable[[], bool]  # by the user


class SpoiltRun:
    """A run to which faults are done.

    Attributes:
        process: The launcher's.
        dead: Robots that were killed for good, and when [monotonic s].
        shifted: Robots whose clock is not that of the others.
        started: Common start [monotonic s].
        answer: Of the conductor, to the last restart.
    """

    def __init__(self, stack: ExitStack, setting: Setting, stage: Stage, number: int) -> None:
        """Start it; `stack` ends it."""
        experiment = self.experiment = setting.experiment
        folder = setting.folder / f"round-{number:03}"
        self._switches = folder / "switches"
        self._switches.mkdir(parents=True)
        self.routers = [free_endpoint(preferred_port=0) for _ in range(2 if stage == "two routers" else 1)]
        self.recording = folder / f"{setting.case}.mcap"
        self.dead: dict[str, float] = {}
        self.shifted: set[str] = set()
        self.started: float | None = None
        self.answer = messages.RunReply()
        self._keys, self._random = Keys(experiment.network.realm), np.random.default_rng([setting.seed, number])
        self._stopped: list[int] = []
        groups: dict[str, list[str]] = {}
        for name, robot in experiment.robots.items():
            groups.setdefault(robot.process or name, []).append(name)
        self._process_of = {name: "+".join(names) for names in groups.values() for name in names}
        self.switch("lease").write(LEASE_S if stage == "patient router" else 0.0)
        changes = [*setting.changes, f"network.listen={json.dumps(self.routers)}"]
        changes.append(f"network.routers={len(self.routers)}")
        if stage == "motion capture":
            flying = [name for name, robot in experiment.robots.items() if KINDS[robot.kind].flies]
            changes += [f'robots.{name}.position="external"' for name in flying or experiment.robots]
            changes.append('positioning="vicon-twin"')
        self._cables = stack.enter_context(Cables())
        laid = {role: {end: self._cables.lay(role, end) for end in self.routers} for role in self._process_of.values()}
        request = Request(str(setting.file), str(folder), setting.case, changes, laid, str(self._switches))
        self._tag = f"{RUN}={secrets.token_hex(8)}"  # in the environment of all its processes
        self._launcher = stack.enter_context(Launcher(folder / "logs"))
        words = ["tools.reliability.run_process", msgspec.json.encode(request).decode()]
        self.process = self._spawn(CONDUCTOR, [sys.executable, "-m", spoilt_process.MODULE, request.switches, *words])
        stack.callback(self._kill)

    @property
    def over(self) -> bool:
        """Whether its time is over."""
        return time.monotonic() - (self.started or 0.0) > self.experiment.duration_s - END_S

    def processes(self) -> dict[int, str]:
        """Processes that run: role by id."""
        return {pid: role_of(words) for pid, words in tagged(self._tag)}

    def close(self) -> None:
        """Cut the lifeline, as the death of its holder does, and do not wait."""
        self._launcher.release(CONDUCTOR)

    def _spawn(self, name: str, words: Sequence[str]) -> Process:
        return self._launcher.spawn(name, ["env", self._tag, *words])

    def _kill(self) -> None:
        """Kill what is left of the run, whatever happened."""
        for pid in self.processes():
            self._signal(pid, signal.SIGKILL)

    # ---------------------------------------------------------------------- levers

    def switch(self, name: str) -> Switch:
        """A switch between a process and its clock, body or lease (`tools.reliability.spoilt_process`)."""
        return Switch(self._switches / name)

    def process_of(self, robot: str) -> str:
        """Role of the process that runs a robot."""
        return self._process_of[robot]

    def send(self, role: str, number: signal.Signals) -> None:
        """Send a signal to the first process of a role, or of a robot."""
        for pid in self._running(role)[:1]:
            self._signal(pid, number)
            self._stopped += [pid] if number == signal.SIGSTOP else []

    def cut(self, robot: str) -> None:
        """Let nothing pass between a robot and its routers."""
        self._cables.cut(self.process_of(robot))

    def release(self) -> None:
        """Undo what can be undone: continue stopped processes, mend all cables, set the clock of motion capture."""
        for pid in self._stopped:
            self._signal(pid, signal.SIGCONT)
        self._stopped.clear()
        self._cables.mend()
        self.switch(MOCAP_CLOCK).write(0.0)

    def restart(self, robot: str, session: zenoh.Session) -> None:
        """Have the conductor start a robot again; do not wait for that."""
        order = messages.RunOrder("restart", [robot], who="chaos")

        def ask() -> None:
            self.answer = orders.send_run_order(session, self._keys, order)

        self.answer = messages.RunReply()
        threading.Thread(target=ask, name="restart", daemon=True).start()

    def start_duplicate(self, robot: str) -> Process:
        """Start a second process of a robot's name: the same command again."""
        pid = self._running(robot)[0]
        words = dict(tagged(self._tag))[pid][:-1]  # the last one is empty
        return self._spawn(f"double-{robot}-{pid}-{time.monotonic_ns()}", words)

    def fill_disk(self) -> str:
        """Limit the recording to its present size: the recorder gets the error of a disk that is full."""
        full = self.recording.stat().st_size
        for pid in self._running("recorder"):
            with contextlib.suppress(ProcessLookupError):
                resource.prlimit(pid, resource.RLIMIT_FSIZE, (full, resource.RLIM_INFINITY))
            return f"at {full} bytes"
        return "no recorder"

    def spoil(self, robot: str, session: zenoh.Session) -> int:
        """Send nonsense on every key that a robot and its body read, but the stop's; return the number of payloads."""
        keys = self._keys
        read = (keys.pose, keys.position, keys.setpoint, keys.state, keys.status, keys.goal, keys.ranges)
        for key in read:
            for _ in range(GARBAGE):
                session.put(key(robot), self._malformed_payload(robot), encoding=messages.JSON)
        return GARBAGE * len(read)

    def _malformed_payload(self, robot: str) -> bytes:
        whole = messages.encode(messages.pose(robot, 1, 0.0, [9e9, 0.0, 0.0], [0.0, 0.0, 0.0], 0.0))
        payloads = (
            self._random.bytes(int(self._random.integers(1, 400))),
            b"[" * 10_000,
            b'{"robot": "' + robot.encode() + b'", "seq": 1e999, "stamp": -1, "position": [1e308, 0, 0]}',
            b"x" * 100_000,
            whole[: int(self._random.integers(len(whole)))],
        )
        return payloads[int(self._random.integers(len(payloads)))]

    def _running(self, role: str) -> list[int]:
        """The processes of a role, or of a robot."""
        return [pid for pid, name in sorted(self.processes().items()) if role in name.split("+")]

    @staticmethod
    def _signal(pid: int, number: signal.Signals) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)
