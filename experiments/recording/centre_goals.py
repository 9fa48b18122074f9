"""What a centre and the robots that it guides said to each other: as arrays, from virtual time or recorded."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Final

import msgspec
import numpy as np

from agents.arrays import Array
from agents.network import messages
from experiments.recording.topics import SentGoal
from experiments.recording.trace import ROUNDING_S, Goals, _first

STATUS_S: Final = 1.0  # a report at most this much after the end of a run still counts for it


def of_recording(
    goals: Sequence[SentGoal],
    states: Mapping[str, Sequence[messages.State]],
    reports: Sequence[messages.CentreState],
    start: float,
    duration: float,
) -> Goals:
    """As recorded.

    Args:
        goals: All that were sent.
        states: Telemetry of each robot; the keys are the robots in the order of the rows.
        reports: What the centre said of itself.
        start: Common start, UTC [s].
        duration: How long the run lasted [s].
    """
    row = {name: number for number, name in enumerate(states)}

    def within(t: Any) -> Any:  # noqa: ANN401 - a number, or many
        return (t >= -ROUNDING_S) & (t < duration - ROUNDING_S)

    mine = [each for each in goals if each.robot in row and within(each.stamp - start)]
    sent = _table(sorted((each.stamp - start, row[each.robot], each.size) for each in mine))
    acted = _table(
        sorted(
            (each.acted - start, row[name], each.pose - start)
            for name, own in states.items()
            for state in own
            for each in state.followed
        )
    )
    follower = acted[1].astype(np.intp)
    reached, anew = within(acted[0]), _first(acted[0], follower, acted[2])
    anew &= reached
    said = sorted(reports, key=lambda each: each.stamp)
    heard, lost, dropped = (_grown(said, what, start, start + duration) for what in ("heard", "lost", "dropped"))
    return Goals(
        time=sent[0],
        robot=sent[1].astype(np.intp),
        bytes=sent[2].astype(np.intp),
        reached=np.bincount(follower[reached], minlength=len(row)),
        acted=acted[0][anew],
        follower=follower[anew],
        delay=(acted[0] - acted[2])[anew],
        heard=np.array([heard[name] for name in row], dtype=np.intp),
        lost=np.array([lost[name] for name in row], dtype=np.intp),
        dropped=np.array([dropped[name] for name in row], dtype=np.intp),
        reports=tuple(
            msgspec.structs.replace(each, stamp=each.stamp - start)
            for each in said
            if 0.0 < each.stamp - start <= duration + STATUS_S
        ),
    )


def _table(rows: Sequence[tuple[float, int, float]]) -> Array:
    """As columns (3, K)."""
    return np.array(rows, dtype=float).reshape(-1, 3).T


def _grown(reports: Sequence[messages.CentreState], what: str, start: float, end: float) -> Counter[str]:
    """How much a counter grew in the run, by robot; a centre that was started again counts from 0."""
    total: Counter[str] = Counter()
    before: Mapping[str, int] = {}
    process = None
    for centre_report in reports:
        now = getattr(centre_report, what)
        if centre_report.pid != process:
            before, process = {}, centre_report.pid
        if start < centre_report.stamp <= end + STATUS_S:
            total.update({robot: max(0, count - before.get(robot, 0)) for robot, count in now.items()})
        before = now
    return total
