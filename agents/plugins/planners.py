"""Planners, the upper level (paper, figure 10): target of a robot as a function of time.

A planner is a frozen struct of its parameters with two methods, found by the entry-point group `zenpark.planners`.
It starts at the robot's place (its anchor and heading when the leg begins), so one file serves any start.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Protocol

import msgspec
import numpy as np
from msgspec import Meta

from agents.arrays import Array, Index, Mask, Positive

Offset = Annotated[list[float], Meta(min_length=2, max_length=3)]


class Planner(Protocol):
    """Target as a function of time."""

    def target(self, elapsed: Array, anchor: Array, heading: Array) -> tuple[Array, Array]:
        """Target position (R, 3) [m] and yaw (R,) [rad], NaN where any yaw will do.

        The rows began this leg `elapsed` (R,) [s] ago, at `anchor` (R, 3) [m] with the yaw `heading` (R,) [rad].
        """
        ...

    def speed(self) -> float:
        """Largest speed of the target [m/s]."""
        ...


class Parameters(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of a planner, as they stand in the experiment file."""


def _any_yaw(rows: int) -> Array:
    return np.full(rows, np.nan)


def _spatial(values: Sequence[float]) -> Array:
    """(3,) from a planar or spatial offset."""
    return np.array([*values, 0.0][:3])


class Hold(Parameters, frozen=True):
    """Stay in place, or stand at `at`; turn to `yaw` if given."""

    at: Annotated[Offset | None, Meta(description="x, y (, z) [m]")] = None
    yaw: Annotated[float | None, Meta(description="[rad]")] = None

    def target(self, elapsed: Array, anchor: Array, heading: Array) -> tuple[Array, Array]:
        position = anchor.copy()
        if self.at is not None:
            position[:, : len(self.at)] = self.at
        return position, np.full(len(elapsed), np.nan if self.yaw is None else self.yaw)

    def speed(self) -> float:
        return 0.0


class Line(Parameters, frozen=True):
    """Straight line from the robot's place, at constant speed; then stay."""

    move_by: Annotated[Offset, Meta(description="x, y (, z) [m]")]
    speed_: Annotated[Positive, Meta(description="[m/s]")] = msgspec.field(name="speed")
    yaw: Annotated[float | None, Meta(description="at the end [rad]")] = None

    def target(self, elapsed: Array, anchor: Array, heading: Array) -> tuple[Array, Array]:
        way = _spatial(self.move_by)
        length = math.sqrt(float(way @ way))
        share = np.minimum(elapsed * self.speed_ / length, 1.0) if length else np.ones_like(elapsed)
        yaw = _any_yaw(len(elapsed))
        if self.yaw is not None:
            yaw[share >= 1.0] = self.yaw
        return anchor + share[:, None] * way, yaw

    def speed(self) -> float:
        return self.speed_


class Waypoints(Parameters, frozen=True):
    """Straight lines through points of the arena, at constant speed; then stay, or begin again with `loop`."""

    points: Annotated[list[Offset], Meta(min_length=1, description="x, y (, z) [m]")]
    speed_: Annotated[Positive, Meta(description="[m/s]")] = msgspec.field(name="speed")
    loop: Annotated[bool, Meta(description="from the last point to the first, and again")] = False

    def target(self, elapsed: Array, anchor: Array, heading: Array) -> tuple[Array, Array]:
        points = np.repeat(anchor[:, None, :], len(self.points), axis=1)  # (R, P, 3): heights left out stay
        for k, point in enumerate(self.points):
            points[:, k, : len(point)] = point
        route = np.concatenate([anchor[:, None], points], axis=1)
        way = elapsed * self.speed_
        if not self.loop:
            return _points_along(route, way), _any_yaw(len(elapsed))
        ring = np.concatenate([points, points[:, :1]], axis=1)
        approach, lap = _length(route[:, :2]), _length(ring)
        on_ring = way > approach
        rest = np.mod(way - approach, np.where(lap > 0, lap, 1.0))
        return np.where(on_ring[:, None], _points_along(ring, rest), _points_along(route, way)), _any_yaw(len(elapsed))

    def speed(self) -> float:
        return self.speed_


def _length(route: Array) -> Array:
    """Lengths (R,) of the polylines (R, P, 3)."""
    return np.asarray(np.sqrt(np.sum(np.diff(route, axis=1) ** 2, axis=2)).sum(axis=1))


def _points_along(route: Array, way: Array) -> Array:
    """The points (R, 3) reached after `way` (R,) metres along the polylines `route` (R, P, 3)."""
    step = np.diff(route, axis=1)
    length = np.sqrt(np.sum(step**2, axis=2))  # (R, P-1)
    begun = np.cumsum(length, axis=1) - length
    share = np.clip((way[:, None] - begun) / np.where(length > 0, length, 1.0), 0.0, 1.0)
    share = np.where(length > 0, share, 0.0)
    return np.asarray(route[:, 0] + np.einsum("rp,rpk->rk", share, step))


