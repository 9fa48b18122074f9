"""On-board flight control of a quadrotor: setpoints, and autonomous take-offs and landings. All of it is quiet."""

from __future__ import annotations

from typing import Final

from agents.body.interface import NO_ATTITUDE
from agents.body.kinds import Kind
from agents.vectors import ZERO, Setpoint, Vector
from twins.models.motion import Motion

CLIMB: Final = 0.4  # [m/s] mean speed of take-offs and landings
SHORTEST_S: Final = 0.5  # duration of a take-off or landing
TOUCHDOWN: Final = 0.02  # [m] a landing robot below this height is down


class OnboardFlight(Motion):
    """State, setpoints, take-offs and landings of a quadrotor; subclasses add the motion."""

    __slots__ = (
        "_by_velocity", "_climb_s", "_climbing", "_elapsed", "_from", "_landing", "_target", "_to",
        "_velocity_setpoint", "_yaw_rate", "_yaw_setpoint", "held", "wind",
    )  # fmt: skip

    held: Vector  # position as the controller knows it: without hover jitter [m]
    wind: tuple[float, float]  # acceleration that it adds while the motors are on [m/s²]
    _by_velocity: bool  # setpoints are velocity and yaw rate
    _target: Vector  # setpoint of the position [m],
    _yaw_setpoint: float  # yaw commanded to it [rad]
    _velocity_setpoint: Vector  # [m/s]
    _yaw_rate: float  # [rad/s]
    _landing: bool
    _climbing: bool  # a take-off or landing leads the height of the target,
    _from: float  # height at the begin [m]
    _to: float  # height at the end [m]
    _elapsed: float  # time since its begin [s],
    _climb_s: float  # duration of the climb [s]

    def __init__(self, kind: Kind, start: Vector, yaw: float) -> None:
        """At rest at `start` [m] with `yaw` [rad], motors off."""
        self._by_velocity = kind.takes == "velocity"
        self.attitude = NO_ATTITUDE
        self.wobble, self.wind = (0.0, 0.0), (0.0, 0.0)
        self._from = self._to = start[2]
        self._elapsed, self._climb_s = 0.0, 1.0
        self.place(start, yaw, flying=False)

    def command(self, setpoint: Setpoint) -> None:
        """Set position and yaw, or velocity and yaw rate; no effect if it is NaN, or on the ground, or landing."""
        x = setpoint[0]
        if x != x or self._landing or not self.flying:  # noqa: PLR0124 - NaN
            return
        self._climbing = False
        if self._by_velocity:
            self._velocity_setpoint, self._yaw_rate = (x, setpoint[1], setpoint[2]), setpoint[3]
        else:
            self._target, self._yaw_setpoint = (x, setpoint[1], setpoint[2]), setpoint[3]

    def blow(self, wind: tuple[float, float]) -> None:
        """Set the acceleration by a steady wind [m/s²], before the first step."""
        self.wind = wind

    def takeoff(self, height: float) -> None:
        """Start the motors and climb to `height` [m] at the present place."""
        self.flying, self._landing = True, False
        self._climb(height)

    def land(self) -> None:
        """Descend at the present place, then switch the motors off; a repeated order changes nothing."""
        if self.flying and not self._landing:
            self._landing = True
            self._climb(0.0)

    def stop(self) -> None:
        """Switch the motors off: in the air the robot falls."""
        self.flying = self._landing = False

    def place(self, position: Vector, yaw: float, *, flying: bool) -> None:
        self.position = self.held = self._target = position
        self.velocity = self._velocity_setpoint = ZERO
        self.yaw = self._yaw_setpoint = yaw
        self._yaw_rate = 0.0
        self.flying = flying
        self._landing, self._climbing = False, False

    def _climb(self, height: float) -> None:
        self._target = self.held
        self._from, self._to = self.held[2], height
        self._elapsed, self._climbing = 0.0, True
        self._climb_s = max(abs(height - self.held[2]) / CLIMB, SHORTEST_S)

    def _advance_climb(self, dt: float) -> None:
        """Advance the height setpoint by one step, on a polynomial without jerk at both ends."""
        self._elapsed += dt
        s = min(self._elapsed / self._climb_s, 1.0)
        s2 = s * s
        share = s2 * s2 * (35.0 - 84.0 * s + 70.0 * s2 - 20.0 * (s2 * s))
        self._target = (self._target[0], self._target[1], self._from + share * (self._to - self._from))

    def _touches_down(self, height: float) -> bool:
        """Switch the motors off when a landing is complete at `height` [m]; returns whether they are off."""
        if self._landing and height < TOUCHDOWN and self._elapsed > self._climb_s:
            self.flying = self._landing = False
        return not self.flying
