"""Meshes of the robots and obstacles: a few hundred triangles each, made of prisms. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from agents.body.kinds import Kind
from agents.plugins import registry
from twins.arrays import Array
from twins.scene import Scene

SIDES: Final = 10  # sides of what looks round
ROUND: Final = 28  # sides of a cylinder among the obstacles
WALL_M: Final = 0.02  # drawn thickness of a wall

Faces = NDArray[np.uint32]


@dataclass(frozen=True)
class Mesh:
    """Triangles."""

    vertices: Array  # (V, 3) [m]
    faces: Faces  # (F, 3) rows of `vertices`, anticlockwise seen from outside

    def moved(self, x: float, y: float, z: float) -> Mesh:
        return Mesh(self.vertices + np.array([x, y, z]), self.faces)

    def turned(self, yaw: float) -> Mesh:
        """About z by `yaw` [rad]."""
        cos, sin = np.cos(yaw), np.sin(yaw)
        return Mesh(self.vertices @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]), self.faces)


def joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + np.uint32(start) for mesh, start in zip(meshes, starts, strict=True)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces).astype(np.uint32))


def prism(ring: Array, low: float, high: float) -> Mesh:
    """Upright prism over a convex polygon (k, 2) [m], anticlockwise."""
    count = len(ring)
    vertices = np.concatenate([np.column_stack([ring, np.full(count, z)]) for z in (low, high)])
    k = np.arange(count)
    after = (k + 1) % count
    sides = np.concatenate([np.stack([k, after, after + count], 1), np.stack([k, after + count, k + count], 1)])
    fan = np.stack([np.zeros(count - 2, dtype=int), k[1:-1], k[2:]], 1)
    faces = np.concatenate([sides, fan[:, ::-1], fan + count])
    return Mesh(vertices, faces.astype(np.uint32))


def circle(radius: float, sides: int = SIDES) -> Array:
    """Corners (sides, 2) [m], anticlockwise."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def cylinder(radius: float, low: float, high: float, sides: int = SIDES) -> Mesh:
    return prism(circle(radius, sides), low, high)


def box(x: float, y: float, low: float, high: float) -> Mesh:
    """Box of x by y [m] in its middle."""
    return prism(0.5 * np.array([[-x, -y], [x, -y], [x, y], [-x, y]]), low, high)


def diamond(radius: float) -> Mesh:
    """Octahedron about the origin, `radius` [m] from its middle to its corners."""
    corners = radius * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float)
    k = np.arange(4)
    after = (k + 1) % 4
    top, bottom = np.stack([k, after, np.full(4, 4)], 1), np.stack([after, k, np.full(4, 5)], 1)
    return Mesh(corners, np.concatenate([top, bottom]).astype(np.uint32))


def annulus(inner: float, outer: float, sides: int = 32) -> Mesh:
    """Flat ring that is seen from above and from below."""
    ring = np.column_stack([np.concatenate([circle(inner, sides), circle(outer, sides)]), np.zeros(2 * sides)])
    k = np.arange(sides)
    after = (k + 1) % sides
    up = np.concatenate([np.stack([k, k + sides, after + sides], 1), np.stack([k, after + sides, after], 1)])
    return Mesh(ring, np.concatenate([up, up[:, ::-1]]).astype(np.uint32))


@dataclass(frozen=True)
class Model:
    """A kind of robot: heading along x, lowest point at z = 0."""

    body: Mesh  # mesh in the colour of the place of its body
    accent: Mesh  # mesh in the robot's colour; its nose

    @property
    def whole(self) -> Mesh:
        return joined(self.body, self.accent)


def quadrotor(kind: Kind, rotor: float, arm: float) -> Model:
    """Arms in a cross, a hub, and four rotors, of which the two in front and the nose have the robot's colour."""
    reach = kind.radius - rotor
    top = kind.height
    parts = [cylinder(0.32 * kind.radius, 0.25 * top, 0.95 * top, 8)]
    marked: list[Mesh] = []
    for k in range(4):
        angle = np.pi / 4 + k * np.pi / 2
        x, y = 1.25 * reach * np.cos(angle), 1.25 * reach * np.sin(angle)
        parts += [
            box(1.25 * reach, arm, 0.45 * top, 0.65 * top).moved(0.625 * reach, 0.0, 0.0).turned(angle),
            cylinder(0.8 * arm, 0.0, 0.85 * top, 6).moved(x, y, 0.0),
        ]
        disc = cylinder(rotor, 0.9 * top, top).moved(x, y, 0.0)
        (marked if k in (0, 3) else parts).append(disc)
    nose = prism(np.array([[0.35, -0.22], [0.85, 0.0], [0.35, 0.22]]) * kind.radius, 0.5 * top, 0.8 * top)
    return Model(joined(*parts), joined(nose, *marked))


