"""Bytes from and to ROS 2 and TurtleBots."""

from contextlib import ExitStack
from itertools import count

import numpy as np

from agents.network.keys import Keys
from agents.vectors import is_finite
from bridges.ros2 import messages as ros2
from bridges.ros2.bridge import Graph
from bridges.ros2.node import Participant
from bridges.turtlebot3.body import TurtleBot3
from bridges.turtlebot3.twin import TurtleBot3Twin
from tests.fuzz.messages import everything
from tests.fuzz.target import Target, place, renewed, split
from tests.network import Sample
from tests.requests import request
from twins.device import DeviceRequest, Faults


def ros_messages():
    """A good message of each type that is read, as CDR."""
    types = ros2.types("jazzy")
    make = types.make
    header = types.header(1.7e9, "map")
    point = make("geometry_msgs/msg/Point", x=0.1, y=0.2, z=0.0)
    turn = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.1, w=1.0)
    pose = make("geometry_msgs/msg/Pose", position=point, orientation=turn)
    twist = types.twist((0.1, 0.0, 0.0), (0.0, 0.0, 0.2))
    sides = np.zeros(36)
    found = {
        ros2.TWIST: twist,
        ros2.TWIST_STAMPED: make(ros2.TWIST_STAMPED, header=header, twist=twist),
        ros2.POSE_STAMPED: make(ros2.POSE_STAMPED, header=header, pose=pose),
        ros2.ODOMETRY: make(
            ros2.ODOMETRY, header=header, child_frame_id="base_footprint",
            pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=sides),
            twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=sides),
        ),
        ros2.LASER_SCAN: make(
            ros2.LASER_SCAN, header=header, angle_min=0.0, angle_max=6.0, angle_increment=0.5, time_increment=0.001,
            scan_time=0.2, range_min=0.12, range_max=3.5, ranges=np.full(12, 1.5, np.float32),
            intensities=np.zeros(12, np.float32),
        ),
        ros2.BATTERY_STATE: make(
            ros2.BATTERY_STATE, header=header, voltage=11.0, temperature=0.0, current=0.0, charge=0.0, capacity=0.0,
            design_capacity=1.8, percentage=55.0, power_supply_status=0, power_supply_health=0,
            power_supply_technology=0, present=True, cell_voltage=np.zeros(3, np.float32),
            cell_temperature=np.zeros(0, np.float32), location="", serial_number="",
        ),
    }  # fmt: skip
    return {kind: types.encode(message, kind) for kind, message in found.items()}


@place(40_000)
def ros():
    """CDR of every type, tokens and attachments: kind and payload with a zero byte between them."""
    types = ros2.types("jazzy")
    good = ros_messages()
    topic = ros2.endpoint_topic("/tb3_0/odom", ros2.ODOMETRY, ros2.RELIABLE, types)
    tokens = [
        ros2.endpoint_token(0, "f00d", 0, 1, "MP", "tb3_0", "node", topic),
        ros2.dds_token("f00d", "MS", "/tb3_0/cmd_vel", ros2.TWIST),
    ]
    examples = [kind.encode() + b"\0" + payload for kind, payload in good.items()]
    examples += [b"token\0" + token.encode() for token in tokens] + [b"attached\0" + ros2.attachment(1, 2, bytes(16))]

    def take(data):
        kind, rest = split(data)
        if kind == "token":
            for style in ("rmw", "ros2dds"):
                ros2.announced(style, rest.decode("utf-8", "replace"))
        elif kind == "attached":
            ros2.attached(rest)
        elif kind in good:
            types.decode(rest, kind)

    yield Target(examples, take, (ValueError,))


def turtlebot_messages():
    good = ros_messages()
    topics = {"odom": ros2.ODOMETRY, "scan": ros2.LASER_SCAN, "battery_state": ros2.BATTERY_STATE}
    token = ros2.dds_token("f00d", "MS", "/tb3_0/cmd_vel", ros2.TWIST_STAMPED).encode() + b"\0\0"
    return [*(f"tb3_0/{topic}\0\0".encode() + good[kind] for topic, kind in topics.items()), token]


@renewed(200, turtlebot_messages, 20_000)
def turtlebot_bridge(net):
    """Odometry, scans, batteries and tokens of a robot."""
    net.first["tb3_0/odom"] = Sample("tb3_0/odom", "", ros_messages()[ros2.ODOMETRY])
    body = TurtleBot3(request("turtlebot3", "ros2dds://tb3_0"))
    body.open()
    with ExitStack() as stack:
        stack.callback(body._close)  # `close` waits until the robot stands
        for k in count(1):
            data = yield
            net.deliver(data, gone=len(data) % 16 == 0)
            (state,) = body.read(0.01 * k)
            assert is_finite(state.position)
            body.command([(0.1, 0.2, 0.0, 0.0)])


@renewed(300, lambda: [b"KH01/cmd_vel\0\0" + ros_messages()[ros2.TWIST_STAMPED]], 10_000, 100)
def turtlebot_twin(net):
    """Commands to the twin of a robot."""
    device = TurtleBot3Twin(DeviceRequest(request("turtlebot3", "turtlebot3-twin"), Faults()))
    for k in count(1):
        net.deliver((yield))
        device.advance(0.01 * k)
        assert np.isfinite(device.truth()[0]).all()


def park_and_goal():
    key = ros2.topic_key("rmw", "/KH01/goal", ros2.POSE_STAMPED, domain=0, types=ros2.types("jazzy"))
    goal = key.encode() + b"\0\0" + ros_messages()[ros2.POSE_STAMPED]
    return [*everything("KH01", "KH02", only=("state", "ranges", "status")), *[goal] * 10]


@renewed(200, park_and_goal, 20_000)
def ros_graph(net):
    """The bridge to ROS 2: states and statuses of robots, goals from ROS."""
    participant = Participant(net.session, ros2.types("jazzy"), style="rmw")
    graph = Graph(net.session, participant, Keys())
    net.deliver(b"park/KH01/alive\0\0")
    graph.poll()
    while True:
        data = yield
        net.deliver(data, gone=len(data) % 16 == 0)
        graph.poll()
