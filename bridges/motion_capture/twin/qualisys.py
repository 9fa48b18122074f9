"""Protocol twin of Qualisys Track Manager (QTM): its real-time server over TCP."""

from __future__ import annotations

from collections.abc import Sequence
from math import nan
from typing import Final

from bridges.motion_capture.protocol import qtm
from bridges.motion_capture.protocol.qtm import BodyPose, QtmFrame, QtmPacketKind
from bridges.motion_capture.twin.capture import CaptureClient, SeenBody, StreamTwin

OLD: Final = (b"1.0", b"1.1", b"1.2", b"1.3", b"1.4", b"1.5", b"1.6", b"1.7")  # versions with bodies of doubles


class QualisysTwin(StreamTwin):
    """Real-time server of QTM: 6DOF bodies over TCP. A body that is not tracked is NaN; a missing one is left out."""

    WELCOME = qtm.command(qtm.WELCOME)
    framer = staticmethod(qtm.framer)

    def _answer(self, client: CaptureClient, kind: int, payload: bytes) -> None:
        if kind == QtmPacketKind.COMMAND:
            client.unsent += self._reply(client, payload.rstrip(b"\0").lower())

    def _reply(self, client: CaptureClient, command: bytes) -> bytes:
        word, _, argument = command.partition(b" ")
        bodies = b"6d" in argument.split() and b"udp:" not in argument
        if word == b"streamframes" and (bodies or argument == b"stop"):
            client.streams = bodies
            return b""
        if word == b"getcurrentframe" and bodies:
            client.asked += 1
            return b""
        if word == b"getparameters":
            return qtm.command(qtm.pack_parameters(self._names(), self._rate), QtmPacketKind.XML)
        if word == b"version" and argument not in OLD:
            return qtm.command(b"Version set to " + argument)
        return qtm.command(b"Not supported", QtmPacketKind.ERROR)

    def _packet(self, client: CaptureClient, frame: bytes) -> bytes:
        return frame

    def _encode(self, number: int, t: float, bodies: Sequence[SeenBody]) -> bytes:
        hidden = BodyPose((nan,) * 3, (nan,) * 9)
        poses = [
            BodyPose(tuple(body.position.tolist()), tuple(body.rotation.reshape(9).tolist()))
            if body.tracked
            else hidden
            for body in bodies
        ]
        return qtm.pack_frame(QtmFrame(t, number, poses))
