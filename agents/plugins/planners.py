"""Planners, the upper level (paper, figure 10): target of a robot as a function of time.

A planner is a frozen struct of its parameters with two methods, found by the entry-point group `zenpark.planners`.
It starts at the robot's place (its anchor and heading when the leg begins), so one file serves any start.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import accumulate, pairwise
from math import copysign, cos, inf, isfinite, isnan, nan, sin, sqrt, tau
from typing import Annotated, ClassVar, Final

import msgspec
from msgspec import Meta

from agents.vectors import ZERO, Pose, Positive, Vector, distance, is_finite

Offset = Annotated[list[float], Meta(min_length=2, max_length=3)]
NO_TARGET: Final[Pose] = (nan, nan, nan, nan)


class Planner(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of all planners: target as a function of time."""

    FILES: ClassVar[Mapping[str, str]] = {}  # parameters that name a file, and those that get its content, in base64

    def target(self, elapsed: float, anchor: Vector, heading: float) -> Pose:
        """Target x, y, z [m] and yaw [rad], NaN where any yaw will do.

        The leg began `elapsed` [s] ago, at `anchor` [m] with the yaw `heading` [rad].
        """
        raise TypeError(f"{type(self).__name__} must define `target`")

    def speed(self) -> float:
        """Largest speed of the target [m/s]."""
        raise TypeError(f"{type(self).__name__} must define `speed`")

    def source(self, elapsed: float) -> str:
        """Place in a file of the target at a time since the leg began [s], for people; empty without a file."""
        return ""


def spatial(place: Sequence[float], height: float) -> Vector:
    """Vector from a place or offset of two or three numbers; `height` is what is left out."""
    return place[0], place[1], place[2] if len(place) > 2 else height


class Hold(Planner, frozen=True):
    """Stay in place, or stand at `at`; turn to `yaw` if given."""

    at: Annotated[Offset | None, Meta(description="x, y (, z) [m]")] = None
    yaw: Annotated[float | None, Meta(description="[rad]")] = None

    def target(self, elapsed: float, anchor: Vector, heading: float) -> Pose:
        x, y, z = anchor if self.at is None else spatial(self.at, anchor[2])
        return x, y, z, nan if self.yaw is None else self.yaw

    def speed(self) -> float:
        return 0.0


class Line(Planner, frozen=True):
    """Straight line from the robot's place, at constant speed; then stay."""

    move_by: Annotated[Offset, Meta(description="x, y (, z) [m]")]
    speed_: Annotated[Positive, Meta(description="[m/s]")] = msgspec.field(name="speed")
    yaw: Annotated[float | None, Meta(description="at the end [rad]")] = None

    def target(self, elapsed: float, anchor: Vector, heading: float) -> Pose:
        (x, y, z), (dx, dy, dz) = anchor, spatial(self.move_by, 0.0)
        length = sqrt(dx * dx + dy * dy + dz * dz)
        share = min(elapsed * self.speed_ / length, 1.0) if length else 1.0
        yaw = nan if self.yaw is None or share < 1.0 else self.yaw
        return x + share * dx, y + share * dy, z + share * dz, yaw

    def speed(self) -> float:
        return self.speed_


class Waypoints(Planner, frozen=True):
    """Straight lines through points of the arena, at constant speed; then stay, or begin again with `loop`."""

    points: Annotated[list[Offset], Meta(min_length=1, description="x, y (, z) [m]")]
    speed_: Annotated[Positive, Meta(description="[m/s]")] = msgspec.field(name="speed")
    loop: Annotated[bool, Meta(description="from the last point to the first, and again")] = False

    def target(self, elapsed: float, anchor: Vector, heading: float) -> Pose:
        route, ways = _route(anchor, self)
        way = elapsed * self.speed_
        if self.loop and way > ways[1]:
            way = ways[1] + (way - ways[1]) % (ways[-1] - ways[1] or 1.0)
        k = bisect_right(ways, way)
        if k == len(route):
            return (*route[-1], nan)
        (x, y, z), (next_x, next_y, next_z) = route[k - 1], route[k]
        share = (way - ways[k - 1]) / (ways[k] - ways[k - 1])
        return x + share * (next_x - x), y + share * (next_y - y), z + share * (next_z - z), nan

    def speed(self) -> float:
        return self.speed_

    def __hash__(self) -> int:
        return hash((self.speed_, self.loop, len(self.points)))


