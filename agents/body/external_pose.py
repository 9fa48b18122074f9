"""Velocities that follow from measured positions, and the positions that are measured outside of the robots."""

from __future__ import annotations

from typing import Final, TypeVar

import numpy as np

from agents.arrays import Array, Index
from agents.body.interface import BodyState

SMOOTHING_S: Final = 0.1  # time constant of the velocity estimate
FASTEST: Final = 5.0  # [m/s] a jump that would need more is a mistaken marker, not a motion
FARTHEST: Final = 1e6  # [m] nothing is measured beyond
PATIENCE_S: Final = 0.5  # after this silence any position is believed again

Number = TypeVar("Number", float, Array)


def velocity_after(velocity: Number, moved: Number, since: float) -> Number:
    """The velocity estimate after one more measured position: a low-pass with `SMOOTHING_S` on the difference quotient.

    The one estimate of this project: motion capture and odometry measure positions, and a velocity is what is left
    of their differences. White noise σ of the positions makes σ / `SMOOTHING_S` of noise, whatever the rate is.

    Args:
        velocity: The estimate before, any shape [m/s].
        moved: Measured position less the one before [m].
        since: Time between the two, above 0 [s].
    """
    share = since / (SMOOTHING_S + since)
    return velocity + share * (moved / since - velocity)


class External:
    """The last external pose of each row, and a filtered derivative of it.

    Attributes:
        time: (n,) [s], minus infinity before the first.
        position: (n, 3) [m], NaN before the first.
        velocity: (n, 3) [m/s].
        yaw: (n,) [rad].
        refused: Poses that were no motion of a robot.
    """

    def __init__(self, rows: int) -> None:
        self.time = np.full(rows, -np.inf)
        self.position = np.full((rows, 3), np.nan)
        self.velocity = np.zeros((rows, 3))
        self.yaw = np.full(rows, np.nan)
        self.refused = 0

    def update(self, row: int, t: float, position: Array, yaw: float) -> bool:
        """Takes a pose in; False if it is old, or jumps farther than any robot moves."""
        since = t - self.time[row]
        if not (since > 0.0 and (np.abs(position) <= FARTHEST).all()):  # NaN is not nearer either
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
        if np.isfinite(yaw):
            self.yaw[row] = yaw
        return True

    def fill(self, state: BodyState, rows: Index) -> None:
        """Puts what is known of `rows` in place of what their bodies say; a yaw never measured is left alone."""
        state.time[rows], state.position[rows] = self.time[rows], self.position[rows]
        state.velocity[rows] = self.velocity[rows]
        state.yaw[rows] = np.where(np.isfinite(self.yaw[rows]), self.yaw[rows], state.yaw[rows])
