"""A run to which faults are done, in a process of its own, with one world for all: its start, levers, and end."""

from __future__ import annotations

import contextlib
import json
import os
import random
import resource
import secrets
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final, Literal

import zenoh

from agents.body.kinds import KINDS
from agents.errors import ExplainedError
from agents.network import messages
from agents.network.endpoints import free_endpoint
from agents.network.keys import Keys
from agents.runtime.command_line import on_termination
from agents.runtime.lifeline import Lifeline
from experiments.definition.plan import Plan
from experiments.file.document import load
from experiments.real_time.conductor import orders
from experiments.real_time.conductor.conduct import RunOptions, Supervision, conduct
from experiments.real_time.hosts.launcher import RUN, Launcher, Process, tagged
from tests.reliability import spoilt_process
from tests.reliability.spoilt_process import CONDUCTOR, Switch, role_of
from tools.progress import Lines
from twins.devices.device import CAPTURE_FAULTS, CaptureFault

Stage = Literal["plain", "two routers", "patient router", "motion capture"]

GARBAGE: Final = 20  # payloads of nonsense at a time, on each key of a victim
CABLE: Final = "cable"
MODULE: Final = "tests.reliability.spoilt_run"
LEASE_S: Final = 60.0  # of a patient router, as ROS 2 sets it
END_S: Final = 1.0  # before its time is over: then the conductor lands all robots, and lets none in again
MOCAP_CLOCK: Final = "clock-positioning"


@dataclass(frozen=True)
class Setting:
    """Settings of all rounds."""

    file: Path  # the experiment
    case: str  # its case
    plan: Plan  # the same, changes applied
    folder: Path  # where each round gets a folder
    changes: Sequence[str]  # as behind `--set`
    interrupted: Callable[[], bool]  # by the user


class SpoiltLauncher(Launcher):
    """Starts processes that can be spoiled, and whose robots find their routers at the ends of cables of their own."""

    def __init__(self, cables: dict[str, dict[str, str]], switches: str, logs: Path) -> None:
        """Cables are endpoints in place of each router's, by the role of a process of robots; switches, a folder."""
        super().__init__(logs)
        self._cables, self._switches = cables, switches

    def start(self, name: str, module: str, *arguments: str, forked: bool = False) -> Process:
        own = self._cables.get(spoilt_process.role_of([module, *arguments]), {})
        spoilt = self._switches, module, *(own.get(word, word) for word in arguments)
        return super().start(name, spoilt_process.MODULE, *spoilt, forked=forked)


