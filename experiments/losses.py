"""What was lost or dropped of poses, by their numbers and by what robots counted."""

from __future__ import annotations

from collections import Counter
from typing import Final, Literal

import numpy as np

from agents.rows import Index
from agents.wire import Status
from experiments import assign
from experiments.contacts import ROUNDING_S
from experiments.experiment import Experiment
from experiments.recording import SentPose

STATUS_S: Final = 1.0  # what happened in the run is counted by a status at most this much after its end


def lost(
    robots: tuple[str, ...], poses: list[list[SentPose]], statuses: list[list[Status]], run: tuple[float, float]
) -> Index:
    """(N,) what was lost of each robot, as `playback.read` defines it; `run` is its beginning and end in UTC [s]."""
    missed: Counter[str] = Counter()
    for robot, own, said in zip(robots, poses, statuses, strict=True):
        missed[robot] += _gaps(own, run) + _tail(own, said, run)
        missed.update(_by_speaker(said, run, "lost"))
    return np.array([missed[robot] for robot in robots], dtype=np.intp)


def _gaps(poses: list[SentPose], run: tuple[float, float]) -> int:
    begin, end = run[0] - ROUNDING_S, run[1] + ROUNDING_S
    seq = np.array([pose.seq for pose in poses if begin <= pose.stamp <= end], dtype=np.intp)
    step = np.diff(seq)
    anew = seq[1:][step < 0]
    return int((step[step > 0] - 1).sum() + (anew - 1).sum())


def _tail(poses: list[SentPose], statuses: list[Status], run: tuple[float, float]) -> int:
    said = [status for status in statuses if run[0] < status.stamp <= run[1] + STATUS_S]
    if not said:
        return 0
    last = said[-1]
    recorded = [pose.seq for pose in poses if pose.stamp <= last.stamp + ROUNDING_S]
    before = [status.sent for status in statuses if status.stamp <= run[0] and status.pid == last.pid]
    return max(0, last.sent - max(recorded[-1:] + before[-1:], default=0))


def dropped(experiment: Experiment, statuses: list[list[Status]], run: tuple[float, float]) -> Index:
    """(E,) what the modelled network dropped on each of `assign.heard_links`; `statuses` of each robot."""
    links, robots = assign.heard_links(experiment), list(experiment.robots)
    found = [_by_speaker(said, run, "dropped") for said in statuses]
    ends = zip(links.listener.tolist(), links.speaker.tolist(), strict=True)
    return np.array([found[i][robots[j]] for i, j in ends], dtype=np.intp)


def _by_speaker(statuses: list[Status], run: tuple[float, float], what: Literal["lost", "dropped"]) -> Counter[str]:
    """What one listener's process, or several after each other, counted in the run, by speaker."""
    total: Counter[str] = Counter()
    before: dict[str, int] = {}
    process = None
    for status in statuses:
        if status.pid != process:
            before, process = {}, status.pid
        if run[0] < status.stamp <= run[1] + STATUS_S:
            now: dict[str, int] = getattr(status, what)
            total.update({speaker: max(0, count - before.get(speaker, 0)) for speaker, count in now.items()})
        before = getattr(status, what)
    return total
