"""Body of several Crazyflies in one process: one thread per drone, one or several radios."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from math import inf, isfinite
from typing import Final

from agents.body.device_address import DeviceAddress
from agents.body.external_pose import External
from agents.body.interface import Body, BodyEntry, BodyError, BodyFault, BodyRequest, BodyState, RangeScan
from agents.clock import uptime, wait_until
from agents.network.messages import Inspection, number
from agents.vectors import UNKNOWN, Setpoint, Vector
from bridges.crazyflie.file_faults import file_faults
from bridges.crazyflie.link import prepare
from bridges.crazyflie.pilot import CrazyfliePilot
from bridges.crazyflie.protocol.addresses import (
    CrazyflieSettings,
    Lighthouse,
    address,
    capacity,
    chosen,
    device_of,
    dongle_of,
    overload,
    radio_loads,
)
from bridges.crazyflie.protocol.crtp import Info
from bridges.crazyflie.telemetry import BEARING, ELEVATION, Telemetry

STALE_S: Final = 0.5  # the note reports poses older than this
WINDOW_S: Final = 0.25  # averaging window of the radio's load [s]
MEASURING_S: Final = 8.0  # time in which a radio is measured: others may still start on it


class CrazyflieBody(Body):
    """Crazyflies. Raises BodyError for an invalid address or setting.

    Args:
        measuring_s: A radio that carries too little in each window of this time is refused [s].
    """

    SETTINGS = CrazyflieSettings

    @classmethod
    def faults(cls, robots: Sequence[BodyEntry]) -> Iterator[BodyFault]:
        """See `Body.faults`."""
        return file_faults(robots)

    @classmethod
    def device_of(cls, robot: BodyEntry, endpoints: Sequence[str] = ()) -> DeviceAddress:
        """See `Body.device_of`."""
        return device_of(address(robot.name, robot.address))

    def __init__(self, request: BodyRequest, measuring_s: float = MEASURING_S) -> None:
        self._names, self._measuring_s = request.names, measuring_s
        self._addresses = addresses = [address(*pair) for pair in zip(request.names, request.addresses, strict=True)]
        settings = [
            chosen(name, device, external=outside)
            for name, device, outside in zip(request.names, request.device, request.external, strict=True)
        ]
        self._loads = radio_loads(addresses, settings)
        rows = len(addresses)
        dongles = [dongle_of(each) for each in addresses]
        self._radios = {one: [row for row in range(rows) if dongles[row] == one] for one in dongles if one}
        self._capacity: dict[str, float] = {}  # [1/s] measured, by radio
        self._dongles, self._settings = dongles, settings
        turns = {one: threading.Lock() for one in self._radios}
        self._telemetry = [
            Telemetry(lighthouse=isinstance(each.positioning, Lighthouse), absolute=each.positioning is not None)
            for each in settings
        ]
        in_turn = max((len(on_it) for on_it in self._radios.values()), default=1)
        self._open_timeout = max(each.connect_s + each.converge_s for each in settings) + 5.0 * in_turn
        self.pilots = [
            CrazyfliePilot(
                name,
                where,
                each,
                self._telemetry[row],
                place=(request.start[row], request.yaw[row]),
                turn=turns.get(dongles[row], threading.Lock()),
            )
            for row, (name, where, each) in enumerate(zip(request.names, addresses, settings, strict=True))
        ]
        self._outside = request.external
        self._external = [External() for _ in addresses]
        self._zero = uptime()  # zero of the process's clock on the clock `uptime` [s]

    def open(self) -> None:
        """See `Body.open`. Unreachable drones are left out, retried in the background, and named in the notes.

        Raises:
            BodyError: If no drone is reachable, or a radio carries less than is asked of it.
        """
        prepare(self._addresses)
        for pilot in self.pilots:
            pilot.start()
        wait_until(lambda: all(pilot.opened.is_set() or pilot.failure for pilot in self.pilots), self._open_timeout)
        if not any(pilot.opened.is_set() for pilot in self.pilots):
            self.close()
            failures = [pilot.failure for pilot in self.pilots if pilot.failure is not None]
            raise failures[0] if failures else BodyError(f"{', '.join(self._names)}: not ready in time")
        refusals = [self._measure_radio(radio, rows) for radio, rows in self._radios.items()]
        if any(refusals):
            self.close()
            raise BodyError("; ".join(filter(None, refusals)))

    def _measure_radio(self, radio: str, rows: list[int]) -> str:
        """Measure what a radio carries while its drones log; returns why it is too little, or an empty text."""
        settings = [self._settings[row] for row in rows]
        refusal, best = "", 0.0
        end = uptime() + self._measuring_s
        while uptime() < end:
            before, begin = self.exchanges(rows), uptime()
            time.sleep(WINDOW_S)
            best = max(best, (self.exchanges(rows) - before) / (uptime() - begin))
            self._capacity[radio] = capacity(settings, best)
            refusal = overload(radio, settings, best)
            if not refusal:
                break
        return refusal

    def exchanges(self, rows: list[int]) -> int:
        return sum(self.pilots[row].exchanges for row in rows)

    def read(self, t: float) -> Sequence[BodyState]:
        """See `Body.read`."""
        now = uptime()
        self._zero = now - t
        return [self._state(row, now) for row in range(len(self.pilots))]

    def _state(self, row: int, now: float) -> BodyState:
        telemetry, pilot = self._telemetry[row], self.pilots[row]
        settled, measured = telemetry.settled, telemetry.pose_time - self._zero
        x, y, z, vx, vy, vz, yaw = telemetry.pose
        state = BodyState(
            measured,
            (x, y, z) if settled else UNKNOWN,
            (vx, vy, vz) if settled else UNKNOWN,
            yaw,
            battery=telemetry.battery,
            flying=telemetry.airborne,
            spinning=Info.FLYING in telemetry.info,
            received=max(telemetry.pose_time, telemetry.status_time) - self._zero,
            note=self._note(row, now),
            refusal=pilot.refusal,
            scan=self._scan(telemetry) if self._settings[row].multiranger else None,
        )
        if self._outside[row]:
            self._external[row].fill(state)
            if not settled:
                state.position = UNKNOWN  # no flight before the estimator on board has settled
            state.time = min(state.time, measured)  # a drone without telemetry is lost as well
        return state

    def command(self, setpoints: Sequence[Setpoint]) -> None:
        """See `Body.command`."""
        now = uptime()
        for pilot, setpoint in zip(self.pilots, setpoints, strict=True):
            pilot.set_target(now, setpoint if isfinite(sum(setpoint)) else None)

    def takeoff(self, rows: Sequence[int], heights: Sequence[float]) -> None:
        """See `Body.takeoff`."""
        for row, up in zip(rows, heights, strict=True):
            self._telemetry[row].airborne = True  # set at once: callers wait for a landing as long as this is set
            self.pilots[row].give_order("takeoff", up)

    def land(self, rows: Sequence[int]) -> None:
        """See `Body.land`."""
        for row in rows:
            self.pilots[row].give_order("land")

    def stop(self, rows: Sequence[int]) -> None:
        """See `Body.stop`. Drones on the ground get no command: an emergency stop locks them until a restart."""
        for row in rows:
            self.pilots[row].give_order("stop")

    def locate(self, row: int, t: float, position: Vector, yaw: float) -> None:
        """See `Body.locate`."""
        if self._external[row].update(t, position, yaw):
            self.pilots[row].locate(self._zero + t, position, yaw)

    def inspect(self, row: int) -> Inspection:
        """See `Body.inspect`."""
        load = self._loads[row]
        return Inspection(
            firmware=self.pilots[row].firmware,
            volts=number(self._telemetry[row].volts),
            packets_hz=load,
            capacity_hz=self._capacity.get(self._dongles[row]),
            delay_s=number(self.pilots[row].delay),
        )

    def close(self, *, land: bool = True) -> None:
        """See `Body.close`. Drones in the air are landed first, unless they are to be left as they are."""
        for pilot in self.pilots:
            pilot.close(land=land)
        for pilot in self.pilots:
            pilot.join()

    def _note(self, row: int, now: float) -> str:
        age = now - self._telemetry[row].pose_time
        stale = f"no pose for {age:.1f} s" if STALE_S < age < inf else ""
        return "; ".join(part for part in (self.pilots[row].note, stale) if part)

    def _scan(self, telemetry: Telemetry) -> RangeScan | None:
        if not isfinite(telemetry.ranges_time):
            return None
        return RangeScan(telemetry.ranges_time - self._zero, BEARING, ELEVATION, telemetry.ranges)
