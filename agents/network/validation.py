"""Validation of received messages: numbers that no robot, clock or sensor can have are refused.

Decoded values may still be NaN, or from the future. NaN fails each comparison here, because all of them ask whether a
number lies inside. All `check_` functions raise `Malformed`.
"""

from __future__ import annotations

import math
from typing import Final

from agents.network.messages import (
    STILL,
    Command,
    Event,
    Goal,
    Malformed,
    Pose,
    Position,
    Ranges,
    State,
    Variable,
    Vector,
)

FUTURE_S: Final = 5.0  # a stamp further ahead comes from a wrong clock or a forgery, and would suppress correct samples
MAX_SPEED: Final = 50.0  # [m/s]; nothing here moves faster
ABSURD: Final = 1e6  # [m, m/s, rad, rad/s] no setpoint is that large
MAX_NUMBERS: Final = 64  # most numbers that a robot says beside its pose
ENORMOUS: Final = 1e12  # no variable of a law is that large, whatever its unit
MAX_RAYS: Final = 720  # most rays of one sweep; the finest scanner here has 360
MAX_RANGE: Final = 100.0  # [m]; no range sensor here sees farther
ANY_ROOM: Final = (1e3, 1e3, 1e3)  # [m] bounds of valid positions where the arena is not known
WORLD: Final = "world"  # source of all events of the world
REACH_M: Final = 1.0  # a position farther outside the arena is refused
MAX_YAW: Final = 1e3  # [rad]; ours is within ±π, other programs may count on over full turns


def valid_box_of(low: Vector, high: Vector) -> Vector:
    """Largest |x|, |y|, |z| [m] of a valid position or goal in the arena from `low` to `high`, x, y, z [m]."""
    x, y, z = (max(abs(least), abs(most)) + REACH_M for least, most in zip(low, high, strict=True))
    return x, y, z


def taken(stamp: float, now: float) -> float:
    """Time of a measurement by its `stamp` [s], at most that of its arrival, `now` [s].

    A clock that is ahead must not make a measurement look fresher than it is.
    """
    return min(stamp, now)


def check_pose(pose: Pose, *, now: float, valid_box: Vector) -> None:
    """Refuses an impossible pose: stamp in the future, position outside `valid_box`, no robot's velocity."""
    if not (is_count(pose.seq) and 0.0 < pose.stamp < now + FUTURE_S):
        raise Malformed(f"sequence number {pose.seq} or stamp {pose.stamp} is impossible")
    _refuse_place(pose.position, valid_box)
    _refuse_motion(pose.velocity, pose.yaw)
    if pose.shared:
        _refuse_words(pose.shared)


def check_state(state: State, *, now: float, valid_box: Vector) -> None:
    """Refuses telemetry with an impossible pose; a pose may be missing."""
    _refuse_stamp(state.stamp, now)
    if state.position is not None:
        _refuse_place(state.position, valid_box)
    _refuse_motion(state.velocity, state.yaw)


def check_world_event(event: Event) -> None:
    """Refuses an event of the world in the name of another."""
    if event.source != WORLD:
        raise Malformed(f"event of '{event.source}' on the key of the world")


def check_position(measured: Position, *, now: float, valid_box: Vector) -> None:
    _refuse_stamp(measured.stamp, now)
    _refuse_place(measured.position, valid_box)
    if measured.yaw is not None and not abs(measured.yaw) <= MAX_YAW:
        raise Malformed(f"yaw {measured.yaw} is impossible")


def check_goal(goal: Goal, *, now: float, valid_box: Vector, oldest_s: float) -> None:
    """Refuses a goal that is impossible or too old, or younger than the pose on which it rests."""
    if not (is_count(goal.seq) and now - oldest_s <= goal.stamp and 0.0 < goal.stamp < now + FUTURE_S):
        raise Malformed(f"sequence number {goal.seq} or stamp {goal.stamp} is impossible, or the goal is old")
    if not 0.0 < goal.pose <= goal.stamp + FUTURE_S:  # the robot's clock may be ahead
        raise Malformed(f"a goal of {goal.stamp} cannot rest on a pose of {goal.pose}")
    _refuse_place(goal.position, valid_box)
    if goal.velocity is not None and not (
        2 <= len(goal.velocity) <= 3 and all(abs(each) <= MAX_SPEED for each in goal.velocity)
    ):
        raise Malformed(f"velocity {goal.velocity} is impossible")
    if goal.yaw is not None and not abs(goal.yaw) <= MAX_YAW:
        raise Malformed(f"yaw {goal.yaw} is impossible")


