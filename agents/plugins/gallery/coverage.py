"""Coverage of an area."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import exp, nan
from typing import Annotated, ClassVar

import msgspec
from msgspec import Meta

from zenpark import Control, Law, Measure, Memory, Positive, View

Place = tuple[float, float]


class Coverage(Law, frozen=True):
    """v_i = k (c_i − p_i), with c_i the centroid of the robot's Voronoi cell: Lloyd's descent in continuous time.

    H = Σ_i ∫_{V_i} ‖q − p_i‖² φ(q) dq never rises, and the robots end at a centroidal Voronoi partition (J. Cortés,
    S. Martínez, T. Karatas, F. Bullo, "Coverage control for mobile sensing networks", IEEE Transactions on Robotics
    and Automation 20(2), 2004). A robot needs a link to every robot with a cell that may touch its own. A neighbour
    that is lost leaves its cell to the others; a robot without a cell, outside the area, stays.
    """

    ALONE: ClassVar[bool] = True
    MEASURES: ClassVar[Mapping[str, Measure]] = {"cost": Measure(), "mass": Measure(better="")}

    gain: Annotated[Positive, Meta(description="k [1/s]")] = 0.5
    area: Annotated[
        list[Place],
        Meta(
            min_length=3,
            description="corners x, y [m] of a convex area, in their order",
            examples=[[[-2.0, -2.0], [2.0, -2.0], [0.0, 2.0]]],
        ),
    ] = msgspec.field(default_factory=lambda: [(-2.0, -2.0), (2.0, -2.0), (2.0, 2.0), (-2.0, 2.0)])
    peaks: Annotated[
        list[tuple[float, float, Positive, Positive]],
        Meta(description="what matters more: x, y, width [m] and height of bells, which φ = 1 + Σ adds up"),
    ] = msgspec.field(default_factory=list)
    grain: Annotated[Positive, Meta(description="longest edge of a triangle of the integral [m]")] = 0.6

    def __post_init__(self) -> None:
        """Raise ValueError unless the area is convex."""
        ends = zip(self.area[-2:] + self.area[:-2], self.area[-1:] + self.area[:-1], self.area, strict=True)
        turns = [(b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0]) for a, b, c in ends]
        if min(turns) <= 0.0 <= max(turns):
            raise ValueError("`area` must be convex: name its corners in their order around it")

    def step(self, view: View, memory: Memory) -> Control:
        """Cell, its centroid by the edge midpoints of triangles, and the robot's share of H."""
        x, y, _ = view.position
        cell = self.area
        for each in view.neighbours:
            cell = nearer(cell, (x, y), (each.position[0], each.position[1]))
        mass = first_x = first_y = cost = 0.0
        for k in range(1, len(cell) - 1):
            for area, px, py in midpoints(cell[0], cell[k], cell[k + 1], self.grain if self.peaks else 1e9):
                weight = area * self.density(px, py)
                mass += weight
                first_x += weight * px
                first_y += weight * py
                cost += weight * ((px - x) ** 2 + (py - y) ** 2)
        if mass <= 0.0:
            return Control(measures={"cost": 0.0, "mass": 0.0})
        velocity = (self.gain * (first_x / mass - x), self.gain * (first_y / mass - y), nan)
        return Control(velocity=velocity, measures={"cost": cost, "mass": mass})

    def density(self, x: float, y: float) -> float:
        """φ at a place."""
        bells = (h * exp(-((x - px) ** 2 + (y - py) ** 2) / (2.0 * width**2)) for px, py, width, h in self.peaks)
        return 1.0 + sum(bells)


def nearer(polygon: list[Place], own: Place, other: Place) -> list[Place]:
    """Part of a convex polygon that is nearer to `own` than to `other`."""
    nx, ny = other[0] - own[0], other[1] - own[1]
    level = 0.5 * (nx * (own[0] + other[0]) + ny * (own[1] + other[1]))
    beyond = [nx * x + ny * y - level for x, y in polygon]
    kept: list[Place] = []
    for k, (x, y) in enumerate(polygon):
        (last_x, last_y), before = polygon[k - 1], beyond[k - 1]
        here = beyond[k]
        if (before > 0.0) != (here > 0.0):
            share = before / (before - here)
            kept.append((last_x + share * (x - last_x), last_y + share * (y - last_y)))
        if here <= 0.0:
            kept.append((x, y))
    return kept


def midpoints(a: Place, b: Place, c: Place, grain: float) -> Iterator[tuple[float, float, float]]:
    """Weights [m²] and places x, y that integrate over a triangle, exact for quadratic functions."""
    ends = ((a, b, c), (b, c, a), (c, a, b))
    lengths = [(p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 for p, q, _ in ends]
    if max(lengths) > grain * grain:
        p, q, other = ends[lengths.index(max(lengths))]
        middle = (0.5 * (p[0] + q[0]), 0.5 * (p[1] + q[1]))
        yield from midpoints(p, middle, other, grain)
        yield from midpoints(middle, q, other, grain)
        return
    third = abs((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])) / 6.0
    for p, q, _ in ends:
        yield third, 0.5 * (p[0] + q[0]), 0.5 * (p[1] + q[1])
