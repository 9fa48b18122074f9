"""The array types of the row-wise core: first axis is the robots (N) or the links (E)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]
Rows = Index | slice  # what selects rows: numbers, or a run of them


def clamp(value: Array, low: Array | float, high: Array | float) -> Array:
    """`value` between `low` and `high`; NaN stays NaN. A third of the cost of `numpy.clip` on a few rows."""
    return np.asarray(np.minimum(np.maximum(value, low), high))


def norm(vectors: Array) -> Array:
    """Euclidean length of each row of (..., k) -> (...,).

    `numpy.linalg.norm` costs twice as much on the few rows that a robot process has.
    """
    return np.asarray(np.sqrt(np.vecdot(vectors, vectors)))


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
