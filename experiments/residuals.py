"""What links and anchors ask of a set of places, as equations in x and y: how far each is off, and its slope."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from agents.anchors import Anchors
from agents.coordination import Law
from agents.graph import BY_BEARING, BY_DISTANCE, BY_RELATIVE, Links
from agents.rows import Array, Index, norm

TAKES: Final = {"distance": BY_DISTANCE, "relative": BY_RELATIVE, "bearing": BY_BEARING}
TINY: Final = 1e-18  # [m²] no length is zero


@dataclass(frozen=True)
class Residuals:
    """Equations (M) of links and anchors.

    Attributes:
        value: (M,) how far each is off [m].
        tail: (M,) row i.
        head: (M,) row j, −1 for anchors.
        slope: (M, 2) derivative of the value by x and y of row i; that by row j is its negative.
    """

    value: Array
    tail: Index
    head: Index
    slope: Array

    def jacobian(self, rows: Index, count: int) -> Array:
        """Derivatives (M, 2 R) of all values by x and y of `rows` (R,), of `count` robots."""
        column = np.full(count + 1, -1)  # the last stands for what is no robot
        column[rows] = np.arange(len(rows))
        number, slopes = np.arange(len(self.value)), np.zeros((len(self.value), len(rows), 2))
        for end, sign in ((self.tail, 1.0), (self.head, -1.0)):
            at = column[end]
            moves = at >= 0
            slopes[number[moves], at[moves]] = sign * self.slope[moves]
        return slopes.reshape(len(self.value), -1)

    def normal(self, rows: Index, count: int) -> tuple[Array, Array]:
        """JᵀJ (2 R, 2 R) and Jᵀ value (2 R,) of the `jacobian` J, which need not be made for it: it is nearly empty."""
        column = np.full(count + 1, -1)
        column[rows] = np.arange(len(rows))
        square = np.zeros((len(rows), len(rows), 2, 2))
        slope = np.zeros((len(rows), 2))
        outer = self.slope[:, :, None] * self.slope[:, None, :]
        ends = ((column[self.tail], 1.0), (column[self.head], -1.0))
        for one, sign in ends:
            moves = one >= 0
            np.add.at(slope, one[moves], sign * (self.value[:, None] * self.slope)[moves])
            for other, against in ends:
                both = moves & (other >= 0)
                np.add.at(square, (one[both], other[both]), sign * against * outer[both])
        size = 2 * len(rows)
        return square.transpose(0, 2, 1, 3).reshape(size, size), slope.ravel()


def as_taken(law: Law, links: Links) -> Links:
    """The links with what the law takes them to ask for: `distance` sees a distance in a relative position as well."""
    wants = TAKES.get(getattr(law, "NEEDS", "any"))
    if wants is None or links.wants is None:
        return links
    return replace(links, wants=None if wants == BY_DISTANCE else np.full(len(links), wants))


def residuals(links: Links, anchors: Anchors | None, position: Array) -> Residuals:
    """The equations at `position` (N, 3) [m]; of links as `as_taken` gives them."""
    apart = position[links.listener] - position[links.speaker]
    wants = np.full(len(links), BY_DISTANCE) if links.wants is None else links.wants
    parts = [_of_lengths(apart, links, np.flatnonzero(wants == BY_DISTANCE))]
    if links.wants is not None and links.relative is not None and links.bearing is not None:
        at = np.flatnonzero(wants == BY_RELATIVE)
        parts.append(
            _of_vectors(apart[at] - links.relative[at], np.broadcast_to(np.eye(3), (len(at), 3, 3)), links, at)
        )
        at = np.flatnonzero(wants == BY_BEARING)
        parts.append(_of_vectors(*_beside(apart[at], links.bearing[at]), links, at))
    if anchors is not None:
        parts.append(_of_anchors(anchors, position))
    columns = zip(*((each.value, each.tail, each.head, each.slope) for each in parts), strict=True)
    return Residuals(*(np.concatenate(column) for column in columns))


def _of_lengths(apart: Array, links: Links, at: Index) -> Residuals:
    length = np.sqrt(np.einsum("ek,ek->e", apart[at], apart[at]) + TINY)
    return Residuals(
        length - links.distance[at], links.listener[at], links.speaker[at], apart[at, :2] / length[:, None]
    )


def _of_vectors(value: Array, slope: Array, links: Links, at: Index) -> Residuals:
    """Three equations of each link: its vector (K, 3) and the derivative of that (K, 3, 3)."""
    return Residuals(
        value.reshape(-1), np.repeat(links.listener[at], 3), np.repeat(links.speaker[at], 3),
        slope[:, :, :2].reshape(-1, 2),
    )  # fmt: skip


def _beside(apart: Array, bearing: Array) -> tuple[Array, Array]:
    """From the ray along each bearing to x, as the law `bearing` sees it, and its derivative."""
    flat = np.isnan(bearing[:, 2])
    bearing, apart = bearing.copy(), apart.copy()
    bearing[flat, 2] = apart[flat, 2] = 0.0
    along = np.vecdot(apart, bearing)
    ahead = (along > 0.0)[:, None, None]
    value = apart - np.maximum(along, 0.0)[:, None] * bearing
    return value, np.eye(3) - np.where(ahead, bearing[:, :, None] * bearing[:, None, :], 0.0)


def _of_anchors(anchors: Anchors, position: Array) -> Residuals:
    away = anchors.away(position)
    matrix = anchors.whole[:, None, None] * np.eye(3) + anchors.along[:, None, None] * (
        anchors.axis[:, :, None] * anchors.axis[:, None, :]
    )
    ring = np.flatnonzero(anchors.distance > 0.0)
    length = np.sqrt(norm(away[ring]) ** 2 + TINY)
    direction = np.einsum("ak,akl->al", away[ring] / length[:, None], matrix[ring])[:, :2]
    on = np.flatnonzero(anchors.distance == 0.0)
    tail = np.concatenate([anchors.row[ring], np.repeat(anchors.row[on], 3)])
    return Residuals(
        np.concatenate([length - anchors.distance[ring], away[on].reshape(-1)]),
        tail,
        np.full(len(tail), -1),
        np.concatenate([direction, matrix[on][:, :, :2].reshape(-1, 2)]),
    )
