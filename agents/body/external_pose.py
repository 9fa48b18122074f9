"""External poses (motion capture), and the estimate of velocity from positions, where nothing measures it."""

from __future__ import annotations

from typing import Final, TypeVar

import numpy as np

from agents.arrays import Array, Index
from agents.body.interface import BodyState

SMOOTHING_S: Final = 0.1  # time constant of the velocity estimate
FASTEST: Final = 5.0  # [m/s] a faster jump results from a mistaken marker
FARTHEST: Final = 1e6  # [m] largest coordinate
PATIENCE_S: Final = 0.5  # after this silence any position is accepted

Number = TypeVar("Number", float, Array)


def velocity_after(velocity: Number, moved: Number, since: float) -> Number:
    """The velocity estimate after one more measured position: a low-pass with `SMOOTHING_S` on the difference quotient.

    Used for motion capture and odometry. White noise σ of the positions makes σ / `SMOOTHING_S` of noise, at any rate.
    The position `moved` [m] in `since` [s], above 0; velocities [m/s] of any shape.
    """
    share = since / (SMOOTHING_S + since)
    return velocity + share * (moved / since - velocity)


class External:
    """The last external pose of each row, and a filtered derivative of it."""

    def __init__(self, rows: int) -> None:
        self.time: Array = np.full(rows, -np.inf)  # (n,) [s], minus infinity before the first pose
        self.position: Array = np.full((rows, 3), np.nan)  # (n, 3) [m], NaN before the first pose
        self.velocity: Array = np.zeros((rows, 3))  # (n, 3) [m/s]
        self.yaw: Array = np.full(rows, np.nan)  # (n,) [rad], NaN while the newest pose has none
        # (n,) last measured yaw less the body's own at that time [rad], NaN before the first; and that time [s]
        self._turned, self._turned_at = np.full((2, rows), np.nan)
        self.refused = 0  # poses that jumped farther than a robot can move

    def update(self, row: int, t: float, position: Array, yaw: float) -> bool:
        """Stores a pose; returns False if it is old, or jumps farther than a robot can move."""
        since = t - self.time[row]
        if not (since > 0.0 and (np.abs(position) <= FARTHEST).all()):  # NaN fails as well
            return False
        if since < PATIENCE_S:
            moved = position - self.position[row]
            if float(moved @ moved) > (FASTEST * since + 0.02) ** 2:
                self.refused += 1
                return False
            self.velocity[row] = velocity_after(self.velocity[row], moved, since)
        else:
            self.velocity[row] = 0.0
        self.time[row], self.position[row] = t, position
        self.yaw[row] = yaw if np.isfinite(yaw) else np.nan
        return True

    def estimate(self, t: float, state: BodyState) -> None:
        """Estimates, at `t` [s], the velocity of rows whose bodies measure none, from their positions."""
        rows = np.flatnonzero(np.isnan(state.velocity).any(axis=1))
        for row in rows.tolist():
            self.update(row, float(state.time[row]), state.position[row], float(state.yaw[row]))
        fresh = t - self.time[rows] < PATIENCE_S
        state.velocity = state.velocity.copy()  # may be another field as well: a body has one array of unknowns
        state.velocity[rows] = np.where(fresh[:, None], self.velocity[rows], np.nan)

    def fill(self, state: BodyState, rows: Index) -> None:
        """Replaces the poses of `rows` in a state of their bodies.

        While poses come without a yaw, it is the body's own, turned to agree with the last measured one.
        """
        state.time[rows], state.position[rows] = self.time[rows], self.position[rows]
        state.velocity[rows] = self.velocity[rows]
        yaw, own = self.yaw[rows], state.yaw[rows]
        known = np.isfinite(yaw)
        new = known & np.isfinite(own) & (self.time[rows] != self._turned_at[rows])
        self._turned[rows] = np.where(new, yaw - own, self._turned[rows])
        self._turned_at[rows] = np.where(new, self.time[rows], self._turned_at[rows])
        turned = self._turned[rows]
        state.yaw[rows] = np.where(known, yaw, np.where(np.isnan(turned), own, own + turned))
