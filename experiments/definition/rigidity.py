"""Rigidity of a framework, and which links and robots it can lose without losing it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from twins.arrays import Array, Index, Mask


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
    tolerance = 1e-9 * max(1.0, float(singular[0]) if len(singular) else 1.0)
    rank = int((singular > tolerance).sum())
    needed = int(free.sum()) - rigid_motions(position, free)
    smallest = float(singular[needed - 1]) if 0 < needed <= len(singular) else 0.0
    return Rigidity(rank, needed, smallest)


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


SINGULAR: Final = 1e-9  # relative to the largest: smaller singular values are arithmetic
CERTAIN: Final = 1e-12  # a link that bears all but this share of its own load alone bears all of it: shares are squares


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
        mine = basis[(pairs == row).any(axis=1)]
        lost = int((np.linalg.eigvalsh(mine @ mine.T) > 1.0 - CERTAIN).sum()) if len(mine) else 0
        needed = int(free[others].sum()) - rigid_motions(position[others], free[others]) if rows > 1 else 0
        found.robots[row] = rank - lost >= needed
    return found
