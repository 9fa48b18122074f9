"""Prediction: believed position of a robot from its last transmitted pose.

Receiver and sender extrapolate the last transmitted pose with the same model, so the sender knows its neighbours'
error without receiving anything. A predictor is a frozen struct of its parameters, found by the entry-point group
`zenpark.predictors`. All methods run on quiet ticks.
"""

from __future__ import annotations

from math import inf
from typing import Annotated, Protocol

import msgspec
from msgspec import Meta

from agents.vectors import ZERO, Positive, Vector


class Sent(Protocol):
    """A transmitted pose."""

    @property
    def position(self) -> Vector: ...  # [m]
    @property
    def velocity(self) -> Vector: ...  # [m/s]


class Predictor(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Extrapolation between two messages; a subclass that defines nothing holds the last pose."""

    def position(self, pose: Sent, age: float) -> Vector:
        """Estimated position [m] of the robot with a `pose` of this `age` [s].

        Negative ages, which clocks of two machines can make, count as zero.
        """
        return pose.position

    def velocity(self, pose: Sent, age: float) -> Vector:
        """Velocity [m/s] of that belief."""
        return ZERO

    def reach(self) -> float:
        """Time for which the belief moves as `velocity` says at age 0 [s]; infinity where that never changes."""
        return inf


class HoldPrediction(Predictor, frozen=True):
    """p̂ = p_k: the last transmitted position."""


class ConstantVelocity(Predictor, frozen=True):
    """p̂ = p_k + v_k · min(t − t_k, horizon): the last transmitted motion, which stops after the horizon.

    The linear predictor of Y. S. Suh, "Send-On-Delta Sensor Data Transmission With A Linear Predictor", with the
    velocity taken from the message instead of from the samples before. Without a horizon the estimate runs away after a
    lost message, until the next one arrives.
    """

    horizon_s: Annotated[
        Positive, Meta(description="time for which the last velocity is used [s]; left out: for ever")
    ] = inf

    def position(self, pose: Sent, age: float) -> Vector:
        seconds = min(max(age, 0.0), self.horizon_s)
        (x, y, z), (vx, vy, vz) = pose.position, pose.velocity
        return x + vx * seconds, y + vy * seconds, z + vz * seconds

    def velocity(self, pose: Sent, age: float) -> Vector:
        return pose.velocity if age < self.horizon_s else ZERO

    def reach(self) -> float:
        return self.horizon_s


HOLD = HoldPrediction()
