"""The commander: selects the setpoint that has priority, and converts it to a setpoint of the motion model."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from twins.arrays import Array, Mask
from twins.models.quadrotor import GRAVITY

STEEPEST: Final = np.radians(20.0)  # the firmware's default limit of roll and pitch
NEITHER: Final = (np.nan, np.nan, np.nan)


class Commander:
    """Setpoints of N rows: each axis of a row follows a position, a velocity, or nothing.

    A low-level setpoint has priority over the planner for ever, unless the client announces the end of its setpoints.
    """

    def __init__(self, rows: int) -> None:
        self.target = np.full((rows, 3), np.nan)  # position setpoints [m], NaN on axes without one
        self.thrust = np.full(rows, np.nan)  # raw thrust instead of vertical setpoints, of 65,535; NaN without one
        self.on = np.zeros(rows, dtype=bool)  # motors requested
        self._velocity = np.full((rows, 3), np.nan)
        self._body = np.zeros(rows, dtype=bool)
        self._heading = np.full(rows, np.nan)
        self._turn = np.zeros(rows)
        self._lean = np.zeros((rows, 2))  # acceleration along the axes of the robot, on axes without setpoint [m/s²]
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
        lean: tuple[float, float] = (0.0, 0.0),
        thrust: float = np.nan,
        on: bool = True,
    ) -> None:
        """Set a low-level setpoint.

        Args:
            target: Position [m]; NaN on axes without one.
            velocity: [m/s]; NaN on axes without one.
            heading: Yaw [rad], or NaN: use `turn`.
            turn: Yaw rate [rad/s].
            body: Velocity along the axes of the robot.
            lean: Roll to the right and pitch nose up [rad]; they count on axes without setpoint.
            thrust: Raw thrust, of 65,535; it counts without a vertical setpoint.
            on: Motors on.
        """
        self.target[row], self._velocity[row], self.thrust[row] = target, velocity, thrust
        self._heading[row], self._turn[row], self._body[row], self.on[row] = heading, turn, body, on
        roll, pitch = np.clip(lean, -STEEPEST, STEEPEST)
        self._lean[row] = -GRAVITY * np.tan([pitch, roll])
        self._received[row] = t
        self._low_level[row] = True

    def stop(self, row: int) -> None:
        """Forget the setpoint of a row: motors off."""
        self.on[row] = self._low_level[row] = False

    def release(self, row: int) -> None:
        """End the client's setpoints: the planner's setpoints count again."""
        self._low_level[row] = False

    def take_planned(self, t: float, goal: Array) -> Mask:
        """Use the planners' setpoints (N, 4), NaN for none; returns the rows (N,) without low-level setpoints."""
        listening = ~self._low_level
        planned = listening & np.isfinite(goal[:, 0])
        self.target[listening], self._velocity[listening], self._body[listening] = goal[listening, :3], np.nan, False
        self._lean[listening], self.thrust[listening] = 0.0, np.nan
        self._heading[planned], self._turn[planned] = goal[planned, 3], 0.0
        self.on[listening] = planned[listening]
        self._received[listening] = t
        return listening

    def setpoint_age(self, t: float) -> Array:
        """Age (N,) of the current setpoints [s]."""
        return t - self._received

    def model_setpoint(
        self,
        position: Array,
        velocity: Array,
        yaw: Array,
        *,
        level: Mask,
        gain: Array,
        speed_gain: float,
        turn_gain: float,
    ) -> Array:
        """Setpoints as positions and yaws (N, 4), the input of the motion model.

        Args:
            position: (N, 3) estimated positions [m].
            velocity: (N, 3) [m/s].
            yaw: (N,) [rad].
            level: (N,) rows without horizontal setpoint.
            gain: (3,) of the model's position controller [1/s]: a velocity v is the position v / gain ahead.
            speed_gain: Of its horizontal velocity controller [1/s]: an acceleration a is a / speed_gain faster.
            turn_gain: Likewise of its yaw controller [1/s].
        """
        cos, sin = np.cos(yaw), np.sin(yaw)
        v, body = self._velocity, self._body
        speed = v.copy()
        speed[:, 0] = np.where(body, cos * v[:, 0] - sin * v[:, 1], v[:, 0])
        speed[:, 1] = np.where(body, sin * v[:, 0] + cos * v[:, 1], v[:, 1])
        target = self.target.copy()
        target[level, :2] = speed[level, :2] = np.nan
        free = velocity.copy()  # axes without setpoint keep their velocity, or lean
        lean = np.where(level[:, None], 0.0, self._lean) / speed_gain
        free[:, 0] += cos * lean[:, 0] - sin * lean[:, 1]
        free[:, 1] += sin * lean[:, 0] + cos * lean[:, 1]
        speed = np.where(np.isnan(speed), free, speed)
        target = np.where(np.isnan(target), position + speed / gain, target)
        turning = np.isnan(self._heading) | level
        heading = np.where(turning, yaw + np.where(level, 0.0, self._turn) / turn_gain, self._heading)
        near = yaw + (heading - yaw + np.pi) % (2.0 * np.pi) - np.pi
        return np.concatenate([target, near[:, None]], axis=1)
