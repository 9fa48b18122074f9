"""Rigidity of a framework, and which links and robots it can lose without losing it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from twins.arrays import Array, Index, Mask, norm

# of the largest singular value: smaller ones are zero. A shape that bends to first order is solved to the root of the
# solver's accuracy only, some 1e-6 m, and the singular value that is zero at the exact shape is as large as that
SINGULAR: Final = 1e-5
STIFF: Final = 0.05  # share of the largest singular value: motions with larger ones are not soft
CERTAIN: Final = SINGULAR**2  # a link bears all of its own load alone if it bears all but this: shares are squares


def rigidity_matrix(position: Array, pairs: Index, moves: Mask | None = None) -> Array:
    """R (M, 3N): row of edge (i, j) holds (p_i − p_j)ᵀ at i and its negative at j.

    Robots at `position` (N, 3) [m], undirected edges `pairs` (M, 2). Columns of coordinates that are not in `moves`
    (N, 3), such as hover heights, are left out: the rigidity is that in motions that the robots really have.
    """
    rows = len(position)
    i, j = pairs[:, 0], pairs[:, 1]
    edge = np.arange(len(pairs))
    offset = position[i] - position[j]
    matrix = np.zeros((len(pairs), rows, 3))
    matrix[edge, i] = offset
    matrix[edge, j] = -offset
    flat = matrix.reshape(len(pairs), rows * 3)
    return flat if moves is None else flat[:, moves.ravel()]


@dataclass(frozen=True)
class Rigidity:
    """Rank of the rigidity matrix, the rank that infinitesimal rigidity needs, and its smallest singular value."""

    rank: int
    needed: int
    smallest: float

    @property
    def rigid(self) -> bool:
        return self.rank >= self.needed


def rigidity(position: Array, pairs: Index, moves: Mask | None = None) -> Rigidity:
    """Infinitesimal rigidity of the framework in the motions that the robots have.

    The rank needed is the number of free coordinates less the rigid motions that those coordinates allow: with all
    heights held these are 3 (two translations and the yaw), in full space 6. They are counted, not assumed: the rank
    of the rigid motions that leave every held coordinate alone.
    """
    free = np.ones_like(position, dtype=bool) if moves is None else moves
    singular = np.linalg.svd(rigidity_matrix(position, pairs, free), compute_uv=False)
    rank = int((singular > SINGULAR * singular.max(initial=0.0)).sum())
    needed = int(free.sum()) - rigid_motions(position, free)
    smallest = float(singular[needed - 1]) if 0 < needed <= len(singular) else 0.0
    return Rigidity(rank, needed, smallest)


class Bend(NamedTuple):
    """The robot that moves most against its neighbours in the motion that links resist least."""

    row: int
    way: float  # [m]; infinity where nothing resists


def bend(position: Array, pairs: Index, sigma: float, moves: Mask | None = None) -> Bend:
    """Bend of a framework under errors of positions of `sigma` [m], estimated.

    Moving by t along the right singular vector v of a small singular value s changes half the squares of the lengths
    by s t + κ t² in the direction w of a stress, with κ = wᵀq and q_ij = |v_i − v_j|²/2. So a framework that bends to
    first order (s = 0: robots in line, a V, a hexagon with its long diagonals) resists with the square only: an error
    of 2 mm moves a robot by centimetres. For the other arguments see `rigidity_matrix`.
    """
    free = np.ones_like(position, dtype=bool) if moves is None else moves
    needed = int(free.sum()) - rigid_motions(position, free)
    stress, singular, motion = np.linalg.svd(rigidity_matrix(position, pairs, free))
    slope = np.zeros(needed)
    slope[: len(singular)] = singular[:needed]
    stiff = min(int((slope > STIFF * singular[0]).sum()), needed - 1)
    length, found = norm(position[pairs[:, 0]] - position[pairs[:, 1]]), Bend(0, 0.0)
    error = sigma * math.sqrt(2.0 * float((length**2).mean()))  # error of half the square, noise at both ends
    count = np.bincount(pairs.ravel(), minlength=len(position))[:, None]
    for k in range(stiff, needed):
        velocity = np.zeros(position.shape)
        velocity[free] = motion[k]
        against = velocity[pairs[:, 0]] - velocity[pairs[:, 1]]
        curvature = float(norm(stress[:, stiff:].T @ (0.5 * (against**2).sum(axis=1))))
        # s t + κ t² = error; both small: a mechanism
        root = math.sqrt(float(slope[k]) ** 2 + 4.0 * curvature * error)
        way = 2.0 * error / (float(slope[k]) + root) if root > SINGULAR * singular[0] else math.inf
        total = np.zeros(position.shape)
        np.add.at(total, pairs[:, 0], against)
        np.add.at(total, pairs[:, 1], -against)
        moved = norm(total / np.maximum(count, 1))
        found = max(found, Bend(int(moved.argmax()), way * float(moved.max())), key=lambda each: each.way)
    return found


def rigid_motions(position: Array, free: Mask) -> int:
    """Dimension of the rigid motions (N, 3 velocities) that are zero in every held coordinate."""
    x, y, z = (position - position.mean(axis=0)).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    motions = np.array(
        [[one, zero, zero], [zero, one, zero], [zero, zero, one], [zero, -z, y], [z, zero, -x], [-y, x, zero]]
    ).transpose(0, 2, 1)  # (6, N, 3)
    held = motions[:, ~free]
    kept = _null_space(held.T) if held.size else np.eye(6)
    moving = np.tensordot(kept.T, motions, axes=1).reshape(kept.shape[1], position.size)
    return int(np.linalg.matrix_rank(moving, tol=1e-9)) if moving.size else 0


def _null_space(matrix: Array) -> Array:
    """Basis (k, m) of the vectors that `matrix` (n, k) maps to zero."""
    if len(matrix) > matrix.shape[1]:  # its triangle says the same, and is as small as the vectors
        matrix = np.asarray(np.linalg.qr(matrix, mode="r"))
    _, singular, right = np.linalg.svd(matrix)
    rank = int((singular > 1e-9 * max(1.0, float(singular[0]))).sum())
    return np.asarray(right[rank:].T)


@dataclass(frozen=True)
class Redundancy:
    """Links (M) and robots (N) without which a framework stays rigid."""

    pairs: Mask  # (M,) rigid without this pair
    robots: Mask  # (N,) rigid without this robot


def redundancy(position: Array, pairs: Index, moves: Mask | None = None) -> Redundancy:
    """Redundant links and robots of an infinitesimally rigid framework; none, if it is not rigid.

    With P the projector onto the columns of the rigidity matrix R, the rank of R without the rows of a set S is smaller
    by the multiplicity of the eigenvalue 1 of P_SS: as many independent velocities stretch links of S only. For one
    link that eigenvalue is P_ee itself, and it is 1 where no self-stress passes through the link. So one
    decomposition of R answers for every link and every robot. For the arguments see `rigidity_matrix`.
    """
    rows = len(position)
    free = np.ones_like(position, dtype=bool) if moves is None else moves
    nothing = Redundancy(np.zeros(len(pairs), dtype=bool), np.zeros(rows, dtype=bool))
    if not len(pairs):
        return nothing
    left, singular, _ = np.linalg.svd(rigidity_matrix(position, pairs, free), full_matrices=False)
    basis = left[:, singular > SINGULAR * singular[0]]
    rank = basis.shape[1]
    if rank < int(free.sum()) - rigid_motions(position, free):
        return nothing
    borne = np.vecdot(basis, basis)
    found = replace(nothing, pairs=borne < 1.0 - CERTAIN)
    everyone = np.arange(rows)
    for row in range(rows):
        others = everyone != row
        incident = basis[(pairs == row).any(axis=1)]
        lost = int((np.linalg.eigvalsh(incident @ incident.T) > 1.0 - CERTAIN).sum()) if len(incident) else 0
        needed = int(free[others].sum()) - rigid_motions(position[others], free[others]) if rows > 1 else 0
        found.robots[row] = rank - lost >= needed
    return found
