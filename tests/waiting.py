"""The one way in which tests wait for something, and a clock by hand."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

PATIENCE_S = 60.0  # nothing takes so long, on the slowest machine


def until(true: Callable[[], object], what: str = "it is true", limit_s: float = PATIENCE_S) -> None:
    """Waits until something is true."""
    deadline = time.monotonic() + limit_s
    pause = threading.Event()
    while not true():
        assert time.monotonic() < deadline, f"not in {limit_s:g} s: {what}"
        pause.wait(0.005)


class ManualClock:
    """Time that passes by hand; stands in for an `agents.clock.Clock` and for the module `time`.

    Attributes:
        now: Reading of every clock [s].
        step: Time that passes at each reading [s].
    """

    def __init__(self, now: float = 0.0, step: float = 0.0) -> None:
        self.now, self.step = now, step

    def monotonic(self) -> float:
        self.now += self.step
        return self.now

    utc = time = perf_counter = monotonic

    def sleep(self, seconds: float) -> None:
        self.now += seconds
