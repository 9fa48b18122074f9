"""The air between a Crazyradio and the Crazyflies: exchanges, safelink, queues, losses and outages.

The other end is the software dongle of the bridge, below the unmodified radio driver of cflib.
"""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from bridges.crazyflie.protocol import crazyradio
from bridges.crazyflie.protocol.crazyradio import ACK, ANSWER, COUNTERS, DATA_RATES, DOWN, EXCHANGE, NULL, SAFELINK, UP
from bridges.crazyflie.protocol.crtp import Port, header
from twins.device import Faults, FaultyLink

HOST: Final = "127.0.0.1"
CHANNEL: Final = 80
RATE: Final = "2M"
MAX_DATAGRAM_BYTES: Final = 64  # [bytes] longest datagram
AT_ONCE: Final = 64  # exchanges before the models advance
NOTHING: Final = bytes((NULL, 0x01, 0x00))  # acknowledgement of a drone with nothing to send
LOG_DATA: Final = header(Port.LOG, 2)


class RadioLink(FaultyLink[bytes]):
    """Radio chip of one Crazyflie and the queue before it. Its safelink outlives the session of a client."""

    def __init__(self, random: np.random.Generator, faults: Faults, row: int) -> None:
        super().__init__(faults, random)
        self.own = bytes.fromhex(f"E7E7E7E7{row + 1:02X}")  # address on the air
        self.address = ""  # address for the bridge
        self.queue: deque[bytes] = deque()
        self.dropped = 0  # log packets that found the queue full
        self.safelink = False
        self.heard = -np.inf  # last exchange [s]
        self._up = self._down = 1  # counters of safelink
        self._acknowledgement = NOTHING

    @property
    def connected(self) -> bool:
        """Whether the firmware counts its radio as connected; else it removes its log blocks."""
        return self.t - self.heard <= crazyradio.ACTIVITY_S

    def send(self, port: Port, channel: int, data: bytes) -> None:
        """Queue a packet for the client. Answers wait behind log packets, which are dropped when the queue is full."""
        packet = bytes((header(port, channel),)) + data
        if packet[0] == LOG_DATA and len(self.queue) >= crazyradio.QUEUE:
            self.dropped += 1
        else:
            self.queue.append(packet)

    def send_due(self) -> None:
        """Empty the queue of a drone that has lost its radio; other packets wait for exchanges."""
        if not self.connected:
            self.queue.clear()

    def exchange(self, packet: bytes, retries: int) -> tuple[int, bytes, bytes | None]:
        """One exchange: status byte and acknowledgement for the client, and the packet for the drone, or None."""
        received, forwarded = False, None
        for attempt in range(retries + 1):
            if self.lost():
                continue
            if not received:  # the chip recognizes a retransmission and only repeats its acknowledgement
                received, forwarded = True, self._receive(packet)
            if not self.lost():
                return ACK | attempt << 4, self._acknowledgement, forwarded
        return 0, b"", forwarded

    def _receive(self, packet: bytes) -> bytes | None:
        """Update safelink and the acknowledgement; returns the packet for the drone, None for a repetition."""
        self.heard = self.t
        null = packet[0] | COUNTERS == NULL | COUNTERS
        if null and len(packet) == 3 and packet[1] == SAFELINK:
            self.safelink = bool(packet[2])
            self._up, self._down = 1, 1
            self._acknowledgement = packet
            return None
        forwarded = None
        if not self.safelink or bool(packet[0] & UP) != bool(self._up):
            self._up = 1 - self._up
            forwarded = None if null else packet
        if not self.safelink or bool(packet[0] & DOWN) != bool(self._down):
            self._down = 1 - self._down
            self._acknowledgement = self.queue.popleft() if self.queue else NOTHING
        if self.safelink:
            first = self._acknowledgement[0] & ~COUNTERS | (DOWN if self._down else 0)
            self._acknowledgement = bytes((first,)) + self._acknowledgement[1:]
        return forwarded


class Air:
    """Socket on which software dongles exchange packets with the drones of one device."""

    def __init__(self, links: Sequence[RadioLink], hz: float) -> None:
        """Links of the drones, each with its `address`; `hz`: exchanges per second of a dongle."""
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((HOST, 0))
        self.socket.setblocking(False)
        self._rows = {link.own: row for row, link in enumerate(links)}
        self._links = links
        port = self.socket.getsockname()[1]
        for link in links:
            drone = f"radio://0/{CHANNEL}/{RATE}/{link.own.hex().upper()}"
            link.address = crazyradio.software_address(drone, HOST, port, hz)

    def serve(self, t: float, deliver: Callable[[int, bytes], None]) -> None:
        """Answer the exchanges that wait at time `t` [s]; `deliver` gets the row and packet of each that arrived."""
        for _ in range(AT_ONCE):
            try:
                datagram, client = self.socket.recvfrom(MAX_DATAGRAM_BYTES)
            except BlockingIOError:
                return
            except ConnectionError:  # an earlier answer was rejected
                continue
            if len(datagram) <= EXCHANGE.size:
                continue
            number, channel, rate, drone, retries = EXCHANGE.unpack_from(datagram)
            row = self._rows.get(drone)
            status, acknowledgement = 0, b""
            packet = None
            if row is not None and (channel, rate) == (CHANNEL, DATA_RATES[RATE]):
                self._links[row].t = t
                status, acknowledgement, packet = self._links[row].exchange(datagram[EXCHANGE.size :], retries)
            if row is not None and packet is not None:
                deliver(row, packet)
            try:
                self.socket.sendto(ANSWER.pack(number, status) + acknowledgement, client)
            except (BlockingIOError, ConnectionError):
                continue
