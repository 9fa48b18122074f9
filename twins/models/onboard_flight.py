"""On-board flight control of quadrotors: setpoints, and autonomous take-offs and landings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from agents.arrays import Array, Index, Mask, every, some
from agents.body.kinds import Kind

CLIMB: Final = 0.4  # [m/s] mean speed of take-offs and landings
SHORTEST_S: Final = 0.5  # duration of a take-off or landing
TOUCHDOWN: Final = 0.02  # [m] a landing robot below this height is down


class OnboardFlight:
    """State, setpoints, take-offs and landings of n quadrotors; subclasses add the motion (`advance`)."""

    def __init__(self, kinds: Sequence[Kind], start: Array, yaw: Array, dt: float) -> None:
        """At rest at `start` (n, 3) [m] with `yaw` (n,) [rad], motors off."""
        rows = len(kinds)
        self._dt = dt
        self.position = np.array(start, dtype=float)  # (n, 3) [m]
        self.velocity = np.zeros_like(self.position)  # (n, 3) [m/s]
        self.yaw = np.array(yaw, dtype=float)  # (n,) [rad]
        self.flying = np.zeros(rows, dtype=bool)  # (n,) motors on
        self._landing = np.zeros(rows, dtype=bool)
        self._by_velocity = np.array([kind.takes == "velocity" for kind in kinds], dtype=bool)
        self._by_position = ~self._by_velocity
        self._any_by_velocity = some(self._by_velocity)
        self._target = self.position.copy()  # (n, 3) position setpoint [m]
        self._yaw_setpoint = self.yaw.copy()
        self._velocity_setpoint = np.zeros((rows, 3))  # of rows `_by_velocity` [m/s]
        self._yaw_rate = np.zeros(rows)  # of rows `_by_velocity` [rad/s]
        self._from = self._target[:, 2].copy()  # take-offs and landings: heights [m], times [s]
        self._to = self._from.copy()
        self._elapsed = np.full(rows, np.inf)
        self._span = np.ones(rows)
        self._any_climbing = False

    def advance(self) -> None:
        """Advance one step of dt."""
        raise NotImplementedError

    def command(self, setpoint: Array) -> None:
        """Set position and yaw, or velocity and yaw rate (n, 4); no effect on rows of NaN, on the ground or landing."""
        unknown = np.isnan(setpoint[:, 0])
        if every(self.flying) and not (self._any_by_velocity or self._any_climbing or some(unknown)):
            self._target[:], self._yaw_setpoint[:] = setpoint[:, :3], setpoint[:, 3]
            return
        given = self.flying & ~(unknown | self._landing)
        position = given & self._by_position
        np.copyto(self._target, setpoint[:, :3], where=position[:, None])
        np.copyto(self._yaw_setpoint, setpoint[:, 3], where=position)
        if self._any_climbing:
            self._elapsed[given] = np.inf
            self._any_climbing = some(self._climbing())
        if self._any_by_velocity:
            velocity = given & self._by_velocity
            np.copyto(self._velocity_setpoint, setpoint[:, :3], where=velocity[:, None])
            np.copyto(self._yaw_rate, setpoint[:, 3], where=velocity)

    def takeoff(self, rows: Index, height: Array) -> None:
        """Start the motors and climb to `height` (len(rows),) [m] at the present place."""
        self.flying[rows] = True
        self._landing[rows] = False
        self._climb(rows, height)

    def land(self, rows: Index) -> None:
        """Descend at the present place, then switch the motors off; a repeated order changes nothing."""
        rows = rows[self.flying[rows] & ~self._landing[rows]]
        self._landing[rows] = True
        self._climb(rows, np.zeros(len(rows)))

    def stop(self, rows: Index) -> None:
        """Switch the motors off: rows in the air fall."""
        self.flying[rows] = False
        self._landing[rows] = False

    def place(self, rows: Index, position: Array, yaw: Array, flying: Mask) -> None:
        """Set positions (len(rows), 3) [m] and yaws [rad], at rest; flying rows hold them."""
        self.position[rows], self.velocity[rows], self.yaw[rows] = position, 0.0, yaw
        self._target[rows], self._yaw_setpoint[rows] = position, yaw
        self._velocity_setpoint[rows], self._yaw_rate[rows] = 0.0, 0.0
        self.flying[rows], self._landing[rows] = flying, False
        self._elapsed[rows] = np.inf
        self._any_climbing = some(self._climbing())

    def _climbing(self) -> Mask:
        """Rows (n,) in a take-off or landing."""
        return np.asarray(np.isfinite(self._elapsed))

    def _climb(self, rows: Index, height: Array) -> None:
        self._target[rows] = self.position[rows]
        self._from[rows], self._to[rows] = self.position[rows, 2], height
        self._elapsed[rows] = 0.0
        self._any_climbing = some(self._climbing())
        self._span[rows] = np.maximum(np.abs(height - self.position[rows, 2]) / CLIMB, SHORTEST_S)

    def _advance_climb(self, climbing: Mask) -> None:
        """Advance the height setpoint of rows `climbing` by one step, on a polynomial without jerk at both ends."""
        self._elapsed += self._dt
        s = np.clip(self._elapsed[climbing] / self._span[climbing], 0.0, 1.0)
        share = s**4 * (35.0 - 84.0 * s + 70.0 * s**2 - 20.0 * s**3)
        self._target[climbing, 2] = self._from[climbing] + share * (self._to[climbing] - self._from[climbing])

    def _touch_down(self) -> None:
        """Switch off the motors of rows whose landing is complete."""
        down = self._landing & (self.position[:, 2] < TOUCHDOWN) & (self._elapsed > self._span)
        self.flying &= ~down
        self._landing &= ~down
