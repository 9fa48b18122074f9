"""Wire format of the Vicon DataStream: TCP, little endian, unpadded, millimetres and rotation matrices.

A packet is the magic number, a length, and blocks; a block is its kind, a length, and a payload. Text is its length and
bytes, a list its count and items. The server begins and offers its kinds of block. The client answers with those that
it wants, and requests one frame, or all as they come. What does not change from frame to frame (names, axes) may be
sent once and is then valid until it is sent again.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from enum import IntEnum
from typing import Final, NamedTuple

from agents.body.byte_stream import Framer, MalformedStream

PORT: Final = 801
MAGIC: Final = 0x1A2B0001
MAX_PACKET: Final = 4_000_000  # [bytes]; a frame of a hundred bodies has 30 kB, a length beyond this is noise
NO_PARENT: Final = 0xFFFFFFFF  # parent of a root segment
CLOCK_HZ: Final = 135_000_000  # unit of the frame period
MM: Final = 1000.0  # millimetres in a metre
Z_UP: Final = 0


class BlockKind(IntEnum):
    """Kinds of block, as numbered on the wire."""

    STREAM_INFO = 1
    SUBJECT_INFO = 2
    FRAME_INFO = 5
    GLOBAL_SEGMENTS = 9
    LATENCY_INFO = 26
    APPLICATION_INFO = 37
    OBJECT_ENUMS = 100001  # offered by the server, wanted by the client
    REQUEST_FRAME = 100002  # 1: all frames from now on, 0: one
    REQUEST_NEXT_FRAME = 100008


POSES: Final = (
    BlockKind.STREAM_INFO,
    BlockKind.SUBJECT_INFO,
    BlockKind.FRAME_INFO,
    BlockKind.GLOBAL_SEGMENTS,
    BlockKind.LATENCY_INFO,
    BlockKind.APPLICATION_INFO,
)  # what there is to know of rigid bodies

_WORD = struct.Struct("<I")
_PERIOD = struct.Struct("<q")
_HEAD = struct.Struct("<II")
_SEGMENT = struct.Struct("<I3d9d")


class Subject(NamedTuple):
    """A tracked body: its number in the stream, its name, and the number of its root segment."""

    number: int
    name: str
    root: int


class Segment(NamedTuple):
    """Pose of a segment of a subject: position (3,) [m], rotation to the room (9,), row by row."""

    number: int
    position: tuple[float, float, float]
    rotation: tuple[float, ...]


# ---------------------------------------------------------------------- packing


def block(kind: int, payload: bytes = b"") -> bytes:
    return _HEAD.pack(kind, len(payload)) + payload


def packet(*blocks: bytes) -> bytes:
    return block(MAGIC, b"".join(blocks))


def pack_kinds(kinds: Iterable[int]) -> bytes:
    """The packet with which a server offers kinds of block, and a client wants some of them."""
    chosen = sorted(kinds)
    return packet(block(BlockKind.OBJECT_ENUMS, struct.pack(f"<I{len(chosen)}I", len(chosen), *chosen)))


def pack_stream_info(rate_hz: float) -> bytes:
    """The block with the frame rate."""
    return block(BlockKind.STREAM_INFO, _PERIOD.pack(round(CLOCK_HZ / rate_hz)))


def unpack_period(payload: bytes) -> float:
    """Time from one frame to the next [s]; 0 if the block has no number above 0."""
    (ticks,) = _unpack(_PERIOD, payload, 0)
    return max(int(ticks), 0) / CLOCK_HZ


def pack_axes(up: int = Z_UP) -> bytes:
    """The block with the upward axis."""
    return block(BlockKind.APPLICATION_INFO, bytes([up]))


def pack_subject(number: int, name: str) -> bytes:
    """The block that names a subject of one segment, which has the subject's name and the number 0."""
    root = _HEAD.pack(NO_PARENT, 0) + struct.pack("<6f", *[0.0] * 6) + _text(name)
    neither_markers_nor_attachments = _HEAD.pack(0, 0)
    payload = _WORD.pack(number) + _text(name) + _WORD.pack(1) + root + neither_markers_nor_attachments
    return block(BlockKind.SUBJECT_INFO, payload)


def pack_frame_number(number: int) -> bytes:
    return block(BlockKind.FRAME_INFO, _WORD.pack(number & 0xFFFFFFFF))


