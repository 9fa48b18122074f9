"""Odometry of a TurtleBot3: a pose in the arena from counts that begin anywhere, and may restart.

Its speed is that of its poses: the twist of turtlebot3_node was zero until December 2024 (its pull request 1001).
"""

from __future__ import annotations

from collections import deque
from math import cos, hypot, inf, isfinite, nan, sin
from typing import Final

from agents.body.external_pose import velocity_after
from agents.clock import StampAge
from agents.vectors import wrap
from bridges.ros2 import messages as ros2
from bridges.ros2.messages import Message

SILENCE_S: Final = 0.5  # age of odometry from which the robot is out of reach and gets zeros
STANDING: Final = (0.015, 0.06)  # [m/s, rad/s] slower robots stand
FASTEST: Final = 0.5  # [m/s] odometry that jumps faster was restarted
RESETS: Final = (3, 5.0)  # number within seconds that are no restarts: two robots send odometry, or it is broken
DRIFT: Final = 1e-3  # [s/s] largest difference between the robot's clock, which may be slewed, and ours
ORIGIN: Final = 0.01  # [m] odometry closer to zero is at its origin
SETTLING_S: Final = 0.12  # time after the first message of a node, to the second of which it adds the yaw of its IMU

Planar = tuple[float, float, float]  # x, y [m], yaw [rad]


class Odometry:
    """Pose and speed of a robot in the arena, by its odometry. Times `now` are monotonic [s]."""

    def __init__(self, start: Planar, *, boot: bool) -> None:
        """Of a robot at `start`; `boot`: it stood there when it was switched on, not when it is first received."""
        self.pose: Planar = (nan, nan, nan)  # pose in the arena; NaN before the first odometry
        self.speed = (0.0, 0.0)  # v [m/s] and ω [rad/s]
        self.received = -inf  # time of the last odometry
        self.age = 0.0  # age of the last odometry when it arrived, by its stamp [s]
        self.restarted = False
        self._start, self._stamps = start, StampAge(DRIFT)
        self._raw_pose: Planar = (nan, nan, nan)  # pose in odometry's own frame
        self._stamp = inf  # time of that pose, on the clock of the robot [s]
        self._frame: Planar | None = start if boot else None  # origin of odometry in the arena,
        self._settled_at = -inf  # time from which the yaw is certain [s]
        self._resets: deque[float] = deque(maxlen=RESETS[0])  # times of the last

    def update(self, message: Message, now: float) -> bool:
        """Take a message; False if a number in it is not finite."""
        place, q = message.pose.pose.position, message.pose.pose.orientation
        counted, stamp = (place.x, place.y, ros2.yaw_of(q)), ros2.stamp_of(message.header)
        if not all(map(isfinite, counted)):
            return False
        before = self._start if self.received == -inf else self.pose
        reset = self.received > -inf and self._was_reset(counted, now, stamp)
        if reset:
            self.restarted = True
            self._resets.append(now)
        if reset or self._frame is None:
            self._settled_at = now + SETTLING_S
        if self._frame is None or self.settles(now):
            # it counts from elsewhere: assume that the robot stands at its last known pose
            self._frame = _frame(before, counted)
        self.pose = _to_arena(self._frame, counted)
        since = stamp - self._stamp if stamp > self._stamp else now - self.received
        if 0.0 < since < inf:
            self._update_speed(before, since)
        self._raw_pose, self._stamp = counted, stamp
        self.age = self._stamps.age(now, stamp)
        self.received = now
        return True

    def _update_speed(self, before: Planar, since: float) -> None:
        """Filter the speed, after a motion from a pose `before` in `since` [s]."""
        (x, y, yaw), (x0, y0, yaw0) = self.pose, before
        turn = wrap(yaw - yaw0)
        middle = yaw0 + 0.5 * turn
        along = cos(middle) * (x - x0) + sin(middle) * (y - y0)
        v, w, _ = velocity_after((*self.speed, 0.0), (along, turn, 0.0), since)
        self.speed = v, w

    def _was_reset(self, counted: Planar, now: float, stamp: float) -> bool:
        """Whether odometry was reset: a jump faster than any robot, or back at the origin after a silence.

        Messages that a link has held back come at once, and some of them are skipped: their stamps are apart.
        """
        silence = now - self.received
        pose = _to_arena(self._frame or self._start, counted)
        jump = hypot(pose[0] - self.pose[0], pose[1] - self.pose[1])
        back = silence > SILENCE_S and _at_origin(counted) and not _at_origin(self._raw_pose)
        return back or jump > FASTEST * max(silence, stamp - self._stamp) + 0.1

    def silent(self, now: float) -> bool:
        return now - self.received > SILENCE_S

    def settles(self, now: float) -> bool:
        """Whether its frame is not certain yet: the robot has to stand."""
        return now <= self._settled_at

    def unsteady(self, now: float) -> bool:
        """Whether odometry was reset too often to tell a position."""
        count, span = RESETS
        return len(self._resets) == count and now - self._resets[0] < span

    @property
    def standing(self) -> bool:
        return abs(self.speed[0]) < STANDING[0] and abs(self.speed[1]) < STANDING[1]

    def fault(self, now: float) -> str:
        """Fault for users; empty if none."""
        if self.silent(now):
            return f"odometry silent for {now - self.received:.0f} s" if self.received > -inf else "no odometry"
        if self.unsteady(now):
            return "odometry jumps again and again: do two robots have this namespace?"
        if self.age > SILENCE_S:
            return f"odometry is {self.age:.1f} s old by its stamps: its link holds it back, or its clock was set"
        return ""


def _at_origin(pose: Planar) -> bool:
    return hypot(pose[0], pose[1]) < ORIGIN


def _to_arena(frame: Planar, pose: Planar) -> Planar:
    """Transform a pose from `frame` to the arena."""
    x, y, yaw = frame
    c, s = cos(yaw), sin(yaw)
    return x + c * pose[0] - s * pose[1], y + s * pose[0] + c * pose[1], wrap(yaw + pose[2])


def _frame(arena: Planar, pose: Planar) -> Planar:
    """Frame in which `pose` equals the pose `arena` of the arena."""
    yaw = arena[2] - pose[2]
    c, s = cos(yaw), sin(yaw)
    return arena[0] - c * pose[0] + s * pose[1], arena[1] - s * pose[0] - c * pose[1], yaw
