"""Trajectories that end on the floor: what lies on board of a Crazyflie for the time when nothing more is received.

Each setpoint is a trajectory in the memory of the planner on board: at once at the setpoint, hold it, descend. The next
one replaces it, so the descent begins only when none comes. A streamed low-level setpoint cannot have such an end: it
makes the firmware forget the planner's trajectory, and 2 s after the last one the motors are cut (commander.c,
supervisor.c). The firmware's default controller uses the position of a trajectory only, as of a streamed setpoint.

The estimate of a drone with positions from outside drifts while nothing is received, by half the error of its
accelerometer times the square of the time: standing on the floor it would believe to sink, and take off again. Its
descent is therefore accelerated by more than that error, and ends in a piece that is not a number. The planner gives
up, and 2 s later the firmware stops the motors and locks them. Only polynomials can say that.

Compressed trajectories take one packet, but releases until 2026 misread a yaw in them (firmware issue 1659): they are
used for yaw 0, and polynomials in several packets for others. Formats: Bitcraze's page on trajectories.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from typing import Any, Final

from agents.clock import uptime
from bridges.crazyflie.protocol import crtp
from bridges.crazyflie.protocol.crazyradio import COUNTERS, NULL
from bridges.crazyflie.protocol.crtp import HighLevel, Port

HOLD_S: Final = 1.0  # [s] least hover before the descent
SINK: Final = 0.3  # [m/s] speed of the descent
BELOW: Final = -1.0  # [m] height at its end: below any floor, because only an order to land stops the motors
STOP_SINK: Final = 0.15  # [m/s²] acceleration of a descent that ends in a stop
WRONG: Final = 0.05  # [m/s²] error of an accelerometer with which it still ends on the floor: 5 mg
STOP_STEP: Final = 0.5  # [m] heights between which its duration is the same, and is not written again
STOP_S: Final = 2.0  # [s] time from its end until the firmware stops and locks the motors
FARTHEST: Final = 32.0  # [m] largest distance from the origin in a compressed trajectory
CHUNK: Final = 24  # [bytes] written by one packet
LONGEST_MS: Final = 0xFFFF
SHORTEST_S: Final = 0.01
# trajectories by number: two of each format, one of which is written while the other is flown, and those of a take-off
COMPRESSED: Final = (0, 1)
POLYNOMIALS: Final = (2, 3)
TAKEOFFS: Final = (4, 5)
# address, and the number of pieces of polynomials, which compressed ones do not need
PLACES: Final = ((0x000, 0), (0x040, 0), (0x100, 2), (0x300, 2), (0x080, 0), (0x500, 3))
REPEAT_S: Final = 0.3  # a part that is not confirmed is written again after this
START_EXPIRY_S: Final = 0.5  # a radio does not deliver a start that has waited for longer
STAMP: Final = struct.Struct("<d")  # time of a start [s, `uptime`], behind what the firmware reads of it

NO_NUMBERS: Final = crtp.PIECE.pack(*[math.nan] * 32, 1.0)  # last piece of a descent that ends in a stop

STARTS: Final = crtp.header(Port.HIGH_LEVEL, 0) & ~COUNTERS

Target = tuple[float, float, float, float]  # x, y, z [m], yaw [rad]
Send = Callable[[Port, int, bytes], None]


def stop_descent_s(height: float, before: float = 0.0) -> float:
    """Duration [s] of a descent that ends in a stop from a height [m], `before` [s] after the last position.

    STOP_SINK T² / 2 = height + WRONG (before + T + STOP_S)² / 2: at the stop a wrong accelerometer has not lifted it.
    """
    top, since = max(STOP_STEP * math.ceil(height / STOP_STEP), STOP_STEP), before + STOP_S
    speed, rest = WRONG * since, STOP_SINK - WRONG
    return (speed + math.sqrt(speed * speed + rest * (2.0 * top + speed * since))) / rest


def rest_to_rest(begin: float, end: float, span: float) -> list[float]:
    """Coefficients (8), constant first, of a motion of `span` [s] without speed, acceleration and jerk at its ends."""
    way = end - begin
    powers = (35.0 * way / span**4, -84.0 * way / span**5, 70.0 * way / span**6, -20.0 * way / span**7)
    return [begin, 0.0, 0.0, 0.0, *powers]


def compressed(place: Sequence[float], hold: float, climb: tuple[float, float] | None = None) -> bytes:
    """Hold x, y, z [m] with yaw 0 for `hold` [s], then sink; see `polynomials`."""
    x, y, z, top = (round(each / crtp.MM) for each in (*place[:3], place[2] if climb is None else climb[0]))
    pieces = [struct.pack("<4h", x, y, z, 0)]
    if climb is not None:  # z: seven control points, of which those at each end are equal: at rest there
        pieces.append(struct.pack("<BH7h", 3 << 4, round(crtp.SECONDS_MS * climb[1]), *[z] * 3, *[top] * 4))
    pieces.append(struct.pack("<BH", 0, round(crtp.SECONDS_MS * hold)))
    sinking = min(max(round((top - BELOW / crtp.MM) / SINK), 1), LONGEST_MS)
    pieces.append(struct.pack("<BHh", 1 << 4, sinking, round(BELOW / crtp.MM)))  # one control point, a straight line
    return b"".join((*pieces, struct.pack("<BH", 0, 0)))


def polynomials(place: Target, hold: float, climb: tuple[float, float] | None = None, *, stops: bool = False) -> bytes:
    """Hold a place for `hold` [s], then sink to `BELOW`; before that `climb` from there to a height [m] in some [s].

    `stops`: without holding, a descent that ends in a stop of the motors.
    """
    x, y, z, yaw = place
    pieces = [] if climb is None else [(rest_to_rest(z, *climb), climb[1])]
    top = z if climb is None else climb[0]
    if stops:
        pieces.append(([top, 0.0, -0.5 * STOP_SINK], stop_descent_s(top, 0.0 if climb is None else climb[1])))
    else:
        pieces += [([top], hold), ([top, -SINK], max((top - BELOW) / SINK, SHORTEST_S))]
    axes = (((x,), (y,), vertical, (yaw,), seconds) for vertical, seconds in pieces)
    packed = [
        crtp.PIECE.pack(*(c for axis in four for c in (*axis, *[0.0] * (8 - len(axis)))), seconds)
        for *four, seconds in axes
    ]
    return b"".join((*packed, NO_NUMBERS if stops else b""))


def _fits(target: Target) -> bool:
    """Whether a compressed trajectory can hold a setpoint."""
    return target[3] == 0.0 and max(map(abs, target[:3])) < FARTHEST


class TrajectoryMemory:
    """Trajectory memory of one Crazyflie, over one link.

    Only what differs is written, one part at a time: a burst of parts would be answered by a burst, behind which poses
    wait. A trajectory is started when the drone has confirmed all of it, because the firmware may start what its memory
    holds before a write that came first (two tasks).
    """

    def __init__(self, send: Send) -> None:
        self.memory = 0  # number of the trajectory memory
        self.stops = False  # descents end in a stop of the motors
        self.start_command = HighLevel.START_2
        self._send = send
        self._written: dict[int, bytes] = {}  # confirmed parts, by address
        self._sent: tuple[int, bytes] | None = None  # address and content of the part that is not confirmed yet,
        self._sent_at = -math.inf  # [s, `uptime`]
        self._upcoming: tuple[int, bytes] | None = None  # number and content of the setpoint that is being written
        self._started = -1  # number of the last trajectory that was started
        self._packets = 0  # sent since then

    def define(self) -> None:
        """Tell the drone where its trajectories are; each is answered."""
        for number, (address, pieces) in enumerate(PLACES):
            kind = crtp.UNCOMPRESSED if pieces else crtp.COMPRESSED
            place = crtp.DEFINE.pack(crtp.IN_MEMORY, kind, address, pieces)
            self._send(Port.HIGH_LEVEL, 0, bytes((HighLevel.DEFINE, number)) + place)

    def note_answer(self, address: int, status: int) -> None:
        """Answer of the drone about a part that was written; one that it refuses is written again after a while."""
        sent = self._sent
        if sent is not None and sent[0] == address and status == 0:
            self._written[address] = sent[1]
            self._sent = None

    def hold(self, target: Target, seconds: float, before_start: Callable[[], None] = lambda: None) -> int:
        """Write the next part of a setpoint that is held for some seconds, or start it when all of it is confirmed.

        A setpoint that has been begun is started before another one is written, unless it has become old in a gap.
        `before_start` is called just before it is started.
        Returns the number of packets that it has taken if it was started, else 0.
        """
        if self._upcoming is None or uptime() - self._sent_at > START_EXPIRY_S:
            short = not self.stops and _fits(target)
            data = compressed(target, seconds) if short else polynomials(target, seconds, stops=self.stops)
            one, other = COMPRESSED if short else POLYNOMIALS
            again = self._started in (one, other) and not self._missing(self._started, data)
            self._upcoming = self._started if again else other if self._started == one else one, data
        number, data = self._upcoming
        if not self._write(number, data):
            return 0
        before_start()
        return self.start(number)

    def write_climb(self, place: Target, climb: tuple[float, float], seconds: float) -> int | None:
        """Write the next part of a climb, see `polynomials`; returns its number when all of it is confirmed."""
        self._upcoming = None  # trajectory of an earlier flight
        short = not self.stops and _fits((*place[:2], climb[0], place[3]))
        data = compressed(place, seconds, climb) if short else polynomials(place, seconds, climb, stops=self.stops)
        number = TAKEOFFS[0 if short else 1]
        return number if self._write(number, data) else None

    def start(self, number: int) -> int:
        """Start a trajectory; returns the number of packets since the last start."""
        packed = (
            crtp.START_2.pack(False, False, False, number, 1.0)
            if self.start_command == HighLevel.START_2
            else crtp.START.pack(False, False, number, 1.0)
        )
        self._send(Port.HIGH_LEVEL, 0, bytes((self.start_command, 0)) + packed + STAMP.pack(uptime()))
        packets, self._packets = self._packets + 1, 0
        self._started, self._upcoming = number, None
        return packets

    def _write(self, number: int, data: bytes) -> bool:
        """Write the next part of a trajectory, unless one is not confirmed yet; True when all of it is."""
        missing = self._missing(number, data)
        now = uptime()
        if missing and (self._sent is None or now - self._sent_at > REPEAT_S):
            address, part = self._sent = missing[0]
            self._written.pop(address, None)
            self._sent_at = now
            self._packets += 1
            self._send(Port.MEMORY, crtp.MEMORY_WRITE, crtp.MEMORY.pack(self.memory, address) + part)
        return not missing

    def _missing(self, number: int, data: bytes) -> list[tuple[int, bytes]]:
        """Addresses and contents of the parts of a trajectory that the drone has not confirmed."""
        begin, _ = PLACES[number]
        parts = ((begin + k, data[k : k + CHUNK]) for k in range(0, len(data), CHUNK))
        return [(address, part) for address, part in parts if self._written.get(address) != part]


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
            if uptime() - born > START_EXPIRY_S:
                data[0] |= NULL  # the counters of safelink stay
                del data[1:]
        return self._radio.send_packet(data)
