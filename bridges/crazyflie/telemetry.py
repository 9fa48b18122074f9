"""What Crazyflies say of themselves, newest values only: written by cflib's threads, read by the robot's loop."""

from __future__ import annotations

from collections.abc import Mapping
from math import nan, radians
from typing import Final

import numpy as np

from agents.arrays import Array
from agents.protocols.crtp import MM, Info, Power
from bridges.crazyflie.link import Link

POSE: Final = {f"stateEstimate.{name}": "float" for name in ("x", "y", "z", "vx", "vy", "vz")} | {
    "stateEstimate.yaw": "FP16"  # two bytes are left of 26: a pose is one packet
}
STATUS: Final = {
    "supervisor.info": "uint16_t",
    "pm.vbat": "FP16",
    "pm.batteryLevel": "uint8_t",
    "pm.state": "int8_t",
    "lighthouse.status": "uint8_t",
    "sys.canfly": "uint8_t",  # these three for firmwares from before the supervisor
    "sys.isFlying": "uint8_t",
    "sys.isTumbled": "uint8_t",
}
RANGES: Final = {f"range.{side}": "uint16_t" for side in ("front", "back", "left", "right", "up")}
BEARING: Final = np.radians([0.0, 180.0, 90.0, -90.0, 0.0])
ELEVATION: Final = np.radians([0.0, 0.0, 0.0, 0.0, 90.0])
OUT_OF_REACH_MM: Final = 8000.0
FULL_V, EMPTY_V = 4.2, 3.0
WORDS: Final = {
    Info.LOCKED: "locked: switch it off and on",
    Info.CRASHED: "crashed",
    Info.TUMBLED: "upside down",
}
STATIONS: Final = ("receives no base station", "misses geometry or calibration of its base stations", "")


class Board:
    """Rows of Crazyflies as they were last heard of; times are of the monotonic clock, minus infinity before the first.

    Attributes:
        heard: (N,) when the pose came [s].
        pose: (N, 7) x, y, z [m], their rates [m/s], yaw [rad].
        placed: (N,) the position estimate has settled: what it says may be believed.
        told: (N,) when the status came [s].
        info: (N,) flags of the supervisor.
        power: (N,) what power management says.
        battery: (N,) charge, 0 to 1.
        stations: (N,) lighthouse.status, or -1.
        scanned: (N,) when the ranges came [s].
        ranges: (N, 5) front, back, left, right, up [m], NaN where nothing is in reach.
        airborne: (N,) motors on, as far as the bridge knows.
    """

    def __init__(self, rows: int) -> None:
        never = np.full(rows, -np.inf)
        self.heard, self.told, self.scanned = never.copy(), never.copy(), never.copy()
        self.pose = np.full((rows, 7), np.nan)
        self.placed = np.zeros(rows, dtype=bool)
        self.info = np.zeros(rows, dtype=np.intp)
        self.power = np.full(rows, int(Power.BATTERY))
        self.battery = np.full(rows, np.nan)
        self.stations = np.full(rows, -1)
        self.ranges = np.full((rows, 5), np.nan)
        self.airborne = np.zeros(rows, dtype=bool)


class Telemetry:
    """One row of a board."""

    def __init__(self, board: Board, row: int, *, lighthouse: bool) -> None:
        """`lighthouse`: the state of its base stations matters."""
        self.board, self.row = board, row
        self._lighthouse = lighthouse

    @property
    def info(self) -> Info:
        """What the supervisor said last."""
        return Info(int(self.board.info[self.row]))

    @property
    def told(self) -> float:
        """When it said so, on the monotonic clock [s]."""
        return float(self.board.told[self.row])

    @property
    def position(self) -> Array:
        """(3,) [m]."""
        return self.board.pose[self.row, :3]

    @property
    def yaw(self) -> float:
        """[rad]."""
        return float(self.board.pose[self.row, 6])

    @property
    def low(self) -> bool:
        """Whether the battery is nearly empty."""
        return bool(self.board.power[self.row] >= Power.LOW)

    def forget(self) -> None:
        """A new connection: nothing is known of the supervisor."""
        self.board.told[self.row] = -np.inf
        self.board.info[self.row] = 0

    def listen(self, link: Link, *, log_hz: float, status_hz: float, ranges_hz: float | None) -> None:
        """Has the row's Crazyflie say what the board shows."""
        link.log("pose", log_hz, POSE, self._pose)
        link.log("status", status_hz, STATUS, self._status)
        if ranges_hz is not None:
            link.log("ranges", ranges_hz, RANGES, self._ranges)

    def words(self) -> str:
        """What is worth saying of the last status."""
        board, row = self.board, self.row
        said = [text for flag, text in WORDS.items() if flag in self.info]
        if board.power[row] >= Power.LOW:
            said.append("battery low")
        if self._lighthouse and board.stations[row] >= 0:
            said.append(STATIONS[min(int(board.stations[row]), len(STATIONS) - 1)])
        return "; ".join(text for text in said if text)

    def _pose(self, t: float, values: Mapping[str, float]) -> None:
        x, y, z, vx, vy, vz, yaw = (values.get(name, nan) for name in POSE)
        self.board.pose[self.row] = x, y, z, vx, vy, vz, radians(yaw)
        self.board.heard[self.row] = t

    def _status(self, t: float, values: Mapping[str, float]) -> None:
        board, row = self.board, self.row
        board.info[row] = int(values["supervisor.info"]) if "supervisor.info" in values else _info(values)
        board.power[row] = int(values.get("pm.state", Power.BATTERY))
        level = values.get("pm.batteryLevel")
        volts = values.get("pm.vbat", nan)
        board.battery[row] = (volts - EMPTY_V) / (FULL_V - EMPTY_V) if level is None else 0.01 * level
        board.stations[row] = int(values.get("lighthouse.status", -1))
        board.told[row] = t

    def _ranges(self, t: float, values: Mapping[str, float]) -> None:
        seen = (values.get(name, OUT_OF_REACH_MM) for name in RANGES)
        self.board.ranges[self.row] = [nan if mm >= OUT_OF_REACH_MM else MM * mm for mm in seen]
        self.board.scanned[self.row] = t


def _info(values: Mapping[str, float]) -> Info:
    """What a supervisor would say, from what firmwares without one do."""
    info = Info(0)
    if values.get("sys.canfly"):
        info |= Info.ARMED | Info.CAN_FLY
    if values.get("sys.isFlying"):
        info |= Info.FLYING
    if values.get("sys.isTumbled"):
        info |= Info.TUMBLED
    return info
