"""CRTP protocol of one Crazyflie: decodes every packet, and sends the answers."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from agents.vectors import difference
from bridges.crazyflie.protocol import crtp
from bridges.crazyflie.protocol.crtp import (
    HighLevel,
    Location,
    LogStatus,
    Misc,
    Platform,
    Port,
    PowerSwitch,
    Setpoint,
    SupervisorCommand,
    Toc,
)
from bridges.crazyflie.protocol.tables import (
    EXTENDED,
    PACKINGS,
    PARAMETER_CODES,
    READ_ONLY,
    VariableTable,
    inventory,
    pack,
)
from bridges.crazyflie.twin.logs import LogBlocks
from bridges.crazyflie.twin.memory import ANCHORS
from bridges.crazyflie.twin.planner import PlannerState
from bridges.crazyflie.twin.trajectories import Trajectories
from bridges.crazyflie.twin.vehicle import Vehicle
from twins.arrays import Array

CONSOLE_TEXTS: Final = {  # parameters that make a Crazyflie write to its console
    "system.assertInfo": "SYS: No assert information found\n",
    "system.storageStats": "STORAGE: Used storage: 1 %\n",
    "system.taskDump": "SYSLOAD: Task dump\n",
    "supervisor.infdmp": "SUP: Supervisor info ---\n",
}
Send = Callable[[Port, int, bytes], None]
LEAST: Final = "posCtlPid.thrustMin"
SIGMA: Final = "locSrv.extPosStdDev"  # noise of external positions [m]
MAX_WHOLE_PARAMETER: Final = 2.0**32  # upper bound of whole parameters, far above any length, angle or speed
LEAST_THRUST, MOST_THRUST = 1000, 60000
TAKEOFFS: Final = (HighLevel.TAKEOFF, HighLevel.OLD_TAKEOFF, HighLevel.TAKEOFF_VELOCITY)
LANDINGS: Final = (HighLevel.LAND, HighLevel.OLD_LAND, HighLevel.LAND_VELOCITY)
DEFAULT_SPEED: Final = 0.5  # [m/s] mean speed of take-offs and landings with velocity that name none


@dataclass
class Drone:
    """Protocol of a vehicle; answers go to `send`.

    A packet that is too short raises `struct.error` or `IndexError`, one with invalid numbers `ValueError`; the device
    drops such packets.
    """

    vehicle: Vehicle
    send: Send
    stored: dict[int, float] = field(default_factory=dict)  # parameters stored on board
    on: bool = True
    thrust_locked: bool = True  # no thrust before a packet of zero thrust

    def __post_init__(self) -> None:
        tables = inventory(tuple(self.vehicle.settings.tables))
        self.parameters, self.log_table = tables.parameters, tables.logs
        self.memories = self.vehicle.decks.memories
        self.logs = LogBlocks(self.vehicle, self.value, tables.logs)
        self.start()
        # answer to a packet on the same port and channel, or None
        self._answer: dict[Port, Callable[[int, bytes], bytes | None]] = {
            Port.LINK: self._link,
            Port.PLATFORM: self._platform,
            Port.SUPERVISOR: self._supervisor,
            Port.PARAM: self._param,
            Port.LOG: self._log,
            Port.MEMORY: self._memory,
            Port.COMMANDER: self._thrust,
            Port.SETPOINT: self._setpoint,
            Port.HIGH_LEVEL: self._high_level,
            Port.LOCATION: self._location,
        }
        self._plans: dict[Sequence[int], Callable[[int, Array, bytes], LogStatus]] = {
            (*TAKEOFFS, *LANDINGS): self._climb,
            (HighLevel.GO_TO, HighLevel.OLD_GO_TO): self._go_to,
            (HighLevel.SPIRAL,): self._spiral,
            (HighLevel.START, HighLevel.START_2): self._follow,
        }

    def start(self) -> None:
        """State after switching on."""
        vehicle, decks = self.vehicle, self.vehicle.decks
        self.thrust_locked = True
        self.memories.restart()
        self.trajectories = Trajectories(self.memories)
        self.logs.began = vehicle.t
        self.values = [variable.value for variable in self.parameters.variables]
        present = {
            "deck.bcLighthouse4": decks.lighthouse,
            "deck.bcLoco": decks.loco,
            "deck.bcDWM1000": decks.loco,
            "deck.bcMultiranger": decks.multiranger,
            "deck.bcFlow2": decks.flow,
            "deck.bcZRanger2": decks.flow,
        }
        for name, deck in present.items():
            if name in self.parameters.number:
                self.values[self.parameters.number[name]] = int(deck)
        for number, value in self.stored.items():
            self.values[number] = value
        vehicle.vertical.least = self.value(LEAST)
        self.logs.reset()

    def value(self, name: str) -> float:
        """Value of a parameter; 0 if this firmware has none of this name."""
        number = self.parameters.number.get(name)
        return 0.0 if number is None else self.values[number]

    def receive(self, port: int, channel: int, data: bytes) -> None:
        """Process one packet."""
        if port in self._answer and (self.on or (port == Port.LINK and channel == 3)):
            answer = self._answer[Port(port)](channel, data)
            if answer is not None:
                self.send(Port(port), channel, answer)

    def console(self, text: str) -> None:
        """Send text on the console port."""
        encoded = text.encode()
        for begin in range(0, len(encoded), crtp.MTU):
            self.send(Port.CONSOLE, 0, encoded[begin : begin + crtp.MTU])

    # ------------------------------------------------------------------ connection

    def _link(self, channel: int, data: bytes) -> bytes | None:
        if channel == 3 and data[:1] == bytes((crtp.NRF,)):
            if data[1] == PowerSwitch.RESET_BEGIN:
                return data[:2] + crtp.ADDRESS
            self.on = data[1] in (PowerSwitch.ON, PowerSwitch.RESET)
            self.vehicle.restart()
            self.start()
            return data[:2]
        answers = {0: data, 1: crtp.GREETING, 3: None if data else b""}  # 0: echo
        return answers.get(channel)

    def _platform(self, channel: int, data: bytes) -> bytes | None:
        command = channel, data[0]
        if command == (crtp.VERSIONS, 0):
            return b"\0" + struct.pack("<I", crtp.VERSION)
        if command == (crtp.VERSIONS, crtp.FIRMWARE):
            return b"\1twin"
        if command == (0, Platform.ARM):
            return data[:1] + self._arm(on=bool(data[1]))
        return data[:1] + self._recover() if command == (0, Platform.RECOVER) else None

    def _arm(self, *, on: bool) -> bytes:
        """Arm or disarm; returns success and state."""
        return bytes((self.vehicle.arm(on=on), self.vehicle.supervisor.armed))

    def _recover(self) -> bytes:
        """Recover from a crash; returns success, and whether it has recovered."""
        done = self.vehicle.supervisor.recover()
        return bytes((done, done))

    def _supervisor(self, channel: int, data: bytes) -> bytes | None:
        command, answer = (channel, data[0]), bytes((data[0] | SupervisorCommand.ANSWER,))
        if command == (0, SupervisorCommand.ASK):
            return answer + struct.pack("<H", self.vehicle.info)
        if command == (1, SupervisorCommand.ARM):
            return answer + self._arm(on=bool(data[1]))
        if command == (1, SupervisorCommand.RECOVER):
            return answer + self._recover()
        if command == (1, SupervisorCommand.STOP):
            self.vehicle.supervisor.stop()
        elif command == (1, SupervisorCommand.WATCHDOG):
            self.vehicle.supervisor.reset_watchdog(self.vehicle.t)
        return None

    # ------------------------------------------------------------------ parameters, logs, memories

    @staticmethod
    def _table(table: VariableTable, data: bytes, limits: bytes = b"") -> bytes | None:
        if data[0] == Toc.INFO:
            return crtp.TOC_INFO.pack(Toc.INFO, len(table.items), table.crc) + limits
        if data[0] == Toc.ITEM:
            (number,) = crtp.IDENT.unpack_from(data, 1)
            return data[:3] + table.items[number] if number < len(table.items) else data[:1]
        return None

    def _param(self, channel: int, data: bytes) -> bytes | None:
        table = self.parameters
        if channel == 0:
            return self._table(table, data)
        if channel == 3:
            return self._set_by_name(data) if data[0] == Misc.SET_BY_NAME else self._param_misc(data)
        (number,) = crtp.IDENT.unpack_from(data)
        if number >= len(table.variables):
            return data[:2] + bytes((LogStatus.UNKNOWN,))
        variable = table.variables[number]
        if channel == crtp.PARAM_READ:
            return data[:2] + b"\0" + pack(variable.type, self.values[number])
        if variable.flags & READ_ONLY:
            return None  # a write to a constant is never answered
        (value,) = _numbers(PACKINGS[variable.type], data[2:])
        self._set(number, value)
        return data

    def _set_by_name(self, data: bytes) -> bytes:
        group, name, rest = data[1:].split(b"\0", 2)
        number = self.parameters.number.get(f"{group.decode()}.{name.decode()}")
        status = LogStatus.UNKNOWN
        if number is not None:
            kind = self.parameters.variables[number].type
            if PARAMETER_CODES[kind] == rest[0]:
                status = LogStatus.OK
                self._set(number, _numbers(PACKINGS[kind], rest[1:])[0])
        return data[: len(group) + len(name) + 3] + bytes((status,))

    def _param_misc(self, data: bytes) -> bytes | None:
        variables = self.parameters.variables
        command, number = crtp.ITEM.unpack_from(data)
        known = data[: crtp.ITEM.size]
        if number >= len(variables):
            return known + bytes((LogStatus.UNKNOWN,))
        variable = variables[number]
        extended = bytes((1 if variable.flags & EXTENDED else 0,))
        default = pack(variable.type, variable.value)
        if command == Misc.STORE:
            self.stored[number] = self.values[number]
        elif command == Misc.CLEAR:
            self.stored.pop(number, None)
        kept = self.stored.get(number)
        answers = {
            Misc.EXTENDED: extended,
            Misc.EXTENDED_2: b"\0" + extended,
            Misc.DEFAULT_2: b"\0" + default,
            Misc.STORE: b"\0",
            Misc.CLEAR: b"\0",
            Misc.STORED: b"\0" + default if kept is None else b"\1" + default + pack(variable.type, kept),
        }
        return known + answers[command] if command in answers else None

    def _set(self, number: int, value: float) -> None:
        """Set a parameter and apply its effect."""
        before, self.values[number] = self.values[number], value
        name, vehicle = self.parameters.variables[number].name, self.vehicle
        if name == "kalman.resetEstimation" and value:
            place = self.value("kalman.initialX"), self.value("kalman.initialY"), self.value("kalman.initialZ")
            yaw = self.value("kalman.initialYaw") - vehicle.model.yaw
            vehicle.estimator.reset(difference(place, vehicle.place), yaw, vehicle.model.velocity)
        elif name == LEAST:
            vehicle.vertical.least = value
        elif name == "lighthouse.systemType" and value != before:
            self.memories.clear_stations()
        elif name == "stabilizer.stop" and value:
            vehicle.supervisor.stop()
        elif name == "memTst.resetW" and value:
            self.memories.write_errors = 0
        elif name in CONSOLE_TEXTS and value:
            self.console(CONSOLE_TEXTS[name])

    def _log(self, channel: int, data: bytes) -> bytes | None:
        if channel == 0:
            return self._table(self.log_table, data, bytes((crtp.LOG_BLOCKS, crtp.LOG_VARIABLES)))
        if channel != 1:
            return None
        block = data[1] if len(data) > 1 else 0
        return bytes((data[0], block, self.logs.execute(data[0], block, data[2:], self.vehicle.t)))

    def _memory(self, channel: int, data: bytes) -> bytes | None:
        memories = self.memories
        if channel == 0:
            if data[0] == 1:
                return bytes((1, len(memories.listed)))
            known = data[0] == 2 and data[1] < len(memories.listed)
            return crtp.MEMORY_INFO.pack(2, data[1], *memories.listed[data[1]]) if known else None
        number, address = crtp.MEMORY.unpack_from(data)
        head, rest = data[: crtp.MEMORY.size], data[crtp.MEMORY.size :]
        read: bytes | None = b""
        if channel == 1:
            read = memories.read_number(number, address, rest[0])
        elif number >= len(memories.kinds) or not memories.write(memories.kinds[number], address, rest):
            read = None
        return head + (bytes((LogStatus.IO,)) if read is None else bytes((LogStatus.OK,)) + read)

    # ------------------------------------------------------------------ motion

    def _command(self, **setpoint: object) -> None:
        self.vehicle.planner.stop()
        self.vehicle.commander.command(self.vehicle.t, **setpoint)  # type: ignore[arg-type]

    def _thrust(self, _channel: int, data: bytes) -> None:
        roll, pitch, turn, thrust = _numbers(crtp.THRUST, data)
        self.thrust_locked = self.thrust_locked and thrust > 0
        on = thrust >= LEAST_THRUST and not self.thrust_locked
        lean = math.radians(roll), math.radians(pitch)
        self._command(on=on, thrust=min(thrust, MOST_THRUST), turn=math.radians(turn), lean=lean)

    def _setpoint(self, channel: int, data: bytes) -> None:
        if channel == 1:
            if data[0] == 0:
                self.vehicle.commander.release()
            return
        kind, rest = data[0], data[1:]
        free = math.nan
        sense = -1.0 if kind in (Setpoint.OLD_VELOCITY, Setpoint.OLD_HEIGHT, Setpoint.OLD_HOVER) else 1.0
        if kind == Setpoint.POSITION:
            x, y, z, yaw = _numbers(crtp.FOUR, rest)
            self._command(target=(x, y, z), heading=math.radians(yaw))
        elif kind in (Setpoint.VELOCITY, Setpoint.OLD_VELOCITY):
            vx, vy, vz, turn = _numbers(crtp.FOUR, rest)
            self._command(velocity=(vx, vy, vz), turn=sense * math.radians(turn))
        elif kind in (Setpoint.HOVER, Setpoint.OLD_HOVER):
            vx, vy, turn, z = _numbers(crtp.FOUR, rest)
            self._command(velocity=(vx, vy, free), target=(free, free, z), turn=sense * math.radians(turn), body=True)
        elif kind in (Setpoint.HEIGHT, Setpoint.OLD_HEIGHT, Setpoint.CLIMB_RATE):
            roll, pitch, turn, z = _numbers(crtp.FOUR, rest)
            vertical = "velocity" if kind == Setpoint.CLIMB_RATE else "target"
            lean = math.radians(roll), math.radians(pitch)
            self._command(**{vertical: (free, free, z)}, turn=sense * math.radians(turn), lean=lean)
        elif kind == Setpoint.FULL_STATE:
            values = crtp.FULL_STATE.unpack_from(rest)
            x, y, z = (crtp.MM * value for value in values[:3])
            self._command(target=(x, y, z), heading=crtp.yaw_of(values[9]))
        else:  # a stop, and what the firmware does not know: all zero
            self._command(on=False)

    def _high_level(self, _channel: int, data: bytes) -> bytes:
        return data[:3].ljust(3, b"\0") + bytes((self._plan(data[0], data[1], data[2:]),))

    def _plan(self, command: int, group: int, data: bytes) -> LogStatus:
        vehicle, planner = self.vehicle, self.vehicle.planner
        if command == HighLevel.DEFINE:  # the number of the trajectory is in the place of the mask
            return self.trajectories.define(group, *crtp.DEFINE.unpack_from(data))
        if command == HighLevel.GROUP:
            if (number := self.parameters.number.get("hlCommander.groupmask")) is not None:
                self.values[number] = group
            return LogStatus.OK
        if group and not group & int(self.value("hlCommander.groupmask")):
            return LogStatus.OK
        if command == HighLevel.STOP:
            planner.stop()
            return LogStatus.OK
        begin = next((plans for commands, plans in self._plans.items() if command in commands), None)
        if begin is None or not vehicle.supervisor.may_fly:
            return LogStatus.NO_COMMAND if begin is None else LogStatus.BUSY
        # the firmware plans from its last setpoint while a plan runs, else from its estimate
        pose = vehicle.pose if planner.plan == PlannerState.IDLE else planner.state(vehicle.t)[0]
        return begin(command, pose, data)

    def _climb(self, command: int, pose: Array, data: bytes) -> LogStatus:
        landing = command in LANDINGS
        if command in (HighLevel.OLD_TAKEOFF, HighLevel.OLD_LAND):
            height, span = _numbers(crtp.OLD_CLIMB, data)
            yaw, keep = 0.0, False
        elif command in (HighLevel.TAKEOFF_VELOCITY, HighLevel.LAND_VELOCITY):
            height, relative, yaw, keep, speed = _numbers(crtp.CLIMB_VELOCITY, data)
            height = float(pose[2]) + (-height if landing else height) if relative else height
            span = abs(height - float(pose[2])) / (speed if speed > 0.0 else DEFAULT_SPEED)
        else:
            height, yaw, keep, span = _numbers(crtp.CLIMB, data)
        yaw = float(pose[3]) if keep else yaw
        vehicle = self.vehicle
        return vehicle.planner.climb(vehicle.t, pose, height=height, yaw=yaw, span=span, landing=landing)

    def _go_to(self, command: int, pose: Array, data: bytes) -> LogStatus:
        old = command == HighLevel.OLD_GO_TO
        packing = crtp.OLD_GO_TO if old else crtp.GO_TO
        if any(map(math.isnan, packing.unpack_from(data))) and self.vehicle.model.flying:
            self.vehicle.supervisor.stop()  # no plan has such values: motors off, and locked
            return LogStatus.OK
        relative, *straight, x, y, z, yaw, span = _numbers(packing, data)
        linear = any(straight)
        goal, vehicle = np.array([x, y, z, yaw]), self.vehicle
        return vehicle.planner.go_to(
            vehicle.t, pose, vehicle.model.velocity, goal=goal, span=span, relative=relative, linear=linear
        )

    def _spiral(self, _: int, pose: Array, data: bytes) -> LogStatus:
        sideways, clockwise, angle, first, last, climb, span = _numbers(crtp.SPIRAL, data)
        return self.vehicle.planner.spiral(
            self.vehicle.t,
            pose,
            angle=angle,
            radii=(first, last),
            climb=climb,
            span=span,
            sideways=sideways,
            clockwise=clockwise,
        )

    def _follow(self, command: int, pose: Array, data: bytes) -> LogStatus:
        if command == HighLevel.START:
            (relative, reverse, number, scale), turned = _numbers(crtp.START, data), False
        else:
            relative, turned, reverse, number, scale = _numbers(crtp.START_2, data)
        start = pose if relative else None
        status, pieces = self.trajectories.pieces(number, start, turned=turned, reverse=reverse, scale=scale)
        if pieces:
            self.vehicle.planner.follow(self.vehicle.t, pieces)
        return status

    # ------------------------------------------------------------------ position

    def _location(self, channel: int, data: bytes) -> bytes | None:
        vehicle, decks = self.vehicle, self.vehicle.decks
        if channel == 0:
            vehicle.locate(_numbers(crtp.VECTOR, data), self.value(SIGMA))
            return None
        kind, rest = data[0], data[1:]
        if kind == Location.POSE:
            x, y, z, qx, qy, qz, qw = _numbers(crtp.POSE, rest)
            vehicle.locate((x, y, z), self.value(SIGMA))
            yaw = math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
            vehicle.estimator.turn = math.remainder(yaw - vehicle.model.yaw, math.tau)
        elif kind == Location.LPP and decks.loco:
            if rest[1] == crtp.ANCHOR_POSITION and rest[0] < ANCHORS:
                decks.memories.set_anchor(rest[0], *_numbers(crtp.VECTOR, rest[2:]))
        elif kind == Location.STORE_LIGHTHOUSE:
            decks.memories.stored = struct.unpack_from("<HH", rest)
            return bytes((Location.STORE_LIGHTHOUSE, 1))
        elif kind == Location.STOP:
            vehicle.supervisor.stop()
        elif kind == Location.WATCHDOG:
            vehicle.supervisor.reset_watchdog(vehicle.t)
        return None


def _numbers(packing: struct.Struct, data: bytes) -> tuple[Any, ...]:
    """Numbers packed at the beginning of `data`."""
    values = packing.unpack_from(data)
    if not all(abs(value) <= MAX_WHOLE_PARAMETER for value in values):  # NaN fails too
        raise ValueError(f"{values} are not valid numbers for a robot")
    return values
