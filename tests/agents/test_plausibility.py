"""What no robot, clock or sensor can have is refused, and says why."""

import math

import msgspec
import pytest

from agents import plausibility
from agents.wire import Command, Malformed, Pose, State

POSE = Pose("KH01", 3, 1000.0, (0.1, -0.2, 0.0), (0.01, 0.0, 0.0), 1.5)
REACH = (2.0, 2.0, 3.5)


def test_an_honest_pose_passes():
    plausibility.check_pose(POSE, robot="KH01", now=1000.0, reach=REACH)
    plausibility.check_pose(POSE, robot="KH01", now=1e9, reach=REACH)  # late joiners get old ones


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"robot": "KH02"}, "pose of 'KH02' on the key of 'KH01'"),
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
        plausibility.check_pose(pose, robot="KH01", now=1000.0, reach=REACH)


@pytest.mark.parametrize(
    ("command", "why"),
    [
        (Command("KH02", 1, 1.0, "stop"), "command of 'KH02' on the key of 'KH01'"),
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
        plausibility.check_command(command, robot="KH01")


@pytest.mark.parametrize(
    "changes",
    [
        {"robot": "KH02"},
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
    plausibility.check_state(state, robot="KH01", now=1000.0, reach=(2.0, 2.0, 2.0))
    with pytest.raises(Malformed):
        plausibility.check_state(
            msgspec.structs.replace(state, **changes), robot="KH01", now=1000.0, reach=(2.0, 2.0, 2.0)
        )
