"""Ticks of a loop at a fixed rate: when the next one is due, and which are skipped by a loop that comes late.

Loops that only look for news now and then (recorder, conductor, viewers, watchdogs) have no deadlines: they pause.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from math import floor
from typing import Final

ROUNDING_S: Final = 1e-6  # times are sums of binary fractions: instants that differ by less are the same
POLL_S: Final = 0.02  # pause of loops that look for news


class Ticks:
    """Times 0, 1 / `hz`, 2 / `hz`, ... [s] since `start`, for a loop that waits `until_next` and then calls `begin`.

    The loop chooses how it waits: asleep, for an event, on sockets. A loop that comes late makes up for at most
    `catch_up` ticks and skips those before; the others keep their times, so that robots which started together go on
    together. A wait that lasts too long delays its tick and skips none, unless the loop asks `until_next` again.
    """

    def __init__(self, hz: float, *, catch_up: int = 0, clock: Callable[[], float] = time.monotonic) -> None:
        self.period = 1.0 / hz  # [s]
        self._catch_up, self._clock = catch_up, clock
        self._skips = 0  # ticks that are over before the next one begins
        self.late_s = 0.0  # [s] delay of the last tick's begin
        self.start()

    def start(self) -> float:
        """Make the present time 0, at which the first tick is due; returns it on the clock [s]."""
        self.zero = self._clock()  # moved by a loop with slewed time
        self.t = self.next = 0.0  # [s] times of the last tick and of the next one
        return self.zero

    def elapsed(self) -> float:
        """Time since the start [s]."""
        return self._clock() - self.zero

    def until_next(self) -> float:
        """Time until the next tick [s]; 0 if it is due, and then the ticks to skip are counted."""
        ahead = self.zero + self.next - self._clock()
        if ahead > 0.0:
            self._skips = 0
            return ahead
        self._skips = max(0, int(-ahead / self.period) - self._catch_up)
        return 0.0

    def begin(self) -> int:
        """Begin the next tick, at `t`; returns the number of ticks that were skipped before it."""
        self.t = self.next + self._skips * self.period
        self.next = self.t + self.period
        self.late_s = self._clock() - self.zero - self.t
        return self._skips

    def align(self, at: float) -> None:
        """Shift the ticks so that one falls on `at` [s]; the next is at most a period after the last."""
        self.next = at - floor((at - self.t) / self.period - 1e-6) * self.period
