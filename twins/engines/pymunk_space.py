"""Pymunk space of a scene: robots as discs, wheels with grip, obstacles, walls."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

import numpy as np
import pymunk

from agents.body.kinds import Kind, Wheels
from twins.arrays import Array
from twins.models.quadrotor import GRAVITY
from twins.scene import Scene

WALL_DEPTH: Final = 1.0  # [m] thickness of the arena's walls, outwards: nothing passes through
GRAIN: Final = 32  # points per side for the mean lever of the friction under a box

# Obstacles with a mass have two shapes: one with a skin (see `twins.engines.pymunk_contacts`) for robots, which are
# fast, and one without for everything else, so that a box can rest flush against a wall.
ROBOT, FIXED, FIXED_BARE, LOOSE, LOOSE_BARE = (1 << k for k in range(5))
MEETS: Final = {
    ROBOT: ROBOT | FIXED | LOOSE,
    FIXED: ROBOT,
    FIXED_BARE: LOOSE_BARE,
    LOOSE: ROBOT,
    LOOSE_BARE: FIXED_BARE | LOOSE_BARE,
}
UNMOVED: Final = 1  # group of fixed bodies, which do not touch each other


@dataclass(frozen=True)
class Surfaces:
    """Coefficients of friction, and the thickness of the skin [m]."""

    robots: float
    walls: float
    traction: float
    skin: float


@dataclass
class ArenaSpace:
    """A scene with its robots."""

    surfaces: Surfaces
    walls: int  # number of the arena's walls, −1 − M
    space: pymunk.Space = field(default_factory=pymunk.Space)
    numbers: dict[pymunk.Shape, int] = field(
        default_factory=dict
    )  # row of each shape, or −1 − k of obstacle k, or walls
    rows: dict[int, pymunk.Body] = field(default_factory=dict)  # robots
    wheels: dict[int, pymunk.Body] = field(default_factory=dict)  # ground robots: shapeless, moves as commanded
    feet: dict[int, tuple[pymunk.PivotJoint, float]] = field(default_factory=dict)  # grip of landed rows, its force [N]
    obstacles: dict[int, pymunk.Body] = field(default_factory=dict)  # obstacles that have a plan or a mass

    def __post_init__(self) -> None:
        self._floor = self.space.static_body  # first of all bodies, so that bodies of one sort are contiguous

    def add_robot(self, row: int, kind: Kind, *, mirrored: bool) -> None:
        """Add a robot; a mirrored robot pushes others and cannot be pushed."""
        mass = kind.mass
        if mirrored:
            body = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        else:
            # contacts do not turn a flying robot: its model computes the yaw
            body = pymunk.Body(mass, math.inf if kind.flies else pymunk.moment_for_circle(mass, 0.0, kind.radius))
        self.space.add(body)
        self.rows[row] = body
        self._cover(body, row, [pymunk.Circle(body, kind.radius + self.surfaces.skin)], ROBOT, mirrored)
        force = self.surfaces.traction * mass * GRAVITY
        if not kind.flies:
            wheels = self.wheels[row] = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
            self.space.add(wheels)
            if not mirrored and isinstance(kind.motion, Wheels):
                self._add_floor_friction(wheels, body, force, 0.5 * kind.motion.base * force)
        elif not mirrored:
            self.feet[row] = self._add_floor_friction(self._floor, body, force, 0.0), force

    def furnish(self, scene: Scene) -> None:
        """Add obstacles and walls."""
        loose = bool(np.isfinite(scene.mass).any())
        for k, outline in enumerate(scene.outline):
            x, y, yaw = scene.pose[k].tolist()
            mass = float(scene.mass[k])
            if math.isfinite(mass):
                body = pymunk.Body(mass, _moment(mass, scene, k))
            elif scene.plans[k] is not None:
                body = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
            else:
                body = pymunk.Body(body_type=pymunk.Body.STATIC)
            body.position, body.angle = (x, y), yaw
            self.space.add(body)
            if body.body_type != pymunk.Body.STATIC:
                self.obstacles[k] = body
            pushed = math.isfinite(mass)
            if pushed:
                force = float(scene.friction[k]) * mass * GRAVITY
                self._add_floor_friction(self._floor, body, force, force * _friction_lever(scene, k))
            parts = ((LOOSE, LOOSE_BARE) if pushed else (FIXED, FIXED_BARE))[: 2 if loose else 1]
            for part in parts:
                skin = self.surfaces.skin if part in (FIXED, LOOSE) else 0.0
                shapes = _shapes(body, outline, scene.closed[k], float(scene.radius[k]), skin)
                self._cover(body, -1 - k, shapes, part, not pushed)
        if scene.walled:
            self._wall_in(scene, loose)

    def _wall_in(self, scene: Scene, loose: bool) -> None:
        body = self._floor
        (x0, y0), (x1, y1) = scene.low[:2].tolist(), scene.high[:2].tolist()
        d = WALL_DEPTH
        sides = [(x0 - d, y0 - d, x0, y1 + d), (x1, y0 - d, x1 + d, y1 + d)]
        sides += [(x0 - d, y0 - d, x1 + d, y0), (x0 - d, y1, x1 + d, y1 + d)]
        for part in (FIXED, FIXED_BARE)[: 2 if loose else 1]:
            skin = self.surfaces.skin if part == FIXED else 0.0
            corners = [[(a, b), (c, b), (c, e), (a, e)] for a, b, c, e in sides]
            self._cover(body, self.walls, [pymunk.Poly(body, each, radius=skin) for each in corners], part, True)

    def _cover(self, body: pymunk.Body, number: int, shapes: list[pymunk.Shape], part: int, unmoved: bool) -> None:
        # pymunk multiplies the coefficients of both shapes
        robots = math.sqrt(self.surfaces.robots)
        against = self.surfaces.walls / robots if robots > 0.0 else 0.0
        for shape in shapes:
            shape.friction = robots if part == ROBOT else against
            shape.filter = pymunk.ShapeFilter(UNMOVED if unmoved else 0, part, MEETS[part])
            self.numbers[shape] = number
            self.space.add(shape)

    def _add_floor_friction(self, on: pymunk.Body, body: pymunk.Body, force: float, torque: float) -> pymunk.PivotJoint:
        """Add friction with the floor: pulls a body to the velocity of `on`, within force [N] and torque [N m]."""
        hold = pymunk.PivotJoint(on, body, (0.0, 0.0), (0.0, 0.0))
        joints: list[pymunk.Constraint] = [hold]
        hold.max_force = force
        if torque > 0.0:
            joints.append(pymunk.GearJoint(on, body, 0.0, 1.0))
            joints[1].max_force = torque
        for joint in joints:
            joint.max_bias = 0.0  # velocities only, no correction of positions
        self.space.add(*joints)
        return hold


def _shapes(body: pymunk.Body, outline: Array | None, closed: bool, radius: float, skin: float) -> list[pymunk.Shape]:
    if outline is None:
        return [pymunk.Circle(body, radius + skin)]
    points = [(float(x), float(y)) for x, y in outline]
    if closed:
        return [pymunk.Poly(body, points, radius=skin)]
    return [pymunk.Segment(body, a, b, skin) for a, b in pairwise(points)]


def _moment(mass: float, scene: Scene, k: int) -> float:
    outline = scene.outline[k]
    if outline is None:
        return pymunk.moment_for_circle(mass, 0.0, float(scene.radius[k]))
    return pymunk.moment_for_poly(mass, outline.tolist())


def _friction_lever(scene: Scene, k: int) -> float:
    """Mean lever of the friction under an obstacle that turns [m]."""
    outline = scene.outline[k]
    if outline is None:
        return 2.0 / 3.0 * float(scene.radius[k])
    middles = (np.arange(GRAIN) + 0.5) / GRAIN * 2.0 - 1.0
    x, y = np.abs(outline).max(axis=0)
    return float(np.hypot(*np.meshgrid(x * middles, y * middles)).mean())
