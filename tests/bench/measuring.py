"""Measured figures, the way to measure them, and the figures of a command's start and of virtual time."""

import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from experiments.file.document import load
from experiments.run import simulate, simulate_seeds

REPEATS: Final = 5
SEEDS: Final = 20  # side by side in virtual time


class Figure(msgspec.Struct, frozen=True):
    """A measured figure, and its ratio to a baseline of the same run."""

    benchmark: str
    name: str
    value: float
    unit: str
    ratio: float
    baseline: str


def median(clock: Callable[[], float], work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Median time of a piece of work by a clock [s]: `time.process_time` for CPU time, `time.monotonic`."""
    taken = []
    for _ in range(repeats):
        begin = clock()
        work()
        taken.append(clock() - begin)
    return statistics.median(taken)


def start() -> Iterator[Figure]:
    """Time until a command answers."""

    def wall(*arguments: str) -> float:
        command = partial(subprocess.run, [sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
        return 1e3 * median(time.monotonic, command)

    bare = wall("-c", "pass")
    yield Figure("start", "python that does nothing", bare, "ms", 1.0, "yardstick")
    answer = wall("-m", "tools.guard", "--help")
    yield Figure("start", "zenpark --help", answer, "ms", answer / bare, "× bare python")


def virtual() -> Iterator[Figure]:
    """The reference experiment in virtual time, with and without a recording."""
    cpu = partial(median, time.process_time)
    read = load("robotic-park")
    span = read.experiment.duration_s
    yield Figure("virtual", "10,000 numpy operations", cpu(unit_of_work), "s CPU", 1.0, "yardstick")
    for case in read.cases():
        simulate(read, cases=[case])  # warm up
        taken = cpu(partial(simulate, read, cases=[case]))
        yield Figure("virtual", f"{case}, {span:g} s", taken, "s CPU", span / taken, "× real time")

        def recorded(case: str = case) -> None:
            with tempfile.TemporaryDirectory() as folder:
                simulate(read, cases=[case], folder=Path(folder))

        taken = cpu(recorded)
        yield Figure("virtual", f"{case}, {span:g} s, recorded", taken, "s CPU", span / taken, "× real time")
    taken = cpu(partial(simulate_seeds, read, range(SEEDS), cases=["event"]), 1)
    yield Figure("virtual", f"event, {SEEDS} seeds side by side", taken, "s CPU", SEEDS * span / taken, "× real time")


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """Pipe table of rows, the head first."""
    head, *others = (f"| {' | '.join(row)} |" for row in rows)
    return "\n".join([head, f"|{'---|' * len(rows[0])}", *others])


def unit_of_work() -> None:
    """10,000 small numpy operations, the kind of work that a tick is made of: the yardstick."""
    a, b = np.ones((7, 3)), np.full((7, 3), 0.5)
    for _ in range(5000):
        b = np.maximum(a - b, 0.1)
