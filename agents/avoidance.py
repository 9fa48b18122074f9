"""Avoidance: how robots keep clear of what their range sensors see and of whom they hear.

An avoidance is a frozen struct of its parameters, found by the entry-point group `zenpark.avoidances`. It may act at
two levels: `deviate` shifts a goal (individual level; the potential of the paper), `restrain` has a say in the last
word before the body (safety level; the barrier).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from agents.rows import Array, Index, Mask

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]


@dataclass(frozen=True)
class Nearby:
    """What rows know of the things around them, one entry per thing and row that knows it (K).

    Things are upright cylinders: a robot that was heard, or the point (radius 0) where a ray of a range sensor ended.

    Attributes:
        row: (K,) who knows it.
        position: (K, 2) where it is believed to be now [m].
        velocity: (K, 2) as believed [m/s]; 0 for what a ray saw.
        radius: (K,) [m]
        low: (K,) lower end [m].
        high: (K,) upper end [m].
        heard: (K,) a robot of this experiment that was heard, which may avoid as well; else what a ray saw.
    """

    row: Index
    position: Array
    velocity: Array
    radius: Array
    low: Array
    high: Array
    heard: Mask


@dataclass(frozen=True)
class Self:
    """What rows know of themselves (N).

    Attributes:
        position: (N, 3) measured [m].
        yaw: (N,) measured [rad].
        radius: (N,) [m]
        height: (N,) vertical size, about the position of a flying robot, from the floor for others [m].
        speed: (N,) limit [m/s].
        turn_rate: (N,) limit [rad/s].
        response: (N,) rate at which a body that takes positions closes a position error [1/s].
        takes: (N,) "position", "velocity" or "twist".
        flies: (N,)
    """

    position: Array
    yaw: Array
    radius: Array
    height: Array
    speed: Array
    turn_rate: Array
    response: Array
    takes: tuple[str, ...]
    flies: Mask


class Avoidance(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters that every avoidance has."""

    hears: Annotated[
        Literal["neighbours", "all"], Meta(description="whom it hears: the neighbours of the formation, or every robot")
    ] = "neighbours"

    def deviate(self, goal: Array, own: Self, near: Nearby, period: float) -> Array:
        """The goals (N, 3) [m] that are pursued in place of `goal` (N, 3); asked every `period` [s]."""
        return goal

    def restrain(self, setpoint: Array, own: Self, near: Nearby) -> Array:
        """The setpoints (N, 4) that may be sent in place of `setpoint` (N, 4), in the meaning of each row's kind."""
        return setpoint


class Potential(Avoidance, frozen=True):
    """The repulsive potential of the paper, eqs. (2) to (4)."""

    reach: Annotated[Positive, Meta(description="d0 [m]")] = 0.30


class Barrier(Avoidance, frozen=True):
    """Control barrier function."""

    margin: Annotated[NotNegative, Meta(description="[m]")] = 0.05
