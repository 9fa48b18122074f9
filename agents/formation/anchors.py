"""Anchors: distances that robots keep to a point, a line or a plane that stands still."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agents.arrays import Array, Index, norm


@dataclass(frozen=True)
class Anchors:
    """Distances to what stands still (A): a point, a line through it along `axis`, or a plane through it across `axis`.

    Attributes:
        row: (A,) which robot.
        point: (A, 3) [m].
        axis: (A, 3) unit vectors; of no meaning for points.
        whole: (A,) 1 for points and lines, 0 for planes: the share of p − point that counts.
        along: (A,) 0 for points, −1 for lines, 1 for planes: the share of its part along `axis` that is added.
        distance: (A,) wanted [m]; 0: on it.
        gain: (A,) [1/(m² decision)], or [1/decision] where the distance is 0.
    """

    row: Index
    point: Array
    axis: Array
    whole: Array
    along: Array
    distance: Array
    gain: Array

    def __len__(self) -> int:
        return len(self.row)

    def of_rows(self, rows: Index) -> Anchors:
        """Those of these rows, which are renumbered from 0."""
        mine = np.flatnonzero(np.isin(self.row, rows))
        order = np.argsort(rows)
        return self._take(mine, order[np.searchsorted(rows, self.row[mine], sorter=order)])

    def repeated(self, times: int, rows: int) -> Anchors:
        """The same in `times` copies of an experiment of `rows` robots, one copy behind the other."""
        shift = np.repeat(np.arange(times) * rows, len(self))
        return self._take(np.tile(np.arange(len(self)), times), np.tile(self.row, times) + shift)

    def offset(self, position: Array) -> Array:
        """u (N, 3) [m] of all rows: ½ g (d² − ‖x‖²) x, with x from the nearest point to p; −g x where d = 0.

        For points as the authors' controllers pull to the origin; −g x because the cube of a small x never gets there.
        """
        away = self.displacement(position)
        square = np.vecdot(away, away)
        share = np.where(self.distance > 0.0, 0.5 * (self.distance**2 - square), -1.0)
        total = np.zeros_like(position)
        np.add.at(total, self.row, (self.gain * share)[:, None] * away)
        return total

    def error(self, position: Array) -> Array:
        """|d − ‖x‖| (A,) [m]."""
        return np.abs(self.distance - norm(self.displacement(position)))

    def displacement(self, position: Array) -> Array:
        """x (A, 3): from the nearest point of each point, line or plane to its robot [m]."""
        apart = position[self.row] - self.point
        part = np.vecdot(apart, self.axis) * self.along
        return np.asarray(self.whole[:, None] * apart + part[:, None] * self.axis)

    def _take(self, which: Index, row: Index) -> Anchors:
        columns = (self.point, self.axis, self.whole, self.along, self.distance, self.gain)
        return Anchors(row, *(column[which] for column in columns))
