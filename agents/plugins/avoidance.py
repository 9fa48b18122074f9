"""Avoidance: keeping clear of obstacles seen by range sensors and of robots whose poses are received.

An avoidance is a frozen struct of its parameters, found by the entry-point group `zenpark.avoidances`. It may act at
two levels: `deviate` shifts a goal (individual level; the potential of the paper), `restrain` limits the setpoint
after all other limits (safety level; the barrier).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from agents.arrays import Array, Columns, Index, Mask, NotNegative, Positive, every, norm

COINCIDENT = 1e-6  # [m] axes nearer than this have no direction
TOUCHING = 1e-3  # [m] smallest gap in a force: forces stay finite
LAYER = 0.05  # [m] depth within d0 in which the push of a thing grows to its full size
ASIDE = 0.1  # of the pull against a push: the step aside


class Nearby(Columns, frozen=True):
    """Things near rows, one entry per thing and row that knows it (K).

    Things are upright cylinders: a robot whose pose was received, or the point (radius 0) where a range reading ended.
    """

    row: Index  # (K,) row that knows the thing
    position: Array  # (K, 2) believed now [m]
    velocity: Array  # (K, 2) believed [m/s]; 0 for range readings
    radius: Array  # (K,) [m]
    low: Array  # (K,) lower end [m]
    high: Array  # (K,) upper end [m]
    is_robot: Mask  # (K,) robot of this experiment, which may avoid as well; else a range reading
    lag: Array  # (K,) time constant of its velocity [s]; 0 for range readings

    def append(self, others: Nearby) -> Nearby:
        """These things and others."""
        if not len(others):
            return self
        return Nearby.joined([self, others]) if len(self) else others

    def bearing(self, own: OwnState) -> tuple[Array, Array]:
        """Unit vectors (K, 2) from each thing to the row that knows it, and the distances (K,) of their axes [m].

        Two axes in one place, which only wrong measurements can give, are separated along x.
        """
        away = own.position[self.row, :2] - self.position
        distance = norm(away)
        some_way = distance > COINCIDENT
        if not every(some_way):
            away[~some_way], distance = (COINCIDENT, 0.0), np.maximum(distance, COINCIDENT)
        return away / distance[:, None], distance

    def gaps(self, own: OwnState) -> tuple[Array, Array]:
        """Unit vectors (K, 2) as `bearing`, and gaps (K,) between surfaces once both have stopped closing in [m].

        A velocity fades with its time constant, so that a robot moves on by the product of both.
        """
        away, distance = self.bearing(own)
        coming = np.maximum(np.vecdot(away, self.velocity), 0.0)
        going = np.maximum(-np.vecdot(away, own.velocity[self.row, :2]), 0.0)
        way = own.lag[self.row] * going + self.lag * coming
        return away, distance - own.radius[self.row] - self.radius - way


@dataclass(frozen=True)
class OwnState:
    """State and properties of rows (N)."""

    position: Array  # (N, 3) measured [m]
    velocity: Array  # (N, 3) measured or estimated, 0 where unknown [m/s]
    yaw: Array  # (N,) measured [rad]
    radius: Array  # (N,) [m]
    height: Array  # (N,) vertical size, from the position up [m]
    speed: Array  # (N,) limit [m/s]
    turn_rate: Array  # (N,) limit [rad/s]
    response: Array  # (N,) rate at which a body that takes positions closes a position error [1/s]
    lag: Array  # (N,) time constant from commanded to true velocity [s]
    takes: tuple[str, ...]  # (N,) "position", "velocity" or "twist"
    by_position: Mask  # (N,) takes a position
    by_twist: Mask  # (N,) takes a twist
    flies: Mask  # (N,)


class Avoidance(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of all avoidances, with the parameters that every one has."""

    hears: Annotated[
        Literal["neighbours", "all"],
        Meta(description="robots whose poses are received for it: neighbours of the formation, or all"),
    ] = "neighbours"
    clearance: Annotated[
        NotNegative,
        Meta(description="things farther above or below than this are ignored [m]; more against downwash"),
    ] = 0.1

    def deviate(self, goal: Array, own: OwnState, near: Nearby, period: float) -> Array:
        """Goals (N, 3) [m] to pursue in place of `goal` (N, 3); called every `period` [s]."""
        return goal

    def restrain(self, setpoint: Array, own: OwnState, near: Nearby) -> Array:
        """Setpoints (N, 4) to send in place of `setpoint` (N, 4), in the meaning of each row's kind.

        Changes are held to the limits of speed and arena; rows without a valid pose keep theirs.
        """
        return setpoint


