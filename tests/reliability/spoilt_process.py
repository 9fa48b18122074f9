"""Run `python -m tests.reliability.spoilt_process FOLDER MODULE ARGUMENT...` as MODULE, with faults inside of it.

The file `levers-ROLE.json` in the folder, if there is one, has the faults of that process now, by kind: see `Levers`.
What a launcher in such a process starts is spoilt as well. The file `cut-ROBOT`, if there is one, gets the moment at
which the twin of that robot cut its motors, by the machine's monotonic clock [s].
"""

from __future__ import annotations

import builtins
import io
import json
import mmap
import os
import pkgutil
import random
import runpy
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from itertools import chain, takewhile
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

MODULE: Final = "tests.reliability.spoilt_process"
CONDUCTOR: Final = "conductor"
RUN: Final = "tools.guard"  # module of the conductor
CABLE: Final = "tests.simulated.cable"
INSIDE: Final = ("cut", "hang", "late", "disk", "body")  # kinds of faults that need a lever in the process
PATIENCE_S: Final = 30.0  # time for a cable to be laid
ROLES: Final = {  # by the module that a process runs
    RUN: CONDUCTOR,
    "agents.runtime.router": "router",
    "experiments.real_time.processes.recorder": "recorder",
    "experiments.real_time.processes.world": "world",
    "experiments.real_time.processes.centre": "centre",
    "bridges.motion_capture.publisher": "positioning",
    "bridges.motion_capture.twin.capture": "capture",
}
ROBOT: Final = "experiments.real_time.processes.robot"
OTHER: Final = "other"


def role_of(words: Sequence[str]) -> str:
    """Role of a process by its command line: a robot's name, "router", "recorder", "world", ..."""
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


class Levers:
    """Faults in a process by their kinds, set from outside; None of a kind without one.

    | kind | value |
    |---|---|
    | hang | number of the fault, time for which its next sleep is longer [s] |
    | late | mean lateness of its sleeps [s] |
    | disk | "full", "read-only", or time that each write takes [s] |
    | body | readings by robot: word, number, memory (`tests.simulated.bodies.READINGS`) |
    """

    def __init__(self, folder: Path, role: str) -> None:
        self.file = folder / f"levers-{role}.json"
        self._version = Switch(folder / f"levers-{role}")
        self._known = 0.0
        self._values: dict[str, Any] = {}

    def set(self, kind: str, value: object) -> None:
        if self.file.exists():
            self._values = json.loads(self.file.read_text("utf-8"))
        self._values[kind] = value
        whole = self.file.with_suffix(".new")
        whole.write_text(json.dumps(self._values), "utf-8")
        whole.rename(self.file)
        self._version.write(self._version.read() + 1.0)

    def get(self, kind: str) -> Any:
        if (version := self._version.read()) != self._known:
            self._known, self._values = version, json.loads(self.file.read_text("utf-8"))
        return self._values.get(kind)


def spoil(folder: Path, words: Sequence[str]) -> None:
    """Put levers into this process, if it has any."""
    role = role_of(words)
    if role == CONDUCTOR:
        _spoil_children(folder)
    names = [name for name in role.split("+") if (folder / f"levers-{name}.json").exists()]
    if not names:
        return
    levers = Levers(folder, names[0])
    kinds = levers.get("kinds")
    if "cut" in kinds:
        _lay_cable()
    if {"hang", "late"} & {*kinds}:
        _spoil_sleep(levers)
    if {"disk", "body"} & {*kinds}:
        _spoil_disk_and_body(role, levers)


def _spoil_children(folder: Path) -> None:
    launcher = pkgutil.resolve_name("experiments.real_time.hosts.launcher:Launcher")
    start = launcher.start

    def start_spoilt(made: object, name: str, module: str, *arguments: str, **_: object) -> object:
        return start(made, name, MODULE, str(folder), module, *arguments)

    launcher.start, launcher.preload = start_spoilt, lambda _: None


