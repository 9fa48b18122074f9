"""Values that no robot, clock or sensor can have are refused with a reason."""

from functools import partial
from math import inf, nan

import msgspec
import pytest

from agents.network import validation
from agents.network.messages import Command, Goal, Malformed, Pose, Ranges, State

SEEN = {"now": 1000.0, "valid_box": (2.0, 2.0, 3.5)}
GOOD = {
    "pose": Pose("KH01", 3, 1000.0, (0.1, -0.2, 0.0), (0.01, 0.0, 0.0), 1.5),
    "state": State("KH01", 1, 1000.0, "running", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.5, None, None, 0.0),
    "goal": Goal("KH01", 7, 999.9, (0.5, -0.5, 0.0), 0.25, 999.85),
    "ranges": Ranges("KH01", 1000.0, [0.0, 1.5], [0.0, 0.0], [0.25, None]),
    "drive": Command("KH01", 1, 1.0, "drive", (0.1, 0.0, 0.0, 0.0)),
    "takeoff": Command("KH01", 1, 1.0, "takeoff", None, 0.5),
}
CHECKS = {
    "pose": partial(validation.check_pose, **SEEN),
    "state": partial(validation.check_state, **SEEN),
    "goal": partial(validation.check_goal, oldest_s=1.0, **SEEN),
    "ranges": partial(validation.check_ranges, now=1000.0),
    "drive": validation.check_command,
    "takeoff": validation.check_command,
}


def check(what, **changes):
    CHECKS[what](msgspec.structs.replace(GOOD[what], **changes))


@pytest.mark.parametrize(
    ("what", "changes"),
    [
        *((what, {}) for what in GOOD),
        ("pose", {"stamp": 1.0}),  # late joiners get old ones
        ("goal", {"yaw": None, "stamp": 1000.5, "pose": 1001.0}),  # clocks that differ a little
        ("goal", {"stamp": 999.0}),
    ],
    ids=str,
)
def test_honest_messages_pass(what, changes):
    check(what, **changes)


@pytest.mark.parametrize(
    ("what", "change", "why"),
    [
        ("pose", {"seq": 0}, "sequence number 0"),
        ("pose", {"seq": 2**53}, "sequence number"),
        ("pose", {"stamp": 1006.0}, "stamp 1006.0"),
        ("pose", {"stamp": 0.0}, "stamp 0.0"),
        ("pose", {"stamp": nan}, "stamp nan"),
        ("pose", {"position": (2.01, 0.0, 0.0)}, "outside the arena"),
        ("pose", {"position": (0.0, -2.01, 0.0)}, "outside the arena"),
        ("pose", {"position": (0.0, 0.0, 9.0)}, "outside the arena"),
        ("pose", {"position": (0.0, nan, 0.0)}, "outside the arena"),
        ("pose", {"velocity": (0.0, 0.0, 51.0)}, "velocity"),
        ("pose", {"velocity": (0.0, nan, 0.0)}, "velocity"),
        ("pose", {"yaw": nan}, "yaw nan"),
        ("pose", {"yaw": 1e4}, "yaw"),
        ("state", {"stamp": nan}, "stamp"),
        ("state", {"position": (2.1, 0.0, 0.0)}, "outside the arena"),
        ("state", {"velocity": (51.0, 0.0, 0.0)}, "velocity"),
        ("state", {"yaw": inf}, "yaw"),
        ("goal", {"seq": 0}, "sequence number"),
        ("goal", {"seq": 2**60}, "sequence number"),
        ("goal", {"stamp": 998.9}, "old"),
        ("goal", {"stamp": nan}, "stamp"),
        ("goal", {"stamp": 1006.0}, "stamp"),
        ("goal", {"pose": nan}, "rest on a pose"),
        ("goal", {"pose": 0.0}, "rest on a pose"),
        ("goal", {"pose": 1005.5}, "rest on a pose"),
        ("goal", {"position": (0.0, 1e9, 0.0)}, "outside the arena"),
        ("goal", {"yaw": nan}, "yaw"),
        ("goal", {"yaw": 1e9}, "yaw"),
        ("ranges", {"stamp": 1006.0}, "stamp 1006.0"),
        ("ranges", {"distance": [0.25]}, "differ in number"),
        ("ranges", {"elevation": [0.0, 0.0, 0.0]}, "differ in number"),
        ("ranges", {"distance": [0.25, inf]}, "between 0 and 100 m"),
        ("ranges", {"distance": [-0.1, None]}, "between 0 and 100 m"),
        ("ranges", {"distance": []}, "0 rays"),
        ("ranges", {"distance": [1.0] * 721}, "721 rays"),
        ("ranges", {"bearing": [0.0, nan]}, "no angle"),
        ("ranges", {"bearing": [0.0, 90.0]}, "no angle"),
        ("drive", {"seq": 0}, "sequence number 0"),
        ("drive", {"setpoint": None}, "drive with the setpoint None"),
        ("drive", {"setpoint": (0.0, nan, 0.0, 0.0)}, "drive with the setpoint"),
        ("drive", {"setpoint": (0.0, 0.0, 0.0, -inf)}, "drive with the setpoint"),
        ("takeoff", {"height": None}, "takeoff with the height None"),
        ("takeoff", {"height": -0.5}, "takeoff with the height -0.5"),
    ],
    ids=lambda value: str(value)[:40],
)
def test_impossible_messages_are_refused(what, change, why):
    with pytest.raises(Malformed, match=why):
        check(what, **change)


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
def test_gap_counts_at_most_what_time_allows(last, seq, since, lost):
    assert validation.missed(last, seq, since, 50.0) == lost
