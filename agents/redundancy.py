"""What a rigid formation can lose and stay rigid: single links, single robots."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from agents.graph import rigid_motions, rigidity_matrix
from agents.rows import Array, Index, Mask

SINGULAR: Final = 1e-9  # relative to the largest: smaller singular values are arithmetic
CERTAIN: Final = 1e-12  # a link that bears all but this share of its own load alone bears all of it: shares are squares


@dataclass(frozen=True)
class Redundancy:
    """Of a framework of N robots and M pairs.

    Attributes:
        pairs: (M,) whether it stays rigid without this pair.
        robots: (N,) whether it stays rigid without this robot.
    """

    pairs: Mask
    robots: Mask


def redundancy(position: Array, pairs: Index, moves: Mask | None = None) -> Redundancy:
    """What can be left out of an infinitesimally rigid framework; nothing, if it is not rigid.

    With P the projector onto the columns of the rigidity matrix R, the rank of R without the rows of a set S is smaller
    by the multiplicity of the eigenvalue 1 of P_SS: as many independent velocities stretch links of S only. For one
    link that eigenvalue is P_ee itself, and it is 1 where no self-stress passes through the link. So one
    decomposition of R tells it for every link and every robot.

    Args:
        position: (N, 3) [m].
        pairs: (M, 2) undirected edges.
        moves: (N, 3) which coordinates are free to move; None: all.
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
