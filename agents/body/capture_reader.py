"""Interface of a reader of motion capture, and what readers share.

A reader is a class registered under `zenpark.positioning`; its name is the scheme in `positioning = "NAME://HOST"`.
"""

from __future__ import annotations

import math
import re
import select
import socket
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final, NamedTuple

from agents.body.byte_stream import Framer, MalformedStream, Packet

CHUNK: Final = 1 << 18  # [bytes] read at once: about ten frames of twenty bodies
SKEW: Final = 1e-3  # tolerance of a rotation's orthonormality, and of a quaternion's square


class MeasuredPose(NamedTuple):
    """MeasuredPose of a body in the system's coordinates: position (3,) [m], rotation to the room (9,), row by row."""

    position: tuple[float, float, float]
    rotation: tuple[float, ...]


@dataclass(frozen=True)
class CaptureFrame:
    """Frame of motion capture: the poses of all bodies at one instant."""

    number: int  # number of the server
    poses: Mapping[str, MeasuredPose | None]  # pose of each body; None while it is not tracked
    latency_s: float = math.nan  # age when sent; NaN: the system does not say
    up: str = ""  # axis that points up, "y" or "z", as the stream says; empty: it does not say
    clock_s: float = math.nan  # steady time of the server; NaN: the system does not say


class CaptureReader(ABC):
    """Connection to a motion capture system, which streams every frame. Another one is made after each error."""

    PORT: ClassVar[int]  # usual port of the server
    FILE: ClassVar[bool] = False  # the address is the name of a file beside the experiment, not a host
    UP: ClassVar[str] = "z"  # axis that points up where neither the stream nor the file says so
    METRES: ClassVar[bool] = False  # its poses are in metres, so that the file names no unit
    PROGRAM: ClassVar[str] = "motion capture"  # program that is to run on the host, for messages
    TRANSPORT: ClassVar[str] = "TCP"  # protocol that a firewall must let in, for messages
    HINT: ClassVar[str] = (  # remedy where nothing answers
        "Is that the computer that runs {program}, is it on this network (ping {host}), and does its firewall let "
        "{transport} port {port} in?"
    )
    TWIN: ClassVar[str] = ""  # protocol twin, as `module:class`, for `positioning = "NAME-twin"`

    @abstractmethod
    def __init__(self, host: str, port: int, timeout_s: float) -> None:
        """Connect; raises OSError without an answer in time, MalformedStream for one that is no such system."""

    @abstractmethod
    def newest(self, timeout_s: float) -> CaptureFrame | None:
        """Newest frame received, or None at the timeout.

        Older frames are dropped: their time of arrival is unknown. Frames that overtook each other need no care.

        Raises:
            OSError: If the connection is lost.
            MalformedStream: If the stream is damaged.
        """

    @abstractmethod
    def close(self) -> None:
        """Leave the system."""

    @classmethod
    def parse(cls, address: str) -> tuple[str, int]:
        """Host and port of an address; raises ValueError for one that is none."""
        return parse_server(address, cls.PORT)

    @classmethod  # noqa: B027 - a host has no text
    def check(cls, text: str, label: str, flies: Mapping[str, bool], *, simulated: bool = False) -> None:
        """Check the text of a file that is the address; raises ValueError with place and remedy.

        Args:
            flies: Whether a body is that of a robot that flies, by name.
            simulated: Whether the file is read by the protocol twin as well.
        """


def parse_server(server: str, port: int) -> tuple[str, int]:
    """Host and port of "HOST" or "HOST:PORT"; raises ValueError if it is neither. `port` is that of a mere host."""
    host, colon, given = server.partition(":")
    if not re.fullmatch(r"[\w.-]+", host) or (
        colon and not (given.isascii() and given.isdigit() and 0 < int(given) < 65536)
    ):
        raise ValueError(f"'{server}' is neither HOST nor HOST:PORT, such as 192.168.0.10:{port}")
    return host, int(given) if colon else port


def readable(sockets: Sequence[socket.socket], deadline: float) -> bool:
    """Wait until one of the sockets has something to read; False at the deadline of `time.monotonic()` [s]."""
    poll = select.poll()
    for each in sockets:
        poll.register(each, select.POLLIN)
    return bool(poll.poll(1000.0 * max(0.0, deadline - time.monotonic())))


def _received(connection: socket.socket) -> bytes:
    """Bytes that a TCP connection has received, empty if that is nothing; raises OSError where it is closed."""
    parts: list[bytes] = []
    while True:
        try:
            part = connection.recv(CHUNK)
        except BlockingIOError:
            return b"".join(parts)
        if not part and not parts:  # what came before the end is read first
            raise ConnectionResetError("the server has closed the connection")
        if not part:
            return b"".join(parts)
        parts.append(part)


class PacketReader(CaptureReader):
    """Reader of packets over one TCP connection."""

    def __init__(self, host: str, port: int, timeout_s: float, framer: Framer) -> None:
        """Connect; raises OSError if no server answers in time [s], and MalformedStream if it is another one."""
        deadline = time.monotonic() + timeout_s
        self._framer = framer
        self._packets: deque[Packet] = deque()  # packets received, not decoded yet
        self._socket = socket.create_connection((host, port), timeout_s)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            self._subscribe(deadline)
        except (OSError, MalformedStream):
            self._socket.close()
            raise

    @abstractmethod
    def _subscribe(self, deadline: float) -> None:
        """Ask the server for frames."""

    @abstractmethod
    def _decoded(self, packets: Iterable[Packet]) -> CaptureFrame | None:
        """The newest frame in packets."""

    def newest(self, timeout_s: float) -> CaptureFrame | None:
        deadline = time.monotonic() + timeout_s
        while True:
            self._packets += self._framer.feed(_received(self._socket))
            packets, self._packets = self._packets, deque()
            if (frame := self._decoded(packets)) is not None:
                return frame
            if not readable([self._socket], deadline):
                return None

    def _next_packet(self, deadline: float) -> Packet:
        """The next packet; raises TimeoutError without one."""
        while not self._packets:
            if not readable([self._socket], deadline):
                raise TimeoutError("no answer")
            self._packets += self._framer.feed(_received(self._socket))
        return self._packets.popleft()

    def close(self) -> None:
        self._socket.close()


def rotation_of(quaternion: Sequence[float]) -> tuple[float, ...]:
    """Rotation (9,), row by row, of a quaternion x, y, z, w; NaN for one that is not of length 1, such as zeros."""
    x, y, z, w = quaternion
    square = x * x + y * y + z * z + w * w
    if not abs(square - 1.0) < SKEW:  # NaN fails as well
        return (math.nan,) * 9
    return (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w),
        2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w),
        2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


def by_name(bodies: Sequence[tuple[str, MeasuredPose | None]]) -> dict[str, MeasuredPose | None]:
    """Poses by name; a name that stands twice has no pose."""
    poses: dict[str, MeasuredPose | None] = {}
    for name, pose in bodies:
        poses[name] = None if name in poses else pose
    return poses
