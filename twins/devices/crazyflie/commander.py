"""The commander: of all setpoints that a Crazyflie is sent, the one that counts, and what it means for the motion."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from agents.arrays import Array, Mask

NEITHER: Final = (np.nan, np.nan, np.nan)


class Commander:
    """Setpoints of N rows: each axis of a row follows a position, a velocity, or nothing.

    A low-level setpoint has priority over the planner for ever, unless the client says that it sends no more of them.

    Attributes:
        target: (N, 3) positions wanted [m], NaN on axes that follow none.
        on: (N,) motors wanted.
    """

    def __init__(self, rows: int) -> None:
        self.target = np.full((rows, 3), np.nan)
        self.on = np.zeros(rows, dtype=bool)
        self._velocity = np.full((rows, 3), np.nan)
        self._body = np.zeros(rows, dtype=bool)
        self._heading = np.full(rows, np.nan)
        self._turn = np.zeros(rows)
        self._received = np.full(rows, -np.inf)
        self._low_level: NDArray[np.bool_] = np.zeros(rows, dtype=bool)

    def command(
        self,
        row: int,
        t: float,
        *,
        target: tuple[float, float, float] = NEITHER,
        velocity: tuple[float, float, float] = NEITHER,
        heading: float = np.nan,
        turn: float = 0.0,
        body: bool = False,
        on: bool = True,
    ) -> None:
        """A low-level setpoint of a row.

        Args:
            row: Whose.
            t: Now [s].
            target: Position [m]; NaN on axes that follow none.
            velocity: [m/s]; NaN on axes that follow none.
            heading: Yaw [rad], or NaN: turn.
            turn: Yaw rate [rad/s].
            body: The velocity is along the axes of the robot.
            on: Motors on.
        """
        self.target[row], self._velocity[row] = target, velocity
        self._heading[row], self._turn[row], self._body[row], self.on[row] = heading, turn, body, on
        self._received[row] = t
        self._low_level[row] = True

    def release(self, row: int) -> None:
        """The client sends no more setpoints: what the planner says counts again, from now on."""
        self._low_level[row] = False

    def follow(self, t: float, goal: Array) -> Mask:
        """Takes in what the planners want (N, 4), NaN for nothing; returns (N,) the rows that listen to them."""
        listening = ~self._low_level
        planned = listening & np.isfinite(goal[:, 0])
        self.target[listening], self._velocity[listening], self._body[listening] = goal[listening, :3], np.nan, False
        self._heading[planned], self._turn[planned] = goal[planned, 3], 0.0
        self.on[listening] = planned[listening]
        self._received[listening] = t
        return listening

    def age(self, t: float) -> Array:
        """(N,) of the setpoints that count [s]."""
        return t - self._received

    def wanted(
        self, position: Array, velocity: Array, yaw: Array, *, level: Mask, gain: Array, turn_gain: float
    ) -> Array:
        """The same as positions and yaws (N, 4), which is what the model of motion takes.

        Args:
            position: (N, 3) where the rows believe to be [m].
            velocity: (N, 3) [m/s].
            yaw: (N,) [rad].
            level: (N,) rows that follow nothing in the horizontal.
            gain: (3,) of the model's position controller [1/s]: a velocity v is the position v / gain ahead.
            turn_gain: Likewise of its yaw controller [1/s].
        """
        cos, sin = np.cos(yaw), np.sin(yaw)
        v, body = self._velocity, self._body
        speed = v.copy()
        speed[:, 0] = np.where(body, cos * v[:, 0] - sin * v[:, 1], v[:, 0])
        speed[:, 1] = np.where(body, sin * v[:, 0] + cos * v[:, 1], v[:, 1])
        target = self.target.copy()
        target[level, :2] = speed[level, :2] = np.nan
        speed = np.where(np.isnan(speed), velocity, speed)  # what follows nothing drifts on
        target = np.where(np.isnan(target), position + speed / gain, target)
        turning = np.isnan(self._heading) | level
        heading = np.where(turning, yaw + np.where(level, 0.0, self._turn) / turn_gain, self._heading)
        near = yaw + (heading - yaw + np.pi) % (2.0 * np.pi) - np.pi
        return np.concatenate([target, near[:, None]], axis=1)
