"""Anchors: distances that robots keep to a fixed point, line or plane."""

from __future__ import annotations

import numpy as np
from msgspec.structs import replace

from agents.arrays import Array, Columns, Index, norm


class Anchors(Columns, frozen=True):
    """Distances (A) to a fixed point, to a line along `axis` through it, or to a plane across `axis` through it."""

    row: Index  # (A,) robot
    point: Array  # (A, 3) [m]
    axis: Array  # (A, 3) unit vectors; unused for points
    whole: Array  # (A,) share of p − point that counts: 1 for points and lines, 0 for planes
    along: Array  # (A,) share of its part along `axis` that is added: 0 for points, −1 for lines, 1 for planes
    distance: Array  # (A,) wanted [m]; 0: on it
    gain: Array  # (A,) [1/(m² decision)], or [1/decision] where the distance is 0

    def repeated(self, times: int, rows: int) -> Anchors:
        """Anchors of `times` copies of an experiment of `rows` robots, one copy behind the other."""
        shift = np.repeat(np.arange(times) * rows, len(self))
        many = self.take(np.tile(np.arange(len(self)), times))
        return replace(many, row=many.row + shift)

    def offset(self, position: Array) -> Array:
        """u (N, 3) [m] of all rows: ½ g (d² − ‖x‖²) x, with x from the nearest point to p; −g x where d = 0.

        For points this is the pull to the origin of the authors' controllers; −g x because the cube of a small x never
        gets there.
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
        """x (A, 3) from the nearest point of each point, line or plane to its robot [m]."""
        apart = position[self.row] - self.point
        part = np.vecdot(apart, self.axis) * self.along
        return np.asarray(self.whole[:, None] * apart + part[:, None] * self.axis)
