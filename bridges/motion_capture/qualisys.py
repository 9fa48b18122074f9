"""CaptureReader of Qualisys Track Manager (QTM): 6DOF bodies of its real-time server."""

from __future__ import annotations

import math
import time
from collections import deque
from typing import ClassVar, Final

from agents.body.byte_stream import MalformedStream
from agents.body.capture_reader import (
    CaptureFrame,
    CaptureReader,
    MeasuredPose,
    by_name,
    connect_tcp,
    readable,
    received,
)
from bridges.motion_capture.protocol import qtm
from bridges.motion_capture.protocol.qtm import PacketFramer, QtmFrame, QtmPacketKind

NAMES_S: Final = 1.0  # period of the question for the names of bodies
UPWARD: Final = {"+Y": "y", "+Z": "z"}  # axes that can be read


class QualisysReader(CaptureReader):
    """Connection to the real-time server of QTM."""

    PORT: ClassVar = qtm.PORT
    PROGRAM: ClassVar = "QTM, with its real-time output on"
    TWIN: ClassVar = "bridges.motion_capture.twin.qualisys:QualisysTwin"

    def __init__(self, host: str, port: int = qtm.PORT, timeout_s: float = 2.0) -> None:
        deadline = time.monotonic() + timeout_s
        self._framer = PacketFramer()
        self._waiting: deque[tuple[int, bytes]] = deque()  # packets received, not decoded yet
        self._socket = connect_tcp(host, port, timeout_s)
        try:
            if not self._answer(QtmPacketKind.COMMAND, deadline).startswith(qtm.WELCOME):
                raise MalformedStream("another server than QTM's")
            self._socket.sendall(qtm.command(f"Version {qtm.VERSION}".encode()))
            self._answer(QtmPacketKind.COMMAND, deadline)
            self._socket.sendall(qtm.command(qtm.PARAMETERS))
            self._parameters = qtm.unpack_parameters(self._answer(QtmPacketKind.XML, deadline))
            self._asked_at = time.monotonic()
            self._socket.sendall(qtm.command(qtm.STREAM))
        except (OSError, MalformedStream):
            self._socket.close()
            raise

    def newest(self, timeout_s: float) -> CaptureFrame | None:
        deadline = time.monotonic() + timeout_s
        while True:
            self._ask()
            self._waiting += self._framer.feed(received(self._socket))
            newest: QtmFrame | None = None
            while self._waiting:
                kind, payload = self._waiting.popleft()
                if kind == QtmPacketKind.XML:
                    self._parameters = qtm.unpack_parameters(payload)
                elif kind == QtmPacketKind.ERROR:
                    raise MalformedStream(f"QTM says: {_text(payload)}")
                elif kind == QtmPacketKind.DATA and (frame := qtm.unpack_frame(payload)) is not None:
                    newest = frame if newest is None or frame.number > newest.number else newest
            if newest is not None:
                return self._named(newest)
            if not readable([self._socket], deadline):
                return None

    def close(self) -> None:
        self._socket.close()

    def _named(self, frame: QtmFrame) -> CaptureFrame:
        """A frame with names; without poses while there are more or fewer bodies than names."""
        names = self._parameters.names
        poses = [MeasuredPose(*body) if math.isfinite(sum(body.position)) else None for body in frame.bodies]
        if len(poses) != len(names):
            poses = [None] * len(names)
        up = UPWARD.get(self._parameters.up, "other")
        return CaptureFrame(frame.number, by_name(list(zip(names, poses, strict=True))), math.nan, up, frame.time_s)

    def _ask(self) -> None:
        """Ask for the names of bodies, which may change."""
        if time.monotonic() - self._asked_at >= NAMES_S:
            self._asked_at = time.monotonic()
            self._socket.sendall(qtm.command(qtm.PARAMETERS))

    def _answer(self, wanted: QtmPacketKind, deadline: float) -> bytes:
        """The next packet of a kind; raises MalformedStream for an error of the server."""
        while True:
            while self._waiting:
                kind, payload = self._waiting.popleft()
                if kind == QtmPacketKind.ERROR:
                    raise MalformedStream(f"QTM says: {_text(payload)}")
                if kind == wanted:
                    return payload
            if not readable([self._socket], deadline):
                raise TimeoutError("no answer")
            self._waiting += self._framer.feed(received(self._socket))


def _text(payload: bytes) -> str:
    return payload.rstrip(b"\0").decode(errors="replace")[:200]
