"""Telemetry at irregular times, resampled onto the uniform grid of a trace; NaN in holes."""

from __future__ import annotations

from typing import Final

import numpy as np

from agents.ticks import ROUNDING_S
from twins.arrays import Array, Mask, norm

HOLE_S: Final = 1.0  # telemetry that is silent for longer is not interpolated over


def line(t: Array, values: Array, time: Array, hold: float) -> Array:
    """Samples (K, k) at times (K,), interpolated linearly onto the grid (T, k); one that is not finite is none.

    For `hold` seconds before and after a sample it is taken to be known; then it is NaN.
    """
    whole = np.isfinite(values).all(axis=1)
    t, values = t[whole], values[whole]
    if not len(t):
        return np.full((len(time), values.shape[1]), np.nan)
    drawn = np.column_stack([np.interp(time, t, column) for column in values.T])
    drawn[~_known(t, time, hold)] = np.nan
    return drawn


def turn(t: Array, angle: Array, time: Array, hold: float) -> Array:
    """Like `line` for angles (K, 1) [rad]: the short way round, and on the branch of the sample before."""
    whole = np.isfinite(angle[:, 0])
    t, angle = t[whole], angle[whole]
    turned = line(t, np.unwrap(angle, axis=0), time, hold)
    return turned + 2.0 * np.pi * np.round((step(t, angle, time, hold) - turned) / (2.0 * np.pi))


def attitude(t: Array, quaternion: Array, time: Array, hold: float) -> Array:
    """Like `line` for unit quaternions (K, 4), of which q and −q are the same: the short way, and of length one."""
    size = np.abs(quaternion).max(axis=1, initial=0.0)
    whole = (size > 0.1) & (size < 2.0)  # a recording can hold anything; NaN is neither
    t, quaternion = t[whole], quaternion[whole]
    with_the_last = np.vecdot(quaternion[1:], quaternion[:-1])
    sign = np.cumprod(np.concatenate([np.ones(min(1, len(t))), np.where(with_the_last < 0.0, -1.0, 1.0)]))
    mixed = line(t, sign[:, None] * quaternion, time, hold)
    # on the side of the sample before, as it was recorded
    side = np.vecdot(step(t, quaternion, time, hold), mixed)
    return mixed * (np.where(side < 0.0, -1.0, 1.0) / norm(mixed))[:, None]


def step(t: Array, values: Array, time: Array, hold: float) -> Array:
    """Samples (K, k) at times (K,), the last at or before each time of the grid (T, k)."""
    if not len(t):
        return np.full((len(time), values.shape[1]), np.nan)
    before = np.searchsorted(t, time + ROUNDING_S, side="right") - 1
    held = values[np.maximum(before, 0)]
    held[~_known(t, time, hold)] = np.nan
    return held


def _known(t: Array, time: Array, hold: float) -> Mask:
    """Mask of the grid where samples are valid: close to one, or between two that are not far apart."""
    after = np.searchsorted(t, time)
    padded = np.concatenate([[-np.inf], t, [np.inf]])
    since, until = time - padded[after], padded[after + 1] - time
    return np.asarray((np.minimum(since, until) <= hold + ROUNDING_S) | (since + until <= HOLE_S + ROUNDING_S))