def check_ranges(ranges: Ranges, *, now: float) -> None:
    _refuse_stamp(ranges.stamp, now)
    if not 1 <= len(ranges.distance) <= MAX_RAYS:
        raise Malformed(f"{len(ranges.distance)} rays; a sweep has 1 to {MAX_RAYS}")
    if not len(ranges.bearing) == len(ranges.elevation) == len(ranges.distance):
        raise Malformed("bearings, elevations and distances differ in number")
    if not all(abs(angle) <= math.tau for angle in (*ranges.bearing, *ranges.elevation)):
        raise Malformed("a bearing or an elevation is no angle in radians")
    if not all(value is None or 0.0 <= value <= MAX_RANGE for value in ranges.distance):
        raise Malformed(f"a distance is not between 0 and {MAX_RANGE:g} m")


def check_command(command: Command) -> None:
    """Refuses a command that no body can carry out."""
    if not is_count(command.seq):
        raise Malformed(f"sequence number {command.seq} is impossible")
    if command.action == "drive":
        x, y, z, w = command.setpoint or (math.nan,) * 4
        # a world checks twenty thousand of these in a second: a generator would cost it three times as much
        if not (abs(x) <= ABSURD and abs(y) <= ABSURD and abs(z) <= ABSURD and abs(w) <= ABSURD):
            raise Malformed(f"drive with the setpoint {command.setpoint}")
    elif command.action == "takeoff" and not (command.height is not None and 0.0 < command.height <= MAX_RANGE):
        raise Malformed(f"takeoff with the height {command.height}")


def missed(last: int, seq: int, since: float, rate: float) -> int:
    """Number of lost poses between two received ones, numbered `last` and `seq`, `since` [s] apart by their stamps.

    A smaller `seq` is that of a new process, which began at 1. The largest rate of poses [1/s] limits the result: one
    forged number must not become a hundred million lost poses.
    """
    return min(seq - last - 1 if seq > last else seq - 1, most_poses(since, rate))


def most_poses(since: float, rate: float) -> int:
    """Largest number of poses in `since` [s] at `rate` [1/s]; UTC stamps are exact to a microsecond."""
    return math.ceil(since * rate - 1e-3)


def is_count(seq: int) -> bool:
    """Whether a number can be a running number."""
    return 0 < seq < 2**53  # what JSON carries exactly


def _refuse_stamp(stamp: float, now: float) -> None:
    if not 0.0 < stamp < now + FUTURE_S:
        raise Malformed(f"stamp {stamp} is impossible")


def _refuse_place(position: Vector, valid_box: Vector) -> None:
    (x, y, z), (far_x, far_y, far_z) = position, valid_box
    if not (abs(x) <= far_x and abs(y) <= far_y and abs(z) <= far_z):
        raise Malformed(f"position {position} is outside the arena")


def _refuse_words(shared: list[Variable]) -> None:
    if sum(len(each.value) for each in shared) > MAX_NUMBERS or len({each.name for each in shared}) < len(shared):
        raise Malformed(f"more than {MAX_NUMBERS} numbers beside a pose, or a variable that is said twice")
    if not all(abs(number) <= ENORMOUS for each in shared for number in each.value):
        raise Malformed("a variable beside a pose is no number")


def _refuse_motion(velocity: Vector | None, yaw: float | None) -> None:
    x, y, z = velocity or STILL
    if not (abs(x) <= MAX_SPEED and abs(y) <= MAX_SPEED and abs(z) <= MAX_SPEED and abs(yaw or 0.0) <= MAX_YAW):
        raise Malformed(f"velocity {velocity} or yaw {yaw} is impossible")