class Circle(Parameters, frozen=True):
    """Circle from the robot's place, along its heading, to the left (to the right with a negative radius)."""

    radius: Annotated[float, Meta(description="[m]")]
    period_s: Annotated[Positive, Meta(description="one turn [s]")]
    turns: Annotated[Positive | None, Meta(description="how many; for ever if left out")] = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.radius) and self.radius != 0.0):
            raise ValueError("`radius` must be a number other than 0")

    def target(self, elapsed: Array, anchor: Array, heading: Array) -> tuple[Array, Array]:
        turned = elapsed / self.period_s
        if self.turns is not None:
            turned = np.minimum(turned, self.turns)
        angle = heading + math.copysign(2.0 * math.pi, self.radius) * turned
        position = anchor.copy()
        position[:, 0] += self.radius * (np.sin(angle) - np.sin(heading))
        position[:, 1] += self.radius * (np.cos(heading) - np.cos(angle))
        return position, _any_yaw(len(elapsed))

    def speed(self) -> float:
        return 2.0 * math.pi * abs(self.radius) / self.period_s


class Lemniscate(Parameters, frozen=True):
    """Figure of eight (Gerono's lemniscate) through the robot's place, leaving along its heading."""

    size: Annotated[Positive, Meta(description="half its length [m]")]
    period_s: Annotated[Positive, Meta(description="one figure [s]")]

    def target(self, elapsed: Array, anchor: Array, heading: Array) -> tuple[Array, Array]:
        angle = 2.0 * math.pi * elapsed / self.period_s
        along, across = self.size * np.sin(angle), self.size * np.sin(angle) * np.cos(angle)
        turn = heading - math.pi / 4.0  # the curve leaves its centre at 45 degrees
        position = anchor.copy()
        position[:, 0] += np.cos(turn) * along - np.sin(turn) * across
        position[:, 1] += np.sin(turn) * along + np.cos(turn) * across
        return position, _any_yaw(len(elapsed))

    def speed(self) -> float:
        return 2.0 * math.pi / self.period_s * self.size * math.sqrt(2.0)


@dataclass(frozen=True)
class Leg:
    """Leg of an itinerary: follow `planner` from `at` on [s of the experiment]."""

    at: float
    planner: Planner


class Itinerary:
    """Legs that some rows follow one after the other, and where each began."""

    def __init__(self, rows: Index, legs: Sequence[Leg], *, holds_before: bool) -> None:
        """Rows `rows` (R,) follow `legs`, given in order of time; the first may begin later than 0.

        With `holds_before` the rows stay at their start until the first leg; else they have no target then.
        """
        self.rows = rows
        first = Leg(0.0, Hold()) if holds_before else None
        self.legs = tuple(legs) if first is None else (first, *legs)
        self._leg = np.full(len(rows), -1)
        self._anchor = np.zeros((len(rows), 3))
        self._heading = np.zeros(len(rows))
        self._origin = np.full((len(rows), 4), np.nan)

    def target(self, t: Array, position: Array, yaw: Array) -> tuple[Array, Array]:
        """Target position (R, 3) [m] and yaw (R,) [rad] at times `t` (R,) [s]; NaN before the first leg.

        The first leg begins at `position` (R, 3) [m] and `yaw` (R,) [rad].
        """
        target, toward = np.full((len(self.rows), 3), np.nan), _any_yaw(len(self.rows))
        for number, leg in enumerate(self.legs):
            begins = (t >= leg.at - 1e-9) & (self._leg < number)
            if begins.any() and (begins := begins & np.isfinite(position).all(axis=1)).any():  # or it begins later
                self._begin(number, begins, position, yaw)
            mine = self._leg == number
            if mine.any():
                elapsed = np.maximum(t[mine] - leg.at, 0.0)
                target[mine], toward[mine] = leg.planner.target(elapsed, self._anchor[mine], self._heading[mine])
        return target, toward

    def origin(self, row: int) -> tuple[float, float, float, float] | None:
        """x, y, z [m] and yaw [rad] of a row when its first leg began; None before that, and of other rows."""
        mine = np.flatnonzero((self.rows == row) & (self._leg >= 0))
        if not len(mine):
            return None
        x, y, z, yaw = self._origin[mine[0]].tolist()
        return x, y, z, yaw

    def _begin(self, number: int, rows: Mask, position: Array, yaw: Array) -> None:
        """Anchor a leg at the end of the one before, so that tracking errors do not add up, or at the robot."""
        anchor, heading = position[rows], yaw[rows].copy()
        if number:
            before = self.legs[number - 1]
            elapsed = np.full(len(anchor), self.legs[number].at - before.at)
            anchor, toward = before.planner.target(elapsed, self._anchor[rows], self._heading[rows])
            heading = np.where(np.isnan(toward), heading, toward)
        else:
            self._origin[rows, :3], self._origin[rows, 3] = anchor, heading
        self._leg[rows], self._anchor[rows], self._heading[rows] = number, anchor, heading