def khepera(kind: Kind) -> Model:
    """A low cylinder between two wheels, with a coloured top plate that points ahead."""
    radius, top = kind.radius, kind.height
    wheel = box(0.6 * radius, 0.08 * radius, 0.0, 0.65 * top)
    body = joined(
        cylinder(0.95 * radius, 0.1 * top, 0.85 * top, 18),
        wheel.moved(0.0, 0.99 * radius, 0.0),
        wheel.moved(0.0, -0.99 * radius, 0.0),
    )
    plate = cylinder(0.72 * radius, 0.85 * top, top, 18)
    nose = prism(np.array([[0.55, -0.3], [1.05, 0.0], [0.55, 0.3]]) * radius, 0.6 * top, 0.98 * top)
    return Model(body, joined(plate, nose))


def turtlebot(kind: Kind) -> Model:
    """Stacked plates on two wheels, with a laser scanner on top."""
    radius, top = kind.radius, kind.height
    wheel = box(0.62 * radius, 0.17 * radius, 0.0, 0.34 * top)
    plates = [cylinder(0.92 * radius, z * top, (z + 0.05) * top, 8).turned(np.pi / 8) for z in (0.08, 0.32, 0.76)]
    posts = [box(0.08 * radius, 0.08 * radius, 0.1 * top, 0.78 * top).moved(x * radius, y * radius, 0.0)
             for x in (-0.55, 0.55) for y in (-0.55, 0.55)]  # fmt: skip
    body = joined(
        *plates, *posts, wheel.moved(0.1 * radius, 0.9 * radius, 0.0), wheel.moved(0.1 * radius, -0.9 * radius, 0.0)
    )
    plate = cylinder(0.9 * radius, 0.55 * top, 0.62 * top, 8).turned(np.pi / 8)
    scanner = cylinder(0.36 * radius, 0.81 * top, top)
    nose = prism(np.array([[0.6, -0.35], [1.15, 0.0], [0.6, 0.35]]) * radius, 0.78 * top, 0.86 * top)
    return Model(body, joined(plate, scanner, nose))


def crazyflie(kind: Kind) -> Model:
    return quadrotor(kind, rotor=0.023, arm=0.009)


def tello(kind: Kind) -> Model:
    return quadrotor(kind, rotor=0.038, arm=0.014)


def model(kind: Kind) -> Model:
    """Model of a kind; of one without its own, a quadrotor or a cylinder on two wheels of its size.

    Raises PluginError if the function that it names cannot be found.
    """
    if not kind.mesh:
        return quadrotor(kind, 0.36 * kind.radius, 0.14 * kind.radius) if kind.flies else khepera(kind)
    made: Model = registry.find(kind.mesh, f"mesh of the kind {kind.name!r}")(kind)
    return made


def obstacle(scene: Scene, number: int) -> Mesh:
    """Mesh of an obstacle in its own frame [m]."""
    low, high = float(scene.bottom[number]), float(scene.top[number])
    outline = scene.outline[number]
    if outline is None:
        return cylinder(float(scene.radius[number]), low, high, ROUND)
    if scene.closed[number]:
        return prism(outline, low, high)
    return joined(*(panel(a, b, low, high) for a, b in pairwise(outline)))


def panel(a: Array, b: Array, low: float, high: float) -> Mesh:
    """A piece of a thin wall from `a` to `b` (2,) [m]."""
    way = b - a
    length = float(np.hypot(*way))
    x, y = (0.5 * (a + b)).tolist()
    return box(length + WALL_M, WALL_M, low, high).turned(float(np.arctan2(way[1], way[0]))).moved(x, y, 0.0)
