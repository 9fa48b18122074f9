"""Telemetry of Crazyflies, newest values only: written by cflib's threads, read by the robot's loop.

The age of a pose follows from the drone's own time stamp, not from its arrival. Queues on board, in the radio and in
this computer hold packets back for seconds without losing one.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import exp, inf, isfinite, nan, radians
from typing import Final

from agents.clock import StampAge, uptime
from bridges.crazyflie.delay import ClimbLog
from bridges.crazyflie.link import CrazyflieLink
from bridges.crazyflie.positioning import SETTLED_BELOW
from bridges.crazyflie.protocol.crtp import MM, Info, Power

# for firmwares without a supervisor
OLD_INFO: Final = {"sys.canfly": Info.ARMED | Info.CAN_FLY, "sys.isFlying": Info.FLYING, "sys.isTumbled": Info.TUMBLED}
PLACE: Final = tuple(f"stateEstimateZ.{name}" for name in ("x", "y", "z", "vx", "vy", "vz"))  # [mm], [mm/s]
YAW: Final = "stateEstimate.yaw"  # [degrees]
VARIANCE: Final = "kalman.varPX"  # [m²]
STATE: Final = (
    dict.fromkeys(PLACE, "int16_t")
    | {  # 25 bytes of 26: pose and status are one packet
        YAW: "FP16",
        VARIANCE: "FP16",
        "supervisor.info": "uint16_t",
        "pm.vbat": "FP16",
        "pm.state": "int8_t",
        "lighthouse.status": "uint8_t",
    }
    | dict.fromkeys(OLD_INFO, "uint8_t")
)
RANGES: Final = {f"range.{side}": "uint16_t" for side in ("front", "back", "left", "right", "up")}
BEARING: Final = tuple(map(radians, (0.0, 180.0, 90.0, -90.0, 0.0)))
ELEVATION: Final = tuple(map(radians, (0.0, 0.0, 0.0, 0.0, 90.0)))
OUT_OF_REACH_MM: Final = 8000.0
# voltages of a full and an empty cell at rest, and their sag in the air [V]
FULL_V, EMPTY_V, SAG_V = 4.2, 3.5, 0.3
SMOOTHING_S: Final = 2.0  # time constant of the voltage: a short load is no empty battery
WRAP_MS: Final = 1 << 24  # stamps of log packets have 24 bits
BACK_MS: Final = 1000  # a stamp that is further back comes from a drone that was switched off and on
AHEAD_S: Final = 10.0  # likewise one that is further ahead: longer than a full queue with late packets
LATE_S: Final = 2.0  # largest age of the first packet over a new connection: no queue outlives one
DRIFT: Final = 1e-4  # [s/s] largest difference between the clocks of a drone and of this computer
INFO_TEXT: Final = {
    Info.LOCKED: "locked: switch it off and on",
    Info.CRASHED: "crashed: put it upright on the floor; then set recover = true, or switch it off and on",
    Info.TUMBLED: "upside down",
}
STATION_TEXT: Final = ("receives no base station", "misses geometry or calibration of its base stations", "")
MEASURING: Final = len(STATION_TEXT) - 1  # lighthouse.status of a deck that measures


class PacketAge:
    """Age of packets of one drone, by stamps that overflow, on a clock that restarts with the drone."""

    def __init__(self) -> None:
        self.restarted = False  # the clock of the drone restarted
        self.connected_anew = False  # the next packet is the first over a new connection
        self._last: int | None = None  # stamp without its overflows [ms]
        self._ages = StampAge(DRIFT)

    def age(self, arrival: float, stamp: int) -> float:
        """Age [s] of a packet with this stamp [ms, 24 bits] that arrived at `arrival` [s]."""
        if self._last is None:
            self._last = stamp
        since = (stamp - self._last + WRAP_MS // 2) % WRAP_MS - WRAP_MS // 2
        change = arrival - 1e-3 * (self._last + since) - self._ages.least  # change of the smallest difference
        jumped = isfinite(change) and (change < -AHEAD_S or (self.connected_anew and change > LATE_S))
        self.connected_anew = False
        if since < -BACK_MS or jumped:
            self.restarted = True
            self._last, self._ages.least = stamp, inf
        elif since > 0:
            self._last += since
        return self._ages.lateness(arrival, 1e-3 * (self._last + min(since, 0)))


class Telemetry:
    """Newest telemetry of one Crazyflie; times on the clock `uptime` [s], -inf before the first."""

    def __init__(self, *, lighthouse: bool, absolute: bool = False) -> None:
        """`lighthouse`: has base stations; `absolute`: positions are measured, see `Convergence`."""
        self.stamps = PacketAge()
        self.arrival = -inf  # arrival of the last packet of a log
        self.status_time = -inf  # time of the last status over this connection
        self.pose_time = self.ranges_time = -inf  # time of the last pose that was measured
        self.pose: tuple[float, ...] = (nan,) * 7  # x, y, z [m], their rates [m/s], yaw [rad]
        self.settled = False  # position estimate has settled and may be used
        self.info = Info(0)  # flags of the supervisor
        self.reports_plans = False  # the firmware reports whether its planner is active
        self.power = int(Power.BATTERY)  # state of power management
        self.battery = nan  # charge, 0 to 1
        self.volts = nan  # voltage of the battery [V]
        self.stations = -1  # lighthouse.status, or -1
        self.ranges = (nan,) * len(RANGES)  # front, back, left, right, up [m]; NaN: nothing in reach
        self.climb = ClimbLog()
        self.airborne = False  # motors on, as far as the bridge knows
        self._lighthouse, self._absolute = lighthouse, absolute

    @property
    def battery_low(self) -> bool:
        """Whether the battery is nearly empty."""
        return self.power >= Power.LOW

    @property
    def pose_age(self) -> float:
        """Age of the last pose [s]; infinity before the first."""
        return uptime() - self.pose_time

    def reset_status(self) -> None:
        """Clear the status at a new connection; whether the drone was switched off and on, its next packet tells."""
        self.stamps.restarted, self.stamps.connected_anew = False, True
        self.arrival = -inf
        self.status_time = -inf
        self.info = Info(0)

    def start_logging(self, link: CrazyflieLink, *, log_hz: float, ranges_hz: float | None) -> None:
        """Start the log blocks."""
        link.start_log("state", log_hz, STATE, self._state)
        if ranges_hz is not None:
            link.start_log("ranges", ranges_hz, RANGES, self._ranges)

    def status_text(self) -> str:
        """Faults in the last status, for users."""
        faults = [text for flag, text in INFO_TEXT.items() if flag in self.info]
        if self.battery_low:
            faults.append("battery low")
        if self._lighthouse and self.stations >= 0:
            faults.append(STATION_TEXT[min(self.stations, MEASURING)])
        return "; ".join(text for text in faults if text)

    def _stamped(self, t: float, stamp: int) -> float:
        """Time [s] of the measurement of a packet that arrived at `t` [s]."""
        self.arrival = t
        return t - self.stamps.age(t, stamp)

    def _state(self, t: float, stamp: int, values: Mapping[str, float]) -> None:
        measured = self._stamped(t, stamp)
        place = (MM * values.get(name, nan) for name in PLACE)
        self.pose = *place, radians(values.get(YAW, nan))
        old = sum(flags for name, flags in OLD_INFO.items() if values.get(name))
        self.info = Info(int(values.get("supervisor.info", old)))
        self.reports_plans = self.reports_plans or Info.PLANNER_ACTIVE in self.info
        self.power = int(values.get("pm.state", Power.BATTERY))
        self._add_volts(values.get("pm.vbat", nan), measured - self.status_time)
        self.stations = int(values.get("lighthouse.status", -1))
        self.status_time = measured
        self.climb.feel(measured, self.pose[2], self.pose[5])
        if self._measures(values.get(VARIANCE, 0.0)) or not self.settled:
            self.pose_time = measured

    def _measures(self, variance: float) -> bool:
        """Whether the pose is measured; else the estimator goes on by its accelerometers, and drifts away."""
        blind = self._lighthouse and 0 <= self.stations < MEASURING
        return not blind and (variance < SETTLED_BELOW or not self._absolute)

    def _add_volts(self, volts: float, since: float) -> None:
        """Filter the voltage `since` [s] after the last one, and estimate the charge, with the motors on or off."""
        before = self.volts
        share = 1.0 - exp(-since / SMOOTHING_S) if isfinite(before) and isfinite(since) else 1.0
        self.volts = before + share * (volts - before) if share < 1.0 else volts
        empty = EMPTY_V - (SAG_V if Info.FLYING in self.info else 0.0)
        self.battery = min(max((self.volts - empty) / (FULL_V - EMPTY_V), 0.0), 1.0)

    def _ranges(self, t: float, stamp: int, values: Mapping[str, float]) -> None:
        measured = (values.get(name, OUT_OF_REACH_MM) for name in RANGES)
        self.ranges = tuple(nan if mm >= OUT_OF_REACH_MM else MM * mm for mm in measured)
        self.ranges_time = self._stamped(t, stamp)
