"""Writes the recording of one case: an MCAP file that describes itself and survives a killed recorder."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import inf
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any, Final, Literal, Self, cast

import msgspec
from mcap._chunk_builder import ChunkBuilder
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, MessageIndex, Statistics
from mcap.writer import CompressionType, Writer

from agents.body.kinds import KINDS, RecordedKind
from agents.network.messages import BareGoal, BarePose, Event, Goal, Pose, State, Vector
from experiments.definition.plan import Plan
from experiments.recording import version
from experiments.recording.reader import RecordingError
from experiments.recording.ros2 import viewers
from experiments.recording.ros2.cdr import Unencodable, codec
from experiments.recording.ros2.viewers import Draw
from experiments.recording.topics import CHUNK_BYTES, JSON, KINDS_JSON, METADATA, SPOKEN, TOML, TOPICS, Message

BLOCK_BYTES: Final = 1024 * 1024
INDICES: Final = "_Writer__chunk_indices"  # as of mcap 1.6; the library has no public place for it
CHUNK, STATISTICS = "_Writer__chunk_builder", "_Writer__statistics"  # nor for these


class ChunkIndices:
    """Chunk indices in an unnamed file, in place of the writer's list, which grows in memory with the recording."""

    def __init__(self, folder: Path, writer: Writer) -> None:
        """Takes the place of a new writer's list; the file without a name is in `folder`, and gone with the process."""
        self._kept = TemporaryFile(dir=folder)  # noqa: SIM115 - closed by `close`
        self.end = 0  # [ns] latest log time in the chunks so far
        assert getattr(writer, INDICES) == [], "another version of mcap"
        setattr(writer, INDICES, self)

    def append(self, index: ChunkIndex) -> None:
        """Keeps the index of a chunk."""
        self.end = max(self.end, index.message_end_time)
        record = RecordBuilder()
        index.write(record)
        self._kept.write(record.end())

    def __iter__(self) -> Iterator[ChunkIndices]:
        yield self  # all at once, see `write`

    def write(self, stream: RecordBuilder) -> None:
        """Adds all indices to the summary."""
        self._kept.seek(0)
        while block := self._kept.read(BLOCK_BYTES):
            stream.write(block)

    def close(self) -> None:
        """Close the file, which is then deleted."""
        self._kept.close()


class Chunk(ChunkBuilder):
    """Chunk in progress, in place of the writer's own: adds a message in a fifth of the library's time."""

    HEAD: Final = struct.Struct("<BQHIQQ")  # a message's record up to its data

    def __init__(self, writer: Writer, size: int = CHUNK_BYTES) -> None:
        """Takes the place of a new writer's chunk; it is full at this size [bytes]."""
        super().__init__()
        self.full = False
        self._size = size
        self._statistics: Statistics = getattr(writer, STATISTICS)
        setattr(writer, CHUNK, self)

    def add(self, channel: int, logged: int, data: bytes, stamp: int, number: int) -> None:
        """Adds a message with its log time and stamp [ns], and its entry in the index."""
        if not self.num_messages or logged < self.message_start_time:
            self.message_start_time = logged
        self.message_end_time = max(self.message_end_time, logged)
        index = self.message_indices.get(channel)
        if index is None:
            index = self.message_indices[channel] = _MessageIndex(channel, [])
        offset, length = self.count, len(data) + self.HEAD.size
        index.records.append((logged, offset))
        self.num_messages += 1
        # its opcode and the length itself, 9 bytes, are not in the length
        self.record_writer.write(self.HEAD.pack(Opcode.MESSAGE, length - 9, channel, number, logged, stamp) + data)
        self.full = offset + length > self._size

    def reset(self) -> None:
        """Counts the messages of a chunk that was taken by `end` and written, and begins the next."""
        counted = self._statistics
        first = min(counted.message_start_time, self.message_start_time)
        counted.message_start_time = first if counted.message_count else self.message_start_time
        counted.message_end_time = max(counted.message_end_time, self.message_end_time)
        counted.message_count += self.num_messages
        for channel, index in self.message_indices.items():
            counted.channel_message_counts[channel] += len(index.records)
        self.message_start_time = self.message_end_time = self.num_messages = 0
        self.message_indices.clear()
        self.full = False


class _MessageIndex(MessageIndex):
    def write(self, stream: RecordBuilder) -> None:
        """Write all entries at once."""
        numbers = [number for entry in self.records for number in entry]
        head = (Opcode.MESSAGE_INDEX, 6 + 8 * len(numbers), self.channel_id, 8 * len(numbers))
        stream.write(struct.pack(f"<BQHI{len(numbers)}Q", *head, *numbers))


