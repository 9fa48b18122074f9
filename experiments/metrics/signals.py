"""Signals of a trace, as arrays: errors of links, acquisition, rotation, beliefs, gaps; `Measurement` has each once.

Positions that are unknown are NaN; nothing here lets one robot's NaN reach another robot's numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, ValuesView
from dataclasses import dataclass, fields, replace
from functools import cached_property, wraps
from itertools import pairwise
from math import inf, nan
from types import SimpleNamespace
from typing import Any, Final, NamedTuple, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from msgspec import structs

from agents.plugins.laws import Distance, Gradient
from agents.plugins.predictors import HOLD, Predictor
from agents.ticks import ROUNDING_S
from agents.vectors import Vector
from experiments.arrays import ArrayTable
from experiments.definition.formation import counted_links, robot_sums, targeted
from experiments.definition.graph import Links
from experiments.definition.plan import Plan
from experiments.metrics import centralised
from experiments.metrics.clearance import Clearance, collisions
from experiments.metrics.results import Collision, LinkDelivery, PhaseMetrics
from experiments.recording.losses import count_unrecorded
from experiments.recording.trace import Trace
from twins.arrays import Array, Index, Mask, norm

WINDOW_S: Final = 1.0  # [s] window of the moving mean that decides on acquisition, and of the residual
BAND: Final = 0.02  # share of the largest error: the 2 % band of the settling time
KNOWN: Final = 0.95  # least share of known positions of a robot: below it the robot counts as died
RETURN_S: Final = 3.0  # robots come back one after the other when the network does


def has_errors(plan: Plan) -> bool:
    """Whether links have errors: any of them has a target. A law without memory goes by targets, even of no link."""
    return isinstance(plan.law, Gradient) or bool(targeted(plan.law, plan.formation).any())


def phase_starts(trace: Trace) -> tuple[float, ...]:
    """Beginnings of the phases [s]: common start, each leg of the timeline and each change of shape in the run."""
    first, last = float(trace.time[0]), float(trace.time[-1])
    experiment = trace.plan.experiment
    begins = {leg.at_s for leg in experiment.timeline} | {change.at_s for change in experiment.formation.changes}
    return (first, *sorted(at for at in begins if first < at < last))


def bounds_of(trace: Trace) -> list[tuple[float, int, int]]:
    """Start [s], first row and last row + 1 of each phase; legs that begin within one sample are one phase."""
    starts = phase_starts(trace)
    begins, first = np.unique(np.searchsorted(trace.time, np.array(starts) - 1e-9), return_index=True)
    ends = [*begins[1:], len(trace.time)]
    return [(starts[k], int(begin), int(end)) for k, begin, end in zip(first, begins, ends, strict=True)]


@dataclass(frozen=True)
class LinkErrors:
    """Errors of the links against their targets, and the robots that they count for."""

    time: Array  # (T,) [s]
    net: Links
    # (E, N) 1 where a link with a target counts for a robot: those on which it receives, or without any, those on
    # which it sends
    own: Array
    # (T, E) by the target, |‖p_i − p_j‖ − d_ij| for distances [m]; NaN where an end is unknown, or the link is not
    # there or has no target
    error: Array
    alive: Mask  # (T, N) whether the robot's own position is known
    # (T, N) whether a robot was to be there: not before it joined, nor while the network was away (see `network_away`),
    # when an unknown position tells nothing of it
    present: Mask
    gone: Mask  # (T, N) from then on neither a robot's position nor an error of its links is known any more
    away_s: float  # [s] time without any known position in the whole trace, see `network_away`

    @classmethod
    def of_trace(cls, trace: Trace) -> LinkErrors:
        pattern, rows = trace.plan.formation, len(trace.robots)
        alive = np.asarray(np.isfinite(trace.true_position).all(axis=2))
        away_s, away = network_away(alive, trace.time)
        present = np.repeat(~away[:, None], rows, axis=1)
        if trace.joined is not None:
            present &= trace.time[:, None] >= trace.joined
        alive &= ~trace.blind
        own, error = counted_links(trace.plan.law, pattern, rows), trace.link_errors
        gone = ~np.maximum.accumulate((alive & (np.isfinite(error) @ own > 0.0))[::-1])[::-1]
        return cls(trace.time, pattern.links, own, error, alive, present, np.asarray(gone), away_s)

    def part(self, begin: int, end: int) -> LinkErrors:
        """The same from one row in time to another."""
        rows = slice(begin, end)
        parts = {name: getattr(self, name)[rows] for name in ("time", "error", "alive", "present", "gone")}
        return replace(self, **parts)

    def acquired(self, window: int, tolerance: float) -> list[float | None]:
        """Per robot, from when on the mean of each of its links over `window` samples stays within the tolerance [m].

        Seconds since the first sample; None if the last sample is still outside. A neighbour that died does not count.
        While nothing is known of a robot that comes back, it is where it was before: outside, if never seen inside.
        """
        total, count = sums_over_window(self.error, window)
        outside = (total > tolerance * count + 1e-12).astype(float) @ self.own > 0.0
        known = (np.isfinite(self.error) @ self.own > 0.0) & self.alive
        last = np.maximum.accumulate(np.where(known, np.arange(len(known))[:, None], -1), axis=0)
        before = np.take_along_axis(outside, np.maximum(last, 0), axis=0) | ((last < 0) & self.present)
        return after_last(before | self.gone, self.time)

    def gaps(self) -> list[tuple[int, float, float]]:
        """Times [s, s] without the position of a robot, by its row, until it is known again; no absence of all."""
        absent = ~self.alive & self.present & np.maximum.accumulate(self.alive, axis=0)
        found = []
        for row in range(self.alive.shape[1]):
            edges = np.flatnonzero(np.diff(absent[:, row], prepend=False, append=False))
            for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
                if end < len(self.time):
                    found.append((row, float(self.time[begin]), float(self.time[end])))
        return found

    def coverage(self) -> Array:
        """(N,) known share of the errors of each robot's links while both ends were to be there; 0 without links."""
        present = self.present[:, self.net.receiver] & self.present[:, self.net.sender]
        covered = (np.isfinite(self.error) & present).sum(axis=0) / np.maximum(present.sum(axis=0), 1)
        return np.asarray((covered @ self.own) / np.maximum(self.own.sum(axis=0), 1.0))

    def worst(self, names: Sequence[str]) -> list[tuple[float | None, str]]:
        """Per robot the mean error of its worst link [m], and the robot at its other end."""
        mean = mean_known(self.error)
        found: list[tuple[float | None, str]] = []
        for i, counts in enumerate(self.own.T > 0.0):
            candidates = np.flatnonzero(counts & np.isfinite(mean))
            if not len(candidates):
                found.append((None, ""))
                continue
            k = candidates[mean[candidates].argmax()]
            other = self.net.sender[k] if self.net.receiver[k] == i else self.net.receiver[k]
            found.append((float(mean[k]), names[other]))
        return found


