"""Run `python -m tests.reliability.spoilt_process FOLDER MODULE ARGUMENT...` as MODULE, and note when motors are cut.

The file `cut-ROBOT` in the folder, if there is one, gets the moment at which the twin of that robot cut its motors, by
the machine's monotonic clock [s].
"""

from __future__ import annotations

import mmap
import pkgutil
import runpy
import sys
import time
from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any, Final

MODULE: Final = "tests.reliability.spoilt_process"
CONDUCTOR: Final = "conductor"
ROLES: Final = {  # by the module that a process runs
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
    sys.argv[:] = sys.argv[2:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
