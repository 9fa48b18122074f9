"""Khepera IV over Robotic Park's protocol or K-Team's: rows of robots, each with a link of its own."""

from __future__ import annotations

import math
import threading
import time
from typing import Final

import numpy as np

from agents.arrays import Array, Index
from agents.body.device_locks import Claims
from agents.body.external_pose import External
from agents.body.interface import UNANSWERED, BodyError, BodyRequest, BodyState, RangeScan, Rays, settings
from agents.protocols import khepera4 as protocol
from bridges.khepera4.link import Address, Link

OPEN_S: Final = 3.0  # for the first odometry of a robot


class KheperaBody:
    """Rows of Khepera IV robots; implements `agents.body.interface.Body`."""

    def __init__(self, request: BodyRequest) -> None:
        self._names = request.names
        self._addresses = [Address.of(*row) for row in zip(request.names, request.addresses, strict=True)]
        self._settings = [settings(protocol.Settings, *row) for row in zip(request.names, request.device, strict=True)]
        self._claims = Claims(request.names, [address.device for address in self._addresses])
        self._start = np.column_stack([request.start[:, :2], request.yaw])
        self._outside = np.flatnonzero(request.external)
        self._external = External(len(self._names))
        self._links: list[Link] = []

    def open(self) -> None:
        """See `Body.open`. Robots that do not answer are waited for while the others drive."""
        self._claims.take()
        for name, address, chosen, (x, y, yaw) in zip(
            self._names, self._addresses, self._settings, self._start.tolist(), strict=True
        ):
            self._links.append(Link(name, address, chosen, (x, y, yaw)))
            self._links[-1].start()
        deadline, pause = time.monotonic() + OPEN_S, threading.Event()
        while time.monotonic() < deadline and any(link.heard.stamp == -math.inf for link in self._links):
            pause.wait(0.01)
        if all(link.heard.stamp == -math.inf for link in self._links):
            whys = [f"{name}: {link.trouble}" for name, link in zip(self._names, self._links, strict=True)]
            self.close()
            raise BodyError("no Khepera answers: " + "; ".join(whys))

    def read(self, t: float) -> BodyState:
        """See `Body.read`."""
        now = time.monotonic()
        heard = [link.heard for link in self._links]
        rows = len(heard)
        # a robot that has not spoken yet is nowhere: its pose is not what the file says but what it counts
        position = np.array([(h.x, h.y, 0.0 * h.x) for h in heard])
        velocity = np.array([(*h.velocity, 0.0 * h.velocity[0]) for h in heard])
        time_heard = np.array([h.stamp for h in heard]) - now + t
        state = BodyState(
            time_heard,
            position,
            velocity,
            np.array([h.yaw for h in heard]),
            np.full((rows, 3), np.nan),
            np.full(rows, np.nan),
            np.array([link.battery for link in self._links]),
            np.zeros(rows, dtype=bool),
            tuple(self._note(link, now) for link in self._links),
            Rays.gather([self._scan(link, now, t) for link in self._links]),
        )
        if len(self._outside):
            state.time = time_heard.copy()
            self._external.fill(state, self._outside)
            lost = np.array([now - h.stamp > s.silence_s for h, s in zip(heard, self._settings, strict=True)])
            # whoever is not heard cannot be driven, however well others see it
            state.time[lost] = np.minimum(state.time, time_heard)[lost]
        return state

    def command(self, setpoint: Array) -> None:
        """See `Body.command`."""
        now = time.monotonic()
        for link, (v, turn, _, _) in zip(self._links, setpoint.tolist(), strict=True):
            if math.isfinite(v + turn):
                link.drive(v, turn, now)

    def takeoff(self, rows: Index, height: Array) -> None:
        """See `Body.takeoff`: it stays on the ground."""

    def land(self, rows: Index) -> None:
        """See `Body.land`."""
        now = time.monotonic()
        for row in rows.tolist() if self._links else ():
            self._links[row].halt(now)

    def stop(self, rows: Index) -> None:
        """See `Body.stop`."""
        self.land(rows)

    def locate(self, row: int, t: float, position: Array, yaw: float) -> None:
        """See `Body.locate`."""
        self._external.update(row, t, position, yaw)

    def close(self) -> None:
        """See `Body.close`."""
        now = time.monotonic()
        for link in self._links:
            link.halt(now)
            link.end()
        for link in self._links:
            link.join()
        self._links = []
        self._claims.release()

    @staticmethod
    def _note(link: Link, now: float) -> str:
        unanswered = UNANSWERED if link.unanswered(now) else ""
        return "; ".join(part for part in (unanswered, KheperaBody._trouble(link, now)) if part)

    @staticmethod
    def _trouble(link: Link, now: float) -> str:
        if link.trouble and link.heard.stamp > -math.inf:
            return f"silent for {now - link.heard.stamp:.1f} s: {link.trouble}"
        return link.trouble or (f"battery at {link.battery:.0%}: it does not drive on" if link.exhausted else "")

    @staticmethod
    def _scan(link: Link, now: float, t: float) -> RangeScan | None:
        if link.scan is None:
            return None
        stamp, bearing, distance = link.scan
        return RangeScan(stamp - now + t, bearing, np.zeros(len(bearing)), distance)


def open_khepera4(request: BodyRequest) -> KheperaBody:
    """The entry points `khepera4` and `kteam` of the group `zenpark.bodies`."""
    return KheperaBody(request)
