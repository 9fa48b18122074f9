"""Vertical motion: the firmware's loops of height and climb rate, and motors that carry a weight.

These loops make a take-off overshoot. The integral of the height is charged while the drone lags behind its plan, on
the floor at first, and must be discharged above the height.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from twins.arrays import Array, Mask, clamp
from twins.engines.crazyflie_cascade import BASE, FULL, LEAST, POSITION, SPEED, THRUST_SCALE, VELOCITY
from twins.models.quadrotor import GRAVITY

MOTOR_S: Final = 0.03  # time constant of the motors
# thrust, of 65,535, that carries the weight which the firmware assumes of each platform: 29 g, and 39.3 g (Brushless
# with guards, both with battery and a deck). The firmware compensates the voltage of the battery.
HOVER: Final = {"crazyflie": 39300.0, "brushless": 31750.0}
BASES: Final = {"crazyflie": BASE, "brushless": 30000.0}  # thrust before the loops' output is added
SLIDES: Final = 0.4  # share of the weight: a robot of which the motors carry more slides over the floor
UP: Final = 2  # axis


class VerticalLoops:
    """Loops of N rows."""

    def __init__(self, platforms: Sequence[str], dt: float) -> None:
        """`platforms` (N) of the firmware; `dt`: period [s]."""
        rows = len(platforms)
        self.hover = np.array([HOVER[each] for each in platforms])  # (N,) thrust that carries the weight
        self.least = np.full(rows, LEAST)  # (N,) least thrust in the air
        self.thrust = np.zeros(rows)  # (N,) of the motors, of 65,535
        self._base = np.array([BASES[each] for each in platforms])
        self._height, self._climb = np.zeros(rows), np.zeros(rows)  # integrals [m s], [m]
        self._dt, self._lag = dt, -np.expm1(-dt / MOTOR_S)

    @property
    def sliding(self) -> Mask:
        """Rows (N,) that slide when they press on the floor, with the least thrust."""
        return np.asarray(self.least > SLIDES * self.hover)

    def advance(self, spinning: Mask, offset: Array, climb: Array, wanted: Array, raw: Array) -> Array:
        """Advance one step; returns vertical accelerations (N,) in the air [m/s²].

        Args:
            spinning: (N,) motors on; the loops of others are reset.
            offset: (N,) from the estimated height to the target [m].
            climb: (N,) estimated climb rate [m/s].
            wanted: (N,) setpoint of the climb rate [m/s]; NaN in rows that follow a height.
            raw: (N,) thrust of rows without loops, of 65,535; NaN in the others. As in the firmware, a change from
                raw thrust to height or climb rate resets the loops.
        """
        self.thrust[~spinning] = 0.0
        looped = spinning & np.isnan(raw)
        self._height[~looped] = self._climb[~looped] = 0.0
        by_height = np.isnan(wanted)
        self._height += self._dt * np.where(looped & by_height, offset, 0.0)
        reference = clamp(POSITION.p[UP] * offset + POSITION.i[UP] * self._height, -SPEED, SPEED)
        error = np.where(by_height, reference, wanted) - climb
        self._climb += self._dt * np.where(looped, error, 0.0)
        lift = THRUST_SCALE * (VELOCITY.p[UP] * error + VELOCITY.i[UP] * self._climb)
        command = clamp(self._base + clamp(lift, -0.5 * FULL, 0.5 * FULL), self.least, FULL)
        command = np.where(np.isnan(raw), command, raw)
        self.thrust += self._lag * np.where(spinning, command - self.thrust, 0.0)
        return np.asarray(GRAVITY * (self.thrust / self.hover - 1.0))
