"""Run `python -m tests.reliability.spoilt_process FOLDER MODULE ARGUMENT...` as MODULE, but for switches in FOLDER.

Switches are numbers in files, which the laboratory writes and the processes of a run map into memory.

    clock, clock-ROLE   how much more the wall clock of all processes, or of those with that role, reads [s]
    lease               lease that a router announces [s]; 0: its own
    read-ROBOT          not 0: reading the body of that robot raises
    sleep-ROLE          how long the computer of robots slept: their monotonic clock leaves that out, as Linux does [s]
    refuse-ROBOT        not 0: the body of that robot does not obey orders to land
    capture             number of the fault of motion capture in `CAPTURE_FAULTS`
    capture-subject     row of its subject
    cut-ROBOT           when its twin cut the motors, by the machine's monotonic clock [s]; only if the file is there
"""

from __future__ import annotations

import mmap
import os
import runpy
import sys
import time
from collections.abc import Sequence
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Final

from agents.clock import READING

MODULE: Final = "tests.reliability.spoilt_process"
CONDUCTOR: Final = "conductor"
ROLES: Final = {  # by the module that a process runs
    "agents.runtime.router": "router",
    "experiments.real_time.processes.recorder": "recorder",
    "experiments.real_time.processes.world": "world",
    "experiments.real_time.processes.centre": "centre",
    "tests.reliability.spoilt_run": CONDUCTOR,
    "bridges.vicon.publisher": "positioning",
    "twins.devices.vicon": "capture",
}
ROBOT: Final = "experiments.real_time.processes.robot"
OTHER: Final = "other"


def role_of(words: Sequence[str]) -> str:
    """Role of a process by its command line: a robot's name, "router", "recorder", "conductor", ..."""
    for module, name in ROLES.items():
        if module in words:
            return name
    if ROBOT not in words:
        return OTHER
    return "+".join(takewhile(lambda word: word and not word.startswith("--"), words[words.index(ROBOT) + 2 :]))


class Switch:
    """A number in a file that processes share; 0 at first."""

    def __init__(self, file: Path) -> None:
        with file.open("a+b") as opened:
            if not opened.tell():
                opened.truncate(8)
            self._shared = memoryview(mmap.mmap(opened.fileno(), 8)).cast("d")

    def read(self) -> float:
        return float(self._shared[0])

    def write(self, value: float) -> None:
        self._shared[0] = value


def spoil(folder: Path, words: Sequence[str]) -> None:
    """Put the switches of a folder between this process and what it will run."""
    role = role_of(words)
    utc, everyone, own = time.time, Switch(folder / "clock"), Switch(folder / f"clock-{role}")
    time.time = lambda: utc() + everyone.read() + own.read()
    if own.read():  # a computer of its own
        time.time = lambda: utc() + own.read()
        os.environ.pop(READING, None)
    if role == "router":
        _announce(Switch(folder / "lease").read())
    elif role == "world":
        _refuse_landings(folder)
    elif role == "capture":
        _spoil_capture(Switch(folder / "capture"), Switch(folder / "capture-subject"))
    elif ROBOT in words:
        monotonic, slept = time.monotonic, Switch(folder / f"sleep-{role}")
        time.monotonic = lambda: monotonic() - slept.read()
        _break_body([Switch(folder / f"read-{name}") for name in role.split("+")])
        if (file := folder / f"cut-{role}").exists():
            _stamp_stops(Switch(file))


def _announce(lease_s: float) -> None:
    from agents.network import zenoh_config  # not in every process

    if lease_s > 0.0:
        zenoh_config.settings = partial(zenoh_config.settings, lease_s=lease_s)


def _break_body(broken: Sequence[Switch]) -> None:
    from agents.body.interface import BodyState  # not in every process
    from bridges.external import ExternalBody

    read = ExternalBody.read

    def failing(body: ExternalBody, t: float) -> Sequence[BodyState]:
        if any(switch.read() for switch in broken):
            raise OSError("read fails, as the laboratory wants")
        return read(body, t)

    ExternalBody.read = failing  # type: ignore[assignment, method-assign]


def _spoil_capture(number: Switch, subject: Switch) -> None:
    from twins.devices.device import CAPTURE_FAULTS, CaptureFault, Faults  # not in every process

    def captured(_faults: Faults, _t: float) -> tuple[CaptureFault, int]:
        return CAPTURE_FAULTS[int(number.read())], int(subject.read())

    Faults.captured = captured  # type: ignore[method-assign, assignment]


def _refuse_landings(folder: Path) -> None:
    from agents.network.messages import Command  # not in every process
    from experiments.real_time.processes.world_network import Commands

    obey, switches = Commands._obey, dict[str, Switch]()

    def refusing(commands: Commands, row: int, command: Command, t: float) -> None:
        name = command.robot
        if name not in switches:
            switches[name] = Switch(folder / f"refuse-{name}")
        if command.action == "land" and switches[name].read():
            commands.done[name], commands.quiet[row] = command.seq - 1, t  # it is repeated, and the robot hovers
        else:
            obey(commands, row, command, t)

    Commands._obey = refusing  # type: ignore[method-assign, assignment]


def _stamp_stops(stamp: Switch) -> None:
    from twins.body import TwinBody  # not in every process

    cut = TwinBody.stop

    def stop(body: TwinBody, rows: Sequence[int]) -> None:
        cut(body, rows)
        stamp.write(stamp.read() or time.monotonic())

    TwinBody.stop = stop  # type: ignore[method-assign, assignment]


if __name__ == "__main__":
    spoil(Path(sys.argv[1]), sys.argv[2:])
    sys.argv[:] = sys.argv[2:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
