"""The formats of ROS 2 on Zenoh against published literals, and the robots of a realm in the graph of ROS 2."""

import math
import re
import signal
import struct
import threading
import time

import numpy as np
import pytest
import xxhash
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore
from zenoh.ext import Int64, z_serialize
from zenoh.handlers import RingChannel

from agents.network import messages
from agents.network.keys import Keys
from agents.network.pubsub import alive_token, pose_publisher
from agents.network.session import open_session, received
from bridges.ros2 import messages as ros2
from bridges.ros2.bridge import GoalHeight, main, ros_name, scan, transform
from experiments.recording.ros2 import viewers
from tests.commands import started
from tests.waiting import until

JSON = "application/json"
TYPES = ros2.types("jazzy")

HASHES = {
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "geometry_msgs/msg/PoseStamped": "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    "geometry_msgs/msg/Twist": "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    "geometry_msgs/msg/TwistStamped": "5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64",
    "nav_msgs/msg/Odometry": "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "geometry_msgs/msg/TransformStamped": "0a241f87d04668d94099cbb5ba11691d5ad32c2f29682e4eb5653424bd275206",
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "diagnostic_msgs/msg/DiagnosticArray": "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    "sensor_msgs/msg/LaserScan": "64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828",
    "sensor_msgs/msg/Imu": "7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b",
    "sensor_msgs/msg/BatteryState": "4bee5dfce981c98faa6828b868307a0a73f992ed0789f374ee96c8f840e69741",
}


@pytest.mark.parametrize("distro", ["jazzy", "kilted", "rolling"])
def test_hashes_are_the_published_ones(distro):
    types = ros2.types(distro)
    assert {kind: types.hash(kind) for kind in HASHES} == {kind: f"RIHS01_{code}" for kind, code in HASHES.items()}
    assert ros2.types("humble").hash(ros2.TWIST) == "TypeHashNotSupported"


@pytest.mark.parametrize("distro", ["humble", "jazzy"])
def test_cdr_is_identical_to_rosbags(distro):
    types, store = ros2.types(distro), get_typestore(Stores[f"ROS2_{distro.upper()}"])
    twist = types.twist((0.22, 0.0, 0.0), (0.0, 0.0, -2.84))
    stamped = types.make(ros2.TWIST_STAMPED, header=types.header(1700000000.25, "map"), twist=twist)
    pose = types.make(ros2.POSE_STAMPED, header=types.header(12.5, "odom"), pose=types.pose(1.0, -2.0, 0.5, 1.2))
    raw = {}
    for kind, message in ((ros2.TWIST, twist), (ros2.TWIST_STAMPED, stamped), (ros2.POSE_STAMPED, pose)):
        raw[kind] = types.encode(message, kind)
        assert raw[kind] == bytes(store.serialize_cdr(store.deserialize_cdr(raw[kind], kind), kind))
    numbers = struct.pack("<6d", 0.22, 0.0, 0.0, 0.0, 0.0, -2.84)
    head = struct.pack("<iI", 1700000000, 250000000) + struct.pack("<I", 4) + b"map\0"
    assert (raw[ros2.TWIST], raw[ros2.TWIST_STAMPED]) == (b"\0\1\0\0" + numbers, b"\0\1\0\0" + head + numbers)
    for kind, other in ((ros2.TWIST, ros2.TWIST_STAMPED), (ros2.TWIST_STAMPED, ros2.TWIST)):
        with pytest.raises(ros2.UnknownMessage, match=other.rpartition("/")[2]):
            types.decode(raw[kind], other)


def test_transforms_match_tf_bytes_and_are_read_back():
    state = messages.State("tb3-0", 1, 12.5, "running", (1.0, -2.0, 0.5), None, math.pi, None, None, 0.0)
    made = transform(TYPES, state, (1.0, -2.0, 0.5), "tb3_0")
    raw = TYPES.encode(TYPES.make(ros2.TF_MESSAGE, transforms=[made]), ros2.TF_MESSAGE)
    head = struct.pack("<IiI", 1, 12, 500000000) + struct.pack("<I", 4) + b"map\0" + struct.pack("<I", 6) + b"tb3_0\0"
    numbers = struct.pack("<7d", 1.0, -2.0, 0.5, 0.0, 0.0, 1.0, math.cos(math.pi / 2))
    assert raw == b"\0\1\0\0" + head + b"\0\0" + numbers
    (back,) = TYPES.decode(raw, ros2.TF_MESSAGE).transforms
    assert (back.header.frame_id, back.child_frame_id, back.transform) == ("map", "tb3_0", made.transform)
    assert (ros2.TRANSFORMS, ros2.yaw_of(back.transform.rotation)) == ("::,100:,:,:,,", pytest.approx(math.pi))


