"""Can a formation exist, does it hold its shape, and does the sampled loop settle: the numbers, without any motion."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from agents.coordination import Law
from agents.graph import Links, Rigidity, edges, rigidity
from agents.rows import Array, Index, Mask, norm

EXACT = 1e-9  # [m] link errors below this are arithmetic
ROUNDED = 1e-3  # [m] distances written with three decimals contradict one another by less
STEP = 1e-4  # [m] of the differences that stand for the law's derivative
STANDING = 1e-6  # modes slower than the fastest by this factor do not move at all


@dataclass(frozen=True)
class Shape:
    """A place for every robot that meets the distances as well as they can be met.

    Attributes:
        position: (N, 3) [m].
        error: (E,) |‖p_i − p_j‖ − d_ij| of each link [m].
    """

    position: Array
    error: Array

    @property
    def worst(self) -> float:
        """The largest error of a link [m]."""
        return float(self.error.max(initial=0.0))


def link_errors(links: Links, position: Array) -> Array:
    """|‖p_i − p_j‖ − d_ij| (..., E) [m] of positions (..., N, 3)."""
    offset = position[..., links.listener, :] - position[..., links.speaker, :]
    return np.asarray(np.abs(norm(offset) - links.distance))


def realise(links: Links, guesses: Iterable[Array], moves: Mask) -> list[Shape]:
    """Places at the distances wanted, one for each guess, until one is exact.

    Args:
        links: With the distances.
        guesses: (N, 3) each [m]; heights are held where they are.
        moves: (N,) rows that may be placed elsewhere in the plane.

    Returns:
        The shapes that were found, in the order of the guesses; the last one is the only one that may be exact.
    """
    found = []
    for guess in guesses:
        position = _fitted(links, guess, np.flatnonzero(moves))
        found.append(Shape(position, link_errors(links, position)))
        if found[-1].worst < EXACT:
            break
    return found


def unfolded(links: Links, height: Array) -> Array:
    """A first guess (N, 3) [m] at the shape: the two main axes of the distances through the network.

    Torgerson's scaling, with shortest ways through the network for the distances that no link gives; robots in
    different parts of it are put as far apart as the longest way.
    """
    rows = len(height)
    way = np.full((rows, rows), np.inf)
    rise = height[links.listener] - height[links.speaker]
    way[links.listener, links.speaker] = np.sqrt(np.maximum(links.distance**2 - rise**2, 0.0))
    way = np.minimum(way, way.T)
    np.fill_diagonal(way, 0.0)
    for over in range(rows):
        way = np.minimum(way, way[:, over, None] + way[None, over, :])
    way[~np.isfinite(way)] = way[np.isfinite(way)].max()
    way = np.minimum(way, 1e6)  # its square must be a number
    centring = np.eye(rows) - 1.0 / rows
    values, axes = np.linalg.eigh(-0.5 * centring @ way**2 @ centring)
    plane = axes[:, -2:] * np.sqrt(np.maximum(values[-2:], 0.0))
    return np.column_stack([np.zeros((rows, 2 - plane.shape[1])), plane, height])


def _fitted(links: Links, guess: Array, rows: Index) -> Array:
    """Least squares of the link errors over x and y of `rows`, by Levenberg's and Marquardt's method."""
    position, damping = guess.copy(), 1e-3
    column = np.full(len(guess), -1)
    column[rows] = np.arange(len(rows))
    link = np.arange(len(links))
    tails, heads = column[links.listener], column[links.speaker]
    tail, head = tails >= 0, heads >= 0
    error, offset, length = _lengths(links, position)
    for _ in range(200):
        direction = offset[:, :2] / length[:, None]
        slopes = np.zeros((len(links), len(rows), 2))
        slopes[link[tail], tails[tail]] = direction[tail]
        slopes[link[head], heads[head]] = -direction[head]
        jacobian = slopes.reshape(len(links), -1)
        slope, normal = jacobian.T @ error, jacobian.T @ jacobian
        step = np.linalg.solve(normal + damping * np.eye(len(slope)), -slope).reshape(-1, 2)
        tried = position.copy()
        tried[rows, :2] += step
        then = _lengths(links, tried)
        before, after = float(error @ error), float(then[0] @ then[0])
        if after < before:
            position, damping = tried, max(damping / 10.0, 1e-10)
            error, offset, length = then
        else:
            damping *= 10.0
        if damping > 1e9 or before < (EXACT / 100) ** 2 or 0.0 <= before - after < 1e-9 * before:
            break
    return position


def _lengths(links: Links, position: Array) -> tuple[Array, Array, Array]:
    """Signed error (E,), offset (E, 3) and length (E,) of each link [m]; no length is zero."""
    offset = position[links.listener] - position[links.speaker]
    length = np.sqrt(np.einsum("ek,ek->e", offset, offset) + 1e-18)
    return length - links.distance, offset, length


@dataclass(frozen=True)
class Conflict:
    """Distances that contradict one another whatever the rest of the formation does.

    Attributes:
        rows: Two robots whose heights alone are farther apart than they should be, or the three of a triangle.
        ceiling: Height of the higher ones at which they would just be met [m]; NaN where no height would do.
        high: The rows of the higher ones.
    """

    rows: tuple[int, ...]
    ceiling: float
    high: tuple[int, ...]


def conflicts(links: Links, height: Array) -> list[Conflict]:
    """Pairs and triangles of linked robots that cannot be met with the held heights (N,) [m]."""
    rows = len(height)
    wanted = np.full((rows, rows), np.nan)
    wanted[links.listener, links.speaker] = links.distance
    wanted = np.where(np.isnan(wanted), wanted.T, wanted)
    rise = np.abs(height[:, None] - height[None, :])
    found = []
    for i, j in np.argwhere(np.triu(wanted < rise - ROUNDED)):
        high = int(i if height[i] > height[j] else j)
        found.append(Conflict((int(i), int(j)), float(wanted[i, j] + min(height[i], height[j])), (high,)))
    planar = np.sqrt(np.maximum(wanted**2 - rise**2, 0.0))
    planar[wanted < rise - ROUNDED] = np.nan
    seen = set()
    for i, j in edges(links):
        for k in np.flatnonzero(planar[i, j] > planar[i] + planar[j] + ROUNDED):
            triangle = tuple(sorted((int(i), int(j), int(k))))
            if triangle not in seen:
                seen.add(triangle)
                found.append(_of_triangle(triangle, wanted, height))
    return found


def _of_triangle(triangle: tuple[int, ...], wanted: Array, height: Array) -> Conflict:
    """What height would close it: that of the triangle itself, standing on the two that share a height."""
    for apex in triangle:
        left, right = (row for row in triangle if row != apex)
        if height[left] == height[right] != height[apex]:
            base = wanted[left, right]
            sides = np.array([base, wanted[left, apex], wanted[right, apex]])
            half = sides.sum() / 2.0
            square = half * float(np.prod(half - sides))
            if square > 0.0:
                high = (apex,) if height[apex] > height[left] else (left, right)
                return Conflict(triangle, float(min(height[apex], height[left]) + 2.0 * math.sqrt(square) / base), high)
    return Conflict(triangle, math.nan, ())


def stiffness(position: Array, links: Links, led: Index) -> tuple[Rigidity, Rigidity]:
    """Infinitesimal rigidity when heights are held, and in full space.

    Leaders (rows `led`) keep their places among themselves by their plans, so a bar stands between any two of them.
    """
    bars = np.array([(i, j) for i in led for j in led if i < j], dtype=np.intp).reshape(-1, 2)
    pairs = np.unique(np.concatenate([edges(links), bars]), axis=0).astype(np.intp)
    moves = np.ones_like(position, dtype=bool)
    moves[:, 2] = False
    return rigidity(position, pairs, moves), rigidity(position, pairs)


def algebraic_connectivity(links: Links, rows: int) -> float:
    """Second smallest eigenvalue of the Laplacian of the network without directions (Fiedler); 0 for one robot."""
    between = np.zeros((rows, rows))
    i, j = edges(links).T
    between[i, j] = between[j, i] = 1.0
    values = np.linalg.eigvalsh(np.diag(between.sum(axis=1)) - between)
    return max(0.0, float(values[1])) if rows > 1 else 0.0


@dataclass(frozen=True)
class Modes:
    """The sampled loop near its target.

    Attributes:
        gain: Largest real part of the eigenvalues of H M, what a decision takes from a mode; 2 is where it hunts.
        radius: Largest |1 − λ|: above 1 something grows.
        slowest_s: Time constant of the slowest mode that moves [s]; infinity where none does.
    """

    gain: float
    radius: float
    slowest_s: float


def modes(law: Law, links: Links, position: Array, closed: Array, hz: float) -> Modes:
    """Eigenvalues of p⁺ = p + H u(p) at `position`, over x and y of the robots that listen.

    Args:
        law: Its offset is differentiated numerically, in all coordinates at once.
        links: Of the whole experiment.
        position: (N, 3) where the formation is met [m].
        closed: (N,) h_i, the share of a position error that robot i closes until its next decision.
        hz: Decisions per second.
    """
    rows, listeners = len(position), np.unique(links.listener)
    free = (3 * listeners[:, None] + np.arange(2)).ravel()
    count = len(free)
    moved = np.tile(position.ravel(), (2 * count, 1))
    moved[np.arange(count), free] += STEP
    moved[count + np.arange(count), free] -= STEP
    many = links.repeated(2 * count, rows)
    places = moved.reshape(-1, 3)
    offset = law.offset(places, places[many.speaker], many).reshape(2 * count, 3 * rows)[:, free]
    slope = -(offset[:count] - offset[count:]).T / (2.0 * STEP)
    taken = np.repeat(closed[listeners], 2)[:, None] * slope
    if not np.isfinite(taken).all():
        return Modes(math.inf, math.inf, math.inf)
    values = np.linalg.eigvals(taken)
    moving = values[np.abs(values) > STANDING * np.abs(values).max(initial=0.0)]
    left = np.abs(1.0 - moving)
    decaying = left[left < 1.0]
    with np.errstate(divide="ignore"):
        slowest = -1.0 / (hz * np.log(decaying.max())) if len(decaying) else math.inf
    return Modes(float(values.real.max(initial=0.0)), float(left.max(initial=0.0)), float(slowest))
