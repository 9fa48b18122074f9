"""Scene: arena and obstacles as outlines in the plane, their motion, and distances from points to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from math import isfinite
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from agents.plugins.planners import Planner
from agents.vectors import NotNegative, Positive
from twins.arrays import Array, Index, Mask, norm

Planar = tuple[float, float]
Pose = tuple[float, float, float]  # x, y [m], yaw [rad]
Points = Annotated[list[Planar], Meta(min_length=2)]


class Obstacle(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """One obstacle: a box, a cylinder, or a thin wall along points; exactly one of the three."""

    box: Annotated[tuple[Positive, Positive] | None, Meta(description="size along its own x and y [m]")] = None
    radius: Annotated[Positive | None, Meta(description="of a cylinder [m]")] = None
    wall: Annotated[
        Annotated[list[Planar], Meta(min_length=2)] | None, Meta(description="points of a thin wall, x, y [m]")
    ] = None
    at: Annotated[Planar, Meta(description="centre x, y [m]; a wall's points are relative to it")] = (0.0, 0.0)
    yaw: Annotated[float, Meta(description="[rad]")] = 0.0
    height: Annotated[Positive | None, Meta(description="[m]; left out: up to the ceiling")] = None
    bottom: Annotated[NotNegative, Meta(description="height of the lower side above the floor [m]")] = 0.0
    mass: Annotated[Positive | None, Meta(description="[kg], can be pushed; left out: fixed")] = None
    friction: Annotated[NotNegative, Meta(description="with the floor, of an obstacle with a mass")] = 0.5
    plan: Annotated[str | dict[str, Any] | None, Meta(description="planner that moves the obstacle")] = None

    def __post_init__(self) -> None:
        if sum(part is not None for part in (self.box, self.radius, self.wall)) != 1:
            raise ValueError("an obstacle has exactly one of box, radius and wall; for example box = [0.5, 0.2]")
        if self.mass is not None and (self.plan is not None or self.wall is not None):
            raise ValueError("only a box or a cylinder without a plan can have a mass; leave mass out")
        if self.plan is not None and self.wall is not None:
            raise ValueError("a wall cannot have a plan, because it does not move; use a box")


@dataclass(frozen=True)
class Scene:
    """Arena and M obstacles, as used by engines and sensors."""

    low: Array  # (3,) corner of the arena [m]
    high: Array  # (3,) opposite corner [m]
    walled: bool  # the arena's border is a wall
    names: tuple[str, ...]  # names of the obstacles (M)
    outline: tuple[
        Array | None, ...
    ]  # own frame: corners (k, 2) of a box, anticlockwise; points of a wall; None: cylinder
    closed: tuple[bool, ...]  # box; a wall is open
    radius: Array  # (M,) of cylinders [m], 0 for others
    pose: Array  # (M, 3) x, y [m], yaw [rad] at the common start
    bottom: Array  # (M,) [m]
    top: Array  # (M,) [m]
    mass: Array  # (M,) [kg], infinite if fixed
    friction: Array  # (M,) with the floor
    plans: tuple[Planner | None, ...]  # planner of each moving obstacle; None: not moved

    @classmethod
    def furnished(
        cls, size: Sequence[float], obstacles: Mapping[str, Obstacle], plans: Mapping[str, Planner], *, walled: bool
    ) -> Scene:
        """Arena of `size` (3) [m], centred on the origin, with obstacles; `plans`: planners of moving obstacles."""
        x, y, z = size
        given = tuple(obstacles.values())
        return cls(
            low=np.array([-x / 2, -y / 2, 0.0]),
            high=np.array([x / 2, y / 2, z]),
            walled=walled,
            names=tuple(obstacles),
            outline=tuple(_outline(obstacle) for obstacle in given),
            closed=tuple(obstacle.wall is None for obstacle in given),
            radius=np.array([obstacle.radius or 0.0 for obstacle in given]),
            pose=np.array([(*obstacle.at, obstacle.yaw) for obstacle in given], dtype=float).reshape(-1, 3),
            bottom=np.array([obstacle.bottom for obstacle in given]),
            top=np.array([z if o.height is None else o.bottom + o.height for o in given]),
            mass=np.array([obstacle.mass or np.inf for obstacle in given]),
            friction=np.array([obstacle.friction for obstacle in given]),
            plans=tuple(plans.get(name) for name in obstacles),
        )

    @classmethod
    def empty(cls, size: Sequence[float] = (1e3, 1e3, 1e3)) -> Scene:
        """Arena without walls or obstacles."""
        return cls.furnished(size, {}, {}, walled=False)

    @property
    def moving(self) -> Index:
        """Obstacles that have a plan."""
        return np.array([k for k, plan in enumerate(self.plans) if plan is not None], dtype=np.intp)

    @cached_property
    def start(self) -> list[Pose]:
        """Poses of the obstacles at the common start: x, y [m], yaw [rad]."""
        return [(x, y, yaw) for x, y, yaw in self.pose.tolist()]

    def poses(self, t: float) -> list[Pose]:
        """Planned poses at `t` [s] after the common start; obstacles without a plan stay in place."""
        poses = list(self.start)
        elapsed = max(t, 0.0)
        for k, plan in enumerate(self.plans):
            if plan is not None:
                x0, y0, yaw0 = poses[k]
                x, y, _, yaw = plan.target(elapsed, (x0, y0, 0.0), yaw0)
                poses[k] = (x, y, yaw if isfinite(yaw) else yaw0)
        return poses

    def at(self, t: float) -> Array:
        """Poses (M, 3) at `t` [s], see `poses`."""
        return np.array(self.poses(t)).reshape(-1, 3)

    def along(self, time: Array) -> Array:
        """Poses (T, M, 3) at times (T,) [s], see `poses`."""
        return np.array([self.poses(t) for t in time.tolist()]).reshape(len(time), -1, 3)

    def edges(self) -> tuple[Array, Index]:
        """Straight edges (S, 2, 2), each in the frame of its obstacle, and that obstacle's number (S,).

        The arena's own walls come last, in the world frame, under the number −1.
        """
        edges: list[Array] = []
        owners: list[int] = []
        for k, (outline, closed) in enumerate(zip(self.outline, self.closed, strict=True)):
            if outline is not None:
                ends = np.roll(outline, -1, axis=0)
                pairs = np.stack([outline, ends], axis=1)
                pairs = pairs if closed else pairs[:-1]
                edges.append(pairs)
                owners += [k] * len(pairs)
        if self.walled:
            (x0, y0), (x1, y1) = self.low[:2], self.high[:2]
            corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
            edges.append(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1))
            owners += [-1] * 4
        if not edges:
            return np.zeros((0, 2, 2)), np.zeros(0, dtype=np.intp)
        return np.concatenate(edges), np.array(owners, dtype=np.intp)


def _outline(obstacle: Obstacle) -> Array | None:
    if obstacle.box is not None:
        x, y = 0.5 * obstacle.box[0], 0.5 * obstacle.box[1]
        return np.array([[-x, -y], [x, -y], [x, y], [-x, y]])
    return np.array(obstacle.wall, dtype=float) if obstacle.wall is not None else None


def corners(outline: Array, pose: Array) -> Array:
    """Corners (..., k, 2) in the world frame [m] of an outline (k, 2) at poses (..., 3)."""
    cos, sin = np.cos(pose[..., 2, None]), np.sin(pose[..., 2, None])
    x, y = outline[:, 0], outline[:, 1]
    return np.stack([cos * x - sin * y + pose[..., 0, None], sin * x + cos * y + pose[..., 1, None]], axis=-1)


def distance(scene: Scene, obstacle: int, pose: Array, point: Array) -> Array:
    """Distance (...) in the plane from points to an obstacle [m]; negative inside a box or a cylinder.

    Args:
        pose: (..., 3) x, y [m] and yaw [rad] of the obstacle.
        point: (..., 2) [m].
    """
    outline = scene.outline[obstacle]
    offset = point - pose[..., :2]
    if outline is None:
        return np.asarray(norm(offset) - scene.radius[obstacle])
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x, y = cos * offset[..., 0] + sin * offset[..., 1], cos * offset[..., 1] - sin * offset[..., 0]
    if scene.closed[obstacle]:  # a box, centred on its frame
        over = np.stack([np.abs(x) - outline[:, 0].max(), np.abs(y) - outline[:, 1].max()], axis=-1)
        return np.asarray(norm(np.maximum(over, 0.0)) + np.minimum(over.max(axis=-1), 0.0))
    nearest = np.full(x.shape, np.inf)
    for (ax, ay), (bx, by) in pairwise(outline):
        dx, dy = bx - ax, by - ay
        length = dx * dx + dy * dy
        share = np.clip(((x - ax) * dx + (y - ay) * dy) / length, 0.0, 1.0) if length else 0.0
        nearest = np.minimum(nearest, np.hypot(x - ax - share * dx, y - ay - share * dy))
    return nearest


def at_height(scene: Scene, obstacle: int, low: Array | float, high: Array | float) -> Mask:
    """Whether bodies between heights `low` and `high` (...) [m] overlap an obstacle in height."""
    return np.asarray((low < scene.top[obstacle]) & (high > scene.bottom[obstacle]))


def outside(scene: Scene, obstacle: int) -> bool:
    """Whether an obstacle is entirely outside the arena at the start."""
    pose, outline = scene.pose[obstacle], scene.outline[obstacle]
    low, high = scene.low[:2], scene.high[:2]
    if outline is None:
        beyond = np.maximum(np.maximum(low - pose[:2], pose[:2] - high), 0.0)
        return bool(norm(beyond) > scene.radius[obstacle])
    points = corners(outline, pose)
    if scene.closed[obstacle]:
        return _disjoint(points, low, high)
    return all(_disjoint(np.stack(edge), low, high) for edge in pairwise(points))


def _disjoint(polygon: Array, low: Array, high: Array) -> bool:
    """Whether a convex polygon (k, 2) or segment and a rectangle are disjoint, by the separating axis theorem."""
    edge = np.roll(polygon, -1, axis=0) - polygon
    axes = np.concatenate([np.eye(2), np.stack([-edge[:, 1], edge[:, 0]], axis=1)])
    rectangle = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    shadow, other = polygon @ axes.T, rectangle @ axes.T
    gap = np.maximum(other.min(axis=0) - shadow.max(axis=0), shadow.min(axis=0) - other.max(axis=0))
    return bool((gap > 0.0).any())
