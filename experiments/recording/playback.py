"""Reads a recording back into the arrays of a trace, finished or not."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

import msgspec
import numpy as np
from msgspec.structs import astuple, replace

from agents.body.kinds import KINDS, RecordedKind
from agents.decision.lifecycle import PHASES, Phase
from agents.network.messages import (
    CentreState,
    Contact,
    Encoding,
    Event,
    Goal,
    HostClock,
    LawMemory,
    Malformed,
    Pose,
    State,
    Status,
    Variable,
    WorldState,
)
from agents.network.validation import ABSURD, FUTURE_S, is_count
from agents.plugins.registry import PluginError
from agents.ticks import ROUNDING_S
from experiments.arrays import PoseTable, known_rows
from experiments.definition.plan import Plan
from experiments.definition.standby import without_standby
from experiments.recording.clocks import Correction
from experiments.recording.losses import (
    STATUS_S,
    count_dropped,
    count_foreign,
    count_in_run,
    count_lost,
    counter_growth,
    lives,
)
from experiments.recording.reader import RecordedMessage, RecordingError, Records
from experiments.recording.resample import HOLE_S, attitude, line, step, turn
from experiments.recording.ros2 import payload
from experiments.recording.topics import JSON, KINDS_JSON, METADATA, TOPICS, SentGoal, SentPose, Topic
from experiments.recording.trace import (
    OPTIONAL,
    Goals,
    Trace,
    poses_in_run,
    world_in_run,
)
from twins.arrays import Array, Index

HOLD_PERIODS: Final = 2.0  # state periods for which a sample is valid
EARLY_S: Final = 0.5  # a landing at most this much before the planned end is a regular one [s]
AROUND_S: Final = 600.0  # [s] longest time before and after a run that a replay shows
LANDED: Final = (Phase.LANDING.word, Phase.DONE.word)
NOWHERE: Final = (math.nan, math.nan, math.nan)
# topics and encodings by their types in the file
TYPES: Final = {payload.type_name(topic.message, each): (topic, each) for topic in TOPICS for each in payload.NAMES}
RECORDED: Final[dict[type[msgspec.Struct], type[SentPose | SentGoal]]] = {Pose: SentPose, Goal: SentGoal}

S = TypeVar("S", bound=msgspec.Struct)
M = TypeVar("M", State, SentPose, Status, LawMemory)


class NotStarted(RecordingError):
    """The recording of a run that ended before its common start, so that there is nothing to show."""


def topic_of(records: Records, channel: int) -> tuple[Topic, Encoding] | None:
    """Topic and encoding of a channel in a file, None if another program wrote it; raises RecordingError as `read`."""
    about = records.channels[channel]
    schema = records.schemas.get(about.schema_id)
    if schema is None or (found := TYPES.get(schema.name)) is None:
        return None
    if not schema.data.endswith(b"\n" + payload.FIELDS[found[1]].encode()):
        raise RecordingError(
            f"{records.path}: {about.topic} was recorded by a version of zenpark with another form of {schema.name}; "
            "read it with that version"
        )
    return found


@dataclass(frozen=True)
class AboutRun:
    """Case, seed, clock and experiment of a recording, and its common start, if that was announced."""

    case: str
    seed: int
    clock: str  # "real" or "virtual"
    announced: float | None  # [s] UTC
    plan: Plan

    @classmethod
    def of(cls, records: Records) -> AboutRun:
        """Content of `records`, after their messages were read."""
        about = next((record.metadata for record in records.metadata if record.name == METADATA), {})
        attached = next((record.data for record in records.attachments if record.name == JSON), b"")
        kinds = next((record.data for record in records.attachments if record.name == KINDS_JSON), b"[]")
        try:
            announced = float(about["started"]) if "started" in about else None
            for each in msgspec.json.decode(kinds, type=list[RecordedKind]):
                KINDS.remember(each)
            plan = Plan.decoded(attached)
            _ = plan.one_way_links  # names of robots are not in the types
            return cls(about["case"], int(about["seed"]), about["clock"], announced, plan)
        except PluginError as error:
            raise RecordingError(f"{records.path}: {error}") from None
        except (KeyError, ValueError, RecursionError) as error:
            text = f"holds no experiment that this version of zenpark can read ({error})"
            raise RecordingError(f"{records.path}: {text}") from None

    def start(self, events: Iterable[Event], statuses: Iterable[Status], path: Path) -> float:
        """UTC time of the common start [s]: as the conductor says, else as announced, else the earliest of a robot."""
        said = (each.stamp for each in events if each.kind == "start" and math.isfinite(each.stamp))
        start = next(said, self.announced)
        if start is None:
            start = min((each.started for each in statuses if each.started > 0.0), default=None)
        if start is None:
            raise NotStarted(f"{path}: no robot had started when the recording ended; there is nothing to show")
        return start


@dataclass(frozen=True)
class Playback:
    """A recording as a trace."""

    trace: Trace  # trace up to the end of the run
    started: float  # [s] UTC of the common start; of a virtual run `trace.EPOCH`
    complete: bool  # the recorder finished the file and nothing in it is damaged
    messages: int  # number in the file, those of other programs included
    damaged: int  # what could not be read of the file [bytes]


@dataclass(frozen=True)
class WholeRecording:
    """A recording from its first sample to its last."""

    trace: Trace  # trace with take-off and landing; poses sent, contacts and reports of the world are those of the run
    phase: Index  # (T, N) `agents.decision.lifecycle.Phase`
    statuses: tuple[tuple[Status, ...], ...]  # statuses of each robot, stamps since the common start


def read(path: Path) -> Playback:
    """Reads a recording.

    Positions, yaw, attitude and the poses of shadow twins are interpolated onto the grid; goals and setpoints are the
    last at or before. A robot that never reported is NaN; one that fell silent is NaN from two state periods after its
    last sample, and inside holes of more than a second. A robot on standby that was never added is left out.

    Counters of a robot are sums over all its processes. What robots refuse (running numbers that are not possible,
    stamps ahead of the time) is left out.

    `lost` of a robot is a sum of three parts. (1) Gaps in the sequence numbers of its poses recorded in the run; a
    number that goes back is a publisher that restarted at 1. (2) Poses beyond the last recorded one that its last
    status of the run counts as sent. (3) Poses that the last status of each receiver counts as lost from it, less the
    count of the same process before the common start. A pose that two receivers and the recorder missed counts three
    times, since each should have received it. Poses that the modelled network dropped are not lost; the receivers count
    them in `dropped`.

    The trace of a run that is shorter than its experiment ends when the conductor began to land all robots (interrupted
    by the user, or all had come down before). After a kill of recorder or conductor it ends with the last known samples
    of running robots. It contains no landing.

    Stamps of robots on other machines are corrected by the drift of their clocks in the run; their offset at its
    beginning was subtracted where they were made.

    Raises:
        NotStarted: If the run ended before its common start.
        RecordingError: If the file is no recording of zenpark, or of another version.
    """
    content = Content(Records(path))
    messages = content.fill()
    trace, start = _played(content, path)
    return Playback(trace, start, content.records.complete, messages, content.records.damaged)


def read_whole(path: Path) -> WholeRecording:
    """Reads a recording for a replay, take-off and landing included; raises as `read`."""
    content = Content(Records(path))
    content.fill()
    trace, start = _played(content, path, whole=True)
    statuses = by_robot(content[Status], trace.robots)
    phase = np.full(trace.yaw.shape, Phase.IDLE, dtype=np.intp)
    for row, own in enumerate(by_robot(content[State], trace.robots)):
        words = np.array([PHASES.get(state.phase, Phase.IDLE) for state in own], dtype=np.intp)
        before = np.searchsorted([state.stamp - start for state in own], trace.time + ROUNDING_S, side="right")
        phase[before > 0, row] = words[before[before > 0] - 1]
    since = (tuple(replace(each, stamp=each.stamp - start) for each in own) for own in statuses)
    return WholeRecording(trace, phase, tuple(since))


def _played(content: Content, path: Path, *, whole: bool = False) -> tuple[Trace, float]:
    """Trace of the run, or of the `whole` recording, and its common start [s, UTC]."""
    about = AboutRun.of(content.records)
    plan = without_standby(about.plan, {state.robot for state in content[State]})
    about, experiment = dataclasses.replace(about, plan=plan), plan.experiment
    start = about.start(content[Event], content[Status], path)
    length, rate = content.length(start, experiment.duration_s), experiment.rates.state_hz
    begin, end = 0.0, length
    if whole:
        stamps = [at for state in content[State] if -AROUND_S < (at := state.stamp - start) < length + AROUND_S]
        begin, end = min(stamps, default=0.0), max(stamps, default=0.0)
    time = np.arange(math.floor(begin * rate + 1e-9), math.floor(end * rate + 1e-9) + 1) / rate
    if len(time) < 2:  # nothing can be integrated
        raise NotStarted(f"{path}: the run ended before the common start; there is nothing to show")
    with np.errstate(all="ignore"):  # numbers that no robot can have are in the file, not of our making
        return _trace(content, about, (start, length), time), start


class Content:
    """The messages of a recording, by kind."""

    def __init__(self, records: Records) -> None:
        self.records = records
        kinds = (topic.message for topic in TOPICS)
        self._lists: dict[type[msgspec.Struct], list[Any]] = {RECORDED.get(kind, kind): [] for kind in kinds}

    def __getitem__(self, kind: type[S]) -> list[S]:
        return self._lists[kind]

    def fill(self) -> int:
        """Reads all messages and counts them; those of other types are passed over."""
        readers: dict[int, Callable[[RecordedMessage], None] | None] = {}
        count = 0
        for message in self.records.messages():
            count += 1
            if message.channel not in readers:
                readers[message.channel] = self._reader(message.channel)
            take = readers[message.channel]
            if take is not None:
                try:
                    take(message)
                except (Malformed, msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
                    text = f"message {count} is damaged, or of another version of zenpark: {error}"
                    raise RecordingError(f"{self.records.path}: {text}") from None
        if self[HostClock]:
            right = Correction(self[HostClock])
            self[State][:] = [right.state(state) for state in self[State]]
            self[SentPose][:] = [replace(pose, stamp=right(pose.robot, pose.stamp)) for pose in self[SentPose]]
            self[LawMemory][:] = [replace(each, stamp=right(each.robot, each.stamp)) for each in self[LawMemory]]
            self[Status][:] = [right.status(status) for status in self[Status]]
            self[SentGoal][:] = [replace(goal, pose=right(goal.robot, goal.pose)) for goal in self[SentGoal]]
        return count

    def length(self, start: float, duration: float) -> float:
        """Length of the run from the common start on [s], at most `duration`."""
        landings = [
            (event.stamp - start, event.text != "landing")
            for event in self[Event]
            if (event.kind, event.source) == ("phase", "conductor")
            and event.text.startswith("landing")
            and math.isfinite(event.stamp)
        ]
        if landings:
            end, interrupted = min(landings)
            return min(end, duration) if interrupted or end < duration - EARLY_S else duration
        last: dict[str, float] = {}
        for state in self[State]:
            if state.phase not in LANDED and math.isfinite(state.stamp):
                last[state.robot] = max(last.get(state.robot, -math.inf), state.stamp - start)
        end = max(last.values(), default=duration)
        # robots that were there until the end are known until the first of them falls silent: some messages of the
        # others only came later into the file, which is no reason to call them dead
        end = min((at for at in last.values() if at > end - HOLE_S), default=end)
        landed = any(state.phase in LANDED for state in self[State])  # else the recording broke off
        return duration if not last or end > duration - (EARLY_S if landed else 0.0) else end

    def _reader(self, channel: int) -> Callable[[RecordedMessage], None] | None:
        """Function that takes in a message of a channel; None if another program wrote it."""
        if (found := topic_of(self.records, channel)) is None:
            return None
        topic, encoding = found
        recorded = RECORDED.get(topic.message)
        append = self._lists[recorded or topic.message].append
        decode = (msgspec.json if encoding == "json" else msgspec.msgpack).Decoder(topic.message).decode
        if recorded is None:
            return lambda message: append(decode(payload.unwrap(message.data, encoding)))

        def take(message: RecordedMessage) -> None:
            sent = payload.unwrap(message.data, encoding)
            seconds, rest = divmod(message.logged, 10**9)
            append(recorded(*(*astuple(decode(sent)), seconds + 1e-9 * rest, len(sent))))

        return take


def _trace(content: Content, about: AboutRun, run: tuple[float, float], time: Array) -> Trace:
    """The trace of a run by its common start, UTC, and its length [s], on the grid `time` (T,)."""
    plan = about.plan
    experiment, robots = about.plan.experiment, about.plan.names
    rate, (start, duration) = experiment.rates.state_hz, run
    states = by_robot(content[State], robots)
    poses = [
        list({(pose.stamp, pose.seq): pose for pose in own}.values()) for own in by_robot(content[SentPose], robots)
    ]
    statuses = by_robot(content[Status], robots)

    def counted(what: str) -> Index:
        """A counter of each robot at the end of the run, 0 without a status."""
        return np.array([count_in_run(own, what, start, start + duration) for own in statuses], dtype=np.intp)

    sampled = [_sampled(own, start, time, HOLD_PERIODS / rate) for own in states]
    columns = {what: np.stack([own[what] for own in sampled], axis=1) for what in sampled[0]}
    known = {what: each for what, each in columns.items() if what not in OPTIONAL or np.isfinite(each).any()}
    contacts, world = world_in_run(content[Contact], content[WorldState], start, duration)
    laws, stepping = by_robot(content[LawMemory], robots), HOLD_PERIODS / min(rate, experiment.rates.coordination_hz)
    goals = _goals(content, states, robots, start, duration) if plan.guided else None
    return Trace(
        case=about.case,
        plan=plan,
        seed=about.seed,
        robots=robots,
        clock=about.clock,
        time=time,
        sent=_sent(poses, start, duration),
        received=_received(states, plan, start, duration),
        lost=count_lost(robots, poses, statuses, (start, start + duration), experiment.rates.pose_hz)
        + (0 if goals is None else goals.lost),
        dropped=count_dropped(plan, statuses, (start, start + duration)),
        foreign=count_foreign(robots, statuses, (start, start + duration)),
        missed_deadlines=counted("missed"),
        ticks=counted("ticks"),
        decisions=counted("decisions"),
        events=tuple(
            replace(event, stamp=event.stamp - start) for event in sorted(content[Event], key=lambda event: event.stamp)
        ),
        interventions=counted("interventions"),
        avoided=counted("avoided"),
        contacts=contacts,
        world=world,
        goals=goals,
        clocks=Correction(content[HostClock]).offsets(),
        joined=_joined(states, plan, start),
        memory=_memories(laws, start, time, stepping, "memory"),
        measures={name: values[..., 0] for name, values in _memories(laws, start, time, stepping, "measures").items()},
        **known,
    )


def by_robot(messages: Iterable[M], robots: Sequence[str]) -> list[list[M]]:
    """For each robot its messages in order of time."""
    found: dict[str, list[M]] = {robot: [] for robot in robots}
    for message in messages:
        if message.robot in found and math.isfinite(message.stamp) and _possible(message):
            found[message.robot].append(message)
    return [sorted(own, key=lambda message: message.stamp) for own in found.values()]


def _joined(states: list[list[State]], plan: Plan, start: float) -> Array | None:
    """Time at which each robot joined (N,) [s]: 0, except for those on standby; None without such robots."""
    robots = plan.experiment.robots.values()
    if not any(robot.standby for robot in robots):
        return None
    first = [
        next((state.stamp - start for state in own if state.phase == Phase.RUNNING.word), 0.0) if robot.standby else 0.0
        for robot, own in zip(robots, states, strict=True)
    ]
    return np.maximum(first, 0.0)


def _possible(message: State | SentPose | Status | LawMemory | CentreState) -> bool:
    """Whether robots would take the numbers of a message: metrics refuse what robots refuse."""
    match message:
        case SentPose():
            return is_count(message.seq) and 0.0 < message.stamp < message.received + FUTURE_S and message.size >= 0
        case Status():
            counts = (message.sent, message.ticks, message.missed, message.decisions)
            changed = (message.interventions, message.avoided)
            by_name = (*message.lost.values(), *message.dropped.values(), *message.foreign.values())
            return _counts((*counts, *changed, *by_name))
        case CentreState():
            by_name = (*message.received.values(), *message.lost.values(), *message.dropped.values())
            return math.isfinite(message.stamp) and _counts(
                (message.decisions, message.missed, message.goals, *by_name)
            )
        case _:
            return True


def _counts(numbers: Iterable[int]) -> bool:
    return all(number == 0 or is_count(number) for number in numbers)


def _sampled(states: list[State], start: float, time: Array, hold: float) -> dict[str, Array]:
    """Columns of `Trace` from the telemetry of one robot on the grid `time` (T,): (T, k) or (T,) each."""
    t = np.array([state.stamp for state in states]) - start
    grid = (time, hold)

    def column(what: str, width: int) -> Array:
        values = known_rows((getattr(state, what) for state in states), width)
        return np.where(np.abs(values) < ABSURD, values, np.nan)

    measured, truth = column("position", 3), column("true_position", 3)
    return {
        "position": line(t, measured, *grid),
        "yaw": turn(t, column("yaw", 1), *grid)[:, 0],
        "true_position": line(t, np.where(np.isfinite(truth), truth, measured), *grid),
        "goal": step(t, column("goal", 3), *grid),
        "setpoint": step(t, column("setpoint", 4), *grid),
        "attitude": attitude(t, column("attitude", 4), *grid),
        "shadow_position": line(t, column("shadow_position", 3), *grid),
        "shadow_yaw": turn(t, column("shadow_yaw", 1), *grid)[:, 0],
    }


def _memories(
    laws: list[list[LawMemory]], start: float, time: Array, hold: float, what: Literal["memory", "measures"]
) -> dict[str, Array]:
    """Variables of all robots on the grid `time` (T,), by name: (T, N, k); NaN where one is unknown."""
    sizes: dict[str, int] = {}
    for each in (each for own in laws for message in own for each in getattr(message, what)):
        sizes[each.name] = max(sizes.get(each.name, 1), len(each.value))
    found = {name: np.full((len(time), len(laws), size), np.nan) for name, size in sizes.items()}
    for row, own in enumerate(laws):
        t = np.array([message.stamp for message in own]) - start
        for name, size in sizes.items():
            known = [_value(getattr(message, what), name, size) for message in own]
            if own:
                found[name][:, row] = step(t, np.array(known), time, hold)
    return found


def _value(variables: Sequence[Variable], name: str, size: int) -> Sequence[float]:
    """Value of a variable; NaN where it is missing, or of another size."""
    value = next((each.value for each in variables if each.name == name), ())
    return value if len(value) == size else (math.nan,) * size


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _sent(poses: list[list[SentPose]], start: float, duration: float) -> PoseTable:
    rows = [
        (row, p.seq, p.stamp, p.stamp, *p.position, *(p.velocity or NOWHERE), _number(p.yaw), p.size)
        for row, own in enumerate(poses)
        for p in own
    ]
    return poses_in_run(_table(rows).since(start), duration, "stamp")


def _received(states: list[list[State]], plan: Plan, start: float, duration: float) -> PoseTable:
    """On the links of the plan; other poses that a robot received count nowhere."""
    ends, names = plan.pose_links, plan.names
    pairs = zip(ends.receiver.tolist(), ends.sender.tolist(), strict=True)
    links = {(receiver, names[sender]): link for link, (receiver, sender) in enumerate(pairs)}
    found = {
        (links[row, each.sender], each.seq, each.stamp, each.arrived): each
        for row, own in enumerate(states)
        for state in own
        for each in state.received
        if (row, each.sender) in links and is_count(each.seq)
    }  # a state that is recorded twice repeats its receipts
    rows = [(*about, *each.position, *each.velocity, math.nan, 0) for about, each in found.items()]
    return poses_in_run(replace(_table(rows), yaw=None, bytes=None).since(start), duration, "arrival")


def _goals(content: Content, states: list[list[State]], robots: Sequence[str], start: float, duration: float) -> Goals:
    """Messages between the central controller and the robots that it guides."""
    row = {name: number for number, name in enumerate(robots)}
    own = (goal for goal in content[SentGoal] if goal.robot in row and is_count(goal.seq))
    goals = sorted(own, key=lambda goal: (goal.stamp, row[goal.robot]))
    sent = [(row[g.robot], g.seq, g.stamp, g.received, *g.position, *NOWHERE, _number(g.yaw), g.size) for g in goals]
    receipts = sorted(
        (each.acted, row, each.pose, each.seq, each.stamp)
        for row, own in enumerate(states)
        for state in own
        for each in state.goal_receipts
        if is_count(each.seq)
    )
    acted = _table([(row, seq, stamp, at, *NOWHERE, *NOWHERE, math.nan, 0) for at, row, _, seq, stamp in receipts])
    pose = np.array([pose for _, _, pose, *_ in receipts], dtype=float).reshape(-1, 1) - start
    reports = sorted(filter(_possible, content[CentreState]), key=lambda each: each.stamp)
    counts = [Counter[str](), Counter[str](), Counter[str]()]
    for life in lives(reports, lambda each: each.decisions):
        for total, what in zip(counts, ("received", "lost", "dropped"), strict=True):
            growth = counter_growth([(each.stamp, getattr(each, what)) for each in life], start, start + duration)
            total.update(growth)
    received, lost_poses, dropped_poses = (np.array([each[name] for name in row], dtype=np.intp) for each in counts)
    return Goals.of_run(
        _table(sent).since(start),
        replace(acted.since(start), extra=pose),
        duration,
        received=received,
        lost=lost_poses,
        dropped=dropped_poses,
        reports=tuple(
            replace(each, stamp=each.stamp - start)
            for each in reports
            if 0.0 < each.stamp - start <= duration + STATUS_S
        ),
    )


def _table(rows: Sequence[tuple[float, ...]]) -> PoseTable:
    """From link, seq, stamp, arrival, position, velocity, yaw and bytes of each pose."""
    table = np.array(rows, dtype=np.float64).reshape(-1, 12)
    link, seq, size = (table[:, column].astype(np.intp) for column in (0, 1, 11))
    return PoseTable(link, seq, table[:, 2], table[:, 3], table[:, 4:7], table[:, 7:10], table[:, 10], size)
