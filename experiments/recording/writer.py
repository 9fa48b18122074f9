"""Writes the recording of one case: an MCAP file that describes itself and survives a killed recorder."""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from io import FileIO
from math import inf
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, Final, Literal, Self, cast

import msgspec
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

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
HEAD: Final = struct.Struct("<BQHIQQ")  # a message's record up to its data
# records that the summary repeats, in groups of this order
GROUPS: Final = (
    Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
)  # fmt: skip


class McapFile:
    """An MCAP file in chunks of messages with their schemas and channels; attachments and metadata lie before them.

    The library's own writer takes five times as long for a message, and its memory grows with the recording.
    """

    def __init__(self, file: _Unbuffered, folder: Path, chunk_bytes: int) -> None:
        """Keep indices of chunks in a file without a name in `folder`, gone with the process."""
        self.full = False  # the chunk in progress has its size
        self.end = 0  # [ns] latest log time in the finished chunks
        self._file, self._size = file, chunk_bytes
        self._chunk, self._index = RecordBuilder(), dict[int, list[int]]()  # log times [ns] and offsets, by channel
        self._first = self._last = 0  # [ns] log times in the chunk
        self._summary = {group: RecordBuilder() for group in GROUPS}
        self._indices = TemporaryFile(dir=folder)  # noqa: SIM115 - closed by `close`
        self._counted = Statistics(0, 0, Counter(), 0, 0, 0, 0, 0, 0)

    def start(self) -> None:
        """Write the head."""
        self._file.write(MCAP0_MAGIC)
        self._put(Header(profile="ros2", library="zenpark"))

    def attach(self, name: str, kind: str, data: bytes) -> None:
        """Write an attachment."""
        offset, length = self._put(Attachment(0, 0, name, kind, data))
        AttachmentIndex(offset, length, 0, 0, len(data), name, kind).write(self._summary[Opcode.ATTACHMENT_INDEX])
        self._counted.attachment_count += 1

    def describe(self, name: str, about: dict[str, str]) -> None:
        """Write metadata."""
        offset, length = self._put(Metadata(name, about))
        MetadataIndex(offset, length, name).write(self._summary[Opcode.METADATA_INDEX])
        self._counted.metadata_count += 1

    def register_schema(self, name: str, schema: str) -> int:
        """Number of a new schema, in ROS 2's language."""
        self._counted.schema_count += 1
        made = Schema(data=schema.encode(), encoding="ros2msg", id=self._counted.schema_count, name=name)
        for place in (self._chunk, self._summary[Opcode.SCHEMA]):
            made.write(place)
        return made.id

    def register_channel(self, topic: str, schema: int) -> int:
        """Number of a new channel of messages in CDR."""
        self._counted.channel_count += 1
        made = Channel(self._counted.channel_count, topic, "cdr", {}, schema)
        for place in (self._chunk, self._summary[Opcode.CHANNEL]):
            made.write(place)
        return made.id

    def add(self, channel: int, logged: int, data: bytes, stamp: int, number: int) -> None:
        """Add a message with its log time and stamp [ns] to the chunk in progress."""
        self._first = min(self._first, logged) if self._index else logged
        self._last = max(self._last, logged)
        offset, length = self._chunk.count, len(data) + HEAD.size
        self._index.setdefault(channel, []).extend((logged, offset))
        # its opcode and the length itself, 9 bytes, are not in the length
        self._chunk.write(HEAD.pack(Opcode.MESSAGE, length - 9, channel, number, logged, stamp) + data)
        self.full = offset + length > self._size

    def flush(self) -> None:
        """Write the chunk in progress, unless it is without messages."""
        if not self._index:
            return
        data = self._chunk.end()
        packed, size = zstandard.compress(data), len(data)
        offset, length = self._put(Chunk("zstd", packed, self._last, self._first, zlib.crc32(data), size))
        begin, indices = self._file.tell(), RecordBuilder()
        offsets = dict[int, int]()
        for channel, numbers in self._index.items():
            offsets[channel] = begin + indices.count
            head = (Opcode.MESSAGE_INDEX, 6 + 8 * len(numbers), channel, 8 * len(numbers))
            indices.write(struct.pack(f"<BQHI{len(numbers)}Q", *head, *numbers))
            self._counted.channel_message_counts[channel] += len(numbers) // 2
            self._counted.message_count += len(numbers) // 2
        written, record = indices.end(), RecordBuilder()
        self._file.write(written)
        ChunkIndex(length, offset, "zstd", len(packed), self._last, len(written), offsets, self._first, size).write(
            record
        )
        self._indices.write(record.end())
        counted = self._counted
        first = min(counted.message_start_time, self._first) if counted.chunk_count else self._first
        counted.message_start_time, counted.message_end_time = first, max(counted.message_end_time, self._last)
        counted.chunk_count += 1
        self.end = max(self.end, self._last)
        self._last, self.full = 0, False
        self._index.clear()

    def finish(self) -> None:
        """Write the last chunk and the summary."""
        self.flush()
        self._put(DataEnd(0))
        self._counted.write(self._summary[Opcode.STATISTICS])
        begin, sum_ = self._file.tell(), 0
        offsets = RecordBuilder()
        self._indices.seek(0)
        for group in GROUPS:
            start, kept = self._file.tell(), self._summary[group].end()
            for block in iter(partial(self._indices.read, BLOCK_BYTES), b"") if group == Opcode.CHUNK_INDEX else [kept]:
                self._file.write(block)
                sum_ = zlib.crc32(block, sum_)
            SummaryOffset(group, start, self._file.tell() - start).write(offsets)
        # the footer's sum of the summary covers its own fields before that sum
        end = offsets.end() + struct.pack("<BQQQ", Opcode.FOOTER, 20, begin, self._file.tell())
        self._file.write(end + struct.pack("<I", zlib.crc32(end, sum_)) + MCAP0_MAGIC)

    def close(self) -> None:
        """Close the file of the indices, which is then deleted, and the file itself."""
        with suppress(OSError):  # raised by a full disk; it is not read any more
            self._indices.close()
        self._file.close()

    def _put(self, record: McapRecord) -> tuple[int, int]:
        """Write a record; return where it begins, and its length."""
        built, offset = RecordBuilder(), self._file.tell()
        record.write(built)
        return offset, self._file.write(built.end())


