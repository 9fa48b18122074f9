"""Wire format of NatNet, the stream of OptiTrack's Motive: UDP, little endian, metres and quaternions x, y, z, w.

A message is its kind, a length, and a body. A client sends CONNECT to the command port and gets SERVER_INFO with the
version of the bit stream, the clock and the group; it asks for the names of bodies with REQUEST_DESCRIPTIONS. Frames go
to a multicast group, or to each client that sends KEEP_ALIVE. From version 4.1 on each section of a frame names its
size. Read are versions 3.0 to 4.x.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, NamedTuple

from agents.body.byte_stream import WORD, Cursor, MalformedStream

COMMAND_PORT: Final = 1510
DATA_PORT: Final = 1511
GROUP: Final = "239.255.42.99"
CLOCK_HZ: Final = 10_000_000  # clock of Motive on Windows
OLDEST: Final = (3, 0)  # earlier frames have no time stamps of the cameras
SIZED: Final = (4, 1)  # version from which on sections name their sizes
NAME_BYTES: Final = 256
MODELS_CHANGED: Final = 2  # flag of a frame: names or ids of bodies have changed
STREAM_CHANGED: Final = 4  # flag of a frame: the version of the bit stream has changed
TRACKED: Final = 1  # flag of a body

Version = tuple[int, int]


class MessageKind(IntEnum):
    """Kinds of messages, as numbered on the wire."""

    CONNECT = 0
    SERVER_INFO = 1
    REQUEST_DESCRIPTIONS = 4
    DESCRIPTIONS = 5
    FRAME = 7
    KEEP_ALIVE = 10


class ServerInfo(NamedTuple):
    """Answer of a server to CONNECT."""

    program: str
    version: Version  # version of the bit stream
    clock_hz: int
    data_port: int
    group: str  # multicast address of the frames; empty: they go to each client


class RigidBodyPose(NamedTuple):
    """Pose of a rigid body in a frame."""

    id: int
    position: tuple[float, float, float]  # [m]
    quaternion: tuple[float, float, float, float]  # x, y, z, w
    tracked: bool


@dataclass(frozen=True)
class NatNetFrame:
    """Frame of Motive."""

    number: int
    bodies: Sequence[RigidBodyPose]
    exposed: int  # clock at the middle of the exposure [ticks], 0: unknown
    received: int  # clock when the cameras' data had come [ticks]
    sent: int  # clock at sending [ticks]
    flags: int = 0


_MESSAGE: Final = struct.Struct("<HH")
_INFO: Final = struct.Struct(f"<{NAME_BYTES}s4B4BQH?4B")
_DESCRIBED: Final = struct.Struct("<ii3f")
_BODY: Final = struct.Struct("<i3f4ffh")
_TIMECODE: Final = struct.Struct("<IId")
_TICKS: Final = struct.Struct("<QQQ")
_PRECISE: Final = struct.Struct("<II")  # time of a PTP clock, since 4.1
_TAIL: Final = struct.Struct("<hi")
_POINT: Final = 12  # size of a point [bytes]
_LABELLED_MARKER: Final = 26
_FORCE_PLATE: Final = 4 * (2 + 3 + 144 + 12 + 2)  # part of its description between serial number and channels [bytes]


def message(kind: MessageKind, body: bytes = b"") -> bytes:
    return _MESSAGE.pack(kind, len(body)) + body


def unpack_message(packet: bytes) -> tuple[int, bytes]:
    """Kind and body of a message."""
    cursor = Cursor(packet)
    kind, length = cursor.take(_MESSAGE)
    return int(kind), cursor.bytes(length)


def pack_server_info(info: ServerInfo) -> bytes:
    group = [int(part) for part in (info.group or GROUP).split(".")]
    version = (*info.version, 0, 0)
    return _INFO.pack(
        info.program.encode()[: NAME_BYTES - 1], 3, 1, 0, 0, *version, info.clock_hz, info.data_port, bool(info.group),
        *group,
    )  # fmt: skip


def unpack_server_info(body: bytes) -> ServerInfo:
    """The answer to CONNECT; raises MalformedStream for a version or a clock that cannot be read."""
    program, *numbers = Cursor(body).take(_INFO)
    version = numbers[4], numbers[5]
    clock_hz, data_port, multicast, *group = numbers[8:]
    if not OLDEST <= version < (5, 0):
        raise MalformedStream(
            f"NatNet {version[0]}.{version[1]} is not read: choose 3.0 to 4.x in the program's streaming"
        )
    if not (1000 <= clock_hz <= 10**10 and data_port > 0):
        raise MalformedStream(f"a clock of {clock_hz} Hz, a data port {data_port}")
    name = program.split(b"\0")[0].decode(errors="replace")
    return ServerInfo(name, version, clock_hz, data_port, ".".join(map(str, group)) if multicast else "")


def pack_descriptions(names: Mapping[int, str], version: Version) -> bytes:
    """Names of rigid bodies by id."""
    packed = WORD.pack(len(names))
    for number, name in names.items():
        body = name.encode() + b"\0" + _DESCRIBED.pack(number, -1, 0.0, 0.0, 0.0)
        body += struct.pack("<4f", 0.0, 0.0, 0.0, 1.0) if version >= (4, 2) else b""
        body += WORD.pack(0)  # markers
        packed += WORD.pack(1) + (WORD.pack(len(body)) if version >= SIZED else b"") + body
    return packed


def unpack_descriptions(body: bytes, version: Version) -> list[tuple[int, str]]:
    """Id and name of each rigid body.

    Before 4.1 the first description of an unknown kind ends the list; Motive describes rigid bodies before those.
    """
    cursor = Cursor(body)
    found = []
    for _ in range(cursor.count()):
        kind = cursor.count()
        end = cursor.at + 4 + cursor.count() if version >= SIZED else None
        if end is not None and end > len(body):
            raise MalformedStream("a description that is cut off")
        if kind == 1:
            found.append(_unpack_rigid_body(cursor, version))
        elif end is None and not _skip_description(cursor, kind, version):
            break
        cursor.at = cursor.at if end is None else end
    return found


def _unpack_rigid_body(cursor: Cursor, version: Version) -> tuple[int, str]:
    name = cursor.text()
    number = cursor.take(_DESCRIBED)[0]
    cursor.bytes(16 if version >= (4, 2) else 0)
    markers = cursor.count()
    cursor.bytes(markers * (_POINT + 4))
    for _ in range(markers if version >= (4, 0) else 0):
        cursor.text()
    return number, name


def _skip_description(cursor: Cursor, kind: int, version: Version) -> bool:
    """Skip a description of another kind; False if it is unknown."""
    if kind not in (0, 2, 3, 5):
        return False
    if kind == 3:
        cursor.count()
    cursor.text()
    if kind == 0:  # marker set: names of its markers
        for _ in range(cursor.count()):
            cursor.text()
    elif kind == 2:  # skeleton: id and rigid bodies
        cursor.count()
        for _ in range(cursor.count()):
            _unpack_rigid_body(cursor, version)
    elif kind == 3:  # force plate: names of its channels
        cursor.bytes(_FORCE_PLATE)
        for _ in range(cursor.count()):
            cursor.text()
    else:  # camera: position and quaternion
        cursor.bytes(7 * 4)
    return True


def pack_frame(frame: NatNetFrame, version: Version) -> bytes:
    """A frame with rigid bodies alone."""

    def section(count: int = 0, body: bytes = b"") -> bytes:
        return WORD.pack(count) + (WORD.pack(len(body)) if version >= SIZED else b"") + body

    bodies = b"".join(
        _BODY.pack(each.id, *each.position, *each.quaternion, 0.0003, TRACKED if each.tracked else 0)
        for each in frame.bodies
    )
    behind = 5 if version >= SIZED else 4  # skeletons, assets, labelled markers, force plates, devices
    ticks = _TICKS.pack(frame.exposed, frame.received, frame.sent)
    precise = _PRECISE.pack(0, 0) if version >= SIZED else b""
    return b"".join(
        [
            WORD.pack(frame.number), section() * 2, section(len(frame.bodies), bodies), section() * behind,
            _TIMECODE.pack(0, 0, frame.sent / CLOCK_HZ), ticks, precise, _TAIL.pack(frame.flags, 0),
        ]
    )  # fmt: skip


def unpack_frame(body: bytes, version: Version) -> NatNetFrame:
    """A frame; raises MalformedStream where lengths, counts or its end are wrong."""
    cursor = Cursor(body)
    number = cursor.count()
    _skip(cursor, version, "marker sets")
    _skip(cursor, version, "markers")
    count = cursor.count()
    size = cursor.count() if version >= SIZED else count * _BODY.size
    if size != count * _BODY.size:
        raise MalformedStream(f"{count} bodies in {size} bytes")
    bodies = [
        RigidBodyPose(each[0], each[1:4], each[4:8], bool(each[9] & TRACKED))
        for each in _BODY.iter_unpack(cursor.bytes(size))
    ]
    for name in ("skeletons", *(("assets",) if version >= SIZED else ()), "labelled markers", "channels", "channels"):
        _skip(cursor, version, name)
    cursor.take(_TIMECODE)
    exposed, received, sent = cursor.take(_TICKS)
    if version >= SIZED and cursor.left >= _PRECISE.size + _TAIL.size:
        cursor.take(_PRECISE)
    flags, end = cursor.take(_TAIL)
    if end != 0:
        raise MalformedStream("a frame without its end")
    return NatNetFrame(number, bodies, exposed, received, sent, flags)


def _skip(cursor: Cursor, version: Version, name: str) -> None:
    """Skip a section of a frame."""
    count = cursor.count()
    if version >= SIZED:
        cursor.bytes(cursor.count())
    elif name in ("markers", "labelled markers"):
        cursor.bytes(count * (_POINT if name == "markers" else _LABELLED_MARKER))
    elif name == "marker sets":
        for _ in range(count):
            cursor.text()
            cursor.bytes(cursor.count() * _POINT)
    elif name == "skeletons":
        for _ in range(count):
            cursor.count()
            cursor.bytes(cursor.count() * _BODY.size)
    else:  # force plates and devices: channels of values
        for _ in range(count):
            cursor.count()
            for _ in range(cursor.count()):
                cursor.bytes(4 * cursor.count())
