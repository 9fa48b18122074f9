"""Cost of the architecture of a case: messages, delays, and the load of the central controller."""

from __future__ import annotations

import statistics
from itertools import pairwise

import numpy as np

from experiments.metrics.results import CentralisedMetrics
from experiments.recording.trace import Trace
from twins.arrays import Array, Index, Mask


def _delays(delay: Array) -> dict[str, float | None]:
    """Mean, 95th percentile and maximum of delays (A,) [s], by their names in the results; None without any."""
    found = (delay.mean(), np.quantile(delay, 0.95), delay.max()) if len(delay) else (None,) * 3
    return {
        f"delay_{what}_s": None if each is None else float(each)
        for what, each in zip(("mean", "p95", "max"), found, strict=True)
    }


def guided_rows(trace: Trace) -> Mask:
    """Robots (N,) that the central controller guides."""
    return np.isin(np.array(trace.robots), trace.plan.guided)


def received_by_centre(trace: Trace) -> Mask:
    """Senders (N,) of poses to the central controller: the robots that it guides, and their neighbours."""
    rows = guided_rows(trace)
    net = trace.plan.links
    hears = rows.copy()
    hears[net.sender[rows[net.receiver]]] = True
    return np.asarray(hears & rows.any())


def delays(trace: Trace) -> list[dict[str, float | None]]:
    """Delays of the goals to each robot, as fields of its metrics."""
    goals = trace.goals
    rows = range(len(trace.robots))
    return [_delays(np.zeros(0) if goals is None else goals.delay[goals.follower == row]) for row in rows]


def goals_to(trace: Trace) -> tuple[Index, Index]:
    """Number of goals sent to each robot (N,), and their payload (N,) [bytes]."""
    rows, goals = len(trace.robots), trace.goals
    if goals is None:
        return np.zeros(rows, dtype=np.intp), np.zeros(rows, dtype=np.intp)
    size = np.bincount(goals.sent.link, weights=goals.sent.bytes, minlength=rows)
    return np.bincount(goals.sent.link, minlength=rows), size.astype(np.intp)


def deliveries(trace: Trace) -> int:
    """Messages that arrived, once per receiver: poses at robots and at the central controller, and its goals."""
    goals = trace.goals
    return len(trace.received) + (0 if goals is None else int(goals.received.sum() + goals.reached.sum()))


def guidance(trace: Trace) -> CentralisedMetrics | None:
    """Metrics of the centralised architecture; None if each robot decides for itself."""
    goals = trace.goals
    if goals is None:
        return None
    duration = float(trace.time[-1] - trace.time[0])
    load = [report.load for report in goals.reports] if trace.clock == "real" else []
    missed = [report.missed for report in goals.reports]
    return CentralisedMetrics(
        guided=trace.plan.guided,
        goals=len(goals.sent),
        goals_hz=len(goals.sent) / duration,
        goal_bytes=int(goals_to(trace)[1].sum()),
        goals_lost=max(0, len(goals.sent) - int(goals.reached.sum())),
        received=int(goals.received.sum()),
        poses_lost=int(goals.lost.sum() + goals.dropped.sum()),
        **_delays(goals.delay),
        load=statistics.fmean(load) if load else None,
        load_max=max(load, default=None),
        missed=sum(max(0, b - a) for a, b in pairwise(missed)),
    )
