"""What stands in an arena, seen from above: outlines, and how far points are from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from agents.arrays import Array, Index, Mask, norm
from agents.plugins.planners import Planner

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Planar = tuple[float, float]
Points = Annotated[list[Planar], Meta(min_length=2)]


class Obstacle(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """One obstacle: a box, a cylinder, or a thin wall along points; exactly one of the three."""

    box: Annotated[tuple[Positive, Positive] | None, Meta(description="size along its own x and y [m]")] = None
    radius: Annotated[Positive | None, Meta(description="of a cylinder [m]")] = None
    wall: Annotated[
        Annotated[list[Planar], Meta(min_length=2)] | None, Meta(description="points of a thin wall, x, y [m]")
    ] = None
    at: Annotated[Planar, Meta(description="its middle, x, y [m]; a wall's points are counted from there")] = (0.0, 0.0)
    yaw: Annotated[float, Meta(description="[rad]")] = 0.0
    height: Annotated[Positive | None, Meta(description="[m]; left out: up to the ceiling")] = None
    bottom: Annotated[NotNegative, Meta(description="how high over the floor it begins [m]")] = 0.0
    mass: Annotated[Positive | None, Meta(description="[kg]: it can be pushed; left out: it stands fast")] = None
    friction: Annotated[NotNegative, Meta(description="with the floor, of one that can be pushed")] = 0.5
    plan: Annotated[str | dict[str, Any] | None, Meta(description="a planner that moves it")] = None

    def __post_init__(self) -> None:
        if sum(part is not None for part in (self.box, self.radius, self.wall)) != 1:
            raise ValueError("an obstacle has exactly one of box, radius and wall; for example box = [0.5, 0.2]")
        if self.mass is not None and (self.plan is not None or self.wall is not None):
            raise ValueError("only a box or a cylinder without a plan can have a mass; leave mass out")
        if self.plan is not None and self.wall is not None:
            raise ValueError("a wall cannot have a plan, because it does not move; use a box")


@dataclass(frozen=True)
class Scene:
    """An arena as engines and sensors see it; obstacles (M), their poses in rows of x, y, yaw.

    Attributes:
        low: (3,) corner of the arena [m].
        high: (3,) the other corner [m].
        walled: The arena's border is a wall.
        names: Of the obstacles (M).
        outline: Corners (k, 2) of each box in its own frame, against the clock; points of a wall; None of a cylinder.
        closed: Whether the outline is one of a box (a wall is open).
        radius: (M,) of cylinders [m], 0 of the others.
        pose: (M, 3) x, y [m], yaw [rad] at the common start.
        bottom: (M,) [m].
        top: (M,) [m].
        mass: (M,) [kg], infinite where it cannot be pushed.
        friction: (M,) with the floor.
        plans: What moves each; None: nothing.
    """

    low: Array
    high: Array
    walled: bool
    names: tuple[str, ...]
    outline: tuple[Array | None, ...]
    closed: tuple[bool, ...]
    radius: Array
    pose: Array
    bottom: Array
    top: Array
    mass: Array
    friction: Array
    plans: tuple[Planner | None, ...]

    @classmethod
    def furnished(
        cls, size: Sequence[float], obstacles: Mapping[str, Obstacle], plans: Mapping[str, Planner], *, walled: bool
    ) -> Scene:
        """An arena of `size` (3) [m], centred on the origin, with obstacles; `plans` of those that move."""
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
        """Room without walls or obstacles."""
        return cls.furnished(size, {}, {}, walled=False)

    @property
    def moving(self) -> Index:
        """Obstacles that have a plan."""
        return np.array([k for k, plan in enumerate(self.plans) if plan is not None], dtype=np.intp)

    def along(self, time: Array) -> Array:
        """Poses (T, M, 3) at times (T,) after the common start [s]; what can be pushed is where it stood then."""
        pose = np.tile(self.pose, (len(time), 1, 1))
        elapsed = np.maximum(time, 0.0)
        for k, plan in enumerate(self.plans):
            if plan is not None:
                anchor = np.tile([*self.pose[k, :2], 0.0], (len(time), 1))
                place, yaw = plan.target(elapsed, anchor, np.full(len(time), self.pose[k, 2]))
                pose[:, k, :2] = place[:, :2]
                pose[:, k, 2] = np.where(np.isfinite(yaw), yaw, self.pose[k, 2])
        return pose

    def at(self, t: float) -> Array:
        """Poses (M, 3) at `t` [s], see `along`."""
        return np.asarray(self.along(np.array([t]))[0])

    def edges(self) -> tuple[Array, Index]:
        """Straight edges (S, 2, 2), each in the frame of its obstacle, and the number (S,) of that obstacle.

        The arena's own walls come last, in the frame of the room, under the number −1.
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
    """Corners (..., k, 2) in the room [m] of an outline (k, 2) at poses (..., 3)."""
    cos, sin = np.cos(pose[..., 2, None]), np.sin(pose[..., 2, None])
    x, y = outline[:, 0], outline[:, 1]
    return np.stack([cos * x - sin * y + pose[..., 0, None], sin * x + cos * y + pose[..., 1, None]], axis=-1)


