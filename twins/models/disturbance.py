"""Disturbances of a model: hover jitter, measurement noise, drift of odometry, and command latency."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from agents.arrays import Array, every, norm
from agents.body.interface import Disturbance
from twins.models.noise import Noise

FULL_WOBBLE = 0.2  # [m] hover jitter grows from the ground up to this height: a standing robot has none


class HoverJitter:
    """Ornstein-Uhlenbeck displacement of each horizontal axis about the position held by the robot's controller."""

    def __init__(self, disturbance: Sequence[Disturbance], noise: Noise, dt: float) -> None:
        jitter = [d.hover_jitter for d in disturbance]
        sigma = np.array([0.0 if j is None else j.sigma for j in jitter])
        keep = np.array([1.0 if j is None else math.exp(-dt / j.correlation_s) for j in jitter])
        self._keep = np.repeat(keep[:, None], 2, axis=1)
        noise.scale = np.repeat((sigma * np.sqrt(1.0 - keep**2))[:, None], 2, axis=1)
        self._push = noise
        self.present = bool(sigma.any())
        self._displacement = np.zeros((len(disturbance), 2))

    def advance(self, height: Array) -> Array:
        """Step by dt, exact for any dt; returns the displacement (n, 2) of rows at `height` (n,) [m]."""
        self._displacement = self._keep * self._displacement + self._push.draw()
        if every(height >= FULL_WOBBLE):
            return self._displacement
        return np.asarray(np.minimum(height / FULL_WOBBLE, 1.0)[:, None] * self._displacement)


class Measurement:
    """White noise on the measured position and yaw."""

    def __init__(self, disturbance: Sequence[Disturbance], spatial: Array, noise: Noise) -> None:
        """`spatial` (n, 3): 1 on the axes on which a row's position is measured, else 0."""
        sigma = np.array([d.position_sigma or 0.0 for d in disturbance])
        yaw = np.array([d.yaw_sigma or 0.0 for d in disturbance])
        noise.scale = np.concatenate([sigma[:, None] * spatial, yaw[:, None]], axis=1)
        self._noise = noise
        self.present = bool(noise.scale.any())

    def draw(self) -> Array:
        """Noise (n, 4): x, y, z [m], yaw [rad]."""
        return self._noise.draw()


class Drift:
    """Error of odometry: a random walk of the measured position whose variance grows with the distance driven."""

    def __init__(self, disturbance: Sequence[Disturbance], noise: Noise) -> None:
        self._rate = np.array([d.odometry_drift or 0.0 for d in disturbance])
        self._noise = noise
        self.present = bool(self._rate.any())
        self.error = np.zeros((len(disturbance), 2))

    def advance(self, moved: Array) -> None:
        """One step in which each row moved by (n, 2) [m]."""
        self.error += (self._rate * np.sqrt(norm(moved)))[:, None] * self._noise.draw()


class Latency:
    """Commands (n, 4) take effect some ticks later."""

    def __init__(self, disturbance: Sequence[Disturbance], dt: float) -> None:
        self._ticks = np.array([round((d.latency_s or 0.0) / dt) for d in disturbance])
        self._past = np.full((int(self._ticks.max(initial=0)) + 1, len(disturbance), 4), np.nan)
        self._rows = np.arange(len(disturbance))
        self._now = 0
        self.present = bool(self._ticks.any())

    def delay(self, command: Array) -> Array:
        """Store this tick's command; returns the command that takes effect now."""
        self._now = (self._now + 1) % len(self._past)
        self._past[self._now] = command
        return np.asarray(self._past[(self._now - self._ticks) % len(self._past), self._rows])
