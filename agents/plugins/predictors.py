"""Prediction: where a robot is believed to be, from what it last said of itself.

Whoever listens applies it on each link, and whoever speaks applies the same to what it said last: both believe the same
place, so that a trigger can tell how far off its neighbours are without hearing from them. A predictor is a frozen
struct of its parameters, found by the entry-point group `zenpark.predictors`.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from agents.arrays import Array

Positive = Annotated[float, Meta(gt=0)]


class Predictor(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a belief goes on between two messages; a subclass that does not say otherwise holds the last one."""

    @property
    def reach_s(self) -> float:
        """For how long the belief moves as `velocity` says at age 0 [s]; infinity where that never changes."""
        return np.inf

    def position(self, position: Array, velocity: Array, age: Array) -> Array:
        """Where (K, 3) [m] somebody is believed to be who said `position` (K, 3) and `velocity` (K, 3) `age` (K,) ago.

        Ages are in seconds; negative ones, which clocks of two machines can make, count as zero.
        """
        return position

    def velocity(self, velocity: Array, age: Array) -> Array:
        """How fast (K, 3) [m/s] that belief moves."""
        return np.zeros_like(velocity)


class Hold(Predictor, frozen=True):
    """p̂ = p_k: everybody is where they last said."""


class ConstantVelocity(Predictor, frozen=True):
    """p̂ = p_k + v_k · min(t − t_k, horizon): everybody goes on as they last said, and stops after the horizon.

    The linear predictor of Y. S. Suh, "Send-On-Delta Sensor Data Transmission With A Linear Predictor", with the
    velocity taken from the message instead of from the samples before. Without a horizon the belief about a robot whose
    last message was lost runs away for as long as the robot keeps silent.
    """

    horizon_s: Annotated[
        Positive | None, Meta(description="the last velocity is believed for so long [s]; left out: for ever")
    ] = None

    @property
    def reach_s(self) -> float:
        """See `Predictor.reach_s`."""
        return np.inf if self.horizon_s is None else self.horizon_s

    def position(self, position: Array, velocity: Array, age: Array) -> Array:
        """See `Predictor.position`."""
        return position + velocity * np.minimum(np.maximum(age, 0.0), self.reach_s)[:, None]

    def velocity(self, velocity: Array, age: Array) -> Array:
        """See `Predictor.velocity`."""
        return np.where((age < self.reach_s)[:, None], velocity, 0.0)


HOLD = Hold()
