"""Metrics of a run: the indices of the paper (section IV-B), and the numbers that show whether to trust them.

All errors are taken on true positions. A robot that died has NaN positions from then on: its links are left out from
that moment, integrals cover the known part (`coverage` is its share), and the means leave that robot out. The figures
of a run that was interrupted cover the time until then.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, SupportsFloat

import msgspec
import numpy as np

from agents.decision.lifecycle import TOLD_TO_END
from agents.network.messages import Event
from agents.safety.hazards import BY_OPERATOR, OVER, QUIET_S, UNRESOLVED, Cause, failed, is_blind
from experiments.definition import link_conditions
from experiments.metrics import centralised
from experiments.metrics.comparable import STOOD, reasons
from experiments.metrics.metric import (
    DETAILS,
    OF_LAW,
    case_values,
    known_metrics,
    law_metrics,
    measures_of,
    metrics_of,
    unusable_metrics,
    values_of,
)
from experiments.metrics.results import Approach, Belief, CaseMetrics, LawMeasure, RobotMetrics
from experiments.metrics.shadow import agreement
from experiments.metrics.signals import Measurement, link_deliveries, mean_known, outside_arena
from experiments.recording.trace import Trace

TROUBLES: Final = ("late", "unread")  # kinds of events of the run itself, not of a robot
PRESENT: Final = 0.8  # least share of known positions of a robot: below it the robot was out of reach
GAP_S: Final = 0.5  # [s] shorter times without a position are not named
HELD: Final = 0.2  # share of the time for which a robot may be held
LAST_S: Final = 0.5  # longest time between the last sample of a whole recording and the order to land [s]
NAMED_S: Final = 0.05  # [s] shorter holds are not named
# causes of holds that are not part of an experiment
HOLDING: Final = (Cause.ORDERED, Cause.POSITION, Cause.ROUTER, Cause.CENTRE, Cause.SUSPENDED, Cause.OWNER)
CHANGES: Final = {"remove": "removed", "restart": "restarted", "replace": "replaced"}  # orders to the conductor
ENDED: Final = (
    "silent",
    "killed",
    "left",
    "changed",
)  # orders after which the former process of a robot ends, or has ended
LEAVING: Final = ("ordered to leave", TOLD_TO_END)  # reasons of a robot that lands for one of them


def measure(trace: Trace) -> CaseMetrics:
    """All metrics of one case.

    Raises ValueError if the trace has fewer than two samples, so that nothing can be integrated.
    """
    if len(trace.time) < 2:
        raise ValueError(f"case '{trace.case}' holds fewer than two samples: the run ended before it began")
    asked, missing = metrics_of(trace.plan)
    metrics, left_out = known_metrics() | asked | law_metrics(measures_of(trace)), unusable_metrics()
    shared = Measurement.of(trace)
    values, faults = values_of(metrics | DETAILS, shared)
    mean = case_values(metrics, values, shared.kept)
    names, errors, belief = trace.robots, shared.errors, shared.belief
    gaps = errors.gaps()
    beyond, links = outside_arena(trace), link_deliveries(trace)
    together, rotation = shared.together, shared.rotation
    farthest = int(beyond.argmax())
    rms = np.sqrt(mean_known(belief**2))
    largest = np.where(np.isfinite(belief), belief, -np.inf).max(axis=0, initial=-np.inf)
    guidance, arrived = centralised.guidance(trace), centralised.deliveries(trace)
    robots = _robots(shared, {name: values[name] for name, each in (metrics | DETAILS).items() if each.per == "robot"})
    ticks, missed = int(trace.ticks.sum()), int(trace.missed_deadlines.sum())
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
        mean=mean,
        acquired_s=together,
        rotation_rad_s=rotation,
        belief=tuple(
            Belief(names[i], names[j], _number(rms[k]), _number(largest[k]))
            for k, (i, j) in enumerate(zip(errors.net.receiver, errors.net.sender, strict=True))
        ),
        excursion=max(0.0, float(beyond[farthest])),
        excursion_robot=names[farthest] if beyond[farthest] > 0.0 else "",
        lost=int(trace.lost.sum()),
        dropped=int(shared.dropped.sum()),
        link_deliveries=links,
        modelled=link_conditions.models_network(trace.plan),
        missed_deadlines=missed,
        missed_share=_share(missed, ticks + missed),
        collisions=shared.collisions,
        watched=trace.contacts is not None,
        near=_nearest(shared.clearance.robots),
        near_arena=_nearest(shared.clearance.arena),
        intervened_share=_share(trace.interventions.sum(), ticks),
        avoided_share=_share(trace.avoided.sum(), ticks),
        world_factor=_slowest(trace),
        away_s=errors.away_s,
        gaps=tuple(f"{names[row]} from {begin:.1f} to {end:.1f} s" for row, begin, end in gaps if end - begin > GAP_S),
        troubles=(
            *(f"{event.source} {event.text}" for event in trace.events if event.kind in TROUBLES),
            *_taken_out(trace).values(),
            *_held(trace),
            *_restarted(trace),
            *_redirected(trace),
        ),
        failures=failures(trace, shared.known.tolist()),
        network_messages=sum(robot.messages + robot.goals for robot in robots),
        network_bytes=sum(robot.bytes + robot.goal_bytes for robot in robots),
        deliveries=arrived,
        guidance=guidance,
        measures=_law_measures(trace, mean),
        metric_faults=(*left_out, *missing, *faults),
        criteria=tuple(trace.plan.experiment.criteria),
        asked=tuple(trace.plan.experiment.metrics),
    )
    return msgspec.structs.replace(found, spoiled=reasons(found))


def _robots(shared: Measurement, values: Mapping[str, Sequence[float | None]]) -> tuple[RobotMetrics, ...]:
    """Metrics of each robot, from the `values` (N,) of figures."""
    trace, fields = shared.trace, RobotMetrics.__struct_fields__
    first, *later = shared.phases
    columns: dict[str, Sequence[Any]] = {
        **values,
        "robot": trace.robots,
        "kind": [trace.plan.experiment.robots[name].kind for name in trace.robots],
        "worst": [each.worst for each in first],
        "phases": [*zip(*later, strict=True)] or [()] * len(first),
        "near": shared.clearance.robots,
        "near_arena": shared.clearance.arena,
        "shadow": agreement(trace),
    }
    found = []
    for row in zip(*columns.values(), strict=True):
        robot = dict(zip(columns, row, strict=True))
        extra = {name: robot.pop(name) for name in values if name not in fields}
        found.append(RobotMetrics(**robot, extra=extra, measures=_law_measures(trace, extra)))
    return tuple(found)


def failures(trace: Trace, known: Sequence[float]) -> tuple[str, ...]:
    """The first thing that kept each robot from its part of the experiment, and a cut of its motors after that.

    Args:
        known: (N,) share of the time at which the position of each robot is known.
    """
    found: dict[str, str] = {}
    blind: dict[str, Event] = {}  # begin of the last loss of its own position
    for event in trace.events:
        lost = event.kind in {"lost", "failed"} or (event.kind == "hazard" and failed(event.text))
        if event.kind == "hazard" and event.text.startswith("hold: ") and is_blind(event.text):
            blind[event.source] = event
        if lost and event.source in trace.robots and event.source not in found:
            what = f"was lost: {event.text}" if event.kind == "lost" else event.text.removeprefix("warn: ")
            begin = event
            if event.text.startswith(UNRESOLVED) and event.source in blind:
                begin = blind[event.source]
                what = f"{begin.text.removeprefix('hold: ')}, until the end"
            found[event.source] = f"{event.source} {_moment(begin)}: {what}"
        elif event.text.startswith("cut: ") and "cut: " not in found.get(event.source, "cut: "):
            found[event.source] += f"; {_moment(event)} {event.text}"
    taken_out = _taken_out(trace)
    for name, share in zip(trace.robots, known, strict=True):
        if share < PRESENT and name not in taken_out:
            found.setdefault(name, f"{name}: its position was known for {share:.0%} of the time only")
    last = _last_sample(trace)
    unrecorded = last < trace.time[-1] - LAST_S and not found.keys() >= {*trace.robots}
    if (ended_early(trace) or unrecorded) and not _landed_by_conductor(trace, last):
        planned = trace.plan.experiment.duration_s
        found[""] = f"the recording breaks off after {last:.1f} s of {planned:g} s"
    return tuple(found.values())


def _moment(event: Event) -> str:
    """Time of an event, in words."""
    return f"at {abs(event.stamp):.1f} s" if event.stamp > -0.05 else f"{-event.stamp:.1f} s before the start"


def _last_sample(trace: Trace) -> float:
    """Time of the last sample of any robot [s]."""
    known = np.isfinite(trace.position).any(axis=(1, 2))
    return float(trace.time[known][-1] if known.any() else trace.time[-1])


def _landed_by_conductor(trace: Trace, last: float) -> bool:
    """Whether the recording has samples until the conductor's order to land, also of an interrupted run."""
    phases = (event for event in trace.events if (event.kind, event.source) == ("phase", "conductor"))
    return any(event.text.startswith("landing") and event.stamp <= last + LAST_S for event in phases)


