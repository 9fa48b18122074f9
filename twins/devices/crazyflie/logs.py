"""Log blocks: variables and periods chosen by the client, and their packets."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from struct import Struct
from typing import Final

import numpy as np

from agents.protocols import crtp
from agents.protocols.crtp import Info, Log, Status
from twins.devices.crazyflie.flock import Flock
from twins.devices.crazyflie.tables import LOG_FORMATS, LOGS

ROOM: Final = (2.0, 2.0, 2.5)  # [m] from the origin to the walls, and height: measured by the Multi-ranger
REACH: Final = 4.0  # [m] of its sensors
NOTHING_MM: Final = 32766  # reading when nothing is in reach
SENSORS: Final = {"front": 0.0, "left": 0.5 * math.pi, "back": math.pi, "right": 1.5 * math.pi}
MILLISECONDS: Final = 0xFFFFFF
BEHIND_S: Final = 1.0  # a block that is later restarts its period

Read = Callable[[], float]


@dataclass
class Block:
    """One log block."""

    variables: list[tuple[Read, Struct, bool]] = field(default_factory=list)
    period: float = 0.0  # [s], 0 while it is stopped
    next: float = 0.0

    @property
    def size(self) -> int:
        """Bytes of its values."""
        return sum(packing.size for _, packing, _ in self.variables)


class LogBlocks:
    """The log blocks of one Crazyflie."""

    def __init__(self, flock: Flock, row: int, parameter: Callable[[str], float]) -> None:
        self._blocks: dict[int, Block] = {}
        known = _variables(flock, row, parameter)
        self._read: list[Read] = [known.get(variable.name, _zero) for variable in LOGS]

    def execute(self, command: int, number: int, rest: bytes, t: float) -> Status:
        """Execute a command for block `number` at time `t` [s]."""
        block = self._blocks.get(number)
        if command == Log.RESET:
            self._blocks.clear()
            return Status.OK
        if command == Log.CREATE:
            return self._create(number, rest)
        if block is None:
            return Status.UNKNOWN
        if command == Log.APPEND:
            return self._append(block, rest)
        if command == Log.START:
            block.period = 0.01 * rest[0]
            block.next = t + block.period
        elif command == Log.STOP:
            block.period = 0.0
        elif command == Log.DELETE:
            del self._blocks[number]
        return Status.OK if command in (Log.START, Log.STOP, Log.DELETE) else Status.NO_COMMAND

    def due(self, t: float) -> Iterator[bytes]:
        """Packets that are due at `t` [s]."""
        stamp = (int(crtp.SECONDS_MS * t) & MILLISECONDS).to_bytes(3, "little")
        for number, block in self._blocks.items():
            if block.period == 0.0 or t < block.next - 1e-6:
                continue
            block.next += block.period
            if block.next < t - BEHIND_S:
                block.next = t + block.period
            values = b"".join(
                packing.pack(_wrapped(read(), packing) if whole else read()) for read, packing, whole in block.variables
            )
            yield bytes((number,)) + stamp + values

    def _create(self, number: int, items: bytes) -> Status:
        if number in self._blocks:
            return Status.EXISTS
        if len(self._blocks) == crtp.LOG_BLOCKS:
            return Status.NO_ROOM
        self._blocks[number] = Block()
        return self._append(self._blocks[number], items)

    def _append(self, block: Block, items: bytes) -> Status:
        for begin in range(0, len(items) - 2, 3):
            kind, number = crtp.ITEM.unpack_from(items, begin)
            if number >= len(LOGS) or kind & 0x0F not in LOG_FORMATS:
                return Status.UNKNOWN
            packing, whole = LOG_FORMATS[kind & 0x0F]
            if block.size + packing.size > crtp.LOG_PAYLOAD:
                return Status.TOO_LARGE
            if sum(len(other.variables) for other in self._blocks.values()) == crtp.LOG_VARIABLES:
                return Status.NO_ROOM
            block.variables.append((self._read[number], packing, whole))
        return Status.OK


def _zero() -> float:
    return 0.0


def _wrapped(value: float, packing: Struct) -> int:
    """Whole number, wrapped to the size of the packing."""
    bits = 8 * packing.size
    whole = int(value) & ((1 << bits) - 1)
    signed = packing.format[-1].islower()
    return whole - (1 << bits) if signed and whole >> (bits - 1) else whole


def _variables(flock: Flock, row: int, parameter: Callable[[str], float]) -> dict[str, Read]:
    """Functions that read the log variables."""
    quadrotor, memories = flock.quadrotor, flock.memories[row]
    read: dict[str, Read] = {}
    for i, axis in enumerate("xyz"):
        read[f"stateEstimate.{axis}"] = lambda i=i: float(flock.estimate[row, i])  # type: ignore[misc]
        read[f"stateEstimate.v{axis}"] = lambda i=i: float(flock.velocity[row, i])  # type: ignore[misc]
        read[f"stateEstimateZ.{axis}"] = lambda i=i: flock.estimate[row, i] / crtp.MM  # type: ignore[misc]
        read[f"stateEstimateZ.v{axis}"] = lambda i=i: flock.velocity[row, i] / crtp.MM  # type: ignore[misc]
        read[f"ctrltarget.{axis}"] = lambda i=i: float(np.nan_to_num(flock.commander.target[row, i]))  # type: ignore[misc]
        read[f"locSrv.{axis}"] = lambda i=i: float(flock.estimator.external[row, i])  # type: ignore[misc]
        read[f"kalman.varP{axis.upper()}"] = lambda: float(flock.estimator.variance[row])
    for sensor, bearing in SENSORS.items():
        read[f"range.{sensor}"] = lambda bearing=bearing: _distance(flock, row, bearing)  # type: ignore[misc]
    read |= {
        "stateEstimate.yaw": lambda: math.degrees(_wrap(quadrotor.yaw[row])),
        "stabilizer.yaw": lambda: math.degrees(_wrap(quadrotor.yaw[row])),
        "stateEstimate.qz": lambda: math.sin(0.5 * quadrotor.yaw[row]),
        "stateEstimate.qw": lambda: math.cos(0.5 * quadrotor.yaw[row]),
        "range.up": lambda: _in_reach(ROOM[2] - flock.place[row, 2]),
        "range.zrange": lambda: _in_reach(flock.place[row, 2]),
        "pm.vbat": lambda: flock.voltage(row),
        "pm.vbatMV": lambda: crtp.SECONDS_MS * flock.voltage(row),
        "pm.batteryLevel": lambda: 100.0 * float(flock.charge[row]),
        "pm.state": lambda: flock.power(row),
        "supervisor.info": lambda: flock.info(row),
        "sys.canfly": lambda: bool(flock.info(row) & Info.CAN_FLY),
        "sys.isFlying": lambda: bool(flock.info(row) & Info.FLYING),
        "radio.isConnected": lambda: 1.0,
        "radio.rssi": lambda: 45.0,
        "lighthouse.status": lambda: flock.station_status(row),
        "lighthouse.bsReceive": lambda: memories.geometries if flock.lighthouse[row] else 0,
        "lighthouse.bsActive": lambda: memories.geometries & memories.calibrations,
        "lighthouse.bsGeoVal": lambda: memories.geometries,
        "lighthouse.bsCalVal": lambda: memories.calibrations,
        "loco.mode": lambda: parameter("loco.mode") or 2.0,  # mode "auto" finds TDoA 2
        "ranging.state": lambda: sum(1 << anchor for anchor in memories.anchors()),
    }
    return read


def _wrap(angle: float) -> float:
    return math.remainder(angle, 2.0 * math.pi)


def _distance(flock: Flock, row: int, bearing: float) -> float:
    """Distance from a row to the wall in the direction `bearing` from its nose [mm]."""
    x, y, _ = flock.place[row]
    angle = float(flock.quadrotor.yaw[row]) + bearing
    ahead = []
    for place, way, wall in ((x, math.cos(angle), ROOM[0]), (y, math.sin(angle), ROOM[1])):
        if abs(way) > 1e-9:
            ahead.append((math.copysign(wall, way) - place) / way)
    return _in_reach(min(ahead))


def _in_reach(distance: float) -> float:
    return distance / crtp.MM if 0.0 <= distance <= REACH else NOTHING_MM
