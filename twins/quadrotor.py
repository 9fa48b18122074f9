"""Flying robots as their users see them: position or velocity control on board, with limits and lag."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from agents.kinds import Kind
from agents.rows import Array, Index, Mask, clamp, every, some

GRAVITY: Final = 9.81  # [m/s²]
CLIMB: Final = 0.4  # [m/s] mean speed of take-offs and landings
TOUCHDOWN: Final = 0.02  # [m] lower than this a landing robot is down


@dataclass(frozen=True)
class Response:
    """Closed loop on board: position and velocity gains (x, y, z) [1/s], speed limit per axis [m/s]."""

    position: tuple[float, float, float]
    velocity: tuple[float, float, float]
    speed: float


RESPONSES: Final[dict[str, Response]] = {
    # fitted to the firmware's planner, cascaded PID and a rigid body: 0.06 m rms on manoeuvres of 2.3 m/s
    "crazyflie": Response((2.0, 2.0, 2.5), (3.5, 3.5, 4.0), 1.0),
    # a choice: the maker publishes no figures
    "tello": Response((1.0, 1.0, 1.0), (3.0, 3.0, 3.0), 1.0),
}


class Quadrotor:
    """Rows of quadrotors.

    Attributes:
        position: (n, 3) where the on-board controller has them [m].
        velocity: (n, 3) [m/s].
        yaw: (n,) [rad].
        flying: (n,) motors on.
    """

    def __init__(self, kinds: Sequence[Kind], start: Array, yaw: Array, dt: float) -> None:
        responses = [RESPONSES[kind.name] for kind in kinds]
        rows = len(responses)
        self._dt = dt
        self._kp = np.array([r.position for r in responses])
        self._gain = dt * np.array([r.velocity for r in responses])  # of a step: k_v dt
        self._speed = np.array([[r.speed] * 3 for r in responses]).reshape(rows, 3)
        self._by_velocity = np.array([kind.takes == "velocity" for kind in kinds], dtype=bool)
        self._any_by_velocity = some(self._by_velocity)
        self._turn = np.array([kind.turn_response for kind in kinds])
        self.position = np.array(start, dtype=float)
        self.velocity = np.zeros_like(self.position)
        self.yaw = np.array(yaw, dtype=float)
        self.flying = np.zeros(rows, dtype=bool)
        self._target = self.position.copy()
        self._wanted = np.zeros((rows, 3))  # velocity setpoint of rows that take one
        self._heading = self.yaw.copy()
        self._yaw_rate = np.zeros(rows)
        self._from = self.position[:, 2].copy()  # vertical moves that a row makes by itself
        self._to = self._from.copy()
        self._elapsed = np.full(rows, np.inf)
        self._span = np.ones(rows)
        self._landing = np.zeros(rows, dtype=bool)

    def command(self, setpoint: Array) -> None:
        """Position and yaw, or velocity and yaw rate (n, 4); rows of NaN, on the ground or landing keep theirs."""
        given = self.flying & ~(np.isnan(setpoint[:, 0]) | self._landing)
        position = given & ~self._by_velocity
        np.copyto(self._target, setpoint[:, :3], where=position[:, None])
        np.copyto(self._heading, setpoint[:, 3], where=position)
        self._elapsed[given] = np.inf
        if self._any_by_velocity:
            velocity = given & self._by_velocity
            np.copyto(self._wanted, setpoint[:, :3], where=velocity[:, None])
            np.copyto(self._yaw_rate, setpoint[:, 3], where=velocity)

    def takeoff(self, rows: Index, height: Array) -> None:
        """Motors on, and up to `height` (len(rows),) [m] over the present place."""
        self.flying[rows] = True
        self._landing[rows] = False
        self._climb(rows, height)

    def land(self, rows: Index) -> None:
        """Down over the present place, then motors off."""
        rows = rows[self.flying[rows]]
        self._landing[rows] = True
        self._climb(rows, np.zeros(len(rows)))

    def stop(self, rows: Index) -> None:
        """Motors off: what is in the air falls."""
        self.flying[rows] = False
        self._landing[rows] = False

    def place(self, rows: Index, position: Array, yaw: Array, flying: Mask) -> None:
        """Puts rows at (len(rows), 3) [m] with yaw [rad], at rest; those that fly hold that place."""
        self.position[rows], self._target[rows], self.velocity[rows] = position, position, 0.0
        self.yaw[rows], self._heading[rows] = yaw, yaw
        self._wanted[rows], self._yaw_rate[rows] = 0.0, 0.0
        self.flying[rows], self._landing[rows] = flying, False
        self._elapsed[rows] = np.inf

    def advance(self) -> None:
        """One step of dt: v_cmd = clip(k_p (target − p), ± limit), a = k_v (v_cmd − v)."""
        climbing = np.isfinite(self._elapsed)
        if some(climbing):
            self._ramp(climbing)
        wanted = self._kp * (self._target - self.position)
        turn = self._turn * (self._heading - self.yaw)
        if self._any_by_velocity:
            wanted = np.where((self._by_velocity & ~climbing)[:, None], self._wanted, wanted)
            turn = np.where(self._by_velocity, self._yaw_rate, turn)
        wanted = clamp(wanted, -self._speed, self._speed)
        velocity = self.velocity + self._gain * (wanted - self.velocity)
        aloft = every(self.flying)
        if not aloft:
            velocity = np.where(self.flying[:, None], velocity, self._falling())
            turn = np.where(self.flying, turn, 0.0)
        self.velocity = velocity
        self.position += self._dt * velocity
        self.yaw += self._dt * turn
        if not aloft or some(self._landing):
            self._touch_down()

    def _climb(self, rows: Index, height: Array) -> None:
        self._target[rows] = self.position[rows]
        self._from[rows], self._to[rows] = self.position[rows, 2], height
        self._elapsed[rows] = 0.0
        self._span[rows] = np.maximum(np.abs(height - self.position[rows, 2]) / CLIMB, 0.5)

    def _ramp(self, climbing: Mask) -> None:
        """Vertical target of rows that climb or sink by themselves: a polynomial, without jerk at both ends."""
        self._elapsed += self._dt
        s = np.clip(self._elapsed[climbing] / self._span[climbing], 0.0, 1.0)
        share = s**4 * (35.0 - 84.0 * s + 70.0 * s**2 - 20.0 * s**3)
        self._target[climbing, 2] = self._from[climbing] + share * (self._to[climbing] - self._from[climbing])

    def _falling(self) -> Array:
        fall = self.velocity - [0.0, 0.0, GRAVITY * self._dt]
        return np.where((self.position[:, 2] > 0.0)[:, None], fall, 0.0)

    def _touch_down(self) -> None:
        down = self._landing & (self.position[:, 2] < TOUCHDOWN) & (self._elapsed > self._span)
        self.flying &= ~down
        self._landing &= ~down
        grounded = ~self.flying & (self.position[:, 2] <= TOUCHDOWN)
        self.position[grounded, 2] = 0.0
        self.velocity[grounded] = 0.0
