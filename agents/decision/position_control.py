"""Position control, the individual level (paper, figure 10): from a goal to the setpoint of the robot's body.

All functions run on quiet ticks.
"""

from __future__ import annotations

from math import atan2, cos, isfinite, isnan, nan, pi, radians, sin, sqrt
from typing import Final

from agents.body.kinds import Agility, Kind, Steering
from agents.vectors import UNKNOWN, Setpoint, Vector, clamp, wrap

REACHED: Final = 0.005  # [m] a ground robot stops nearer than this to its goal; half the threshold of a 1 cm trigger
TURNED: Final = radians(2.0)  # [rad] largest error of yaw that counts as reached

LEASH: Final = 0.05  # [m] farthest of a reference from its robot: it does not wind up where the robot is held back

BROADSIDE: Final = 0.02  # cosine of α below which a goal is abeam: wheels turn first, and drive in proportion


class PositionController:
    """Position controller of a robot of any kind."""

    def __init__(self, kind: Kind) -> None:
        # its body takes positions, and closes in on them by itself, or twists; one that takes neither takes velocities
        self._flies_to, self._drives = kind.takes == "position", kind.takes == "twist"
        self._flies, self._steering = kind.flies, kind.steering or TwoWheels()  # steering of a kind that takes twists
        self._agility = Agility(kind.response, kind.turn_response, kind.speed, kind.turn_rate)

    def setpoint(self, goal: Vector, goal_yaw: float, position: Vector, yaw: float) -> Setpoint:
        """Setpoint in the meaning of the robot's kind (see `agents.network.messages.State`).

        From `goal` [m], `goal_yaw` [rad], NaN for any, and the measured `position` [m] and `yaw` [rad].
        """
        x, y, z = goal
        if self._flies_to:
            return x, y, z, 0.0 if isnan(goal_yaw) else goal_yaw
        here_x, here_y, here_z = position
        agility = self._agility
        if self._drives:
            v, omega = self._steering.twist(x - here_x, y - here_y, yaw, goal_yaw, agility)
            return v, omega, 0.0, 0.0
        response, speed = agility.response, agility.speed
        turn = 0.0 if isnan(goal_yaw) else agility.turn_response * wrap(goal_yaw - yaw)
        if isnan(turn):
            turn = 0.0
        vx, vy = response * (x - here_x), response * (y - here_y)
        vz = 0.0
        if self._flies:
            vz = response * (z - here_z)
        if -speed <= vx <= speed and -speed <= vy <= speed and -speed <= vz <= speed:
            return vx, vy, vz, turn
        return clamp(vx, -speed, speed), clamp(vy, -speed, speed), clamp(vz, -speed, speed), turn


class VelocityFollower:
    """Goals of a robot that is to move with a velocity, one on every tick: its reference and the way of 1/response.

    The reference of a robot that takes twists is its measured place. That of any other is carried on with the velocity:
    a measured one would be a random walk.
    """

    def __init__(self, kind: Kind, ground: float) -> None:
        """`ground`: height that the robot holds [m]."""
        self._by_twist, self._flies = kind.takes == "twist", kind.flies
        self._ground = ground
        self._response, self._speed = kind.response, kind.speed
        self.reference = UNKNOWN  # [m]; NaN: the next one is the place of the robot

    def goal(self, velocity: Vector, position: Vector, dt: float) -> Vector:
        """Goal [m] of a robot at `position` [m] that moves with `velocity` [m/s] for a tick of `dt` [s].

        A velocity beyond the speed of the kind keeps its direction. Where its third number is NaN, or the robot stands
        on wheels, the height is held.
        """
        x, y, z = velocity
        held = isnan(z) or not self._flies
        if held:
            z = 0.0
        share = min(1.0, self._speed / max(sqrt(x * x + y * y + z * z), self._speed))
        x, y, z = share * x, share * y, share * z
        here_x, here_y, here_z = position
        a, b, c = self.reference
        if self._by_twist or not (isfinite(a) and isfinite(b) and isfinite(c)):
            a, b, c = position
        else:
            a, b, c = a + x * dt, b + y * dt, c + z * dt
        if held:
            c = here_z = self._ground
        apart = sqrt((a - here_x) * (a - here_x) + (b - here_y) * (b - here_y) + (c - here_z) * (c - here_z))
        if apart > LEASH:
            near = LEASH / apart
            a, b, c = here_x + near * (a - here_x), here_y + near * (b - here_y), here_z + near * (c - here_z)
        self.reference = a, b, c
        seconds = 1.0 / self._response
        return a + seconds * x, b + seconds * y, c + seconds * z


class TwoWheels(Steering, frozen=True):
    """Steering of a differential robot, which turns on the spot.

    It cannot move sideways (paper, eq. (1)): the pose error is turned into distance and bearing. The law is that of
    Farias et al. for the Khepera IV, v = K d (π − |α|)/π and ω = K_α sin α. The bearing α refers to the nearer end of
    the robot. It drives backward and forward, because formation goals lie behind it and in front of it equally often.
    Toward a goal exactly abeam v is 0: wheels that accelerate drive before they turn. The goal would then lie behind
    the end that drives ahead, so the robot would change ends at each tick and never leave.
    """

    def twist(self, x: float, y: float, yaw: float, goal_yaw: float, agility: Agility) -> tuple[float, float]:
        speed, turn_rate, turn_response = agility.speed, agility.turn_rate, agility.turn_response
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
        v = agility.response * distance * (1.0 - abs(alpha) / pi)
        v = speed if v > speed else v
        if along < BROADSIDE * distance:
            v *= along / distance / BROADSIDE
        omega = turn_response * across / distance
        if omega > turn_rate:
            omega = turn_rate
        elif omega < -turn_rate:
            omega = -turn_rate
        return -v if backward else v, omega