def sums_over_window(error: Array, window: int) -> tuple[Array, Array]:
    """Sum and number (T, E) of the known of errors (T, E) over the last samples; the window fills up at the start."""
    known = np.isfinite(error)
    edge = np.zeros((1, error.shape[1]))
    total = np.concatenate([edge, np.cumsum(np.where(known, error, 0.0), axis=0)])
    count = np.concatenate([edge, np.cumsum(known, axis=0)])
    before = np.maximum(np.arange(1, len(total)) - window, 0)
    return total[1:] - total[before], count[1:] - count[before]


def moving_mean(error: Array, window: int) -> Array:
    """Mean of each link over the last `window` samples (T, E) [m], as `acquired` judges it; NaN without any."""
    total, count = sums_over_window(error, window)
    return np.asarray(np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0))


def largest(values: Array) -> Array:
    """Largest known value of each row (T, n); NaN without any."""
    return np.asarray(np.fmax.reduce(values, axis=1, initial=np.nan))


def network_away(alive: Mask, time: Array) -> tuple[float, Mask]:
    """Holes that all robots share and that end: not the robots, the network was away.

    Args:
        alive: (T, N) whether a robot's position is known.

    Returns:
        Time without any known position [s], and the rows (T,) up to `RETURN_S` after that at which some are not known.
    """
    none_known: Mask = np.asarray(~alive.any(axis=1))
    ends = np.flatnonzero(alive.any(axis=1))
    none_known[(ends[-1] if len(ends) else 0) :] = False  # robots that never come back are lost
    if alive.shape[1] < 2 or not none_known.any():
        return 0.0, np.zeros(len(time), dtype=bool)
    moments = time[none_known]
    before = np.concatenate([[-np.inf], moments])[np.searchsorted(moments, time)]
    near = time - before <= RETURN_S
    return float(none_known.sum() * (time[1] - time[0])), np.asarray((near & ~alive.all(axis=1)) | none_known)


