"""A run to which faults are done: its start, the injection of faults, and their end."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import zenoh

from agents.body.kinds import KINDS
from agents.network import messages
from agents.network.endpoints import free_endpoint
from agents.network.keys import Keys
from experiments.definition.experiment import Experiment
from experiments.real_time.conductor import orders
from experiments.real_time.hosts.launcher import Launcher, Process, tagged
from tools.reliability.cables import Cables
from tools.reliability.fault_script import Fault, Round
from tools.reliability.run_process import Request, WatchedRun
from tools.reliability.spoilt_process import Switch

GARBAGE: Final = 20  # payloads of nonsense at a time, on each key of a victim
LEASE_S: Final = 60.0  # of a patient router, as ROS 2 sets it


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
    """A run in a process of its own, to which faults are done; its robots reach their routers through cables.

    Attributes:
        second: The second process of a name.
        answer: Of the conductor, to the last restart.
    """

    def __init__(self, stack: ExitStack, setting: Setting, script: Round, folder: Path, seed: Sequence[int]) -> None:
        """Start it; `stack` ends it."""
        experiment, stage = setting.experiment, script.stage
        self.routers = [free_endpoint(preferred_port=0) for _ in range(2 if stage == "two routers" else 1)]
        self.recording = folder / f"{setting.case}.mcap"
        self.second: Process | None = None
        self.answer = messages.RunReply()
        self._keys, self._random = Keys(experiment.network.realm), np.random.default_rng(seed)
        self._groups = {name: robot.process or name for name, robot in experiment.robots.items()}
        self._stopped: list[int] = []
        self._folder = folder / "switches"
        self._folder.mkdir(parents=True)
        self._switches: dict[str, Switch] = {}
        self._switch("lease").write(LEASE_S if stage == "patient router" else 0.0)
        changes = [*setting.changes, f"network.listen={json.dumps(self.routers)}"]
        changes.append(f"network.routers={len(self.routers)}")
        if stage == "motion capture":
            flying = [name for name, robot in experiment.robots.items() if KINDS[robot.kind].flies]
            changes += [f'robots.{name}.position="external"' for name in flying or experiment.robots]
            changes.append('positioning="vicon-twin"')
        self._cables = stack.enter_context(Cables())
        laid = {
            group: {end: self._cables.lay(group, end) for end in self.routers}
            for group in dict.fromkeys(self._groups.values())
        }
        self._launcher = stack.enter_context(Launcher(folder / "logs"))
        request = Request(str(setting.file), str(folder), setting.case, changes, "world", laid, str(self._folder))
        self.watched = WatchedRun(self._launcher, request)
        stack.callback(self._kill)

    def _kill(self) -> None:
        """Kill what is left of the run, whatever happened."""
        for pid in self.watched.processes():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def begin(self, fault: Fault, victim: str, session: zenoh.Session) -> str:
        """Inject a fault; return a note for the report.

        Args:
            victim: A robot; empty for the whole run.
        """
        kind, size, how = fault.kind, fault.size, fault.properties
        if how.signal is not None:
            sent = self._send(victim or how.role, how.signal)
            self._stopped = sent if how.signal == signal.SIGSTOP else []
        if how.cuts:
            self._cables.cut(self._groups[victim])
        if kind == "read-error":
            self._switch(f"read-{victim}").write(1.0)
        if kind == "double":
            self.second = self._start_duplicate(victim)
        if how.clock is not None:
            name, direction = how.clock
            companions = [robot for robot, group in self._groups.items() if group == self._groups.get(victim)]
            switch = self._switch(name.format("+".join(companions)))
            switch.write(direction * size + (switch.read() if kind == "clock" else 0.0))
            return f"{direction * size:+g} s"
        if kind == "disk":
            return self._fill()
        return f"{self._spoil(victim, session)} payloads of nonsense" if kind == "corrupt" else ""

    def end(self, fault: Fault) -> None:
        if fault.kind == "mocap-clock":
            self._switch("clock-positioning").write(0.0)
        elif fault.lasts_s:
            self.release()

    def restart(self, victim: str, session: zenoh.Session) -> None:
        """Have the conductor start a robot again; do not wait for that."""
        order = messages.RunOrder("restart", [victim], who="chaos")

        def ask() -> None:
            self.answer = orders.send_run_order(session, self._keys, order)

        self.answer = messages.RunReply()
        threading.Thread(target=ask, name="restart", daemon=True).start()

    def release(self) -> None:
        """Continue stopped processes and mend all cables."""
        for pid in self._stopped:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        self._stopped = []
        self._cables.mend()

    def _spoil(self, victim: str, session: zenoh.Session) -> int:
        """Send nonsense on every key that a robot and its body read, but the stop's; return the number of payloads."""
        keys = self._keys
        read = (keys.pose, keys.position, keys.setpoint, keys.state, keys.status, keys.goal, keys.ranges)
        targets = [key(victim) for key in read]
        for key in targets:
            for _ in range(GARBAGE):
                session.put(key, self._malformed_payload(victim), encoding=messages.JSON)
        return GARBAGE * len(targets)

    def _malformed_payload(self, victim: str) -> bytes:
        whole = messages.encode(messages.pose(victim, 1, 0.0, [9e9, 0.0, 0.0], [0.0, 0.0, 0.0], 0.0))
        payloads = (
            self._random.bytes(int(self._random.integers(1, 400))),
            b"[" * 10_000,
            b'{"robot": "' + victim.encode() + b'", "seq": 1e999, "stamp": -1, "position": [1e308, 0, 0]}',
            b"x" * 100_000,
            whole[: int(self._random.integers(len(whole)))],
        )
        return payloads[int(self._random.integers(len(payloads)))]

    def _switch(self, name: str) -> Switch:
        return self._switches.setdefault(name, Switch(self._folder / name))

    def _start_duplicate(self, victim: str) -> Process:
        """A second process of a name: the same command again."""
        pid = self._running(victim)[0]
        tag = self.watched.tag
        words = dict(tagged(tag))[pid][:-1]  # the last one is empty
        return self._launcher.spawn(f"double-{victim}-{pid}-{time.monotonic_ns()}", ["env", tag, *words])

    def _fill(self) -> str:
        """Limit the recording to its present size: the recorder gets the error of a disk that is full."""
        full = self.recording.stat().st_size
        for pid in self._running("recorder"):
            with contextlib.suppress(ProcessLookupError):
                resource.prlimit(pid, resource.RLIMIT_FSIZE, (full, resource.RLIM_INFINITY))
            return f"at {full} bytes"
        return "no recorder"

    def _running(self, role: str) -> list[int]:
        """The processes of a role, or of a robot."""
        return [pid for pid, name in sorted(self.watched.processes().items()) if role in name.split("+")]

    def _send(self, role: str, number: signal.Signals) -> list[int]:
        """Send a signal to the first process of a role."""
        found = self._running(role)[:1]
        for pid in found:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)
        return found
