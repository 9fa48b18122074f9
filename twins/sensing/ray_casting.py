"""Ray casting: true distances for all range sensors of all robots of a scene at once.

Objects are upright: cylinders (robots, round obstacles) and straight edges (boxes, thin walls, the arena's border),
each from a bottom to a top. Rays are level or vertical; others are not supported, and a robot that tilts still sends
them level. Only rays within the angles of an object are tested against it, so the work grows with the angular widths of
the objects and not with rays times objects.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from agents.body.kinds import Kind
from twins.arrays import Array, Index, clamp
from twins.scene import Scene

STRIDE: Final = 16.0  # step between the bearings of two fans in one sorted array: more than two turns
SLACK: Final = 1e-9  # [rad], and share of an edge: a ray into the corner of two edges hits one of them
BUDGET: Final = 1 << 18  # pairs: a few MB for each number of a pair
CROWDED: Final = 8  # objects per ray for which memory is planned; more cost more rounds
FULL: Final = 2.0 * np.pi


@dataclass(frozen=True, eq=False)
class Fan:
    """Rays of one kind of sensor."""

    bearing: Array  # (m,) from the robot's nose, to the left [rad]
    elevation: Array  # (m,) 0, or ±π/2 [rad]
    height: float  # height of the sensor above the robot's position [m]
    reach: float  # distance from the robot's centre [m]

    def __post_init__(self) -> None:
        """Raises ValueError for a ray that is neither level nor vertical."""
        if not np.all((self.elevation == 0.0) | (np.abs(np.abs(self.elevation) - 0.5 * np.pi) < SLACK)):
            raise ValueError("rays are level (elevation 0) or vertical (±π/2)")


class Beams:
    """Fans of rays on rows, arranged for `Caster.cast`: fan after fan, each in its own order."""

    def __init__(self, fans: Sequence[Fan], row: Index, which: Index, budget: int = BUDGET) -> None:
        """Row `row` (F,) sends `fans[which]` (F,); `budget` pairs of ray and object are processed at once."""
        count = np.array([len(fan.bearing) for fan in fans], dtype=np.intp)[which]
        self.size = int(count.sum())  # number of rays (R)
        self.row, self.budget = row, budget
        self.first = np.cumsum(count) - count  # (F,) number of each fan's first ray
        self.height = np.array([fan.height for fan in fans])[which]  # (F,) above the row's position [m]
        self.reach = np.array([fan.reach for fan in fans])[which]  # (F,) from the row's centre [m]
        self.ray_reach = np.repeat(self.reach, count)
        self.widest = int(count.max(initial=0))
        self._base = STRIDE * which
        slots, keys, bearings = [], [], []  # each level ray twice, one turn apart: then no window wraps
        for k, fan in enumerate(fans):
            level = np.flatnonzero(fan.elevation == 0.0)
            angle = np.mod(fan.bearing[level], FULL)
            order = np.argsort(angle, kind="stable")
            slots.append(np.tile(level[order], 2))
            keys.append(k * STRIDE + np.concatenate([angle[order], angle[order] + FULL]))
            bearings.append(fan.bearing[slots[-1]])
        self._slot, self._key = np.concatenate(slots), np.concatenate(keys)
        self._cos, self._sin = np.cos(np.concatenate(bearings)), np.sin(np.concatenate(bearings))
        ends = [(f, ray) for f, k in enumerate(which) for ray in np.flatnonzero(fans[k].elevation)]
        self.upright_fan = np.array([f for f, _ in ends], dtype=np.intp)
        self.upright = np.array([self.first[f] + ray for f, ray in ends], dtype=np.intp)
        self.up = np.array([np.sign(fans[which[f]].elevation[ray]) for f, ray in ends])

    def within(self, fan: Index, start: Array, width: Array) -> Iterator[tuple[Index, Index, Array, Array]]:
        """Rays of fans between two angles, in portions of limited memory.

        Args:
            fan: (P,)
            start: (P,) from the row's nose [rad].
            width: (P,) to the left of `start`, at most π [rad].

        Yields:
            For each ray: index in the P, number of the ray, x and y of its direction in the row's frame.
        """
        low = np.mod(start - SLACK, FULL) + self._base[fan]
        begin = np.searchsorted(self._key, low)
        count = np.searchsorted(self._key, low + (width + 2.0 * SLACK), side="right") - begin
        total = np.cumsum(count)
        if not len(total) or not total[-1]:
            return
        cuts = [0, len(count)]
        if total[-1] > self.budget:
            inner = np.searchsorted(total, np.arange(self.budget, total[-1], self.budget))
            cuts = np.unique(np.concatenate([inner, cuts])).tolist()
        before = total - count
        for i, j in pairwise(cuts):
            pair = np.repeat(np.arange(i, j), count[i:j])
            slot = np.arange(before[i], before[i] + len(pair)) + (begin - before)[pair]
            yield pair, self.first[fan[pair]] + self._slot[slot], self._cos[slot], self._sin[slot]


@dataclass(frozen=True, eq=False)
class _Geometry:
    """Current positions of cylinders (C,), and of edges (S) by both ends."""

    x: Array
    y: Array
    bottom: Array
    top: Array
    ends: Array  # (4, S): x, y of one end, x, y of the other


class Caster:
    """Casts rays in a scene."""

    def __init__(self, scene: Scene, kinds: Sequence[Kind]) -> None:
        """`kinds` (n) of the robots. Cylinders are robots, then round obstacles."""
        self._size = np.array([kind.height for kind in kinds])
        self._round = np.flatnonzero(scene.radius > 0.0)
        self._span = scene.bottom[self._round], scene.top[self._round]
        self._radius = np.concatenate([[kind.radius for kind in kinds], scene.radius[self._round]])
        self._edges, self._owner = scene.edges()
        border = (scene.low[2], scene.high[2])  # bottom and top; its owner is −1: the last
        self._bottom = np.append(scene.bottom, border[0])[self._owner]
        self._top = np.append(scene.top, border[1])[self._owner]
        self._solid = np.array([*scene.closed, False])[self._owner] if len(self._owner) else np.zeros(0, dtype=bool)
        along = self._edges[:, 1] - self._edges[:, 0]
        self._length2 = np.maximum((along**2).sum(axis=1), 1e-300)
        self._floor, self._ceiling = float(border[0]), float(border[1]) if scene.walled else np.inf

    def cast(self, beams: Beams, position: Array, yaw: Array, obstacles: Array) -> Array:
        """Distances (R,) from the centres of the sending rows [m]; NaN where nothing is in reach.

        A level ray hits objects that span its height, except an object that it begins in. A vertical ray hits the
        nearest object above (below) in plan, else the ceiling of a walled arena (the floor).

        Args:
            position: (n, 3) of all rows [m]; a row at NaN neither sees nor is seen.
            yaw: (n,) [rad]
            obstacles: (M, 3) poses: x, y [m], yaw [rad].
        """
        distance = np.full(beams.size, np.inf)
        geometry = self._place_geometry(position, obstacles)
        share = len(self._radius) + len(self._owner)
        step = max(1, beams.budget // (share + CROWDED * beams.widest))
        for begin in range(0, len(beams.row), step):
            fans = np.arange(begin, min(begin + step, len(beams.row)))
            origins = _FanOrigins(beams, fans, position, yaw)
            self._cast_on_cylinders(distance, origins, geometry)
            if len(self._owner):
                self._cast_on_edges(distance, origins, geometry)
        step = max(1, beams.budget // share)
        for begin in range(0, len(beams.upright), step):
            self._cast_on_upright(distance, beams, slice(begin, begin + step), position, geometry)
        distance[~(distance <= beams.ray_reach)] = np.nan
        return distance

    def _place_geometry(self, position: Array, obstacles: Array) -> _Geometry:
        pillars = obstacles[self._round]
        pose = np.concatenate([obstacles, np.zeros((1, 3))])[self._owner]  # last: the world frame
        c, s = np.cos(pose[:, 2:]), np.sin(pose[:, 2:])
        x, y = self._edges[..., 0], self._edges[..., 1]
        ends_x, ends_y = pose[:, :1] + c * x - s * y, pose[:, 1:2] + s * x + c * y
        return _Geometry(
            np.concatenate([position[:, 0], pillars[:, 0]]),
            np.concatenate([position[:, 1], pillars[:, 1]]),
            np.concatenate([position[:, 2], self._span[0]]),
            np.concatenate([position[:, 2] + self._size, self._span[1]]),
            np.stack([ends_x[:, 0], ends_y[:, 0], ends_x[:, 1], ends_y[:, 1]]),
        )

    def _cast_on_cylinders(self, distance: Array, origins: _FanOrigins, geometry: _Geometry) -> None:
        dx, dy = geometry.x - origins.x, geometry.y - origins.y
        radius = self._radius
        square = dx * dx + dy * dy
        near = (square <= (origins.reach + radius) ** 2) & (
            square > radius**2
        )  # not from inside, as from the robot's own disc
        near &= (geometry.bottom <= origins.z) & (origins.z <= geometry.top)
        which = np.flatnonzero(near)
        if not len(which):
            return
        fan_index = which // near.shape[1]
        x, y = origins.rotate_to_robot(fan_index, dx.ravel()[which], dy.ravel()[which])
        radius = radius[which % near.shape[1]]
        half = np.arcsin(radius / np.sqrt(square.ravel()[which]))
        for pair, ray, c, s in origins.beams.within(origins.fans[fan_index], np.arctan2(y, x) - half, 2.0 * half):
            ahead, aside = x[pair] * c + y[pair] * s, x[pair] * s - y[pair] * c
            depth = radius[pair] ** 2 - aside**2
            hit = np.where(depth >= 0.0, ahead - np.sqrt(np.maximum(depth, 0.0)), np.inf)
            np.minimum.at(distance, ray, hit)

    def _cast_on_edges(self, distance: Array, origins: _FanOrigins, geometry: _Geometry) -> None:
        ax, ay, bx, by = geometry.ends
        ax, bx, ay, by = ax - origins.x, bx - origins.x, ay - origins.y, by - origins.y
        ex, ey = bx - ax, by - ay
        area = ax * by - ay * bx
        foot = clamp(-(ax * ex + ay * ey) / self._length2, 0.0, 1.0)
        near = (ax + foot * ex) ** 2 + (ay + foot * ey) ** 2 <= origins.reach**2
        near &= (self._bottom <= origins.z) & (origins.z <= self._top)
        near &= (area < 0.0) | ((area > 0.0) & ~self._solid)  # corners are anticlockwise: a box's front is area < 0
        which = np.flatnonzero(near)
        if not len(which):
            return
        fan_index = which // near.shape[1]
        area = area.ravel()[which]
        ax, ay = origins.rotate_to_robot(fan_index, ax.ravel()[which], ay.ravel()[which])
        bx, by = origins.rotate_to_robot(fan_index, bx.ravel()[which], by.ravel()[which])
        ex, ey = bx - ax, by - ay
        right = np.arctan2(np.where(area > 0.0, ay, by), np.where(area > 0.0, ax, bx))
        width = np.arctan2(np.abs(area), ax * bx + ay * by)
        for pair, ray, c, s in origins.beams.within(origins.fans[fan_index], right, width):
            slope = c * ey[pair] - s * ex[pair]
            with np.errstate(divide="ignore", invalid="ignore"):  # a ray along the edge
                hit, share = area[pair] / slope, (ax[pair] * s - ay[pair] * c) / slope
            np.minimum.at(distance, ray, np.where((hit >= 0.0) & (np.abs(share - 0.5) <= 0.5 + SLACK), hit, np.inf))

    def _cast_on_upright(
        self, distance: Array, beams: Beams, part: slice, position: Array, geometry: _Geometry
    ) -> None:
        """Vertical rays; downward rays are cast upwards in the scene turned upside down."""
        fan, up = beams.upright_fan[part], beams.up[part]
        row = beams.row[fan]
        x, y, z = position[row].T
        height = up * (z + beams.height[fan])
        over = (geometry.x - x[:, None]) ** 2 + (geometry.y - y[:, None]) ** 2 < self._radius**2
        over &= np.arange(len(self._radius)) != row[:, None]
        nearest = np.where(up > 0.0, self._ceiling - height, -self._floor - height)
        side = np.where(up[:, None] > 0.0, geometry.bottom, -geometry.top) - height[:, None]
        nearest = np.fmin(nearest, np.where(over & (side >= 0.0), side, np.inf).min(axis=1, initial=np.inf))
        solid = np.flatnonzero(self._solid)
        if len(solid):
            ax, ay, bx, by = geometry.ends[:, solid]
            inner = (ax - x[:, None]) * (by - y[:, None]) > (ay - y[:, None]) * (bx - x[:, None])
            first = np.flatnonzero(np.diff(self._owner[solid], prepend=-1))
            box = solid[first]
            side = np.where(up[:, None] > 0.0, self._bottom[box], -self._top[box]) - height[:, None]
            over = np.logical_and.reduceat(inner, first, axis=1) & (side >= 0.0)
            nearest = np.fmin(nearest, np.where(over, side, np.inf).min(axis=1))
        distance[beams.upright[part]] = np.where((nearest >= 0.0) & np.isfinite(x), nearest, np.inf)


class _FanOrigins:
    """Positions of some fans: columns (f, 1)."""

    def __init__(self, beams: Beams, fans: Index, position: Array, yaw: Array) -> None:
        row = beams.row[fans]
        self.beams, self.fans = beams, fans
        place = position[row]
        self.x, self.y = place[:, :1], place[:, 1:2]
        self.z = place[:, 2:] + beams.height[fans, None]
        self.reach = beams.reach[fans, None]
        self._cos, self._sin = np.cos(yaw[row]), np.sin(yaw[row])

    def rotate_to_robot(self, fan_index: Index, x: Array, y: Array) -> tuple[Array, Array]:
        """Rotate vectors (P,) from the world to the frames of the rows that send the rays."""
        c, s = self._cos[fan_index], self._sin[fan_index]
        return c * x + s * y, c * y - s * x
