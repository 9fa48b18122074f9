"""Position control, the individual level (paper, figure 10): from a goal to the setpoint of the robot's body."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from agents.arrays import Array, clamp, every, norm, some, span
from agents.body.kinds import Kind

REACHED = 0.005  # [m] a ground robot stops nearer than this to its goal; half the threshold of a 1 cm trigger
TURNED = math.radians(2.0)  # [rad] and nearer than this to the wanted yaw

BROADSIDE = 0.02  # cosine of α below which a goal is abeam: wheels turn first, and drive in proportion


def wrap(angle: Array) -> Array:
    """Angle in (−π, π]."""
    return np.asarray(math.pi - np.mod(math.pi - angle, 2.0 * math.pi))


class PositionController:
    """Position controllers of rows of any kinds."""

    def __init__(self, kinds: Sequence[Kind]) -> None:
        takes = np.array([kind.takes for kind in kinds])
        position, velocity, twist = (np.flatnonzero(takes == what) for what in ("position", "velocity", "twist"))
        self._position, self._velocity, self._twist = span(position), span(velocity), span(twist)
        self._any_position, self._any_velocity, self._any_twist = len(position), len(velocity), len(twist)
        self._speed = np.array([kind.speed for kind in kinds])
        self._response = np.array([kind.response for kind in kinds])
        self._turn_response = np.array([kind.turn_response for kind in kinds])
        driven = [kinds[row] for row in twist.tolist()]
        self._drive = {
            name: np.array([getattr(kind, name) for kind in driven])
            for name in ("response", "turn_response", "speed", "turn_rate")
        }

    def setpoint(self, goal: Array, goal_yaw: Array, position: Array, yaw: Array) -> Array:
        """Setpoints (N, 4), in the meaning of each row's kind (see `agents.network.messages.State`).

        From `goal` (N, 3) [m], `goal_yaw` (N,) [rad], NaN for any, measured `position` (N, 3) [m] and `yaw` (N,) [rad].
        """
        setpoint = np.zeros((len(goal), 4))
        if self._any_position:
            rows = self._position
            setpoint[rows, :3] = goal[rows]
            free = np.isnan(goal_yaw[rows])
            setpoint[rows, 3] = 0.0 if every(free) else np.where(free, 0.0, goal_yaw[rows])
        if self._any_velocity:
            rows = self._velocity
            velocity = self._response[rows, None] * (goal[rows] - position[rows])
            setpoint[rows, :3] = clamp(velocity, -self._speed[rows, None], self._speed[rows, None])
            turn = self._turn_response[rows] * wrap(goal_yaw[rows] - yaw[rows])
            setpoint[rows, 3] = np.where(np.isnan(turn), 0.0, turn)
        if self._any_twist:
            rows = self._twist
            offset = goal[rows, :2] - position[rows, :2]
            setpoint[rows, :2] = drive(offset, yaw[rows], goal_yaw[rows], **self._drive)
        return setpoint


def drive(
    way: Array,  # (n, 2) goal less position [m]
    yaw: Array,  # (n,) [rad]
    goal_yaw: Array,  # (n,) wanted at the goal [rad], NaN for any
    *,
    response: Array,  # (n,) K [1/s]
    turn_response: Array,  # (n,) K_α [1/s]
    speed: Array,  # (n,) limit [m/s]
    turn_rate: Array,  # (n,) limit [rad/s]
) -> Array:
    """Linear and angular speed (n, 2) of differential robots toward a point, and there to a yaw.

    They cannot move sideways (paper, eq. (1)): the pose error is turned into distance and bearing. The law is that of
    Farias et al. for the Khepera IV, v = K d (π − |α|)/π and ω = K_α sin α; α is taken to the nearer end of the robot,
    which drives backward as well as forward, because formation goals lie behind it as often as before it. Toward a goal
    exactly abeam v is 0: wheels that accelerate drive before they turn, which would put the goal behind the end that
    drives ahead: the robot would change ends at each tick and never leave.
    """
    distance = norm(way)
    cos, sin = np.cos(yaw), np.sin(yaw)
    x, y = way[:, 0], way[:, 1]
    along, across = cos * x + sin * y, cos * y - sin * x
    ahead = np.copysign(1.0, along)
    alpha = np.arctan2(ahead * across, ahead * along)
    twist = np.empty((len(way), 2))
    twist[:, 0] = ahead * np.minimum(response * distance * (1.0 - np.abs(alpha) / math.pi), speed)
    twist[:, 0] *= np.minimum(np.cos(alpha) / BROADSIDE, 1.0)
    twist[:, 1] = turn_response * np.sin(alpha)
    there = distance <= REACHED
    if some(there):
        twist[there] = 0.0
        asked = there & ~np.isnan(goal_yaw)
        if some(asked):
            turn = wrap(goal_yaw[asked] - yaw[asked])
            twist[asked, 1] = np.where(np.abs(turn) > TURNED, turn_response[asked] * turn, 0.0)
    twist[:, 1] = clamp(twist[:, 1], -turn_rate, turn_rate)
    return twist
