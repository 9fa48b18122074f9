"""Counters of robots over all lives of their processes, and poses lost and dropped."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final, Literal, TypeVar

import numpy as np

from agents.network.messages import CentreState, Status
from agents.network.validation import missed, most_poses
from agents.ticks import ROUNDING_S
from experiments.definition.plan import Plan
from experiments.recording.topics import SentPose
from twins.arrays import Array, Index

STATUS_S: Final = 1.0  # a status at most this much after the end of a run still counts for it


def count_unrecorded(stamp: Array, seq: Index, rate: float) -> int:
    """Poses that a robot sent between the recorded ones, given by their stamps [s] and numbers in order of time.

    A robot transmits at most `rate` poses in a second [1/s]; see `agents.network.validation.missed`.
    """
    gaps = np.flatnonzero(np.diff(seq) != 1).tolist()
    return sum(missed(int(seq[k]), int(seq[k + 1]), float(stamp[k + 1] - stamp[k]), rate) for k in gaps)


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
        known = [pose for pose in own if begin <= pose.stamp <= end]
        columns = np.array([pose.stamp for pose in known]), np.array([pose.seq for pose in known], dtype=np.intp)
        tails = sum(_tail(own, life, run, rate) for life in lives(reports, _made))
        total[robot] += count_unrecorded(*columns, rate) + tails
        total.update(_by_sender(reports, run, "lost"))
    return np.array([total[robot] for robot in robots], dtype=np.intp)


def _made(status: Status) -> int:
    """Counters that only grow during the life of a process."""
    return status.sent + status.decisions


def _tail(poses: list[SentPose], life: list[Status], run: tuple[float, float], rate: float) -> int:
    """Poses that the last status of a process counts as sent, beyond the last recorded one."""
    reports = [status for status in life if run[0] < status.stamp <= run[1] + STATUS_S]
    if not reports:
        return 0
    last = reports[-1]
    recorded = [(pose.seq, pose.stamp) for pose in poses if pose.stamp <= last.stamp + ROUNDING_S]
    before = [(status.sent, run[0]) for status in life if status.stamp <= run[0]]
    number, stamp = max(recorded[-1:] + before[-1:], default=(0, run[0]))
    return max(0, min(last.sent - number, most_poses(last.stamp - stamp, rate)))


def count_dropped(plan: Plan, statuses: list[list[Status]], run: tuple[float, float]) -> Index:
    """(E,) poses that the modelled network dropped on each of `Plan.pose_links`; `statuses` of each robot."""
    links, robots = plan.pose_links, plan.names
    found = [_by_sender(reports, run, "dropped") for reports in statuses]
    ends = zip(links.receiver.tolist(), links.sender.tolist(), strict=True)
    return np.array([found[i][robots[j]] for i, j in ends], dtype=np.intp)


def count_foreign(robots: Sequence[str], statuses: list[list[Status]], run: tuple[float, float]) -> Index:
    """(N,) poses in the name of each robot that came from another source than its process, and were refused.

    One that several receivers refuse counts once: the number is that of the receiver with the most.
    """
    found = [_by_sender(reports, run, "foreign") for reports in statuses]
    return np.array([max((each[name] for each in found), default=0) for name in robots], dtype=np.intp)


def _by_sender(
    statuses: list[Status], run: tuple[float, float], what: Literal["lost", "dropped", "foreign"]
) -> Counter[str]:
    """Poses lost, dropped or refused in the run by one receiver, by sender."""
    total: Counter[str] = Counter()
    for life in lives(statuses, _made):
        total += counter_growth([(status.stamp, getattr(status, what)) for status in life], *run)
    return total


R = TypeVar("R", Status, CentreState)  # messages with counters of a process


def lives(reports: Iterable[R], made: Callable[[R], int]) -> list[list[R]]:
    """Reports in order of time, by the process that made them, in the order of the first of each.

    Two processes of one robot may report in turn. If a later process has the same number (in containers all have the
    same), falling counters distinguish it from the former one.

    Args:
        reports: In order of time.
        made: Sum of counters that only grow during the life of a process.
    """
    found: list[list[R]] = []
    newest: dict[int, tuple[list[R], int]] = {}
    for report in reports:
        life, most = newest.get(report.pid, ([], 0))
        if not life or 2 * made(report) < most:  # a clock that was set back makes counters fall a little
            life, most = [], 0
            found.append(life)
        life.append(report)
        newest[report.pid] = life, max(most, made(report))
    return found


def count_in_run(statuses: list[Status], what: str, start: float, end: float) -> int:
    """A counter that begins at the common start, at the end of the run, over all processes of a robot.

    Statuses come once in a second: between the last one of the run and the next, the counter grows evenly.
    """
    total, ended = 0.0, start
    for life in lives(statuses, _made):
        begun = [status for status in life if status.stamp > start and status.decisions] or [
            status for status in life if status.stamp > start
        ]
        if not begun:
            continue
        stamps = [min(ended, begun[0].stamp), *(status.stamp for status in begun)]
        counts = np.maximum.accumulate([0, *(getattr(status, what) for status in begun)])
        total += float(np.interp(end, stamps, counts))
        ended = min(begun[-1].stamp, end)
    return round(total)


def counter_growth(counts: Sequence[tuple[float, Mapping[str, int]]], start: float, end: float) -> Counter[str]:
    """Growth of the counters of one process in a run, by their names.

    Args:
        counts: Stamp [s], and what the process has counted since it began.
        start: Of the run [s].
        end: Of the run [s]; a report at most `STATUS_S` later counts.
    """
    before, last = Counter[str](), Counter[str]()
    for stamp, now in counts:
        if stamp <= start:
            before |= Counter(now)
        elif stamp <= end + STATUS_S:
            last |= Counter(now)
    return last - before
