"""Clearance between robots, obstacles and walls, surface to surface, and contacts.

Robots are upright cylinders of the radius and height of their kind; a position is that of the lowest point. Everything
is taken on true positions, at the samples of the trace; unknown ones touch nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from agents.body.kinds import KINDS
from agents.plugins import registry
from experiments.definition.experiment import WORLD
from experiments.metrics.results import Approach, Collision
from experiments.recording.trace import WALL, Trace
from twins import scene as outlines
from twins.arrays import Array, Mask, norm

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
        names, solid = trace.robots, _Cylinders.of_trace(trace)
        robots: list[Approach | None] = [None] * len(names)
        arena: list[Approach | None] = [None] * len(names)
        overlaps: list[Collision] = []
        for i, name in enumerate(names[:-1]):
            gap = solid.between(i)
            for j, other in enumerate(names[i + 1 :]):
                robots[i] = _closer(robots[i], trace.time, gap[:, j], (name, other))
                robots[i + 1 + j] = _closer(robots[i + 1 + j], trace.time, gap[:, j], (other, name))
                overlaps += _overlaps(trace.time, gap[:, j], (name, other))
        for thing, gap in _to_things(trace, solid):
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


@dataclass(frozen=True)
class _Cylinders:
    """The robots as solids: where their axes are (T, N, 2), their bottoms and tops (T, N), NaN where unknown."""

    axis: Array
    radius: Array
    bottom: Array
    top: Array
    flies: Mask

    @classmethod
    def of_trace(cls, trace: Trace) -> _Cylinders:
        kinds = [KINDS[trace.plan.experiment.robots[name].kind] for name in trace.robots]
        height = np.array([kind.height for kind in kinds])
        radius, flies = np.array([kind.radius for kind in kinds]), np.array([kind.flies for kind in kinds])
        bottom = trace.true_position[..., 2]
        return cls(trace.true_position[..., :2], radius, bottom, bottom + height, flies)

    def between(self, i: int) -> Array:
        """Gaps (T, N − i − 1) of robot i to all that come after it."""
        rest = slice(i + 1, None)
        level = norm(self.axis[:, rest] - self.axis[:, i, None]) - (self.radius[rest] + self.radius[i])
        upright = np.maximum(self.bottom[:, i, None] - self.top[:, rest], self.bottom[:, rest] - self.top[:, i, None])
        return _gap(level, upright, self.flies[rest] | self.flies[i])


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


def _to_things(trace: Trace, solid: _Cylinders) -> Iterator[tuple[str, Array]]:
    """Each obstacle, and the arena's walls, with the gaps (T, N) of all robots to it."""
    scene = trace.plan.scene
    poses = scene.along(trace.time)
    for k, name in enumerate(scene.names):
        if trace.contacts is not None and math.isfinite(scene.mass[k]):
            continue
        level = outlines.distance(scene, k, poses[:, k, None], solid.axis) - solid.radius
        upright = np.maximum(scene.bottom[k] - solid.top, solid.bottom - scene.top[k])
        yield name, _gap(level, upright, solid.flies)
    if scene.walled:
        room = np.minimum(solid.axis - scene.low[:2], scene.high[:2] - solid.axis).min(axis=2)
        yield WALL, np.where(np.isfinite(room), room - solid.radius, np.inf)