def _lay_cable() -> None:
    """Let the sessions of this process connect through a relay, which SIGSTOP cuts."""
    session = pkgutil.resolve_name("agents.network.session")
    free_endpoint = pkgutil.resolve_name("agents.network.endpoints:free_endpoint")
    open_with, near, cables = session.open_with, dict[str, str](), list[object]()

    def open_through(chosen: Any) -> object:
        places = json.loads(chosen.get_json("connect/endpoints"))
        if new := [place for place in places if place not in near]:
            near.update((place, free_endpoint(0)) for place in new)
            ports = chain.from_iterable((_port(near[place]), _port(place)) for place in new)
            cables.append(subprocess.Popen([sys.executable, "-m", CABLE, *map(str, ports)], stdin=subprocess.PIPE))
            for place in new:
                _await_port(_port(near[place]))
        chosen.insert_json5("connect/endpoints", json.dumps([near[place] for place in places]))
        return open_with(chosen)

    session.open_with = open_through


def _port(endpoint: str) -> int:
    return int(endpoint.rpartition(":")[2])


def _await_port(port: int) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        with socket.socket() as tried:
            if not tried.connect_ex(("127.0.0.1", port)):
                return
        time.sleep(0.02)


def _spoil_sleep(levers: Levers) -> None:
    clock: Any = time
    sleep, rng = time.sleep, random.Random()
    hung = 0

    def sleep_badly(seconds: float) -> None:
        nonlocal hung
        sleep(seconds)
        if late := levers.get("late"):
            sleep(rng.expovariate(1.0 / late))
        number, stall = levers.get("hang") or (hung, 0.0)
        if number != hung and threading.current_thread() is threading.main_thread():
            hung = number
            sleep(stall)

    clock.sleep = sleep_badly


class Place:
    """The laboratory as `tests.simulated.bodies` and `processes` ask for it, in a process of its own."""

    on_command: tuple[object, ...] = ()

    def __init__(self, process: object, levers: Levers) -> None:
        self._process, self._levers = process, levers
        self.bodies, self.commands = list[object](), list[object]()
        self.robots, self.rising = dict[str, object](), dict[object, object]()
        self.now = 0.0

    @property
    def readings(self) -> Mapping[str, Any]:
        return self._levers.get("body") or {}

    @property
    def disks(self) -> Mapping[str, Any]:
        fault = self._levers.get("disk")
        return {} if fault is None else {"": fault}

    def process(self, _: str) -> object:
        return self._process

    def carries(self, *_: object) -> bool:
        return True

    def note_motors(self, *_: object) -> None:
        self.commands.clear()


def _spoil_disk_and_body(role: str, levers: Levers) -> None:
    from tests.simulated import bodies, kernel, processes, world  # noqa: PLC0415 - most processes need none of it

    process = SimpleNamespace(name=role, pid=os.getpid())
    running = SimpleNamespace(process=process, task=SimpleNamespace(block=time.sleep), rng=random.Random(), now=0.0)
    stands: tuple[tuple[Any, str, Any], ...] = (
        (kernel, "_kernel", running), (world, "_world", Place(process, levers)),
        (builtins, "open", processes.open_file), (io, "open", processes.open_file),
        (pkgutil.resolve_name("experiments.recording.writer"), "TemporaryFile", processes.temporary_file),
    )  # fmt: skip
    for module, name, value in stands:
        setattr(module, name, value)
    twins = pkgutil.resolve_name("agents.body.shadow_twin")
    shadowed = twins.shadowed
    twins.shadowed = lambda body, request, periods: bodies.WatchedBody(
        shadowed(body, request, periods), request.names, request.rate_hz
    )


def note_cuts(folder: Path, words: Sequence[str]) -> None:
    """Let the twin of this process note when it cuts its motors."""
    if not (file := folder / f"cut-{role_of(words)}").exists():
        return
    body = pkgutil.resolve_name("twins.body:TwinBody")
    stop, stamp = body.stop, Switch(file)

    def noted(*arguments: Any) -> None:
        stop(*arguments)
        stamp.write(stamp.read() or time.monotonic())

    body.stop = noted


if __name__ == "__main__":
    note_cuts(Path(sys.argv[1]), sys.argv[2:])
    spoil(Path(sys.argv[1]), sys.argv[2:])
    sys.argv[:] = sys.argv[2:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
