"""Avoidance: keeping clear of obstacles seen by range sensors and of robots with received poses.

An avoidance is a frozen struct of its parameters, found by the entry-point group `zenpark.avoidances`. It may act at
two levels: `deviate` shifts a goal (individual level; the potential of the paper), `restrain` limits the setpoint
after all other limits (safety level; the barrier). Both are quiet.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, sqrt
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from agents.vectors import ZERO, NotNegative, Positive, Setpoint, Vector

ABSENT_M: Final = 1e6  # [m] distance from 0 on both axes of what is not there
COINCIDENT: Final = 1e-6  # [m] axes nearer than this have no direction
TOUCHING: Final = 1e-3  # [m] smallest gap in a force: forces stay finite
LAYER: Final = 0.05  # [m] depth within d0 in which the push of a thing grows to its full size
ASIDE: Final = 0.1  # share of the pull against a push: the step aside
HURRY: Final = 2.0  # times its limit of speed: no robot is faster, not along the diagonal of limits per axis either


@dataclass(eq=False, slots=True)
class Thing:
    """Thing near a robot: an upright cylinder, a robot with a received pose or the end of a range reading.

    What follows `lag` is set by `measure`.
    """

    x: float = ABSENT_M  # believed now [m]
    y: float = ABSENT_M
    velocity_x: float = 0.0  # believed [m/s]; 0 for range readings
    velocity_y: float = 0.0
    radius: float = 0.0  # [m]; 0 for range readings
    low: float = 0.0  # lower end [m]
    high: float = 0.0  # upper end [m]
    is_robot: bool = False  # robot of this experiment, which may avoid as well; else a range reading
    lag: float = 0.0  # time constant of its velocity [s]; 0 for range readings
    away_x: float = 0.0  # unit vector from the thing to the robot
    away_y: float = 0.0
    gap: float = 0.0  # distance of the surfaces once both have stopped closing in [m]

    def vanish(self) -> None:
        """Be a point at rest, out of reach of everything."""
        self.x = self.y = ABSENT_M
        self.velocity_x = self.velocity_y = self.radius = self.low = self.high = self.lag = 0.0
        self.is_robot = False


@dataclass(eq=False, slots=True)
class Plane:
    """Half-plane a·u ≤ b of velocities u."""

    x: float = 0.0  # unit vector a
    y: float = 0.0
    b: float = 0.0  # [m/s]


class Nearby:
    """Things near a robot: the first `count` of `things`. The list has room for more, which stand `ABSENT_M` away."""

    def __init__(self) -> None:
        self.count = 0
        self.things: list[Thing] = []
        self.planes: list[Plane] = []  # planes that an avoidance writes, as many as things
        self.reserve(1)  # a compiler wants to see what is in a list

    def reserve(self, count: int) -> None:
        """Make room for `count` things; rare."""
        while len(self.things) < count:
            self.things.append(Thing())
            self.planes.append(Plane())

    def add(self) -> Thing:
        """One more thing, to be filled in; there is room for it."""
        self.count += 1
        return self.things[self.count - 1]

    def clear_rest(self, before: int) -> None:
        """Let those that are not among the things any more vanish; there were `before`."""
        for k in range(self.count, before):
            self.things[k].vanish()


@dataclass(eq=False, slots=True)
class OwnState:
    """State and properties of a robot."""

    position: Vector = ZERO  # measured [m]
    velocity: Vector = ZERO  # measured or estimated, 0 where unknown [m/s]
    yaw: float = 0.0  # measured [rad]
    radius: float = 0.0  # [m]
    height: float = 0.0  # vertical size, from the position up [m]
    speed: float = 1.0  # limit [m/s]
    turn_rate: float = 1.0  # limit [rad/s]
    response: float = 1.0  # rate at which a body that takes positions closes a position error [1/s]
    lag: float = 0.0  # time constant from commanded to true velocity [s]
    by_position: bool = False  # takes a position
    by_twist: bool = False  # takes a twist
    flies: bool = False


def measure_gap(own: OwnState, thing: Thing) -> None:
    """Set `away` and `gap` of a thing.

    Two axes in one place, which only wrong measurements can give, are separated along x. A velocity fades with its time
    constant, so that a robot moves on by the product of both.
    """
    x, y = own.position[0] - thing.x, own.position[1] - thing.y
    apart = sqrt(x * x + y * y)
    if not apart > COINCIDENT:
        x, y = COINCIDENT, 0.0
        apart = max(apart, COINCIDENT)
    x, y = x / apart, y / apart
    going, coming = -(x * own.velocity[0] + y * own.velocity[1]), x * thing.velocity_x + y * thing.velocity_y
    going = max(going, 0.0)
    coming = max(coming, 0.0)
    thing.away_x, thing.away_y = x, y
    thing.gap = apart - own.radius - thing.radius - (own.lag * going + thing.lag * coming)


class Avoidance(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of all avoidances, with the parameters that every one has."""

    hears: Annotated[
        Literal["neighbours", "all"],
        Meta(description="robots with poses received for it: neighbours of the formation, or all"),
    ] = "neighbours"
    clearance: Annotated[
        NotNegative, Meta(description="things farther above or below than this are ignored [m]; more against downwash")
    ] = 0.1

    def horizon(self, own: OwnState) -> float:
        """Distance between surfaces beyond which a thing at rest changes nothing [m]; its range readings are left out.

        Asked once, with the properties of the robot; infinite unless an avoidance says less.
        """
        return inf

    def kept_gap(self) -> float:
        """Gap between surfaces that is kept [m], as a picture draws it."""
        return self.clearance

    def deviate(self, goal: Vector, own: OwnState, near: Nearby, period: float) -> Vector:
        """Goal [m] to pursue in place of `goal` [m]; called every `period` [s]."""
        return goal

    def restrain(self, setpoint: Setpoint, own: OwnState, near: Nearby) -> Setpoint:
        """Setpoint to send in place of `setpoint`, in the meaning of the robot's kind.

        Changes are held to the limits of speed and arena; a robot without a valid pose keeps its own.
        """
        return setpoint


