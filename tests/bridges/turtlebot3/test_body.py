"""The TurtleBot3 bridge against the protocol twin, through a real router."""

import os
import signal
import struct
import subprocess
import sys
import threading
import time
from dataclasses import replace
from math import pi
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xxhash
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore
from zenoh.handlers import RingChannel

from agents.body.interface import UNANSWERED, BodyError
from agents.body.kinds import KHEPERA4
from agents.network.session import open_session
from agents.protocols import ros2, turtlebot3
from bridges.turtlebot3 import body as bridge
from bridges.turtlebot3.body import DIAGNOSIS_S, OPEN_S, TurtleBot3
from bridges.turtlebot3.robot import Robot, StampAge, ranges
from tests.bridges.turtlebots import FastClock, Stage, clock, request
from tests.conftest import RouterProcess
from tests.waiting import until
from twins.devices.device import Faults

ROOT = Path(__file__).resolve().parents[3]
NOWHERE = "tcp/127.0.0.1:9"
STYLES = ["ros2dds", "rmw"]


@pytest.fixture(scope="module")
def hub():
    """One router for all tests that leave it alone."""
    made = RouterProcess()
    yield made
    made.stop()


# ---------------------------------------------------------------------- without a network


@given(st.floats(-3.5, 3.5))
def test_the_robot_does_what_the_bridge_meant(speed):
    made = turtlebot3.cut(turtlebot3.whole(speed, 2.84))
    assert abs(made - max(-2.84, min(2.84, speed))) <= 0.005 + 1e-9
    assert abs(made * 100 - round(made * 100)) < 1e-9


def test_every_whole_speed_survives_the_truncation():
    for limit in (0.22, 2.84):
        for steps in range(round(100 * limit) + 1):
            for sign in (1.0, -1.0):
                assert turtlebot3.cut(turtlebot3.whole(sign * steps / 100.0, limit)) == sign * steps / 100.0
    assert turtlebot3.cut(0.29) == 0.28  # why a speed is not sent as it is


@pytest.mark.parametrize(
    ("voltage", "percentage", "charge"),
    [
        (12.3, 100.0, 1.0),
        (11.4, 50.0, 0.5),
        (10.4, 12.0, 0.0),  # the firmware stops counting below 10.5 V
        (0.0, 0.4, 0.4),  # a robot that keeps to the ROS message
        (10.518, 1.0, 0.01),  # one per cent, not full
        (np.nan, 80.0, 0.8),
    ],
)
def test_charge(voltage, percentage, charge):
    assert turtlebot3.charge(voltage, percentage) == pytest.approx(charge, abs=1e-6)


@pytest.mark.parametrize(
    ("address", "device", "message"),
    [
        ("ros2dds://tb3-0", {}, "TB0: 'tb3-0' is no ROS namespace"),
        ("rmw://tb3_0?domain=500", {}, "domain '500' is no number from 0 to 232"),
        ("rmw://tb3_0?distro=foxy", {}, "distro 'foxy' is not known"),
        ("rmw://tb3_0?colour=red", {}, "'colour' is no part"),
        ("radio://0", {}, "is no TurtleBot3: write it like ros2dds://tb3_0"),
        ("ros2dds://", {"speed": 1.0}, r"TB0: device: Object contains unknown field `speed`"),
        ("ros2dds://", {"domain": -1}, r"`int` >= 0 - at `\$.domain`"),
        ("ros2dds://", {"distro": "foxy"}, r"at `\$.distro`"),
    ],
)
def test_wrong_addresses_and_settings_are_named(address, device, message):
    with pytest.raises(BodyError, match=message):
        TurtleBot3(request(NOWHERE, addresses=(address,), device=device))


def test_drives_turtlebots_only():
    with pytest.raises(BodyError, match="TB0 is a khepera4"):
        TurtleBot3(replace(request(NOWHERE, addresses=("ros2dds://",)), kinds=(KHEPERA4,)))


def test_addresses():
    where = turtlebot3.address("TB0", "rmw://fleet/tb3_0?distro=humble", turtlebot3.TurtleBot3Settings(domain=30))
    assert where == turtlebot3.Address("rmw", "fleet/tb3_0", "humble", 30)
    assert str(where) == "rmw://fleet/tb3_0?domain=30&distro=humble"
    assert turtlebot3.address("TB0", "ros2dds://", turtlebot3.TurtleBot3Settings()).namespace == ""
    assert turtlebot3.command_type("humble", None) == ros2.TWIST
    assert turtlebot3.command_type("jazzy", None) == ros2.TWIST_STAMPED
    assert turtlebot3.command_type("jazzy", stamped=False) == ros2.TWIST


