"""Poses lost and dropped, by their running numbers and by the counters of robots."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import Final, Literal

import numpy as np

from agents.arrays import Index
from agents.network.messages import Status
from agents.network.validation import missed, most_poses
from experiments.definition.plan import Plan
from experiments.recording.topics import SentPose
from experiments.recording.trace import ROUNDING_S

STATUS_S: Final = 1.0  # a status at most this much after the end of a run still counts for it


def count_unrecorded(poses: Iterable[tuple[float, int]], rate: float) -> int:
    """Poses that a robot sent between the recorded ones, given by stamp [s] and number in order of time.

    A robot transmits at most `rate` poses in a second [1/s]; see `agents.network.validation.missed`.
    """
    return sum(missed(last, seq, then - before, rate) for (before, last), (then, seq) in pairwise(poses))


def count_lost(
    robots: tuple[str, ...],
    poses: list[list[SentPose]],
    statuses: list[list[Status]],
    run: tuple[float, float],
    rate: float,
) -> Index:
    """(N,) lost poses of each robot, as `playback.read` defines them.

    Args:
        poses: Of each, in order of time.
        statuses: Of each, in order of time.
        run: Its beginning and end in UTC [s].
        rate: Largest rate of transmissions of a robot [1/s].
    """
    total: Counter[str] = Counter()
    begin, end = run[0] - ROUNDING_S, run[1] + ROUNDING_S
    for robot, own, reports in zip(robots, poses, statuses, strict=True):
        mine = [(pose.stamp, pose.seq) for pose in own if begin <= pose.stamp <= end]
        total[robot] += count_unrecorded(mine, rate) + _tail(own, reports, run, rate)
        total.update(_by_sender(reports, run, "lost"))
    return np.array([total[robot] for robot in robots], dtype=np.intp)


def _tail(poses: list[SentPose], statuses: list[Status], run: tuple[float, float], rate: float) -> int:
    reports = [status for status in statuses if run[0] < status.stamp <= run[1] + STATUS_S]
    if not reports:
        return 0
    last = reports[-1]
    recorded = [(pose.seq, pose.stamp) for pose in poses if pose.stamp <= last.stamp + ROUNDING_S]
    before = [(status.sent, run[0]) for status in statuses if status.stamp <= run[0] and status.pid == last.pid]
    number, stamp = max(recorded[-1:] + before[-1:], default=(0, run[0]))
    return max(0, min(last.sent - number, most_poses(last.stamp - stamp, rate)))


def count_dropped(plan: Plan, statuses: list[list[Status]], run: tuple[float, float]) -> Index:
    """(E,) poses that the modelled network dropped on each of `Plan.pose_links`; `statuses` of each robot."""
    links, robots = plan.pose_links, plan.names
    found = [_by_sender(reports, run, "dropped") for reports in statuses]
    ends = zip(links.receiver.tolist(), links.sender.tolist(), strict=True)
    return np.array([found[i][robots[j]] for i, j in ends], dtype=np.intp)


def _by_sender(statuses: list[Status], run: tuple[float, float], what: Literal["lost", "dropped"]) -> Counter[str]:
    """Poses lost or dropped in the run by one receiver, by sender."""
    return counter_growth(((status.pid, status.stamp, getattr(status, what)) for status in statuses), *run)


def counter_growth(counts: Iterable[tuple[int, float, Mapping[str, int]]], start: float, end: float) -> Counter[str]:
    """Growth of counters in a run, by their names.

    Args:
        counts: Reports in order of time: process, stamp [s], and what the process has counted since it began.
        start: Of the run [s].
        end: Of the run [s]; a report at most `STATUS_S` later counts.
    """
    total: Counter[str] = Counter()
    before: Mapping[str, int] = {}
    process = None
    for pid, stamp, now in counts:
        if pid != process:  # started again: counts from 0
            before, process = {}, pid
        if start < stamp <= end + STATUS_S:
            total.update({name: max(0, count - before.get(name, 0)) for name, count in now.items()})
        before = now
    return total