class Potential(Avoidance, frozen=True):
    """The repulsive potential of the paper, eqs. (2) to (4): a shift of the goal away from near things.

    Each thing k within d0 pushes with F_k = η (1/d_k − 1/d0) / d_k² along the horizontal unit vector from it to the
    robot. The goal is shifted by u = h v F/‖F‖, F = Σ F_k; d is between surfaces once both stopped. In a layer of
    `LAYER` below d0 the shift grows in proportion to ‖F‖ (Slotine and Sastry, "Tracking control of non-linear systems
    using sliding surfaces", Int. J. Control 38(2), 1983), and the part of the pull against F also pulls aside, by
    `ASIDE` (a vortex field: De Luca and Oriolo, "Local incremental planning for nonholonomic mobile robots", ICRA
    1994). docs/plugins.md gives the reasons, and the choices where the paper leaves something open.
    """

    reach: Annotated[Positive, Meta(description="d0, from surface to surface [m]")] = 0.30
    strength: Annotated[Positive, Meta(description="η [N m³], equal for all forces")] = 1.5e-4
    velocity: Annotated[Positive, Meta(description="v [m/s]; left out: the robot's limit of speed")] = inf
    period_s: Annotated[NotNegative, Meta(description="h [s]; 0: 1/response of the robot's kind")] = 0.0

    def horizon(self, own: OwnState) -> float:
        return self.reach + own.lag * HURRY * own.speed

    def push(self, gap: float) -> float:
        """Force of a thing at a distance of `gap` [m] between surfaces [N]."""
        gap = max(gap, TOUCHING)
        return self.strength * max(1.0 / gap - 1.0 / self.reach, 0.0) / (gap * gap)

    def deviate(self, goal: Vector, own: OwnState, near: Nearby, period: float) -> Vector:
        """Shift a goal by eq. (4)."""
        force_x = force_y = 0.0
        for k in range(near.count):
            thing = near.things[k]
            measure_gap(own, thing)
            push = self.push(thing.gap)
            force_x, force_y = force_x + push * thing.away_x, force_y + push * thing.away_y
        strength = sqrt(force_x * force_x + force_y * force_y)
        x, y, z = goal
        if not (strength > 0.0 and abs(x) < inf and abs(y) < inf):
            return goal
        here_x, here_y, _ = own.position
        way_x, way_y = x - here_x, y - here_y
        length = sqrt(way_x * way_x + way_y * way_y)
        shorter = min(1.0, own.speed / own.response / max(length, TOUCHING))
        way_x, way_y = way_x * shorter, way_y * shorter
        v = self.velocity if self.velocity < inf else own.speed
        h = self.period_s if self.period_s > 0.0 else 1.0 / own.response
        away_x, away_y = force_x / strength, force_y / strength
        right_x, right_y = -away_y, away_x  # right of one that looks against the push
        against, across = max(-(way_x * away_x + way_y * away_y), 0.0), way_x * right_x + way_y * right_y
        aside = (ASIDE if across >= -0.5 * ASIDE * against else -ASIDE) * against
        inner = self.reach - min(LAYER, 0.5 * self.reach)
        share = min(1.0, strength / (self.strength * (1.0 / inner - 1.0 / self.reach) / (inner * inner)))
        out, side = share * h * v, share * aside
        return here_x + way_x + out * away_x + side * right_x, here_y + way_y + out * away_y + side * right_y, z
