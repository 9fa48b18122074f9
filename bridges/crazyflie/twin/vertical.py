"""Vertical motion: the firmware's loops of height and climb rate, and motors that carry a weight.

These loops make a take-off overshoot. The integral of the height is charged while the drone lags behind its plan, on
the floor at first, and must be discharged above the height.
"""

from __future__ import annotations

from math import exp
from typing import Final

from agents.vectors import clamp
from bridges.crazyflie.mujoco.cascade import BASE, FULL, LEAST, POSITION, SPEED, THRUST_SCALE, VELOCITY
from twins.models.quadrotor import GRAVITY

MOTOR_S: Final = 0.03  # time constant of the motors
# thrust, of 65,535, that carries the weight which the firmware assumes of each platform: 29 g, and 39.3 g (Brushless
# with guards, both with battery and a deck). The firmware compensates the voltage of the battery.
HOVER: Final = {"crazyflie": 39300.0, "brushless": 31750.0}
BASES: Final = {"crazyflie": BASE, "brushless": 30000.0}  # thrust before the loops' output is added
SLIDES: Final = 0.4  # share of the weight: a robot of which the motors carry more slides over the floor
UP: Final = 2  # axis


class VerticalLoops:
    """Loops of one drone."""

    def __init__(self, platform: str, dt: float) -> None:
        """`platform` of the firmware; `dt`: period [s]."""
        self.least = LEAST  # thrust in the air, of 65,535
        self._hover, self._base = HOVER[platform], BASES[platform]
        self._dt, self._lag = dt, 1.0 - exp(-dt / MOTOR_S)
        self.reset()

    def reset(self) -> None:
        """Motors off."""
        self.thrust = 0.0  # thrust of the motors, of 65,535
        self._height = self._climb = 0.0  # integrals [m s], [m]

    @property
    def sliding(self) -> bool:
        """Whether a drone that presses on the floor slides, with the least thrust."""
        return self.least > SLIDES * self._hover

    def advance(self, offset: float, climb: float, wanted: float | None, raw: float | None) -> float:
        """Advance one step with motors on; returns the vertical acceleration in the air [m/s²].

        Args:
            offset: From the estimated height to the target [m].
            climb: Estimated climb rate [m/s].
            wanted: Setpoint of the climb rate [m/s]; None: follow the height.
            raw: Thrust without loops, of 65,535; None: by the loops. As in the firmware, a change from raw thrust to
                height or climb rate resets the loops.
        """
        if raw is not None:
            self._height = self._climb = 0.0
            command = raw
        else:
            if wanted is None:
                self._height += self._dt * offset
                wanted = clamp(POSITION.p[UP] * offset + POSITION.i[UP] * self._height, -SPEED, SPEED)
            error = wanted - climb
            self._climb += self._dt * error
            lift = THRUST_SCALE * (VELOCITY.p[UP] * error + VELOCITY.i[UP] * self._climb)
            command = clamp(self._base + clamp(lift, -0.5 * FULL, 0.5 * FULL), self.least, FULL)
        self.thrust += self._lag * (command - self.thrust)
        return GRAVITY * (self.thrust / self._hover - 1.0)