def pack_latency(parts: Iterable[tuple[str, float]]) -> bytes:
    """The block with the latency of a frame: stages and their durations [s]."""
    stages = [_text(name) + struct.pack("<d", seconds) for name, seconds in parts]
    return block(BlockKind.LATENCY_INFO, _WORD.pack(len(stages)) + b"".join(stages))


def pack_segments(subject: int, segments: Iterable[Segment]) -> bytes:
    """The block with the poses of the segments of a subject; without any it is occluded."""
    packed = [_SEGMENT.pack(s.number, *(MM * x for x in s.position), *s.rotation) for s in segments]
    return block(BlockKind.GLOBAL_SEGMENTS, _HEAD.pack(subject, len(packed)) + b"".join(packed))


# ---------------------------------------------------------------------- unpacking


def framer() -> Framer:
    """A framer of packets."""
    return Framer(_HEAD, _length)


def _length(magic: int, length: int) -> int:
    if magic != MAGIC:
        raise MalformedStream(f"a packet begins with {magic:#010x}, not with {MAGIC:#010x}")
    if length > MAX_PACKET:
        raise MalformedStream(f"a packet of {length} bytes is longer than any frame")
    return length


def blocks(body: bytes) -> Iterator[tuple[int, bytes]]:
    """Kind and payload of each block in the body of a packet; raises MalformedStream if one is longer than its rest."""
    at = 0
    while at < len(body):
        kind, length = _unpack(_HEAD, body, at)
        at += _HEAD.size
        if length > len(body) - at:
            raise MalformedStream(f"a block of {length} bytes in a packet that ends after {len(body) - at}")
        yield kind, body[at : at + length]
        at += length


def unpack_kinds(payload: bytes) -> set[int]:
    """Kinds that `pack_kinds` packed; raises MalformedStream, as the functions below, if the block is cut off."""
    (count,) = _unpack(_WORD, payload, 0)
    if 4 * count > len(payload) - 4:
        raise MalformedStream(f"a list of {count} kinds in {len(payload)} bytes")
    return set(struct.unpack_from(f"<{count}I", payload, 4))


def unpack_subject(payload: bytes) -> Subject:
    """A subject of any number of segments; the last without a parent is its root."""
    (number,) = _unpack(_WORD, payload, 0)
    name, at = _read_text(payload, 4)
    (count,) = _unpack(_WORD, payload, at)
    at += 4
    root = 0
    for _ in range(count):
        parent, segment = _unpack(_HEAD, payload, at)
        _, at = _read_text(payload, at + _HEAD.size + 24)  # name behind its six bounds
        if parent == NO_PARENT:
            root = segment
    return Subject(number, name, root)


def unpack_frame_number(payload: bytes) -> int:
    (number,) = _unpack(_WORD, payload, 0)
    return int(number)


def unpack_latency(payload: bytes) -> float:
    """Age of a frame [s], all stages together."""
    (count,) = _unpack(_WORD, payload, 0)
    at, total = 4, 0.0
    for _ in range(count):
        _, at = _read_text(payload, at)
        (seconds,) = _unpack(_SECONDS, payload, at)
        at += 8
        total += seconds
    return total


def unpack_segments(payload: bytes) -> tuple[int, list[Segment]]:
    """The number of a subject and where its segments are; no segments: it is occluded."""
    subject, count = _unpack(_HEAD, payload, 0)
    if count * _SEGMENT.size > len(payload) - _HEAD.size:
        raise MalformedStream(f"{count} segments in {len(payload)} bytes")
    found = []
    for number, x, y, z, *rotation in _SEGMENT.iter_unpack(payload[8 : 8 + count * _SEGMENT.size]):
        found.append(Segment(number, (x / MM, y / MM, z / MM), tuple(rotation)))
    return subject, found


_SECONDS = struct.Struct("<d")


def _text(text: str) -> bytes:
    encoded = text.encode()
    return _WORD.pack(len(encoded)) + encoded


def _read_text(payload: bytes, at: int) -> tuple[str, int]:
    """Text at an offset, and the offset behind it."""
    (length,) = _unpack(_WORD, payload, at)
    end = at + 4 + length
    if end > len(payload):
        raise MalformedStream(f"a text of {length} bytes where {len(payload) - at - 4} are left")
    return payload[at + 4 : end].decode(errors="replace"), end


def _unpack(layout: struct.Struct, payload: bytes, at: int) -> tuple[int, ...]:
    try:
        return layout.unpack_from(payload, at)
    except struct.error:
        raise MalformedStream(f"a block is cut off after {len(payload)} bytes") from None
