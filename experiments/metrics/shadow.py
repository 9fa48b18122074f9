"""Agreement of a shadow twin with its robot: bias, error and correlation, from the poses of both."""

from __future__ import annotations

from typing import Final

import numpy as np

from experiments.arrays import wrap
from experiments.metrics.results import ShadowMetrics
from experiments.recording.trace import Trace
from twins.arrays import Array, Mask, norm

SPEED_S: Final = 0.2  # [s] time over which a speed is taken: shorter, and it would be the noise's
STILL_M: Final = 1e-3  # [m] standard deviation of what hardly moved: it has no correlation
STILL_M_S: Final = 5e-3  # [m/s] likewise
JUMP: Final = 6.0  # times the usual change from sample to sample: there the twin was put onto the robot
JUMP_M: Final = 1e-3  # [m] least length of a jump


def differences(trace: Trace) -> Array:
    """(T, N, 3) position of the twin beside each robot less that of the robot, as measured [m]; NaN where unknown."""
    if trace.shadow_position is None:
        return np.full_like(trace.position, np.nan)
    return np.asarray(trace.shadow_position - trace.position)


def in_heading(trace: Trace, difference: Array) -> tuple[Array, Array]:
    """Planar differences (T, N, 3) as parts along each robot's heading and to its left, (T, N) each [m]."""
    cos, sin = np.cos(trace.yaw), np.sin(trace.yaw)
    x, y = difference[..., 0], difference[..., 1]
    return cos * x + sin * y, cos * y - sin * x


def agreement(trace: Trace) -> list[ShadowMetrics | None]:
    """Metrics of each robot's shadow twin; None without one, or if both are never known together."""
    if trace.shadow_position is None or trace.shadow_yaw is None:
        return [None] * len(trace.robots)
    difference, turned = differences(trace), wrap(trace.shadow_yaw - trace.yaw)
    along, across = in_heading(trace, difference)
    known = np.isfinite(difference).all(axis=2) & np.isfinite(turned)
    found: list[ShadowMetrics | None] = []
    for i, name in enumerate(trace.robots):
        samples = known[:, i]
        chosen = trace.plan.experiment.robots[name].shadow
        if not samples.any():
            found.append(None)
            continue
        robot, twin = trace.position[:, i], trace.shadow_position[:, i]
        apart = difference[:, i]
        bias = apart[samples].mean(axis=0).tolist()
        gap = norm(apart[samples])
        found.append(
            ShadowMetrics(
                horizon_s=None if chosen is None else chosen.restart_s,
                bias=(bias[0], bias[1], bias[2]),
                along=float(along[samples, i].mean()),
                across=float(across[samples, i].mean()),
                bias_yaw=float(turned[samples, i].mean()),
                rmse=float(np.sqrt((gap**2).mean())),
                rmse_yaw=float(np.sqrt((turned[samples, i] ** 2).mean())),
                largest=float(gap.max()),
                correlation=tuple(_correlation(robot[samples, k], twin[samples, k], STILL_M) for k in range(3)),  # type: ignore[arg-type]
                correlation_speed=_of_speeds(trace.time, robot, twin, samples),
                known=float(samples.mean()),
            )
        )
    return found


def _of_speeds(time: Array, robot: Array, twin: Array, known: Mask) -> float | None:
    """Correlation of the speeds of two paths (T, 3), without the resets of the twin."""
    width = max(1, round(SPEED_S / float(time[1] - time[0])))
    if len(time) <= width:
        return None
    broken = ~known
    change = norm(np.diff(twin - robot, axis=0))
    usual = change[np.isfinite(change)]
    if len(usual):  # it changes as it never does by itself where the twin was put onto the robot
        broken[1:] |= change > JUMP * np.median(usual) + JUMP_M
    count = np.concatenate([[0], np.cumsum(broken)])
    whole = count[width + 1 :] == count[1 : len(time) - width + 1]  # no break after the first of width + 1 samples
    whole &= known[: len(time) - width]
    speeds = [norm(path[width:] - path[:-width])[whole] / SPEED_S for path in (robot, twin)]
    return _correlation(speeds[0], speeds[1], STILL_M_S)


def _correlation(one: Array, other: Array, still: float) -> float | None:
    """Pearson's; None if one of the two hardly changes."""
    if len(one) < 3 or min(one.std(), other.std()) < still:
        return None
    return float(np.corrcoef(one, other)[0, 1])