def test_rays_that_saw_nothing_are_nan():
    types = ros2.types("jazzy")
    distance = np.array([1.0, np.inf, 0.0, 0.11, 3.5, 3.6, np.nan], np.float32)
    scan = types.make(
        ros2.LASER_SCAN,
        header=types.header(1.0, "base_scan"),
        angle_min=-0.5,
        angle_max=0.1,
        angle_increment=0.1,
        time_increment=0.0,
        scan_time=0.2,
        range_min=0.12,
        range_max=3.5,
        ranges=distance,
        intensities=distance,
    )
    found = ranges(scan, 7.0)
    assert found.time == 7.0
    np.testing.assert_allclose(found.bearing, np.linspace(-0.5, 0.1, 7), atol=1e-9)
    np.testing.assert_allclose(found.distance, [1.0, np.nan, np.nan, np.nan, 3.5, np.nan, np.nan])


@pytest.mark.parametrize(
    ("first", "increment", "farthest", "seen"),
    [(-0.5, 0.1, np.inf, 1.0), (-0.5, np.nan, 3.5, np.nan), (np.inf, 0.1, 3.5, np.nan), (-0.5, 0.1, np.nan, np.nan)],
)
def test_rays_are_finite_or_nothing(first, increment, farthest, seen):
    scan = SimpleNamespace(
        angle_min=first, angle_increment=increment, range_min=0.0, range_max=farthest,
        ranges=np.array([0.0, 1.0, np.inf, -np.inf], np.float32),
    )  # fmt: skip
    found = ranges(scan, 7.0)
    assert np.isfinite(found.bearing).all()
    np.testing.assert_array_equal(found.distance, [np.nan, seen, np.nan, np.nan])


@pytest.mark.parametrize(
    ("arrivals", "stamps", "ages"),
    [
        ([10.0, 10.1, 12.2, 12.2, 12.3], [5.0, 5.1, 5.2, 7.1, 7.3], [0.0, 0.0, 2.0, 0.1, 0.0]),  # a link held it back
        ([10.0, 10.1, 10.2], [5.0, 2.1, 2.2], [0.0, 0.0, 0.0]),  # its clock was set back
        ([10.0, 10.1, 10.2], [5.0, 9999.1, 9999.2], [0.0, 0.0, 0.0]),  # or ahead
        ([10.0, 99.0, 999.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]),  # it has none
        ([1000.0, 3000.0], [0.0, 1999.0], [0.0, 0.0]),  # it goes slower than ours
    ],
)
def test_age_by_stamps_of_another_clock(arrivals, stamps, ages):
    stamped = StampAge()
    assert [stamped.age(*pair) for pair in zip(arrivals, stamps, strict=True)] == pytest.approx(ages, abs=0.005)


# ---------------------------------------------------------------------- driving


@pytest.mark.system
@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("distro", ["humble", "jazzy"])
def test_drives_to_goals(hub, style, distro):
    start, goal = ((1.0, 0.5), (-1.0, 0.0)), np.array([[1.3, 0.3], [-1.1, 0.3]])
    asked = request(hub.endpoint, start=start, yaw=(1.0, -2.0), device={"style": style, "distro": distro})
    with Stage(asked) as stage:
        assert stage.twin.addresses[0] == (
            f"ros2dds://TB0?distro={distro}" if style == "ros2dds" else f"rmw://TB0?domain=0&distro={distro}"
        )
        stage.body.open()
        state = stage.run(0.1)
        np.testing.assert_allclose(state.position[:, :2], start, atol=1e-6)
        np.testing.assert_allclose(state.yaw, (1.0, -2.0), atol=1e-6)
        assert stage.twin.commands_received == [0, 0]  # rows of NaN are not sent
        state = stage.run(9.0, stage.toward(goal))
        assert np.linalg.norm(stage.place - goal, axis=1).max() < 0.01
        assert np.linalg.norm(state.position[:, :2] - stage.place, axis=1).max() < 0.005
        assert (state.notes, state.flying.any()) == (("", ""), False)
        assert (stage.t - state.time < 0.2).all()
        assert (state.battery > 0.99).all()
        assert stage.body.inspect(0).volts > 12.0
        assert np.bincount(state.rays.row).tolist() == [360, 360]
        assert np.isnan(state.rays.scan_of(0).distance).all()


