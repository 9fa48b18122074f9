"""Telemetry of Crazyflies, newest values only: written by cflib's threads, read by the robot's loop."""

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
    "sys.canfly": "uint8_t",  # these three for firmwares without a supervisor
    "sys.isFlying": "uint8_t",
    "sys.isTumbled": "uint8_t",
}
RANGES: Final = {f"range.{side}": "uint16_t" for side in ("front", "back", "left", "right", "up")}
BEARING: Final = np.radians([0.0, 180.0, 90.0, -90.0, 0.0])
ELEVATION: Final = np.radians([0.0, 0.0, 0.0, 0.0, 90.0])
OUT_OF_REACH_MM: Final = 8000.0
FULL_V, EMPTY_V = 4.2, 3.0
INFO_TEXT: Final = {
    Info.LOCKED: "locked: switch it off and on",
    Info.CRASHED: "crashed",
    Info.TUMBLED: "upside down",
}
STATION_TEXT: Final = ("receives no base station", "misses geometry or calibration of its base stations", "")


class Board:
    """Newest telemetry of N Crazyflies; times of reception on the monotonic clock [s], -inf before the first."""

    def __init__(self, rows: int) -> None:
        never = np.full(rows, -np.inf)
        self.pose_time, self.status_time, self.ranges_time = never.copy(), never.copy(), never.copy()  # (N,) [s]
        self.pose = np.full((rows, 7), np.nan)  # x, y, z [m], their rates [m/s], yaw [rad]
        self.settled = np.zeros(rows, dtype=bool)  # position estimate has settled and may be used
        self.info = np.zeros(rows, dtype=np.intp)  # flags of the supervisor
        self.power = np.full(rows, int(Power.BATTERY))  # state of power management
        self.battery = np.full(rows, np.nan)  # charge, 0 to 1
        self.volts = np.full(rows, np.nan)  # of the battery [V]
        self.stations = np.full(rows, -1)  # lighthouse.status, or -1
        self.ranges = np.full((rows, 5), np.nan)  # front, back, left, right, up [m]; NaN: nothing in reach
        self.airborne = np.zeros(rows, dtype=bool)  # motors on, as far as the bridge knows


class Telemetry:
    """One row of a board."""

    def __init__(self, board: Board, row: int, *, lighthouse: bool) -> None:
        """`lighthouse`: report the state of the base stations."""
        self.board, self.row = board, row
        self._lighthouse = lighthouse

    @property
    def info(self) -> Info:
        """Last flags of the supervisor."""
        return Info(int(self.board.info[self.row]))

    @property
    def status_time(self) -> float:
        """Time of the last status on the monotonic clock [s]."""
        return float(self.board.status_time[self.row])

    @property
    def position(self) -> Array:
        """(3,) [m]."""
        return self.board.pose[self.row, :3]

    @property
    def yaw(self) -> float:
        """[rad]."""
        return float(self.board.pose[self.row, 6])

    @property
    def battery_low(self) -> bool:
        """Whether the battery is nearly empty."""
        return bool(self.board.power[self.row] >= Power.LOW)

    def reset_status(self) -> None:
        """Clear the status at a new connection."""
        self.board.status_time[self.row] = -np.inf
        self.board.info[self.row] = 0

    def start_logging(self, link: Link, *, log_hz: float, status_hz: float, ranges_hz: float | None) -> None:
        """Start the log blocks that fill the board."""
        link.start_log("pose", log_hz, POSE, self._pose)
        link.start_log("status", status_hz, STATUS, self._status)
        if ranges_hz is not None:
            link.start_log("ranges", ranges_hz, RANGES, self._ranges)

    def status_text(self) -> str:
        """Faults in the last status, for users."""
        board, row = self.board, self.row
        faults = [text for flag, text in INFO_TEXT.items() if flag in self.info]
        if board.power[row] >= Power.LOW:
            faults.append("battery low")
        if self._lighthouse and board.stations[row] >= 0:
            faults.append(STATION_TEXT[min(int(board.stations[row]), len(STATION_TEXT) - 1)])
        return "; ".join(text for text in faults if text)

    def _pose(self, t: float, values: Mapping[str, float]) -> None:
        x, y, z, vx, vy, vz, yaw = (values.get(name, nan) for name in POSE)
        self.board.pose[self.row] = x, y, z, vx, vy, vz, radians(yaw)
        self.board.pose_time[self.row] = t

    def _status(self, t: float, values: Mapping[str, float]) -> None:
        board, row = self.board, self.row
        board.info[row] = int(values["supervisor.info"]) if "supervisor.info" in values else _info(values)
        board.power[row] = int(values.get("pm.state", Power.BATTERY))
        level = values.get("pm.batteryLevel")
        volts = values.get("pm.vbat", nan)
        board.battery[row] = (volts - EMPTY_V) / (FULL_V - EMPTY_V) if level is None else 0.01 * level
        board.volts[row] = volts
        board.stations[row] = int(values.get("lighthouse.status", -1))
        board.status_time[row] = t

    def _ranges(self, t: float, values: Mapping[str, float]) -> None:
        measured = (values.get(name, OUT_OF_REACH_MM) for name in RANGES)
        self.board.ranges[self.row] = [nan if mm >= OUT_OF_REACH_MM else MM * mm for mm in measured]
        self.board.ranges_time[self.row] = t


def _info(values: Mapping[str, float]) -> Info:
    """Flags of a supervisor, from the variables of firmwares that have none."""
    info = Info(0)
    if values.get("sys.canfly"):
        info |= Info.ARMED | Info.CAN_FLY
    if values.get("sys.isFlying"):
        info |= Info.FLYING
    if values.get("sys.isTumbled"):
        info |= Info.TUMBLED
    return info
