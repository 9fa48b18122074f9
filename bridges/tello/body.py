"""DJI Tello through djitellopy: rows of drones that take velocities and are told by others where they are.

Of the library we use its sockets, its parser and its sends that do not wait (`bridges.tello.pilot` says why); one
thread for all rows is the pilots'.
"""

from __future__ import annotations

import importlib
import importlib.util
import logging
import math
import socket
import sys
import threading
import time
import types
from functools import partial
from typing import Final, Protocol

import numpy as np

from agents.arrays import Array, Index
from agents.body.device_locks import Claims
from agents.body.external_pose import External
from agents.body.interface import FRESH_S, TROUBLE, BodyError, BodyRequest, BodyState, call_all, settings
from agents.protocols import tello as protocol
from bridges.tello.pilot import Duty, Pilot, Vendor

OPEN_S: Final = 3.0  # for the first state line of a drone


class TelloBody:
    """Rows of Tellos; implements `agents.body.interface.Body`. One process flies all Tellos of a computer."""

    def __init__(self, request: BodyRequest) -> None:
        self._names, self._kinds = request.names, request.kinds
        self._places = [protocol.endpoint(*row) for row in zip(request.names, request.addresses, strict=True)]
        self._settings = [settings(protocol.Settings, *row) for row in zip(request.names, request.device, strict=True)]
        for row, name in enumerate(self._names):
            if not request.external[row]:
                raise BodyError(f'{name}: a Tello does not know where it is: write position = "external"')
            if self._places[row][0] in [host for host, _ in self._places[:row]]:
                raise BodyError(f"{name}: another Tello of this process has the address {self._places[row][0]}")
        self._claims = Claims(self._names, [f"tello://{host}" for host, _ in self._places])
        rows = len(self._names)
        self._start_yaw = request.yaw
        self._external = External(rows)
        self._rows = np.arange(rows)
        self._pilots: list[Pilot] = []
        self._lock = threading.Lock()
        self._ending = threading.Event()
        self._attended = -math.inf
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """See `Body.open`. Drones that do not answer are waited for in flight of the others."""
        self._claims.take()
        try:
            make = _library()
        except BodyError:
            self._claims.release()
            raise
        self._pilots = [
            Pilot(make(*place), kind, chosen)
            for place, kind, chosen in zip(self._places, self._kinds, self._settings, strict=True)
        ]
        self._ending.clear()
        self._thread = threading.Thread(target=self._run, name="tello pilots", daemon=True)
        self._thread.start()
        deadline = time.monotonic() + OPEN_S
        while time.monotonic() < deadline and any(pilot.heard == -math.inf for pilot in self._pilots):
            self._ending.wait(0.02)
        if all(pilot.heard == -math.inf for pilot in self._pilots):
            now = time.monotonic()
            whys = [
                f"{name} at {host}:{port}: {pilot.note(now)}"
                for name, (host, port), pilot in zip(self._names, self._places, self._pilots, strict=True)
            ]
            self.close()
            remedy = f"switch it on, join its Wi-Fi, let UDP {protocol.STATE_PORT} through the firewall"
            raise BodyError(f"{'; '.join(whys)} ({remedy})")

    def read(self, t: float) -> BodyState:
        """See `Body.read`."""
        rows = len(self._names)
        nowhere = np.full((rows, 3), np.nan)
        with self._lock:
            now = self._attended = time.monotonic()
            yaw = self._start_yaw + [pilot.turned for pilot in self._pilots]
            heard = np.array([pilot.heard for pilot in self._pilots]) - now + t
            silent = np.array([pilot.silent(now) for pilot in self._pilots])
            state = BodyState(
                np.full(rows, t),
                nowhere,
                np.zeros((rows, 3)),
                yaw,
                nowhere.copy(),
                np.full(rows, np.nan),
                np.array([pilot.battery for pilot in self._pilots]),
                np.array([pilot.flying for pilot in self._pilots]),
                tuple(pilot.note(now) for pilot in self._pilots),
            )
            self._external.fill(state, self._rows)
            fresh = t - state.time <= FRESH_S
            for row, pilot in enumerate(self._pilots):
                x, y, z = state.position[row].tolist() if fresh[row] else (math.nan,) * 3
                pilot.position, pilot.yaw = (x, y, z), float(state.yaw[row])
            # whoever is not heard cannot be flown, however well others see it
            state.time[silent] = np.minimum(state.time, heard)[silent]
        return state

    def command(self, setpoint: Array) -> None:
        """See `Body.command`."""
        with self._lock:
            now = time.monotonic()
            for pilot, (x, y, z, turn) in zip(self._pilots, setpoint.tolist(), strict=True):
                if math.isfinite(x + y + z + turn) and pilot.duty in (Duty.HOLD, Duty.FLY):
                    pilot.duty, pilot.setpoint, pilot.set_at = Duty.FLY, (x, y, z, turn), now

    def takeoff(self, rows: Index, height: Array) -> None:
        """See `Body.takeoff`."""
        with self._lock:
            for row, to in zip(rows.tolist(), height.tolist(), strict=True):
                self._pilots[row].rise(to, time.monotonic())

    def land(self, rows: Index) -> None:
        """See `Body.land`."""
        with self._lock:
            now = time.monotonic()
            call_all(partial(self._pilots[row].land, now) for row in rows.tolist())

    def stop(self, rows: Index) -> None:
        """See `Body.stop`."""
        with self._lock:
            now = time.monotonic()
            call_all(partial(self._pilots[row].cut, now) for row in rows.tolist())

    def locate(self, row: int, t: float, position: Array, yaw: float) -> None:
        """See `Body.locate`."""
        self._external.update(row, t, position, yaw)

    def close(self) -> None:
        """See `Body.close`."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        pilots, self._pilots = self._pilots, []
        try:
            call_all(pilot.leave for pilot in pilots)
        finally:
            self._claims.release()

    def _run(self) -> None:
        period = 1.0 / max(chosen.rc_hz for chosen in self._settings)
        while not self._ending.wait(period):
            with self._lock:
                now = time.monotonic()
                for pilot in self._pilots:
                    try:
                        pilot.step(now, self._attended)
                    except TROUBLE as error:  # the others fly on
                        pilot.trouble = f"cannot be driven: {type(error).__name__}: {error}"


class _Make(Protocol):
    def __call__(self, host: str, port: int, /) -> Vendor: ...


def _library() -> _Make:
    """djitellopy, made ready: what makes a drone for an address."""
    if "av" not in sys.modules and importlib.util.find_spec("av") is None:
        sys.modules["av"] = types.ModuleType("av")  # only its video, which we do not use, would need it
    try:
        library = importlib.import_module("djitellopy.tello")
    except ModuleNotFoundError as error:
        raise BodyError(
            f"flying a Tello needs djitellopy, which is not installed ({error.name} is missing): "
            "pip install -e '.[tello]'"
        ) from error
    library.Tello.LOGGER.setLevel(logging.ERROR)  # it says every command
    if not library.threads_initialized:
        for port in (protocol.CONTROL_PORT, protocol.STATE_PORT):
            _check_free(port)

    def make(host: str, port: int) -> Vendor:
        drone = library.Tello(host=host, retry_count=1)
        drone.address = (host, port)  # the library itself knows but one port, here and there
        vendor: Vendor = drone
        return vendor

    return make


def _check_free(port: int) -> None:
    """The library binds its ports in threads that die unseen when they are taken."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", port))
        except OSError as error:
            raise BodyError(
                f"UDP port {port} of this computer is taken ({error.strerror}): another program flies Tellos; end it, "
                "or give all Tellos the same `process`"
            ) from error


def open_tello(request: BodyRequest) -> TelloBody:
    """The entry point `tello` of the group `zenpark.bodies`."""
    return TelloBody(request)
