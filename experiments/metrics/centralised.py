"""Cost of the architecture of a case: messages, delays, and the load of the central controller."""

from __future__ import annotations

import statistics
from itertools import pairwise
from types import SimpleNamespace

import numpy as np

from experiments.definition.graph import Links
from experiments.metrics.results import CentralisedMetrics
from experiments.recording.trace import Trace
from twins.arrays import Array


def _delays(delay: Array) -> dict[str, float | None]:
    """Mean, 95th percentile and maximum of delays (A,) [s], by their names in the results; None without any."""
    if not len(delay):
        return dict.fromkeys(("delay_mean_s", "delay_p95_s", "delay_max_s"))
    found = {"mean": delay.mean(), "p95": np.quantile(delay, 0.95), "max": delay.max()}
    return {f"delay_{what}_s": float(each) for what, each in found.items()}


def columns(trace: Trace, net: Links) -> SimpleNamespace:
    """Receivers, deliveries and goals of each robot (N,), as fields of its metrics; `net` are the formation's links."""
    rows, goals = len(trace.robots), trace.goals
    guided = np.isin(np.array(trace.robots), trace.plan.guided)  # the centre receives their neighbours' poses
    links, ends = trace.plan.links, trace.plan.pose_links
    to_centre = guided.copy()
    to_centre[links.sender[guided[links.receiver]]] = True
    counted = np.zeros((rows, rows), dtype=bool)  # links for avoidance alone do not belong to the formation
    counted[net.receiver, net.sender] = ~guided[net.receiver]
    taken = trace.received.link[counted[ends.receiver, ends.sender][trace.received.link]]
    found = {
        "receivers": np.bincount(net.sender[~guided[net.receiver]], minlength=rows) + to_centre,
        "received": np.bincount(ends.sender[taken], minlength=rows),
        **dict.fromkeys(("goals", "goal_bytes"), np.zeros(rows, dtype=np.intp)),
    }
    delays = [_delays(np.zeros(0) if goals is None else goals.delay[goals.follower == row]) for row in range(rows)]
    if goals is not None:
        size = np.bincount(goals.sent.link, weights=goals.sent.bytes, minlength=rows).astype(np.intp)
        found["received"] += goals.received
        found |= {"goals": np.bincount(goals.sent.link, minlength=rows), "goal_bytes": size}
    return SimpleNamespace(**found, **{name: [each[name] for each in delays] for name in delays[0]})


def deliveries(trace: Trace) -> int:
    """Messages that arrived, once per receiver: poses at robots and at the central controller, and its goals."""
    goals = trace.goals
    return len(trace.received) + (0 if goals is None else int(goals.received.sum() + goals.reached.sum()))


def guidance(trace: Trace) -> CentralisedMetrics | None:
    """Metrics of the centralised architecture; None if each robot decides for itself."""
    goals = trace.goals
    if goals is None:
        return None
    assert goals.sent.bytes is not None
    load = [report.load for report in goals.reports] if trace.clock == "real" else []
    missed = [report.missed for report in goals.reports]
    return CentralisedMetrics(
        guided=trace.plan.guided,
        goals=len(goals.sent),
        goals_hz=len(goals.sent) / float(trace.time[-1] - trace.time[0]),
        goal_bytes=int(goals.sent.bytes.sum()),
        goals_lost=max(0, len(goals.sent) - int(goals.reached.sum())),
        received=int(goals.received.sum()),
        poses_lost=int(goals.lost.sum() + goals.dropped.sum()),
        **_delays(goals.delay),
        load=statistics.fmean(load) if load else None,
        load_max=max(load, default=None),
        missed=sum(max(0, b - a) for a, b in pairwise(missed)),
    )
