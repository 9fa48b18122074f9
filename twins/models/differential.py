"""Differential drive: unicycle on two wheels with limits of speed and acceleration; all of it is quiet.

A command holds until the next one, as on the robots themselves: wheels without new commands are stopped by their
bridge, by a watchdog on the robot, or by nothing (docs/hanging.md).
"""

from __future__ import annotations

from math import cos, isfinite, sin

from agents.body.interface import NO_ATTITUDE
from agents.body.kinds import Kind, Wheels
from agents.vectors import ZERO, Setpoint, Vector, clamp
from twins.models.motion import Motion


class Differential(Motion):
    """One differential robot."""

    __slots__ = (
        "_acceleration", "_base", "_half_base", "_left", "_limit", "_right", "_wanted_left", "_wanted_right",
    )  # fmt: skip

    _base: float  # distance between the wheels [m],
    _half_base: float  # half of it
    _limit: float  # largest rim speed [m/s]
    _acceleration: float  # largest, of the rim [m/s²]
    _left: float  # rim speeds [m/s],
    _right: float
    _wanted_left: float  # commanded speed
    _wanted_right: float

    def __init__(self, kind: Kind, start: Vector, yaw: float) -> None:
        """At rest at `start` [m] with `yaw` [rad]."""
        wheels = kind.motion
        assert isinstance(wheels, Wheels)
        self._base, self._half_base = wheels.base, 0.5 * wheels.base
        self._limit, self._acceleration = wheels.speed, wheels.acceleration
        self.attitude, self.flying = NO_ATTITUDE, False
        self.wobble = (0.0, 0.0)
        self.place(start, yaw, flying=False)

    def command(self, setpoint: Setpoint) -> None:
        """Set v [m/s] and ω [rad/s], the first two numbers; NaN keeps the command."""
        v, half = setpoint[0], self._half_base * setpoint[1]
        left = v - half
        if isfinite(left):
            self._wanted_left, self._wanted_right = left, v + half

    def land(self) -> None:
        """Command zero wheel speed."""
        self._wanted_left = self._wanted_right = 0.0

    def place(self, position: Vector, yaw: float, *, flying: bool) -> None:
        self.position, self.velocity, self.yaw = position, ZERO, yaw
        self._left = self._right = self._wanted_left = self._wanted_right = 0.0

    def push(self, velocity: Vector) -> None:
        speed = velocity[0] * cos(self.yaw) + velocity[1] * sin(self.yaw)
        self._left = self._right = self._wanted_left = self._wanted_right = speed

    def move(self, dt: float) -> None:
        """One step of `dt` [s], along an arc: no side-slip (paper, eq. (1))."""
        left, right, limit = self._wanted_left, self._wanted_right, self._limit
        if abs(left) > limit or abs(right) > limit:
            # both wheels are slowed by the same factor, which keeps the curvature
            excess = max(abs(left), abs(right)) / limit
            left, right = left / excess, right / excess
        change = self._acceleration * dt
        self._left += clamp(left - self._left, -change, change)
        self._right += clamp(right - self._right, -change, change)
        left, right = self._left, self._right
        v = 0.5 * (left + right)
        turn = (right - left) * (dt / self._base)
        yaw = self.yaw
        middle = yaw + 0.5 * turn
        vx, vy = v * cos(middle), v * sin(middle)
        x, y, z = self.position
        self.velocity = (vx, vy, 0.0)
        self.position = (x + dt * vx, y + dt * vy, z)
        self.yaw = yaw + turn
