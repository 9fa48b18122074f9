"""Tracks of the robots of a recording, for replay: what is drawn, and nothing else."""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from math import nan
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

from agents.arrays import Array, Index
from agents.decision.lifecycle import Phase
from agents.network.messages import Event, HostClock, State, Status, WorldState
from experiments.definition.experiment import Experiment
from experiments.recording.clocks import Correction
from experiments.recording.playback import AboutRun
from experiments.recording.reader import RecordingError, Records
from experiments.recording.ros2.cdr import Undecodable, codec
from experiments.recording.topics import SentPose
from experiments.recording.trace import ROUNDING_S

LOST_S: Final = 1.0  # without a sample for so long a robot is silent
WORDS: Final = {phase.word: int(phase) for phase in Phase}
NOWHERE: Final = (nan, nan, nan)
COLUMNS: Final = np.cumsum([1, 1, 3, 1, 3, 4, 3, 1])  # ends of the columns of `_sample`


@dataclass(frozen=True)
class Track:
    """Samples (K) of one robot, in order of time; unknown numbers are NaN."""

    time: Array  # (K,) [s] since the common start
    phase: Index  # (K,) `agents.decision.lifecycle.Phase`
    position: Array  # (K, 3) [m] true if known, else measured
    yaw: Array  # (K,) [rad] likewise
    goal: Array  # (K, 3) [m]
    attitude: Array  # (K, 4) quaternion w, x, y, z
    shadow: Array  # (K, 3) [m] of the twin beside the robot
    shadow_yaw: Array  # (K,) [rad]
    sent: Array  # (P,) [s] of each pose to the neighbours
    statuses: tuple[Status, ...]  # stamps since the common start

    def at(self, t: float) -> int:
        """Number of the last sample at or before `t` [s]; −1 before the first."""
        return int(np.searchsorted(self.time, t + ROUNDING_S, side="right")) - 1

    def positions(self, times: Array) -> Array:
        """Positions (..., 3) [m] at `times` (...) [s], interpolated; unknown before the first sample."""
        time, place = self._known
        if not len(time):
            return np.full((*times.shape, 3), nan)
        return np.stack([np.interp(times, time, place[:, k], left=nan) for k in range(3)], axis=-1)

    @cached_property
    def _known(self) -> tuple[Array, Array]:
        """Times [s] and positions [m] of the samples with a position."""
        known = np.isfinite(self.position).all(axis=1)
        return self.time[known], self.position[known]


@dataclass(frozen=True)
class Tracks:
    """A recording as tracks."""

    case: str
    experiment: Experiment
    clock: str  # "real" or "virtual"
    robots: tuple[str, ...]
    tracks: tuple[Track, ...]  # in the order of `robots`
    events: tuple[Event, ...]  # incidents of robots included, in order of time; stamps since the common start
    world: tuple[WorldState, ...]
    begin: float  # [s] first sample, since the common start: not later than 0
    end: float  # [s] last sample


def read(path: Path) -> Tracks:
    """Reads a recording, finished or not.

    Raises:
        NotStarted: If no robot had started when the recording ended.
        RecordingError: If the file is no recording of zenpark, or of another version.
    """
    records = Records(path)
    samples: dict[str, array[float]] = {}
    sent: dict[str, list[float]] = {}
    rare: dict[type, list[Any]] = {kind: [] for kind in (Event, Status, WorldState, HostClock)}
    decoders = {codec(kind).name: codec(kind).decode for kind in (State, SentPose, *rare)}
    for message in records.messages():
        about = records.channels[message.channel]
        decode = decoders.get(records.schemas[about.schema_id].name)
        if decode is None:
            continue
        try:
            found = decode(message.data)
        except Undecodable as error:
            raise RecordingError(f"{path}: a message of {about.topic} is damaged: {error}") from None
        if isinstance(found, State):
            samples.setdefault(found.robot, array("d")).extend(_sample(found))
        elif isinstance(found, SentPose):
            sent.setdefault(found.robot, []).append(found.stamp)
        else:
            rare[type(found)].append(found)
    run = AboutRun.of(records)
    experiment = run.experiment
    events, statuses = sorted(rare[Event], key=lambda event: event.stamp), rare[Status]
    start = run.start(events, statuses, path)
    right = Correction(rare[HostClock])
    robots = tuple(experiment.robots)

    def since(robot: str, stamps: Array) -> Array:
        return right.stamps(robot, stamps) - start

    def track(name: str) -> Track:
        table = np.array(samples.get(name, ())).reshape(-1, COLUMNS[-1])
        time = since(name, table[:, 0])
        _, order = np.unique(time, return_index=True)  # several states of one sample: the first has the pose
        order = order[np.isfinite(time[order])]
        _, phase, position, yaw, goal, attitude, shadow, shadow_yaw, _ = np.split(table[order], COLUMNS, axis=1)
        poses = since(name, np.unique(sent.get(name, ())))
        own = sorted((status for status in statuses if status.robot == name), key=lambda status: status.stamp)
        return Track(
            time[order], phase[:, 0].astype(np.intp), position, yaw[:, 0], goal, attitude, shadow, shadow_yaw[:, 0],
            sent=poses[np.isfinite(poses)],
            statuses=tuple(
                msgspec.structs.replace(each, stamp=float(since(name, np.array(each.stamp)))) for each in own
            ),
        )  # fmt: skip

    tracks = tuple(map(track, robots))
    said = [msgspec.structs.replace(event, stamp=event.stamp - start) for event in events]
    if not any(event.kind == "hazard" for event in said):
        said += _incidents(tracks)
    reports = tuple(msgspec.structs.replace(each, stamp=each.stamp - start) for each in rare[WorldState])
    there = [track.time for track in tracks if len(track.time)]
    return Tracks(
        run.case, experiment, run.clock, robots, tracks, tuple(sorted(said, key=lambda event: event.stamp)), reports,
        begin=min([0.0, *(float(time[0]) for time in there)]),
        end=max([0.0, *(float(time[-1]) for time in there)]),
    )  # fmt: skip


def _sample(state: State) -> tuple[float, ...]:
    """The row of a state: stamp, phase, position, yaw, goal, attitude, position and yaw of the shadow twin."""
    yaw = state.yaw if state.true_yaw is None else state.true_yaw
    return (
        state.stamp,
        WORDS.get(state.phase, 0),
        *(state.true_position or state.position or NOWHERE),
        nan if yaw is None else yaw,
        *(state.goal or NOWHERE),
        *(state.attitude or (*NOWHERE, nan)),
        *(state.shadow_position or NOWHERE),
        nan if state.shadow_yaw is None else state.shadow_yaw,
    )


def _incidents(tracks: Sequence[Track]) -> Iterator[Event]:
    """Incidents that robots report from their start on, each once."""
    for track in tracks:
        for before, status in pairwise((None, *track.statuses)):
            if status is not None and status.started > 0.0:
                for each in status.incidents_since(before):
                    yield Event(each.stamp - status.started, "hazard", status.robot, each.text)
