"""What flying robots were told: setpoints, and the climbs and landings that they then make by themselves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from agents.arrays import Array, Index, Mask, every, some
from agents.body.kinds import Kind

CLIMB: Final = 0.4  # [m/s] mean speed of take-offs and landings
SHORTEST_S: Final = 0.5  # of them
TOUCHDOWN: Final = 0.02  # [m] lower than this a landing robot is down


class Pilot:
    """The orders of rows of quadrotors, whatever then moves them.

    Attributes:
        flying: (n,) motors on.
        target: (n, 3) position to go to [m].
        heading: (n,) yaw to turn to [rad].
        wanted: (n, 3) velocity of rows that take one [m/s].
        yaw_rate: (n,) of rows that take a velocity [rad/s].
        by_velocity: (n,) rows that take a velocity.
        any_by_velocity: Whether there are any.
        anybody_climbs: Whether a row moves vertically by itself.
        landing: (n,) on their way down.
    """

    def __init__(self, kinds: Sequence[Kind], start: Array, yaw: Array, dt: float) -> None:
        rows = len(kinds)
        self._dt = dt
        self.by_velocity = np.array([kind.takes == "velocity" for kind in kinds], dtype=bool)
        self.any_by_velocity = some(self.by_velocity)
        self.flying = np.zeros(rows, dtype=bool)
        self.landing = np.zeros(rows, dtype=bool)
        self.target = np.array(start, dtype=float)
        self.heading = np.array(yaw, dtype=float)
        self.wanted = np.zeros((rows, 3))
        self.yaw_rate = np.zeros(rows)
        self._from = self.target[:, 2].copy()  # vertical moves that a row makes by itself
        self._to = self._from.copy()
        self._elapsed = np.full(rows, np.inf)
        self._span = np.ones(rows)
        self._by_position = ~self.by_velocity
        self.anybody_climbs = False

    @property
    def climbing(self) -> Mask:
        """(n,) rows that move vertically by themselves, up or down."""
        return np.asarray(np.isfinite(self._elapsed))

    def command(self, setpoint: Array) -> None:
        """Position and yaw, or velocity and yaw rate (n, 4); rows of NaN, on the ground or landing keep theirs."""
        given = self.flying & ~(np.isnan(setpoint[:, 0]) | self.landing)
        position = given & self._by_position
        if every(position):
            self.target[:], self.heading[:] = setpoint[:, :3], setpoint[:, 3]
        else:
            np.copyto(self.target, setpoint[:, :3], where=position[:, None])
            np.copyto(self.heading, setpoint[:, 3], where=position)
        if self.anybody_climbs:
            self._elapsed[given] = np.inf
            self.anybody_climbs = some(self.climbing)
        if self.any_by_velocity:
            velocity = given & self.by_velocity
            np.copyto(self.wanted, setpoint[:, :3], where=velocity[:, None])
            np.copyto(self.yaw_rate, setpoint[:, 3], where=velocity)

    def takeoff(self, rows: Index, height: Array, position: Array) -> None:
        """Motors on, and up to `height` (len(rows),) [m] over where the rows are, `position` (n, 3) [m]."""
        self.flying[rows] = True
        self.landing[rows] = False
        self._climb(rows, height, position)

    def land(self, rows: Index, position: Array) -> None:
        """Down from where the rows are, `position` (n, 3) [m]."""
        rows = rows[self.flying[rows]]
        self.landing[rows] = True
        self._climb(rows, np.zeros(len(rows)), position)

    def stop(self, rows: Index) -> None:
        """Motors off."""
        self.flying[rows] = False
        self.landing[rows] = False

    def place(self, rows: Index, position: Array, yaw: Array, flying: Mask) -> None:
        """Rows were put at (len(rows), 3) [m] with yaw [rad]; those that fly hold that place."""
        self.target[rows], self.heading[rows] = position, yaw
        self.wanted[rows], self.yaw_rate[rows] = 0.0, 0.0
        self.flying[rows], self.landing[rows] = flying, False
        self._elapsed[rows] = np.inf
        self.anybody_climbs = some(self.climbing)

    def advance(self, climbing: Mask) -> None:
        """One step of dt of the rows `climbing`: their target moves by a polynomial, without jerk at both ends."""
        self._elapsed += self._dt
        s = np.clip(self._elapsed[climbing] / self._span[climbing], 0.0, 1.0)
        share = s**4 * (35.0 - 84.0 * s + 70.0 * s**2 - 20.0 * s**3)
        self.target[climbing, 2] = self._from[climbing] + share * (self._to[climbing] - self._from[climbing])

    def touch_down(self, height: Array) -> None:
        """Motors of rows off whose landing is over, at `height` (n,) [m]."""
        down = self.landing & (height < TOUCHDOWN) & (self._elapsed > self._span)
        self.flying &= ~down
        self.landing &= ~down

    def _climb(self, rows: Index, height: Array, position: Array) -> None:
        self.target[rows] = position[rows]
        self._from[rows], self._to[rows] = position[rows, 2], height
        self._elapsed[rows] = 0.0
        self.anybody_climbs = some(self.climbing)
        self._span[rows] = np.maximum(np.abs(height - position[rows, 2]) / CLIMB, SHORTEST_S)


class Piloted:
    """Rows of quadrotors under a pilot: the orders of `twins.engines.point_mass.Flight`; what moves the rows adds the
    motion.

    Attributes:
        position: (n, 3) [m].
        velocity: (n, 3) [m/s].
        yaw: (n,) [rad].
        flying: (n,) motors on.
    """

    def __init__(self, kinds: Sequence[Kind], start: Array, yaw: Array, dt: float) -> None:
        """At rest at `start` (n, 3) [m] with `yaw` (n,) [rad], motors off."""
        self._pilot = Pilot(kinds, start, yaw, dt)
        self.position = np.array(start, dtype=float)
        self.velocity = np.zeros_like(self.position)
        self.yaw = np.array(yaw, dtype=float)
        self.flying = self._pilot.flying

    def command(self, setpoint: Array) -> None:
        """Position and yaw, or velocity and yaw rate (n, 4); rows of NaN, on the ground or landing keep theirs."""
        self._pilot.command(setpoint)

    def takeoff(self, rows: Index, height: Array) -> None:
        """Motors on, and up to `height` (len(rows),) [m] over the present place."""
        self._pilot.takeoff(rows, height, self.position)

    def land(self, rows: Index) -> None:
        """Down over the present place, then motors off."""
        self._pilot.land(rows, self.position)

    def stop(self, rows: Index) -> None:
        """Motors off: what is in the air falls."""
        self._pilot.stop(rows)