def reach(scene: Scene, obstacle: int) -> tuple[Array, Array]:
    """Least and largest x, y (2,) [m] that an obstacle reaches to, where it stands at the start."""
    pose, outline = scene.pose[obstacle], scene.outline[obstacle]
    if outline is None:
        return pose[:2] - scene.radius[obstacle], pose[:2] + scene.radius[obstacle]
    points = corners(outline, pose)
    return points.min(axis=0), points.max(axis=0)


def distance(scene: Scene, obstacle: int, pose: Array, point: Array) -> Array:
    """Distance (...) in the plane from points to an obstacle [m]; negative inside a box or a cylinder.

    Args:
        scene: Where it stands.
        obstacle: Its number.
        pose: (..., 3) where it is, x, y [m] and yaw [rad].
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
    """Whether bodies from `low` to `high` (...) [m] are at the height of an obstacle."""
    return np.asarray((low < scene.top[obstacle]) & (high > scene.bottom[obstacle]))


def outside(scene: Scene, obstacle: int) -> bool:
    """Whether all of an obstacle stands outside the arena at the start."""
    pose, outline = scene.pose[obstacle], scene.outline[obstacle]
    low, high = scene.low[:2], scene.high[:2]
    if outline is None:
        beyond = np.maximum(np.maximum(low - pose[:2], pose[:2] - high), 0.0)
        return bool(norm(beyond) > scene.radius[obstacle])
    points = corners(outline, pose)
    if scene.closed[obstacle]:
        return _apart(points, low, high)
    return all(_apart(np.stack(edge), low, high) for edge in pairwise(points))


def _apart(polygon: Array, low: Array, high: Array) -> bool:
    """Whether a convex polygon (k, 2), or a segment, and a rectangle have no point in common: some line parts them."""
    edge = np.roll(polygon, -1, axis=0) - polygon
    axes = np.concatenate([np.eye(2), np.stack([-edge[:, 1], edge[:, 0]], axis=1)])
    rectangle = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    mine, other = polygon @ axes.T, rectangle @ axes.T
    gap = np.maximum(other.min(axis=0) - mine.max(axis=0), mine.min(axis=0) - other.max(axis=0))
    return bool((gap > 0.0).any())


@dataclass(frozen=True)
class World:
    """The place that twins share.

    Attributes:
        copy: (n,) which copy of it a row is in: repetitions of an experiment are as many copies.
        scene: What stands there.
        engine: A registered engine: its name, or a table with its `kind` and parameters.
        sensors: The range sensors of each row, by name (`twins.sensing.range_sensors.SENSORS`).
        sensor_noise: Of the range sensors, as a multiple of the real ones'.
        mirrored: (n,) rows that are elsewhere in reality, and appear here where they are said to be.
    """

    copy: Index
    scene: Scene
    engine: str | Mapping[str, object]
    sensors: tuple[tuple[str, ...], ...]
    sensor_noise: float
    mirrored: Mask

    @classmethod
    def alone(cls, rows: int) -> World:
        """Every row by itself, in a room without end."""
        nobody = np.zeros(rows, dtype=bool)
        return cls(np.arange(rows), Scene.empty(), "point-mass", ((),) * rows, 1.0, nobody)
