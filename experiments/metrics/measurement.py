"""Shared quantities of the metrics of one trace, each computed when it is first asked for, and once."""

from __future__ import annotations

from functools import cached_property
from math import nan
from typing import Final

import numpy as np

from agents.plugins.laws import Distance, Gradient
from experiments.metrics.clearance import Clearance
from experiments.metrics.results import PhaseMetrics
from experiments.metrics.signals import (
    LinkErrors,
    after_last,
    belief_errors,
    integral,
    integrals,
    leaders,
    phase_starts,
    transmission_gaps,
    transmissions,
)
from experiments.recording.trace import ROUNDING_S, Trace
from twins.arrays import Array, Index, norm

WINDOW_S: Final = 1.0  # [s] of the moving mean that decides on acquisition, and of the residual
BAND: Final = 0.02  # of the largest error: the 2 % band of the settling time
KNOWN: Final = 0.95  # least share of known positions of a robot: below it the robot counts as died


class Measurement:
    """Quantities of a trace of T samples and N robots that several metrics need; unknown numbers are NaN.

    All errors are taken on true positions. A robot that died has NaN positions from then on: its links are left out
    from that moment.
    """

    def __init__(self, trace: Trace) -> None:
        self.trace = trace

    @cached_property
    def errors(self) -> LinkErrors:
        """Errors of the links [m]."""
        return LinkErrors.of_trace(self.trace)

    @cached_property
    def has_errors(self) -> bool:
        """Whether links have errors: only gradient laws measure them."""
        return isinstance(self.trace.plan.law, Gradient)

    @cached_property
    def robot_errors(self) -> Array:
        """e(t) of each robot (T, N) [m], over its own links."""
        return self.errors.per_robot()

    @cached_property
    def integrals(self) -> tuple[Array, Array, Array]:
        """IAE [m s], ITAE [m s²] and RMSE [m] of each robot, (N,) each."""
        return integrals(self.robot_errors, self.trace.time)

    @cached_property
    def clearance(self) -> Clearance:
        """Distances between surfaces."""
        return Clearance.of_trace(self.trace)

    @cached_property
    def belief(self) -> Array:
        """Errors of the believed positions (T, E) [m], see `signals.belief_errors`."""
        return belief_errors(self.trace, self.errors.net)

    @cached_property
    def cost(self) -> float:
        """J2, see `benchmark_cost`; NaN for laws without errors."""
        return benchmark_cost(self.trace, self.errors) if self.has_errors else nan

    @cached_property
    def known(self) -> Array:
        """Share of the time at which the position of each robot is known (N,)."""
        return self.errors.known()

    @cached_property
    def leaders(self) -> tuple[str, ...]:
        """Robots that lead: means leave them out."""
        return leaders(self.trace)

    @cached_property
    def died(self) -> tuple[str, ...]:
        """Followers without a known position for too long: means leave them out."""
        names = zip(self.trace.robots, self.known, strict=True)
        return tuple(name for name, share in names if share < KNOWN and name not in self.leaders)

    @cached_property
    def kept(self) -> list[int]:
        """Rows of the robots in the means."""
        out = {*self.leaders, *self.died}
        return [i for i, name in enumerate(self.trace.robots) if name not in out]

    @cached_property
    def bounds(self) -> list[tuple[float, int, int]]:
        """Phases, see `bounds_of`."""
        return bounds_of(self.trace)

    @cached_property
    def window(self) -> int:
        """Samples of the moving mean."""
        return max(1, round(WINDOW_S / float(self.trace.time[1] - self.trace.time[0])))

    @cached_property
    def acquired(self) -> list[float | None]:
        """Acquisition of each robot in the first phase [s]; None if never."""
        return self._acquired(0)

    @cached_property
    def phases(self) -> list[list[PhaseMetrics]]:
        """Per phase and robot: time of acquisition and residual error."""
        found = []
        for k, (start, begin, end) in enumerate(self.bounds):
            acquired = self._acquired(k) if k else self.acquired
            worst = self.errors.part(max(begin, end - self.window), end).worst(self.trace.robots)
            found.append([PhaseMetrics(start, when, *left) for when, left in zip(acquired, worst, strict=True)])
        return found

    def _acquired(self, phase: int) -> list[float | None]:
        _, begin, end = self.bounds[phase]
        return self.errors.part(begin, end).acquired(self.window, self.trace.plan.experiment.tolerance)

    @cached_property
    def settled(self) -> list[float | None]:
        """From when on the error of each robot stays in its 2 % band [s]; None if never."""
        total = self.robot_errors
        unsettled = ~(total <= BAND * np.where(np.isfinite(total), total, 0.0).max(axis=0))
        return after_last(unsettled & (self.errors.there | np.isfinite(total)), self.trace.time)

    @cached_property
    def transmissions(self) -> tuple[Index, Index]:
        """Poses sent by each robot, by their running numbers, and those of them in the recording, (N,) each."""
        return transmissions(self.trace)

    @cached_property
    def rate(self) -> Array:
        """Poses that each robot sent in a second, from when it takes part (N,) [Hz]."""
        trace, rows = self.trace, range(len(self.trace.robots))
        time, joined = trace.time, np.zeros(len(rows)) if trace.joined is None else trace.joined
        present = np.maximum(time[-1] - np.maximum(joined, time[0]), time[1] - time[0])
        early = np.array([(trace.sent_by(i).stamp < joined[i]).sum() for i in rows], dtype=np.intp)
        return np.asarray((self.transmissions[0] - early) / present)

    @cached_property
    def waits(self) -> list[Array]:
        """Times between the transmissions of each robot [s]."""
        return transmission_gaps(self.trace)

    @cached_property
    def payload(self) -> Index:
        """Payload that each robot sent (N,) [bytes]."""
        sent = self.trace.sent
        assert sent.bytes is not None, "a sweep keeps sizes only where a metric needs sent"
        size = np.bincount(sent.link, weights=sent.bytes, minlength=len(self.trace.robots))
        return size.astype(np.intp)

    @cached_property
    def dropped(self) -> Index:
        """Poses of each robot that the modelled network dropped, over all receivers (N,)."""
        rows, dropped = len(self.trace.robots), self.trace.dropped
        if dropped is None:
            return np.zeros(rows, dtype=np.intp)
        return np.bincount(self.trace.plan.pose_links.sender, weights=dropped, minlength=rows).astype(np.intp)


