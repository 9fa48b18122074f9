"""Types of arrays and numbers, and the table of poses: the first axis is robots (N), links (E) or poses (M)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import nan, pi, tau
from typing import Annotated, Any, Self

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]
Rows = Index | slice  # what selects rows: numbers, or a run of them

# of settings
Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Share = Annotated[float, Meta(ge=0, le=1)]


def clamp(value: Array, low: Array | float, high: Array | float) -> Array:
    """`value` between `low` and `high`; NaN stays NaN. A third of the cost of `numpy.clip` on a few rows."""
    clamped: Array = np.minimum(np.maximum(value, low), high)
    return clamped


def norm(vectors: Array) -> Array:
    """Euclidean length of each row of (..., k) -> (...,).

    `numpy.linalg.norm` costs twice as much on the few rows that a robot process has.
    """
    length: Array = np.sqrt(np.vecdot(vectors, vectors))
    return length


def wrap(angle: Array) -> Array:
    """Angles in (−π, π]."""
    return np.asarray(pi - np.mod(pi - angle, tau))


def some(mask: Mask) -> bool:
    """True if any entry of `mask` is true. A tenth of the cost of `mask.any()` on a few rows."""
    return 1 in mask.tobytes()


def every(mask: Mask) -> bool:
    """True if all entries of `mask` are true. A tenth of the cost of `mask.all()` on a few rows."""
    return 0 not in mask.tobytes()


def span(rows: Index) -> Rows:
    """`rows` as a slice if they follow one another: a view costs a tenth of the copy that row numbers make."""
    if len(rows) and (np.diff(rows) == 1).all():
        return slice(int(rows[0]), int(rows[-1]) + 1)
    return rows


def known_rows(values: Iterable[Sequence[float] | float | None], width: int = 1) -> Array:
    """Numbers or vectors as rows (n, width); NaN where there is none."""
    blank = nan if width == 1 else (nan,) * width
    return np.array([blank if each is None else each for each in values], dtype=float).reshape(-1, width)


class Columns(msgspec.Struct, frozen=True):
    """Base of tables: arrays with a first axis of the same length; a column may be None."""

    @classmethod
    def joined(cls, tables: Sequence[Self]) -> Self:
        """All rows of `tables`, which have the same columns."""
        columns: Any = zip(*map(msgspec.structs.astuple, tables), strict=True)
        joined: list[Any] = [None if column[0] is None else np.concatenate(column) for column in columns]
        return cls(*joined)

    def __len__(self) -> int:
        return len(msgspec.structs.astuple(self)[0])

    def take(self, which: Index | Mask) -> Self:
        kept: list[Any] = [None if column is None else column[which] for column in msgspec.structs.astuple(self)]
        return type(self)(*kept)


class PoseTable(Columns, frozen=True):
    """Poses (M) of many robots: as they were sent, on their way, or as they were received.

    In memory alone an array may have no columns, (M, 0), where its values are not kept.
    """

    link: Index  # directed link; in a table of sent poses, the sender's row
    seq: Index  # running number of the sender
    stamp: Array  # [s] when the pose was sent
    arrival: Array  # [s]
    position: Array  # (M, 3) [m]
    velocity: Array  # (M, 3) [m/s]
    yaw: Array | None = None  # [rad]
    bytes: Index | None = None  # of the payload
    extra: Array | None = None  # (M, k) transmitted with the pose

    def since(self, begin: float) -> Self:
        """The same with times that count from `begin` [s]."""
        return msgspec.structs.replace(self, stamp=self.stamp - begin, arrival=self.arrival - begin)

    def between(self, first: int, end: int) -> Self:
        """Rows of the links from `first` to before `end`, which then count from 0."""
        kept = self.take((self.link >= first) & (self.link < end))
        return msgspec.structs.replace(kept, link=kept.link - first)


def no_poses() -> PoseTable:
    none, rows = np.zeros(0), np.zeros(0, dtype=np.intp)
    return PoseTable(rows, rows, none, none, np.zeros((0, 3)), np.zeros((0, 3)), none, rows)
