"""What a centre and the robots that it guides said to each other: as arrays, from virtual time or recorded."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import msgspec
import numpy as np

from agents import wire
from agents.rows import Array, Index, Mask
from experiments.channel import EPOCH
from experiments.contacts import ROUNDING_S
from experiments.recording import SentGoal
from experiments.steering import Steered

STATUS_S: Final = 1.0  # a report at most this much after the end of a run still counts for it


@dataclass(frozen=True)
class Goals:
    """Goals of one case, from the common start on.

    A robot's delay is from the measurement of its pose to the moment at which it acts on the first goal that rests on
    that pose: both ways through the network, and the wait for the next decision. Goals that rest on a pose that was
    answered before (a robot that has nothing new to say) have none.

    Attributes:
        time: (M,) when each was sent, since the common start [s].
        robot: (M,) row of its robot.
        bytes: (M,) size of the payload.
        reached: (N,) how many reached each robot.
        acted: (A,) when a first answer was acted on, since the common start [s].
        follower: (A,) row of its robot.
        delay: (A,) see above [s].
        heard: (N,) poses of each robot that the centre heard.
        lost: (N,) and those that never came, by their numbers.
        dropped: (N,) and those that the modelled network dropped.
        reports: What the centre said of itself, stamps in seconds since the common start; of no meaning in virtual
            time, where it takes no time.
    """

    time: Array
    robot: Index
    bytes: Index
    reached: Index
    acted: Array
    follower: Index
    delay: Array
    heard: Index
    lost: Index
    dropped: Index
    reports: tuple[wire.CentreState, ...] = ()


def messages(steered: Steered, names: Sequence[str], first: int) -> Iterator[tuple[float, wire.Goal]]:
    """Goals of one repetition, and when they were sent since the common start [s].

    Args:
        steered: Of all repetitions.
        names: Of the robots.
        first: Row of the first of them.
    """
    time, row, seq, goal, toward, rests = steered.sent
    own = (row >= first) & (row < first + len(names))
    columns = (column[own].tolist() for column in (time, row - first, seq, goal.round(6), toward.round(6), rests))
    for t, robot, number, place, yaw, pose in zip(*columns, strict=True):
        stamps = round(EPOCH + t, 6), round(EPOCH + pose, 6)
        yield t, wire.Goal(names[robot], number, stamps[0], tuple(place), None if math.isnan(yaw) else yaw, stamps[1])


def followed(steered: Steered, sample: Array, first: int, rows: int) -> dict[tuple[int, int], list[wire.Followed]]:
    """Goals that reached the robots of one repetition, by the number of the `sample` (T,) that tells of it, and row."""
    time, row, seq, stamp, pose = steered.followed
    own = (row >= first) & (row < first + rows)
    at = np.searchsorted(sample, time[own] - ROUNDING_S)
    found: dict[tuple[int, int], list[wire.Followed]] = {}
    columns = (column.tolist() for column in (at, row[own] - first, seq[own], stamp[own], pose[own], time[own]))
    for k, robot, number, sent, taken, acted in zip(*columns, strict=True):
        news = wire.Followed(number, EPOCH + sent, EPOCH + taken, EPOCH + acted)
        found.setdefault((k, robot), []).append(news)
    return found


def report(steered: Steered, names: Sequence[str], first: int, duration: float) -> wire.CentreState:
    """What the centre of one repetition in virtual time would say of itself at the end of the run."""
    goals = of_log(steered, names, first, duration, "json")
    return wire.CentreState(
        stamp=EPOCH + duration,
        robots=[name for name, reached in zip(names, goals.reached, strict=True) if reached],
        missing=[],
        load=0.0,
        late_s=0.0,
        decisions=len(np.unique(goals.time)),
        missed=0,
        goals=len(goals.time),
        heard=dict(zip(names, goals.heard.tolist(), strict=True)),
        lost=dict.fromkeys(names, 0),
        dropped=dict(zip(names, goals.dropped.tolist(), strict=True)),
        malformed=0,
        pid=0,
        cpu_s=0.0,
        rss_mb=0.0,
    )


def of_log(steered: Steered, names: Sequence[str], first: int, duration: float, encoding: wire.Encoding) -> Goals:
    """Of one repetition in virtual time, whose first row is `first`."""
    rows = len(names)

    def within(t: Any) -> Any:  # noqa: ANN401 - a number, or many
        return (t >= -ROUNDING_S) & (t < duration - ROUNDING_S)

    def mine(row: Index) -> Mask:
        return np.asarray((row >= first) & (row < first + rows))

    sent = within(steered.sent[0]) & mine(steered.sent[1])
    heard = within(steered.heard[0]) & mine(steered.heard[1])
    sizes = [len(wire.encode(goal, encoding)) for t, goal in messages(steered, names, first) if within(t)]
    own = mine(steered.followed[1])
    time, row, pose = steered.followed[0][own], steered.followed[1][own], steered.followed[4][own]
    reached, anew = within(time), _first(time, row, pose)
    anew &= reached
    return Goals(
        time=steered.sent[0][sent],
        robot=steered.sent[1][sent] - first,
        bytes=np.array(sizes, dtype=np.intp),
        reached=np.bincount(row[reached] - first, minlength=rows),
        acted=time[anew],
        follower=row[anew] - first,
        delay=(time - pose)[anew],
        heard=np.bincount(steered.heard[1][heard] - first, minlength=rows),
        lost=np.zeros(rows, dtype=np.intp),
        dropped=steered.lost_poses[first : first + rows],
    )


def of_recording(
    goals: Sequence[SentGoal],
    states: Mapping[str, Sequence[wire.State]],
    reports: Sequence[wire.CentreState],
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


def _first(time: Array, row: Index, pose: Array) -> Mask:
    """Which of goals (K,), acted on at `time`, are the first of their robot that rest on that pose."""
    order = np.lexsort((time, row))
    changed = np.ones(len(order), dtype=bool)
    changed[1:] = (np.diff(row[order]) != 0) | (np.diff(pose[order]) > ROUNDING_S)
    first = np.zeros(len(order), dtype=bool)
    first[order] = changed
    return first


def _grown(reports: Sequence[wire.CentreState], what: str, start: float, end: float) -> Counter[str]:
    """How much a counter grew in the run, by robot; a centre that was started again counts from 0."""
    total: Counter[str] = Counter()
    before: Mapping[str, int] = {}
    process = None
    for report in reports:
        now = getattr(report, what)
        if report.pid != process:
            before, process = {}, report.pid
        if start < report.stamp <= end + STATUS_S:
            total.update({robot: max(0, count - before.get(robot, 0)) for robot, count in now.items()})
        before = now
    return total
