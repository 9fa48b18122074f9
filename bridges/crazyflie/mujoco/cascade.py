"""Cascade of PID controllers of the Crazyflie firmware (paper, figure 6): position, velocity, attitude, rate, motors.

Written for rows from the firmware's structure, gains and limits. Internal units are degrees and 1/65535 of a motor's
full thrust, because the firmware's gains are in these units; the interface is in SI units.

Left out: the estimators (the true state is given), the gyroscope's low-pass filter of 80 Hz, and the compensation of
the battery's voltage, which makes thrust proportional to the command, as here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from twins.arrays import Array, Index, Mask, any_true, clamp

RATE_HZ: Final = 500.0  # rate of the attitude and rate loops
OUTER: Final = 5  # divisor of the rate for the position and velocity loops: 100 Hz
FULL: Final = 65535.0  # largest command of a motor
TORQUE_LIMIT: Final = 32767.0  # largest output of the rate loops
BASE: Final = 36000.0  # thrust before the vertical loop's output is added: 0.995 of the weight
LEAST: Final = 20000.0
THRUST_SCALE: Final = 1000.0
SPEED: Final = 1.0 * 1.1  # [m/s] speed per axis; the firmware allows its position loop 10 % more than its limit
TILT: Final = 20.0  # [deg]
# motors: front right, back right, back left, front left; share of each in a torque about x, y (nose down) and z
MIX: Final = np.array([[-0.5, -0.5, -1.0], [-0.5, 0.5, 1.0], [0.5, 0.5, -1.0], [0.5, -0.5, 1.0]])


@dataclass(frozen=True)
class Gains:
    """PID gains of three axes, and the limit of the integral."""

    p: tuple[float, float, float]
    i: tuple[float, float, float]
    d: tuple[float, float, float] = (0.0, 0.0, 0.0)
    limit: tuple[float, float, float] = (5000.0, 5000.0, 5000.0)


POSITION: Final = Gains((2.0, 2.0, 2.0), (0.0, 0.0, 0.5))  # m -> m/s
VELOCITY: Final = Gains((25.0, 25.0, 25.0), (1.0, 1.0, 15.0))  # m/s -> deg, deg, thousands of units
ATTITUDE: Final = Gains((6.0, 6.0, 6.0), (3.0, 3.0, 1.0), (0.0, 0.0, 0.35), (20.0, 20.0, 360.0))  # deg -> deg/s
RATE: Final = Gains((250.0, 250.0, 120.0), (500.0, 500.0, 16.7), (2.5, 2.5, 0.0), (33.3, 33.3, 166.7))  # -> units


class Pid:
    """Three PID controllers per row; the derivative acts on the measured value, so setpoint steps cause no kick."""

    def __init__(self, gains: Gains, rows: int, dt: float) -> None:
        self._p, self._i = np.array(gains.p), np.array(gains.i)
        self._d = np.array(gains.d) / dt
        self._differs = bool(any(gains.d))
        self._limit, self._dt = np.array(gains.limit), dt
        self._integral = np.zeros((rows, 3))
        self._before = np.full((rows, 3), np.nan)

    def reset(self, rows: Index | Mask) -> None:
        """Reset rows to the state before the first step."""
        self._integral[rows] = 0.0
        self._before[rows] = np.nan

    def preset(self, rows: Index, output: Array) -> None:
        """Set integrals so that the output without error is (len(rows), 3); zero for axes without integral gain."""
        self._integral[rows] = np.divide(output, self._i, out=np.zeros_like(output), where=self._i != 0.0)

    def advance(self, error: Array, measured: Array) -> Array:
        """Output for (n, 3) errors; `measured` (n, 3) is what the derivative is of."""
        self._integral = clamp(self._integral + self._dt * error, -self._limit, self._limit)
        output = self._p * error + self._i * self._integral
        if self._differs:
            change = measured - self._before
            output = output - self._d * np.where(np.isnan(change), 0.0, change)
            self._before = measured
        return np.asarray(output)


class Firmware:
    """Controller cascades of n quadrotors."""

    def __init__(self, rows: int, dt: float) -> None:
        """`dt`: period of the inner loops [s], 1/RATE_HZ or a divisor of the engine's step."""
        self._position, self._velocity = Pid(POSITION, rows, OUTER * dt), Pid(VELOCITY, rows, OUTER * dt)
        self._attitude, self._rate = Pid(ATTITUDE, rows, dt), Pid(RATE, rows, dt)
        self._thrust = np.full(rows, BASE)
        self.angles = np.zeros((rows, 3))  # roll and pitch setpoints of the velocity loops, and 0 [deg]
        self._tick = 0

    def reset(self, rows: Index | Mask) -> None:
        """Reset rows at the start of their motors."""
        for loop in (self._position, self._velocity, self._attitude, self._rate):
            loop.reset(rows)
        self._thrust[rows], self.angles[rows] = BASE, 0.0

    def preset_hover(self, rows: Index, share: Array) -> None:
        """Initialise rows in hover, with the share (len(rows),) of their motors' full thrust."""
        lift = np.zeros((len(rows), 3))
        lift[:, 2] = (FULL * share - BASE) / THRUST_SCALE
        self._velocity.preset(rows, lift)

    def advance_outer_loops(self, offset: Array, velocity: Array, wanted: Array, by_velocity: Mask, yaw: Array) -> None:
        """Advance the two outer loops on every OUTER-th call.

        Args:
            offset: (n, 3) from the estimated position to the target [m].
            velocity: (n, 3) [m/s].
            wanted: (n, 3) velocity setpoint of rows `by_velocity` [m/s].
            by_velocity: (n,)
            yaw: (n,) [rad].
        """
        self._tick += 1
        if (self._tick - 1) % OUTER:
            return
        cos, sin = np.cos(yaw), np.sin(yaw)
        reference = clamp(self._position.advance(_to_level_frame(offset, cos, sin), offset), -SPEED, SPEED)
        if any_true(by_velocity):
            reference = np.where(by_velocity[:, None], _to_level_frame(wanted, cos, sin), reference)
        moving = _to_level_frame(velocity, cos, sin)
        output = self._velocity.advance(reference - moving, moving)
        # forward is nose down, to the left is left side down
        self.angles = np.stack([-output[:, 1], output[:, 0], np.zeros(len(yaw))], axis=1)
        self.angles = clamp(self.angles, -TILT, TILT)
        lift = clamp(output[:, 2], -0.5 * FULL / THRUST_SCALE, 0.5 * FULL / THRUST_SCALE)
        self._thrust = clamp(BASE + THRUST_SCALE * lift, LEAST, FULL)

    def advance_inner_loops(self, angles: Array, rates: Array, heading: Array) -> Array:
        """Advance the two inner loops and the mixer; returns (n, 4) thrust of each motor as a share of full thrust.

        Args:
            angles: (n, 3) roll, pitch (nose down) and yaw [rad].
            rates: (n, 3) angular velocity in the robot's frame [rad/s].
            heading: (n,) yaw setpoint [rad].
        """
        measured, turning = np.degrees(angles), np.degrees(rates)
        error = self.angles - measured
        error[:, 2] = (np.degrees(heading) - measured[:, 2] + 180.0) % 360.0 - 180.0
        rate = self._attitude.advance(error, measured)
        torque = clamp(self._rate.advance(rate - turning, turning), -TORQUE_LIMIT, TORQUE_LIMIT)
        # no product of matrices: its rounding depends on the number of rows
        roll, pitch, yaw = (torque[:, axis, None] * MIX[:, axis] for axis in range(3))
        motors = self._thrust[:, None] + roll + pitch + yaw
        # at saturation of a motor the torque is kept and the thrust reduced
        excess = np.maximum(motors.max(axis=1) - FULL, 0.0)
        return np.asarray(clamp(motors - excess[:, None], 0.0, FULL) / FULL)


def _to_level_frame(vectors: Array, cos: Array, sin: Array) -> Array:
    """Vectors (n, 3) in the level frame with the robots' yaw."""
    x, y = vectors[:, 0], vectors[:, 1]
    return np.stack([cos * x + sin * y, cos * y - sin * x, vectors[:, 2]], axis=1)
