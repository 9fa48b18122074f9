"""Motion on the floor other than on two wheels, and the base of such models; all of it is quiet.

A command holds until the next one, as in `twins.models.differential`.
"""

from __future__ import annotations

from math import atan, cos, sin, sqrt, tan
from typing import Final

from agents.body.interface import NO_ATTITUDE
from agents.body.kinds import Holonomic, Kind, Steered
from agents.vectors import ZERO, Setpoint, Vector, clamp
from twins.models.motion import Motion

REST: Final[Setpoint] = (0.0, 0.0, 0.0, 0.0)
CREEP: Final = 1e-6  # [m/s] a slower twist says nothing of the steering angle


class Ground(Motion):
    """One robot on the floor. A model adds `move`, and what it remembers as attributes that `rest` sets."""

    setpoint: Setpoint  # the last command: v_x, v_y [m/s], 0, yaw rate [rad/s] in the room; or v, ω, 0, 0

    def __init__(self, kind: Kind, start: Vector, yaw: float) -> None:
        """At rest at `start` [m] with `yaw` [rad]."""
        self.attitude, self.flying = NO_ATTITUDE, False
        self.wobble = (0.0, 0.0)
        self.place(start, yaw, flying=False)

    def command(self, setpoint: Setpoint) -> None:
        """Set the setpoint; NaN keeps the last one."""
        x = setpoint[0]
        if x == x:  # noqa: PLR0124 - not NaN
            self.setpoint = setpoint

    def land(self) -> None:
        """Command standing still."""
        self.setpoint = REST

    def place(self, position: Vector, yaw: float, *, flying: bool) -> None:
        """Set position [m] and yaw [rad], at rest."""
        self.position, self.velocity, self.yaw, self.setpoint = position, ZERO, yaw, REST
        self.rest()

    def rest(self) -> None:
        """Set what a model remembers to that of a robot at rest."""


class Omni(Ground):
    """Velocities in the room that follow commands with a lag, and within limits of speed and acceleration."""

    def __init__(self, kind: Kind, start: Vector, yaw: float) -> None:
        assert isinstance(kind.motion, Holonomic)
        self._lag, self._speed, self._turn_rate = kind.lag, kind.speed, kind.turn_rate
        self._acceleration = kind.motion.acceleration
        super().__init__(kind, start, yaw)

    def rest(self) -> None:
        self._turning = 0.0  # [rad/s]

    def move(self, dt: float) -> None:
        """One step of `dt` [s]: a = (u − v) / lag, its size limited, as is that of u."""
        wanted_x, wanted_y, _, wanted_turn = self.setpoint
        speed = sqrt(wanted_x * wanted_x + wanted_y * wanted_y)
        if speed > self._speed:
            share = self._speed / speed
            wanted_x, wanted_y = wanted_x * share, wanted_y * share
        follows = 1.0
        if dt < self._lag:
            follows = dt / self._lag
        vx, vy, _ = self.velocity
        change_x, change_y = follows * (wanted_x - vx), follows * (wanted_y - vy)
        change = sqrt(change_x * change_x + change_y * change_y)
        if change > self._acceleration * dt:
            share = self._acceleration * dt / change
            change_x, change_y = change_x * share, change_y * share
        vx, vy = vx + change_x, vy + change_y
        x, y, z = self.position
        self._turning += follows * (clamp(wanted_turn, -self._turn_rate, self._turn_rate) - self._turning)
        self.velocity = (vx, vy, 0.0)
        self.position = (x + dt * vx, y + dt * vy, z)
        self.yaw += dt * self._turning


class Bicycle(Ground):
    """Two axles with front steering: the kinematic bicycle model, with limits of steering and acceleration.

    It drives as fast as its wheels are turned: the farther the steering angle is from the wanted one, the slower.
    """

    def __init__(self, kind: Kind, start: Vector, yaw: float) -> None:
        steered = kind.motion
        assert isinstance(steered, Steered)
        self._base, self._most, self._rate = steered.base, steered.angle, steered.angle_rate
        self._limit, self._acceleration = kind.speed, steered.acceleration
        super().__init__(kind, start, yaw)

    def rest(self) -> None:
        self._along, self._angle = 0.0, 0.0  # speed along the heading [m/s], steering angle [rad]

    def push(self, velocity: Vector) -> None:
        self._along = velocity[0] * cos(self.yaw) + velocity[1] * sin(self.yaw)
        self.setpoint = (self._along, 0.0, 0.0, 0.0)

    def move(self, dt: float) -> None:
        """One step of `dt` [s], along an arc: yaw' = v tan(angle) / base."""
        v, turn = self.setpoint[0], self.setpoint[1]
        angle = self._angle
        if abs(v) > CREEP:
            angle = clamp(atan(self._base * turn / v), -self._most, self._most)
        most, change = self._rate * dt, self._acceleration * dt
        self._angle += clamp(angle - self._angle, -most, most)
        v = clamp(v, -self._limit, self._limit) * max(0.0, 1.0 - abs(angle - self._angle) / self._most)
        self._along += clamp(v - self._along, -change, change)
        along, turned = self._along, self._along * tan(self._angle) / self._base * dt
        middle = self.yaw + 0.5 * turned
        vx, vy = along * cos(middle), along * sin(middle)
        x, y, z = self.position
        self.velocity = (vx, vy, 0.0)
        self.position = (x + dt * vx, y + dt * vy, z)
        self.yaw += turned
