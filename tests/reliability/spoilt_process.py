"""Run `python -m tests.reliability.spoilt_process FOLDER MODULE ARGUMENT...` as MODULE, but for switches in FOLDER.

Switches are numbers in files, which the laboratory writes and the processes of a run map into memory.

    clock, clock-ROLE   how much more the wall clock of all processes, or of those with that role, reads [s]
    lease               lease that a router announces [s]; 0: its own
    read-ROBOT          not 0: reading the body of that robot raises
    sleep-ROLE          how long the computer of robots slept: their monotonic clock leaves that out, as Linux does [s]
    refuse-ROBOT        not 0: the body of that robot does not obey orders to land
    capture             number of the fault of motion capture in `CAPTURE_FAULTS`
    capture-subject     row of its subject
    capture-by          its size, see `capture_by` of `Faults`
    cut-ROBOT           when its twin cut the motors, by the machine's monotonic clock [s]; only if the file is there
"""

from __future__ import annotations

import mmap
import os
import pkgutil
import runpy
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Any, Final

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
        if lease_s := Switch(folder / "lease").read():
            zenoh_config = pkgutil.resolve_name("agents.network.zenoh_config")
            zenoh_config.settings = partial(zenoh_config.settings, lease_s=lease_s)
    elif role == "world":
        _replace("experiments.real_time.processes.world_network:Commands", "_obey", partial(_obey, folder))
    elif role == "capture":
        number, row, size = (Switch(folder / f"capture{part}") for part in ("", "-subject", "-by"))
        faults = pkgutil.resolve_name("twins.devices.device:CAPTURE_FAULTS")

        def captured(*_: object) -> tuple[str, int, float]:
            return faults[int(number.read())], int(row.read()), size.read()

        _replace("twins.devices.device:Faults", "captured", captured)
    elif ROBOT in words:
        monotonic, slept = time.monotonic, Switch(folder / f"sleep-{role}")
        time.monotonic = lambda: monotonic() - slept.read()
        broken = [Switch(folder / f"read-{name}") for name in role.split("+")]
        _replace("bridges.external:ExternalBody", "read", partial(_read, broken))
        if (file := folder / f"cut-{role}").exists():
            _replace("twins.body:TwinBody", "stop", partial(_stop, Switch(file)))


def _replace(owner: str, name: str, other: Callable[..., object]) -> None:
    """Put another function in the place of a class or module's, which it gets before the arguments."""
    place = pkgutil.resolve_name(owner)  # not imported in every process
    there = getattr(place, name)
    setattr(place, name, lambda *arguments, **named: other(there, *arguments, **named))


def _read(broken: Sequence[Switch], read: Callable[..., object], *arguments: object) -> object:
    if any(switch.read() for switch in broken):
        raise OSError("read fails, as the laboratory wants")
    return read(*arguments)


def _obey(folder: Path, obey: Callable[..., object], commands: Any, *arguments: Any) -> None:
    row, command, t = arguments
    if command.action == "land" and Switch(folder / f"refuse-{command.robot}").read():
        # it is repeated, and the robot hovers
        commands.done[command.robot], commands.quiet[row] = command.seq - 1, t
    else:
        obey(commands, *arguments)


def _stop(stamp: Switch, stop: Callable[..., object], *arguments: object) -> None:
    stop(*arguments)
    stamp.write(stamp.read() or time.monotonic())


if __name__ == "__main__":
    spoil(Path(sys.argv[1]), sys.argv[2:])
    sys.argv[:] = sys.argv[2:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
