"""The Crazyflie firmware's cascade of PID controllers (paper, figure 6): position, velocity, attitude, rate, motors.

Written anew for rows, from its structure, gains and limits. Inside it is in degrees and in 1/65535 of a motor's full
thrust, because the firmware's gains are: they would not be recognised in other units. Seen from outside it is SI.

What is left out: the estimators (it is given the true state), the gyroscope's low-pass filter of 80 Hz, and the
compensation of the battery's voltage, which is there to make thrust proportional to the command, as it is here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from agents.arrays import Array, Index, Mask, clamp, some

RATE_HZ: Final = 500.0  # of the attitude and rate loops
OUTER: Final = 5  # the position and velocity loops are that much slower: 100 Hz
FULL: Final = 65535.0  # of a motor
TORQUE_LIMIT: Final = 32767.0  # of the rate loops' output
BASE: Final = 36000.0  # thrust to which the vertical loop adds: 0.995 of the weight
LEAST: Final = 20000.0
THRUST_SCALE: Final = 1000.0
SPEED: Final = 1.0 * 1.1  # [m/s] per axis; the firmware leaves its position loop a tenth more than its limit
TILT: Final = 20.0  # [deg]
# motors: front right, back right, back left, front left; how much each adds to a torque about x, y (nose down) and z
MIX: Final = np.array([[-0.5, -0.5, -1.0], [-0.5, 0.5, 1.0], [0.5, 0.5, -1.0], [0.5, -0.5, 1.0]])


@dataclass(frozen=True)
class Gains:
    """Of three axes: proportional, integral, derivative, and the limit of the integral."""

    p: tuple[float, float, float]
    i: tuple[float, float, float]
    d: tuple[float, float, float] = (0.0, 0.0, 0.0)
    limit: tuple[float, float, float] = (5000.0, 5000.0, 5000.0)


POSITION: Final = Gains((2.0, 2.0, 2.0), (0.0, 0.0, 0.5))  # m -> m/s
VELOCITY: Final = Gains((25.0, 25.0, 25.0), (1.0, 1.0, 15.0))  # m/s -> deg, deg, thousands of units
ATTITUDE: Final = Gains((6.0, 6.0, 6.0), (3.0, 3.0, 1.0), (0.0, 0.0, 0.35), (20.0, 20.0, 360.0))  # deg -> deg/s
RATE: Final = Gains((250.0, 250.0, 120.0), (500.0, 500.0, 16.7), (2.5, 2.5, 0.0), (33.3, 33.3, 166.7))  # -> units


class Pid:
    """Three PID controllers of each row; the derivative is of the measured value: setpoints do not kick."""

    def __init__(self, gains: Gains, rows: int, dt: float) -> None:
        self._p, self._i = np.array(gains.p), np.array(gains.i)
        self._d = np.array(gains.d) / dt
        self._differs = bool(any(gains.d))
        self._limit, self._dt = np.array(gains.limit), dt
        self._integral = np.zeros((rows, 3))
        self._before = np.full((rows, 3), np.nan)

    def reset(self, rows: Index | Mask) -> None:
        """As at the first step."""
        self._integral[rows] = 0.0
        self._before[rows] = np.nan

    def preset(self, rows: Index, output: Array) -> None:
        """Integrals of rows that give (len(rows), 3) without any error; of axes without an integral, zero."""
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
    """The cascades of rows of quadrotors.

    Attributes:
        tilt: (n, 2) roll and pitch that the velocity loops ask for [rad].
    """

    def __init__(self, rows: int, dt: float) -> None:
        """`dt` is the period of `motors` [s]: 1/RATE_HZ, or what divides the engine's step."""
        self._position, self._velocity = Pid(POSITION, rows, OUTER * dt), Pid(VELOCITY, rows, OUTER * dt)
        self._attitude, self._rate = Pid(ATTITUDE, rows, dt), Pid(RATE, rows, dt)
        self._thrust = np.full(rows, BASE)
        self._angles = np.zeros((rows, 3))
        self._tick = 0

    @property
    def tilt(self) -> Array:
        """See the class."""
        return np.radians(self._angles[:, :2])

    def reset(self, rows: Index | Mask) -> None:
        """Rows whose motors begin to turn."""
        for loop in (self._position, self._velocity, self._attitude, self._rate):
            loop.reset(rows)
        self._thrust[rows], self._angles[rows] = BASE, 0.0

    def trim(self, rows: Index, share: Array) -> None:
        """Rows that hover already, with (len(rows),) of their motors' full thrust."""
        lift = np.zeros((len(rows), 3))
        lift[:, 2] = (FULL * share - BASE) / THRUST_SCALE
        self._velocity.preset(rows, lift)

    def guide(self, offset: Array, velocity: Array, wanted: Array, by_velocity: Mask, yaw: Array) -> None:
        """The two outer loops, on every OUTER-th call.

        Args:
            offset: (n, 3) from where a row believes to be to its target [m].
            velocity: (n, 3) [m/s].
            wanted: (n, 3) velocity that rows `by_velocity` fly at instead [m/s].
            by_velocity: (n,)
            yaw: (n,) [rad].
        """
        self._tick += 1
        if (self._tick - 1) % OUTER:
            return
        cos, sin = np.cos(yaw), np.sin(yaw)
        reference = clamp(self._position.advance(_turned(offset, cos, sin), offset), -SPEED, SPEED)
        if some(by_velocity):
            reference = np.where(by_velocity[:, None], _turned(wanted, cos, sin), reference)
        moving = _turned(velocity, cos, sin)
        output = self._velocity.advance(reference - moving, moving)
        # forward is nose down, to the left is left side down
        self._angles = np.stack([-output[:, 1], output[:, 0], np.zeros(len(yaw))], axis=1)
        self._angles = clamp(self._angles, -TILT, TILT)
        lift = clamp(output[:, 2], -0.5 * FULL / THRUST_SCALE, 0.5 * FULL / THRUST_SCALE)
        self._thrust = clamp(BASE + THRUST_SCALE * lift, LEAST, FULL)

    def motors(self, angles: Array, rates: Array, heading: Array) -> Array:
        """The two inner loops and the mixer: (n, 4) thrust of each motor as a share of its full thrust.

        Args:
            angles: (n, 3) roll, pitch (nose down) and yaw [rad].
            rates: (n, 3) angular velocity in the robot's frame [rad/s].
            heading: (n,) yaw to turn to [rad].
        """
        measured, turning = np.degrees(angles), np.degrees(rates)
        error = self._angles - measured
        error[:, 2] = (np.degrees(heading) - measured[:, 2] + 180.0) % 360.0 - 180.0
        rate = self._attitude.advance(error, measured)
        torque = clamp(self._rate.advance(rate - turning, turning), -TORQUE_LIMIT, TORQUE_LIMIT)
        # no product of matrices: its rounding depends on the number of rows
        roll, pitch, yaw = (torque[:, axis, None] * MIX[:, axis] for axis in range(3))
        motors = self._thrust[:, None] + roll + pitch + yaw
        # the torque is kept and the thrust given up where a motor can do no more
        excess = np.maximum(motors.max(axis=1) - FULL, 0.0)
        return np.asarray(clamp(motors - excess[:, None], 0.0, FULL) / FULL)


def _turned(vectors: Array, cos: Array, sin: Array) -> Array:
    """(n, 3) in the frame that is turned with the robots, and level."""
    x, y = vectors[:, 0], vectors[:, 1]
    return np.stack([cos * x + sin * y, cos * y - sin * x, vectors[:, 2]], axis=1)
