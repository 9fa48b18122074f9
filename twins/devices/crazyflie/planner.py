"""High-level commander: trajectories computed on board, polynomials of the 7th order.

Position, velocity and acceleration at both ends are given and the jerk is zero there, which determines one polynomial
per axis (Richter, Bry and Roy, "Polynomial Trajectory Planning for Aggressive Quadrotor Flight", 2016).
"""

from __future__ import annotations

from enum import IntEnum
from math import pi

import numpy as np
from numpy.typing import NDArray

from agents.arrays import Array, Mask
from agents.protocols.crtp import Status

SHORTEST = 0.01  # [s]


class Plan(IntEnum):
    """State of a planner."""

    IDLE = 0
    FLYING = 1
    LANDING = 2


def polynomial(span: float, begin: tuple[Array, Array, Array], end: tuple[Array, Array, Array]) -> Array:
    """Coefficients (k, 8), constant first, from position, velocity, acceleration (k,) at ends `span` [s] apart."""
    (p, v, a), (q, w, b) = begin, end
    d = q - (p + v * span + 0.5 * a * span**2)
    dv = (w - (v + a * span)) * span
    da = (b - a) * span**2
    return np.stack(
        [
            p,
            v,
            0.5 * a,
            np.zeros_like(p),
            (35.0 * d - 15.0 * dv + 2.5 * da) / span**4,
            (-84.0 * d + 39.0 * dv - 7.0 * da) / span**5,
            (70.0 * d - 34.0 * dv + 6.5 * da) / span**6,
            (-20.0 * d + 10.0 * dv - 2.0 * da) / span**7,
        ],
        axis=-1,
    )


def evaluate(coefficients: Array, t: Array) -> tuple[Array, Array, Array]:
    """Value, first and second derivative of polynomials (..., 8) at `t` (...), by Horner's scheme."""
    value = first = half = np.zeros(np.broadcast_shapes(coefficients.shape[:-1], np.shape(t)))
    for k in range(coefficients.shape[-1] - 1, -1, -1):
        half = half * t + first
        first = first * t + value
        value = value * t + coefficients[..., k]
    return value, first, 2.0 * half


class Planner:
    """Planners of N rows; a pose is (4,): x, y, z [m], yaw [rad]."""

    def __init__(self, rows: int) -> None:
        self.plan: NDArray[np.int8] = np.zeros(rows, dtype=np.int8)  # (N,) `Plan` of each row
        self._begin = np.zeros(rows)
        self._span = np.ones(rows)
        self._coefficients = np.zeros((rows, 4, 8))

    def takeoff(self, row: int, t: float, pose: Array, *, height: float, yaw: float, span: float) -> Status:
        """Plan a vertical motion to `height` [m]; refused unless idle."""
        if self.plan[row] != Plan.IDLE:
            return Status.REFUSED
        self._vertical(row, t, pose, height=height, yaw=yaw, span=span)
        self.plan[row] = Plan.FLYING
        return Status.OK

    def land(self, row: int, t: float, pose: Array, *, height: float, yaw: float, span: float) -> Status:
        """Plan a vertical motion to `height` [m], then motors off; refused while landing."""
        if self.plan[row] == Plan.LANDING:
            return Status.REFUSED
        self._vertical(row, t, pose, height=height, yaw=yaw, span=span)
        self.plan[row] = Plan.LANDING
        return Status.OK

    def go_to(
        self,
        row: int,
        t: float,
        pose: Array,
        velocity: Array,
        *,
        goal: Array,
        span: float,
        relative: bool,
        linear: bool,
    ) -> Status:
        """Plan a motion to the pose `goal`, from the current trajectory or else from `pose` and `velocity` (3,)."""
        span = max(span, SHORTEST)
        zero = np.zeros(4)
        speed, acceleration = np.append(velocity, 0.0), zero
        if self.plan[row] != Plan.IDLE:
            pose, speed, acceleration = self._state(row, t)
        if relative:
            goal = pose + goal
        goal = self._shorter_turn(pose, goal)
        if linear:
            even = (goal - pose) / span
            ends = (pose, even, zero), (goal, even, zero)
        else:
            ends = (pose, speed, acceleration), (goal, zero, zero)
        self._start(row, t, span, polynomial(span, *ends))
        self.plan[row] = Plan.FLYING
        return Status.OK

    def stop(self, row: int) -> None:
        """Drop the plan of a row."""
        self.plan[row] = Plan.IDLE

    def finished(self, t: float) -> Mask:
        """Rows (N,) at the end of their plan, or without one."""
        return np.asarray((self.plan == Plan.IDLE) | (t - self._begin >= self._span))

    def goal(self, t: float) -> Array:
        """Current planned poses (N, 4), NaN for idle rows; a row that has landed becomes idle."""
        self.plan[(self.plan == Plan.LANDING) & (t - self._begin >= self._span)] = Plan.IDLE
        elapsed = np.clip(t - self._begin, 0.0, self._span)
        pose, _, _ = evaluate(self._coefficients, elapsed[:, None])
        return np.asarray(np.where((self.plan == Plan.IDLE)[:, None], np.nan, pose))

    def _state(self, row: int, t: float) -> tuple[Array, Array, Array]:
        """Pose, speed and acceleration (4,) on the plan of a row; at rest after the end of the plan."""
        elapsed = t - self._begin[row]
        pose, speed, acceleration = evaluate(self._coefficients[row], np.clip(elapsed, 0.0, self._span[row]))
        if elapsed >= self._span[row]:
            speed, acceleration = np.zeros(4), np.zeros(4)
        return pose, speed, acceleration

    def _vertical(self, row: int, t: float, pose: Array, *, height: float, yaw: float, span: float) -> None:
        span, zero = max(span, SHORTEST), np.zeros(4)
        goal = self._shorter_turn(pose, np.array([pose[0], pose[1], height, yaw]))
        self._start(row, t, span, polynomial(span, (pose, zero, zero), (goal, zero, zero)))

    def _start(self, row: int, t: float, span: float, coefficients: Array) -> None:
        self._begin[row], self._span[row], self._coefficients[row] = t, span, coefficients

    @staticmethod
    def _shorter_turn(pose: Array, goal: Array) -> Array:
        """Goal with the yaw of the shorter turn."""
        turn = (goal[3] - pose[3] + pi) % (2.0 * pi) - pi
        return np.array([*goal[:3], pose[3] + turn])
