"""The recording of one case: an MCAP file that describes itself and survives a killed recorder.

    /<robot>/pose       zenpark_msgs/SentPose         what was sent to the neighbours, with its size on the network
    /<robot>/state      zenpark_msgs/State            telemetry, with the poses heard since the one before
    /<robot>/true_pose  geometry_msgs/PoseStamped     the same place in a type that every viewer draws
    /<robot>/status     zenpark_msgs/Status
    /<robot>/goal       zenpark_msgs/SentGoal         what the centre told a robot that it guides
    /centre/report      zenpark_msgs/CentreState      what the centre says of itself
    /world/contact      zenpark_msgs/Contact          what touched in the world, when it began
    /world/state        zenpark_msgs/WorldState       what the world says of itself
    /run/clock          zenpark_msgs/HostClock        how another machine's clock lay to the conductor's
    /events             zenpark_msgs/Event

Attached are the experiment as it was written (`experiment.toml`) and this case with its overrides (`experiment.json`);
the metadata record `zenpark` says which case, which seed, which clock and which version.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from tempfile import TemporaryFile
from types import TracebackType
from typing import IO, Any, Final, Literal, Self, cast

import msgspec
from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex
from mcap.writer import CompressionType, Writer

from agents.network.messages import (
    CentreState,
    Contact,
    Event,
    Goal,
    HostClock,
    Pose,
    State,
    Status,
    Vector,
    WorldState,
)
from experiments.definition.experiment import Experiment
from experiments.recording.cdr import POSE_STAMPED, POSE_STAMPED_SCHEMA, Unencodable, codec, pose_stamped
from experiments.recording.reader import RecordingError

BLOCK_BYTES: Final = 1024 * 1024
PRIVATE: Final = "_Writer__chunk_indices"  # as of mcap 1.6; the library has no public place for it


class Block:
    """Some indices as they stand in the file."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def write(self, stream: RecordBuilder) -> None:
        """Adds them to the summary."""
        stream.write(self._data)


class ChunkIndices:
    """Stands where the writer has a list: it appends, and goes through it once, at the end."""

    def __init__(self, folder: Path) -> None:
        """The file without a name is in `folder`, and gone with the process."""
        self._kept = TemporaryFile(dir=folder)  # noqa: SIM115 - closed by `close`

    def stand_in(self, writer: Writer) -> None:
        """Takes the place of a new writer's list.

        Raises:
            AttributeError: If this version of the library has none of that name.
        """
        if getattr(writer, PRIVATE):
            raise ValueError("the writer has begun already")
        setattr(writer, PRIVATE, self)

    def append(self, index: ChunkIndex) -> None:
        """One more chunk.

        Raises:
            OSError: If the disk takes no more.
        """
        record = RecordBuilder()
        index.write(record)
        self._kept.write(record.end())  # type: ignore[no-untyped-call]

    def __iter__(self) -> Iterator[Block]:
        self._kept.seek(0)
        while block := self._kept.read(BLOCK_BYTES):
            yield Block(block)

    def close(self) -> None:
        """Lets the file go."""
        self._kept.close()


FRAME: Final = "park"
TOML: Final = "experiment.toml"
JSON: Final = "experiment.json"
METADATA: Final = "zenpark"
RUN: Final = "run"  # these stand where a robot's name would; no robot may be called so
WORLD: Final = "world"
CENTRE: Final = "centre"
CHUNK_BYTES: Final = 32 * 1024  # what a kill can cost: a third of a second of seven robots
LATEST_S: Final = 2.0**32  # a stamp beyond (the year 2106) is a broken clock; nanoseconds of it may not fit the file


class SentPose(msgspec.Struct, frozen=True):
    """A pose as it was sent, when the recorder got it (UTC [s]) and how many bytes its payload had."""

    robot: str
    seq: int
    stamp: float
    position: Vector
    velocity: Vector | None
    yaw: float | None
    received: float
    size: int


class SentGoal(msgspec.Struct, frozen=True):
    """A goal as it was sent, see `agents.network.messages.Goal`, when the recorder got it (UTC [s]) and its size
    [bytes].
    """

    robot: str
    seq: int
    stamp: float
    position: Vector
    yaw: float | None
    pose: float
    received: float
    size: int


