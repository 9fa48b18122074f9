"""Metrics of a run: the indices of the paper (section IV-B), and the numbers that show whether to trust them.

All errors are taken on true positions. A robot that died has NaN positions from then on: its links are left out from
that moment, integrals cover the known part (`coverage` is its share), and the means leave that robot out. The figures
of a run that was interrupted cover the time until then.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import msgspec
import numpy as np

from agents.network.messages import Event
from agents.safety.hazards import UNRESOLVED, failed, is_blind
from experiments.definition import link_conditions
from experiments.definition.graph import Links
from experiments.metrics import centralised
from experiments.metrics.clearance import collisions
from experiments.metrics.comparable import reasons
from experiments.metrics.metric import (
    OURS,
    Metric,
    Number,
    case_values,
    foreign_metrics,
    known_metrics,
    metrics_of_criteria,
    unusable_metrics,
    values_of,
)
from experiments.metrics.results import Approach, Belief, CaseMetrics, Collision, LawMeasure, RobotMetrics
from experiments.metrics.shadow import agreement
from experiments.metrics.signals import (
    Measurement,
    link_deliveries,
    mean_known,
    net_rotation,
    network_away,
    outside_arena,
)
from experiments.recording.trace import Trace
from twins.arrays import Array, norm

TROUBLES: Final = ("late", "unread")  # kinds of events of the run itself, not of a robot
PRESENT: Final = 0.8  # least share of known positions of a robot: below it the robot was out of reach
GAP_S: Final = 0.5  # [s] shorter times without a position are not named


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def failures(trace: Trace, known: Sequence[float]) -> tuple[str, ...]:
    """The first thing that kept each robot from its part of the experiment, and a cut of its motors after that.

    Args:
        known: (N,) share of the time at which the position of each robot is known.
    """
    found: dict[str, str] = {}
    blind: dict[str, Event] = {}  # begin of the last loss of its own position
    for event in trace.events:
        lost = event.kind == "lost" or (event.kind == "hazard" and failed(event.text))
        if event.kind == "hazard" and event.text.startswith("hold: ") and is_blind(event.text):
            blind[event.source] = event
        if lost and event.source in trace.robots and event.source not in found:
            what = f"was lost: {event.text}" if event.kind == "lost" else event.text.removeprefix("warn: ")
            begin = event
            if event.text.startswith(UNRESOLVED) and event.source in blind:
                begin = blind[event.source]
                what = f"{begin.text.removeprefix('hold: ')}, until the end"
            found[event.source] = f"{event.source} at {max(begin.stamp, 0.0):.1f} s: {what}"
        elif event.text.startswith("cut: ") and "cut: " not in found.get(event.source, "cut: "):
            found[event.source] += f"; at {max(event.stamp, 0.0):.1f} s {event.text}"
    for name, share in zip(trace.robots, known, strict=True):
        if share < PRESENT:
            found.setdefault(name, f"{name}: its position was known for {share:.0%} of the time only")
    return tuple(found.values())


def measure(trace: Trace) -> CaseMetrics:
    """All metrics of one case.

    Raises ValueError if the trace has fewer than two samples, so that nothing can be integrated.
    """
    if len(trace.time) < 2:
        raise ValueError(f"case '{trace.case}' holds fewer than two samples: the run ended before it began")
    names, shared = trace.robots, Measurement(trace)
    errors, clearance, kept = shared.errors, shared.clearance, shared.kept
    touched = collisions(trace, clearance)
    asked, missing = metrics_of_criteria(trace.plan.experiment.criteria)
    metrics = known_metrics() | asked
    values, faults = values_of(metrics, shared)
    robots = _robots(shared, touched, values, foreign_metrics() | asked)

    together = [_all([phase[i].acquired_s for i in kept if errors.own[:, i].any()]) for phase in shared.phases]
    rotation: list[float | None] = []
    for k, (_, begin, end) in enumerate(shared.bounds):
        after = begin + round((together[k] or 0.0) / float(trace.time[1] - trace.time[0]))
        formed = k > 0 or together[k] is not None  # before, there is no shape that one could turn
        rotation.append(net_rotation(trace.true_position[after:end, kept], trace.time[after:end]) if formed else None)

    held = shared.belief
    rms = np.sqrt(mean_known(held**2))
    largest = np.where(np.isfinite(held), held, -np.inf).max(axis=0, initial=-np.inf)
    beyond = outside_arena(trace)
    farthest = int(beyond.argmax())
    ticks = int(trace.ticks.sum())
    found = CaseMetrics(
        case=trace.case,
        seed=trace.seed,
        clock=trace.clock,
        duration_s=float(trace.time[-1] - trace.time[0]),
        planned_s=trace.plan.experiment.duration_s,
        interrupted=ended_early(trace),
        tolerance=trace.plan.experiment.tolerance,
        starts_s=tuple(start for start, _, _ in shared.bounds),
        robots=robots,
        leaders=shared.leaders,
        died=shared.died,
        mean=case_values(metrics, values, kept),
        acquired_s=tuple(together),
        rotation_rad_s=tuple(rotation),
        belief=tuple(
            Belief(names[i], names[j], _number(rms[k]), _number(largest[k]))
            for k, (i, j) in enumerate(zip(errors.net.receiver, errors.net.sender, strict=True))
        ),
        excursion=max(0.0, float(beyond[farthest])),
        excursion_robot=names[farthest] if beyond[farthest] > 0.0 else "",
        lost=int(trace.lost.sum()),
        dropped=int(shared.dropped.sum()),
        link_deliveries=link_deliveries(trace),
        modelled=link_conditions.models_network(trace.plan),
        missed_deadlines=int(trace.missed_deadlines.sum()),
        missed_share=_share(trace.missed_deadlines.sum(), ticks + int(trace.missed_deadlines.sum())),
        collisions=touched,
        watched=trace.contacts is not None,
        near=_nearest(clearance.robots),
        near_arena=_nearest(clearance.arena),
        intervened_share=_share(trace.interventions.sum(), ticks),
        avoided_share=_share(trace.avoided.sum(), ticks),
        world_factor=_slowest(trace),
        away_s=network_away(np.asarray(np.isfinite(trace.true_position).all(axis=2)), trace.time)[0],
        gaps=tuple(
            f"{names[row]} from {begin:.1f} to {end:.1f} s" for row, begin, end in errors.gaps() if end - begin > GAP_S
        ),
        troubles=tuple(f"{event.source} {event.text}" for event in trace.events if event.kind in TROUBLES),
        failures=failures(trace, [robot.known for robot in robots]),
        network_messages=sum(robot.messages + robot.goals for robot in robots),
        network_bytes=sum(robot.bytes + robot.goal_bytes for robot in robots),
        deliveries=centralised.deliveries(trace),
        guidance=centralised.guidance(trace),
        measures=_law_measures(shared, kept),
        metric_faults=(*unusable_metrics(), *missing, *faults),
        criteria=tuple(trace.plan.experiment.criteria),
    )
    return msgspec.structs.replace(found, spoiled=reasons(found))


def ended_early(trace: Trace) -> bool:
    """Whether a run ended before its time; a whole one may end one sample short."""
    return float(trace.time[-1]) < trace.plan.experiment.duration_s - 1.5 * float(trace.time[1] - trace.time[0])


def _robots(
    shared: Measurement,
    touched: Sequence[Collision],
    values: Mapping[str, Sequence[Number]],
    added: Mapping[str, Metric],
) -> tuple[RobotMetrics, ...]:
    """Metrics of each robot, from the contacts and the values of all metrics; `added` are not ours."""
    trace, errors, clearance = shared.trace, shared.errors, shared.clearance
    rows, duration = len(trace.robots), float(trace.time[-1] - trace.time[0])
    there, mine = errors.expected(), errors.own
    covered = (np.isfinite(errors.error) & there).sum(axis=0) / np.maximum(there.sum(axis=0), 1)
    coverage = (covered @ mine) / np.maximum(mine.sum(axis=0), 1.0)
    linked = np.zeros((rows, rows), dtype=bool)  # links for avoidance alone do not belong to the formation
    guided = centralised.guided_rows(trace)[errors.net.receiver]  # the centre receives their neighbours' poses
    linked[errors.net.receiver[~guided], errors.net.sender[~guided]] = True
    net, received = trace.plan.pose_links, trace.received.link
    counted = linked[net.receiver, net.sender][received]
    delivered = np.bincount(net.sender[received[counted]], minlength=rows)
    receivers = np.bincount(errors.net.sender[~guided], minlength=rows) + centralised.received_by_centre(trace)
    if trace.goals is not None:
        delivered += trace.goals.received
    goals, goal_bytes = centralised.goals_to(trace)
    late, agreements = centralised.delays(trace), agreement(trace)
    settled: list[float | None] = [None] * rows
    if shared.has_errors:
        settled = [duration if when is None else when for when in shared.settled]
    own = [[each for each in touched if name in {each.first, each.second}] for name in trace.robots]
    numbers = {  # (N,) each
        **{"recorded": shared.transmissions[1], "receivers": receivers, "received": delivered},
        **{"interventions": trace.interventions, "avoided": trace.avoided, "goals": goals, "goal_bytes": goal_bytes},
        "foreign": np.zeros(rows, dtype=np.intp) if trace.foreign is None else trace.foreign,
    }
    foreign = [name for name, metric in added.items() if metric.per == "robot"]

    def plain(i: int) -> dict[str, Any]:
        waits = shared.waits[i]
        return {
            **{name: values[name][i] for name, metric in OURS.items() if metric.per == "robot"},
            **{what: int(each[i]) for what, each in numbers.items()},
            "gap_min_s": float(waits.min()) if len(waits) else None,
            "gap_median_s": float(np.median(waits)) if len(waits) else None,
            "gap_max_s": float(waits.max()) if len(waits) else None,
            **late[i],
        }

    return tuple(
        RobotMetrics(
            robot=name,
            kind=trace.plan.experiment.robots[name].kind,
            residual=shared.phases[0][i].residual,
            worst=shared.phases[0][i].worst,
            phases=tuple(phase[i] for phase in shared.phases[1:]),
            settle_s=settled[i],
            missed_share=_share(trace.missed_deadlines[i], trace.ticks[i] + trace.missed_deadlines[i]),
            coverage=float(coverage[i]) if shared.has_errors else None,
            known=float(shared.known[i]),
            collisions=len(own[i]),
            impulse=max((each.impulse for each in own[i] if each.impulse is not None), default=None),
            overlap=max((each.overlap for each in own[i]), default=None),
            short=_distance_to_goal(trace, errors.net, i),
            near=clearance.robots[i],
            near_arena=clearance.arena[i],
            intervened_share=_share(trace.interventions[i], trace.ticks[i]),
            avoided_share=_share(trace.avoided[i], trace.ticks[i]),
            shadow=agreements[i],
            extra={name: values[name][i] for name in foreign},
            measures=_law_measures(shared, [i]),
            **plain(i),
        )
        for i, name in enumerate(trace.robots)
    )


def _law_measures(shared: Measurement, rows: Sequence[int]) -> dict[str, LawMeasure]:
    """Each measure of the law, mean over these robots."""

    def mean(values: Array) -> float | None:
        return _number(mean_known(values[:, rows].reshape(-1)).item())

    every = shared.trace.measures.items()
    return {name: LawMeasure(mean(values), mean(values[-shared.window :])) for name, values in every}


def _distance_to_goal(trace: Trace, net: Links, row: int) -> float | None:
    """Distance of a robot with a plan from its goal at the end [m]; None: no plan, or not known."""
    timeline = trace.plan.experiment.timeline
    began = [leg for leg in timeline if leg.robot == trace.robots[row] and leg.at_s < trace.time[-1]]
    if not began or row in net.receiver:
        return None
    return _number(float(norm(trace.goal[-1, row] - trace.position[-1, row])))


def _share(part: float, whole: float) -> float | None:
    return float(part) / float(whole) if whole else None


def _nearest(approaches: Iterable[Approach | None]) -> Approach | None:
    return min((each for each in approaches if each is not None), key=lambda each: each.gap, default=None)


def _slowest(trace: Trace) -> float | None:
    """Lowest real-time factor of the world; while it is paused, time is to stand still."""
    if trace.clock == "virtual":
        return None
    return min((report.factor for report in trace.world if not report.paused), default=None)


def _all(times: Sequence[float | None]) -> float | None:
    """Time of the last one; None if one is missing, or there is none."""
    known = [when for when in times if when is not None]
    return max(known) if known and len(known) == len(times) else None
