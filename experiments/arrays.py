"""Tables of arrays, that of poses among them: the first axis is robots (N), links (E) or poses (M)."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Mapping, Sequence
from math import nan, pi, tau
from typing import Any, Self

import msgspec
import numpy as np

from twins.arrays import Array, Index, Mask


def wrap(angle: Array) -> Array:
    """Angles in (−π, π]."""
    return np.asarray(pi - np.mod(pi - angle, tau))


def rounded(values: Array) -> Array:
    """Values rounded to six decimals as Python does: numpy errs where a value lies next to the middle of two."""
    scaled = values * 1e6
    whole = np.rint(scaled)
    found = whole / 1e6
    near = np.abs(np.abs(scaled - whole) - 0.5) <= np.spacing(np.abs(scaled))
    found[near] = [round(each, 6) for each in values[near].tolist()]
    return np.asarray(found)


def known_rows(values: Iterable[Sequence[float] | float | None], width: int = 1) -> Array:
    """Numbers or vectors as rows (n, width); NaN where there is none."""
    blank = nan if width == 1 else (nan,) * width
    return np.array([blank if each is None else each for each in values], dtype=float).reshape(-1, width)


def data_frame(columns: Mapping[str, Any]) -> Any:  # noqa: ANN401 - of pandas or of polars
    """Columns as a data frame of pandas, or of polars where only that is installed; raises ImportError without both.

    NaN becomes null in polars: its means leave out nulls alone, and its comparisons take NaN for the largest number.
    """
    for library in ("pandas", "polars"):
        try:
            frame = importlib.import_module(library).DataFrame(columns)
        except ModuleNotFoundError:
            continue
        return frame if library == "pandas" else frame.fill_nan(None)
    raise ImportError("neither pandas nor polars is installed; `./zenpark install pandas` installs one of them")


class ArrayTable(msgspec.Struct, frozen=True):
    """Base of tables: arrays with a first axis of the same length; a column may be None."""

    @classmethod
    def joined(cls, tables: Sequence[Self]) -> Self:
        """All rows of `tables`, which have the same columns."""
        columns: Any = zip(*map(msgspec.structs.astuple, tables), strict=True)
        joined: list[Any] = [None if column[0] is None else np.concatenate(column) for column in columns]
        return cls(*joined)

    def __len__(self) -> int:
        return len(msgspec.structs.astuple(self)[0])

    def take(self, which: Index | Mask | slice) -> Self:
        kept: list[Any] = [None if column is None else column[which] for column in msgspec.structs.astuple(self)]
        return type(self)(*kept)


class PoseTable(ArrayTable, frozen=True):
    """Poses (M) of many robots: as they were sent, on their way, or as they were received.

    In memory alone an array may have no columns, (M, 0), where its values are not kept.
    """

    link: Index  # directed link; in a table of sent poses, the sender's row
    seq: Index  # running number of the sender
    stamp: Array  # [s] time at which the pose was sent
    arrival: Array  # [s]
    position: Array  # (M, 3) [m]
    velocity: Array  # (M, 3) [m/s]
    yaw: Array | None = None  # [rad]
    bytes: Index | None = None  # length of the payload
    extra: Array | None = None  # (M, k) transmitted with the pose

    def since(self, begin: float) -> Self:
        """The same with times that count from `begin` [s]."""
        return msgspec.structs.replace(self, stamp=self.stamp - begin, arrival=self.arrival - begin)

    def between(self, first: int, end: int) -> Self:
        """Rows of the links from `first` to before `end`, which then count from 0."""
        kept = self.take((self.link >= first) & (self.link < end))
        return msgspec.structs.replace(kept, link=kept.link - first)
