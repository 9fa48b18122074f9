"""The heights at which drones can hold a formation that was made for drones that climb while they form it.

Robotic Park's Crazyflies follow the distances in all three axes, zenpark's hold a height. So the shape is sought in
space, from where they start, and its heights are what they are to hold.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from agents.rows import Array, Index, Mask, norm

ROUNDS: Final = 300
FOUND: Final = 1e-9  # [m] nearer is arithmetic
BULGE: Final = (
    1.05  # of the farthest robot's way from the middle: radius of the dome that starts in one plane are bent to
)
TINY: Final = 1e-12


@dataclass(frozen=True)
class Wanted:
    """What is asked of N robots.

    Attributes:
        pairs: (M, 2) i, j.
        distance: (M,) ‖p_i − p_j‖ [m]; NaN where a relative position is asked for.
        relative: (M, 3) p_i − p_j [m].
        row: (A,) robots that keep a distance to a point.
        point: (A, 3) [m].
        radius: (A,) [m].
    """

    pairs: Index
    distance: Array
    relative: Array
    row: Index
    point: Array
    radius: Array


@dataclass(frozen=True)
class Placed:
    """Places (N, 3) [m], how far the worst link misses what it asks for, and how far the worst point [m]."""

    position: Array
    links: float
    points: float

    @property
    def worst(self) -> float:
        """The larger of the two [m]."""
        return max(self.links, self.points)


def placed(wanted: Wanted, start: Array, climbs: Mask, guess: Array | None = None) -> Placed:
    """Places at what is asked for, as well as it can be met.

    Args:
        wanted: Links and points.
        start: (N, 3) [m].
        climbs: (N,) robots whose height may be another; the others keep theirs.
        guess: (N, 3) another beginning, which wins where it is as good [m].
    """
    middle = start[:, :2].mean(axis=0)
    way = norm(start[:, :2] - middle)
    dome = start.copy()
    dome[climbs, 2] += np.sqrt(np.maximum((BULGE * way.max(initial=0.0)) ** 2 - way[climbs] ** 2, 0.0))
    guesses = [start, dome] if guess is None else [guess, start, dome]
    return min((_fitted(wanted, each, climbs) for each in guesses), key=lambda each: round(each.worst, 4))


def _fitted(wanted: Wanted, guess: Array, climbs: Mask) -> Placed:
    """Least squares by Levenberg's and Marquardt's method."""
    free = np.ones_like(guess, dtype=bool)
    free[~climbs, 2] = False
    position, damping = guess.copy(), 1e-3
    value, slope = _residuals(wanted, position)
    for _ in range(ROUNDS):
        jacobian = slope.reshape(len(value), -1)[:, free.ravel()]
        normal = jacobian.T @ jacobian + damping * np.eye(int(free.sum()))
        tried = position.copy()
        tried[free] -= np.linalg.solve(normal, jacobian.T @ value)
        with np.errstate(over="ignore", invalid="ignore"):  # too far a step is no better, whatever it comes to
            then, steeper = _residuals(wanted, tried)
            before, after = float(value @ value), float(then @ then)
        if after < before:
            position, value, slope, damping = tried, then, steeper, max(damping / 10.0, 1e-10)
        else:
            damping *= 10.0
        if damping > 1e9 or before < FOUND**2 or 0.0 <= before - after < 1e-10 * before:
            break
    points = len(wanted.row)
    off = np.abs(value)
    links = off[: len(off) - points] if points else off
    return Placed(position, float(links.max(initial=0.0)), float(off[len(off) - points :].max(initial=0.0)))


def _residuals(wanted: Wanted, position: Array) -> tuple[Array, Array]:
    """What is off (K,) and its slope (K, N, 3): distances, then relative positions, then points."""
    rows = len(position)
    i, j = wanted.pairs[:, 0], wanted.pairs[:, 1]
    apart = position[i] - position[j]
    by_distance, by_place = np.flatnonzero(np.isfinite(wanted.distance)), np.flatnonzero(np.isnan(wanted.distance))
    length = norm(apart[by_distance]) + TINY
    number = np.arange(len(by_distance))
    lengths = np.zeros((len(by_distance), rows, 3))
    lengths[number, i[by_distance]] = apart[by_distance] / length[:, None]
    lengths[number, j[by_distance]] = -apart[by_distance] / length[:, None]
    vectors = np.zeros((len(by_place), 3, rows, 3))
    number = np.arange(len(by_place))
    for axis in range(3):
        vectors[number, axis, i[by_place], axis], vectors[number, axis, j[by_place], axis] = 1.0, -1.0
    away = position[wanted.row] - wanted.point
    far = norm(away) + TINY
    points = np.zeros((len(wanted.row), rows, 3))
    points[np.arange(len(wanted.row)), wanted.row] = away / far[:, None]
    value = np.concatenate(
        [
            length - wanted.distance[by_distance],
            (apart[by_place] - wanted.relative[by_place]).ravel(),
            far - wanted.radius,
        ]
    )
    return value, np.concatenate([lengths, vectors.reshape(-1, rows, 3), points])
