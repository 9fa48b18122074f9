"""Log blocks: variables and periods chosen by the client, and their packets."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Final

import numpy as np

from agents.vectors import ZERO, Vector
from bridges.crazyflie.protocol import crtp
from bridges.crazyflie.protocol.crtp import Info, Log, LogStatus
from bridges.crazyflie.protocol.tables import LOG_TYPES, PACKINGS, VariableTable, pack
from bridges.crazyflie.twin.vehicle import Vehicle
from twins.arrays import Array
from twins.models.quadrotor import GRAVITY

ROOM: Final = (2.0, 2.0, 2.5)  # [m] distance of the walls from the origin, and height: measured by the Multi-ranger
SENSOR_RANGE_M: Final = 4.0  # [m] range of its sensors
NOTHING_MM: Final = 32766  # reading when nothing is in reach
SENSORS: Final = {"front": 0.0, "left": 0.5 * math.pi, "back": math.pi, "right": 1.5 * math.pi}
MILLISECONDS: Final = 0xFFFFFF
BEHIND_S: Final = 1.0  # a block that is later restarts its period

Read = Callable[[], float]
Numbers = Vector | Array


@dataclass
class Block:
    """One log block."""

    variables: list[tuple[Read, str]] = field(default_factory=list)  # value, and the type in which each is sent
    period: float = 0.0  # [s], 0 while it is stopped
    next: float = 0.0

    @property
    def size(self) -> int:
        """Bytes of its values."""
        return sum(PACKINGS[kind].size for _, kind in self.variables)


class LogBlocks:
    """The log blocks of one Crazyflie."""

    def __init__(self, vehicle: Vehicle, parameter: Callable[[str], float], table: VariableTable) -> None:
        self.began = 0.0  # time at which the drone was switched on [s]
        self._blocks: dict[int, Block] = {}
        known = _motion(vehicle) | _system(vehicle, parameter)  # the others are constants of the table
        self._read: list[Read] = [
            known.get(variable.name, partial(float, variable.value)) for variable in table.variables
        ]

    def reset(self) -> None:
        self._blocks.clear()

    def execute(self, command: int, number: int, rest: bytes, t: float) -> LogStatus:
        """Execute a command for block `number` at time `t` [s]."""
        block = self._blocks.get(number)
        if command == Log.RESET:
            self.reset()
            return LogStatus.OK
        if command == Log.CREATE:
            return self._create(number, rest)
        if block is None:
            return LogStatus.UNKNOWN
        if command == Log.APPEND:
            return self._append(block, rest)
        if command == Log.START:
            block.period = 0.01 * rest[0]
            block.next = t + block.period
        elif command == Log.STOP:
            block.period = 0.0
        elif command == Log.DELETE:
            del self._blocks[number]
        return LogStatus.OK if command in (Log.START, Log.STOP, Log.DELETE) else LogStatus.NO_COMMAND

    def due(self, t: float) -> Iterator[bytes]:
        """Packets that are due at `t` [s]."""
        stamp = (int(crtp.SECONDS_MS * (t - self.began)) & MILLISECONDS).to_bytes(3, "little")
        for number, block in self._blocks.items():
            if block.period == 0.0 or t < block.next - 1e-6:
                continue
            block.next += block.period
            if block.next < t - BEHIND_S:
                block.next = t + block.period
            values = b"".join(pack(kind, read()) for read, kind in block.variables)
            yield bytes((number,)) + stamp + values

    def _create(self, number: int, items: bytes) -> LogStatus:
        if number in self._blocks:
            return LogStatus.EXISTS
        if len(self._blocks) == crtp.LOG_BLOCKS:
            return LogStatus.NO_ROOM
        self._blocks[number] = Block()
        return self._append(self._blocks[number], items)

    def _append(self, block: Block, items: bytes) -> LogStatus:
        for begin in range(0, len(items) - 2, 3):
            code, number = crtp.ITEM.unpack_from(items, begin)
            kind = LOG_TYPES.get(code & 0x0F)
            if number >= len(self._read) or kind is None:
                return LogStatus.UNKNOWN
            if block.size + PACKINGS[kind].size > crtp.LOG_PAYLOAD:
                return LogStatus.TOO_LARGE
            if sum(len(other.variables) for other in self._blocks.values()) == crtp.LOG_VARIABLES:
                return LogStatus.NO_ROOM
            block.variables.append((self._read[number], kind))
        return LogStatus.OK


def _motion(vehicle: Vehicle) -> dict[str, Read]:
    """Estimates, sensors of motion, setpoints."""
    noise = np.random.default_rng(vehicle.row)
    read: dict[str, Read] = {}

    def vector(names: str, of: Callable[[], Numbers], scale: float = 1.0, sigma: float = 0.0) -> None:
        """Add the components of a vector under their names."""
        for i, name in enumerate(names.split()):
            read[name] = lambda i=i: float(scale * of()[i]) + (sigma * noise.standard_normal() if sigma else 0.0)  # type: ignore[misc]

    def level(of: Vector) -> Array:
        """Vector of the world in the level frame with the robot's yaw."""
        cos, sin = math.cos(vehicle.yaw), math.sin(vehicle.yaw)
        return np.array([cos * of[0] + sin * of[1], cos * of[1] - sin * of[0], of[2]])

    def angles() -> Array:
        return np.degrees([*vehicle.attitude, math.remainder(vehicle.yaw, math.tau)])

    def force() -> Array:
        """Specific force [g], which is measured; none in free fall."""
        falls = not vehicle.model.flying and vehicle.place[2] > 0.0
        return np.zeros(3) if falls else level(vehicle.acceleration) / GRAVITY + [0.0, 0.0, 1.0]

    def attitude() -> Array:
        """Quaternion x, y, z, w."""
        roll, pitch, yaw = np.radians(angles()) * [0.5, -0.5, 0.5]  # a positive pitch of the firmware is nose up
        (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
        return np.array(
            [
                sr * cp * cy - cr * sp * sy,
                cr * sp * cy + sr * cp * sy,
                cr * cp * sy - sr * sp * cy,
                cr * cp * cy + sr * sp * sy,
            ]
        )

    def thrust() -> float:
        return float(vehicle.vertical.thrust)

    def target() -> Array:
        return np.asarray(np.nan_to_num(vehicle.commander.target))

    millimetres = 1.0 / crtp.MM
    vector("stateEstimate.x stateEstimate.y stateEstimate.z", lambda: vehicle.estimate)
    vector("kalman.stateX kalman.stateY kalman.stateZ", lambda: vehicle.estimate)
    vector("stateEstimate.vx stateEstimate.vy stateEstimate.vz", lambda: vehicle.velocity)
    vector("kalman.statePX kalman.statePY kalman.statePZ", lambda: level(vehicle.velocity))
    vector("stateEstimate.ax stateEstimate.ay stateEstimate.az", lambda: vehicle.acceleration, 1.0 / GRAVITY)
    vector("stateEstimateZ.x stateEstimateZ.y stateEstimateZ.z", lambda: vehicle.estimate, millimetres)
    vector("stateEstimateZ.vx stateEstimateZ.vy stateEstimateZ.vz", lambda: vehicle.velocity, millimetres)
    vector("stateEstimateZ.ax stateEstimateZ.ay stateEstimateZ.az", lambda: vehicle.acceleration, millimetres)
    for group in ("stateEstimate", "stabilizer", "controller"):
        vector(f"{group}.roll {group}.pitch {group}.yaw", angles)
    vector("stateEstimate.qx stateEstimate.qy stateEstimate.qz stateEstimate.qw", attitude)
    vector("kalman.q1 kalman.q2 kalman.q3 kalman.q0", attitude)
    vector("acc.x acc.y acc.z", force, sigma=0.005)
    vector("gyro.x gyro.y gyro.z", lambda: ZERO, sigma=0.05)
    vector("gyro.xRaw gyro.yRaw gyro.zRaw", lambda: ZERO, sigma=2.0)
    vector("ctrltarget.x ctrltarget.y ctrltarget.z", target)
    vector("posCtl.targetX posCtl.targetY posCtl.targetZ", target)
    vector("ctrltargetZ.x ctrltargetZ.y ctrltargetZ.z", target, millimetres)
    vector("locSrv.x locSrv.y locSrv.z", lambda: vehicle.estimator.external)
    vector("ext_pos.X ext_pos.Y ext_pos.Z", lambda: vehicle.estimator.external)
    for axis in "XYZ":
        for name in (f"kalman.varP{axis}", f"kalman.var{axis}"):
            read[name] = lambda: float(vehicle.estimator.variance)
    for name in ("stabilizer.thrust", "ctrltarget.thrust", "controller.cmd_thrust", "controller.actuatorThrust"):
        read[name] = thrust
    for number in range(1, 5):
        read[f"motor.m{number}"] = read[f"motor.m{number}req"] = thrust
    read["supervisor.accNorm"] = lambda: float(np.linalg.norm(force()))
    read["baro.asl"] = lambda: 72.5 + float(vehicle.place[2]) + 0.05 * noise.standard_normal()
    return read


def _system(vehicle: Vehicle, parameter: Callable[[str], float]) -> dict[str, Read]:
    """Decks, battery, supervisor."""
    memories, read = vehicle.decks.memories, dict[str, Read]()
    for sensor, bearing in SENSORS.items() if vehicle.decks.multiranger else ():
        read[f"range.{sensor}"] = lambda bearing=bearing: _distance(vehicle, bearing)  # type: ignore[misc]
    if vehicle.decks.multiranger:
        read["range.up"] = lambda: _in_reach(ROOM[2] - vehicle.place[2])
    if vehicle.decks.flow:
        read["range.zrange"] = lambda: _in_reach(vehicle.place[2])
    if vehicle.decks.loco:
        read["loco.spiWr"] = read["loco.spiRe"] = lambda: 500.0  # [1/s] accesses of the deck's driver
    read |= {
        "pm.vbat": lambda: float(vehicle.battery.volts),
        "pm.vbatMV": lambda: crtp.SECONDS_MS * float(vehicle.battery.volts),
        "pm.batteryLevel": lambda: vehicle.battery.level,
        "pm.state": lambda: vehicle.battery.power,
        "supervisor.info": lambda: vehicle.info,
        "sys.canfly": lambda: bool(vehicle.info & Info.CAN_FLY),
        "sys.isFlying": lambda: bool(vehicle.info & Info.FLYING),
        "sys.isTumbled": lambda: bool(vehicle.info & Info.TUMBLED),
        "memTst.errCntW": lambda: memories.write_errors,
        "lighthouse.status": lambda: vehicle.decks.station_status,
        "lighthouse.bsReceive": lambda: memories.geometries if vehicle.decks.lighthouse else 0,
        "lighthouse.bsActive": lambda: memories.geometries & memories.calibrations,
        "lighthouse.bsGeoVal": lambda: memories.geometries,
        "lighthouse.bsCalVal": lambda: memories.calibrations,
        "loco.mode": lambda: parameter("loco.mode") or 2.0,  # mode "auto" finds TDoA 2
        "ranging.state": lambda: sum(1 << anchor for anchor in memories.anchors()),
    }
    return read


def _distance(vehicle: Vehicle, bearing: float) -> float:
    """Distance to the wall in the direction `bearing` from the nose [mm]."""
    x, y, _ = vehicle.place
    angle = float(vehicle.model.yaw) + bearing
    ahead = []
    for place, way, wall in ((x, math.cos(angle), ROOM[0]), (y, math.sin(angle), ROOM[1])):
        if abs(way) > 1e-9:
            ahead.append((math.copysign(wall, way) - place) / way)
    return _in_reach(min(ahead))


def _in_reach(distance: float) -> float:
    return distance / crtp.MM if 0.0 <= distance <= SENSOR_RANGE_M else NOTHING_MM
