"""The one way in which tests wait for something, or take turns, and a clock by hand."""

from __future__ import annotations

import fcntl
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

PATIENCE_S = 60.0  # nothing takes so long, on the slowest machine


def until(true: Callable[[], object], what: str = "it is true", limit_s: float = PATIENCE_S) -> None:
    """Waits until something is true."""
    deadline = time.monotonic() + limit_s
    pause = threading.Event()
    while not true():
        assert time.monotonic() < deadline, f"not in {limit_s:g} s: {what}"
        pause.wait(0.005)


@contextmanager
def only_user_of(device: str) -> Iterator[None]:
    """Inside no other test drives such a device: the ports of a maker's library are the host's."""
    with (Path(tempfile.gettempdir()) / f"zenpark-{device}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


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
