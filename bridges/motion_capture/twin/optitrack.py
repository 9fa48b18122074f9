"""Protocol twin of OptiTrack's Motive: a NatNet server, unicast, or multicast on this machine."""

from __future__ import annotations

import socket
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from agents.body.byte_stream import MalformedStream
from bridges.motion_capture.protocol import natnet
from bridges.motion_capture.protocol.natnet import MessageKind, NatNetFrame, RigidBodyPose, ServerInfo, Version
from bridges.motion_capture.twin.capture import CaptureTwin, SeenBody
from twins.arrays import Array

SILENT_S: Final = 3.0  # time without a sign of life after which a client of unicast gets no more frames
Address = tuple[str, int]


class OptiTrackTwin(CaptureTwin):
    """NatNet server. A body that is not tracked keeps its last pose, without its flag, as in Motive."""

    def __init__(
        self,
        bodies: Sequence[str],
        *,
        version: str = "4.2",
        multicast: bool = False,
        up: str = "y",
        **settings: Any,  # noqa: ANN401 - as of the base
    ) -> None:
        """Settings as of `CaptureTwin`; raises ValueError for a version that is not MAJOR.MINOR."""
        major, _, minor = version.partition(".")
        self._version: Version = int(major), int(minor)
        self._multicast, self._up = multicast, up
        self._clients: dict[Address, float] = {}  # time of the last sign of life of each client [s]
        self._changed = False  # bodies have changed since the last frame
        super().__init__(bodies, **settings)

    def sockets(self) -> Sequence[socket.socket]:
        return [self._command]

    def serve(self, ready: socket.socket, t: float) -> None:
        try:
            packet, client = self._command.recvfrom(65536)
            kind, _ = natnet.unpack_message(packet)
        except (OSError, MalformedStream):  # the last packet had no receiver, or this is none of the protocol
            return
        if self.link.silent(t):
            return
        if kind in (MessageKind.CONNECT, MessageKind.KEEP_ALIVE):
            self._clients[client] = t
        answer = b""
        if kind == MessageKind.CONNECT:
            group = natnet.GROUP if self._multicast else ""
            info = ServerInfo("Motive", self._version, natnet.CLOCK_HZ, self._data_port, group)
            answer = natnet.message(MessageKind.SERVER_INFO, natnet.pack_server_info(info))
        elif kind == MessageKind.REQUEST_DESCRIPTIONS:
            names = dict(enumerate(self._names(), 1))
            answer = natnet.message(MessageKind.DESCRIPTIONS, natnet.pack_descriptions(names, self._version))
        if answer:
            self._send(answer, client)

    def close(self) -> None:
        self._command.close()

    def _listen(self, host: str, port: int) -> None:
        self._command = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._command.bind((host, port))
        self._command.setblocking(False)
        self._data_port = natnet.DATA_PORT
        if self._multicast:
            local = socket.inet_aton(host)
            self._command.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, local)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
                free.bind((natnet.GROUP, 0))
                self._data_port = free.getsockname()[1]
        self.address = f"{host}:{self._command.getsockname()[1]}"

    def _encode(self, number: int, t: float, bodies: Sequence[SeenBody]) -> bytes:
        sent = round(natnet.CLOCK_HZ * (1.0 + t))
        exposed = sent - round(natnet.CLOCK_HZ * self.latency_s)
        ids = {name: number for number, name in enumerate(self._names(), 1)}
        poses = [
            RigidBodyPose(ids[body.name], *self._pose(body.position, body.rotation), body.tracked) for body in bodies
        ]
        flags, self._changed = natnet.MODELS_CHANGED if self._changed else 0, False
        frame = NatNetFrame(number, poses, max(1, exposed), exposed + (sent - exposed) // 2, sent, flags)
        return natnet.message(MessageKind.FRAME, natnet.pack_frame(frame, self._version))

    def _pose(
        self, position: Array, rotation: Array
    ) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
        (x, y, z), (a, b, c, d) = position.tolist(), quaternion(rotation)
        return ((x, z, -y), (a, c, -b, d)) if self._up == "y" else ((x, y, z), (a, b, c, d))

    def _deliver(self, frame: bytes) -> None:
        if self._multicast:
            self._send(frame, (natnet.GROUP, self._data_port))
            return
        for client, heard in list(self._clients.items()):
            if self.link.t - heard > SILENT_S:
                del self._clients[client]
            else:
                self._send(frame, client)

    def _rename(self) -> None:
        self._changed = True

    def _send(self, packet: bytes, client: Address) -> None:
        try:
            self._command.sendto(packet, client)
        except OSError:  # a full buffer, or a client that is gone
            return


def quaternion(rotation: Array) -> tuple[float, float, float, float]:
    """Quaternion x, y, z, w of a rotation (3, 3), by its largest part."""
    r = rotation
    squares = [1.0 + r[0, 0] - r[1, 1] - r[2, 2], 1.0 - r[0, 0] + r[1, 1] - r[2, 2],
               1.0 - r[0, 0] - r[1, 1] + r[2, 2], 1.0 + r[0, 0] + r[1, 1] + r[2, 2]]  # fmt: skip
    xy, xz, yz = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    xw, yw, zw = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    rows = [[squares[0], xy, xz, xw], [xy, squares[1], yz, yw], [xz, yz, squares[2], zw], [xw, yw, zw, squares[3]]]
    longest = np.array(rows[int(np.argmax(squares))])
    x, y, z, w = (longest / np.linalg.norm(longest)).tolist()
    return x, y, z, w
