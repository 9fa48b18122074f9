"""Differential drive: unicycle on two wheels with limits of speed and acceleration.

A command holds until the next one, as on the robots themselves: what stops wheels that are told nothing more is their
bridge, a watchdog on the robot, or nothing (docs/hanging.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from agents.arrays import Array, Index, Mask, clamp, every
from agents.body.kinds import Kind


@dataclass(frozen=True)
class Drive:
    """Two driven wheels."""

    base: float  # distance between the wheels [m]
    speed: float  # largest rim speed [m/s]
    acceleration: float  # largest, of the rim [m/s²]


DRIVES: Final[dict[str, Drive]] = {
    "khepera4": Drive(base=0.1054, speed=0.8137, acceleration=130.0 * 0.021),  # 130 rad/s² on a wheel of 42 mm
    "turtlebot3": Drive(base=0.160, speed=0.22 + 2.84 * 0.080, acceleration=2.0),  # acceleration: our choice
}


class Differential:
    """N differential robots."""

    def __init__(self, kinds: Sequence[Kind], start: Array, yaw: Array, dt: float) -> None:
        drives = [DRIVES[kind.name] for kind in kinds]
        self._dt = dt
        self._half_base = np.array([0.5 * d.base for d in drives])
        self._turn = np.array([dt / d.base for d in drives])  # change of yaw in a step per difference of the rim speeds
        self._limit = np.array([d.speed for d in drives])
        self._change = np.array([d.acceleration * dt for d in drives])
        self._least = -self._change
        self._wheels = np.zeros((2, len(drives)))  # rim speeds, left and right [m/s]
        self._wanted = np.zeros((2, len(drives)))
        self.position = np.array(start, dtype=float)  # (n, 3) [m]; z stays 0
        self.yaw = np.array(yaw, dtype=float)  # (n,) [rad]
        self.velocity = np.zeros_like(self.position)  # (n, 3) [m/s]

    def command(self, twist: Array) -> None:
        """Set v [m/s] and ω [rad/s], (n, 2); rows of NaN keep their command."""
        v, half = twist[:, 0], self._half_base * twist[:, 1]
        wanted = np.empty((2, len(half)))
        wanted[0], wanted[1] = v - half, v + half
        given = np.isfinite(wanted[0])
        if every(given):
            self._wanted = wanted
        else:
            np.copyto(self._wanted, wanted, where=given)

    def halt(self, rows: Index) -> None:
        """Command zero wheel speed."""
        self._wanted[:, rows] = 0.0

    def place(self, rows: Index, position: Array, yaw: Array, flying: Mask) -> None:
        """Set positions (len(rows), 3) [m] and yaws [rad], at rest."""
        self.position[rows], self.yaw[rows], self.velocity[rows] = position, yaw, 0.0
        self._wanted[:, rows] = self._wheels[:, rows] = 0.0

    def roll(self, rows: Index, velocity: Array) -> None:
        """Drive rows straight ahead with the component of a velocity (len(rows), 3) [m/s] along their heading."""
        speed = velocity[:, 0] * np.cos(self.yaw[rows]) + velocity[:, 1] * np.sin(self.yaw[rows])
        self._wanted[:, rows] = self._wheels[:, rows] = speed

    def advance(self) -> None:
        """One step of dt, along an arc: no side-slip (paper, eq. (1))."""
        wanted = self._wanted
        speed = np.abs(wanted)
        if not every(speed <= self._limit):  # both wheels are slowed by the same factor, which keeps the curvature
            wanted = wanted / np.maximum(np.maximum(speed[0], speed[1]) / self._limit, 1.0)
        self._wheels += clamp(wanted - self._wheels, self._least, self._change)
        left, right = self._wheels[0], self._wheels[1]
        v = 0.5 * (left + right)
        turn = (right - left) * self._turn
        middle = self.yaw + 0.5 * turn
        self.velocity[:, 0], self.velocity[:, 1] = v * np.cos(middle), v * np.sin(middle)
        self.position += self._dt * self.velocity
        self.yaw = self.yaw + turn  # see `Quadrotor.advance`
