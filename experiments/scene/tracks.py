"""Tracks of the robots of a recording, for replay: only the drawn fields."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import accumulate, islice, pairwise
from math import nan
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from agents.decision.lifecycle import Phase
from agents.network.messages import Event, HostClock, LawMemory, State, Status, WorldState
from experiments.definition.plan import Plan
from experiments.recording.clocks import Correction
from experiments.recording.playback import AboutRun, topic_of
from experiments.recording.reader import HEAD, RecordingError, Records
from experiments.recording.ros2.cdr import Undecodable, codec
from experiments.recording.topics import SentPose
from experiments.recording.trace import ROUNDING_S
from twins.arrays import Array, Index

M = TypeVar("M", Status, LawMemory)
LOST_S: Final = 1.0  # time without a sample after which a robot is silent
WORDS: Final = {phase.word: int(phase) for phase in Phase}
NOWHERE: Final = (nan, nan, nan)
COLUMNS: Final = np.cumsum([1, 1, 3, 1, 3, 4, 3, 1])  # ends of the columns of `_sample`
BATCH: Final = 200  # pieces of the file that are taken apart at once
# fields of a state that are drawn, with their widths
FIELDS: Final = {
    "stamp": 1, "position": 3, "yaw": 1, "goal": 3, "true_position": 3, "true_yaw": 1, "attitude": 4,
    "shadow_position": 3, "shadow_yaw": 1,
}  # fmt: skip


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
    memories: tuple[LawMemory, ...] = ()  # of a law that remembers, likewise

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
    samples: dict[str, list[Array]] = {}
    sent: dict[str, list[Array]] = {}
    rare: dict[type, list[Any]] = {kind: [] for kind in (Event, Status, WorldState, HostClock, LawMemory)}
    for data, starts in _batches(records):
        heads = _gathered(data, starts, HEAD)[:, 0]
        for channel in np.unique(heads["channel"]).tolist():
            if channel not in records.channels or (topic := topic_of(records, channel)) is None:
                continue
            kind, name = topic.recorded, records.channels[channel].topic
            rows = np.flatnonzero(heads["channel"] == channel)
            robot = name.split("/")[1]
            if issubclass(kind, SentPose):
                sent.setdefault(robot, []).append(heads["published"][rows] / 1e9)
                continue
            begins, ends = starts[rows] + HEAD.itemsize, starts[rows] + heads["length"][rows].astype(np.intp) + 9
            try:
                if kind is State:
                    samples.setdefault(robot, []).append(_samples(data, begins, ends, robot))
                elif kind in rare:
                    rare[kind] += [codec(kind).decode(data[at:end]) for at, end in zip(begins, ends, strict=True)]
            except Undecodable as error:
                raise RecordingError(f"{path}: a message of {name} is damaged: {error}") from None
    run = AboutRun.of(records)
    plan = run.plan
    events, statuses = sorted(rare[Event], key=lambda event: event.stamp), rare[Status]
    start = run.start(events, statuses, path)
    right = Correction(rare[HostClock])
    robots = plan.names

    def since(robot: str, stamps: Array) -> Array:
        return right.stamps(robot, stamps) - start

    def told(name: str, messages: Sequence[M]) -> tuple[M, ...]:
        own = sorted((each for each in messages if each.robot == name), key=lambda each: each.stamp)
        return tuple(msgspec.structs.replace(each, stamp=float(since(name, np.array(each.stamp)))) for each in own)

    def track(name: str) -> Track:
        table = np.concatenate([np.zeros((0, COLUMNS[-1])), *samples.get(name, ())])
        time = since(name, table[:, 0])
        _, order = np.unique(time, return_index=True)  # several states of one sample: the first has the pose
        order = order[np.isfinite(time[order])]
        _, phase, position, yaw, goal, attitude, shadow, shadow_yaw, _ = np.split(table[order], COLUMNS, axis=1)
        poses = since(name, np.unique(np.concatenate([np.zeros(0), *sent.get(name, ())])))
        return Track(
            time[order], phase[:, 0].astype(np.intp), position, yaw[:, 0], goal, attitude, shadow, shadow_yaw[:, 0],
            sent=poses[np.isfinite(poses)],
            statuses=told(name, statuses),
            memories=told(name, rare[LawMemory]),
        )  # fmt: skip

    tracks = tuple(map(track, robots))
    said = [msgspec.structs.replace(event, stamp=event.stamp - start) for event in events]
    if not any(event.kind == "hazard" for event in said):
        said += _incidents(tracks)
    reports = tuple(msgspec.structs.replace(each, stamp=each.stamp - start) for each in rare[WorldState])
    there = [track.time for track in tracks if len(track.time)]
    return Tracks(
        run.case, plan, run.clock, robots, tracks, tuple(sorted(said, key=lambda event: event.stamp)), reports,
        begin=min([0.0, *(float(time[0]) for time in there)]),
        end=max([0.0, *(float(time[-1]) for time in there)]),
    )  # fmt: skip


def _batches(records: Records) -> Iterator[tuple[bytes, Index]]:
    """Several pieces of the file as one, with the places of the messages in it."""
    pieces = records.pieces()
    while batch := list(islice(pieces, BATCH)):
        offsets = accumulate((len(data) for data, _ in batch), initial=0)
        places = [np.array(own, dtype=np.intp) + at for (_, own), at in zip(batch, offsets, strict=False)]
        yield b"".join(data for data, _ in batch), np.concatenate(places)


def _gathered(data: bytes, places: Index, kind: str | np.dtype[Any], width: int = 1) -> NDArray[Any]:
    """`width` values of a type (K, width) at each of some places (K,) in bytes."""
    size = np.dtype(kind).itemsize * width
    found: NDArray[Any] = np.frombuffer(data, np.uint8)[places[:, None] + np.arange(size)].view(kind)
    return found


def _samples(data: bytes, begins: Index, ends: Index, robot: str) -> Array:
    """Rows as of `_sample` (K, 17) of the states of a robot that lie between places in bytes (K,).

    A state costs a tenth of its decoding. The drawn fields are taken out of all states of one phase at once, by their
    places after the beginning, or before the end if they follow a list. Only states of other layouts are decoded.
    """
    table = np.full((len(begins), COLUMNS[-1]), nan)
    left = np.arange(len(begins))
    for word, number in WORDS.items():
        fields, text, least = _layout(robot, word)
        rows = left[(ends - begins)[left] >= least]
        same = _gathered(data, begins[rows] + fields["stamp"][0] + 8, f"V{len(text)}") == np.void(text)
        rows = rows[(same & (_gathered(data, ends[rows] - 4, "<u4") == 0))[:, 0]]  # no goals of a centre at the end
        found = {
            name: _gathered(data, (begins if at > 0 else ends)[rows] + at, "<f8", width)
            for name, (at, width) in fields.items()
        }
        for name in ("position", "yaw"):
            found[name] = np.where(np.isnan(found["true_" + name]), found[name], found["true_" + name])
        drawn = ("position", "yaw", "goal", "attitude", "shadow_position", "shadow_yaw")
        table[rows] = np.column_stack([found["stamp"], np.full(len(rows), number), *(found[name] for name in drawn)])
        left = np.setdiff1d(left, rows)
    for row in left.tolist():
        table[row] = _sample(codec(State).decode(data[begins[row] : ends[row]]))
    return table


@lru_cache(256)
def _layout(robot: str, phase: str) -> tuple[dict[str, tuple[int, int]], bytes, int]:
    """Places of the drawn fields in the bytes of a state [bytes], with their widths, found by a state of known numbers.

    Also the bytes of its phase, which follow the stamp, and the least length of a state.
    """
    marks = {name: tuple(1e9 + 100.0 * k + j for j in range(width)) for k, (name, width) in enumerate(FIELDS.items())}
    values: dict[str, Any] = {name: mark if len(mark) > 1 else mark[0] for name, mark in marks.items()}
    made = codec(State).encode(State(robot, 0, phase=phase, **values))
    places = {name: made.index(struct.pack("<d", mark[0])) for name, mark in marks.items()}
    text = made[places["stamp"] + 8 :][: 4 + len(phase) + 1]
    behind = places["attitude"]  # lists stand before it
    return {n: (at if at < behind else at - len(made), FIELDS[n]) for n, at in places.items()}, text, len(made)


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