DRAWN: Final = "/{robot}/true_pose"
FRAMES: Final = "/tf"
SCENE: Final = "/scene"
FRAMES_S: Final = 0.04  # pause of two transforms of a robot [s]
SCENE_S: Final = 0.2  # pause of two drawings of the scene [s]
LATE_S: Final = 2.0  # age of a message on arrival above which its clock is wrong [s]
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
        self._channels: dict[tuple[str, str], int] = {}  # channels by topic and robot, if the topic is of one
        self._schemas: dict[str, int] = {}
        self._stamp = -inf  # [s, UTC] the last good one
        self._latest = 0  # [ns] the same
        self._utc, self._draw = utc, draw
        self._places: dict[str, Vector] = {}  # [m] place of each robot, the last known
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
            file = _Unbuffered(path, "xb")
        except FileExistsError:
            raise RecordingError(f"{path}: exists already; move it away or record under another name") from None
        except OSError as error:
            raise RecordingError(f"{path}: cannot be created: {error.strerror}; record somewhere else") from error
        try:
            self._file = McapFile(file, path.parent, chunk_bytes)
        except OSError as error:
            file.close()
            path.unlink()
            raise RecordingError(
                f"{path.parent}: holds no recording: {error.strerror}; record somewhere else"
            ) from error
        made = version.provenance()
        about = {"case": case, "seed": str(seed), "clock": clock, "version": made.zenpark}
        about |= {"code": made.code, "commit": made.commit, "python": made.python, "host": made.host, "cpu": made.cpu}
        about |= made.packages | made.plugins
        if started is not None:
            about["started"] = repr(started)
        try:
            self._write_or_fail(self._begin, plan, document, about)
        except RecordingError:
            self._file.close()
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
        self._write_or_fail(self._file.flush)

    def close(self) -> None:
        """Finishes the file; a second call does nothing. After a write error it stays unfinished, and recoverable."""
        try:
            if not self._over:
                self._write_or_fail(self._file.finish)
                self._over = f"{self.path}: the recording is closed"
        finally:
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _begin(self, plan: Plan, document: str, about: dict[str, str]) -> None:
        experiment = plan.experiment
        self._file.start()
        self._file.attach(TOML, "application/toml", document.encode())
        self._file.attach(JSON, "application/json", msgspec.json.encode(experiment))
        names = sorted({robot.kind for robot in (*experiment.robots.values(), *experiment.spares.values())})
        figures = [RecordedKind.of(KINDS[name]) for name in names if name in KINDS]
        self._file.attach(KINDS_JSON, "application/json", msgspec.json.encode(figures))
        self._file.describe(METADATA, about)

    def _record(self, topic: _Written, message: Message, entry: object, logged: float) -> bool:
        """Write a message; False if it could not be encoded."""
        try:
            data = topic.encode(entry)
        except Unencodable:
            self.refused += 1
            return False
        # one channel for each topic: readers that look a topic up take the first of its channels alone
        robot = getattr(message, "robot", "") if "{robot}" in topic.name else ""
        channel = self._channels.get((topic.name, robot)) or self._register(topic, robot)
        begun = self._nanoseconds(logged)
        stamp = begun if message.stamp == logged else self._nanoseconds(message.stamp)
        number = getattr(message, "seq", 0) & 0xFFFFFFFF
        if self._over:
            raise RecordingError(self._over)
        try:
            # chunks in order of time, as viewers want them: what was late by a moment joins the present chunk
            self._file.add(channel, max(self._file.end, begun), data, stamp, number)
        except BaseException:
            self._over = self._interrupted
            raise
        if self._file.full:
            self.flush()
        return True

    def _register(self, topic: _Written, robot: str) -> int:
        if topic.kind not in self._schemas:
            self._schemas[topic.kind] = self._file.register_schema(topic.kind, topic.schema)
        channel = self._file.register_channel(topic.name.format(robot=robot), self._schemas[topic.kind])
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
                "make room, then `./zenpark export` repairs it"
            )
            raise RecordingError(self._over) from error
        except BaseException:
            self._over = self._interrupted
            raise

    @property
    def _interrupted(self) -> str:
        return f"{self.path}: the recorder was interrupted while it wrote; `./zenpark export` repairs the file"


@dataclass(frozen=True)
class _Written:
    """A topic as the file has it."""

    name: str  # name with `{robot}` for the robot's name
    kind: str  # the ROS 2 type
    schema: str
    encode: Callable[[Any], bytes]


class _Unbuffered(FileIO):
    """An unbuffered file: a write is the kernel's when it returns, so that a kill loses none of it."""

    def write(self, data: bytes) -> int:  # type: ignore[override]
        rest = memoryview(data)
        while rest:  # a disk that is nearly full takes a part, and refuses only the next
            rest = rest[super().write(rest) :]
        return len(data)
