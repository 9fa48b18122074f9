"""A measured figure, and how CPU time is measured."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Final

import msgspec

REPEATS: Final = 5


class Figure(msgspec.Struct, frozen=True):
    """One measured figure, and its ratio to a baseline of the same run."""

    benchmark: str
    name: str
    value: float
    unit: str
    ratio: float
    baseline: str


def cpu(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Median CPU time of a piece of work [s]."""
    taken = []
    for _ in range(repeats):
        begin = time.process_time()
        work()
        taken.append(time.process_time() - begin)
    return statistics.median(taken)
