"""CaptureReader of Qualisys Track Manager (QTM): 6DOF bodies of its real-time server."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from typing import ClassVar, Final

from agents.body.byte_stream import MalformedStream, Packet
from agents.body.capture_reader import CaptureFrame, MeasuredPose, PacketReader, by_name
from bridges.motion_capture.protocol import qtm
from bridges.motion_capture.protocol.qtm import QtmFrame, QtmPacketKind

NAMES_S: Final = 1.0  # period of the question for the names of bodies
UPWARD: Final = {"+Y": "y", "+Z": "z"}  # axes that can be read


class QualisysReader(PacketReader):
    """Connection to the real-time server of QTM."""

    PORT: ClassVar = qtm.PORT
    METRES: ClassVar = True
    PROGRAM: ClassVar = "QTM, with its real-time output on"
    TWIN: ClassVar = "bridges.motion_capture.twin.qualisys:QualisysTwin"

    def __init__(self, host: str, port: int = qtm.PORT, timeout_s: float = 2.0) -> None:
        super().__init__(host, port, timeout_s, qtm.framer())

    def _subscribe(self, deadline: float) -> None:
        if not self._answer(QtmPacketKind.COMMAND, deadline).startswith(qtm.WELCOME):
            raise MalformedStream("another server than QTM's")
        self._socket.sendall(qtm.command(f"Version {qtm.VERSION}".encode()))
        self._answer(QtmPacketKind.COMMAND, deadline)
        self._socket.sendall(qtm.command(qtm.PARAMETERS))
        self._parameters = qtm.unpack_parameters(self._answer(QtmPacketKind.XML, deadline))
        self._asked_at = time.monotonic()
        self._socket.sendall(qtm.command(qtm.STREAM))

    def _decoded(self, packets: Iterable[Packet]) -> CaptureFrame | None:
        if time.monotonic() - self._asked_at >= NAMES_S:  # names of bodies may change
            self._asked_at = time.monotonic()
            self._socket.sendall(qtm.command(qtm.PARAMETERS))
        newest: QtmFrame | None = None
        for kind, payload in packets:
            if kind == QtmPacketKind.XML:
                self._parameters = qtm.unpack_parameters(payload)
            elif kind == QtmPacketKind.ERROR:
                raise MalformedStream(f"QTM says: {_text(payload)}")
            elif kind == QtmPacketKind.DATA and (frame := qtm.unpack_frame(payload)) is not None:
                newest = frame if newest is None or frame.number > newest.number else newest
        return None if newest is None else self._named(newest)

    def _named(self, frame: QtmFrame) -> CaptureFrame:
        """A frame with names; without poses while there are more or fewer bodies than names."""
        names = self._parameters.names
        poses = [MeasuredPose(*body) if math.isfinite(sum(body.position)) else None for body in frame.bodies]
        if len(poses) != len(names):
            poses = [None] * len(names)
        up = UPWARD.get(self._parameters.up, "other")
        return CaptureFrame(frame.number, by_name(list(zip(names, poses, strict=True))), math.nan, up, frame.time_s)

    def _answer(self, wanted: QtmPacketKind, deadline: float) -> bytes:
        """The next packet of a kind; raises MalformedStream for an error of the server."""
        while True:
            kind, payload = self._next_packet(deadline)
            if kind == QtmPacketKind.ERROR:
                raise MalformedStream(f"QTM says: {_text(payload)}")
            if kind == wanted:
                return payload


def _text(payload: bytes) -> str:
    return payload.rstrip(b"\0").decode(errors="replace")[:200]
