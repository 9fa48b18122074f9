"""Clearance between robots, obstacles and walls, surface to surface, and contacts: in a trace, and at one moment.

Robots are upright cylinders of the radius and height of their kind; a position is that of the lowest point. In a trace
everything is taken on true positions, at its samples; unknown ones touch nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from agents.body.kinds import KINDS, Kind
from agents.plugins import registry
from experiments.definition.experiment import WALL, WORLD
from experiments.metrics.results import Approach, Collision
from experiments.recording.trace import Trace
from twins import scene as outlines
from twins.arrays import Array, Index, Mask, norm
from twins.scene import Scene

TOUCH_M = 1e-6  # [m] less overlap than this is rounding


@dataclass(frozen=True)
class Clearance:
    """Distances between surfaces [m], negative where they overlap; times since the common start [s]."""

    robots: tuple[Approach | None, ...]  # closest approach of each robot to another one; None where there is no other
    arena: tuple[Approach | None, ...]  # closest approach of each robot to an obstacle or a wall
    # each longest time in which two robots, or a robot and an obstacle, overlapped: beginning, depth, names
    overlaps: tuple[Collision, ...]

    @classmethod
    def of_trace(cls, trace: Trace) -> Clearance:
        """Clearance in a whole trace; obstacles that can be pushed count only where no world watched for contacts."""
        names, scene = trace.robots, trace.plan.scene
        robots_of = trace.plan.experiment.robots
        solid = Cylinders.of([KINDS[robots_of[name].kind] for name in names], trace.true_position)
        robots: list[Approach | None] = [None] * len(names)
        arena: list[Approach | None] = [None] * len(names)
        overlaps: list[Collision] = []
        for i, name in enumerate(names[:-1]):
            gap = solid.between(slice(i, i + 1), slice(i + 1, None))
            for j, other in enumerate(names[i + 1 :]):
                robots[i] = _closer(robots[i], trace.time, gap[:, j], (name, other))
                robots[i + 1 + j] = _closer(robots[i + 1 + j], trace.time, gap[:, j], (other, name))
                overlaps += _overlaps(trace.time, gap[:, j], (name, other))
        for thing, gap in _to_things(scene, scene.along(trace.time), solid, watched=trace.contacts is not None):
            for i, name in enumerate(names):
                arena[i] = _closer(arena[i], trace.time, gap[:, i], (name, thing))
                overlaps += _overlaps(trace.time, gap[:, i], (name, thing))
        overlaps.sort(key=lambda each: (each.time_s, each.first, each.second))
        return cls(tuple(robots), tuple(arena), tuple(overlaps))


def collisions(trace: Trace, clearance: Clearance) -> tuple[Collision, ...]:
    """Contacts in order of time: those that the world reported; where no world watches, computed from positions.

    A world sees everything that touches a robot that it carries; robots that it does not carry are outside of it.
    """
    if trace.contacts is None:
        return clearance.overlaps
    robots = trace.plan.experiment.robots
    in_world = {name for name in trace.robots if registry.body_name(robots[name].body) == WORLD}
    carried = {*trace.robots} if trace.clock == "virtual" else in_world
    reported = [
        Collision(each.stamp, each.first, each.second, each.impulse, each.overlap)
        for each in trace.contacts
        if each.first in trace.robots or each.second in trace.robots
    ]
    computed = [each for each in clearance.overlaps if not carried & {each.first, each.second}]
    return tuple(sorted([*reported, *computed], key=lambda each: each.time_s))


class Overlap(NamedTuple):
    """A robot, and another one, an obstacle or a wall, that overlap at one moment."""

    first: str
    second: str
    depth: float  # [m]


def present_overlaps(
    names: Sequence[str], kinds: Sequence[Kind], position: Array, scene: Scene, obstacles: Array, *, watched: bool
) -> Iterator[Overlap]:
    """Overlaps at one moment.

    Args:
        position: (N, 3) [m] of the robots.
        obstacles: (M, 3) x, y [m], yaw [rad].
        watched: A world watches for contacts with obstacles that can be pushed.
    """
    solid = Cylinders.of(kinds, position[None])
    first, second = np.triu_indices(len(names), 1)
    gap = solid.between(first, second)[0]
    for k in np.flatnonzero(gap < -TOUCH_M).tolist():
        yield Overlap(names[first[k]], names[second[k]], -float(gap[k]))
    for thing, gaps in _to_things(scene, obstacles[None], solid, watched=watched):
        for row in np.flatnonzero(gaps[0] < -TOUCH_M).tolist():
            yield Overlap(names[row], thing, -float(gaps[0, row]))


@dataclass(frozen=True)
class Cylinders:
    """The robots as solids: where their axes are (T, N, 2), their bottoms and tops (T, N), NaN where unknown."""

    axis: Array
    radius: Array
    bottom: Array
    top: Array
    flies: Mask

    @classmethod
    def of(cls, kinds: Sequence[Kind], position: Array) -> Cylinders:
        """Robots (N) at positions (T, N, 3) [m]."""
        height = np.array([kind.height for kind in kinds])
        radius, flies = np.array([kind.radius for kind in kinds]), np.array([kind.flies for kind in kinds], dtype=bool)
        bottom = position[..., 2]
        return cls(position[..., :2], radius, bottom, bottom + height, flies)

    def between(self, first: Index | slice, second: Index | slice) -> Array:
        """Gaps (T, k) of pairs of rows."""
        level = norm(self.axis[:, second] - self.axis[:, first]) - (self.radius[second] + self.radius[first])
        upright = np.maximum(self.bottom[:, first] - self.top[:, second], self.bottom[:, second] - self.top[:, first])
        return _gap(level, upright, self.flies[second] | self.flies[first])


def _gap(level: Array, upright: Array, free: Mask) -> Array:
    """Signed distance of upright solids from those of their outlines seen from above, and of their heights (T, k).

    How deep they overlap is the shortest way out; upward only where one of the two is `free` (k,) to go there.
    """
    outside = np.hypot(np.maximum(level, 0.0), np.maximum(upright, 0.0))
    gap = outside + np.minimum(np.maximum(level, np.where(free | (upright > 0.0), upright, -np.inf)), 0.0)
    return np.where(np.isfinite(gap), gap, np.inf)


def _closer(known: Approach | None, time: Array, gap: Array, between: tuple[str, str]) -> Approach | None:
    """The closer of a known approach and of gaps (T,) over time."""
    k = int(gap.argmin())
    if not np.isfinite(gap[k]) or (known is not None and known.gap <= gap[k]):
        return known
    return Approach(between, float(gap[k]), float(time[k]))


def _overlaps(time: Array, gap: Array, between: tuple[str, str]) -> list[Collision]:
    """Collisions: one for each maximal time in which a gap (T,) is negative."""
    spans = np.flatnonzero(np.diff(gap < -TOUCH_M, prepend=False, append=False)).reshape(-1, 2).tolist()
    return [Collision(float(time[begin]), *between, None, -float(gap[begin:end].min())) for begin, end in spans]


def _to_things(scene: Scene, poses: Array, solid: Cylinders, *, watched: bool) -> Iterator[tuple[str, Array]]:
    """Each obstacle, at its `poses` (T, M, 3), and the arena's walls, with the gaps (T, N) of all robots to it."""
    for k, name in enumerate(scene.names):
        if watched and math.isfinite(scene.mass[k]):
            continue
        level = outlines.distance(scene, k, poses[:, k, None], solid.axis) - solid.radius
        upright = np.maximum(scene.bottom[k] - solid.top, solid.bottom - scene.top[k])
        yield name, _gap(level, upright, solid.flies)
    if scene.walled:
        room = np.minimum(solid.axis - scene.low[:2], scene.high[:2] - solid.axis).min(axis=2)
        yield WALL, np.where(np.isfinite(room), room - solid.radius, np.inf)
