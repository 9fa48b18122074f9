"""What no robot, clock or sensor can have is refused, and says why."""

import math

import msgspec
import pytest

from agents.network import validation
from agents.network.messages import Command, Goal, Malformed, Pose, State

POSE = Pose("KH01", 3, 1000.0, (0.1, -0.2, 0.0), (0.01, 0.0, 0.0), 1.5)
VALID_BOX = (2.0, 2.0, 3.5)


def test_an_honest_pose_passes():
    validation.check_pose(POSE, now=1000.0, valid_box=VALID_BOX)
    validation.check_pose(POSE, now=1e9, valid_box=VALID_BOX)  # late joiners get old ones


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"seq": 0}, "sequence number 0"),
        ({"seq": -1}, "sequence number -1"),
        ({"seq": 2**53}, "sequence number"),
        ({"stamp": 1006.0}, "stamp 1006.0"),
        ({"stamp": 0.0}, "stamp 0.0"),
        ({"stamp": math.nan}, "stamp nan"),
        ({"stamp": math.inf}, "stamp inf"),
        ({"position": (2.01, 0.0, 0.0)}, "outside the arena"),
        ({"position": (0.0, -2.01, 0.0)}, "outside the arena"),
        ({"position": (0.0, 0.0, 9.0)}, "outside the arena"),
        ({"position": (0.0, math.nan, 0.0)}, "outside the arena"),
        ({"position": (math.inf, 0.0, 0.0)}, "outside the arena"),
        ({"velocity": (0.0, 0.0, 51.0)}, "velocity"),
        ({"velocity": (0.0, math.nan, 0.0)}, "velocity"),
        ({"yaw": math.nan}, "yaw nan"),
        ({"yaw": 1e4}, "yaw"),
    ],
)
def test_a_pose_that_no_robot_can_have(change, says):
    pose = msgspec.structs.replace(POSE, **change)
    with pytest.raises(Malformed, match=says):
        validation.check_pose(pose, now=1000.0, valid_box=VALID_BOX)


@pytest.mark.parametrize(
    ("command", "why"),
    [
        (Command("KH01", 0, 1.0, "stop"), "sequence number 0 is impossible"),
        (Command("KH01", 2**53, 1.0, "stop"), "is impossible"),
        (Command("KH01", 1, 1.0, "drive"), "drive with the setpoint None"),
        (Command("KH01", 1, 1.0, "drive", (0.0, math.nan, 0.0, 0.0)), "drive with the setpoint"),
        (Command("KH01", 1, 1.0, "drive", (0.0, 0.0, 0.0, -math.inf)), "drive with the setpoint"),
        (Command("KH01", 1, 1.0, "takeoff"), "takeoff with the height None"),
        (Command("KH01", 1, 1.0, "takeoff", None, -0.5), "takeoff with the height -0.5"),
    ],
)
def test_commands_that_no_body_can_carry_out(command: Command, why: str) -> None:
    with pytest.raises(Malformed, match=why):
        validation.check_command(command)


@pytest.mark.parametrize(
    "changes",
    [
        {"stamp": math.nan},
        {"stamp": 1006.0},
        {"position": (2.1, 0.0, 0.0)},
        {"position": (math.nan, 0.0, 0.0)},
        {"velocity": (51.0, 0.0, 0.0)},
        {"yaw": math.inf},
    ],
)
def test_states_of_mirrored_robots_that_cannot_be(changes: dict[str, object]) -> None:
    state = State("KH01", 1, 1000.0, "running", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.5, None, None, 0.0)
    validation.check_state(state, now=1000.0, valid_box=(2.0, 2.0, 2.0))
    with pytest.raises(Malformed):
        validation.check_state(msgspec.structs.replace(state, **changes), now=1000.0, valid_box=(2.0, 2.0, 2.0))


GOAL = Goal("KH01", 7, 999.9, (0.5, -0.5, 0.0), 0.25, 999.85)


def check_goal(**changes):
    validation.check_goal(msgspec.structs.replace(GOAL, **changes), now=1000.0, valid_box=VALID_BOX, oldest_s=1.0)


def test_an_honest_goal_passes():
    check_goal()
    check_goal(yaw=None, stamp=1000.5, pose=1001.0)  # clocks that differ a little
    check_goal(stamp=999.0)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"seq": 0}, "sequence number"),
        ({"seq": 2**60}, "sequence number"),
        ({"stamp": 998.9}, "old"),
        ({"stamp": math.nan}, "stamp"),
        ({"stamp": 1006.0}, "stamp"),
        ({"pose": math.inf}, "rest on a pose"),
        ({"pose": math.nan}, "rest on a pose"),
        ({"pose": 0.0}, "rest on a pose"),
        ({"pose": 1005.5}, "rest on a pose"),
        ({"position": (math.nan, 0.0, 0.0)}, "outside the arena"),
        ({"position": (0.0, 1e9, 0.0)}, "outside the arena"),
        ({"yaw": math.nan}, "yaw"),
        ({"yaw": 1e9}, "yaw"),
    ],
)
def test_a_goal_that_no_robot_can_follow(changes, says):
    with pytest.raises(Malformed, match=says):
        check_goal(**changes)


@pytest.mark.parametrize(
    ("last", "seq", "since", "lost"),
    [
        (1, 2, 0.02, 0),
        (1, 5, 0.08, 3),
        (1, 5, 10.0, 3),  # it speaks when it has something to say
        (7, 1, 3.0, 0),  # began anew
        (7, 3, 3.0, 2),
        (7, 99_999_999, 0.02, 1),  # forged: at 50 Hz one can have been said in that time
        (99_999_999, 9, 0.02, 1),
    ],
)
def test_gap_counts_at_most_what_time_allows(last: int, seq: int, since: float, lost: int) -> None:
    assert validation.missed(last, seq, since, 50.0) == lost
