"""Tracks of the robots of a recording, for replay: only the drawn fields."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from math import nan
from pathlib import Path
from typing import Final, TypeVar

import msgspec
import numpy as np

from agents.decision.lifecycle import Phase
from agents.network.messages import Contact, Event, LawMemory, State, Status, WorldState
from experiments.definition.plan import Plan
from experiments.recording.playback import AboutRun, Content, by_robot
from experiments.recording.reader import Records
from experiments.recording.topics import SentPose
from experiments.recording.trace import ROUNDING_S
from experiments.scene.stage import drawn_columns
from twins.arrays import Array, Index

M = TypeVar("M", Contact, Event, Status, LawMemory, WorldState)
LOST_S: Final = 1.0  # time without a sample after which a robot is silent
WORDS: Final = {phase.word: int(phase) for phase in Phase}


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
    memories: tuple[LawMemory, ...] = ()  # memories of a law that remembers, likewise

    @classmethod
    def of_states(
        cls, states: Sequence[State], sent: Sequence[SentPose], start: float, statuses: Sequence[Status],
        memories: Sequence[LawMemory],
    ) -> Track:  # fmt: skip
        """The track of a robot by its messages, in order of time, of a run that began at `start` [s, UTC]."""
        # of several states of one sample the first has the pose
        time, first = np.unique(np.array([state.stamp for state in states], dtype=float), return_index=True)
        kept = [states[k] for k in first.tolist()]
        return cls(
            time=time - start,
            phase=np.array([WORDS.get(state.phase, 0) for state in kept], dtype=np.intp),
            sent=np.unique(np.array([pose.stamp for pose in sent], dtype=float)) - start,
            statuses=_since(start, statuses),
            memories=_since(start, memories),
            **drawn_columns(kept),
        )

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
    plan: Plan
    clock: str  # "real" or "virtual"
    robots: tuple[str, ...]
    tracks: tuple[Track, ...]  # tracks, ordered as `robots`
    events: tuple[Event, ...]  # incidents of robots included, in order of time; stamps since the common start
    world: tuple[WorldState, ...]
    contacts: tuple[Contact, ...]  # contacts that the world reported
    begin: float  # [s] first sample, since the common start: not later than 0
    end: float  # [s] last sample


def read(path: Path) -> Tracks:
    """Reads a recording, finished or not.

    Raises:
        NotStarted: If no robot had started when the recording ended.
        RecordingError: If the file is no recording of zenpark, or of another version.
    """
    content = Content(Records(path))
    content.fill()
    run = AboutRun.of(content.records)
    robots, start = run.plan.names, run.start(content[Event], content[Status], path)
    states, sent = by_robot(content[State], robots), by_robot(content[SentPose], robots)
    statuses, memories = by_robot(content[Status], robots), by_robot(content[LawMemory], robots)
    tracks = tuple(
        Track.of_states(*own[:2], start, *own[2:]) for own in zip(states, sent, statuses, memories, strict=True)
    )
    events = _since(start, content[Event])
    if not any(event.kind == "hazard" for event in events):
        events = (*events, *_incidents(tracks))
    there = [track.time for track in tracks if len(track.time)]
    return Tracks(
        run.case, run.plan, run.clock, robots, tracks,
        events=tuple(sorted(events, key=lambda event: event.stamp)),
        world=_since(start, content[WorldState]),
        contacts=_since(start, content[Contact]),
        begin=min([0.0, *(float(time[0]) for time in there)]),
        end=max([0.0, *(float(time[-1]) for time in there)]),
    )  # fmt: skip


def _since(start: float, messages: Sequence[M]) -> tuple[M, ...]:
    """Messages with stamps that count from `start` [s, UTC]."""
    return tuple(msgspec.structs.replace(each, stamp=each.stamp - start) for each in messages)


def _incidents(tracks: Sequence[Track]) -> Iterator[Event]:
    """Incidents that robots report from their start on, each once."""
    for track in tracks:
        for before, status in pairwise((None, *track.statuses)):
            if status is not None and status.started > 0.0:
                for each in status.incidents_since(before):
                    yield Event(each.stamp - status.started, "hazard", status.robot, each.text)