def _taken_out(trace: Trace) -> dict[str, str]:
    """Robots that an operator has removed, restarted or replaced in the run, each with a sentence about the first."""
    asked: dict[str, str] = {}
    left, found = set[str](), dict[str, str]()
    for event in trace.events:
        name = event.source
        if event.kind in CHANGES and "on_loss" not in event.text:
            asked[name] = CHANGES[event.kind]
        elif event.kind in ENDED or (event.kind == "robot" and any(why in event.text for why in LEAVING)):
            left.add(name)  # maybe before the order is known: others may end its process at the same time
        else:
            continue
        if name in asked and name in left and event.stamp <= trace.time[-1]:
            found.setdefault(name, f"{name} was {asked[name]} {BY_OPERATOR} {_moment(event)}")
    return found


def _held(trace: Trace) -> list[str]:
    """Robots that operators have held for more than a share of the run, and those that stood for other reasons."""
    end = float(trace.time[-1])
    spans: dict[str, list[tuple[float, float, Cause]]] = {name: [] for name in trace.robots}
    for name, begin, until, cause in _holds(trace):
        spans[name].append((begin, until, cause))
    found, groups = list[str](), dict[tuple[str, ...], dict[str, float]]()
    for name, parts in spans.items():
        ordered, total = _covered_s([each for each in parts if each[2] is Cause.ORDERED]), _covered_s(parts)
        words = dict.fromkeys(cause.rule.words for *_, cause in parts if cause is not Cause.ORDERED)
        if ordered > HELD * end:
            found.append(f"{name} was held {BY_OPERATOR} for {ordered:.1f} of {end:g} s")
        elif words and total >= NAMED_S:
            groups.setdefault((STOOD if total > HELD * end else "held for", *words), {})[name] = total
    for (what, *causes), totals in groups.items():
        most = f"{'up to ' * (len(totals) > 1)}{max(totals.values()):.1f} of {end:g} s"
        found.append(f"{', '.join(totals)} {what} {most}: {', '.join(causes)}")
    return found


