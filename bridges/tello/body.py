"""Body of several DJI Tellos through djitellopy: velocity commands, external positions.

Of the library only parser and non-blocking sends are used, for the reasons in `bridges.tello.library` and
`bridges.tello.pilot`; one thread runs the pilots of all drones.
"""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Final

from agents.body.device_address import DeviceAddress
from agents.body.external_pose import External
from agents.body.interface import (
    FRESH_S,
    Body,
    BodyEntry,
    BodyError,
    BodyFault,
    BodyRequest,
    BodyState,
    call_all,
    judged,
    settings,
)
from agents.clock import uptime, wait_until
from agents.vectors import UNKNOWN, ZERO, Setpoint, Vector
from bridges.tello import protocol
from bridges.tello.library import TelloLibrary, filters_answers
from bridges.tello.pilot import Duty, TelloPilot

OPEN_S: Final = 3.0  # deadline of a drone's first state line


BODY: Final = ("body",)


class TelloBody(Body):
    """Tellos. One process flies all Tellos of a computer."""

    SETTINGS = protocol.TelloSettings
    APART = f"{Body.APART}, or name the network interface of each, as in tello://{protocol.HOST}%wlan1"

    @classmethod
    def faults(cls, robots: Sequence[BodyEntry]) -> Iterator[BodyFault]:
        """See `Body.faults`."""
        first: dict[str, BodyEntry] = {}  # entries by machine
        for each in robots:
            yield from judged(each, BODY, partial(protocol.endpoint, each.name, each.address))
            if not each.external:
                message, remedy = "a Tello does not measure its position", 'write position = "external"'
                yield BodyFault(each.name, ("position",), message, remedy)
            other = first.setdefault(each.host, each)
            if other.process != each.process:
                message = f"{other.name} and {each.name} are Tellos of one computer, all of which one process drives"
                process = "tellos" if other.process == other.name else other.process
                yield BodyFault(each.name, BODY, message, f'give each process = "{process}"')

    @classmethod
    def device_of(cls, robot: BodyEntry, endpoints: Sequence[str] = ()) -> DeviceAddress:
        """See `Body.device_of`: a Tello has one port."""
        place = protocol.endpoint(robot.name, robot.address)
        return DeviceAddress(robot.address, (place.host,), (place.interface,))

    def __init__(self, request: BodyRequest, open_s: float = OPEN_S) -> None:
        """`open_s`: deadline of the first state line [s]."""
        self._open_s = open_s
        self._names, self._kinds = request.names, request.kinds
        self._endpoints = [protocol.endpoint(*row) for row in zip(request.names, request.addresses, strict=True)]
        self._settings = [
            settings(protocol.TelloSettings, *row) for row in zip(request.names, request.device, strict=True)
        ]
        self._start_yaw = request.yaw
        self._external = [External() for _ in self._names]
        self._library: TelloLibrary | None = None
        self.pilots: list[TelloPilot] = []
        self._lock = threading.Lock()
        self._ending = threading.Event()
        self._last_read = -math.inf
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """See `Body.open`. Drones without answer are retried while the others fly."""
        library = self._library = TelloLibrary(interfaces=[each.interface for each in self._endpoints])
        self.pilots = [
            TelloPilot(library.drone(place), kind, chosen)
            for place, kind, chosen in zip(self._endpoints, self._kinds, self._settings, strict=True)
        ]
        self._ending.clear()
        self._thread = threading.Thread(target=self._run, args=(library,), name="tello pilots", daemon=True)
        self._thread.start()
        pilots, ending = self.pilots, self._ending
        wait_until(lambda: all(pilot.state_received > -math.inf for pilot in pilots), self._open_s, stop=ending)
        if all(pilot.state_received == -math.inf for pilot in self.pilots):
            now = uptime()
            reasons = [
                f"{name} at {place.device}:{place.port}: {pilot.note(now)}"
                for name, place, pilot in zip(self._names, self._endpoints, self.pilots, strict=True)
            ]
            self.close()
            remedy = f"switch it on, join its Wi-Fi, let UDP {protocol.STATE_PORT} through the firewall"
            if strict := [each.interface for each in self._endpoints if filters_answers(each.interface)]:
                changes = " ".join(f"net.ipv4.conf.{name}.rp_filter=2" for name in strict)
                remedy += f", let Linux take answers by the second of two adapters: sudo sysctl {changes}"
            raise BodyError(f"{'; '.join(reasons)} ({remedy})")

    def read(self, t: float) -> Sequence[BodyState]:
        with self._lock:
            now = self._last_read = uptime()
            return [self._state(row, pilot, t, now) for row, pilot in enumerate(self.pilots)]

    def _state(self, row: int, pilot: TelloPilot, t: float, now: float) -> BodyState:
        """State of a drone; its pilot gets the external pose."""
        received = pilot.state_received - now + t
        state = BodyState(
            t,
            velocity=ZERO,
            yaw=self._start_yaw[row] + pilot.turned,
            battery=pilot.battery,
            flying=pilot.flying,
            received=received,
            note=pilot.note(now),
        )
        self._external[row].fill(state)
        pilot.position = state.position if t - state.time <= FRESH_S else UNKNOWN
        pilot.yaw = state.yaw
        if pilot.silent(now):  # a drone without telemetry cannot be flown, even if its external position is fresh
            state.time = min(state.time, received)
        return state

    def command(self, setpoints: Sequence[Setpoint]) -> None:
        with self._lock:
            now = uptime()
            for pilot, setpoint in zip(self.pilots, setpoints, strict=True):
                if math.isfinite(sum(setpoint)) and pilot.duty in (Duty.HOLD, Duty.FLY):
                    pilot.duty = Duty.FLY
                    pilot.setpoint, pilot.setpoint_time = setpoint, now

    def takeoff(self, rows: Sequence[int], heights: Sequence[float]) -> None:
        with self._lock:
            for row, height in zip(rows, heights, strict=True):
                self.pilots[row].take_off(height, uptime())

    def land(self, rows: Sequence[int]) -> None:
        with self._lock:
            now = uptime()
            call_all(partial(self.pilots[row].land, now) for row in rows if self.pilots)

    def stop(self, rows: Sequence[int]) -> None:
        with self._lock:
            now = uptime()
            call_all(partial(self.pilots[row].cut, now) for row in rows if self.pilots)

    def locate(self, row: int, t: float, position: Vector, yaw: float) -> None:
        self._external[row].update(t, position, yaw)

    def close(self) -> None:
        self._ending.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        try:
            call_all(pilot.leave for pilot in self.pilots)  # drones that can still be stopped
        finally:
            self.pilots = []
            if self._library is not None:
                self._library.close()
                self._library = None

    def _run(self, library: TelloLibrary) -> None:
        period = 1.0 / max(chosen.rc_hz for chosen in self._settings)
        while not self._ending.wait(period):  # not by `Ticks`: a stop needs the lock, and gets it in this pause
            self.step(library)

    def step(self, library: TelloLibrary) -> None:
        """Round of the thread: receive datagrams, and let each pilot act."""
        with self._lock:
            with contextlib.suppress(Exception):  # no datagram may end the thread
                library.receive()
            now = uptime()
            for pilot in self.pilots:
                try:
                    pilot.step(now, self._last_read)
                except Exception as error:  # noqa: BLE001 - of any kind: the others fly on
                    pilot.fail(error)
