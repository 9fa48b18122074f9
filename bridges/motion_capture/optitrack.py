"""CaptureReader of OptiTrack's Motive: NatNet 3.0 to 4.x, multicast or unicast, as the server says."""

from __future__ import annotations

import math
import socket
import time
from collections import Counter
from typing import ClassVar, Final

from agents.body.byte_stream import MalformedStream
from agents.body.capture_reader import CaptureFrame, CaptureReader, MeasuredPose, by_name, readable, rotation_of
from bridges.motion_capture.protocol import natnet
from bridges.motion_capture.protocol.natnet import MessageKind, NatNetFrame, ServerInfo

PACKET: Final = 1 << 16  # [bytes] largest packet of UDP
NAMES_S: Final = 2.0  # period of the question for the names of bodies
ASK_S: Final = 0.2  # period of questions that wait for an answer, and of signs of life
DAMAGED_S: Final = 0.5  # time without a frame after which a damaged packet counts as a damaged stream


class OptiTrackReader(CaptureReader):
    """Connection to the streaming of Motive.

    A single damaged or foreign packet is dropped, as anybody may send to a UDP port; packets count only if they come
    from the host.
    """

    PORT: ClassVar = natnet.COMMAND_PORT
    UP: ClassVar = "y"
    METRES: ClassVar = True
    PROGRAM: ClassVar = "Motive with its streaming switched on"
    TRANSPORT: ClassVar = "UDP"
    TWIN: ClassVar = "bridges.motion_capture.twin.optitrack:OptiTrackTwin"

    def __init__(self, host: str, port: int = natnet.COMMAND_PORT, timeout_s: float = 2.0) -> None:
        deadline = time.monotonic() + timeout_s
        self._names: dict[int, str] = {}
        self._current = False  # the names are those of the frames
        self._asked_at = self._greeted_at = -math.inf
        self._good_at = time.monotonic()  # time of the last frame [s]
        self._damage = ""  # fault of the last packet that was dropped
        self._changed = False  # the last frame said that bodies have changed
        self._sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM)]
        try:
            self._command = self._sockets[0]
            self._command.setblocking(False)
            self._command.connect((host, port))
            self._host = self._command.getpeername()[0]
            self._info = self._greet(deadline)
            if self._info.group:
                self._join(self._info)
        except (OSError, MalformedStream):
            self.close()
            raise

    def newest(self, timeout_s: float) -> CaptureFrame | None:
        deadline = time.monotonic() + timeout_s
        while True:
            self._ask()
            if (frame := self._drain()) is not None:
                return frame
            now = time.monotonic()
            if self._damage and now - self._good_at > DAMAGED_S:
                raise MalformedStream(self._damage)
            if now >= deadline:
                return None
            readable(self._sockets, min(deadline, now + ASK_S))

    def close(self) -> None:
        for each in self._sockets:
            each.close()

    def _greet(self, deadline: float) -> ServerInfo:
        """Ask for the server's description until it comes."""
        while True:
            if time.monotonic() >= deadline:
                raise TimeoutError("no answer")
            self._command.send(natnet.message(MessageKind.CONNECT, b"Ping\0"))
            readable([self._command], min(deadline, time.monotonic() + ASK_S))
            while (packet := _next(self._command)) is not None:
                kind, body = natnet.unpack_message(packet[0])
                if kind == MessageKind.SERVER_INFO:
                    return natnet.unpack_server_info(body)

    def _join(self, info: ServerInfo) -> None:
        """Receive the group of the frames on the interface that reaches the server."""
        data = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sockets.append(data)
        data.setblocking(False)
        data.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        data.bind((info.group, info.data_port))
        local = self._command.getsockname()[0]
        data.setsockopt(
            socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(info.group) + socket.inet_aton(local)
        )

    def _ask(self) -> None:
        """Ask for names, and tell a server without multicast that this client lives, where it is time."""
        now = time.monotonic()
        if now - self._asked_at >= (NAMES_S if self._current else ASK_S):
            self._asked_at = now
            self._command.send(natnet.message(MessageKind.REQUEST_DESCRIPTIONS))
        if not self._info.group and now - self._greeted_at >= ASK_S:
            self._greeted_at = now
            self._command.send(natnet.message(MessageKind.KEEP_ALIVE))

    def _drain(self) -> CaptureFrame | None:
        """The frame with the highest number of those that have come, if that is new."""
        newest: NatNetFrame | None = None
        for each in self._sockets:
            while (packet := _next(each)) is not None:
                data, (sender, _) = packet
                if sender != self._host:
                    self._damage = f"frames come from {sender}: name that host, or end the other server"
                    continue
                try:
                    frame = self._read(data)
                except MalformedStream as error:
                    self._damage = f"a damaged packet of NatNet: {error}"
                    continue
                if frame is not None and (newest is None or frame.number > newest.number):
                    newest = frame
        if newest is None or not self._current:
            return None
        self._good_at, self._damage = time.monotonic(), ""
        return self._frame(newest)

    def _read(self, packet: bytes) -> NatNetFrame | None:
        """Take a packet in; returns its frame, if it is one."""
        kind, body = natnet.unpack_message(packet)
        if kind == MessageKind.DESCRIPTIONS:
            described = natnet.unpack_descriptions(body, self._info.version)
            times = Counter(number for number, _ in described)
            self._names = {number: name for number, name in described if times[number] == 1}
            self._current = True
        elif kind == MessageKind.FRAME:
            frame = natnet.unpack_frame(body, self._info.version)
            if frame.flags & natnet.STREAM_CHANGED:
                raise ConnectionResetError("the version of the stream has changed")
            changed, self._changed = self._changed, bool(frame.flags & natnet.MODELS_CHANGED)
            if self._changed and not changed:
                self._current, self._asked_at = False, -math.inf
            return frame
        return None

    def _frame(self, frame: NatNetFrame) -> CaptureFrame:
        times = Counter(body.id for body in frame.bodies)
        seen = {
            body.id: MeasuredPose(body.position, rotation_of(body.quaternion))
            for body in frame.bodies
            if body.tracked and times[body.id] == 1
        }
        poses = by_name([(name, seen.get(number)) for number, name in self._names.items()])
        since = (frame.sent - frame.exposed) / self._info.clock_hz
        latency = since if frame.exposed > 0 and since >= 0.0 else math.nan
        clock = frame.sent / self._info.clock_hz if frame.sent > 0 else math.nan
        return CaptureFrame(frame.number, poses, latency, "", clock)


def _next(wire: socket.socket) -> tuple[bytes, tuple[str, int]] | None:
    """The next packet and its sender; None if there is none."""
    try:
        return wire.recvfrom(PACKET)
    except BlockingIOError:
        return None
