"""Body of several Khepera IV, over Robotic Park's protocol or K-Team's; each robot has its own link."""

from __future__ import annotations

import math
import threading
from typing import Final

import numpy as np

from agents.arrays import Array, Index
from agents.body.device_locks import Claims
from agents.body.external_pose import External
from agents.body.interface import UNANSWERED, BodyError, BodyRequest, BodyState, RangeScan, Rays, settings
from agents.clock import uptime
from agents.network.messages import Inspection
from agents.protocols import khepera4 as protocol
from bridges.khepera4.link import Address, Khepera4Link

OPEN_S: Final = 4.5  # deadline of the first odometry: that of a connection and of the first answer


class KheperaBody:
    """Khepera IV robots; implements `agents.body.interface.Body`."""

    def __init__(self, request: BodyRequest) -> None:
        self._names = request.names
        self._addresses = [Address.parse(*row) for row in zip(request.names, request.addresses, strict=True)]
        self._settings = [
            settings(protocol.Khepera4Settings, *row) for row in zip(request.names, request.device, strict=True)
        ]
        self._claims = Claims(request.names, [address.device for address in self._addresses])
        self._start = np.column_stack([request.start[:, :2], request.yaw])
        self._external_rows = np.flatnonzero(request.external)
        self._external = External(len(self._names))
        self._links: list[Khepera4Link] = []
        self._read_at = -math.inf  # [s, `uptime`] the state on which the next command is decided

    def open(self) -> None:
        """See `Body.open`. Robots without answer are retried while the others drive."""
        self._claims.take()
        for name, address, device, (x, y, yaw) in zip(
            self._names, self._addresses, self._settings, self._start.tolist(), strict=True
        ):
            self._links.append(Khepera4Link(name, address, device, (x, y, yaw)))
            self._links[-1].start()
        deadline, pause = uptime() + OPEN_S, threading.Event()
        while uptime() < deadline and any(
            link.odometry.stamp == -math.inf and not link.refused for link in self._links
        ):
            pause.wait(0.01)
        if all(link.odometry.stamp == -math.inf for link in self._links):
            reasons = [f"{name}: {link.trouble}" for name, link in zip(self._names, self._links, strict=True)]
            self.close()
            raise BodyError("no Khepera answers: " + "; ".join(reasons))

    def read(self, t: float) -> BodyState:
        now, self._read_at = uptime(), uptime()
        odometry = [link.odometry for link in self._links]
        rows = len(odometry)
        # unknown before the first odometry: the pose is counted by the robot, not read from the file
        position = np.array([(h.x, h.y, 0.0 * h.x) for h in odometry])
        velocity = np.array([(*h.velocity, 0.0 * h.velocity[0]) for h in odometry])
        odometry_time = np.array([h.stamp for h in odometry]) - now + t
        state = BodyState(
            odometry_time,
            position,
            velocity,
            np.array([h.yaw for h in odometry]),
            np.full((rows, 3), np.nan),
            np.full(rows, np.nan),
            np.array([link.battery for link in self._links]),
            np.zeros(rows, dtype=bool),
            tuple(self._note(link, now) for link in self._links),
            Rays.gather([self._scan(link, now, t) for link in self._links]),
            heard=odometry_time,
        )
        if len(self._external_rows):
            state.time = odometry_time.copy()
            self._external.fill(state, self._external_rows)
            lost = np.array([now - h.stamp > s.silence_s for h, s in zip(odometry, self._settings, strict=True)])
            # a robot without odometry cannot be driven, even if its external position is fresh
            state.time[lost] = np.minimum(state.time, odometry_time)[lost]
        return state

    def command(self, setpoint: Array) -> None:
        for link, (v, turn, _, _) in zip(self._links, setpoint.tolist(), strict=True):
            if math.isfinite(v + turn):
                link.drive(v, turn, self._read_at)

    def takeoff(self, rows: Index, height: Array) -> None:
        """See `Body.takeoff`: no effect on a ground robot."""

    def land(self, rows: Index) -> None:
        now = uptime()
        for row in rows.tolist() if self._links else ():
            self._links[row].halt(now)

    def stop(self, rows: Index) -> None:
        self.land(rows)

    def locate(self, row: int, t: float, position: Array, yaw: float) -> None:
        self._external.update(row, t, position, yaw)

    def inspect(self, row: int) -> Inspection:
        server = self._links[row].server if self._links else ""
        return Inspection(firmware=f"server {server}" if server else None)

    def close(self) -> None:
        now = uptime()
        for link in self._links:
            link.halt(now)
            link.end()
        for link in self._links:
            link.join()
        self._links = []
        self._claims.release()

    @staticmethod
    def _note(link: Khepera4Link, now: float) -> str:
        unanswered = UNANSWERED if link.unanswered(now) else ""
        return "; ".join(part for part in (unanswered, KheperaBody._link_fault(link, now)) if part)

    @staticmethod
    def _link_fault(link: Khepera4Link, now: float) -> str:
        if link.trouble and link.odometry.stamp > -math.inf:
            return f"silent for {now - link.odometry.stamp:.1f} s: {link.trouble}"
        return link.trouble or (f"battery at {link.battery:.0%}: too low to drive" if link.battery_empty else "")

    @staticmethod
    def _scan(link: Khepera4Link, now: float, t: float) -> RangeScan | None:
        if link.scan is None:
            return None
        stamp, bearing, distance = link.scan
        return RangeScan(stamp - now + t, bearing, np.zeros(len(bearing)), distance)
