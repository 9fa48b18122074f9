"""Trajectories that end on the floor: what lies on board of a Crazyflie for the time when nothing more is received.

Each setpoint is a trajectory in the memory of the planner on board: at once at the setpoint, hold it, descend. The next
one replaces it, so the descent begins only when none comes. A streamed low-level setpoint cannot have such an end: it
makes the firmware forget the planner's trajectory, and 2 s after the last one the motors are cut (commander.c,
supervisor.c). The firmware's default controller uses the position of a trajectory only, as of a streamed setpoint.

Compressed trajectories take one packet, but releases until 2026 misread a yaw in them (firmware issue 1659): they are
used for yaw 0, and polynomials in several packets for others. Formats: Bitcraze's page on trajectories.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

from agents.protocols import crtp
from agents.protocols.crazyradio import COUNTERS, NULL
from agents.protocols.crtp import HighLevel, Port

HOLD_S: Final = 1.0  # at least, before the descent
SINK: Final = 0.3  # [m/s] of the descent
BELOW: Final = -1.0  # [m] height at its end: below any floor, because only an order to land stops the motors
FARTHEST: Final = 32.0  # [m] from the origin in a compressed trajectory
CHUNK: Final = 24  # [bytes] written by one packet
LONGEST_MS: Final = 0xFFFF
SHORTEST_S: Final = 0.01
# trajectories by number: a compressed one, of which only the end, nearly always the same, is read after its start; two
# lists of polynomials, one of which is written while the other is flown, and those of a take-off; address, pieces
COMPRESSED, FIRST, SECOND, TAKEOFF = range(4)
PLACES: Final = ((0x000, 0), (0x100, 2), (0x300, 2), (0x500, 3))
START_EXPIRY_S: Final = 0.5  # a radio does not deliver a start that has waited for longer
STAMP: Final = struct.Struct("<d")  # time of a start [s, monotonic], behind what the firmware reads of it

STARTS: Final = crtp.header(Port.HIGH_LEVEL, 0) & ~COUNTERS

Target = tuple[float, float, float, float]  # x, y, z [m], yaw [rad]
Send = Callable[[Port, int, bytes], None]


def rest_to_rest(begin: float, end: float, span: float) -> list[float]:
    """Coefficients (8), constant first, of a motion of `span` [s] without speed, acceleration and jerk at its ends."""
    way = end - begin
    powers = (35.0 * way / span**4, -84.0 * way / span**5, 70.0 * way / span**6, -20.0 * way / span**7)
    return [begin, 0.0, 0.0, 0.0, *powers]


def compressed(place: Sequence[float], hold: float) -> bytes:
    """Hold x, y, z [m] with yaw 0 for `hold` [s], then sink to `BELOW`."""
    sinking = min(max(round(crtp.SECONDS_MS * (place[2] - BELOW) / SINK), 1), LONGEST_MS)
    return b"".join(
        (
            struct.pack("<4h", *(round(each / crtp.MM) for each in place[:3]), 0),
            struct.pack("<BH", 0, round(crtp.SECONDS_MS * hold)),
            struct.pack("<BHh", 1 << 4, sinking, round(BELOW / crtp.MM)),  # z: one control point, a straight line
            struct.pack("<BH", 0, 0),
        )
    )


def polynomials(place: Target, hold: float, climb: tuple[float, float] | None = None) -> bytes:
    """Hold a place for `hold` [s], then sink to `BELOW`; before that `climb` from it to a height [m] in a time [s]."""
    x, y, z, yaw = place
    pieces = [] if climb is None else [(rest_to_rest(z, *climb), climb[1])]
    top = z if climb is None else climb[0]
    pieces += [([top], hold), ([top, -SINK], max((top - BELOW) / SINK, SHORTEST_S))]
    axes = (((x,), (y,), vertical, (yaw,), seconds) for vertical, seconds in pieces)
    return b"".join(
        crtp.PIECE.pack(*(c for axis in four for c in (*axis, *[0.0] * (8 - len(axis)))), seconds)
        for *four, seconds in axes
    )


class Trajectories:
    """Trajectory memory of one Crazyflie, over one link.

    Of polynomials only what differs is written, and they are started when the drone has confirmed all of it.
    """

    def __init__(self, send: Send) -> None:
        self.memory = 0  # number of the trajectory memory
        self.start_command = HighLevel.START_2
        self._send = send
        self._written: dict[int, bytes] = {}  # confirmed parts, by address
        self._sent: dict[int, bytes] = {}  # parts that are not confirmed yet
        self._upcoming: bytes | None = None  # polynomials that are not started yet,
        self._number = FIRST  # and their number
        # the compressed one is of this flight: the firmware may start it before it has written the last one (two tasks)
        self._current = False

    def define(self) -> None:
        """Tell the drone where its trajectories are; each is answered."""
        for number, (address, pieces) in enumerate(PLACES):
            kind = crtp.COMPRESSED if number == COMPRESSED else crtp.UNCOMPRESSED
            place = crtp.DEFINE.pack(crtp.IN_MEMORY, kind, address, pieces)
            self._send(Port.HIGH_LEVEL, 0, bytes((HighLevel.DEFINE, number)) + place)

    def note_answer(self, address: int, status: int) -> None:
        """Answer of the drone about a part that was written."""
        self._current |= address == PLACES[COMPRESSED][0] and status == 0
        part = self._sent.pop(address, None)
        if part is not None and status == 0:
            self._written[address] = part

    def hold(self, target: Target, seconds: float) -> int:
        """Send a setpoint that is held for some seconds, or a part of it; returns the number of packets."""
        if target[3] == 0.0 and max(map(abs, target[:3])) < FARTHEST:
            self._upcoming = None
            self._write_part(PLACES[COMPRESSED][0], compressed(target, seconds))
            return 1 + (self._start(COMPRESSED) if self._current else 0)
        self._current = False
        self._upcoming = self._upcoming or polynomials(target, seconds)
        packets = self._write(self._number, self._upcoming)
        if packets == 0:
            packets, self._upcoming = self._start(self._number), None
            self._number = SECOND if self._number == FIRST else FIRST
        return packets

    def climb(self, place: Target, climb: tuple[float, float], seconds: float) -> None:
        """Write a climb from a place to a height [m] in a time [s], or start it once the drone has confirmed it."""
        self._current, self._upcoming = False, None  # of an earlier flight
        if self._write(TAKEOFF, polynomials(place, seconds, climb)) == 0:
            self._start(TAKEOFF)

    def _write(self, number: int, data: bytes) -> int:
        address, _ = PLACES[number]
        parts = {address + k: data[k : k + CHUNK] for k in range(0, len(data), CHUNK)}
        missing = {at: part for at, part in parts.items() if self._written.get(at) != part}
        for at, part in missing.items():
            self._written.pop(at, None)
            self._sent[at] = part
        return sum(self._write_part(at, part) for at, part in missing.items())

    def _write_part(self, address: int, part: bytes) -> int:
        self._send(Port.MEMORY, crtp.MEMORY_WRITE, crtp.MEMORY.pack(self.memory, address) + part)
        return 1

    def _start(self, number: int) -> int:
        packed = (
            crtp.START_2.pack(False, False, False, number, 1.0)
            if self.start_command == HighLevel.START_2
            else crtp.START.pack(False, False, number, 1.0)
        )
        self._send(Port.HIGH_LEVEL, 0, bytes((self.start_command, 0)) + packed + STAMP.pack(time.monotonic()))
        return 1


class PromptRadio:
    """Radio below cflib's driver, which repeats a packet until it is answered: here no start that has become old.

    After a gap it would lift a drone again that has landed meanwhile.
    """

    def __init__(self, radio: Any) -> None:  # noqa: ANN401 - cflib's
        self._radio = radio

    def send_packet(self, data: Any) -> Any:  # noqa: ANN401
        """See cflib's Crazyradio."""
        if data[0] & ~COUNTERS == STARTS and data[1] in (HighLevel.START, HighLevel.START_2):
            (born,) = STAMP.unpack(bytes(data[-STAMP.size :]))
            if time.monotonic() - born > START_EXPIRY_S:
                data[0] |= NULL  # the counters of safelink stay
                del data[1:]
        return self._radio.send_packet(data)
