"""Odometry: a pose in the experiment's frame, from what a robot counts in units and a frame of its own."""

from __future__ import annotations

import math

from agents.body.external_pose import velocity_after
from agents.protocols import khepera4 as protocol


class Odometer:
    """A pose in the experiment's frame, moved on by what the robot counts. It survives the connection.

    Attributes:
        x, y: [m].
        yaw: [rad].
        velocity: In the world [m/s].
    """

    def __init__(self, x: float, y: float, yaw: float) -> None:
        self.x, self.y, self.yaw = x, y, yaw
        self.velocity = (0.0, 0.0)
        self._last: tuple[float, ...] | None = None
        self._stamp = math.nan
        self._doubt = False

    def reconnected(self) -> None:
        """The robot may have been switched on anew: if it now counts from zero, it has."""
        self._doubt = True

    def pose(self, x: float, y: float, theta: float, stamp: float) -> None:
        """The robot says its pose in a frame of its own."""
        last = self._since((x, y, theta))
        if last is not None:
            dx, dy = x - last[0], y - last[1]
            frame = self.yaw - last[2]
            cos, sin = math.cos(frame), math.sin(frame)
            turn = math.remainder(theta - last[2], 2.0 * math.pi)
            self._move(cos * dx - sin * dy, sin * dx + cos * dy, turn, stamp)

    def wheels(self, left: float, right: float, stamp: float) -> None:
        """The robot says its encoders [pulses]."""
        last = self._since((left, right))
        if last is not None:
            self._arc(*protocol.rolled(left - last[0], right - last[1]), stamp)

    def steps(self, way: float, turn: float, stamp: float) -> None:
        """The robot says what it did since it was last asked [m, rad]."""
        if self._since((way, turn)) is not None:
            self._arc(way, turn, stamp)

    def heading(self, way: float, theta: float, stamp: float) -> None:
        """The robot says its way since it was last asked [m], and its yaw in a frame of its own."""
        last = self._since((way, theta))
        if last is not None:
            self._arc(way, math.remainder(theta - last[1], 2.0 * math.pi), stamp)

    def _since(self, counted: tuple[float, ...]) -> tuple[float, ...] | None:
        last, self._last = self._last, counted
        anew, self._doubt = self._doubt and not any(counted), False
        return None if anew else last

    def _arc(self, way: float, turn: float, stamp: float) -> None:
        middle = self.yaw + 0.5 * turn
        self._move(way * math.cos(middle), way * math.sin(middle), turn, stamp)

    def _move(self, dx: float, dy: float, turn: float, stamp: float) -> None:
        self.x, self.y, self.yaw = self.x + dx, self.y + dy, self.yaw + turn
        since, self._stamp = stamp - self._stamp, stamp
        if since > 0.0:
            vx, vy = self.velocity
            self.velocity = velocity_after(vx, dx, since), velocity_after(vy, dy, since)
