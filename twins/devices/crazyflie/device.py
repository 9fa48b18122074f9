"""The device: sockets of the Crazyflies of one process, what goes wrong on them, and the clock of all of them."""

from __future__ import annotations

import socket
import struct
from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np

from agents.arrays import Array
from agents.body.interface import BodyError
from agents.body.kinds import CRAZYFLIE
from agents.protocols.crtp import SCAN, Port, header
from twins.devices.crazyflie.drone import Drone
from twins.devices.crazyflie.flock import Flock
from twins.devices.device import DeviceRequest

HOST: Final = "127.0.0.1"
LARGEST: Final = 64  # [bytes]
AT_ONCE: Final = 64  # packets that are taken from one socket before the others are looked at
RECEIVE_BYTES: Final = 1 << 20

Peer = tuple[str, int]


class Line:
    """The link of one Crazyflie: its socket, its client, and its losses.

    Attributes:
        socket: Where its packets arrive.
        peer: Its client, None before the first packet.
        faults: What goes wrong on it.
        t: Now [s].
    """

    def __init__(self, random: np.random.Generator, request: DeviceRequest) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)
        self.socket.bind((HOST, 0))
        self.socket.setblocking(False)
        self.peer: Peer | None = None
        self.t = 0.0
        self.faults, self._random = request.faults, random
        self._waiting: deque[tuple[float, bytes]] = deque()

    @property
    def address(self) -> str:
        """Where cflib finds it."""
        return f"udp://{HOST}:{self.socket.getsockname()[1]}"

    def lost(self) -> bool:
        """Whether the packet at hand never arrives."""
        faults = self.faults
        return faults.silent(self.t) or (faults.loss > 0.0 and self._random.random() < faults.loss)

    def send(self, port: Port, channel: int, data: bytes) -> None:
        """One packet to the client, if there is one."""
        packet = bytes((header(port, channel),)) + data
        if self.faults.delay_s > 0.0:
            self._waiting.append((self.t + self.faults.delay_s, packet))
        else:
            self._put(packet)

    def send_due(self) -> None:
        """Sends what has been delayed for long enough."""
        while self._waiting and self._waiting[0][0] <= self.t:
            self._put(self._waiting.popleft()[1])

    def receive(self) -> bytes | None:
        """The next packet; None if there is none. The newest client is the client, as in Bitcraze's own simulation."""
        while True:
            try:
                packet, sender = self.socket.recvfrom(LARGEST)
            except BlockingIOError:
                return None
            except ConnectionError:  # an earlier packet found nobody
                continue
            if packet and not self.lost():
                self.peer = sender
                return packet

    def _put(self, packet: bytes) -> None:
        if self.peer is None or self.lost():
            return
        try:
            self.socket.sendto(packet, self.peer)
        except (BlockingIOError, ConnectionError):
            return  # a radio loses packets as well


class CrazyflieTwin:
    """Crazyflies that speak CRTP over UDP; implements `twins.devices.device.Device`.

    Attributes:
        addresses: One per row.
        flock: What moves.
        drones: The protocol of each row.
        lines: The link of each row.
    """

    def __init__(self, request: DeviceRequest) -> None:
        body = request.body
        strange = sorted({kind.name for kind in body.kinds if kind != CRAZYFLIE})
        if strange:
            raise BodyError(f"a Crazyflie's twin flies no {', '.join(strange)}; name another body")
        self.flock = Flock(body, request.faults)
        self.lines = [Line(np.random.default_rng([seed, row]), request) for row, seed in enumerate(body.seeds)]
        self.drones = [Drone(self.flock, row, line.send) for row, line in enumerate(self.lines)]
        self.addresses = tuple(line.address for line in self.lines)
        self._row = {line.socket: row for row, line in enumerate(self.lines)}

    def sockets(self) -> Sequence[socket.socket]:
        """See `Device.sockets`."""
        return list(self._row)

    def serve(self, ready: socket.socket, t: float) -> None:
        """See `Device.serve`."""
        row = self._row[ready]
        line, drone = self.lines[row], self.drones[row]
        line.t = t
        for _ in range(AT_ONCE):
            packet = line.receive()
            if packet is None:
                return
            if packet[0] == SCAN:
                line.send(Port.LINK, 3, b"")
                continue
            try:
                drone.receive(packet[0] >> 4, packet[0] & 3, packet[1:])
            except (struct.error, IndexError, ValueError, UnicodeDecodeError):
                continue  # not a packet of this protocol

    def advance(self, t: float) -> None:
        """See `Device.advance`."""
        locked = self.flock.advance(t)
        for line, drone in zip(self.lines, self.drones, strict=True):
            line.t = t
            if locked[drone.row]:
                drone.console("SUP: Locked, reboot required\n")
            drone.send_logs(t)
            line.send_due()

    def truth(self) -> tuple[Array, Array]:
        """See `Device.truth`."""
        return self.flock.place.copy(), self.flock.quadrotor.yaw.copy()

    def close(self) -> None:
        """See `Device.close`."""
        for line in self.lines:
            line.socket.close()


def open_device(request: DeviceRequest) -> CrazyflieTwin:
    """The entry point `crazyflie-twin` of the group `zenpark.devices`.

    Raises:
        BodyError: If a row is no Crazyflie, or its settings make no sense.
    """
    return CrazyflieTwin(request)
