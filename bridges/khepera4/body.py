"""Body of several Khepera IV, over Robotic Park's protocol or K-Team's; each robot has its own link."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Final

from agents.body.device_address import DeviceAddress
from agents.body.external_pose import External
from agents.body.interface import (
    UNANSWERED,
    Body,
    BodyEntry,
    BodyError,
    BodyFault,
    BodyRequest,
    BodyState,
    RangeScan,
    judged,
    settings,
)
from agents.clock import uptime, wait_until
from agents.network.messages import Inspection
from agents.vectors import Setpoint, Vector
from bridges.khepera4 import protocol
from bridges.khepera4.drivers import FIRST_ANSWER_S
from bridges.khepera4.link import Khepera4Link, KheperaAddress

OPEN_S: Final = 4.5  # deadline of the first odometry: that of a connection and of the first answer


class KheperaBody(Body):
    """Khepera IV robots."""

    SETTINGS = protocol.Khepera4Settings

    @classmethod
    def faults(cls, robots: Sequence[BodyEntry]) -> Iterator[BodyFault]:
        """See `Body.faults`."""
        for each in robots:
            wrong = list(judged(each, ("body",), partial(KheperaAddress.parse, each.name, each.address)))
            yield from wrong
            if not wrong:
                address = KheperaAddress.parse(each.name, each.address)
                chosen = settings(protocol.Khepera4Settings, each.name, each.device)
                yield from judged(each, ("device", "server"), partial(address.server_of, each.name, chosen))

    @classmethod
    def device_of(cls, robot: BodyEntry, endpoints: Sequence[str] = ()) -> DeviceAddress:
        """See `Body.device_of`."""
        address = KheperaAddress.parse(robot.name, robot.address)
        if address.serial:
            return DeviceAddress(robot.address, parts=(os.path.realpath(address.serial),))
        return DeviceAddress(robot.address, (address.host,), (str(address.port),))

    def __init__(self, request: BodyRequest, open_s: float = OPEN_S, first_answer_s: float = FIRST_ANSWER_S) -> None:
        """Deadlines [s] of the first odometry, and of a server's first answer."""
        self._open_s, self._first_answer_s = open_s, first_answer_s
        self._names = request.names
        self._addresses = [KheperaAddress.parse(*row) for row in zip(request.names, request.addresses, strict=True)]
        self._settings = [
            settings(protocol.Khepera4Settings, *row) for row in zip(request.names, request.device, strict=True)
        ]
        self._start = [(x, y, yaw) for (x, y, _), yaw in zip(request.start, request.yaw, strict=True)]
        self._outside = request.external
        self._external = [External() for _ in self._names]
        self._links: list[Khepera4Link] = []
        self._read_at = -math.inf  # [s, `uptime`] the state on which the next command is decided

    def open(self) -> None:
        """See `Body.open`. Robots without answer are retried while the others drive."""
        places = zip(self._names, self._addresses, self._settings, self._start, strict=True)
        self._links = links = [Khepera4Link(*place, self._first_answer_s) for place in places]
        for link in links:
            link.start()
        wait_until(lambda: all(link.odometry.stamp > -math.inf or link.refused for link in links), self._open_s)
        if all(link.odometry.stamp == -math.inf for link in self._links):
            reasons = [f"{name}: {link.trouble}" for name, link in zip(self._names, self._links, strict=True)]
            self.close()
            raise BodyError("no Khepera answers: " + "; ".join(reasons))

    def read(self, t: float) -> Sequence[BodyState]:
        now, self._read_at = uptime(), uptime()
        return [self._state(row, link, t, now) for row, link in enumerate(self._links)]

    def _state(self, row: int, link: Khepera4Link, t: float, now: float) -> BodyState:
        odometry = link.odometry
        x, (vx, vy) = odometry.x, odometry.velocity
        received = odometry.stamp - now + t
        state = BodyState(
            received,
            # unknown before the first odometry: the pose is counted by the robot, not read from the file
            (x, odometry.y, 0.0 * x),
            (vx, vy, 0.0 * vx),
            odometry.yaw,
            battery=link.battery,
            received=received,
            note=self._note(link, now),
            scan=self._scan(link, now, t),
        )
        if self._outside[row]:
            self._external[row].fill(state)
            # a robot without odometry cannot be driven, even if its external position is fresh
            if now - odometry.stamp > self._settings[row].silence_s:
                state.time = min(state.time, received)
        return state

    def command(self, setpoints: Sequence[Setpoint]) -> None:
        for link, (v, turn, _, _) in zip(self._links, setpoints, strict=True):
            if math.isfinite(v + turn):
                link.drive(v, turn, self._read_at)

    def takeoff(self, rows: Sequence[int], heights: Sequence[float]) -> None:
        """See `Body.takeoff`: no effect on a ground robot."""

    def land(self, rows: Sequence[int]) -> None:
        now = uptime()
        for row in rows if self._links else ():
            self._links[row].halt(now)

    def stop(self, rows: Sequence[int]) -> None:
        self.land(rows)

    def locate(self, row: int, t: float, position: Vector, yaw: float) -> None:
        self._external[row].update(t, position, yaw)

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
        return RangeScan(stamp - now + t, bearing, (0.0,) * len(bearing), distance)
