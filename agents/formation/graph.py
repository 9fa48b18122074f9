"""Links as arrays, and graph theory on them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from msgspec.structs import replace

from agents.arrays import Array, Columns, Index, Mask
from agents.formation.link import BY_DISTANCE


class Links(Columns, frozen=True, dict=True):
    """Directed links (E), sorted by receiver.

    A link wants a distance, a relative position or a direction; it is stored in each form that follows from it. In a
    robot's own process receivers are its rows, renumbered from 0; senders keep their numbers in the experiment.
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

    @cached_property
    def _starts(self) -> Index:
        """Index of the first link of each receiver; the links are sorted by receiver."""
        return np.flatnonzero(np.diff(self.receiver, prepend=-1))

    @cached_property
    def _heads(self) -> Index:
        return self.receiver[self._starts]

    def sum_by_receiver(self, per_link: Array, rows: int) -> Array:
        """Sum of a quantity (E, ...) over the links of each receiver -> (rows, ...)."""
        if len(self._heads) == rows > 0:
            return np.asarray(np.add.reduceat(per_link, self._starts, axis=0))
        total = np.zeros((rows, *per_link.shape[1:]))
        if len(self):
            total[self._heads] = np.add.reduceat(per_link, self._starts, axis=0)
        return total

    def by_sender(self, names: Sequence[str]) -> dict[str, Index]:
        """Indices of the links of each sender, by its name among those of all robots."""
        return {names[sender]: np.flatnonzero(self.sender == sender) for sender in np.unique(self.sender)}

    def max_by_receiver(self, per_link: Array, rows: int) -> Array:
        """Largest value of a quantity (E,) per receiver -> (rows,), 0 without links."""
        most = np.zeros(rows)
        if len(self):
            most[self._heads] = np.maximum.reduceat(per_link, self._starts)
        return most

    def to_receivers(self, rows: Index) -> Links:
        """Links to these rows; receivers are renumbered 0..len(rows)-1, senders keep their numbers."""
        at, receiver = self.indices_to_receivers(rows)
        return replace(self.take(at), receiver=receiver)

    def indices_to_receivers(self, rows: Index) -> tuple[Index, Index]:
        """Indices of the links to these rows, in the order of `to_receivers`, and new receiver numbers."""
        mine = np.flatnonzero(np.isin(self.receiver, rows))
        order = np.argsort(rows)
        receiver = order[np.searchsorted(rows, self.receiver[mine], sorter=order)]
        by_receiver = np.argsort(receiver, kind="stable")
        return mine[by_receiver], receiver[by_receiver]

    def repeated(self, times: int, rows: int) -> Links:
        """The same links in `times` copies of an experiment of `rows` robots, one copy behind the other."""
        shift = np.repeat(np.arange(times) * rows, len(self))
        many = self.take(np.tile(np.arange(len(self)), times))
        return replace(many, receiver=many.receiver + shift, sender=many.sender + shift)

    def append(self, others: Links) -> Links:
        """These links followed by others: no longer sorted, so only a sorted part of the result may be summed."""
        if others.wants is None and self.wants is None:
            ours, theirs = self, others
        else:
            ours, theirs = self._with_all_columns(), others._with_all_columns()
        return Links.joined([ours, theirs])

    def _with_all_columns(self) -> Links:
        if self.wants is not None:
            return self
        blank = np.full((len(self), 3), np.nan)
        return replace(self, relative=blank, bearing=blank, wants=np.full(len(self), BY_DISTANCE))


def links(
    pairs: Sequence[tuple[int, int]], distance: Sequence[float] | float = np.nan, gain: Sequence[float] | float = 1.0
) -> Links:
    """Links by distance from (receiver, sender) pairs in any order; one number is for all of them.

    Pairs are enough where only the matrices are wanted: `laplacian(links(pairs), rows)`.
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


def laplacian(net: Links, rows: int) -> Array:
    """L = D − A (N, N) (paper, eq. (5))."""
    return degree(net, rows) - adjacency(net, rows)


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