class Recording:
    """Writes one recording; used by one thread.

    Attributes:
        path: Where it is written.
        refused: Messages that were left out, because they hold what their type excludes.
    """

    def __init__(
        self,
        path: Path,
        experiment: Experiment,
        document: str = "",
        *,
        case: str,
        seed: int,
        clock: Literal["real", "virtual"],
        started: float | None = None,
    ) -> None:
        """Creates the file.

        Args:
            path: A file that does not exist yet.
            experiment: The experiment of this case, overrides applied.
            document: The experiment file, as it was written.
            case: Name of the case.
            seed: Seed of this run.
            clock: Which clock the stamps come from.
            started: UTC time of the common start [s], if it is known already; the event `start` says it as well.

        Raises:
            RecordingError: If the file exists or cannot be written.
        """
        self.path = path
        self.refused = 0
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._latest = 0  # [ns]
        self._pose = _topic("pose", SentPose)
        self._state = _topic("state", State)
        self._status = _topic("status", Status)
        self._event = _topic("events", Event)
        self._clock = _topic("clock", HostClock)
        self._contact, self._world = _topic("contact", Contact), _topic("state", WorldState)
        self._goal, self._centre = _topic("goal", SentGoal), _topic("report", CentreState)
        self._drawn = _Topic("true_pose", POSE_STAMPED, POSE_STAMPED_SCHEMA, _drawing())
        self._over = ""  # why nothing more can be written
        try:
            self._file = _Unbuffered(path)
        except FileExistsError:
            raise RecordingError(f"{path}: exists already; move it away or record under another name") from None
        except OSError as error:
            raise RecordingError(f"{path}: cannot be created: {error.strerror}; record somewhere else") from error
        self._writer = Writer(cast(IO[bytes], self._file), chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._index = ChunkIndices(path.parent)
        self._index.stand_in(self._writer)
        about = {"case": case, "seed": str(seed), "clock": clock, "version": _version()}
        if started is not None:
            about["started"] = repr(started)
        try:
            self._guarded(self._begin, experiment, document, about)
        except RecordingError:
            self._let_go()
            raise

    def pose(self, pose: Pose, received: float, size: int) -> None:
        """Records a pose that was sent to the neighbours.

        Args:
            pose: What was sent.
            received: When the recorder got it, UTC [s].
            size: Of its payload on the network [bytes].

        Raises:
            RecordingError: If it cannot be written; what was written before stays.
        """
        sent = SentPose(pose.robot, pose.seq, pose.stamp, pose.position, pose.velocity, pose.yaw, received, size)
        self._record(self._pose, pose.robot, sent, received, pose.stamp, seq=pose.seq)

    def state(self, state: State) -> None:
        """Records telemetry, and for the viewers where the robot is, if known: the truth of a twin, else as measured.

        Raises:
            RecordingError: If it cannot be written; what was written before stays.
        """
        written = self._record(self._state, state.robot, state, state.stamp, state.stamp, seq=state.seq)
        if written and (state.true_position or state.position) is not None:
            self._record(self._drawn, state.robot, state, state.stamp, state.stamp, seq=state.seq)

    def status(self, status: Status) -> None:
        """Records lifecycle and counters.

        Raises:
            RecordingError: If it cannot be written; what was written before stays.
        """
        self._record(self._status, status.robot, status, status.stamp, status.stamp)

    def goal(self, goal: Goal, received: float, size: int) -> None:
        """Records a goal that was sent to a robot; see `pose`.

        Raises:
            RecordingError: If it cannot be written; what was written before stays.
        """
        sent = SentGoal(goal.robot, goal.seq, goal.stamp, goal.position, goal.yaw, goal.pose, received, size)
        self._record(self._goal, goal.robot, sent, received, goal.stamp, seq=goal.seq)

    def centre(self, said: CentreState) -> None:
        """Records what the centre says of itself.

        Raises:
            RecordingError: If it cannot be written; what was written before stays.
        """
        self._record(self._centre, CENTRE, said, said.stamp, said.stamp)

    def contact(self, contact: Contact) -> None:
        """Records the beginning of a contact in the world.

        Raises:
            RecordingError: If it cannot be written; what was written before stays.
        """
        self._record(self._contact, WORLD, contact, contact.stamp, contact.stamp)

    def world(self, said: WorldState) -> None:
        """Records what the world says of itself.

        Raises:
            RecordingError: If it cannot be written; what was written before stays.
        """
        self._record(self._world, WORLD, said, said.stamp, said.stamp)

    def clock(self, said: HostClock) -> None:
        """Records how another machine's clock lay to the conductor's.

        Raises:
            RecordingError: If it cannot be written; what was written before stays.
        """
        self._record(self._clock, RUN, said, said.stamp, said.stamp)

    def event(self, event: Event) -> None:
        """Records something that happened, and brings all so far to the disk: events are few, and explain the rest.

        Raises:
            RecordingError: If it cannot be written; what was written before stays.
        """
        self._record(self._event, "", event, event.stamp, event.stamp)
        self.flush()

    def flush(self) -> None:
        """Brings everything so far to the disk.

        Raises:
            RecordingError: If it cannot be written; what was written before stays.
        """
        self._guarded(self._writer.flush)

    def close(self) -> None:
        """Finishes the file; a second call does nothing. After a write error it stays unfinished, and recoverable.

        Raises:
            RecordingError: If the end cannot be written; what was written before stays.
        """
        try:
            if not self._over:
                self._guarded(self._writer.finish)
                self._over = f"{self.path}: the recording is closed"
        finally:
            self._let_go()

    def _let_go(self) -> None:
        self._file.close()
        self._index.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _begin(self, experiment: Experiment, document: str, about: dict[str, str]) -> None:
        self._writer.start(profile="ros2", library="zenpark")
        self._writer.add_attachment(0, 0, TOML, "application/toml", document.encode())
        self._writer.add_attachment(0, 0, JSON, "application/json", msgspec.json.encode(experiment))
        self._writer.add_metadata(METADATA, about)

    def _record(
        self, topic: _Topic, robot: str, message: msgspec.Struct, logged: float, published: float, *, seq: int = 0
    ) -> bool:
        """Whether the message was whole, and is written."""
        try:
            data = topic.encode(message)
        except Unencodable:
            self.refused += 1
            return False
        channel = self._channels.get((robot, topic.what)) or self._register(topic, robot)
        times = self._nanoseconds(logged), self._nanoseconds(published)
        self._guarded(self._writer.add_message, channel, times[0], data, times[1], seq & 0xFFFFFFFF)
        return True

    def _register(self, topic: _Topic, robot: str) -> int:
        if topic.name not in self._schemas:
            self._schemas[topic.name] = self._writer.register_schema(topic.name, "ros2msg", topic.schema.encode())
        name = f"/{robot}/{topic.what}" if robot else f"/{topic.what}"
        channel = self._writer.register_channel(name, "cdr", self._schemas[topic.name])
        self._channels[robot, topic.what] = channel
        return channel

    def _nanoseconds(self, stamp: float) -> int:
        if 0.0 <= stamp < LATEST_S:
            self._latest = round(stamp * 1e9)
        return self._latest  # a broken clock must not stretch the time line of the whole file

    def _guarded(self, write: Callable[..., object], *what: object) -> None:
        """Writes. No writer survives an error or interrupt in the middle: the file then stays unfinished."""
        if self._over:
            raise RecordingError(self._over)
        self._over = f"{self.path}: the recorder was interrupted while it wrote; run `zenpark recover` on the file"
        try:
            write(*what)
        except OSError as error:
            self._over = (
                f"{self.path}: cannot be written: {error.strerror}; what was recorded so far is kept: "
                "make room, then run `zenpark recover` on it"
            )
            raise RecordingError(self._over) from error
        self._over = ""


@dataclass(frozen=True)
class _Topic:
    """What is written where, for one robot or for all."""

    what: str
    name: str
    schema: str
    encode: Callable[[Any], bytes]


def _topic(what: str, kind: type[msgspec.Struct]) -> _Topic:
    made = codec(kind)
    return _Topic(what, made.name, made.schema, made.encode)


def _drawing() -> Callable[[State], bytes]:
    """From a state to the pose that a viewer draws."""
    encode = pose_stamped(FRAME)

    def drawn(state: State) -> bytes:
        place = state.position if state.true_position is None else state.true_position
        yaw = state.yaw if state.true_yaw is None else state.true_yaw
        assert place is not None
        return encode(state.stamp, place, yaw or 0.0, state.attitude)

    return drawn


class _Unbuffered:
    """A file whose every write is the kernel's when it returns, so that a kill loses none of it.

    Not a `RawIOBase`: around one of those, `mcap` puts a buffer.
    """

    def __init__(self, path: Path) -> None:
        self._raw = path.open("xb", buffering=0)

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while rest:  # a disk that is nearly full takes a part, and refuses only the next
            rest = rest[self._raw.write(rest) :]
        return len(data)

    def tell(self) -> int:
        return self._raw.tell()

    def flush(self) -> None:
        pass

    def close(self) -> None:
        self._raw.close()


def _version() -> str:
    try:
        return version("zenpark")
    except PackageNotFoundError:
        return "unknown"