def mean_known(values: Array) -> Array:
    """Mean of the finite values over the first axis; NaN where there is none (`nanmean` would warn)."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    total = np.where(known, values, 0.0).sum(axis=0)
    return np.asarray(np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0))


def integral(values: Array, time: Array) -> Array:
    """Trapezoidal integral over the first axis of (T, N), over the part that is known."""
    parts = 0.5 * (values[1:] + values[:-1]) * np.diff(time)[:, None]
    return np.asarray(np.where(np.isfinite(parts), parts, 0.0).sum(axis=0))


def after_last(bad: Mask, time: Array) -> list[float | None]:
    """Per column of (n, N): time since the first row from which on nothing is bad; None if the last row is bad."""
    last = np.where(bad.any(axis=0), len(bad) - 1 - bad[::-1].argmax(axis=0), -1)
    return [None if k == len(bad) - 1 else float(time[k + 1] - time[0]) for k in last]


def net_rotation(position: Array, time: Array) -> float | None:
    """Rate at which a group turns about its centroid, seen from above [rad/s].

    Args:
        position: (n, N, 3) [m]; robots with unknown positions are left out.

    The angle against the first pose is the planar Kabsch solution atan2(Σ r × s, Σ r · s), unwrapped in time; the rate
    is the slope of a straight line through it.
    """
    if len(time) < 3:
        return None
    flat = position[:, np.isfinite(position[..., :2]).all(axis=(0, 2)), :2]
    if flat.shape[1] < 2:
        return None
    flat = flat - flat.mean(axis=1, keepdims=True)
    x, y = flat[0].T
    angle = np.unwrap(np.arctan2(flat[..., 1] @ x - flat[..., 0] @ y, flat[..., 0] @ x + flat[..., 1] @ y))
    t = time - time.mean()
    return float(t @ angle) / float(t @ t)


def belief_errors(trace: Trace, net: Links) -> Array:
    """Error (T, E) [m] of the believed position on each link: the newest pose received, extrapolated by the predictor.

    NaN before the first pose, and after a death.
    """
    rows, received = len(trace.robots), trace.received
    links = trace.plan.pose_links
    number = np.full((rows, rows), -1)
    number[net.receiver, net.sender] = np.arange(len(net))
    link = number[links.receiver, links.sender][received.link]
    error = np.full((len(trace.time), len(net)), np.nan)
    order = np.argsort(link, kind="stable")
    ends = np.searchsorted(link[order], np.arange(len(net) + 1))
    for k, (begin, end) in enumerate(pairwise(ends)):
        arrivals = order[begin:end]
        stamp = received.stamp[arrivals]
        arrivals = arrivals[stamp >= np.maximum.accumulate(stamp)]  # overtaken samples are ignored
        if not len(arrivals):
            continue
        at = np.searchsorted(received.arrival[arrivals], trace.time, side="right") - 1
        newest = arrivals[at]
        age = np.maximum(trace.time - received.stamp[newest], 0.0)
        believed = _predicted(trace.plan.predictor, received.position[newest], received.velocity[newest], age)
        error[:, k] = norm(believed - trace.true_position[:, net.sender[k]])
        error[at < 0, k] = np.nan
    return error


class _Sent(NamedTuple):
    """A transmitted pose."""

    position: Vector  # [m]
    velocity: Vector  # [m/s]


def _predicted(predictor: Predictor, position: Array, velocity: Array, age: Array) -> Array:
    """Believed positions (T, 3) [m] from poses of an age (T,) [s] with position and velocity (T, 3)."""
    if predictor is HOLD:
        return position
    sent = zip(map(tuple, position.tolist()), map(tuple, velocity.tolist()), age.tolist(), strict=True)
    return np.array([predictor.position(_Sent(place, speed), since) for place, speed, since in sent]).reshape(-1, 3)


def closest_distance(position: Array) -> float:
    """Smallest distance between two robots' centres [m]; infinite if there are no two."""
    gaps = (norm(position[:, i + 1 :] - position[:, i, None]) for i in range(position.shape[1] - 1))
    return min((float(gap[np.isfinite(gap)].min(initial=inf)) for gap in gaps), default=inf)


