"""Delay of positions from outside, by a climb: what the drone feels on board, compared with what it is given.

The estimator on board follows positions from outside, late or not. Its climb rate is that of the accelerometer, and of
the corrections by these positions. Without the corrections it knows nothing of their delay.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import nan, sqrt
from typing import Final

import numpy as np

NOISE: Final = 1e-3  # [m²/s³] noise of the vertical acceleration, which the firmware's estimator assumes
RISEN_M: Final = 0.08  # [m] height at which a climb is dated
BEFORE_S, AFTER_S = 1.6, 0.5  # parts before and after that time which are compared [s]
REST_S: Final = 0.6  # begin of that part, at rest
STEP_S: Final = 0.01  # step between the delays that are tried [s]
TRIED: Final = np.arange(51)[:, None] * STEP_S  # [s]
ALIKE_M: Final = 0.012  # [m] deviation of the two heights, up to which one is the other
KEPT_S: Final = 6.0

BoardSample = tuple[float, float, float]  # time [s], height [m] and climb rate [m/s] of the estimator on board
GivenSample = tuple[float, float]  # time [s] at which the estimator got a height, and this height [m]


class ClimbLog:
    """Last seconds of both heights of one drone; written by two threads, read by a third."""

    def __init__(self) -> None:
        self._board: deque[BoardSample] = deque()
        self._given: deque[GivenSample] = deque()

    def feel(self, t: float, height: float, rate: float) -> None:
        """Add a height [m] and a climb rate [m/s] on board at `t` [s]."""
        self._board.append((t, height, rate))
        while self._board[0][0] < t - KEPT_S:
            self._board.popleft()

    def tell(self, t: float, height: float) -> None:
        """Add a height [m] from outside that is sent at `t` [s]."""
        self._given.append((t, height))
        while self._given[0][0] < t - KEPT_S:
            self._given.popleft()

    def delay(self, sigma: float) -> float:
        """See `delay`."""
        return delay(list(self._board), list(self._given), sigma)


def delay(board: Sequence[BoardSample], given: Sequence[GivenSample], sigma: float) -> float:
    """Delay [s] of the heights that a climbing drone is given; NaN if the two do not say it.

    `sigma`: standard deviation [m] that the estimator assumes of them.
    """
    if not board or not given:
        return nan
    t, height, rate = np.array(board).T
    at, heights = np.array(given).T
    risen = heights > heights.min() + RISEN_M
    dated = float(at[np.argmax(risen)])
    begin, end = dated - BEFORE_S, dated + AFTER_S
    if not risen.any() or max(at[0], t[0] + TRIED[-1, 0]) > begin or min(t[-1], at[-1]) < end:
        return nan
    off = np.interp(at, t, height) - heights
    rest = (at >= begin) & (at < begin + REST_S)
    if not rest.any():
        return nan
    off -= off[rest].mean()  # corrects the error of the accelerometer at rest
    every = np.diff(at, prepend=at[0])
    gain = sqrt(NOISE / np.median(every[1:])) / sigma  # [1/s²] gain of the filter at its steady state
    rate = rate + gain * np.interp(t, at, np.cumsum(every * off))
    felt = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(t) * (rate[1:] + rate[:-1]))])
    part = (at >= begin) & (at <= end)
    at, heights = at[part], heights[part]
    left = heights - np.interp(at - TRIED, t, felt)
    trend, _ = np.linalg.qr(np.vander(at - dated, 2))  # trend of an integral: a constant, and a wrong rate
    left = (left - left @ trend @ trend.T).std(axis=1)
    best = int(left.argmin())
    return float(TRIED[best, 0]) if left[best] < ALIKE_M else nan
