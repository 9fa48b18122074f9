"""Prediction: believed position of a robot from its last transmitted pose.

Receiver and sender extrapolate the last transmitted pose with the same model, so the sender knows its neighbours'
error without receiving anything. A predictor is a frozen struct of its parameters, found by the entry-point group
`zenpark.predictors`.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from agents.arrays import Array, Positive


class Predictor(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Extrapolation between two messages; a subclass that defines nothing holds the last pose."""

    @property
    def reach_s(self) -> float:
        """Time for which the belief moves as `velocity` says at age 0 [s]; infinity where that never changes."""
        return np.inf

    def position(self, position: Array, velocity: Array, age: Array) -> Array:
        """Believed positions (K, 3) [m] from `position` (K, 3) and `velocity` (K, 3) of `age` (K,) [s].

        Negative ages, which clocks of two machines can make, count as zero.
        """
        return position

    def velocity(self, velocity: Array, age: Array) -> Array:
        """Velocity (K, 3) [m/s] of that belief."""
        return np.zeros_like(velocity)


class Hold(Predictor, frozen=True):
    """p̂ = p_k: the last transmitted position."""


class ConstantVelocity(Predictor, frozen=True):
    """p̂ = p_k + v_k · min(t − t_k, horizon): the last transmitted motion, which stops after the horizon.

    The linear predictor of Y. S. Suh, "Send-On-Delta Sensor Data Transmission With A Linear Predictor", with the
    velocity taken from the message instead of from the samples before. Without a horizon the belief about a robot whose
    last message was lost runs away until its next message.
    """

    horizon_s: Annotated[
        Positive | None, Meta(description="the last velocity is used for this long [s]; left out: for ever")
    ] = None

    @property
    def reach_s(self) -> float:
        return np.inf if self.horizon_s is None else self.horizon_s

    def position(self, position: Array, velocity: Array, age: Array) -> Array:
        return position + velocity * np.minimum(np.maximum(age, 0.0), self.reach_s)[:, None]

    def velocity(self, velocity: Array, age: Array) -> Array:
        return np.where((age < self.reach_s)[:, None], velocity, 0.0)


HOLD = Hold()
