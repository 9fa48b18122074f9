"""Quadrotor as a point mass under on-board position or velocity control, with limits and lag; `move` is quiet."""

from __future__ import annotations

from typing import Final

from agents.body.kinds import Flight, Kind
from agents.vectors import ZERO, Vector, clamp, wrap
from twins.models.onboard_flight import TOUCHDOWN, OnboardFlight

GRAVITY: Final = 9.81  # [m/s²]


class Quadrotor(OnboardFlight):
    """One quadrotor."""

    __slots__ = (
        "_change", "_dt", "_gain", "_push", "_response", "_speed", "_step_gain", "_tilt", "_turn", "_turn_rate"
    )  # fmt: skip

    _response: Flight
    _gain: Vector  # k_p [1/s]
    _speed: Vector  # limits [m/s]
    _turn: float  # gain of the yaw [1/s]
    _turn_rate: float  # its limit [rad/s]
    _dt: float  # step for which the next two hold [s], 0 before the first
    _step_gain: Vector  # k_v dt
    _tilt: Vector  # share of the acceleration that is reached in a step
    _push: tuple[float, float]  # change of velocity in a step by the wind [m/s]
    _change: Vector  # change of velocity in a step, with the lag of tilting [m/s]

    def __init__(self, kind: Kind, start: Vector, yaw: float) -> None:
        flight = kind.motion
        assert isinstance(flight, Flight)
        self._response = flight
        self._gain, self._speed = flight.position, flight.speed
        self._turn, self._turn_rate = kind.turn_response, kind.turn_rate
        self._dt = 0.0
        self._step_gain, self._tilt = ZERO, ZERO
        self._push = (0.0, 0.0)
        super().__init__(kind, start, yaw)

    def place(self, position: Vector, yaw: float, *, flying: bool) -> None:
        super().place(position, yaw, flying=flying)
        self._change = ZERO

    def move(self, dt: float) -> None:
        """One step of `dt` [s]: v_cmd = clip(k_p (target − p), ± limit), a = k_v (v_cmd − v), delayed by tilting.

        Wind is added to a: k_v and k_p together leave an error of its acceleration / (k_p k_v) [m].
        """
        if dt != self._dt:
            self._set_step(dt)
        if self._climbing:
            self._advance_climb(dt)
        x, y, z = self.held
        if not self.flying:
            self._fall(dt, x, y, z)
            return
        kx, ky, kz = self._gain
        limit_x, limit_y, limit_z = self._speed
        gain_x, gain_y, gain_z = self._step_gain
        tilt_x, tilt_y, tilt_z = self._tilt
        push_x, push_y = self._push
        vx, vy, vz = self.velocity
        ax, ay, az = self._change
        if self._by_velocity and not self._climbing:
            wx, wy, wz = self._velocity_setpoint
        else:
            wx, wy, wz = self._target
            wx, wy, wz = kx * (wx - x), ky * (wy - y), kz * (wz - z)
        turn = self._yaw_rate if self._by_velocity else self._turn * wrap(self._yaw_setpoint - self.yaw)
        wx = limit_x if wx > limit_x else -limit_x if wx < -limit_x else wx
        wy = limit_y if wy > limit_y else -limit_y if wy < -limit_y else wy
        wz = limit_z if wz > limit_z else -limit_z if wz < -limit_z else wz
        # written as a sum, an axis that tilts at once keeps the bits of its change
        ax = (1.0 - tilt_x) * ax + tilt_x * (gain_x * (wx - vx))
        ay = (1.0 - tilt_y) * ay + tilt_y * (gain_y * (wy - vy))
        az = (1.0 - tilt_z) * az + tilt_z * (gain_z * (wz - vz))
        self._change = (ax, ay, az)
        vx, vy = vx + ax + push_x, vy + ay + push_y
        vz = vz + az
        x, y, z = x + dt * vx, y + dt * vy, z + dt * vz
        self.yaw += dt * clamp(turn, -self._turn_rate, self._turn_rate)
        if self._landing and self._touches_down(z):
            self._rest(x, y)
            return
        self.velocity = (vx, vy, vz)
        self.held = (x, y, z)
        wobble_x, wobble_y = self.wobble
        self.position = (x + wobble_x, y + wobble_y, z)

    def _set_step(self, dt: float) -> None:
        gain, tilt = self._response.velocity, self._response.tilt
        wind = self.wind
        self._dt, self._step_gain = dt, (dt * gain[0], dt * gain[1], dt * gain[2])
        self._tilt = (min(dt * tilt[0], 1.0), min(dt * tilt[1], 1.0), min(dt * tilt[2], 1.0))
        self._push = (dt * wind[0], dt * wind[1])

    def _fall(self, dt: float, x: float, y: float, z: float) -> None:
        """Motors off: fall from x, y, z [m], or stand."""
        self._change = ZERO
        if z > 0.0:
            vx, vy, vz = self.velocity
            vz -= GRAVITY * dt
            x, y, z = x + dt * vx, y + dt * vy, z + dt * vz
            self.velocity = (vx, vy, vz)
        else:
            self.velocity = ZERO
        if z <= TOUCHDOWN:
            self._rest(x, y)
            return
        self.held = (x, y, z)
        self.position = (x + self.wobble[0], y + self.wobble[1], z)

    def _rest(self, x: float, y: float) -> None:
        """Stand on the floor at x, y [m]."""
        self.velocity = ZERO
        self.held = (x, y, 0.0)
        self.position = (x + self.wobble[0], y + self.wobble[1], 0.0)
