"""Reads and recovers MCAP files, finished or not: what a killed recorder or a full disk left behind counts.

Readers that seek need the summary that only a finished file has. This one goes through the file from its beginning, and
checks each record before using it. Damage costs only the records it hit and those that depend on them.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC, Writer

from agents.errors import ExplainedError
from agents.network.messages import Event
from experiments.recording.topics import CHUNK_BYTES, TOPICS

_RECORD: Final = struct.Struct("<BQ")  # operation code, length of what follows
_MESSAGE: Final = struct.Struct("<BQHIQQ")  # the same, and channel, sequence, log time, publish time of a message
EVENTS: Final = next(topic.name for topic in TOPICS if topic.message is Event)
PARTS: Final = "cases"  # folder beside a recording: in that of its case are its later parts
HEAD: Final = np.dtype([("", "u1"), ("length", "<u8"), ("channel", "<u2"), ("", "<u4, <u8"), ("published", "<u8")])
_DAMAGE: Final = (McapError, struct.error, zstandard.ZstdError, ValueError, RuntimeError, OverflowError, MemoryError)


class RecordingError(ExplainedError):
    """A recording that cannot be written, read or recovered, with its path and the remedy."""


class RecordedMessage(NamedTuple):
    """A message as it lies in the file; times in nanoseconds."""

    channel: int
    sequence: int
    logged: int
    published: int
    data: bytes


@dataclass
class Records:
    """Content of a file; everything but the messages grows while `messages` is iterated."""

    path: Path
    header: Header | None = None  # profile and library
    schemas: dict[int, Schema] = field(default_factory=dict)  # by their id in the file
    channels: dict[int, Channel] = field(default_factory=dict)  # by their id in the file
    attachments: list[Attachment] = field(default_factory=list)  # in the order of the file
    metadata: list[Metadata] = field(default_factory=list)  # in the order of the file
    complete: bool = False  # the file was finished by its recorder and nothing in it is damaged; known at the end

    def messages(self) -> Iterator[RecordedMessage]:
        """All messages with a known channel, in the order of writing; raises as `pieces` does."""
        for data, places in self.pieces():
            for at in places:
                _, length, channel, sequence, logged, published = _MESSAGE.unpack_from(data, at)
                if channel in self.channels:
                    yield RecordedMessage(
                        channel, sequence, logged, published, data[at + _MESSAGE.size : at + _RECORD.size + length]
                    )

    def pieces(self) -> Iterator[tuple[bytes, list[int]]]:
        """Pieces of the file that are not damaged, each with the places in it where the records of messages begin.

        Raises RecordingError if the file cannot be read, or is no MCAP file.
        """
        try:
            with self.path.open("rb") as file:
                if (magic := file.read(len(MCAP0_MAGIC))) != MCAP0_MAGIC:
                    why = "not an MCAP file; give the .mcap file of a run"
                    if MCAP0_MAGIC.startswith(magic):
                        why = "nothing was recorded, the recorder ended before its first record; delete the file"
                    raise RecordingError(f"{self.path}: {why}")
                yield from self._walk(file, self.path.stat().st_size)
        except OSError as error:
            raise RecordingError(
                f"{self.path}: cannot be read: {error.strerror}; give the .mcap file of a run"
            ) from error

    def _walk(self, file: BinaryIO, size: int) -> Iterator[tuple[bytes, list[int]]]:
        damaged = False
        while len(head := file.read(_RECORD.size)) == _RECORD.size:
            opcode, length = _RECORD.unpack(head)
            if opcode == 0 or length > size - file.tell():
                return
            body = file.read(length)
            if opcode == Opcode.FOOTER:
                self.complete = file.read() == MCAP0_MAGIC and not damaged
                return
            try:
                if opcode == Opcode.CHUNK:
                    stream, length = get_chunk_data_stream(Chunk.read(ReadDataStream(BytesIO(body))), validate_crc=True)
                    data = stream.read(length)
                else:
                    data = head + body
                places = self._places(data)
            except _DAMAGE:
                damaged = True
                continue
            if places:
                yield data, places

    def _places(self, data: bytes) -> list[int]:
        """Places where the records of messages begin, among records that follow each other; other records are kept."""
        places = []
        at, end, unpack = 0, len(data), _RECORD.unpack_from
        while at < end:
            opcode, length = unpack(data, at)
            if opcode != Opcode.MESSAGE:
                self._keep(opcode, data[at + _RECORD.size : at + _RECORD.size + length])
            elif length < _MESSAGE.size - _RECORD.size or at + _RECORD.size + length > end:
                raise ValueError("a message beyond its chunk")
            else:
                places.append(at)
            at += _RECORD.size + length
        return places

    def _keep(self, opcode: int, body: bytes) -> None:
        stream = ReadDataStream(BytesIO(body))
        if opcode == Opcode.HEADER:
            self.header = Header.read(stream)
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self.schemas.setdefault(schema.id, schema)  # the summary repeats them, without a checksum
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            self.channels.setdefault(channel.id, channel)
        elif opcode == Opcode.ATTACHMENT:
            if zlib.crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
                raise ValueError("damaged attachment")
            self.attachments.append(Attachment.read(stream))
        elif opcode == Opcode.METADATA:
            self.metadata.append(Metadata.read(stream))


@dataclass(frozen=True)
class Recovered:
    """Result of `recover`."""

    messages: int
    robots: tuple[str, ...]  # in the order in which they appear
    complete: bool  # the source was whole already, and no target was written


def later_parts(recording: Path) -> list[Path]:
    """Parts of a recording by recorders that took over in its run, not yet joined to it."""
    folder = recording.parent / PARTS / recording.stem
    return sorted(folder.glob("part*.mcap"), key=lambda file: (len(file.name), file.name))


def recover(source: Path, target: Path, later: Sequence[Path] = ()) -> Recovered:
    """Writes every whole record of an unfinished recording into a new, finished one. The sources stay as they are.

    Args:
        later: Further parts of the same recording, by recorders that took over. What they repeat is left out.

    Raises:
        RecordingError: If no part is a recording, or the target exists or cannot be written.
    """
    counts, refusals = list[tuple[Records, int]](), list[RecordingError]()
    for path in (source, *later):
        part = Records(path)
        try:
            counts.append((part, sum(1 for _ in part.messages())))
        except RecordingError as error:  # its recorder was killed before the file was there, or before its first record
            refusals.append(error)
    if not counts:
        raise refusals[0]
    messages = sum(count for _, count in counts)
    parts = [part for part, count in counts if count] or [counts[0][0]]
    channels = [channel for part in parts for channel in part.channels.values()]
    robots = tuple(dict.fromkeys(filter(None, map(_robot, channels))))
    complete = parts[0].complete and parts[0].path == source and len(parts) == 1
    if not complete:
        _write(parts, target)
    return Recovered(messages, robots, complete)


def _write(parts: Sequence[Records], target: Path) -> None:
    """Write all that was read."""
    try:
        with target.open("xb") as file:
            _copy(parts, Writer(file, chunk_size=CHUNK_BYTES))
    except FileExistsError:
        raise RecordingError(f"{target}: exists already; recover under another name") from None
    except RecordingError:
        target.unlink()
        raise
    except OSError as error:
        target.unlink(missing_ok=True)
        raise RecordingError(f"{target}: cannot be written: {error.strerror}; recover to somewhere else") from error


def _copy(parts: Sequence[Records], writer: Writer) -> None:
    first = parts[0]
    header = first.header
    writer.start(header.profile if header else "", header.library if header else "zenpark")
    schemas: dict[tuple[str, str, bytes], int] = {}
    channels: dict[tuple[str, int], int] = {}
    repeats = _Repeats()
    for part in parts:
        made = {0: 0}  # MCAP's own mark for: none
        for old, schema in part.schemas.items():
            about = (schema.name, schema.encoding, schema.data)
            made[old] = schemas.get(about) or schemas.setdefault(about, writer.register_schema(*about))
        places: dict[int, int] = {}
        for old, each in part.channels.items():
            named = (each.topic, made.get(each.schema_id, 0))
            if named not in channels:
                channels[named] = writer.register_channel(each.topic, each.message_encoding, named[1], each.metadata)
            places[old] = channels[named]
        for message in Records(part.path).messages():
            channel = places[message.channel]
            if part is first or not repeats.has(channel, message):
                writer.add_message(channel, message.logged, message.data, message.published, message.sequence)
            if len(parts) > 1:
                repeats.keep(channel, message, part.channels[message.channel].topic)
    for attachment in first.attachments:
        writer.add_attachment(
            attachment.create_time, attachment.log_time, attachment.name, attachment.media_type, attachment.data
        )
    for metadata in first.metadata:
        writer.add_metadata(metadata.name, metadata.metadata)
    writer.finish()


class _Repeats:
    """Last values that publishers repeat to a recorder that took over."""

    def __init__(self) -> None:
        self._events: set[tuple[int, bytes]] = set()  # few, and not in the order of their stamps
        self._latest: dict[int, int] = {}  # [ns] stamp of all other messages, by channel
        self._unordered: set[int] = set()

    def has(self, channel: int, message: RecordedMessage) -> bool:
        if channel in self._unordered:
            return (message.published, message.data) in self._events
        return message.published <= self._latest.get(channel, -1)

    def keep(self, channel: int, message: RecordedMessage, topic: str) -> None:
        if topic == EVENTS:
            self._unordered.add(channel)
            self._events.add((message.published, message.data))
        else:
            self._latest[channel] = max(self._latest.get(channel, -1), message.published)


def _robot(channel: Channel) -> str:
    """The robot in the name of a topic; empty for the topics of a whole run."""
    robot, _, what = channel.topic.removeprefix("/").partition("/")
    return robot if what and channel.topic not in {topic.name for topic in TOPICS} else ""