def outside_arena(trace: Trace) -> Array:
    """Largest distance of each robot outside the arena (N,) [m]; negative if it never was outside."""
    size = np.array(trace.plan.experiment.arena.size)
    centre = np.array([0.0, 0.0, 0.5 * size[2]])  # the floor is at z = 0
    beyond = (np.abs(trace.true_position - centre) - 0.5 * size).max(axis=2)
    return np.asarray(np.where(np.isfinite(beyond), beyond, -np.inf).max(axis=0))


def link_deliveries(trace: Trace) -> tuple[LinkDelivery, ...]:
    """Delivery statistics of every link, those that only avoidance needs included."""
    links, received = trace.plan.pose_links, trace.received
    count, link = len(links), received.link
    took = received.arrival - received.stamp
    dropped = np.zeros(count, dtype=np.intp) if trace.dropped is None else trace.dropped
    counts = np.bincount(link, minlength=count)
    total = np.bincount(link, weights=took, minlength=count)
    longest = np.full(count, -np.inf)
    np.maximum.at(longest, link, took)
    columns = zip(links.receiver.tolist(), links.sender.tolist(), counts.tolist(), dropped.tolist(), strict=True)
    return tuple(
        LinkDelivery(
            receiver=trace.robots[i],
            sender=trace.robots[j],
            received=number,
            dropped=lost,
            delay_mean=float(total[k]) / number if number else None,
            delay_max=float(longest[k]) if number else None,
        )
        for k, (i, j, number, lost) in enumerate(columns)
    )


Value = TypeVar("Value")


def _kept(of: Callable[[Any], Value]) -> cached_property[Value]:
    """Property that is computed once; its arrays cannot be changed, since several metrics read them."""

    @wraps(of)
    def computed(measurement: Measurement) -> Value:
        found = of(measurement)
        several = vars(found).values() if isinstance(found, LinkErrors) else found
        for each in several if isinstance(several, (Sequence, ValuesView)) else (found,):
            if isinstance(each, np.ndarray):
                each.flags.writeable = False
        return found

    return cached_property(computed)


def _locked_copy(trace: Trace) -> Trace:
    """The same trace, with arrays that cannot be changed."""

    def locked(value: Any) -> Any:  # noqa: ANN401 - any field of a trace
        if isinstance(value, np.ndarray):
            value = value.view()
            value.flags.writeable = False
        elif isinstance(value, ArrayTable):
            value = structs.replace(value, **{name: locked(each) for name, each in structs.asdict(value).items()})
        elif isinstance(value, Mapping):
            value = {name: locked(each) for name, each in value.items()}
        return value

    return replace(trace, **{each.name: locked(getattr(trace, each.name)) for each in fields(trace)})


