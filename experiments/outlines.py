"""What stands in an arena, seen from above: outlines, and how far points are from them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from agents.rows import Array, Mask, norm
from twins.scene import Scene


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
