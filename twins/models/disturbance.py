"""Disturbances of one robot: hover jitter, measurement noise, drift of odometry, and command latency.

Everything but the constructors is quiet. `noise` of a disturbance is refilled by its owner (`noise.refill`).
"""

from __future__ import annotations

from math import exp, sqrt
from typing import Final

from agents.body.interface import Disturbance
from agents.vectors import NO_SETPOINT, Setpoint
from twins.models.noise import Noise

FULL_WOBBLE: Final = 0.2  # [m] hover jitter grows from the ground up to this height: a standing robot has none

Planar = tuple[float, float]  # x, y


class HoverJitter:
    """Ornstein-Uhlenbeck displacement of each horizontal axis about the position held by the robot's controller."""

    __slots__ = ("_keep", "_x", "_y", "noise", "present")

    present: bool
    noise: Noise
    _keep: float  # share of the displacement that is left after dt
    _x: float  # displacement at full height [m]
    _y: float

    def __init__(self, disturbance: Disturbance, name: str, seed: int, dt: float) -> None:
        """`dt`: time between two calls of `advance` [s]."""
        jitter = disturbance.hover_jitter
        sigma = 0.0 if jitter is None else jitter.sigma
        self._keep = 1.0 if jitter is None else exp(-dt / jitter.correlation_s)
        self.noise = Noise(name, seed, "hover jitter", (sigma * sqrt(1.0 - self._keep * self._keep),) * 2)
        self.present = sigma != 0.0
        self._x = self._y = 0.0

    def advance(self, height: float) -> Planar:
        """Step by dt, exact for any dt; returns the displacement at `height` [m]."""
        noise = self.noise
        k = noise.next
        noise.next = k + 2
        keep = self._keep
        self._x = x = keep * self._x + noise.ahead[k]
        self._y = y = keep * self._y + noise.ahead[k + 1]
        if height >= FULL_WOBBLE:
            return x, y
        share = height / FULL_WOBBLE
        return share * x, share * y


class MeasurementNoise:
    """White noise on the measured position and yaw."""

    __slots__ = ("noise", "present")

    present: bool
    noise: Noise  # x, y, z [m], yaw [rad] in a draw

    def __init__(self, disturbance: Disturbance, name: str, seed: int, *, spatial: bool) -> None:
        """`spatial`: the height is measured, too."""
        sigma, yaw = disturbance.position_sigma or 0.0, disturbance.yaw_sigma or 0.0
        self.noise = Noise(name, seed, "measurement", (sigma, sigma, sigma if spatial else 0.0, yaw))
        self.present = self.noise.present

    def draw(self) -> tuple[float, float, float, float]:
        """Noise of x, y, z [m] and yaw [rad]."""
        noise = self.noise
        k, ahead = noise.next, noise.ahead
        noise.next = k + 4
        return ahead[k], ahead[k + 1], ahead[k + 2], ahead[k + 3]


class OdometryDrift:
    """Error of odometry: a random walk of the measured position; its variance grows with the distance driven."""

    __slots__ = ("_rate", "noise", "present", "x", "y")

    present: bool
    noise: Noise
    x: float  # error [m]
    y: float
    _rate: float  # standard deviation after 1 m [m per square root of m]

    def __init__(self, disturbance: Disturbance, name: str, seed: int) -> None:
        self._rate = disturbance.odometry_drift or 0.0
        self.present = self._rate != 0.0
        self.noise = Noise(name, seed, "odometry", (1.0, 1.0) if self.present else (0.0, 0.0))
        self.x = self.y = 0.0

    def advance(self, x: float, y: float) -> None:
        """One step in which the robot moved by x, y [m]."""
        noise = self.noise
        k = noise.next
        noise.next = k + 2
        scale = self._rate * sqrt(sqrt(x * x + y * y))
        self.x += scale * noise.ahead[k]
        self.y += scale * noise.ahead[k + 1]


class Latency:
    """Commands take effect some ticks later."""

    __slots__ = ("_now", "_past", "_ticks", "present")

    present: bool
    _ticks: int
    _past: list[Setpoint]  # commands of the last ticks, in a ring,
    _now: int  # index of the oldest

    def __init__(self, disturbance: Disturbance, dt: float) -> None:
        self._ticks = round((disturbance.latency_s or 0.0) / dt)
        self._past = [NO_SETPOINT] * (self._ticks + 1)
        self._now = 0
        self.present = self._ticks != 0

    def delay(self, command: Setpoint) -> Setpoint:
        """Store this tick's command; returns the command that takes effect now."""
        self._past[self._now] = command
        self._now = (self._now + 1) % (self._ticks + 1)
        return self._past[self._now]