@lru_cache(maxsize=1024)
def _route(anchor: Vector, leg: Waypoints) -> tuple[list[Vector], list[float]]:
    """Points from the anchor on, and the way to each [m]: once for each leg, for a tick would walk all of them."""
    points = [spatial(point, anchor[2]) for point in leg.points]  # heights left out stay
    route = [anchor, *points, *points[: leg.loop]]
    return route, [*accumulate((distance(a, b) for a, b in pairwise(route)), initial=0.0)]


class Circle(Planner, frozen=True):
    """Circle from the robot's place, along its heading, to the left (to the right with a negative radius)."""

    radius: Annotated[float, Meta(description="[m]")]
    period_s: Annotated[Positive, Meta(description="one turn [s]")]
    turns: Annotated[Positive | None, Meta(description="how many; for ever if left out")] = None

    def __post_init__(self) -> None:
        if not (isfinite(self.radius) and self.radius != 0.0):
            raise ValueError("`radius` must be a number other than 0")

    def target(self, elapsed: float, anchor: Vector, heading: float) -> Pose:
        x, y, z = anchor
        turned = elapsed / self.period_s
        if self.turns is not None:
            turned = min(turned, self.turns)
        angle = heading + copysign(tau, self.radius) * turned
        x += self.radius * (sin(angle) - sin(heading))
        y += self.radius * (cos(heading) - cos(angle))
        return x, y, z, nan

    def speed(self) -> float:
        return tau * abs(self.radius) / self.period_s


class Leg(msgspec.Struct, frozen=True):
    """Leg of an itinerary: follow `planner` from `at` on [s of the experiment]."""

    at: float
    planner: Planner


class Itinerary:
    """Legs that a robot follows one after the other, and where each began."""

    def __init__(self, legs: Sequence[Leg], *, holds_before: bool) -> None:
        """Follow `legs`, given in order of time; the first may begin later than 0.

        With `holds_before` the robot stays at its start until the first leg; else it has no target then.
        """
        self.legs = (Leg(0.0, Hold()), *legs) if holds_before else tuple(legs)
        self.origin: Pose | None = None  # x, y, z [m] and yaw [rad] where its first leg began; None before
        self._leg, self._anchor = -1, ZERO
        self._heading = 0.0
        self.next_at = self.legs[0].at if self.legs else inf  # time of the next leg [s]; infinity after the last

    def target(self, t: float, position: Vector, yaw: float) -> Pose:
        """Target x, y, z [m] and yaw [rad] at time `t` [s]; NaN before the first leg.

        The first leg begins at `position` [m] and `yaw` [rad].
        """
        if t >= self.next_at - 1e-9 and is_finite(position):  # else it begins later
            self._begin(t, position, yaw)
        if self._leg < 0:
            return NO_TARGET
        leg = self.legs[self._leg]
        return leg.planner.target(max(t - leg.at, 0.0), self._anchor, self._heading)

    def _begin(self, t: float, position: Vector, yaw: float) -> None:
        """Anchor legs that are due at the end of the one before, so that tracking errors do not add up."""
        while self._leg + 1 < len(self.legs) and t >= self.legs[self._leg + 1].at - 1e-9:
            if self._leg < 0:
                x, y, z = position
                self.origin = (x, y, z, yaw)
                self._anchor, self._heading = position, yaw
            else:
                before, after = self.legs[self._leg], self.legs[self._leg + 1]
                x, y, z, toward = before.planner.target(after.at - before.at, self._anchor, self._heading)
                self._anchor, self._heading = (x, y, z), yaw if isnan(toward) else toward
            self._leg += 1
        self.next_at = self.legs[self._leg + 1].at if self._leg + 1 < len(self.legs) else inf