@pytest.mark.system
def test_an_empty_namespace_two_domains_and_another_router(hub):
    asked = request(hub.endpoint, device={"style": "rmw", "domain": 30, "endpoint": hub.endpoint})
    asked = replace(asked, endpoints=(NOWHERE,))
    with Stage(asked) as stage:
        assert stage.twin.addresses == ("rmw://TB0?domain=30&distro=jazzy",)
        stage.body.open()
        assert stage.moved(2.0, stage.constant(0.2))[0] > 0.3
    types = get_typestore(Stores.ROS2_HUMBLE)
    with open_session([hub.endpoint], name="robot") as session:
        out = session.declare_publisher("odom")
        kinds = types.types
        zero = kinds["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
        message = kinds["nav_msgs/msg/Odometry"](
            header=kinds["std_msgs/msg/Header"](
                stamp=kinds["builtin_interfaces/msg/Time"](sec=1, nanosec=2), frame_id=""
            ),
            child_frame_id="",
            pose=kinds["geometry_msgs/msg/PoseWithCovariance"](
                pose=kinds["geometry_msgs/msg/Pose"](
                    position=kinds["geometry_msgs/msg/Point"](x=4.0, y=5.0, z=0.0),
                    orientation=kinds["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
                ),
                covariance=np.zeros(36),
            ),
            twist=kinds["geometry_msgs/msg/TwistWithCovariance"](
                twist=kinds["geometry_msgs/msg/Twist"](linear=zero, angular=zero), covariance=np.zeros(36)
            ),
        )
        raw = bytes(types.serialize_cdr(message, "nav_msgs/msg/Odometry"))
        body = TurtleBot3(request(hub.endpoint, addresses=("ros2dds://",), device={"origin": "boot"}))
        heard = session.declare_subscriber("cmd_vel", RingChannel(4))
        opening = threading.Thread(target=body.open)
        opening.start()
        while opening.is_alive():
            out.put(raw)
            opening.join(0.01)
        out.put(raw)
        state = body.read(0.0)
        np.testing.assert_allclose(state.position, [[4.0, 5.0, 0.0]])
        body.stop(np.array([0]))
        body.close()
        assert heard.recv().payload.to_bytes()[-48:] == bytes(48)


@pytest.mark.system
def test_what_it_sends_is_what_rmw_zenoh_sends(hub, eventually):
    asked = request(hub.endpoint, device={"style": "rmw"})
    code = "RIHS01_5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64"
    with open_session([hub.endpoint], name="ros") as session, Stage(asked) as stage:
        tokens = session.liveliness().declare_subscriber("@ros2_lv/0/**", RingChannel(64), history=True)
        heard = session.declare_subscriber(
            f"0/TB0/cmd_vel/geometry_msgs::msg::dds_::TwistStamped_/{code}", RingChannel(64)
        )
        stage.body.open()
        stage.run(1.0, stage.constant(0.1, -0.5))
        samples = []
        eventually(lambda: (s := heard.try_recv()) is None or samples.append(s))
        announced = []
        eventually(lambda: (s := tokens.try_recv()) is None or announced.append(str(s.key_expr)))
        mine = [token for token in announced if "/MP/" in token and "/zenpark_TB0/%TB0%cmd_vel/" in token]
        assert len(mine) == 1
        gid = xxhash.xxh3_128_intdigest(mine[0].encode()).to_bytes(16, "little")
        attached = [struct.unpack("<qqB16s", sample.attachment.to_bytes()) for sample in samples]
        assert [sequence for sequence, *_ in attached] == list(range(1, len(samples) + 1))
        assert {(size, source) for _, _, size, source in attached} == {(16, gid)}
        twist = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr(
            samples[0].payload.to_bytes(), "geometry_msgs/msg/TwistStamped"
        )
        assert int(twist.twist.linear.x * 100) == 10
        assert int(twist.twist.angular.z * 100) == -50
        assert abs(twist.header.stamp.sec - FastClock().utc()) < 10
        assert sum(token.endswith("/NN/%/%TB0/zenpark_TB0") for token in announced) == 1
        assert any("/MS/" in token and "%TB0%odom" in token for token in announced)


@pytest.mark.system
def test_speeds_are_within_the_limits_and_commands_are_repeated(hub):
    with Stage(request(hub.endpoint)) as stage:
        stage.body.open()
        stage.run(1.0, stage.constant(9.0))
        v = stage.run(0.5, stage.constant(9.0)).velocity[0, 0]
        assert v == pytest.approx(0.22, abs=1e-6)
        before = stage.twin.commands_received[0]
        stage.run(2.0, stage.constant(9.0))
        assert 20 <= stage.twin.commands_received[0] - before <= 60  # 20 Hz


@pytest.mark.system
def test_nobody_commands_and_it_stands(hub):
    with Stage(request(hub.endpoint)) as stage:
        stage.body.open()
        assert stage.moved(1.0, stage.constant(0.2))[0] > 0.1
        stage.run(1.0)  # rows of NaN: the robot itself would go on for ever
        assert stage.moved(0.5)[0] == 0.0


@pytest.mark.system
def test_loop_that_hangs_leaves_it_standing(hub):
    """Nothing is read nor commanded any more, while the robot's router answers all the time."""
    with Stage(request(hub.endpoint)) as stage:
        stage.body.open()
        stage.run(1.0, stage.constant(0.2))
        before = stage.place
        until(lambda: not stage.twin._twist.any(), "it stands")
        assert np.linalg.norm(stage.place - before) < 0.5
        until(lambda: stage.moved(0.5, stage.constant(0.2))[0] > 0.05, "and drives on when it is told to")


@pytest.mark.system
def test_odometry_held_back_is_old(hub):
    with Stage(request(hub.endpoint)) as stage:
        stage.body.open()
        stage.run(1.0, stage.constant(0.2))
        stage.twin._link.faults = Faults(delay_s=2.0)
        until(lambda: "old by its stamps" in stage.run(0.1, stage.constant(0.2)).notes[0], "it is noticed")
        assert stage.t - stage.state.time[0] == pytest.approx(2.0, abs=0.5)


@pytest.mark.system
@pytest.mark.parametrize(
    "how", ["land", pytest.param("stop", marks=pytest.mark.mechanism("TurtleBot3 bridge: emergency stop")), "close"]
)
def test_ends_standing(hub, how):
    with Stage(request(hub.endpoint)) as stage:
        stage.body.open()
        stage.run(1.0, stage.constant(0.2, 1.0))
        rows = np.array([0])
        if how == "close":
            stage.body.close()
            threading.Event().wait(0.1)  # the twin lives on: it rolls out
            before = stage.place
            stage.body.stop(rows)  # nothing left to stop, and nothing is raised
            threading.Event().wait(0.1)
            np.testing.assert_array_equal(stage.place, before)
            return
        getattr(stage.body, how)(rows)
        until(lambda: stage.moved(0.5)[0] == 0.0, "it stands")
        stage.body.takeoff(rows, np.array([0.5]))
        until(lambda: stage.moved(0.5, stage.constant(0.2))[0] > 0.05, "and drives on when it is told to")


@pytest.mark.system
def test_external_positions_with_the_speed_of_odometry(hub):
    asked = request(hub.endpoint, start=((2.0, 2.0),), external=True)
    with Stage(asked, faults=Faults(silent_from_s=4.0)) as stage:
        stage.body.open()
        assert np.isnan(stage.run(0.1).position[0, :2]).all()

        def located(state):
            (x, y), yaw = stage.place[0], stage.twin.truth()[1][0] + pi / 2  # the arena is turned against the start
            stage.body.locate(0, stage.t, np.array([-y, x, 0.1]), yaw)
            return stage.constant(0.2)(state)

        state = stage.run(2.0, located)
        x, y = stage.place[0]
        np.testing.assert_allclose(state.position[0], [-y, x, 0.1], atol=0.01)
        np.testing.assert_allclose(state.velocity[0], [0.0, 0.2, 0.0], atol=1e-6)
        assert state.yaw[0] == pytest.approx(pi / 2)
        # seen from outside, but it does not answer
        until(lambda: "odometry silent" in stage.run(0.1, located).notes[0], "its silence is noticed")
        assert stage.t - stage.state.time[0] > 0.5


@pytest.mark.system
def test_it_stands_on_its_start_pose_wherever_its_odometry_is(hub):
    asked = request(hub.endpoint, start=((1.0, 1.0),), yaw=(pi / 2,))
    with Stage(asked) as stage:
        stage.body.open()
        stage.run(2.5, stage.constant(0.2))
        stage.run(1.0)
        stage.body.close()
        asked = replace(asked, addresses=stage.twin.addresses)
        here, boot = (TurtleBot3(replace(asked, device=({"origin": origin},))) for origin in ("open", "boot"))
        for body, place in ((here, (1.0, 1.0)), (boot, stage.place[0])):
            body.open()
            state = body.read(0.0)
            body.close()
            np.testing.assert_allclose(state.position[0, :2], place, atol=1e-3)
            assert state.yaw[0] == pytest.approx(pi / 2, abs=1e-3)
        assert stage.place[0, 1] > 1.3


# ---------------------------------------------------------------------- what goes wrong


@pytest.mark.system
@pytest.mark.parametrize("style", STYLES)
def test_the_wrong_type_of_command_moves_nothing_and_is_said(hub, style):
    asked = request(hub.endpoint, device={"style": style, "stamped": False})
    with Stage(asked) as stage:
        stage.body = TurtleBot3(replace(asked, addresses=stage.twin.addresses, device=({},)))
        stage.body.open()
        assert stage.moved(1.0, stage.constant(0.2))[0] == 0.0
        assert stage.twin.commands_received == [0]
        assert stage.state.notes[0] == (
            "cmd_vel is not received: the robot expects a geometry_msgs/msg/Twist, "
            "we send a geometry_msgs/msg/TwistStamped as on jazzy: set distro or stamped"
        )


@pytest.mark.system
def test_a_robot_that_does_not_move_is_said_so(hub):
    with Stage(request(hub.endpoint)) as stage:
        stage.body.open()
        stage.twin._top[:] = 0.0  # as with its motors off
        stage.run(1.0, stage.constant(0.2))
        assert stage.state.notes == ("",)
        stage.run(1.0, stage.constant(0.2))
        assert stage.state.notes[0].startswith("does not move despite commands: motors on?")
        stage.run(0.1, stage.constant(0.0))
        assert stage.state.notes == ("",)


@pytest.mark.system
@pytest.mark.parametrize(
    "watchdog", [None, pytest.param(0.5, marks=pytest.mark.mechanism("TurtleBot3 bridge: silent robot"))]
)
def test_a_silent_robot_gets_zeros_until_it_hears_them(hub, watchdog):
    device = {"watchdog_s": watchdog} if watchdog else {}
    with Stage(request(hub.endpoint, device=device), faults=Faults(silent_from_s=3.0, silent_for_s=3.0)) as stage:
        stage.body.open()
        until(lambda: stage.run(0.1, stage.constant(0.2)).notes[0], "its silence is noticed")
        assert stage.state.notes[0].startswith("odometry silent for ")
        assert stage.t - stage.state.time[0] > 0.5
        if watchdog:
            until(lambda: stage.moved(0.2)[0] == 0.0, "its watchdog stops it")
        else:  # it goes on with the last command
            assert stage.moved(1.0)[0] == pytest.approx(0.2, abs=0.1)
        until(lambda: not stage.run(0.1).notes[0], "it is heard again")
        until(lambda: stage.moved(0.5)[0] == 0.0, "zeros have reached it")
        until(lambda: stage.moved(0.5, stage.constant(0.2))[0] > 0.05, "it drives on")


@pytest.mark.system
def test_a_stop_that_is_not_answered_is_said(hub):
    with Stage(request(hub.endpoint), faults=Faults(silent_from_s=2.0, silent_for_s=8.0)) as stage:
        stage.body.open()
        while stage.run(0.1, stage.constant(0.2)).notes[0] == "":
            assert stage.t < 6.0
        stage.body.stop(np.array([0]))
        stage.run(1.0, stage.constant(0.0))
        assert stage.state.notes[0].startswith("odometry silent")
        while not stage.run(0.1).notes[0].startswith(f"{UNANSWERED}; odometry silent"):
            assert stage.t < 9.0
        while stage.run(0.1).notes[0]:
            assert stage.t < 15.0
        assert stage.moved(0.5)[0] == 0.0


def test_one_that_cannot_be_told_keeps_nobody_from_being_stopped():
    body = TurtleBot3(request("tcp/127.0.0.1:1", start=((0.0, 0.0), (1.0, 0.0)), addresses=("rmw://a", "rmw://b")))
    told = []

    def fails(_now):
        raise OSError("its session is closed")

    body._robots[0].halt, body._robots[1].halt, body._sessions = fails, told.append, {(): None}
    for what in (body.land, body.stop):
        with pytest.raises(OSError, match="its session is closed"):
            what(np.arange(2))
    assert len(told) == 2


TWIN = """
import select, sys, time
from tests.bridges.turtlebots import request
from twins.devices.device import DeviceRequest, Faults
from twins.devices.turtlebot3 import TurtleBot3Twin
twin = TurtleBot3Twin(DeviceRequest(request(sys.argv[1]), Faults()))
print(twin.addresses[0], flush=True)
zero = time.monotonic()
while not select.select([sys.stdin], [], [], 0.01)[0]:  # whoever started it is there
    twin.advance(time.monotonic() - zero)
"""


class TwinProcess:
    def __init__(self, endpoint):
        self.process = subprocess.Popen(
            [sys.executable, "-c", TWIN, endpoint],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.address = self.process.stdout.readline().strip()

    def kill(self):
        os.kill(self.process.pid, signal.SIGKILL)
        self.process.wait(30)
        self.process.stdin.close()
        self.process.stdout.close()


@pytest.mark.system
def test_a_killed_robot_goes_stale_and_comes_back(hub, eventually):
    twin = TwinProcess(hub.endpoint)
    body = TurtleBot3(request(hub.endpoint, start=((1.0, 1.0),), addresses=(twin.address,)))
    body.open()
    zero = time.monotonic()
    go = np.array([[0.2, 0.0, 0.0, 0.0]])

    def read():
        state = body.read(time.monotonic() - zero)
        body.command(go)
        return state

    eventually(lambda: read().position[0, 0] > 1.15)
    twin.kill()
    eventually(lambda: read().notes[0] == "odometry silent for 1 s")
    last = read()
    assert time.monotonic() - zero - last.time[0] > 0.5
    twin = TwinProcess(hub.endpoint)  # counts from zero again
    eventually(lambda: read().notes[0].startswith("odometry was restarted"))
    assert abs(read().position[0, 0] - last.position[0, 0]) < 0.1
    eventually(lambda: read().position[0, 0] > last.position[0, 0] + 0.1)
    body.close()
    twin.kill()


@pytest.mark.system
def test_the_router_dies_and_comes_back(router, eventually):
    with Stage(request(router.endpoint, device={"watchdog_s": 0.5})) as stage:
        stage.body.open()
        stage.run(0.5, stage.constant(0.2))
        router.kill()
        eventually(lambda: stage.run(0.1, stage.constant(0.2)).notes == ("no router",))
        stage.run(1.0, stage.constant(0.2))
        assert stage.moved(0.5, stage.constant(0.2))[0] == 0.0
        router.start()
        eventually(lambda: stage.run(0.1, stage.constant(0.2)).notes == ("",))
        assert stage.moved(1.0, stage.constant(0.2))[0] > 0.1


@pytest.mark.system
@pytest.mark.parametrize("style", STYLES)
def test_an_absent_robot_is_named_in_time(hub, style):
    with Stage(request(hub.endpoint, device={"style": style})):
        body = TurtleBot3(request(hub.endpoint, addresses=(f"{style}://tb3_7",)), clock)
        with pytest.raises(BodyError, match=r"TB0: no odometry on '.*tb3_7/odom.*is the robot on.*: TB0$"):
            body.open()
        assert OPEN_S + DIAGNOSIS_S < 5.0


@pytest.mark.system
def test_a_robot_in_another_domain_or_of_another_distribution_is_recognised(hub):
    with Stage(request(hub.endpoint, device={"style": "rmw", "distro": "humble", "domain": 30})) as stage:
        other = TurtleBot3(request(hub.endpoint, addresses=("rmw://TB0?domain=0&distro=humble",)), clock)
        with pytest.raises(BodyError, match=r"published in domain 30: write rmw://TB0\?domain=30"):
            other.open()
        stage.body = TurtleBot3(request(hub.endpoint, addresses=("rmw://TB0?domain=30&distro=jazzy",)), clock)
        with pytest.raises(BodyError, match="type hash TypeHashNotSupported: set another distro than jazzy"):
            stage.body.open()


@pytest.mark.system
def test_no_router_is_named_in_time(monkeypatch):
    monkeypatch.setattr(bridge, "OPEN_S", 0.5)
    begin = time.monotonic()
    with pytest.raises(BodyError, match=r"TB0: no router answers at tcp/127\.0\.0\.1:9"):
        TurtleBot3(request(NOWHERE, addresses=("ros2dds://tb3_0",))).open()
    assert 0.5 < time.monotonic() - begin < 2.0
    assert OPEN_S < 5.0
    with pytest.raises(BodyError, match="TB0: 'nonsense' is not an endpoint"):
        TurtleBot3(request("nonsense", addresses=("ros2dds://tb3_0",))).open()


def odometry(x: float, stamp: float) -> SimpleNamespace:
    still = SimpleNamespace(linear=SimpleNamespace(x=0.0), angular=SimpleNamespace(z=0.0))
    ahead = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    pose = SimpleNamespace(position=SimpleNamespace(x=x, y=0.0), orientation=ahead)
    header = SimpleNamespace(stamp=SimpleNamespace(sec=int(stamp), nanosec=round(stamp % 1.0 * 1e9)))
    return SimpleNamespace(
        header=header, pose=SimpleNamespace(pose=pose), twist=SimpleNamespace(twist=still)
    )  # fmt: skip


def test_two_robots_of_one_namespace_have_no_position() -> None:
    robot = Robot(request("tcp/127.0.0.1:1", addresses=("ros2dds://tb3_0",)), 0)
    robot._types, robot._command_type = ros2.types("humble"), ros2.TWIST
    waiting: list[SimpleNamespace] = []
    nothing = SimpleNamespace(newest=lambda: None)
    robot._odometry = SimpleNamespace(received=lambda: [waiting.pop()])  # type: ignore[assignment]
    robot._scan = robot._battery = nothing  # type: ignore[assignment]
    robot._watch = SimpleNamespace(handler=SimpleNamespace(try_recv=lambda: None))  # type: ignore[assignment]

    def hear(k: int, x: float) -> None:
        waiting.append(odometry(x, 100.0 + 0.05 * k))
        robot.receive_messages(0.05 * k, 0.05 * k)

    for k in range(20):
        hear(k, 3.0 if k == 10 else 0.0)  # there and back: it may have been restarted
    assert robot.time == pytest.approx(0.95)
    assert "was restarted" in robot.note(0.95, linked=True)
    for k in range(20, 40):
        hear(k, 3.0 * (k % 2))
    assert robot.time < 1.1
    assert "do two robots have this namespace?" in robot.note(1.95, linked=True)
    for k in range(40, 160):
        hear(k, 0.0)
    assert robot.time == pytest.approx(7.95)


def test_stale_commands_are_followed_by_zeros() -> None:
    """Also when the loop does not run, and when another robot cannot be told."""
    now = [100.0]
    body = TurtleBot3(
        request("tcp/127.0.0.1:1", start=((0.0, 0.0), (1.0, 0.0)), addresses=("rmw://a", "rmw://b")),
        clock=lambda: now[0],
    )
    sent: list[float] = []
    types = ros2.types("humble")

    def fails(_message):
        raise StopIteration

    for robot, put in zip(body._robots, (fails, lambda message: sent.append(message.linear.x)), strict=True):
        robot._types, robot._command_type = types, ros2.TWIST
        robot._command = SimpleNamespace(put=put)  # type: ignore[assignment]
        robot.odometry_received = 1e9
        robot._sent_at = 100.0
        robot.drive(0.1, 0.0, 100.0)

    class Rounds:
        def wait(self, period):
            now[0] += period
            return now[0] > 101.0

    body._ending = Rounds()  # type: ignore[assignment]
    body._stop_stale()
    assert set(sent) == {0.0}
    assert len(sent) >= 4


def test_a_command_from_before_a_suspension_is_sent_as_zeros() -> None:
    robot = Robot(request("tcp/127.0.0.1:1", addresses=("ros2dds://tb3_0",)), 0)
    sent = []
    robot._types, robot._command_type = ros2.types("humble"), ros2.TWIST
    robot._command = SimpleNamespace(put=lambda message: sent.append(message.linear.x))  # type: ignore[assignment]
    robot.odometry_received = 103.0
    robot.drive(0.1, 0.0, 100.0)  # decided on what was read then, commanded after the suspension
    robot.send_command(103.0)
    assert sent == [0.0]
    robot.drive(0.1, 0.0, 103.0)
    robot.send_command(103.1)
    assert sent[-1] == pytest.approx(0.102)
