"""Protocol twin of Qualisys Track Manager (QTM): its real-time server over TCP."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import nan

from agents.protocols import qtm
from agents.protocols.qtm import BodyPose, PacketFramer, QtmFrame, QtmPacketKind
from twins.devices.capture import CaptureClient, SeenBody, StreamTwin


@dataclass(eq=False)
class QualisysClient(CaptureClient):
    """Connection of a client."""

    framer: PacketFramer = field(default_factory=PacketFramer)


class QualisysTwin(StreamTwin):
    """Real-time server of QTM. A body that is not tracked is NaN; one that is missing is left out."""

    def _greeted(self) -> CaptureClient:
        return QualisysClient(unsent=bytearray(qtm.command(qtm.WELCOME)))

    def _answer(self, client: CaptureClient, received: bytes) -> None:
        assert isinstance(client, QualisysClient)
        for kind, payload in client.framer.feed(received):
            if kind == QtmPacketKind.COMMAND:
                client.unsent += self._reply(client, payload.rstrip(b"\0").lower())

    def _reply(self, client: CaptureClient, command: bytes) -> bytes:
        word, _, argument = command.partition(b" ")
        if word == b"version":
            return qtm.command(b"Version set to " + argument)
        if word == b"qtmversion":
            return qtm.command(b"QTM Version is 2026.1 (build 1)")
        if word == b"getparameters":
            return qtm.command(qtm.pack_parameters(self._names(), self._rate), QtmPacketKind.XML)
        if word == b"streamframes":
            client.streams = argument != b"stop"
            return b""
        if word == b"getcurrentframe":
            client.asked += 1
            return b""
        return qtm.command(b"Parse error", QtmPacketKind.ERROR)

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
