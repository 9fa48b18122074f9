"""Writes the recording of one case: an MCAP file that describes itself and survives a killed recorder."""

from __future__ import annotations

import struct
import zlib
from collections import Counter, defaultdict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from io import FileIO
from math import inf
from pathlib import Path
from tempfile import TemporaryFile
from typing import Final, Literal, Self

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
from agents.network import messages
from agents.network.messages import Event, Goal, Pose, State, Vector
from agents.ticks import ROUNDING_S
from experiments.definition.plan import Plan
from experiments.recording import version
from experiments.recording.reader import RecordingError
from experiments.recording.ros2 import payload, viewers
from experiments.recording.ros2.viewers import Draw
from experiments.recording.topics import CHUNK_BYTES, JSON, KINDS_JSON, METADATA, TOML, TOPICS, Message

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
        self._chunk, self._index = bytearray(), defaultdict[int, list[int]](list)  # log times [ns], offsets, by channel
        self._summary = {group: bytearray() for group in GROUPS}
        self._compressor = zstandard.ZstdCompressor()  # reused: its tables take three times as long as a chunk
        self._indices = TemporaryFile(dir=folder)  # noqa: SIM115 - closed by `close`
        self._counted = Statistics(0, 0, Counter(), 0, 0, 0, 0, 0, 0)

    def start(self) -> None:
        """Write the head."""
        self._file.write(MCAP0_MAGIC)
        self._put(Header(profile="ros2", library="zenpark"))

    def attach(self, name: str, kind: str, data: bytes) -> None:
        """Write an attachment."""
        offset, length = self._put(Attachment(0, 0, name, kind, data))
        index = AttachmentIndex(offset, length, 0, 0, len(data), name, kind)
        self._summary[Opcode.ATTACHMENT_INDEX] += _encoded(index)
        self._counted.attachment_count += 1

    def describe(self, name: str, about: dict[str, str]) -> None:
        """Write metadata."""
        offset, length = self._put(Metadata(name, about))
        self._summary[Opcode.METADATA_INDEX] += _encoded(MetadataIndex(offset, length, name))
        self._counted.metadata_count += 1

    def register_schema(self, name: str, schema: str) -> int:
        """Number of a new schema, in ROS 2's language."""
        self._counted.schema_count += 1
        made = _encoded(Schema(self._counted.schema_count, schema.encode(), "ros2msg", name))
        self._chunk += made
        self._summary[Opcode.SCHEMA] += made
        return self._counted.schema_count

    def register_channel(self, topic: str, schema: int) -> int:
        """Number of a new channel of messages in CDR."""
        self._counted.channel_count += 1
        made = _encoded(Channel(self._counted.channel_count, topic, "cdr", {}, schema))
        self._chunk += made
        self._summary[Opcode.CHANNEL] += made
        return self._counted.channel_count

    def add(self, channel: int, logged: int, data: bytes, stamp: int, number: int) -> None:
        """Add a message with its log time and stamp [ns] to the chunk in progress."""
        offset, length = len(self._chunk), len(data) + HEAD.size
        # its opcode and the length itself, 9 bytes, are not in the length
        self._chunk += HEAD.pack(Opcode.MESSAGE, length - 9, channel, number, logged, stamp)
        self._chunk += data
        self._index[channel] += (logged, offset)
        self.full = offset + length > self._size

    def flush(self) -> None:
        """Write the chunk in progress, unless it is without messages."""
        if not self._index:
            return
        data, times = bytes(self._chunk), [time for numbers in self._index.values() for time in numbers[::2]]
        packed, size = self._compressor.compress(data), len(data)
        first, last = min(times), max(times)
        offset, length = self._put(Chunk("zstd", packed, last, first, zlib.crc32(data), size))
        begin, indices = self._file.tell(), bytearray()
        offsets = dict[int, int]()
        for channel, numbers in self._index.items():
            offsets[channel] = begin + len(indices)
            head = (Opcode.MESSAGE_INDEX, 6 + 8 * len(numbers), channel, 8 * len(numbers))
            indices += struct.pack(f"<BQHI{len(numbers)}Q", *head, *numbers)
            self._counted.channel_message_counts[channel] += len(numbers) // 2
        self._file.write(indices)
        index = ChunkIndex(length, offset, "zstd", len(packed), last, len(indices), offsets, first, size)
        self._indices.write(_encoded(index))
        counted = self._counted
        counted.message_count += len(times)
        counted.message_start_time = min(counted.message_start_time, first) if counted.chunk_count else first
        counted.message_end_time = max(counted.message_end_time, last)
        counted.chunk_count += 1
        self.end = max(self.end, last)
        self.full = False
        self._chunk.clear()
        self._index.clear()

    def finish(self) -> None:
        """Write the last chunk and the summary."""
        self.flush()
        self._put(DataEnd(0))
        self._summary[Opcode.STATISTICS] += _encoded(self._counted)
        begin, sum_ = self._file.tell(), 0
        offsets = bytearray()
        self._indices.seek(0)
        for group in GROUPS:
            start, kept = self._file.tell(), self._summary[group]
            for block in iter(partial(self._indices.read, BLOCK_BYTES), b"") if group == Opcode.CHUNK_INDEX else [kept]:
                self._file.write(block)
                sum_ = zlib.crc32(block, sum_)
            offsets += _encoded(SummaryOffset(group, start, self._file.tell() - start))
        # the footer's sum of the summary covers its own fields before that sum
        end = offsets + struct.pack("<BQQQ", Opcode.FOOTER, 20, begin, self._file.tell())
        self._file.write(end + struct.pack("<I", zlib.crc32(end, sum_)) + MCAP0_MAGIC)

    def close(self) -> None:
        """Close the file of the indices, which is then deleted, and the file itself."""
        with suppress(OSError):  # raised by a full disk; it is not read any more
            self._indices.close()
        self._file.close()

    def _put(self, record: McapRecord) -> tuple[int, int]:
        """Write a record; return where it begins, and its length."""
        return self._file.tell(), self._file.write(_encoded(record))


