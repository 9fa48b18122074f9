"""Odometry: a pose in the experiment's frame, from a robot's counters in its own units and frame."""

from __future__ import annotations

import math
from typing import Final

from agents.body.external_pose import velocity_after
from bridges.khepera4 import protocol

ORIGIN: Final = 0.01  # [m, rad] counters closer to zero are at zero: who switched it on has touched its wheels


class Odometer:
    """Pose in the experiment's frame, integrated from the robot's counters; kept over reconnections."""

    def __init__(self, x: float, y: float, yaw: float) -> None:
        self.x, self.y, self.yaw = x, y, yaw  # [m], [m], [rad]
        self.velocity = (0.0, 0.0)  # velocity in the world [m/s]
        self._last: tuple[float, ...] | None = None
        self._stamp = math.nan
        self._maybe_reset = False

    def reconnected(self) -> None:
        """Note that the robot may have been switched off and on; counters at zero will confirm it."""
        self._maybe_reset = True

    def pose(self, x: float, y: float, theta: float, stamp: float) -> None:
        """Add a pose in the robot's own frame [m, rad]."""
        last = self._last_count((x, y, theta))
        if last is not None:
            dx, dy = x - last[0], y - last[1]
            frame = self.yaw - last[2]
            cos, sin = math.cos(frame), math.sin(frame)
            turn = math.remainder(theta - last[2], 2.0 * math.pi)
            self._move(cos * dx - sin * dy, sin * dx + cos * dy, turn, stamp)

    def wheels(self, left: float, right: float, stamp: float) -> None:
        """Add readings of the wheel encoders [pulses]."""
        last = self._last_count((left, right), protocol.PULSE)
        if last is not None:
            self._arc(*protocol.rolled(left - last[0], right - last[1]), stamp)

    def steps(self, way: float, turn: float, stamp: float) -> None:
        """Add distance [m] and turn [rad] since the last request."""
        if self._last_count((way, turn)) is not None:
            self._arc(way, turn, stamp)

    def heading(self, way: float, theta: float, stamp: float) -> None:
        """Add distance since the last request [m] and yaw in the robot's own frame [rad]."""
        last = self._last_count((way, theta))
        if last is not None:
            self._arc(way, math.remainder(theta - last[1], 2.0 * math.pi), stamp)

    def _last_count(self, counted: tuple[float, ...], unit: float = 1.0) -> tuple[float, ...] | None:
        last, self._last = self._last, counted
        reset, self._maybe_reset = self._maybe_reset and unit * max(map(abs, counted)) < ORIGIN, False
        return None if reset else last

    def _arc(self, way: float, turn: float, stamp: float) -> None:
        middle = self.yaw + 0.5 * turn
        self._move(way * math.cos(middle), way * math.sin(middle), turn, stamp)

    def _move(self, dx: float, dy: float, turn: float, stamp: float) -> None:
        self.x, self.y, self.yaw = self.x + dx, self.y + dy, self.yaw + turn
        since, self._stamp = stamp - self._stamp, stamp
        if since > 0.0:
            vx, vy = self.velocity
            self.velocity = velocity_after((vx, vy, 0.0), (dx, dy, 0.0), since)[:2]
