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


class FlightOrders:
    """Setpoints, take-offs and landings of n quadrotors, independent of the motion model."""

    def __init__(self, kinds: Sequence[Kind], start: Array, yaw: Array, dt: float) -> None:
        rows = len(kinds)
        self._dt = dt
        self.by_velocity = np.array(
            [kind.takes == "velocity" for kind in kinds], dtype=bool
        )  # (n,) kinds with velocities
        self.any_by_velocity = some(self.by_velocity)
        self.flying = np.zeros(rows, dtype=bool)  # (n,) motors on
        self.landing = np.zeros(rows, dtype=bool)  # (n,)
        self.target = np.array(start, dtype=float)  # (n, 3) position setpoint [m]
        self.yaw_setpoint = np.array(yaw, dtype=float)  # (n,) [rad]
        self.velocity_setpoint = np.zeros((rows, 3))  # of rows `by_velocity` [m/s]
        self.yaw_rate = np.zeros(rows)  # of rows `by_velocity` [rad/s]
        self._from = self.target[:, 2].copy()  # take-offs and landings: heights [m], times [s]
        self._to = self._from.copy()
        self._elapsed = np.full(rows, np.inf)
        self._span = np.ones(rows)
        self._by_position = ~self.by_velocity
        self.any_climbing = False

    @property
    def climbing(self) -> Mask:
        """(n,) rows in a take-off or landing."""
        return np.asarray(np.isfinite(self._elapsed))

    def command(self, setpoint: Array) -> None:
        """Set position and yaw, or velocity and yaw rate (n, 4); no effect on rows of NaN, on the ground or landing."""
        unknown = np.isnan(setpoint[:, 0])
        if every(self.flying) and not (self.any_by_velocity or self.any_climbing or some(unknown)):
            self.target[:], self.yaw_setpoint[:] = setpoint[:, :3], setpoint[:, 3]
            return
        given = self.flying & ~(unknown | self.landing)
        position = given & self._by_position
        np.copyto(self.target, setpoint[:, :3], where=position[:, None])
        np.copyto(self.yaw_setpoint, setpoint[:, 3], where=position)
        if self.any_climbing:
            self._elapsed[given] = np.inf
            self.any_climbing = some(self.climbing)
        if self.any_by_velocity:
            velocity = given & self.by_velocity
            np.copyto(self.velocity_setpoint, setpoint[:, :3], where=velocity[:, None])
            np.copyto(self.yaw_rate, setpoint[:, 3], where=velocity)

    def takeoff(self, rows: Index, height: Array, position: Array) -> None:
        """Start the motors and climb to `height` (len(rows),) [m] from `position` (n, 3) [m]."""
        self.flying[rows] = True
        self.landing[rows] = False
        self._climb(rows, height, position)

    def land(self, rows: Index, position: Array) -> None:
        """Descend from `position` (n, 3) [m]; rows that do already go on, however often the order is repeated."""
        rows = rows[self.flying[rows] & ~self.landing[rows]]
        self.landing[rows] = True
        self._climb(rows, np.zeros(len(rows)), position)

    def stop(self, rows: Index) -> None:
        """Switch the motors off."""
        self.flying[rows] = False
        self.landing[rows] = False

    def place(self, rows: Index, position: Array, yaw: Array, flying: Mask) -> None:
        """Reset rows to positions (len(rows), 3) [m] and yaws [rad]; flying rows hold them."""
        self.target[rows], self.yaw_setpoint[rows] = position, yaw
        self.velocity_setpoint[rows], self.yaw_rate[rows] = 0.0, 0.0
        self.flying[rows], self.landing[rows] = flying, False
        self._elapsed[rows] = np.inf
        self.any_climbing = some(self.climbing)

    def advance(self, climbing: Mask) -> None:
        """Advance the height setpoint of rows `climbing` by one step, on a polynomial without jerk at both ends."""
        self._elapsed += self._dt
        s = np.clip(self._elapsed[climbing] / self._span[climbing], 0.0, 1.0)
        share = s**4 * (35.0 - 84.0 * s + 70.0 * s**2 - 20.0 * s**3)
        self.target[climbing, 2] = self._from[climbing] + share * (self._to[climbing] - self._from[climbing])

    def touch_down(self, height: Array) -> None:
        """Switch off the motors of rows whose landing is complete, at `height` (n,) [m]."""
        down = self.landing & (height < TOUCHDOWN) & (self._elapsed > self._span)
        self.flying &= ~down
        self.landing &= ~down

    def _climb(self, rows: Index, height: Array, position: Array) -> None:
        self.target[rows] = position[rows]
        self._from[rows], self._to[rows] = position[rows, 2], height
        self._elapsed[rows] = 0.0
        self.any_climbing = some(self.climbing)
        self._span[rows] = np.maximum(np.abs(height - position[rows, 2]) / CLIMB, SHORTEST_S)


class OnboardFlight:
    """State and orders of n quadrotors, as in `twins.engines.point_mass.Flight`; subclasses add the motion."""

    def __init__(self, kinds: Sequence[Kind], start: Array, yaw: Array, dt: float) -> None:
        """At rest at `start` (n, 3) [m] with `yaw` (n,) [rad], motors off."""
        self._orders = FlightOrders(kinds, start, yaw, dt)
        self.position = np.array(start, dtype=float)  # (n, 3) [m]
        self.velocity = np.zeros_like(self.position)  # (n, 3) [m/s]
        self.yaw = np.array(yaw, dtype=float)  # (n,) [rad]
        self.flying = self._orders.flying  # (n,) motors on

    def command(self, setpoint: Array) -> None:
        self._orders.command(setpoint)

    def takeoff(self, rows: Index, height: Array) -> None:
        """Start the motors and climb to `height` (len(rows),) [m] at the present place."""
        self._orders.takeoff(rows, height, self.position)

    def land(self, rows: Index) -> None:
        """Descend at the present place, then switch the motors off."""
        self._orders.land(rows, self.position)

    def stop(self, rows: Index) -> None:
        """Switch the motors off: rows in the air fall."""
        self._orders.stop(rows)