def benchmark_cost(trace: Trace, errors: LinkErrors) -> float:
    """J2 of the authors' benchmark (`benchmark_evaluation.m` of 2024), summed over the robots that receive poses.

    The cost of a robot is 0.02 n_m + 0.1 n_u + 0.3 t_s + 0.1 IAE + 0.01 ITAE, all until the settling time t_s. With r
    the distances to its neighbours and anchors and d the wanted ones, t_s is the last time at which g = Σ(r² − d²)
    differs from its end by more than 2 % of |g(0) − g(end)|. n_m are transmissions, n_u computed goals; IAE and ITAE
    are those of Σ|r − d|, halved because a link has two ends (their script takes the ITAE of the last neighbour only,
    which is taken for a slip). For laws without distances, and where wanted distances change, g is their error. Goals
    are counted by their changes in the samples, in proportion to all that were computed.
    """
    plan, time, place = trace.plan, trace.time, trace.true_position
    links, anchors = errors.net, plan.anchors_by_row
    plain = isinstance(plan.law, Distance) and not plan.formation.changes
    new = (np.diff(trace.goal, axis=0) != 0.0).any(axis=2) & np.isfinite(trace.goal[1:]).all(axis=2)
    cost = 0.0
    for i in sorted({*links.receiver.tolist()}):
        own = np.flatnonzero(links.receiver == i)
        error, gap = errors.error[:, own], errors.error[:, own]
        if plain:
            gap = norm(place[:, i, None] - place[:, links.sender[own]]) ** 2 - links.distance[own] ** 2
        for anchor in (each for row, each in anchors if row == i):
            away = norm(np.array([anchor.displacement(tuple(each)) for each in place[:, i].tolist()]))[:, None]
            error = np.hstack([error, np.abs(away - anchor.distance)])
            gap = np.hstack([gap, away**2 - anchor.distance**2])
        signal = np.where(np.isfinite(gap), gap, 0.0).sum(axis=1)
        known = np.flatnonzero(np.isfinite(gap).any(axis=1))
        if not len(known):
            continue
        first, end = signal[known[[0, -1]]]
        outside = known[np.abs(signal[known] - end) > BAND * abs(first - end)]
        last = int(outside[-1]) if len(outside) else 0
        settled = slice(0, last + 1)
        e, t = np.where(np.isfinite(error[settled]), error[settled], 0.0).sum(axis=1)[:, None], time[settled]
        sent = int((trace.sent_by(i).stamp < time[last] - ROUNDING_S).sum())
        before, all_new = int(new[:last, i].sum()), int(new[:, i].sum())
        share = before / all_new if all_new else last / (len(time) - 1)
        effort = 0.02 * sent + 0.1 * share * int(trace.decisions[i]) + 0.3 * float(time[last] - time[0])
        cost += effort + 0.05 * float(integral(e, t)[0]) + 0.005 * float(integral(t[:, None] * e, t)[0])
    return cost


def bounds_of(trace: Trace) -> list[tuple[float, int, int]]:
    """Start [s], first row and last row + 1 of each phase; legs that begin within one sample are one phase."""
    starts = phase_starts(trace)
    begins, first = np.unique(np.searchsorted(trace.time, np.array(starts) - 1e-9), return_index=True)
    ends = [*begins[1:], len(trace.time)]
    return [(starts[k], int(begin), int(end)) for k, begin, end in zip(first, begins, ends, strict=True)]
