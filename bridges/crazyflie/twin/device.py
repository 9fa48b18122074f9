"""The device: links of the Crazyflies of one process over UDP or a software radio, and the common clock."""

from __future__ import annotations

import errno
import socket
import struct
from collections.abc import Sequence
from math import inf
from typing import Final

import numpy as np

from bridges.crazyflie.protocol import crazyradio
from bridges.crazyflie.protocol.crtp import Port, header
from bridges.crazyflie.twin.drone import Drone
from bridges.crazyflie.twin.radio import HOST, Air, RadioLink
from bridges.crazyflie.twin.vehicle import Vehicle
from twins.arrays import Array
from twins.device import Device, DeviceRequest, FaultyLink

SCANNED_PORTS: Final = range(19850, 19860)  # ports at which cflib looks for simulations
MAX_PACKET_BYTES: Final = 64  # [bytes]
AT_ONCE: Final = 64  # packets read from one socket before the others are served
RECEIVE_BYTES: Final = 1 << 20

Peer = tuple[str, int]


class UdpLink(FaultyLink[bytes]):
    """Link of one Crazyflie over UDP: socket and client."""

    def __init__(self, random: np.random.Generator, request: DeviceRequest) -> None:
        super().__init__(request.faults, random)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)
        _bind(self.socket, (*SCANNED_PORTS, 0) if request.by_hand else (0,))
        self.socket.setblocking(False)
        self.peer: Peer | None = None  # client; None before the first packet

    @property
    def connected(self) -> bool:
        """Whether the firmware counts its link as connected; without polls of a radio: whether it could be polled."""
        return not (self.silent(self.t) and self.silent(self.t - crazyradio.ACTIVITY_S))

    @property
    def address(self) -> str:
        return f"udp://{HOST}:{self.socket.getsockname()[1]}"

    def send(self, port: Port, channel: int, data: bytes) -> None:
        """Send a packet to the client, if there is one."""
        self.put(bytes((header(port, channel),)) + data)
        self.send_due()

    def send_due(self) -> None:
        """Send packets that are due."""
        for packet in self.due():
            if self.peer is None or self.lost():
                continue
            try:
                self.socket.sendto(packet, self.peer)
            except (BlockingIOError, ConnectionError):
                continue  # lost, as on a radio

    def receive(self) -> bytes | None:
        """Next packet, or None. The newest sender becomes the client, as in Bitcraze's own simulation."""
        while True:
            try:
                packet, sender = self.socket.recvfrom(MAX_PACKET_BYTES)
            except BlockingIOError:
                return None
            except ConnectionError:  # an earlier packet was rejected
                continue
            if packet and not self.lost():
                self.peer = sender
                return packet


def _bind(wire: socket.socket, ports: Sequence[int]) -> None:
    """Bind to the first port that is free; 0 always is."""
    for port in ports:
        try:
            wire.bind((HOST, port))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
        else:
            return


class CrazyflieTwin(Device):
    """Crazyflies with CRTP over UDP or over a software radio.

    Raises BodyError for invalid settings.
    """

    def __init__(self, request: DeviceRequest) -> None:
        body = request.body
        vehicles = [Vehicle(body, request.faults, row) for row in range(len(body.names))]
        self._air: Air | None = None
        self._row: dict[socket.socket, int] = {}
        self.lines = self._open_links(request)
        self.drones = [Drone(vehicle, line.send) for vehicle, line in zip(vehicles, self.lines, strict=True)]
        self.addresses = tuple(line.address for line in self.lines)
        self._gaps = [sorted(vehicle.settings.gaps) for vehicle in vehicles]  # gaps that have not begun
        self._took_off = [inf] * len(vehicles)  # [s] first time of each

    def _open_links(self, request: DeviceRequest) -> Sequence[UdpLink | RadioLink]:
        random = [np.random.default_rng([seed, row]) for row, seed in enumerate(request.body.seeds)]
        if any(each.get("link") == "radio" for each in request.body.device):
            radios = [RadioLink(own, request.faults, row) for row, own in enumerate(random)]
            self._air = Air(radios, request.faults.exchanges_hz)
            return radios
        wires = [UdpLink(own, request) for own in random]
        self._row = {wire.socket: row for row, wire in enumerate(wires)}
        return wires

    def sockets(self) -> Sequence[socket.socket]:
        return list(self._row) if self._air is None else [self._air.socket]

    def serve(self, ready: socket.socket, t: float) -> None:
        if self._air is not None:
            self._air.serve(t, self.deliver)
            return
        row = self._row[ready]
        line = self.lines[row]
        assert isinstance(line, UdpLink)
        line.t = t
        for _ in range(AT_ONCE):
            packet = line.receive()
            if packet is None:
                return
            self.deliver(row, packet)

    def deliver(self, row: int, packet: bytes) -> None:
        try:
            self.drones[row].receive(packet[0] >> 4, packet[0] & 3, packet[1:])
        except (struct.error, IndexError, ValueError, UnicodeDecodeError):
            return  # not a packet of this protocol

    def advance(self, t: float) -> None:
        for row, (line, drone, gaps) in enumerate(zip(self.lines, self.drones, self._gaps, strict=True)):
            line.t = t
            locked = drone.vehicle.advance(t)
            if drone.vehicle.model.flying:
                self._took_off[row] = min(self._took_off[row], t)
            if gaps and t - self._took_off[row] >= gaps[0][0]:
                line.silence(gaps.pop(0)[1])
            if locked:
                drone.console("SUP: Locked, reboot required\n")
            if not line.connected:
                drone.logs.reset()
            for packet in drone.logs.due(t):
                line.send(Port.LOG, 2, packet)
            line.send_due()

    def truth(self) -> tuple[Array, Array]:
        vehicles = [drone.vehicle for drone in self.drones]
        return np.array([vehicle.place for vehicle in vehicles]), np.array([vehicle.model.yaw for vehicle in vehicles])

    def close(self) -> None:
        for used in self.sockets():
            used.close()