NAN, INF = math.nan, math.inf


@pytest.mark.parametrize(
    ("bearing", "up", "distance", "grid", "places"),
    [
        pytest.param(  # Multi-ranger: back at +180°, and a ray to the ceiling
            [0.0, 180.0, 90.0, -90.0, 0.0], 90.0, [1.0, 2.0, None, 4.0, 5.0], (-180.0, 90.0), [2.0, 4.0, 1.0, INF],
        ),
        pytest.param([-50.0, 0.0, 50.0], 0.0, [1.0, 2.0, None], (-50.0, 50.0), [1.0, 2.0, INF], id="a fan"),
        pytest.param([350.0, 0.0, 20.0], 0.0, [1.0, 2.0, 3.0], (-10.0, 10.0), [1.0, 2.0, NAN, 3.0], id="a gap"),
        pytest.param([0.0, 2.0, 5.0], 0.0, [1.0, 2.0, 3.0], (0.0, 1.0), [1.0, NAN, 2.0, NAN, NAN, 3.0], id="no steps"),
        pytest.param([7.0], 0.0, [None], (7.0, 1.0), [INF], id="one ray"),
        pytest.param([0.0, 0.0, 10.0], 0.0, [3.0, 2.0, None], (0.0, 10.0), [2.0, INF], id="the nearer hit"),
    ],
)  # fmt: skip
def test_range_readings_are_a_scan_of_equal_steps(bearing, up, distance, grid, places):
    up = [*[0.0] * (len(bearing) - 1), up]
    angles = np.radians([bearing, up]).round(6).tolist()  # as they are sent
    made = scan(TYPES, messages.Ranges("CF01", 12.5, *angles, distance), "CF01")
    back = TYPES.decode(TYPES.encode(made, ros2.LASER_SCAN), ros2.LASER_SCAN)
    assert (back.header.frame_id, back.header.stamp.sec) == ("CF01", 12)
    assert np.degrees([back.angle_min, back.angle_increment]) == pytest.approx(grid, abs=1e-3)
    assert back.angle_max == pytest.approx(back.angle_min + back.angle_increment * (len(places) - 1), abs=1e-5)
    np.testing.assert_array_equal(back.ranges, np.array(places, np.float32))
    assert scan(TYPES, messages.Ranges("R", 1.0, [0.0], [1.570796], [2.0]), "R") is None, "a ray to the ceiling"


@given(st.binary(max_size=120), st.sampled_from([ros2.TWIST, ros2.TWIST_STAMPED, ros2.ODOMETRY, ros2.LASER_SCAN]))
def test_bytes_that_are_no_message_are_refused(raw, kind):
    try:
        TYPES.decode(b"\0\1\0\0" + raw, kind)
    except ros2.UnknownMessage as error:
        assert kind in str(error)  # noqa: PT017 - most bytes are refused, a few are a message


def test_attachment_is_that_of_zenoh_ext():
    source = bytes(range(16))
    raw = ros2.attachment(5, 7, source)
    assert raw == bytes.fromhex("0500000000000000070000000000000010000102030405060708090a0b0c0d0e0f")
    assert raw == z_serialize((Int64(5), Int64(7), source)).to_bytes()
    assert ros2.attached(raw) == (5, 7, source)
    with pytest.raises(ros2.UnknownMessage, match="32 bytes"):
        ros2.attached(raw[:32])


def test_gid_is_xxh3_of_token_low_half_first():
    assert ros2.gid("") == bytes.fromhex("99aa06d3014798d86001c324468d497f")[::-1]  # the published value of no input


def test_keys_of_both_styles():
    plain = ros2.topic_key("ros2dds", "/tb3_0/cmd_vel", ros2.TWIST, domain=0, types=TYPES)
    rmw = ros2.topic_key("rmw", "/tb3_0/cmd_vel", ros2.TWIST, domain=30, types=TYPES)
    assert plain == "tb3_0/cmd_vel"
    assert rmw == f"30/tb3_0/cmd_vel/geometry_msgs::msg::dds_::Twist_/RIHS01_{HASHES[ros2.TWIST]}"
    assert ros2.absolute("", "cmd_vel") == "/cmd_vel"
    assert ros2.absolute("tb3_0", "/diagnostics") == "/diagnostics"
    assert list(map(ros_name, ("CF01", "tb3-0", "3rd", "ä b"))) == ["CF01", "tb3_0", "_3rd", "__b"]


