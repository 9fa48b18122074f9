"""The protocol twin of the TurtleBot3, heard and told by plain zenoh and rosbags."""

import struct
import time
from math import pi

import numpy as np
import pytest
import zenoh
from rosbags.typesys import Stores, get_typestore
from zenoh.handlers import RingChannel

from agents.body.interface import BodyError
from agents.network.session import open_session
from bridges.turtlebot3.twin import TurtleBot3Twin
from tests.bridges.test_ros2 import HASHES
from tests.bridges.turtlebot3.turtlebots import request
from twins.device import DeviceRequest, Faults

STORE = get_typestore(Stores.ROS2_JAZZY)
BLOCK = zenoh.CongestionControl.BLOCK
KINDS = {
    "odom": "nav_msgs/msg/Odometry",
    "scan": "sensor_msgs/msg/LaserScan",
    "battery_state": "sensor_msgs/msg/BatteryState",
}
COMMANDS = {"humble": "geometry_msgs/msg/Twist", "jazzy": "geometry_msgs/msg/TwistStamped"}


ANNOUNCED = {
    "rmw": ("@ros2_lv/0/**", 5, 9, "NN MS%TB0%cmd_vel MP%TB0%odom MP%TB0%scan MP%TB0%battery_state"),
    "ros2dds": ("@/*/@ros2_lv/**", 3, 4, "MSTB0§cmd_vel MPTB0§odom MPTB0§scan MPTB0§battery_state"),
}


def key_of(style, distro, topic, kind):
    if style == "ros2dds":
        return f"TB0/{topic}"
    package, _, name = kind.split("/")
    code = "TypeHashNotSupported" if distro == "humble" else f"RIHS01_{HASHES[kind]}"
    return f"0/TB0/{topic}/{package}::msg::dds_::{name}_/{code}"


