"""Quadrotors as point masses under on-board position or velocity control, with limits and lag."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from agents.arrays import Array, Index, Mask, clamp, every, some
from agents.body.kinds import Kind
from agents.decision.position_control import wrap
from twins.models.onboard_flight import TOUCHDOWN, OnboardFlight

GRAVITY: Final = 9.81  # [m/s²]


@dataclass(frozen=True)
class Response:
    """Closed loop on board, for x, y and z."""

    position: tuple[float, float, float]  # gains [1/s]
    velocity: tuple[float, float, float]  # gains [1/s]
    speed: tuple[float, float, float]  # limits [m/s]
    # rate at which the acceleration follows, because the quadrotor must tilt first [1/s]; inf: at once
    tilt: tuple[float, float, float]


RESPONSES: Final[dict[str, Response]] = {
    # fitted to step responses of a rigid body under the firmware's cascade (docs/mujoco.md)
    "crazyflie": Response((2.0, 2.0, 2.8), (5.0, 5.0, 3.5), (1.1, 1.1, 1.4), (5.0, 5.0, math.inf)),
    # a choice: the maker publishes no figures
    "tello": Response((1.0, 1.0, 1.0), (3.0, 3.0, 3.0), (1.0, 1.0, 1.0), (math.inf, math.inf, math.inf)),
}


def linear_step(response: Response, axis: int, dt: float) -> Array:
    """Step (4, 4) of `Quadrotor` within its limits, of position [m], velocity [m/s], its change in a step, and goal."""
    tilt, gain = min(dt * response.tilt[axis], 1.0), dt * response.velocity[axis]
    pull = tilt * gain * response.position[axis]
    place, speed, _, goal = np.eye(4)
    change = np.array([-pull, -tilt * gain, 1.0 - tilt, pull])
    velocity = speed + change
    return np.stack([place + dt * velocity, velocity, change, goal])


class Quadrotor(OnboardFlight):
    """N quadrotors; `position` is that of the on-board controller, without hover jitter."""

    def __init__(self, kinds: Sequence[Kind], start: Array, yaw: Array, dt: float) -> None:
        super().__init__(kinds, start, yaw, dt)
        responses = [RESPONSES[kind.name] for kind in kinds]
        rows = len(responses)
        self._kp = np.array([r.position for r in responses])
        self._gain = dt * np.array([r.velocity for r in responses])  # of a step: k_v dt
        self._speed = np.array([r.speed for r in responses]).reshape(rows, 3)
        self._slowest = -self._speed
        self._tilt = np.minimum(dt * np.array([r.tilt for r in responses]).reshape(rows, 3), 1.0)
        self._rest = 1.0 - self._tilt
        self._change = np.zeros((rows, 3))  # of velocity in a step, with the lag of tilting [m/s]
        self._turn = np.array([kind.turn_response for kind in kinds])
        self._turn_rate = np.array([kind.turn_rate for kind in kinds])

    def place(self, rows: Index, position: Array, yaw: Array, flying: Mask) -> None:
        super().place(rows, position, yaw, flying)
        self._change[rows] = 0.0

    def advance(self) -> None:
        """Advance one step of dt: v_cmd = clip(k_p (target − p), ± limit), a = k_v (v_cmd − v), delayed by tilting."""
        if self._any_climbing:
            self._advance_climb(self._climbing())
        wanted = self._kp * (self._target - self.position)
        turn = self._turn * wrap(self._yaw_setpoint - self.yaw)
        if self._any_by_velocity:
            wanted = np.where((self._by_velocity & ~self._climbing())[:, None], self._velocity_setpoint, wanted)
            turn = np.where(self._by_velocity, self._yaw_rate, turn)
        wanted = clamp(wanted, self._slowest, self._speed)
        turn = np.minimum(np.maximum(turn, -self._turn_rate), self._turn_rate)
        # written as a sum, a row that tilts at once keeps the bits of its change
        self._change = self._rest * self._change + self._tilt * (self._gain * (wanted - self.velocity))
        velocity = self.velocity + self._change
        aloft = every(self.flying)
        if not aloft:
            velocity = np.where(self.flying[:, None], velocity, self._falling())
            turn = np.where(self.flying, turn, 0.0)
            self._change[~self.flying] = 0.0
        self.velocity = velocity
        self.position += self._dt * velocity
        self.yaw = self.yaw + self._dt * turn  # in place, numpy adds one number as a sum: 7 µs more
        if not aloft or some(self._landing):
            self._touch_down()

    def _falling(self) -> Array:
        fall = self.velocity - [0.0, 0.0, GRAVITY * self._dt]
        return np.where((self.position[:, 2] > 0.0)[:, None], fall, 0.0)

    def _touch_down(self) -> None:
        super()._touch_down()
        grounded = ~self.flying & (self.position[:, 2] <= TOUCHDOWN)
        self.position[grounded, 2] = 0.0
        self.velocity[grounded] = 0.0
