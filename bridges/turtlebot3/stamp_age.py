"""Age of messages by the stamps of a robot whose clock is not ours."""

from __future__ import annotations

from math import inf, isfinite
from typing import Final

DRIFT: Final = 1e-3  # [s/s] largest difference between two clocks, one of which may be slewed


class StampAge:
    """Arrival of a message less its stamp, less the smallest such difference so far: what a queue held back.

    A stamp that does not grow comes from a clock that was set back, or from a sender without stamps: all begins anew.
    """

    def __init__(self) -> None:
        self._stamp = self._arrival = -inf
        self._least = inf

    def age(self, arrival: float, stamp: float) -> float:
        """Age [s] of a message with this stamp [s] that arrived at `arrival` [s, monotonic]."""
        if stamp <= self._stamp:
            self._least = inf
        crept = DRIFT * max(arrival - self._arrival, 0.0) if isfinite(self._arrival) else 0.0
        delay = arrival - stamp
        self._least = min(self._least + crept, delay)
        self._stamp, self._arrival = stamp, arrival
        return delay - self._least