class SpoiltRun:
    """A run to which faults are done.

    Attributes:
        process: The launcher's.
    """

    session: zenoh.Session  # on its network; set from outside

    def __init__(self, stack: ExitStack, setting: Setting, stage: Stage, number: int) -> None:
        """Start it; `stack` ends it."""
        self.plan = setting.plan
        experiment = self.experiment = setting.plan.experiment
        folder = setting.folder / f"round-{number:03}"
        self._switches = folder / "switches"
        self._switches.mkdir(parents=True)
        self.routers = [free_endpoint(0) for _ in range(2 if stage == "two routers" else 1)]
        self.recording = folder / f"{setting.case}.mcap"
        self.dead: dict[str, float] = {}  # robots that were killed for good, and when [monotonic s]
        self.shifted: set[str] = set()  # robots with another clock than the others
        self.started: float | None = None  # common start [monotonic s]
        self.answer = messages.RunReply()  # of the conductor, to the last restart
        self._keys = Keys(experiment.network.realm)
        self.flying = [name for name, robot in experiment.robots.items() if KINDS[robot.kind].flies]
        # by motion capture, on its stage; the exchange of two subjects needs two
        self.measured = self.flying if len(self.flying) > 1 else list(experiment.robots)
        self._stopped: list[int] = []
        self._refusing: list[Switch] = []
        self._asleep: dict[str, float] = {}  # processes of sleeping robots, and since when [monotonic s]
        self.process_of = {name: "+".join(names) for names in experiment.processes.values() for name in names}
        self.switch("lease").write(LEASE_S if stage == "patient router" else 0.0)
        changes = [*setting.changes, f"network.listen={json.dumps(self.routers)}"]
        changes.append(f"network.routers={len(self.routers)}")
        if stage == "motion capture":
            changes += [f'robots.{name}.position="external"' for name in self.measured]
            # robots land as they do without a world, in which they would wait for it
            changes += ['positioning="vicon-twin"', f"world.patience_s={experiment.safety.land_without_position_s}"]
        cables = {role: {end: free_endpoint(0) for end in self.routers} for role in self.process_of.values()}
        request = [*map(str, (setting.file, folder, setting.case, self._switches)), changes, cables]
        self._tag = f"{RUN}={secrets.token_hex(8)}"  # in the environment of all its processes
        self._launcher = stack.enter_context(Launcher(folder / "logs"))
        for role, ends in cables.items():
            ports = [end.rpartition(":")[2] for way in ends.items() for end in reversed(way)]
            self._launcher.start(f"{CABLE}-{role}", "tests.reliability.cable", *ports)
        command = [sys.executable, "-m", spoilt_process.MODULE, str(self._switches), MODULE]
        self.process = self._spawn(CONDUCTOR, [*command, json.dumps(request)])
        stack.callback(self._kill)

    @property
    def over(self) -> bool:
        """Whether its time is over."""
        return time.monotonic() - (self.started or 0.0) > self.experiment.duration_s - END_S

    def robots(self, which: Literal["all", "measured", "flying"]) -> list[str]:
        """Robots that can be the victims of a kind of fault."""
        everyone = list(self.experiment.robots)
        return {"all": everyone, "measured": self.measured, "flying": self.flying or everyone}[which]

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

    def switch(self, name: str) -> Switch:
        """A switch between a process and its clock, body or lease (`tests.reliability.spoilt_process`)."""
        return Switch(self._switches / name)

    def send(self, role: str, number: signal.Signals) -> None:
        """Send a signal to the first process of a role, or of a robot."""
        for pid in self._running(role)[:1]:
            self._signal(pid, number)

    def kill(self, robot: str) -> None:
        """Kill a robot's process for good; its body stays in the room and must come down."""
        self.send(robot, signal.SIGKILL)
        self.dead[robot] = time.monotonic()

    def cut(self, robot: str) -> None:
        """Let nothing pass between a robot and its routers."""
        self._signal(self._launcher.get(f"{CABLE}-{self.process_of[robot]}").handle.pid, signal.SIGSTOP)

    def sleep(self, robot: str) -> None:
        """Let the computer of a robot sleep: its process stands still, and its monotonic clock leaves that out."""
        self.cut(robot)
        self.send(robot, signal.SIGSTOP)
        self._asleep[self.process_of[robot]] = time.monotonic()

    def spoil_capture(self, fault: CaptureFault, subject: str = "", size: float = 0.0) -> None:
        """Let motion capture tell wrong poses, of a subject, if not of all; `release` ends that.

        `size`: how wrong, see `capture_by` of `Faults`.
        """
        self.switch("capture-by").write(size)
        self.switch("capture-subject").write(self.measured.index(subject) if subject else 0)
        self.switch("capture").write(CAPTURE_FAULTS.index(fault))

    def refuse_landing(self, robot: str) -> None:
        """Order a robot to land, whose body does not obey until `release`."""
        self._refusing.append(self.switch(f"refuse-{robot}"))
        self._refusing[-1].write(1.0)
        order = self.session, self._keys, [robot], messages.Order("land")
        threading.Thread(target=orders.send_order, args=order, daemon=True).start()

    def release(self) -> None:
        """Undo what can be undone: continue stopped processes, cables too, obey landings, and mend motion capture."""
        for role, since in self._asleep.items():
            slept = self.switch(f"sleep-{role}")
            slept.write(slept.read() + time.monotonic() - since)
        self._asleep.clear()
        for switch in (*self._refusing, self.switch("capture")):
            switch.write(0.0)
        self._refusing.clear()
        for pid in self._stopped:
            self._signal(pid, signal.SIGCONT)
        self._stopped.clear()
        self.switch(MOCAP_CLOCK).write(0.0)

    def restart(self, robot: str) -> None:
        """Have the conductor start a robot again; do not wait for that."""
        order = messages.RunOrder("restart", [robot], operator="chaos")

        def ask() -> None:
            self.answer = orders.send_run_order(self.session, self._keys, order)

        self.answer = messages.RunReply()
        threading.Thread(target=ask, name="restart", daemon=True).start()

    def start_duplicate(self, robot: str) -> Process:
        """Start a second process of a robot's name: the same command again."""
        pid = self._running(robot)[0]
        return self._spawn(f"double-{robot}-{pid}-{time.monotonic_ns()}", dict(tagged(self._tag))[pid])

    def fill_disk(self, _robot: str) -> str:
        """Limit the recording to its present size: the recorder gets the error of a disk that is full."""
        full = self.recording.stat().st_size
        recorders = self._running("recorder")[:1]
        for pid in recorders:
            with contextlib.suppress(ProcessLookupError):
                resource.prlimit(pid, resource.RLIMIT_FSIZE, (full, resource.RLIM_INFINITY))
        return f"at {full} bytes" if recorders else "no recorder"

    def spoil(self, robot: str) -> str:
        """Send nonsense on every key that a robot and its body read, but the stop's; return how much."""
        keys, whole = self._keys, messages.encode(messages.pose(robot, 1, 0.0, [9e9, 0.0, 0.0], [0.0] * 3, yaw=0.0))
        read = (keys.pose, keys.position, keys.setpoint, keys.state, keys.status, keys.goal, keys.ranges)
        for key in read * GARBAGE:
            payloads = (
                random.randbytes(random.randrange(1, 400)),
                b"[" * 10_000,
                b'{"robot": "' + robot.encode() + b'", "seq": 1e999, "stamp": -1, "position": [1e308, 0, 0]}',
                b"x" * 100_000,
                whole[: random.randrange(len(whole))],
            )
            self.session.put(key(robot), random.choice(payloads), encoding=messages.JSON)
        return f"{GARBAGE * len(read)} payloads of nonsense"

    def _running(self, role: str) -> list[int]:
        """The processes of a role, or of a robot."""
        return [pid for pid, name in sorted(self.processes().items()) if role in name.split("+")]

    def _signal(self, pid: int, number: signal.Signals) -> None:
        self._stopped += [pid] if number == signal.SIGSTOP else []
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)


def main() -> int:
    """Run the request of the command line: a run in real time on this machine, its bodies in one world."""
    file, folder, case, switches, changes, cables = json.loads(sys.argv[1])
    over = threading.Event()
    Lifeline(over).start()
    user = Supervision(Lines(), over.is_set, launching=partial(SpoiltLauncher, cables, switches))
    try:
        with on_termination(over.set):
            conduct(load(file, *changes), Path(folder), RunOptions([case], "world", here=True), user)
    except ExplainedError as error:
        print(f"zenpark: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
