"""Wire format of the real-time server of Qualisys Track Manager (QTM): TCP, little endian, millimetres and matrices.

A packet is its length (with these eight bytes), its kind, and a payload. The server greets; the client chooses a
version, asks for parameters (XML: names of bodies in the order of the frames, upward axis) and requests the stream. A
body that is not seen is NaN. Times are microseconds of the server's clock; when a frame was exposed is not said.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from enum import IntEnum
from typing import Final, NamedTuple
from xml.etree import ElementTree
from xml.sax.saxutils import escape

from agents.body.byte_stream import Cursor, Framer, MalformedStream

PORT: Final = 22223  # port for little endian; 22222 has another protocol
VERSION: Final = "1.12"  # 6DOF bodies are the same in all later ones
WELCOME: Final = b"QTM RT Interface connected"
MAX_PACKET: Final = 8_000_000  # [bytes]
MM: Final = 1000.0  # millimetres in a metre
BODIES: Final = 5  # kind of the component with 6DOF bodies
STREAM: Final = b"StreamFrames AllFrames 6D"
PARAMETERS: Final = b"GetParameters 3D 6D"


class QtmPacketKind(IntEnum):
    """Kinds of packets, as numbered on the wire."""

    ERROR = 0
    COMMAND = 1
    XML = 2
    DATA = 3
    NO_MORE_DATA = 4
    EVENT = 6


class BodyPose(NamedTuple):
    """Pose of a 6DOF body: position (3,) [m] and rotation (9,), row by row."""

    position: tuple[float, float, float]
    rotation: tuple[float, ...]


class QtmFrame(NamedTuple):
    """Frame of QTM."""

    time_s: float  # clock of the server [s]
    number: int
    bodies: Sequence[BodyPose]  # NaN: not seen


class QtmParameters(NamedTuple):
    """Parameters of the stream."""

    names: Sequence[str]  # names of the bodies, in the order of the frames
    up: str  # upward axis, such as "+Z"


_HEAD: Final = struct.Struct("<II")
_DATA: Final = struct.Struct("<QII")
_COUNT: Final = struct.Struct("<IHH")
_BODY: Final = struct.Struct("<3f9f")


def packet(kind: QtmPacketKind, payload: bytes = b"") -> bytes:
    return _HEAD.pack(_HEAD.size + len(payload), kind) + payload


def command(text: bytes, kind: QtmPacketKind = QtmPacketKind.COMMAND) -> bytes:
    """The packet of a command, an answer, an error or of XML: a text that ends with a zero byte."""
    return packet(kind, text + b"\0")


def framer() -> Framer:
    """A framer of packets, each with its kind."""
    return Framer(_HEAD, _length)


def _length(size: int, kind: int) -> int:
    if not _HEAD.size <= size <= MAX_PACKET or kind > 30:
        raise MalformedStream(f"a packet of {size} bytes of the kind {kind}: is this QTM's port for little endian?")
    return size - _HEAD.size


def pack_frame(frame: QtmFrame) -> bytes:
    """The packet of a frame with 6DOF bodies."""
    bodies = b"".join(
        _BODY.pack(*(MM * each for each in body.position), *_transposed(body.rotation)) for body in frame.bodies
    )
    component = (
        _HEAD.pack(_HEAD.size + _COUNT.size + len(bodies), BODIES) + _COUNT.pack(len(frame.bodies), 0, 0) + bodies
    )
    return packet(QtmPacketKind.DATA, _DATA.pack(round(1e6 * frame.time_s), frame.number, 1) + component)


def unpack_frame(payload: bytes) -> QtmFrame | None:
    """A frame; None for one without bodies; raises MalformedStream where lengths or counts are wrong."""
    cursor = Cursor(payload)
    microseconds, number, components = cursor.take(_DATA)
    for _ in range(components):
        size, kind = cursor.take(_HEAD)
        inside = Cursor(cursor.bytes(size - _HEAD.size))
        if kind != BODIES:
            continue
        count, _, _ = inside.take(_COUNT)
        if count * _BODY.size != inside.left:
            raise MalformedStream(f"{count} bodies in {inside.left} bytes")
        bodies = [
            BodyPose((x / MM, y / MM, z / MM), _transposed(columns))
            for x, y, z, *columns in _BODY.iter_unpack(inside.bytes(inside.left))
        ]
        return QtmFrame(1e-6 * microseconds, number, bodies)
    return None


def _transposed(matrix: Sequence[float]) -> tuple[float, ...]:
    """Columns to rows, and rows to columns: QTM sends column by column."""
    return tuple(matrix[3 * column + row] for row in range(3) for column in range(3))


def pack_parameters(names: Sequence[str], rate_hz: float) -> bytes:
    """XML of the parameters that `PARAMETERS` asks for."""
    bodies = "".join(f"<Body><Name>{escape(name)}</Name><Enabled>true</Enabled></Body>" for name in names)
    general = f"<General><Frequency>{rate_hz:g}</Frequency></General><The_3D><AxisUpwards>+Z</AxisUpwards></The_3D>"
    root = f"QTM_Parameters_Ver_{VERSION}"
    return f"<{root}>{general}<The_6D><Bodies>{len(names)}</Bodies>{bodies}</The_6D></{root}>".encode()


def unpack_parameters(payload: bytes) -> QtmParameters:
    """Names of the bodies and upward axis."""
    text = payload.rstrip(b"\0 \r\n\t")
    if b"<!" in text:  # definitions of entities may grow without bound
        raise MalformedStream("parameters with definitions")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise MalformedStream(f"parameters that are no XML: {error}") from None
    bodies = root.findall("The_6D/Body")
    names = [(body.findtext("Name") or "").strip() for body in bodies]
    return QtmParameters(names, (root.findtext("The_3D/AxisUpwards") or "").strip().upper())