DRAWN: Final = "/{robot}/true_pose"
FRAMES: Final = "/tf"
SCENE: Final = "/scene"
FRAMES_S: Final = 0.04  # between two transforms of a robot [s]
SCENE_S: Final = 0.2  # between two drawings of the scene [s]
LATE_S: Final = 2.0  # a message that came later than so long after its stamp has a clock that is wrong [s]
ROUNDING_S: Final = 1e-6
LATEST_S: Final = 2.0**32  # a stamp beyond (the year 2106) is a broken clock; nanoseconds of it may not fit the file


BARE: Final = {Pose: len(BarePose.__struct_fields__), Goal: len(BareGoal.__struct_fields__)}


def _spoken(message: Message) -> dict[str, Any]:
    return {"shared": message.shared} if isinstance(message, Pose) and message.shared else {}


class Recording:
    """Writes one recording; used by one thread."""

    def __init__(
        self,
        path: Path,
        plan: Plan,
        document: str = "",
        *,
        case: str,
        seed: int,
        clock: Literal["real", "virtual"],
        started: float | None = None,
        draw: Draw | None = None,
        utc: Callable[[], float] | None = None,
        chunk_bytes: int = CHUNK_BYTES,
    ) -> None:
        """Creates the file; raises RecordingError if the file exists or cannot be written.

        Args:
            path: A file that does not exist yet.
            started: UTC time of the common start [s], if it is known already; the event `start` says it as well.
            draw: Draws the scene for viewers.
            utc: Clock of the recorder [s]: nothing is logged later than it came. Without one, messages come in order.
            chunk_bytes: Messages that are written together, and lost together by a kill [bytes].
        """
        self.path = path
        self.refused = 0  # messages left out, because they hold what their type excludes
        self._channels: dict[tuple[str, str], int] = {}  # by topic and robot
        self._schemas: dict[str, int] = {}
        self._stamp = -inf  # [s, UTC] the last good one
        self._latest = 0  # [ns] the same
        self._utc, self._draw = utc, draw
        self._places: dict[str, Vector] = {}  # [m] of each robot, the last known
        self._framed: dict[str, float] = {}  # [s, UTC] stamp of its last transform, by robot
        self._scene_at = -inf  # [s, UTC]
        self._topics = {
            topic: (topic.recorded, _Written(topic.name, made.name, made.schema, made.encode))
            for topic in TOPICS
            for made in [codec(topic.recorded)]
        }
        self._topic_of = {topic.message: topic for topic in TOPICS if topic is not SPOKEN}
        self._drawn = _Written(DRAWN, viewers.POSE, viewers.POSE_SCHEMA, viewers.pose)
        self._frames = _Written(FRAMES, viewers.TF, viewers.TF_SCHEMA, viewers.transform)
        self._scene = _Written(
            SCENE, viewers.MARKERS, viewers.MARKERS_SCHEMA, lambda drawn: viewers.markers(self._scene_at, drawn)
        )
        self._over = ""  # why nothing more can be written
        try:
            self._file = _Unbuffered(path)
        except FileExistsError:
            raise RecordingError(f"{path}: exists already; move it away or record under another name") from None
        except OSError as error:
            raise RecordingError(f"{path}: cannot be created: {error.strerror}; record somewhere else") from error
        self._writer = Writer(cast(IO[bytes], self._file), chunk_size=chunk_bytes, compression=CompressionType.ZSTD)
        self._chunk = Chunk(self._writer, chunk_bytes)
        self._index = ChunkIndices(path.parent, self._writer)
        made = version.provenance()
        about = {"case": case, "seed": str(seed), "clock": clock, "version": made.zenpark}
        about |= {"code": made.code, "commit": made.commit, "python": made.python, "host": made.host, "cpu": made.cpu}
        about |= made.packages | made.plugins
        if started is not None:
            about["started"] = repr(started)
        try:
            self._write_or_fail(self._begin, plan, document, about)
        except RecordingError:
            self._close_file()
            raise

    def write(self, message: Message, received: float | None = None, size: int = 0) -> None:
        """Records a message. An event brings everything so far to the disk: events are few, and explain the rest.

        With a state, its place goes to the viewers' topics if it is known: the truth of a twin, else as measured.

        Args:
            received: When the recorder got it, UTC [s]; of poses and goals.
            size: Of its payload on the network [bytes]; of poses and goals.

        Raises:
            RecordingError: If it cannot be written; what was written before stays.
        """
        chosen, entry = self._topic_of[type(message)], cast(Any, message)
        if isinstance(message, Pose) and message.shared:
            chosen = SPOKEN
        recorded, topic = self._topics[chosen]
        if received is not None:
            values = msgspec.structs.astuple(message)
            if isinstance(message, Pose | Goal):
                values = values[: BARE[type(message)]]
            entry = recorded(*values, received=received, size=size, **_spoken(message))
        logged = message.stamp if received is None else received
        if self._utc is not None and received is None:
            now = self._utc()
            logged = min(now, max(now - LATE_S, logged))
        written = self._record(topic, message, entry, logged)
        if isinstance(message, State):
            if written:
                self._show(message, logged)
        elif isinstance(message, Event):
            self.flush()

    def _show(self, state: State, logged: float) -> None:
        """Writes a state for viewers: pose, transform, and now and then the scene."""
        place = state.position if state.true_position is None else state.true_position
        if place is None:
            return
        self._record(self._drawn, state, state, logged)
        self._places[state.robot] = place
        if not -FRAMES_S < logged - self._framed.get(state.robot, -inf) < FRAMES_S - ROUNDING_S:
            self._framed[state.robot] = logged
            self._record(self._frames, state, state, logged)
        if self._draw is not None and not -SCENE_S < logged - self._scene_at < SCENE_S - ROUNDING_S:
            self._scene_at = logged
            drawn = self._draw(logged, self._places)
            self._record(self._scene, state, drawn, logged)

    def flush(self) -> None:
        """Brings everything so far to the disk."""
        self._write_or_fail(self._writer.flush)

    def close(self) -> None:
        """Finishes the file; a second call does nothing. After a write error it stays unfinished, and recoverable."""
        try:
            if not self._over:
                self._write_or_fail(self._writer.finish)
                self._over = f"{self.path}: the recording is closed"
        finally:
            self._close_file()

    def _close_file(self) -> None:
        self._file.close()
        self._index.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _begin(self, plan: Plan, document: str, about: dict[str, str]) -> None:
        experiment = plan.experiment
        self._writer.start(profile="ros2", library="zenpark")
        self._writer.add_attachment(0, 0, TOML, "application/toml", document.encode())
        self._writer.add_attachment(0, 0, JSON, "application/json", msgspec.json.encode(experiment))
        names = sorted({robot.kind for robot in (*experiment.robots.values(), *experiment.spares.values())})
        figures = [RecordedKind.of(KINDS[name]) for name in names if name in KINDS]
        self._writer.add_attachment(0, 0, KINDS_JSON, "application/json", msgspec.json.encode(figures))
        self._writer.add_metadata(METADATA, about)

    def _record(self, topic: _Written, message: Message, entry: object, logged: float) -> bool:
        """Write a message; False if it could not be encoded."""
        try:
            data = topic.encode(entry)
        except Unencodable:
            self.refused += 1
            return False
        robot = getattr(message, "robot", "")
        channel = self._channels.get((topic.name, robot)) or self._register(topic, robot)
        begun = self._nanoseconds(logged)
        stamp = begun if message.stamp == logged else self._nanoseconds(message.stamp)
        number = getattr(message, "seq", 0) & 0xFFFFFFFF
        if self._over:
            raise RecordingError(self._over)
        try:
            # chunks in order of time, as viewers want them: what was late by a moment joins the present chunk
            self._chunk.add(channel, max(self._index.end, begun), data, stamp, number)
        except BaseException:
            self._over = self._interrupted
            raise
        if self._chunk.full:
            self.flush()
        return True

    def _register(self, topic: _Written, robot: str) -> int:
        if topic.kind not in self._schemas:
            self._schemas[topic.kind] = self._writer.register_schema(topic.kind, "ros2msg", topic.schema.encode())
        channel = self._writer.register_channel(topic.name.format(robot=robot), "cdr", self._schemas[topic.kind])
        self._channels[topic.name, robot] = channel
        return channel

    def _nanoseconds(self, stamp: float) -> int:
        if stamp != self._stamp and 0.0 <= stamp < LATEST_S:
            self._stamp, self._latest = stamp, round(stamp * 1e9)
        return self._latest  # a broken clock must not stretch the time line of the whole file

    def _write_or_fail(self, write: Callable[..., object], *what: object) -> None:
        """Writes. No writer survives an error or interrupt in the middle: the file then stays unfinished."""
        if self._over:
            raise RecordingError(self._over)
        try:
            write(*what)
        except OSError as error:
            self._over = (
                f"{self.path}: cannot be written: {error.strerror}; what was recorded so far is kept: "
                "make room, then run `./zenpark recover` on it"
            )
            raise RecordingError(self._over) from error
        except BaseException:
            self._over = self._interrupted
            raise

    @property
    def _interrupted(self) -> str:
        return f"{self.path}: the recorder was interrupted while it wrote; run `./zenpark recover` on the file"


@dataclass(frozen=True)
class _Written:
    """A topic as the file has it."""

    name: str  # with `{robot}` for the robot's name
    kind: str  # the ROS 2 type
    schema: str
    encode: Callable[[Any], bytes]


class _Unbuffered:
    """An unbuffered file: a write is the kernel's when it returns, so that a kill loses none of it.

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
