"""The whole records of an MCAP file, finished or not: what a killed recorder or a full disk left behind counts.

Readers that seek need the summary that only a finished file has. This one goes through the file from its beginning, and
checks each record before it is believed, so that damage costs the records it hit and those that depend on them.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

_RECORD: Final = struct.Struct("<BQ")  # operation code, length of what follows
_MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_DAMAGE: Final = (McapError, struct.error, zstandard.ZstdError, ValueError, RuntimeError, OverflowError, MemoryError)


class RecordingError(RuntimeError):
    """A recording that cannot be written, read or recovered, with its path and the remedy."""


class Message(NamedTuple):
    """A message as it lies in the file; times in nanoseconds."""

    channel: int
    sequence: int
    logged: int
    published: int
    data: bytes


@dataclass
class Records:
    """What a file holds. Everything but the messages grows while `messages` is iterated.

    Attributes:
        path: Where the file is.
        header: Profile and library.
        schemas: By their id in the file.
        channels: By their id in the file.
        attachments: In the order of the file.
        metadata: In the order of the file.
        complete: The file was finished by its recorder and nothing in it is damaged; known at the end.
    """

    path: Path
    header: Header | None = None
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    attachments: list[Attachment] = field(default_factory=list)
    metadata: list[Metadata] = field(default_factory=list)
    complete: bool = False

    def messages(self) -> Iterator[Message]:
        """All messages whose channel is known, in the order they were written.

        Raises:
            RecordingError: If the file cannot be read, or is no MCAP file.
        """
        try:
            with self.path.open("rb") as file:
                if (magic := file.read(len(MCAP0_MAGIC))) != MCAP0_MAGIC:
                    raise RecordingError(_stranger(self.path, magic))
                yield from self._walk(file, self.path.stat().st_size)
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be read: {error.strerror}") from error

    def _walk(self, file: BinaryIO, size: int) -> Iterator[Message]:
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
                    messages = list(self._chunk(stream.read(length)))
                else:
                    messages = list(self._chunk(head + body))
            except _DAMAGE:
                damaged = True
                continue
            yield from messages

    def _chunk(self, data: bytes) -> Iterator[Message]:
        """The messages among records that follow each other."""
        at = 0
        while at < len(data):
            opcode, length = _RECORD.unpack_from(data, at)
            at += _RECORD.size
            if opcode == Opcode.MESSAGE:
                channel, sequence, logged, published = _MESSAGE.unpack_from(data, at)
                message = Message(channel, sequence, logged, published, data[at + _MESSAGE.size : at + length])
                if channel in self.channels:
                    yield message
            else:
                self._keep(opcode, data[at : at + length])
            at += length

    def _keep(self, opcode: int, body: bytes) -> None:
        stream = ReadDataStream(BytesIO(body))
        if opcode == Opcode.HEADER:
            self.header = Header.read(stream)
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            self.channels[channel.id] = channel
        elif opcode == Opcode.ATTACHMENT:
            if zlib.crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
                raise ValueError("damaged attachment")
            self.attachments.append(Attachment.read(stream))
        elif opcode == Opcode.METADATA:
            self.metadata.append(Metadata.read(stream))


def _stranger(path: Path, magic: bytes) -> str:
    if MCAP0_MAGIC.startswith(magic):
        return f"{path}: nothing was recorded, the recorder ended before its first record; delete the file"
    return f"{path}: not an MCAP file; give the .mcap file of a run"
