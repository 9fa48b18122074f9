"""High-level commander: trajectories computed on board, polynomials of the 7th order.

Position, velocity and acceleration at both ends are given and the jerk is zero there, which determines one polynomial
per axis (Richter, Bry and Roy, "Polynomial Trajectory Planning for Aggressive Quadrotor Flight", 2016).
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from math import cos, isnan, pi, sin
from typing import Final

import numpy as np

from agents.vectors import Pose, Vector, clamp, wrap
from bridges.crazyflie.protocol.crtp import LogStatus
from twins.arrays import Array

SHORTEST: Final = 0.01  # [s]
ORDER: Final = 7  # degree of the polynomials

Piece = tuple[float, Array]  # duration [s], coefficients (4, ORDER + 1) of x, y, z, yaw, constant first


class PlannerState(IntEnum):
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


def evaluate(coefficients: Array, t: float) -> tuple[Array, Array, Array]:
    """Value, first and second derivative (k,) of polynomials (k, 8) at `t`, by Horner's scheme."""
    value = first = half = np.zeros(len(coefficients))
    for power in coefficients.T[::-1]:
        half = half * t + first
        first = first * t + value
        value = value * t + power
    return value, first, 2.0 * half


class OnboardPlanner:
    """Planner of one drone; a pose is (4,): x, y, z [m], yaw [rad]."""

    def __init__(self) -> None:
        self.plan = PlannerState.IDLE
        self._begin, self._span = 0.0, 1.0  # begin and length of the current piece [s]
        self._coefficients = np.zeros((4, ORDER + 1))
        self._powers: list[list[float]] = []  # the same, of the four axes, highest power first
        self._rest: list[Piece] = []  # pieces after the current one
        self._valid: Pose = (0.0, 0.0, 0.0, 0.0)  # last planned pose

    def climb(self, t: float, pose: Array, *, height: float, yaw: float, span: float, landing: bool) -> LogStatus:
        """Plan a vertical motion to `height` [m]: a landing with motors off at its end, or a take-off.

        A take-off is refused unless idle, a landing while landing.
        """
        possible = self.plan != PlannerState.LANDING if landing else self.plan == PlannerState.IDLE
        if not possible:
            return LogStatus.REFUSED
        span, zero = max(span, SHORTEST), np.zeros(4)
        goal = self._shorter_turn(pose, np.array([pose[0], pose[1], height, yaw]))
        self._start(t, [(span, polynomial(span, (pose, zero, zero), (goal, zero, zero)))])
        self.plan = PlannerState.LANDING if landing else PlannerState.FLYING
        return LogStatus.OK

    def go_to(
        self, t: float, pose: Array, velocity: Vector, *, goal: Array, span: float, relative: bool, linear: bool
    ) -> LogStatus:
        """Plan a motion to the pose `goal`, from the current trajectory or else from `pose` and `velocity`."""
        span = max(span, SHORTEST)
        zero = np.zeros(4)
        speed, acceleration = np.array([*velocity, 0.0]), zero
        if self.plan != PlannerState.IDLE:
            pose, speed, acceleration = self.state(t)
        if relative:
            goal = pose + goal
        goal = self._shorter_turn(pose, goal)
        if linear:
            even = (goal - pose) / span
            ends = (pose, even, zero), (goal, even, zero)
        else:
            ends = (pose, speed, acceleration), (goal, zero, zero)
        self.follow(t, [(span, polynomial(span, *ends))])
        return LogStatus.OK

    def spiral(
        self,
        t: float,
        pose: Array,
        *,
        angle: float,
        radii: tuple[float, float],
        climb: float,
        span: float,
        sideways: bool,
        clockwise: bool,
    ) -> LogStatus:
        """Plan an arc from `pose` around a centre beside it, or ahead of (clockwise) or behind it if `sideways`.

        As in the firmware the arc is one polynomial with the position, velocity and acceleration of the spiral at its
        ends. It is therefore a spiral for angles up to 90° only.

        Args:
            pose: Start (4,).
            angle: Of the arc and of the turn, at most a full circle [rad].
            radii: First and last [m].
            climb: [m].
            span: Duration [s].
            sideways: The nose points to or from the centre instead of along the arc.
            clockwise: Sense.
        """
        span, angle = max(span, SHORTEST), max(-2.0 * pi, min(2.0 * pi, angle))
        first, last = (max(radius, 0.0) for radius in radii)
        rate = (-angle if clockwise else angle) / span
        growth = (last - first) / span
        # direction from the centre to the robot, ahead of its nose by:
        side = (pi if clockwise else 0.0) if sideways else (0.5 * pi if clockwise else -0.5 * pi)
        ends = []
        for radius, yaw in ((first, pose[3]), (last, pose[3] + rate * span)):
            out = np.array([cos(yaw + side), sin(yaw + side)])
            along = np.array([-out[1], out[0]])
            velocity = growth * out + radius * rate * along
            acceleration = 2.0 * growth * rate * along - radius * rate**2 * out
            ends.append(
                (
                    np.array([*(radius * out), 0.0, yaw]),
                    np.array([*velocity, climb / span, rate]),
                    np.array([*acceleration, 0.0, 0.0]),
                )
            )
        (begin, v, a), (end, w, b) = ends
        goal = pose + (end - begin) + [0.0, 0.0, climb, 0.0]
        self.follow(t, [(span, polynomial(span, (pose, v, a), (goal, w, b)))])
        return LogStatus.OK

    def follow(self, t: float, pieces: Sequence[Piece]) -> None:
        """Follow pieces one after the other, then hold the last pose."""
        self._start(t, pieces)
        self.plan = PlannerState.FLYING

    def stop(self) -> None:
        """Drop the plan."""
        self.plan = PlannerState.IDLE

    def finished(self, t: float) -> bool:
        """Whether the plan is at its end, or there is none."""
        return self.plan == PlannerState.IDLE or (not self._rest and t - self._begin >= self._span)

    def goal(self, t: float) -> Pose | None:
        """Current planned pose, None without a plan; after a landing there is none. Quiet: called on every tick.

        NaN in a piece that is not a number: the firmware's planner gives up, and makes no setpoint any more.
        """
        if self.plan == PlannerState.LANDING and self.finished(t):
            self.plan = PlannerState.IDLE
        if self.plan == PlannerState.IDLE:
            return None
        elapsed = self._elapsed(t)
        x = y = z = yaw = 0.0
        for a, b, c, d in self._powers:
            x, y, z, yaw = x * elapsed + a, y * elapsed + b, z * elapsed + c, yaw * elapsed + d
        pose = x, y, z, yaw
        if not isnan(x + y + z + yaw):
            self._valid = pose
        return pose

    def state(self, t: float) -> tuple[Array, Array, Array]:
        """Pose, speed and acceleration (4,) on the plan; at rest after its end, and where the planner gave up."""
        elapsed = self._elapsed(t)
        pose, speed, acceleration = evaluate(self._coefficients, elapsed)
        lost = bool(np.isnan(pose).any())
        if lost:
            pose = np.array(self._valid)
        if lost or elapsed >= self._span:
            speed, acceleration = np.zeros(4), np.zeros(4)
        return pose, speed, acceleration

    def _elapsed(self, t: float) -> float:
        """Time since the begin of the piece that is flown at `t`, or until its end [s]."""
        while self._rest and t - self._begin >= self._span:
            self._start(self._begin + self._span, self._rest)
        return clamp(t - self._begin, 0.0, self._span)

    def _start(self, t: float, pieces: Sequence[Piece]) -> None:
        (self._span, self._coefficients), *self._rest = pieces
        self._begin, self._powers = t, self._coefficients.T[::-1].tolist()

    @staticmethod
    def _shorter_turn(pose: Array, goal: Array) -> Array:
        return np.array([*goal[:3], pose[3] + wrap(goal[3] - pose[3])])
