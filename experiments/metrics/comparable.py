"""Comparable runs: undisturbed ones of equal length, with equally complete data."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

import msgspec

from agents.safety.hazards import BY_OPERATOR
from experiments.metrics.results import CaseMetrics

MISSED: Final = 0.01  # share of missed deadlines from which on a run is spoiled
STALLED: Final = 0.05  # share of those of one robot: among many others a robot that stood still would not show
LOST: Final = 0.01  # share of lost poses from which on a run is spoiled
SLOW: Final = 0.9  # real-time factor of a world below which a run is spoiled
STOOD: Final = "stood for"  # words of a hold that is too long, and not by an operator
SPOILING: Final = ("began", "could not read", BY_OPERATOR, STOOD)  # what troubles that spoil a run say
SAME_LENGTH: Final = 0.005  # share of the longest by which lengths of runs may differ
SAME_COVERAGE: Final = 0.01  # largest difference of known shares of errors where integrals are compared


def reasons(case: CaseMetrics) -> tuple[str, ...]:
    """Reasons why the figures of a run are not compared with those of another one, one clause each."""
    lost, missed = lost_share(case), case.missed_share or 0.0
    factor = case.world_factor
    found = []
    if case.failures:
        found.append("robots failed")
    elif case.died:
        found.append(f"too little is known of {', '.join(case.died)}")
    if missed >= MISSED:
        found.append(f"{100.0 * missed:.2g} % of the deadlines were missed")
    elif stalled := [each.robot for each in case.robots if (each.missed_share or 0.0) >= STALLED]:
        found.append(f"{', '.join(stalled)} missed {100.0 * STALLED:g} % of its deadlines or more")
    if lost >= LOST:
        found.append(f"{100.0 * lost:.2g} % of the poses were lost")
    named = [each for each in case.troubles if BY_OPERATOR in each or STOOD in each]
    if any(spoils(each) for each in case.troubles if each not in named):
        found.append("robots did not begin together, or messages could not be read")
    found += named
    if factor is not None and factor < SLOW:
        found.append(f"the world ran at {factor:.2f} of real time")
    return tuple(found)


def with_failures(case: CaseMetrics, failures: Iterable[str]) -> CaseMetrics:
    """A case with failures that its recording misses: its conductor saw them after the end of its recorder.

    Failures of robots that have failed by the recording already are left out.
    """
    failed = {text.split(" ")[0].rstrip(":") for text in case.failures}
    names = {robot.robot for robot in case.robots}
    more = [text for text in failures if not (named := names & {*re.split(r"[\s,:]+", text)}) or named - failed]
    if not more:
        return case
    case = msgspec.structs.replace(case, failures=(*case.failures, *more))
    return msgspec.structs.replace(case, spoiled=reasons(case))


def lost_share(case: CaseMetrics) -> float:
    """Poses that were lost over those that receivers were to get; 0 without any."""
    due = case.lost + sum(robot.received for robot in case.robots)
    return case.lost / due if due else 0.0


def spoils(trouble: str) -> bool:
    """Whether a trouble of a run spoils its figures; a robot that was ordered twice and began in time does not."""
    return any(word in trouble for word in SPOILING)


def equally_long(lengths: Iterable[float]) -> bool:
    """Whether runs of these lengths [s] can be compared: what is summed, and what fades, depends on the length."""
    known = [*lengths]
    return not known or max(known) - min(known) <= SAME_LENGTH * max(known)


def coverage(case: CaseMetrics) -> float:
    """Known share of the errors of the robots in the means; 1 without any."""
    out = {*case.leaders, *case.died}
    robots = [robot for robot in case.robots if robot.robot not in out and robot.iae is not None]
    known = [robot.coverage for robot in robots if robot.coverage is not None]
    return sum(known) / len(known) if known else 1.0