def _holds(trace: Trace) -> Iterator[tuple[str, float, float, Cause]]:
    """Times within the run in which a robot was held: its name, begin and end [s], cause."""
    end, since = float(trace.time[-1]), dict[tuple[str, Cause], float]()
    last = [
        Event(end, "hazard", name, f"{UNRESOLVED}: {cause.rule.words}") for name in trace.robots for cause in HOLDING
    ]
    for event in (*trace.events, *last):
        outcome, _, words = event.text.partition(": ")
        cause = next((each for each in HOLDING if words.startswith(each.rule.words)), None)
        if event.kind != "hazard" or cause is None or event.source not in trace.robots:
            continue
        name, at = event.source, event.stamp - (QUIET_S if outcome == OVER else 0.0)
        if outcome == "hold":
            since.setdefault((name, cause), at)
        elif (begin := since.pop((name, cause), None)) is not None:
            if lasted := re.search(r" ([\d.]+) s$", words):  # the news of its begin may be late
                after_s = trace.plan.experiment.safety.neighbour_timeout_s if cause is Cause.ROUTER else 0.0
                begin = min(begin, at - float(lasted[1]) + after_s)
            yield name, min(max(begin, 0.0), end), min(max(at, 0.0), end), cause


def _covered_s(spans: Iterable[tuple[float, float, Cause]]) -> float:
    """Length of times that may overlap [s]."""
    total, until = 0.0, -math.inf
    for begin, end, _ in sorted(spans):
        total += max(0.0, end - max(begin, until))
        until = max(until, end)
    return total


def _restarted(trace: Trace) -> list[str]:
    """Routers, worlds and the like that ended in the run and were started again, one sentence each."""
    events = (each for each in trace.events if each.source == "conductor" and each.kind != "recorder")
    return [
        f"{event.text.partition('; ')[0]} after {event.stamp:.1f} s, and was started again"
        for event in events
        if "; started again" in event.text and 0.0 <= event.stamp <= trace.time[-1]
    ]


def _redirected(trace: Trace) -> list[str]:
    """Robots that operators have sent elsewhere or given other numbers, a sentence about the first time of each."""
    found: dict[str, str] = {}
    for event in trace.events:
        if event.kind == "hazard" and event.text.startswith("warn: ") and event.text.endswith(BY_OPERATOR):
            sentence = f"{event.source} {event.text.removeprefix('warn: ')} {_moment(event)}"
            found.setdefault(event.source, sentence)
    return [*found.values()]


def ended_early(trace: Trace) -> bool:
    """Whether a run ended before its time; a whole one may end one sample short."""
    return float(trace.time[-1]) < trace.plan.experiment.duration_s - 1.5 * float(trace.time[1] - trace.time[0])


def _law_measures(trace: Trace, values: Mapping[str, float | None]) -> dict[str, LawMeasure]:
    """Each measure of the law, of the values of `law_metrics`."""
    return {
        name: LawMeasure(values[f"{OF_LAW}{name}_mean"], values[f"{OF_LAW}{name}_end"], each.unit, each.better)
        for name, each in measures_of(trace).items()
    }


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _share(part: SupportsFloat, whole: SupportsFloat) -> float | None:
    return float(part) / float(whole) if whole else None


def _nearest(approaches: Iterable[Approach | None]) -> Approach | None:
    return min((each for each in approaches if each is not None), key=lambda each: each.gap, default=None)


def _slowest(trace: Trace) -> float | None:
    """Lowest real-time factor of the world; while it is paused, time is to stand still."""
    if trace.clock == "virtual":
        return None
    return min((report.factor for report in trace.world if not report.paused), default=None)