def test_tokens_are_those_of_rmw_zenoh():
    zid = "aac3178e146ba6f1fc6e6a4085e77f21"
    assert ros2.node_token(2, zid, 0, "", "listener") == f"@ros2_lv/2/{zid}/0/0/NN/%/%/listener"
    assert ros2.node_token(0, zid, 3, "a/b", "n") == f"@ros2_lv/0/{zid}/3/3/NN/%/%a%b/n"
    rest = ros2.endpoint_topic("/chatter", "std_msgs/msg/String", ros2.qos(depth=7), TYPES)
    token = ros2.endpoint_token(2, zid, 0, 10, "MP", "", "talker", rest)
    assert token == (
        f"@ros2_lv/2/{zid}/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/"
        f"RIHS01_{HASHES['std_msgs/msg/String']}/::,7:,:,:,,"
    )
    assert ros2.announced("rmw", token) == ros2.TopicEndpoint(
        "/chatter", "std_msgs/msg/String", f"RIHS01_{HASHES['std_msgs/msg/String']}", 2
    )
    assert ros2.announced("rmw", f"{token}/cpu%pub") == ros2.announced("rmw", token), "one more since 0.10.5"
    assert (ros2.RELIABLE, ros2.SENSOR_DATA, ros2.qos(depth=42)) == ("::,10:,:,:,,", "2::,5:,:,:,,", "::,:,:,:,,")
    assert zenoh.KeyExpr(ros2.endpoints("rmw", "MP", "/chatter", domain=2)).includes(zenoh.KeyExpr(token))
    assert not zenoh.KeyExpr(ros2.endpoints("rmw", "MS", "/chatter", domain=2)).intersects(zenoh.KeyExpr(token))
    dds = ros2.dds_token("1f", "MS", "/tb3_0/cmd_vel", ros2.TWIST)
    assert dds.startswith("@/1f/@ros2_lv/MS/tb3_0§cmd_vel/geometry_msgs§msg§Twist/")
    assert ros2.announced("ros2dds", dds) == ros2.TopicEndpoint("/tb3_0/cmd_vel", ros2.TWIST)
    assert zenoh.KeyExpr(ros2.endpoints("ros2dds", "MS", "/tb3_0/cmd_vel")).includes(zenoh.KeyExpr(dds))
    for style in ("rmw", "ros2dds"):
        with pytest.raises(ValueError, match="announces no"):
            ros2.announced(style, "@ros2_lv/0/1f/0")


def test_wrong_command_lines_end_without_a_traceback(capsys):
    assert main(["--connect", "nonsense"]) == 2
    assert "write it like tcp/127.0.0.1:7447" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["--domain", "233"])


class RosNode:
    """Plain zenoh and rosbags: keys, tokens and attachments are spelled here once more, by hand."""

    def __init__(self, session):
        self.session, self.store, self.tokens = session, get_typestore(Stores.ROS2_JAZZY), set()
        self.watch = session.liveliness().declare_subscriber("@ros2_lv/7/**", RingChannel(256), history=True)

    def key(self, topic, kind):
        package, _, name = kind.split("/")
        return f"7/{topic}/{package}::msg::dds_::{name}_/{f'RIHS01_{HASHES[kind]}' if kind in HASHES else '*'}"

    def subscribe(self, topic, kind):
        return self.session.declare_subscriber(self.key(topic, kind), RingChannel(64)), kind

    def take(self, subscription):
        """Messages that have come, with sequence numbers and senders."""
        subscriber, kind = subscription
        found = []
        while (sample := subscriber.try_recv()) is not None:
            sequence, stamp, size, gid = struct.unpack("<qqB16s", sample.attachment.to_bytes())
            assert size == 16
            assert abs(stamp / 1e9 - time.time()) < 10.0
            found.append((self.store.deserialize_cdr(sample.payload.to_bytes(), kind), sequence, gid))
        return found

    def taken(self, subscription, feed=lambda: None, least=1):
        """As `take`, with patience: `feed` is called again and again."""
        found = []
        until(lambda: feed() or found.extend(self.take(subscription)) or len(found) >= least)
        return found

    def graph(self):
        while (sample := self.watch.try_recv()) is not None:
            change = self.tokens.add if sample.kind == zenoh.SampleKind.PUT else self.tokens.discard
            change(str(sample.key_expr))
        return self.tokens

    def topics(self):
        """Role, topic and type of every endpoint, as `ros2 topic list -t` would show them."""
        parts = [token.split("/") for token in self.graph()]
        return {(p[5], p[9].replace("%", "/"), p[10]) for p in parts if p[5] != "NN"}


