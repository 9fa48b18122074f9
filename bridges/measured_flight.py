"""Which robots fly, of bodies that tell no more than positions: known by orders and by measured heights."""

from __future__ import annotations

from typing import Final

import numpy as np

from agents.arrays import Array, Mask, norm, some
from agents.safety.detection import SLOWEST

FRESH_S: Final = 0.5  # older positions are lost; robots tolerate as much
LANDING_S: Final = 10.0  # a robot without positions counts as landed so long after `land`, and after a slow descent
GROUNDED_S: Final = 1.0  # a robot in flight that is measured on the ground for so long has landed by itself
AWAY_M: Final = 0.05  # [m] above the ground: higher is in the air, lower is down
FLOOR_M: Final = 0.2  # [m] a take-off from higher up is one from a table: the floor is at 0
TABLE_M: Final = 0.3  # [m] horizontally from there it ends
SETTLED: Final = 0.1  # [m/s] slower robots stand


class MeasuredFlight:
    """Flying rows, and since when each lands; all times are on the clock of the body [s].

    Attributes:
        flying: Rows that fly.
        landing_since: Time of the order to land or to stop; infinity without one.
    """

    def __init__(self, rows: int) -> None:
        self.flying: Mask = np.zeros(rows, dtype=bool)
        self.landing_since: Array = np.full(rows, np.inf)
        self._start = np.zeros((rows, 3))  # place of the take-off [m]
        self._highest = np.full(rows, -np.inf)  # [m] since the order to land
        self._still_since = np.full(rows, np.inf)
        self._grounded_since = np.full(rows, np.inf)  # measured on the ground although it should fly

    def take_off(self, row: int, position: Array) -> None:
        """Begin a flight at a position (3,) [m], NaN if unknown."""
        self._start[row] = np.where(np.isfinite(position), position, 0.0)
        self.flying[row], self.landing_since[row], self._highest[row] = True, np.inf, -np.inf

    def land(self, row: int, now: float) -> None:
        """Note an order to land; a repeated one of a flying row changes nothing."""
        if not (self.flying[row] and np.isfinite(self.landing_since[row])):
            self.landing_since[row] = now

    def update(self, now: float, measured: Array, position: Array, velocity: Array, climbing: Mask) -> Mask:
        """Rows (n,) whose flight has ended since the last update.

        Args:
            measured: Time of the positions.
            position: (n, 3) [m].
            velocity: (n, 3) [m/s].
            climbing: Rows with a take-off under way, which stand before they rise.
        """
        if not some(self.flying):
            return np.zeros(len(self.flying), dtype=bool)
        landing, aged = np.isfinite(self.landing_since), now - measured > FRESH_S
        z = position[:, 2]
        still = ~aged & (norm(velocity) < SETTLED)
        self._still_since = np.where(still, np.minimum(self._still_since, now), np.inf)
        self._highest = np.where(landing, np.fmax(self._highest, z), -np.inf)
        grounded = ~aged & self._on_ground(position) & (np.abs(velocity[:, 2]) < SETTLED)
        self._grounded_since = np.where(
            grounded & self.flying & ~climbing, np.minimum(self._grounded_since, now), np.inf
        )
        alone = ~landing & (now - self._grounded_since > GROUNDED_S)
        unseen = now - self.landing_since > np.fmax(LANDING_S, z / SLOWEST)
        # it has come lower and stands: on a table
        elsewhere = (self._highest - z > AWAY_M) & (now - self._still_since > LANDING_S)
        down = self.flying & ((landing & np.where(aged, unseen, grounded | elsewhere)) | alone)
        self.flying &= ~down
        return down

    def _on_ground(self, position: Array) -> Mask:
        """Rows at the height of the floor, or at the place of their take-off."""
        above = position - self._start
        table = self._start[:, 2] >= FLOOR_M
        floor = np.where(table, position[:, 2], above[:, 2]) <= AWAY_M
        back = (np.abs(above[:, 2]) <= AWAY_M) & (norm(above[:, :2]) < TABLE_M)
        return floor | (table & back)
