"""Position control, the individual level (paper, figure 10): from a goal to the setpoint of the robot's body.

All functions run on quiet ticks.
"""

from __future__ import annotations

from math import atan2, cos, isfinite, isnan, nan, pi, radians, sin, sqrt
from typing import Final

from agents.body.kinds import Kind
from agents.vectors import Setpoint, Vector, clamp, wrap

REACHED: Final = 0.005  # [m] a ground robot stops nearer than this to its goal; half the threshold of a 1 cm trigger
TURNED: Final = radians(2.0)  # [rad] and nearer than this to the wanted yaw

BROADSIDE: Final = 0.02  # cosine of α below which a goal is abeam: wheels turn first, and drive in proportion


class PositionController:
    """Position controller of a robot of any kind."""

    __slots__ = ("_drives", "_flies_to", "_response", "_speed", "_turn_rate", "_turn_response")

    _flies_to: bool  # its body takes positions, and closes in on them by itself
    _drives: bool  # its body takes twists; one that takes neither takes velocities
    _response: float  # of its kind [1/s], and likewise
    _turn_response: float  # [1/s]
    _speed: float  # [m/s]
    _turn_rate: float  # [rad/s]

    def __init__(self, kind: Kind) -> None:
        self._flies_to, self._drives = kind.takes == "position", kind.takes == "twist"
        self._response, self._turn_response = kind.response, kind.turn_response
        self._speed, self._turn_rate = kind.speed, kind.turn_rate

    def setpoint(self, goal: Vector, goal_yaw: float, position: Vector, yaw: float) -> Setpoint:
        """Setpoint in the meaning of the robot's kind (see `agents.network.messages.State`).

        From `goal` [m], `goal_yaw` [rad], NaN for any, and the measured `position` [m] and `yaw` [rad].
        """
        x, y, z = goal
        if self._flies_to:
            return x, y, z, 0.0 if isnan(goal_yaw) else goal_yaw
        here_x, here_y, here_z = position
        response, speed = self._response, self._speed
        if self._drives:
            v, omega = drive(
                x - here_x, y - here_y, yaw, goal_yaw, response, self._turn_response, speed, self._turn_rate
            )
            return v, omega, 0.0, 0.0
        turn = 0.0 if isnan(goal_yaw) else self._turn_response * wrap(goal_yaw - yaw)
        if isnan(turn):
            turn = 0.0
        vx, vy, vz = response * (x - here_x), response * (y - here_y), response * (z - here_z)
        if -speed <= vx <= speed and -speed <= vy <= speed and -speed <= vz <= speed:
            return vx, vy, vz, turn
        return clamp(vx, -speed, speed), clamp(vy, -speed, speed), clamp(vz, -speed, speed), turn


def drive(  # noqa: PLR0917 - numbers alone, as the textbook has them
    x: float,  # goal less position [m]
    y: float,  # likewise
    yaw: float,  # [rad]
    goal_yaw: float,  # wanted at the goal [rad], NaN for any
    response: float,  # K [1/s]
    turn_response: float,  # K_α [1/s]
    speed: float,  # limit [m/s]
    turn_rate: float,  # limit [rad/s]
) -> tuple[float, float]:
    """Linear [m/s] and angular speed [rad/s] of a differential robot toward a point, and there to a yaw.

    It cannot move sideways (paper, eq. (1)): the pose error is turned into distance and bearing. The law is that of
    Farias et al. for the Khepera IV, v = K d (π − |α|)/π and ω = K_α sin α; α is taken to the nearer end of the robot,
    which drives backward as well as forward, because formation goals lie behind it as often as before it. Toward a goal
    exactly abeam v is 0: wheels that accelerate drive before they turn, which would put the goal behind the end that
    drives ahead: the robot would change ends at each tick and never leave.
    """
    distance = sqrt(x * x + y * y)
    if distance <= REACHED:
        turn = 0.0 if isnan(goal_yaw) else wrap(goal_yaw - yaw)
        return 0.0, clamp(turn_response * turn, -turn_rate, turn_rate) if abs(turn) > TURNED else 0.0
    if not isfinite(yaw):
        return nan, nan
    ahead_x, ahead_y = cos(yaw), sin(yaw)
    along, across = ahead_x * x + ahead_y * y, ahead_x * y - ahead_y * x  # distance times cos α and sin α
    backward = along < 0.0
    if backward:
        along, across = -along, -across
    alpha = atan2(across, along)
    v = response * distance * (1.0 - abs(alpha) / pi)
    v = speed if v > speed else v
    if along < BROADSIDE * distance:
        v *= along / distance / BROADSIDE
    omega = turn_response * across / distance
    if omega > turn_rate:
        omega = turn_rate
    elif omega < -turn_rate:
        omega = -turn_rate
    return -v if backward else v, omega