def _encoded(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


DRAWN: Final = "/{robot}/true_pose"
FRAMES: Final = "/tf"
SCENE: Final = "/scene"
FRAMES_S: Final = 0.04  # pause of two transforms of a robot [s]
SCENE_S: Final = 0.2  # pause of two drawings of the scene [s]
LATE_S: Final = 2.0  # age of a message on arrival above which its clock is wrong [s]
LATEST_S: Final = 2.0**32  # a stamp beyond (the year 2106) is a broken clock; nanoseconds of it may not fit the file


@dataclass
class _Written:
    """A topic as the file has it."""

    name: str  # name with `{robot}` for the robot's name
    kind: str  # the ROS 2 type
    schema: str
    channels: dict[str, int] = field(default_factory=dict)  # number by robot


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
        show: Callable[[bytes], object] | None = None,
        utc: Callable[[], float] | None = None,
        chunk_bytes: int = CHUNK_BYTES,
    ) -> None:
        """Creates the file; raises RecordingError if the file exists or cannot be written.

        Args:
            path: A file that does not exist yet.
            started: UTC time of the common start [s], if it is known already; the event `start` says it as well.
            draw: Draws the scene for viewers.
            show: Receives each of these drawings, a MarkerArray as CDR.
            utc: Clock of the recorder [s]: nothing is logged later than it came. Without one, messages come in order.
            chunk_bytes: Messages that are written together, and lost together by a kill [bytes].
        """
        self.path = path
        self._schemas: dict[str, int] = {}
        self._stamp = -inf  # [s, UTC] the last good one
        self._latest = 0  # [ns] the same
        self._utc, self._draw, self._show_scene = utc, draw, show
        self._places: dict[str, Vector] = {}  # [m] place of each robot, the last known
        self._framed: dict[str, float] = {}  # [s, UTC] stamp of its last transform, by robot
        self._scene_at = -inf  # [s, UTC]
        self._chosen = plan.experiment.network.encoding
        self._kinds = {topic.message: topic for topic in TOPICS}
        self._topics = {
            (kind, each): _Written(topic.name, payload.type_name(kind, each), payload.schema(kind, each))
            for kind, topic in self._kinds.items()
            for each in payload.NAMES
        }
        self._poses = _Written(DRAWN, viewers.POSE, viewers.POSE_SCHEMA)
        self._transforms = _Written(FRAMES, viewers.TF, viewers.TF_SCHEMA)
        self._scenes = _Written(SCENE, viewers.MARKERS, viewers.MARKERS_SCHEMA)
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

    def write(
        self, message: Message, data: bytes | None = None, mime: str = "", *, logged: float | None = None
    ) -> None:
        """Records a message. An event brings everything so far to the disk: events are few, and explain the rest.

        With a state, its place goes to the viewers' topics if it is known: the truth of a twin, else as measured.

        Args:
            data: Its payload on the network; None: the message is encoded.
            mime: MIME type of the payload; empty: that of the experiment.
            logged: Log time, UTC [s]. None: a pose or a goal is logged when it came, other messages at their stamps.

        Raises:
            RecordingError: If it cannot be written; what was written before stays.
        """
        kind = type(message)
        encoding = messages.encoding_of(mime) if mime else self._chosen if self._kinds[kind].packed else "json"
        if data is None:
            data = messages.encode(message, encoding)
        if logged is None:
            logged = message.stamp
            if self._utc is not None:
                now = self._utc()
                logged = now if kind in (Pose, Goal) else min(now, max(now - LATE_S, logged))
        begun = self._nanoseconds(logged)
        stamp = begun if message.stamp == logged else self._nanoseconds(message.stamp)
        times = begun, stamp, getattr(message, "seq", 0) & 0xFFFFFFFF
        robot = getattr(message, "robot", "")
        self._add(self._topics[kind, encoding], robot, payload.wrap(data, encoding), times)
        if isinstance(message, State):
            self._show(message, logged, times)
        elif isinstance(message, Event):
            self.flush()

    def _show(self, state: State, logged: float, times: tuple[int, int, int]) -> None:
        """Writes a state for viewers: pose, transform, and now and then the scene; all have its times and number."""
        place = state.position if state.true_position is None else state.true_position
        if place is None:
            return
        with suppress(viewers.Unencodable):
            self._add(self._poses, state.robot, viewers.pose(state), times)
            self._places[state.robot] = place
            if not -FRAMES_S < logged - self._framed.get(state.robot, -inf) < FRAMES_S - ROUNDING_S:
                self._framed[state.robot] = logged
                self._add(self._transforms, "", viewers.transform(state), times)
            if self._draw is not None and not -SCENE_S < logged - self._scene_at < SCENE_S - ROUNDING_S:
                self._scene_at = logged
                drawn = viewers.markers(logged, self._draw(logged, self._places))
                self._add(self._scenes, "", drawn, times)
                if self._show_scene is not None:
                    self._show_scene(drawn)

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

    def _add(self, topic: _Written, robot: str, data: bytes, times: tuple[int, int, int]) -> None:
        """`times`: log time and stamp [ns], and the number of the message."""
        # one channel for each topic: readers that look a topic up take the first of its channels alone
        channel = topic.channels.get(robot) or self._register(topic, robot)
        begun, stamp, number = times
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

    def _register(self, topic: _Written, robot: str) -> int:
        if topic.kind not in self._schemas:
            self._schemas[topic.kind] = self._file.register_schema(topic.kind, topic.schema)
        channel = self._file.register_channel(topic.name.format(robot=robot), self._schemas[topic.kind])
        topic.channels[robot] = channel
        return channel

    def _nanoseconds(self, stamp: float) -> int:
        if stamp != self._stamp and 0.0 <= stamp < LATEST_S:
            seconds = int(stamp)  # apart: nanoseconds since 1970 are more digits than a float has
            self._stamp, self._latest = stamp, seconds * 10**9 + round((stamp - seconds) * 1e9)
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


class _Unbuffered(FileIO):
    """An unbuffered file: a write is the kernel's when it returns, so that a kill loses none of it."""

    def write(self, data: bytes | bytearray) -> int:  # type: ignore[override]
        rest = memoryview(data)
        while rest:  # a disk that is nearly full takes a part, and refuses only the next
            rest = rest[super().write(rest) :]
        return len(data)
