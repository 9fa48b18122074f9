"""The heights at which drones can hold a formation that was made for drones that climb while they form it.

Robotic Park's Crazyflies follow the distances in all three axes, zenpark's hold a height. So the shape is sought at the
heights of the starts, else in space, and its heights are what the drones are to hold.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from agents.rows import Array, Index, Mask, norm
from experiments.feasibility import ENOUGH

ROUNDS: Final = 300
FOUND: Final = 1e-9  # [m] nearer is arithmetic
MET: Final = 1e-3  # [m] and those with three: no further beginnings are drawn
BULGE: Final = 1.05  # radius of the dome, as a multiple of the farthest robot's distance from the middle
DRAWN: Final = 4  # beginnings before the random ones
ATTEMPTS: Final = 40  # random beginnings
SPREAD: Final = (0.05, 0.1, 0.3, 0.6)  # [m] standard deviations of theirs
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

    def without_points(self) -> Wanted:
        """The same without distances to points."""
        return replace(self, row=self.row[:0], point=self.point[:0], radius=self.radius[:0])


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


def placed(wanted: Wanted, start: Array, climbs: Mask) -> Placed:
    """Places at what is asked for, as well as it can be met.

    A formation that can be met at the heights of the starts stays there. Else heights are free, and least squares
    begin at the starts, at a dome above them and at starts that are moved at random (always the same ones): a single
    beginning ends in a local minimum for about two of three of the shapes in space that the authors fly.

    Args:
        wanted: Links and points.
        start: (N, 3) [m].
        climbs: (N,) robots whose height may be another; the others keep theirs.
    """
    best: Placed | None = None
    for number, (guess, free) in enumerate(_beginnings(start, climbs), 1):
        found = _fitted(wanted, guess, free)
        if best is None or round(found.worst, 4) < round(best.worst, 4):
            best = found
        if best.worst <= (ENOUGH if number < DRAWN else MET):
            break
    assert best is not None
    return best


def _beginnings(start: Array, climbs: Mask) -> Iterator[tuple[Array, Mask]]:
    """Guesses (N, 3) [m] at the places, each with the robots (N,) whose heights are free."""
    nobody = np.zeros_like(climbs)
    middle = start[:, :2].mean(axis=0)
    away = start[:, :2] - middle
    way = norm(away)
    mirrored = start.copy()
    mirrored[:, 1] = 2.0 * middle[1] - start[:, 1]
    yield start, nobody
    yield mirrored, nobody
    if not climbs.any():
        return
    dome = start.copy()
    dome[climbs, 2] += np.sqrt(np.maximum((BULGE * way.max(initial=0.0)) ** 2 - way[climbs] ** 2, 0.0))
    yield start, climbs
    yield dome, climbs
    random = np.random.default_rng(0)
    for attempt in range(ATTEMPTS):
        moved = (start, dome)[attempt % 2] + random.normal(0.0, SPREAD[attempt % len(SPREAD)], start.shape)
        moved[~climbs, 2] = start[~climbs, 2]
        yield moved, climbs


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
