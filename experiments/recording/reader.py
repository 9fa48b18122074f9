"""Reads and recovers MCAP files, finished or not: what a killed recorder or a full disk left behind counts.

Readers that seek need the summary that only a finished file has. This one goes through the file from its beginning, and
checks each record before using it. Behind damage it goes on at the next record with a length and a checksum that fit.
Damage costs only the records it hit and those that depend on them, and is counted.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterable, Iterator, Sequence
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
from experiments.recording.topics import CHUNK_BYTES, TOPICS

_RECORD: Final = struct.Struct("<BQ")  # operation code, length of what follows
_FOOTER: Final = struct.Struct("<QQI")  # begin of the summary and of its offsets, checksum of both
_MESSAGE: Final = struct.Struct("<BQHIQQ")  # the same, and channel, sequence, log time, publish time of a message
LAST: Final = 2**64  # [ns] later than any stamp
PARTS: Final = "cases"  # folder beside a recording: in that of its case are its later parts
HEAD: Final = np.dtype([("", "u1"), ("length", "<u8"), ("channel", "<u2"), ("", "<u4, <u8"), ("published", "<u8")])
FOOTER_BYTES: Final = _RECORD.size + _FOOTER.size
PRIVATE: Final = 0x80  # first operation code that MCAP leaves to programs
CHECKED: Final = (Opcode.CHUNK, Opcode.ATTACHMENT)  # records with a checksum
START: Final = re.compile(rb"[\x06\x09\x0c](?=.{4}\x00{4})", re.DOTALL)  # begin of these or of metadata, below 4 GB
BLOCK_BYTES: Final = 1 << 20
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
    schemas: dict[int, Schema] = field(default_factory=dict)  # schemas by their id in the file
    channels: dict[int, Channel] = field(default_factory=dict)  # channels by their id in the file
    attachments: list[Attachment] = field(default_factory=list)  # attachments, ordered as in the file
    metadata: list[Metadata] = field(default_factory=list)  # metadata, ordered as in the file
    complete: bool = False  # the file was finished by its recorder and nothing in it is damaged; known at the end
    damaged: int = 0  # what cannot be read [bytes], without a last record that was being written; known at the end

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
        self._read_summary(file, size)
        at = checked = len(MCAP0_MAGIC)  # `checked`: where the last record with a checksum ended
        unread = 0  # [bytes] records since then with a content that is damaged
        while at < size:
            opcode, body, end = _record(file, at, size)
            if opcode == Opcode.FOOTER:
                self.damaged += unread
                self.complete = file.read() == MCAP0_MAGIC and not self.damaged
                return
            if opcode is None:
                found = _next(file, checked, size)
                if found == size and end > size:  # a last record that was being written
                    break
                self.damaged += found - at + unread if found > at else found - checked
                at, checked = found, found + 1
                unread = 0
                continue
            places: list[int] = []
            try:
                data = _unpacked(body) if opcode == Opcode.CHUNK else _RECORD.pack(opcode, len(body)) + body
                places = self._places(data)
            except _DAMAGE:
                unread += end - at
            else:
                if opcode in CHECKED:
                    self.damaged, checked = self.damaged + unread, end
                    unread = 0
            if places:
                yield data, places
            at = end
        self.damaged += unread

    def _read_summary(self, file: BinaryIO, size: int) -> None:
        """Takes schemas and channels from the summary of a finished file: where they first stood may be damaged."""
        opcode, body, end = _record(file, size - FOOTER_BYTES - len(MCAP0_MAGIC), size)
        begin, _, checksum = _FOOTER.unpack(body) if opcode == Opcode.FOOTER else (0, 0, 0)
        if not 0 < begin < end:
            return
        file.seek(begin)
        content = file.read(end - begin)
        if zlib.crc32(content[:-4]) == checksum:
            summary = Records(self.path)
            summary._places(content[:-FOOTER_BYTES])
            self.schemas, self.channels = summary.schemas, summary.channels

    def _places(self, data: bytes) -> list[int]:
        """Places where the records of messages begin, among records that follow each other; other records are kept."""
        places = []
        at, end = 0, len(data)
        unpack = _RECORD.unpack_from
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


def _record(file: BinaryIO, at: int, size: int) -> tuple[int | None, bytes, int]:
    """Operation code, body and end of the record at a place; no code if it is not whole, and then 0 if it is none."""
    file.seek(max(0, at))
    head = file.read(_RECORD.size)
    if len(head) < _RECORD.size:
        return None, b"", size + 1
    opcode, length = _RECORD.unpack(head)
    if not (0 < opcode <= max(Opcode) or opcode >= PRIVATE) or (opcode == Opcode.FOOTER) != (length == _FOOTER.size):
        return None, b"", 0
    end = at + _RECORD.size + length
    return (None, b"", end) if end > size else (opcode, file.read(length), end)


def _unpacked(body: bytes) -> bytes:
    """Records in a chunk; raises one of _DAMAGE if its checksum does not fit."""
    stream, length = get_chunk_data_stream(Chunk.read(ReadDataStream(BytesIO(body))), validate_crc=True)
    return stream.read(length)


def _next(file: BinaryIO, at: int, size: int) -> int:
    """Place of the next record from a place on with a content that fits; the size of the file if there is none."""
    while at < size:
        file.seek(at)
        block = file.read(BLOCK_BYTES)
        for found in START.finditer(block):
            if _fits(*_record(file, at + found.start(), size)):
                return at + found.start()
        at += max(len(block) - _RECORD.size + 1, 1)
    return size


def _fits(opcode: int | None, body: bytes, _: int) -> bool:
    """Whether the checksum of a chunk or of an attachment fits; of metadata, which have none, the length."""
    try:
        if opcode == Opcode.CHUNK:
            return bool(_unpacked(body))
        if opcode == Opcode.ATTACHMENT:
            return zlib.crc32(body[:-4]) == int.from_bytes(body[-4:], "little")
        if opcode == Opcode.METADATA:
            stream = ReadDataStream(BytesIO(body))
            return bool(Metadata.read(stream).name) and stream.count == len(body)
    except _DAMAGE:
        pass
    return False


@dataclass(frozen=True)
class Recovered:
    """Result of `recover`."""

    messages: int
    robots: tuple[str, ...]  # robots, ordered by their first appearance
    complete: bool  # the source was whole already, and no target was written
    damaged: int = 0  # what could not be read of the sources [bytes]


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
    parts, refusals = list[_Part](), list[RecordingError]()
    for path in (source, *later):
        try:
            parts.append(_Part.of(Records(path)))
        except RecordingError as error:  # its recorder was killed before the file was there, or before its first record
            refusals.append(error)
    if not parts:
        raise refusals[0]
    parts = [part for part in parts if part.messages] or parts[:1]
    first = parts[0]
    channels = [channel for part in parts for channel in part.records.channels.values()]
    robots = tuple(dict.fromkeys(filter(None, map(_robot, channels))))
    if first.records.complete and first.records.path == source and len(parts) == 1:
        return Recovered(first.messages, robots, complete=True)
    damaged = sum(part.records.damaged for part in parts)
    return Recovered(_write(parts, target), robots, complete=False, damaged=damaged)


@dataclass(frozen=True)
class _Part:
    """A file of a recording that was read once."""

    records: Records
    messages: int
    begins: dict[str, int]  # [ns] earliest stamp by topic

    @classmethod
    def of(cls, records: Records) -> _Part:
        count, begins = 0, dict[int, int]()
        for message in records.messages():
            count += 1
            begins[message.channel] = min(message.published, begins.get(message.channel, message.published))
        return cls(records, count, _earliest((records.channels[each].topic, at) for each, at in begins.items()))


def _earliest(stamps: Iterable[tuple[str, int]]) -> dict[str, int]:
    """Earliest of the stamps of each topic."""
    found: dict[str, int] = {}
    for topic, stamp in stamps:
        found[topic] = min(stamp, found.get(topic, stamp))
    return found


def _write(parts: Sequence[_Part], target: Path) -> int:
    """Write all that was read; return the number of messages."""
    try:
        with target.open("xb") as file:
            return _copy(parts, Writer(file, chunk_size=CHUNK_BYTES))
    except FileExistsError:
        raise RecordingError(f"{target}: exists already; recover under another name") from None
    except RecordingError:
        target.unlink()
        raise
    except OSError as error:
        target.unlink(missing_ok=True)
        raise RecordingError(f"{target}: cannot be written: {error.strerror}; recover to somewhere else") from error


def _copy(parts: Sequence[_Part], writer: Writer) -> int:
    """Write the messages of all parts, without those of a part that are in an earlier one; return their number.

    Publishers repeat their last values to a recorder that took over. Messages of one part are never compared with each
    other: several of one topic may have the same stamp.
    """
    first = parts[0].records
    header = first.header
    writer.start(header.profile if header else "", header.library if header else "zenpark")
    schemas: dict[tuple[str, str, bytes], int] = {}
    channels: dict[tuple[str, int], int] = {}
    earlier: set[tuple[int, int, bytes]] = set()  # messages that a later part may repeat
    written = 0
    for number, part in enumerate(parts, 1):
        begins = _earliest(each for later in parts[number:] for each in later.begins.items())
        made = {0: 0}  # MCAP's own mark for: none
        for old, schema in part.records.schemas.items():
            about = (schema.name, schema.encoding, schema.data)
            made[old] = schemas.get(about) or schemas.setdefault(about, writer.register_schema(*about))
        places: dict[int, int] = {}
        for old, each in part.records.channels.items():
            named = (each.topic, made.get(each.schema_id, 0))
            if named not in channels:
                channels[named] = writer.register_channel(each.topic, each.message_encoding, named[1], each.metadata)
            places[old] = channels[named]
        fresh: list[tuple[int, int, bytes]] = []
        for message in Records(part.records.path).messages():
            channel, topic = places[message.channel], part.records.channels[message.channel].topic
            key = (channel, message.published, message.data)
            if key in earlier:
                continue
            writer.add_message(channel, message.logged, message.data, message.published, message.sequence)
            written += 1
            if message.published >= begins.get(topic, LAST):
                fresh.append(key)
        earlier.update(fresh)
    for attachment in first.attachments:
        writer.add_attachment(
            attachment.create_time, attachment.log_time, attachment.name, attachment.media_type, attachment.data
        )
    for metadata in first.metadata:
        writer.add_metadata(metadata.name, metadata.metadata)
    writer.finish()
    return written


def _robot(channel: Channel) -> str:
    """The robot in the name of a topic; empty for the topics of a whole run."""
    robot, _, what = channel.topic.removeprefix("/").partition("/")
    return robot if what and channel.topic not in {topic.name for topic in TOPICS} else ""
