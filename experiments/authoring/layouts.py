"""Layouts of any size: positions and links. Geometry only; `generate` makes files of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from twins.arrays import Array, Index, norm

GOLDEN: Final = math.pi * (3.0 - math.sqrt(5.0))  # [rad] no two multiples of it fall close together
RIM: Final = math.cos(math.radians(75.0))  # a hemisphere ends here: below, robots would stand above one another
SLIVER: Final = math.cos(math.radians(120.0))  # a triangle of the rim that is blunter only bridges a bay of it
LOWEST: Final = 0.4  # [m] lowest robot of a hemisphere, clear of the ground effect


class LayoutError(ValueError):
    """Layout that is impossible; the message names a possible one."""


@dataclass(frozen=True)
class Layout:
    """Shape and links of a formation."""

    title: str  # name for people
    position: Array  # (N, 3) [m], centred on the origin; z is the height that a flying robot holds, 0 where any will do
    pairs: Index  # (M, 2) rows that receive from each other, smaller row first

    def __len__(self) -> int:
        return len(self.position)


def polygon(count: int, spacing: float) -> Layout:
    """Regular polygon of `count` robots `spacing` [m] apart, linked to the next two neighbours on either side.

    The ring alone could fold; with the second neighbours it is rigid in the plane.
    """
    if count < 3:
        raise LayoutError(f"a polygon needs 3 robots or more, not {count}")
    first = np.arange(count)
    angle, radius = 2.0 * math.pi * first / count, spacing / (2.0 * math.sin(math.pi / count))
    position = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)])
    pairs = np.concatenate([np.column_stack([first, (first + step) % count]) for step in (1, 2)])
    return Layout(f"{count} robots on a regular polygon", position, _each_once(pairs))


def grid(rows: int, columns: int, spacing: float) -> Layout:
    """`rows` × `columns` robots on a square grid, `spacing` [m] apart, linked to the up to eight around."""
    if min(rows, columns) < 2:
        raise LayoutError(f"a grid of {rows}x{columns} is a line, which bends: give 2x2 or more")
    number = np.arange(rows * columns).reshape(rows, columns)
    beside, behind = (number[:, :-1], number[:, 1:]), (number[:-1], number[1:])
    neighbours = beside, behind, (number[:-1, :-1], number[1:, 1:]), (number[1:, :-1], number[:-1, 1:])
    both = np.concatenate([np.column_stack([one.ravel(), other.ravel()]) for one, other in neighbours])
    y, x = np.divmod(np.arange(rows * columns), columns)
    place = np.column_stack([x - (columns - 1) / 2.0, (rows - 1) / 2.0 - y, np.zeros(rows * columns)])
    return Layout(f"{rows} × {columns} robots on a grid", spacing * place, _each_once(both))


def hemisphere(count: int, spacing: float, apart: float) -> Layout:
    """`count` robots spread evenly over a hemisphere, linked by its Delaunay triangulation.

    Points that are projected stereographically from the opposite pole have the same triangulation in the plane, because
    circles of the sphere become circles. Blunt triangles of the rim are left out: their long sides would only make the
    formation slower.

    Args:
        spacing: Least distance of two of them [m].
        apart: Least distance seen from above [m], so that they can start and land below their places.
    """
    if count < 4:
        raise LayoutError(f"a hemisphere needs 4 robots or more, not {count}")
    from matplotlib.tri import Triangulation  # noqa: PLC0415 - takes half a second, and only this needs it

    number = np.arange(count)
    cosine = 1.0 - (number + 0.5) / count * (1.0 - RIM)
    sine = np.sqrt(1.0 - cosine**2)
    unit = np.column_stack([sine * np.cos(GOLDEN * number), sine * np.sin(GOLDEN * number), cosine])
    flat = unit[:, :2] / (1.0 + cosine)[:, None]
    pairs = _sides(_without_slivers(unit, Triangulation(flat[:, 0], flat[:, 1]).triangles.astype(np.intp)))
    radius = max(spacing / _nearest(unit), apart / _nearest(unit[:, :2]))
    position = radius * unit
    position[:, 2] += LOWEST - position[:, 2].min()
    return Layout(f"{count} robots on a hemisphere of {radius:.2f} m with Delaunay links", position, pairs)


def _without_slivers(point: Array, triangles: Index) -> Index:
    """Triangles (T, 3) less those on the rim that are blunt opposite to it, again and again."""
    while True:
        sides = np.sort(triangles[:, [[1, 2], [2, 0], [0, 1]]], axis=2)  # opposite to corners 0, 1, 2
        _, which, times = np.unique(sides.reshape(-1, 2), axis=0, return_inverse=True, return_counts=True)
        rim = times[which.ravel()].reshape(-1, 3) == 1
        corner = point[triangles]
        one, other = np.roll(corner, -1, axis=1) - corner, np.roll(corner, 1, axis=1) - corner
        blunt = np.vecdot(one, other) < SLIVER * norm(one) * norm(other)
        keeps = ~(rim & blunt).any(axis=1)
        if keeps.all() or not keeps.any():
            return triangles
        triangles = triangles[keeps]


def _sides(triangles: Index) -> Index:
    """The sides (M, 2) of triangles (T, 3)."""
    return _each_once(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2))


def _nearest(points: Array) -> float:
    """The least distance between two of (N, k) points."""
    return min(float(norm(points[k + 1 :] - points[k]).min()) for k in range(len(points) - 1))


def _each_once(pairs: Index) -> Index:
    """Pairs (M, 2), smaller row first, sorted, each once."""
    return np.unique(np.sort(pairs, axis=1), axis=0).astype(np.intp)