class Measurement:
    """Quantities of a trace of T samples and N robots that several metrics need; unknown numbers are NaN.

    All errors are taken on true positions. A robot that died has NaN positions from then on: its links are left out
    from that moment. No array can be changed, see `_kept`: a metric would falsify the others.
    """

    def __init__(self, trace: Trace) -> None:
        self.trace = _locked_copy(trace)
        self.has_errors = has_errors(trace.plan)
        leading = trace.plan.leaders
        self.leaders = () if len(leading) == len(trace.robots) else leading  # robots that means leave out
        self.bounds = bounds_of(trace)  # phases

    @classmethod
    def of(cls, trace: Trace) -> Measurement:
        """Measurement that metrics, figures and replay of a trace share."""
        if (found := _MEASURED.get(trace)) is None:
            found = _MEASURED[trace] = cls(trace)
        return found

    @_kept
    def window(self) -> int:
        """Samples of the moving mean."""
        time = self.trace.time
        return max(1, round(WINDOW_S / float(time[1] - time[0]))) if len(time) > 1 else 1

    @_kept
    def errors(self) -> LinkErrors:
        """Errors of the links [m]."""
        return LinkErrors.of_trace(self.trace)

    @_kept
    def robot_errors(self) -> Array:
        """e_i(t) = Σ_j e_ij (T, N) [m] over the own links of each robot; NaN where none of them is known."""
        return robot_sums(self.errors.error, self.errors.own)

    @_kept
    def worst_links(self) -> Array:
        """Error of the worst link of each follower (T, N) [m], as acquisition judges it; NaN where none is known."""
        known = self.errors
        mean = np.concatenate([moving_mean(known.error[begin:end], self.window) for _, begin, end in self.bounds])
        followers = [row for row, name in enumerate(self.trace.robots) if name not in self.leaders]
        return np.stack([largest(mean[:, known.own[:, row] > 0.0]) for row in followers], axis=1)

    @_kept
    def integrals(self) -> tuple[Array, Array, Array]:
        """∫ e dt [m s], ∫ t·e dt [m s²] and √(mean e²) [m] of each robot, (N,) each."""
        total, time = self.robot_errors, self.trace.time
        rmse = np.sqrt(mean_known(total**2))
        iae, itae = np.where(np.isfinite(rmse), [integral(total, time), integral(time[:, None] * total, time)], np.nan)
        return iae, itae, np.asarray(rmse)

    @_kept
    def clearance(self) -> Clearance:
        """Distances between surfaces."""
        return Clearance.of_trace(self.trace)

    @_kept
    def belief(self) -> Array:
        """Errors of the believed positions (T, E) [m], see `signals.belief_errors`."""
        return belief_errors(self.trace, self.errors.net)

    @_kept
    def cost(self) -> float:
        """J2 of the authors' benchmark (`benchmark_evaluation.m` of 2024), summed over the robots that receive poses.

        The cost of a robot is 0.02 n_m + 0.1 n_u + 0.3 t_s + 0.1 IAE + 0.01 ITAE, all until the settling time t_s. With
        r the distances to its neighbours and anchors and d the wanted ones, t_s is the last time at which g = Σ(r² −
        d²) differs from its end by more than 2 % of |g(0) − g(end)|. n_m are transmissions, n_u computed goals; IAE and
        ITAE are those of Σ|r − d|, halved because a link has two ends (their script takes the ITAE of the last
        neighbour only, which is taken for a slip). Without distances, and where wanted distances change, g is their
        error. Goals are counted by their changes in the samples, in proportion to all that were computed. NaN for
        links without targets.
        """
        if not self.has_errors:
            return nan
        trace, errors = self.trace, self.errors
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
            sent = int((trace.sent_at[i] < time[last] - ROUNDING_S).sum())
            before, all_new = int(new[:last, i].sum()), int(new[:, i].sum())
            share = before / all_new if all_new else last / (len(time) - 1)
            effort = 0.02 * sent + 0.1 * share * int(trace.decisions[i]) + 0.3 * float(time[last] - time[0])
            cost += effort + 0.05 * float(integral(e, t)[0]) + 0.005 * float(integral(t[:, None] * e, t)[0])
        return cost

    @_kept
    def known(self) -> Array:
        """Share of the time at which each robot was to be there, at which its position is known (N,); 0 without any."""
        present = self.errors.present
        return np.asarray((self.errors.alive & present).sum(axis=0) / np.maximum(present.sum(axis=0), 1))

    @_kept
    def died(self) -> tuple[str, ...]:
        """Followers without a known position for too long: means leave them out."""
        names = zip(self.trace.robots, self.known, strict=True)
        return tuple(name for name, share in names if share < KNOWN and name not in self.leaders)

    @_kept
    def kept(self) -> list[int]:
        """Rows of the robots in the means."""
        out = {*self.leaders, *self.died}
        return [i for i, name in enumerate(self.trace.robots) if name not in out]

    @_kept
    def acquired(self) -> list[float | None]:
        """Acquisition of each robot in the first phase [s]; None if never."""
        return [each.acquired_s for each in self.phases[0]]

    @_kept
    def phases(self) -> list[list[PhaseMetrics]]:
        """Per phase and robot: time of acquisition and residual error."""
        found = []
        for start, begin, end in self.bounds:
            acquired = self.errors.part(begin, end).acquired(self.window, self.trace.plan.experiment.tolerance)
            worst = self.errors.part(max(begin, end - self.window), end).worst(self.trace.robots)
            found.append([PhaseMetrics(start, when, *left) for when, left in zip(acquired, worst, strict=True)])
        return found

    @_kept
    def together(self) -> tuple[float | None, ...]:
        """Per phase: from when on all robots in the means have acquired [s]; None if one never does."""
        linked = [i for i in self.kept if self.errors.own[:, i].any()]
        times = [[when for i in linked if (when := phase[i].acquired_s) is not None] for phase in self.phases]
        return tuple(max(each) if each and len(each) == len(linked) else None for each in times)

    @_kept
    def rotation(self) -> tuple[float | None, ...]:
        """Per phase: net rotation of the robots in the means from acquisition on [rad/s]; None before any shape."""
        place, time = self.trace.true_position[:, self.kept], self.trace.time
        found: list[float | None] = []
        for k, ((_, begin, end), acquired) in enumerate(zip(self.bounds, self.together, strict=True)):
            after = begin + round((acquired or 0.0) / float(time[1] - time[0]))
            formed = k > 0 or acquired is not None
            found.append(net_rotation(place[after:end], time[after:end]) if formed else None)
        return tuple(found)

    @_kept
    def settled(self) -> Array:
        """From when on the error of each robot stays in its 2 % band (N,) [s]; the duration if never."""
        total, time = self.robot_errors, self.trace.time
        if not self.has_errors:
            return np.full(total.shape[1], np.nan)
        unsettled = ~(total <= BAND * np.where(np.isfinite(total), total, 0.0).max(axis=0))
        found = after_last(unsettled & (self.errors.present | np.isfinite(total)), time)
        return np.array([time[-1] - time[0] if when is None else when for when in found])

    @_kept
    def short(self) -> Array:
        """Distance of each robot with a plan from its goal at the end (N,) [m]."""
        trace, net = self.trace, self.errors.net
        began = {leg.robot for leg in trace.plan.experiment.timeline if leg.at_s < trace.time[-1]}
        planned = [name in began and row not in net.receiver for row, name in enumerate(trace.robots)]
        return np.where(planned, norm(trace.goal[-1] - trace.position[-1]), np.nan)

    @_kept
    def collisions(self) -> tuple[Collision, ...]:
        """Contacts in order of time."""
        return collisions(self.trace, self.clearance)

    @_kept
    def contacts(self) -> list[list[Collision]]:
        """Contacts of each robot."""
        return [[each for each in self.collisions if name in {each.first, each.second}] for name in self.trace.robots]

    @_kept
    def architecture(self) -> SimpleNamespace:
        """Receivers, deliveries and goals of each robot, see `centralised.columns`."""
        return centralised.columns(self.trace, self.errors.net)

    @_kept
    def transmissions(self) -> tuple[Index, Index]:
        """Poses sent by each robot, by their running numbers, and those of them in the recording, (N,) each."""
        trace, rows = self.trace, range(len(self.trace.robots))
        recorded, rate = np.bincount(trace.sent.link, minlength=len(rows)), trace.plan.experiment.rates.pose_hz
        missing = [count_unrecorded(trace.sent_at[i], trace.sent.seq[trace.sent_rows[i]], rate) for i in rows]
        return recorded + np.array(missing, dtype=np.intp), recorded

    @_kept
    def rate(self) -> Array:
        """Poses that each robot sent in a second, from when it takes part (N,) [Hz]."""
        trace, time = self.trace, self.trace.time
        sent = self.transmissions[0]
        joined = np.zeros(len(sent)) if trace.joined is None else trace.joined
        present = np.maximum(time[-1] - np.maximum(joined, time[0]), time[1] - time[0])
        early = np.array([(own < when).sum() for own, when in zip(trace.sent_at, joined, strict=True)], dtype=np.intp)
        return np.asarray((sent - early) / present)

    @_kept
    def gaps_between(self) -> list[Array]:
        """Times between the transmissions of each robot [s]."""
        return [np.diff(np.sort(own)) for own in self.trace.sent_at]

    def gap(self, statistic: Callable[[Array], Any]) -> list[float | None]:
        """A statistic of these times of each robot [s]; None for fewer than two transmissions."""
        return [float(statistic(each)) if len(each) else None for each in self.gaps_between]

    @_kept
    def payload(self) -> Index:
        """Payload that each robot sent (N,) [bytes]."""
        sent = self.trace.sent
        assert sent.bytes is not None, "a sweep keeps sizes only where a metric needs sent"
        size = np.bincount(sent.link, weights=sent.bytes, minlength=len(self.trace.robots))
        return size.astype(np.intp)

    @_kept
    def dropped(self) -> Index:
        """Poses of each robot that the modelled network dropped, over all receivers (N,)."""
        rows, dropped = len(self.trace.robots), self.trace.dropped
        if dropped is None:
            return np.zeros(rows, dtype=np.intp)
        return np.bincount(self.trace.plan.pose_links.sender, weights=dropped, minlength=rows).astype(np.intp)


_MEASURED: Final = WeakKeyDictionary[Trace, Measurement]()
