"""Tracks of the robots of a recording, for replay: what is drawn, and nothing else. Read in a third of a trace's time.

A trace decodes all that a metric needs. Here the few fields that move a picture are taken out of the messages of a
robot all at once, by their places in the bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import inf, nan
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from agents.arrays import Array, Index
from agents.decision.lifecycle import Phase
from agents.network.messages import Event, HostClock, State, Status, WorldState
from experiments.definition.experiment import Experiment
from experiments.recording.clocks import Correction
from experiments.recording.playback import AboutRun
from experiments.recording.reader import PAYLOAD, RecordingError, Records
from experiments.recording.ros2.cdr import Undecodable, codec
from experiments.recording.topics import TOPICS, SentPose
from experiments.recording.trace import ROUNDING_S

BATCH: Final = 200  # pieces of the file that are taken apart at once
LOST_S: Final = 1.0  # without a sample for so long a robot is silent
WORDS: Final = {phase.word: int(phase) for phase in Phase}
_NUMBER: Final = struct.Struct("<d")
# fields of a state that are drawn, with their widths; those behind its lists count from the end of the message
_FIELDS: Final = {
    "stamp": 1, "position": 3, "yaw": 1, "goal": 3, "true_position": 3, "true_yaw": 1, "attitude": 4,
    "shadow_position": 3, "shadow_yaw": 1,
}  # fmt: skip
_BEHIND: Final = ("attitude", "shadow_position", "shadow_yaw")

Bytes = NDArray[np.uint8]


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
    states: dict[str, list[dict[str, Array]]] = {}
    sent: dict[str, list[Array]] = {}
    rare: dict[type, list[Any]] = {kind: [] for kind in (Event, Status, WorldState, HostClock)}
    names = {codec(topic.recorded).name: topic.recorded for topic in TOPICS}
    for data, found in _batches(records):
        flat = np.frombuffer(data, dtype=np.uint8)
        for channel, places in found.items():
            about = records.channels.get(channel)
            kind = names.get(records.schemas[about.schema_id].name) if about is not None else None
            if about is None or kind is None:
                continue
            robot = about.topic.split("/")[1]
            starts = np.array(places, dtype=np.intp)
            if kind is State:
                states.setdefault(robot, []).append(_states(flat, data, starts, robot))
            elif kind is SentPose:
                sent.setdefault(robot, []).append(_gathered(flat, starts + PAYLOAD + _stamp_of_pose(robot), 1)[:, 0])
            elif kind in rare:
                rare[kind] += [_decoded(path, kind, data, at) for at in places]
    run = AboutRun.of(records)
    experiment = run.experiment
    events, statuses = sorted(rare[Event], key=lambda event: event.stamp), rare[Status]
    start = run.start(events, statuses, path)
    right = Correction(rare[HostClock]) if rare[HostClock] else None
    robots = tuple(experiment.robots)
    tracks = tuple(
        _track(name, (states.get(name, []), sent.get(name, []), [s for s in statuses if s.robot == name]), start, right)
        for name in robots
    )
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


def _batches(records: Records) -> Iterator[tuple[bytes, dict[int, list[int]]]]:
    """Several pieces of the file as one."""
    pieces: list[bytes] = []
    places: dict[int, list[int]] = {}
    size = 0
    for data, found in records.chunks():
        for channel, own in found.items():
            places.setdefault(channel, []).extend([at + size for at in own])
        pieces.append(data)
        size += len(data)
        if len(pieces) >= BATCH:
            yield b"".join(pieces), places
            pieces, places, size = [], {}, 0
    yield b"".join(pieces), places


def _decoded(path: Path, kind: type[msgspec.Struct], data: bytes, at: int) -> Any:  # noqa: ANN401 - by its kind
    length = int.from_bytes(data[at + 1 : at + 9], "little")
    try:
        return codec(kind).decode(data[at + PAYLOAD : at + 9 + length])
    except Undecodable as error:
        raise RecordingError(f"{path}: a {kind.__name__} is damaged: {error}") from None


def _gathered(flat: Bytes, starts: Index, width: int) -> Array:
    """`width` numbers (K, width) at each of some places (K,) in bytes."""
    taken = flat[starts[:, None] + np.arange(8 * width)]
    return np.ascontiguousarray(taken).view("<f8").astype(float)


def _states(flat: Bytes, data: bytes, starts: Index, robot: str) -> dict[str, Array]:
    """The drawn fields of states, as arrays (K, width)."""
    body = starts + PAYLOAD
    lengths = np.ascontiguousarray(flat[starts[:, None] + np.arange(1, 9)]).view("<u8")[:, 0].astype(np.intp)
    ends = starts + 9 + lengths
    where = 4 + -(-(5 + len(robot.encode())) // 8) * 8 + 16  # behind the name, the number and the stamp: the phase
    counts = np.ascontiguousarray(flat[(body + where)[:, None] + np.arange(4)]).view("<u4")[:, 0]
    found = {name: np.full((len(starts), width), nan) for name, width in _FIELDS.items()}
    found["phase"] = np.zeros((len(starts), 1))
    plain = (flat[ends[:, None] - np.arange(1, 5)] == 0).all(axis=1)  # no goals of a centre at the end
    for count in np.unique(counts).tolist():
        rows = np.flatnonzero(counts == count)
        layout = _layout(robot, count)
        for name, width in _FIELDS.items():
            if name in _BEHIND:
                mine = rows[plain[rows]]
                found[name][mine] = _gathered(flat, ends[mine] + layout[name], width)
            else:
                found[name][rows] = _gathered(flat, body[rows] + layout[name], width)
        texts = flat[(body[rows] + where + 4)[:, None] + np.arange(count - 1)]
        for word, number in WORDS.items():
            if len(word) == count - 1:
                found["phase"][rows[(texts == np.frombuffer(word.encode(), np.uint8)).all(axis=1)]] = number
    for row in np.flatnonzero(~plain).tolist():
        state: State = codec(State).decode(data[int(body[row]) : int(ends[row])])
        for name in _BEHIND:
            value = getattr(state, name)
            found[name][row] = nan if value is None else value
    return found


@lru_cache(256)
def _layout(robot: str, count: int) -> dict[str, int]:
    """Places of the drawn fields in the bytes of a state [bytes], by a state of known numbers.

    Args:
        robot: Whose state it is.
        count: Bytes of the text of its phase.
    """
    marks = {name: tuple(1e9 + 100.0 * k + j for j in range(width)) for k, (name, width) in enumerate(_FIELDS.items())}
    values: dict[str, Any] = {name: mark if len(mark) > 1 else mark[0] for name, mark in marks.items()}
    made = codec(State).encode(State(robot, 0, phase="x" * (count - 1), **values))
    places = {name: made.index(_NUMBER.pack(mark[0])) for name, mark in marks.items()}
    return {name: place - len(made) if name in _BEHIND else place for name, place in places.items()}


@lru_cache(256)
def _stamp_of_pose(robot: str) -> int:
    """Place of the stamp in the bytes of a sent pose [bytes]."""
    made = codec(SentPose).encode(SentPose(robot, 0, 1e9 + 7.0, (0.0, 0.0, 0.0), None, None, 0.0, 0))
    return made.index(_NUMBER.pack(1e9 + 7.0))


def _track(
    name: str,
    found: tuple[Sequence[dict[str, Array]], Sequence[Array], Sequence[Status]],
    start: float,
    right: Correction | None,
) -> Track:
    """The track of one robot, of its states, the stamps of its poses, and its statuses."""
    states, sent, statuses = found

    def since(stamps: Array) -> Array:
        return np.asarray((stamps if right is None else right.stamps(name, stamps)) - start)

    whole = {key: np.concatenate([np.zeros((0, width)), *(part[key] for part in states)])
             for key, width in {**_FIELDS, "phase": 1}.items()}  # fmt: skip
    time = since(whole["stamp"][:, 0])
    _, order = np.unique(time, return_index=True)  # several states of one sample: the first has the pose
    order = order[np.isfinite(time[order])]
    got = {key: value[order] for key, value in whole.items()}
    true, true_yaw = got["true_position"], got["true_yaw"][:, 0]
    poses = since(np.unique(np.concatenate([np.zeros(0), *sent])))
    return Track(
        time=time[order],
        phase=got["phase"][:, 0].astype(np.intp),
        position=np.where(np.isfinite(true).all(axis=1, keepdims=True), true, got["position"]),
        yaw=np.where(np.isfinite(true_yaw), true_yaw, got["yaw"][:, 0]),
        goal=got["goal"],
        attitude=got["attitude"],
        shadow=got["shadow_position"],
        shadow_yaw=got["shadow_yaw"][:, 0],
        sent=poses[np.isfinite(poses)],
        statuses=tuple(
            msgspec.structs.replace(each, stamp=float(since(np.array(each.stamp))))
            for each in sorted(statuses, key=lambda status: status.stamp)
        ),
    )


def _incidents(tracks: Sequence[Track]) -> list[Event]:
    """Incidents that robots report, each once."""
    found: dict[tuple[str, int, int], Event] = {}
    for track in tracks:
        for status in track.statuses:
            for each in status.incidents:
                shifted = each.stamp - (status.started if status.started > 0.0 else inf)
                event = Event(max(shifted, -inf), "hazard", status.robot, each.text)
                found.setdefault((status.robot, status.pid, each.seq), event)
    return [event for event in found.values() if event.stamp > -inf]
