"""A real ROS 2, rclpy with Fast DDS: types and CDR as it has them, and the watchdog of a TurtleBot3 under it."""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from agents.network import messages
from bridges.ros2 import messages as ros2
from bridges.ros2.bridge import diagnostic, scan, transform
from experiments.definition.plan import Plan
from experiments.recording.ros2 import viewers
from experiments.scene import markers
from tests.commands import zenpark
from tests.fuzz.targets_ros import ros_messages
from tests.small import reference
from tests.system.rclpy_wheels import APART, LOOPBACK, PYTHON, missing

WHY = missing()
pytestmark = [pytest.mark.system, pytest.mark.skipif(bool(WHY), reason=WHY)]
SIDE = Path(__file__).with_name("rclpy_side.py")
KINDS = {value for value in vars(ros2).values() if isinstance(value, str) and "/msg/" in value}
PADDED = {ros2.ODOMETRY, ros2.DIAGNOSTIC_ARRAY, ros2.MARKER_ARRAY}  # Fast CDR leaves padding undefined
WITHOUT_WHEEL = {ros2.TF_MESSAGE}  # a list of TransformStamped; its hash is tested against the published one


def ask(folder, *words, given=None):
    """The answer of `rclpy_side.py`, in a network of its own."""
    own = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": "30", "ROS_LOG_DIR": str(folder)}
    own |= {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}  # shared memory stays behind when a process is killed
    path = {name: value for name, value in os.environ.items() if not name.startswith(("ROS_", "RMW_", "PYTHON"))}
    command = [*APART, *LOOPBACK, str(PYTHON), str(SIDE), *words]
    options = {"capture_output": True, "text": True, "timeout": 110, "env": {**path, **own}}
    done = subprocess.run(command, input=json.dumps(given), check=False, **options)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def payloads():
    """A message of each type that this project uses, as its own CDR."""
    types = ros2.types("kilted")
    state = messages.State("tb3", 1, 1.7e9, "running", (1.0, 2.0, 0.5), None, 0.3, None, None, 0.0)
    place = transform(types, state, (1.0, 2.0, 0.5), "tb3")
    bearing = np.radians(np.arange(360.0)).round(6).tolist()
    distance = [None, *np.linspace(0.12, 3.5, 359).round(6).tolist()]
    sweep = messages.Ranges("tb3", 1.7e9, bearing, [0.0] * 360, distance)
    status = diagnostic(types, "tb3", 1, "running; LOCKED", {"battery": "0.750", "missing": ""})
    made = {
        ros2.TRANSFORM_STAMPED: place,
        ros2.TF_MESSAGE: types.make(ros2.TF_MESSAGE, transforms=[place, place]),
        ros2.LASER_SCAN: scan(types, sweep, "tb3"),
        ros2.DIAGNOSTIC_ARRAY: types.make(ros2.DIAGNOSTIC_ARRAY, header=types.header(1.7e9, ""), status=[status] * 2),
    }
    case = Plan(reference())
    drawn = markers.drawing(case)(1.7e9, {name: (0.1 * k, 0.2, 0.3) for k, name in enumerate(case.names)})
    assert {each.group for each in drawn} == {"arena", "robots", "names", "links"}
    scene = {ros2.MARKER_ARRAY: viewers.markers(1.7e9, drawn)}
    return ros_messages() | scene | {kind: types.encode(message, kind) for kind, message in made.items()}


def test_types_and_cdr_are_those_of_rclpy(tmp_path):
    ours, types = payloads(), ros2.types("kilted")
    assert set(ours) == KINDS
    theirs = ask(tmp_path, "types", given={kind: payload.hex() for kind, payload in ours.items()})
    assert {kind for kind, answer in theirs.items() if answer is None} == WITHOUT_WHEEL
    answers = {kind: answer for kind, answer in theirs.items() if answer is not None}
    for distro in ("jazzy", "kilted"):
        assert {kind: code for kind, (code, _) in answers.items()} == {
            kind: ros2.types(distro).hash(kind) for kind in answers
        }
    for kind, (_, payload) in answers.items():
        raw = bytes.fromhex(payload)
        assert len(raw) == len(ours[kind])
        assert types.encode(types.decode(raw, kind), kind) == ours[kind]
        assert raw == ours[kind] or kind in PADDED


@pytest.mark.parametrize("kind", [ros2.TWIST, ros2.TWIST_STAMPED])
def test_watchdog_stops_robot_of_killed_commander(tmp_path, kind):
    watchdog = tmp_path / "watchdog.py"
    watchdog.write_text(zenpark("turtlebot", "watchdog").stdout)
    answer = ask(tmp_path, "drive", kind, str(watchdog))
    speeds = answer["killed"]
    last = len(speeds) - 1 - speeds[::-1].index(0.1)
    assert speeds[: last + 1].count(0.1) >= 20
    assert set(speeds[last + 1 :]) == {0.0}
    assert answer["ended"] == 0
    assert 0.0 in answer["told"], "a watchdog that is ended stops the robot first"