class Realm:
    """Robots as the bridge sees them."""

    def __init__(self, session):
        self.session, self.keys, self.tokens, self.out = session, Keys("park"), {}, {}

    def enter(self, name):
        self.out[name] = pose_publisher(self.session, self.keys.status(name), JSON)
        self.tokens[name] = alive_token(self.session, self.keys.alive(name))

    def leave(self, name):
        self.tokens.pop(name).undeclare()

    def put(self, key, message):
        self.session.put(key, messages.encode(message), encoding=JSON)

    def state(self, name, position=(0.0, 0.0, 0.5), velocity=(0.0, 0.0, 0.0), yaw=0.0):
        state = messages.State(name, 1, 1700000000.5, "running", position, velocity, yaw, None, None, 0.0)
        self.put(self.keys.state(name), state)

    def ranges(self, name):
        sweep = messages.Ranges(name, 1700000000.5, [0.0, round(math.pi / 2, 6)], [0.0, 0.0], [1.5, None])
        self.put(self.keys.ranges(name), sweep)

    def status(self, name, body=""):
        status = messages.Status(
            name, time.time(), "running", "", body, battery=0.75, sent=10, received=20, lost={"CF02": 1}, ticks=100,
            missed=2, decisions=50, interventions=3, late_s=0.01, pid=1, cpu_s=0.5, rss_mb=30.0,
        )  # fmt: skip
        self.out[name].put(messages.encode(status))


@pytest.fixture
def sides(router):
    """A ROS node and a realm with the bridge between them."""
    with (
        started("-m", "bridges.ros2.bridge", "--connect", router.endpoint, "--domain", "7", stderr=None) as process,
        open_session([router.endpoint], name="realm") as inside,
        open_session([router.endpoint], name="ros") as outside,
    ):
        assert process.stdout.readline() == "ros2 ready: node /zenpark, domain 7, jazzy\n"
        yield RosNode(outside), Realm(inside)
        process.send_signal(signal.SIGTERM)
        assert process.wait(100.0) == 0


def endpoints(*names, scan=False):
    """Endpoints of robots, and of the bridge."""
    found = [("MP", "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"), ("MP", "/tf", ros2.TF_MESSAGE)]
    found.append(("MP", "/scene", ros2.MARKER_ARRAY))
    for name in names:
        found.append(("MP", f"/{name}/pose", ros2.POSE_STAMPED))
        found.append(("MP", f"/{name}/velocity", ros2.TWIST_STAMPED))
        found.append(("MS", f"/{name}/goal", ros2.POSE_STAMPED))
    if scan:
        found.append(("MP", f"/{names[0]}/scan", ros2.LASER_SCAN))
    return {(role, topic, kind.replace("/msg/", "::msg::dds_::") + "_") for role, topic, kind in found}