class Listener:
    """A ROS application without ROS; it moves the twin's clock by hand."""

    def __init__(self, session, twin, style="ros2dds", distro="jazzy", wait=None):
        self.twin, self.wait = twin, wait
        self.t, self.inbox = 0.0, {topic: [] for topic in KINDS}
        self.subscribers = {
            topic: session.declare_subscriber(key_of(style, distro, topic, kind), RingChannel(1000))
            for topic, kind in KINDS.items()
        }
        self.kind = COMMANDS[distro]
        self.publisher = session.declare_publisher(key_of(style, distro, "cmd_vel", self.kind))
        self.ends = session.declare_subscriber("end", RingChannel(1))  # behind all others
        (ours,) = twin._sessions.values()
        self.end = ours.declare_publisher("end", priority=zenoh.Priority.DATA_HIGH, congestion_control=BLOCK)
        wait(lambda: self.publisher.matching_status.matching and self.end.matching_status.matching)

    def advance(self, seconds):
        for step in range(1, round(seconds * 100) + 1):
            self.t += 0.01
            self.twin.advance(self.t)
            if step % 50 == 0:  # more at once would be dropped where the network is slow
                self.settle()
        self.take()

    def take(self):
        for topic, subscriber in self.subscribers.items():
            while (sample := subscriber.try_recv()) is not None:
                message = STORE.deserialize_cdr(sample.payload.to_bytes(), KINDS[topic])
                self.inbox[topic].append((message, sample.attachment))

    def count(self, seconds, topic="odom"):
        before = len(self.inbox[topic])
        self.after(seconds)
        return len(self.inbox[topic]) - before

    def after(self, seconds, topic="odom"):
        """The newest message of a topic, that much later, when all have arrived."""
        self.advance(seconds)
        self.settle()
        return self.inbox[topic][-1][0] if self.inbox[topic] else None

    def settle(self):
        """All that the twin has published is here: what follows it in the same queues is."""
        self.end.put("")
        self.wait(self.ends.try_recv)
        self.take()

    def tell(self, v, w, kind=None):
        made, kind = STORE.types, kind or self.kind
        linear, angular = (made["geometry_msgs/msg/Vector3"](x=x, y=0.0, z=z) for x, z in ((v, 0.0), (0.0, w)))
        message = made["geometry_msgs/msg/Twist"](linear=linear, angular=angular)
        if kind.endswith("Stamped"):
            stamp = made["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
            message = made[kind](header=made["std_msgs/msg/Header"](stamp=stamp, frame_id=""), twist=message)
        self.put(bytes(STORE.serialize_cdr(message, kind)))

    def put(self, raw):
        sequence = struct.pack("<qqB16s", 1, time.time_ns(), 16, bytes(range(16)))
        self.publisher.put(raw, attachment=sequence)

    def obey(self, v, w):
        count = self.twin.commands_received[0] + 1
        self.tell(v, w)
        self.wait(lambda: self.advance(0.01) or self.twin.commands_received[0] >= count)


@pytest.fixture
def listen(hub, eventually):
    opened = []

    def make(faults=None, style="ros2dds", distro="jazzy", **kinds):
        device = {"style": style, "distro": distro} | kinds.pop("device", {})
        twin = TurtleBot3Twin(DeviceRequest(request(hub.endpoint, device=device, **kinds), faults or Faults()))
        session = open_session([hub.endpoint], name="listener")
        opened.extend([twin, session])
        return Listener(session, twin, style, distro, eventually)

    yield make
    for each in opened:
        each.close()


@pytest.mark.system
@pytest.mark.parametrize("distro", ["humble", "jazzy"])
@pytest.mark.parametrize("style", ["ros2dds", "rmw"])
def test_says_what_turtlebot3_node_says(listen, style, distro):
    listener = listen(style=style, distro=distro)
    assert listener.count(4.0) == 80
    listener.inbox["scan"].clear()
    assert listener.count(4.0, "scan") == 20
    assert listener.count(4.0, "battery_state") == 4
    odometry, attachment = listener.inbox["odom"][-1]
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_footprint")
    scan = listener.inbox["scan"][-1][0]
    assert np.isinf(scan.ranges).tolist() == [True] * 360
    assert scan.angle_increment == pytest.approx(pi / 180.0)
    assert scan.angle_max == pytest.approx(scan.angle_min + 359 * scan.angle_increment)
    battery = listener.inbox["battery_state"][-1][0]
    assert 99.0 < battery.percentage < 100.0  # per cent, as the robot does and ROS does not want
    assert battery.voltage == pytest.approx(12.3, abs=0.01)
    if style == "ros2dds":
        assert attachment is None
    else:
        numbers = [struct.unpack("<qqB16s", a.to_bytes()) for _, a in listener.inbox["odom"]]
        assert {(size, gid) for _, _, size, gid in numbers} == {(16, numbers[0][3])}
        assert np.diff([sequence for sequence, *_ in numbers]).tolist() == [1] * (len(numbers) - 1)


@pytest.mark.system
@pytest.mark.parametrize("distro", ["humble", "jazzy"])
@pytest.mark.parametrize("style", ["ros2dds", "rmw"])
def test_obeys_its_type_of_command_and_no_other(listen, style, distro):
    listener = listen(style=style, distro=distro)
    wrong = COMMANDS["jazzy" if distro == "humble" else "humble"]
    listener.tell(0.2, 0.0, wrong)
    listener.put(b"")
    listener.put(b"\0\1\0\0rubbish")
    listener.tell(float("nan"), 0.0)
    listener.obey(0.1, 0.0)
    assert listener.after(1.0).twist.twist.linear.x == pytest.approx(0.1)
    assert listener.twin.commands_received == [1]


@pytest.mark.system
def test_cuts_and_limits_speeds_and_holds_them(listen):
    listener = listen()
    for command, made in (((0.139, -0.999), (0.13, -0.99)), ((0.29, 0.0), (0.22, 0.0)), ((0.0, -9.0), (0.0, -2.84))):
        listener.obey(*command)
        twist = listener.after(5.0).twist.twist  # no watchdog: one command is for ever
        assert (twist.linear.x, twist.angular.z) == pytest.approx(made, abs=1e-5)


@pytest.mark.mechanism("TurtleBot3 twin: watchdog")
@pytest.mark.system
def test_a_watchdog_stops_it(listen):
    listener = listen(device={"watchdog_s": 0.5})
    listener.obey(0.2, 0.0)
    listener.advance(1.0)
    before = listener.twin.truth()[0]
    assert 0.08 < before[0, 0] < 0.13  # half a second at 0.2 m/s, and rolling out
    listener.advance(1.0)
    np.testing.assert_array_equal(listener.twin.truth()[0], before)


@pytest.mark.system
def test_loss_delay_and_an_empty_battery(listen):
    listener = listen(faults=Faults(delay_s=0.5))
    assert [listener.count(0.5), listener.count(0.5)] == [0, 10]
    assert 0.6 < listen(faults=Faults(loss=0.3)).count(20.0) / 400 < 0.8
    listener = listen(faults=Faults(battery=0.5, drain=900.0))
    listener.after(4.0)
    charges = [battery.percentage for battery, _ in listener.inbox["battery_state"]]
    assert set(np.round(np.diff(charges))) == {-10.0}
    assert listener.after(6.0, "battery_state").percentage == 0.0


@pytest.mark.system
@pytest.mark.parametrize("style", ANNOUNCED)
def test_is_announced_until_it_is_closed(hub, eventually, style):
    pattern, role, topic, wanted = ANNOUNCED[style]
    with pytest.raises(BodyError, match=r"TB0: device: .*`colour`"):
        TurtleBot3Twin(DeviceRequest(request(hub.endpoint, device={"colour": 1}), Faults()))
    twin = TurtleBot3Twin(DeviceRequest(request(hub.endpoint, device={"style": style}), Faults()))
    with open_session([hub.endpoint], name="listener") as session:

        def announced():
            tokens = [str(reply.ok.key_expr).split("/") for reply in session.liveliness().get(pattern, timeout=1.0)]
            return {parts[role] + "".join(parts[topic : topic + 1]) for parts in tokens}

        eventually(lambda: announced() == set(wanted.split()))
        assert twin.sockets() == ()
        twin.close()
        eventually(lambda: announced() == set())
