"""Links as arrays, and graph theory on them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from experiments.arrays import ArrayTable
from twins.arrays import Array, Index, Mask


class Links(ArrayTable, frozen=True):
    """Directed links (E), sorted by receiver; rows are the robots of the experiment.

    Columns of `agents.formation.link.Link`, where a link is described.
    """

    receiver: Index  # (E,) rows i
    sender: Index  # (E,) rows j
    distance: Array  # (E,) d_ij [m]; NaN where only a direction is wanted
    gain: Array  # (E,) of the law
    # (E, 3) wanted p_i − p_j [m], NaN for distances and directions; None: no link wants one
    relative: Array | None = None
    # (E, 3) unit vector along the wanted p_i − p_j, NaN where none; z alone NaN: seen from above
    bearing: Array | None = None
    wants: Index | None = None  # (E,) BY_DISTANCE, BY_RELATIVE or BY_BEARING; None: all by distance

    def __len__(self) -> int:
        return len(self.receiver)


def links(
    pairs: Sequence[tuple[int, int]], distance: Sequence[float] | float = np.nan, gain: Sequence[float] | float = 1.0
) -> Links:
    """Links by distance from (receiver, sender) pairs in any order; one number is for all of them.

    Pairs are enough where only the matrices are wanted: `adjacency(links(pairs), rows)`.
    """
    both = np.array(pairs, dtype=np.intp).reshape(-1, 2)
    order = np.lexsort((both[:, 1], both[:, 0]))
    wanted, gains = (np.broadcast_to(np.asarray(each, dtype=float), len(both))[order] for each in (distance, gain))
    return Links(both[order, 0], both[order, 1], wanted, gains)


def adjacency(net: Links, rows: int) -> Array:
    """A (N, N): a_ij = 1 if i receives from j (paper, eq. (11))."""
    matrix = np.zeros((rows, rows))
    matrix[net.receiver, net.sender] = 1.0
    return matrix


def degree(net: Links, rows: int) -> Array:
    """D (N, N): number of neighbours that each robot receives from, on the diagonal."""
    return np.diag(adjacency(net, rows).sum(axis=1))


def edges(net: Links) -> Index:
    """The undirected edges (M, 2), smaller row first, each once."""
    pairs = np.sort(np.stack([net.receiver, net.sender], axis=1), axis=1)
    return np.unique(pairs, axis=0).astype(np.intp).reshape(-1, 2)


def reachable(net: Links, rows: int, sources: Index) -> Mask:
    """Rows (N,) that receive from the sources, directly or through others."""
    receives = adjacency(net, rows) > 0
    known = np.zeros(rows, dtype=bool)
    known[sources] = True
    for _ in range(rows):
        wider = known | (receives @ known)
        if (wider == known).all():
            break
        known = wider
    return known


def part_of_rows(net: Links, rows: int) -> Index:
    """Number (N,) of the connected part of each row when directions are ignored: that of one of its rows."""
    label = np.arange(rows)
    for i, j in edges(net):
        label[label == label[j]] = label[i]
    return label


def components(net: Links, rows: int) -> int:
    """Number of connected parts when directions are ignored."""
    return len(np.unique(part_of_rows(net, rows)))