@pytest.mark.mechanism("ROS 2 bridge")
@pytest.mark.system
def test_robots_are_in_the_graph_of_ros(sides):
    node, realm = sides
    until(lambda: any("/NN/%/%/zenpark" in token for token in node.graph()))
    diagnostics = node.subscribe("diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    poses = node.subscribe("CF01/pose", ros2.POSE_STAMPED)
    frames = node.subscribe("tf", ros2.TF_MESSAGE)
    scans = node.subscribe("CF01/scan", ros2.LASER_SCAN)
    speeds = node.subscribe("CF01/velocity", ros2.TWIST_STAMPED)
    realm.enter("CF01")
    realm.enter("tb3-0")
    wanted = endpoints("CF01", "tb3_0")
    until(lambda: node.topics() == wanted)
    codes = [token.split("/")[11] for token in node.graph() if "/NN/" not in token]
    assert all(re.fullmatch(r"RIHS01_[0-9a-f]{64}", code) for code in codes)

    got = node.taken(poses, lambda: realm.state("CF01", (1.0, -2.0, 0.5), (0.1, 0.2, -0.3), math.pi / 2), least=3)
    message, _, gid = got[0]
    assert message.header.frame_id == "map"
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1700000000, 500000000)
    place, turn = message.pose.position, message.pose.orientation
    assert (place.x, place.y, place.z) == (1.0, -2.0, 0.5)
    assert (turn.z, turn.w) == pytest.approx((math.sqrt(0.5), math.sqrt(0.5)))
    assert [sequence for _, sequence, _ in got] == list(range(1, len(got) + 1))
    token = next(token for token in node.graph() if "/MP/" in token and "%CF01%pose" in token)
    assert gid == xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")
    speed = node.taken(speeds)[0][0].twist.linear
    assert (speed.x, speed.y, speed.z) == (0.1, 0.2, -0.3)
    frame = node.taken(frames)[0][0].transforms[0]
    assert (frame.header.frame_id, frame.child_frame_id, frame.header.stamp.sec) == ("map", "CF01", 1700000000)
    assert (frame.transform.translation.x, frame.transform.rotation) == (1.0, turn)

    drawing = viewers.markers(
        1.7e9, [viewers.Marker("robots", viewers.CYLINDER, (0.1, 0.1, 0.1), (0, 114, 178), frame="CF01")]
    )
    scenes = node.subscribe("scene", ros2.MARKER_ARRAY)
    (marker,) = node.taken(scenes, lambda: realm.session.put(realm.keys.scene, drawing))[0][0].markers
    assert (marker.header.frame_id, marker.header.stamp.sec, marker.frame_locked) == ("CF01", 1700000000, True)

    swept = node.taken(scans, lambda: realm.ranges("CF01"))[0][0]
    assert (swept.header.frame_id, swept.ranges.tolist()) == ("CF01", [1.5, INF])
    assert node.topics() == endpoints("CF01", "tb3_0", scan=True), "the other robot has no range readings"

    statuses = [
        status
        for array, _, _ in node.taken(diagnostics, lambda: realm.status("CF01", "LOCKED"))
        for status in array.status
    ]
    assert (statuses[0].name, statuses[0].level, statuses[0].hardware_id) == ("zenpark: CF01", 1, "CF01")
    assert "LOCKED" in statuses[0].message
    values = {pair.key: pair.value for pair in statuses[0].values}
    assert (values["battery"], values["lost"], values["missed ticks"]) == ("0.750", "1", "2 of 100")

    realm.leave("CF01")
    until(lambda: node.topics() == endpoints("tb3_0"))
    until(lambda: any("gone" in {each.message for each in array.status} for array, _, _ in node.take(diagnostics)))
    realm.enter("CF01")
    until(lambda: node.topics() == wanted)


def test_a_goal_without_height_keeps_the_height():
    height = GoalHeight()
    assert not height.known
    for phase, z in (("ready", 0.0), ("airborne", 1.02), ("running", 1.3)):
        height.follow(phase, z)
    assert [height.of_goal(z) for z in (0.0, 0.5, 0.0)] == [1.02, 0.5, 0.5]
    height.follow("done", 0.0)
    assert height.of_goal(0.0) == 0.0


@pytest.mark.system
def test_goals_come_in(sides):
    node, realm = sides
    goals = realm.session.declare_subscriber("park/CF01/goal", RingChannel(16))
    realm.enter("CF01")
    poses = node.subscribe("CF01/pose", ros2.POSE_STAMPED)
    until(lambda: endpoints("CF01") <= node.topics())
    out = node.session.declare_publisher(node.key("CF01/goal", ros2.POSE_STAMPED))

    def put(raw):
        out.put(raw, attachment=struct.pack("<qqB16s", 1, time.time_ns(), 16, bytes(16)))

    def send(frame, x, yaw):
        pose = TYPES.pose(x, 0.25, 0.5, yaw or 0.0)
        if yaw is None:
            pose.orientation = TYPES.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=0.0)
        message = TYPES.make(ros2.POSE_STAMPED, header=TYPES.header(0.0, frame), pose=pose)
        put(TYPES.encode(message, ros2.POSE_STAMPED))

    node.taken(poses, lambda: realm.state("CF01"))
    put(b"\0\1\0\0garbage")
    send("odom", 3.0, 0.0)  # another frame
    send("map", math.nan, 0.0)
    send("map", 1.5, 0.5)
    send("", 2.5, None)
    samples = []
    until(lambda: samples.extend(received(goals)) or len(samples) >= 2)
    first, second = (messages.decode(s.payload.to_bytes(), str(s.encoding), messages.Goal) for s in samples)
    assert (second.seq - first.seq, first.pose) == (1, 1700000000.5)
    assert first.stamp == pytest.approx(time.time(), abs=5.0)
    assert (first.robot, first.position, first.yaw) == ("CF01", (1.5, 0.25, 0.5), pytest.approx(0.5))
    assert (second.position, second.yaw) == ((2.5, 0.25, 0.5), None)

    def passed_on():
        send("map", 1.0, 0.0)
        threading.Event().wait(0.2)
        return list(received(goals))

    token = alive_token(realm.session, "park/centre/here")  # two cannot guide one robot
    until(lambda: not passed_on())
    token.undeclare()
    until(passed_on)