class Potential(Avoidance, frozen=True):
    """The repulsive potential of the paper, eqs. (2) to (4): a shift of the goal away from near things.

    Each thing k within d0 pushes with F_k = η (1/d_k − 1/d0) / d_k² along the horizontal unit vector from it to the
    robot, and the goal is shifted by u = h v F/‖F‖, F = Σ F_k; d is between surfaces once both stopped. In a layer of
    `LAYER` below d0 the shift grows in proportion to ‖F‖ (Slotine and Sastry, "Tracking control of non-linear systems
    using sliding surfaces", Int. J. Control 38(2), 1983), and the part of the pull against F also pulls aside, by
    `ASIDE` (a vortex field: De Luca and Oriolo, "Local incremental planning for nonholonomic mobile robots", ICRA
    1994). docs/plugins.md says why, and how what the paper leaves open is read.
    """

    reach: Annotated[Positive, Meta(description="d0, from surface to surface [m]")] = 0.30
    strength: Annotated[Positive, Meta(description="η [N m³], of all forces alike")] = 1.5e-4
    velocity: Annotated[Positive | None, Meta(description="v [m/s]; left out: the robot's limit of speed")] = None
    period_s: Annotated[Positive | None, Meta(description="h [s]; left out: 1/response of the robot's kind")] = None

    def force(self, own: OwnState, near: Nearby) -> Array:
        """F (N, 2) of eq. (3), summed over near things; zero where there are none."""
        away, gap = near.gaps(own)
        gap = np.maximum(gap, TOUCHING)
        push = self.strength * np.maximum(1.0 / gap - 1.0 / self.reach, 0.0) / gap**2
        total = np.zeros((len(own.yaw), 2))
        np.add.at(total, near.row, push[:, None] * away)
        return total

    def deviate(self, goal: Array, own: OwnState, near: Nearby, period: float) -> Array:
        """Shift goals by eq. (4)."""
        if not len(near):
            return goal
        force = self.force(own, near)
        strength = norm(force)
        rows = np.flatnonzero((strength > 0.0) & np.isfinite(goal[:, :2]).all(axis=1))
        if not len(rows):
            return goal
        here, limit, response = own.position[rows, :2], own.speed[rows], own.response[rows]
        way = goal[rows, :2] - here
        way *= np.minimum(1.0, limit / response / np.maximum(norm(way), TOUCHING))[:, None]
        v = limit if self.velocity is None else self.velocity
        h = 1.0 / response if self.period_s is None else self.period_s
        away = force[rows] / strength[rows, None]
        right = np.column_stack([-away[:, 1], away[:, 0]])  # of one that looks against the push
        against, across = np.maximum(-(way * away).sum(axis=1), 0.0), (way * right).sum(axis=1)
        aside = np.where(across >= -0.5 * ASIDE * against, ASIDE, -ASIDE) * against
        inner = self.reach - min(LAYER, 0.5 * self.reach)
        share = np.minimum(1.0, strength[rows] / (self.strength * (1.0 / inner - 1.0 / self.reach) / inner**2))
        shifted = goal.copy()
        shifted[rows, :2] = here + way + (share * h * v)[:, None] * away + (share * aside)[:, None] * right
        return shifted
