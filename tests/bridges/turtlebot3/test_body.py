"""The TurtleBot3 bridge: numbers, a ROS that is not there, and the protocol twin through a real router."""

import threading
import time
from dataclasses import replace
from math import pi
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.body.interface import UNANSWERED, BodyError
from agents.clock import StampAge
from bridges.ros2 import messages as ros2
from bridges.turtlebot3 import protocol as turtlebot3
from bridges.turtlebot3.body import DIAGNOSIS_S, OPEN_S, TurtleBot3
from bridges.turtlebot3.odometry import DRIFT
from bridges.turtlebot3.robot import ZEROS, TurtleBotConnection, ranges
from tests.bridges.turtlebot3.turtlebots import NOWHERE, STYLES, FakeRos, Stage, clock, odometry, request
from tests.waiting import ManualClock, until


@given(st.floats(-3.5, 3.5))
def test_the_robot_does_what_the_bridge_meant(speed):
    made = turtlebot3.cut(turtlebot3.whole(speed, 2.84))
    assert abs(made - max(-2.84, min(2.84, speed))) <= 0.005 + 1e-9
    assert abs(made * 100 - round(made * 100)) < 1e-9


def test_every_whole_speed_survives_the_truncation():
    for steps in range(-284, 285):
        assert turtlebot3.cut(turtlebot3.whole(steps / 100.0, 2.84)) == steps / 100.0
    assert turtlebot3.cut(0.29) == 0.28  # why a speed is not sent as it is


def test_charge():
    for voltage, percentage, charge in (
        (12.3, 100.0, 1.0),
        (10.4, 12.0, 0.0),  # the firmware stops counting below 10.5 V
        (0.0, 0.4, 0.4),  # a robot that keeps to the ROS message
        (10.518, 1.0, 0.01),  # one per cent, not full
        (np.nan, 80.0, 0.8),
    ):
        assert turtlebot3.charge(voltage, percentage) == pytest.approx(charge, abs=1e-6)


def test_addresses():
    where = turtlebot3.address("TB0", "rmw://fleet/tb3_0?distro=humble", turtlebot3.TurtleBot3Settings(domain=30))
    assert where == turtlebot3.TurtleBotAddress("rmw", "fleet/tb3_0", "humble", 30)
    assert str(where) == "rmw://fleet/tb3_0?domain=30&distro=humble"
    assert turtlebot3.address("TB0", "ros2dds://", turtlebot3.TurtleBot3Settings()).namespace == ""
    assert turtlebot3.command_type("humble", None) == ros2.TWIST
    assert turtlebot3.command_type("jazzy", None) == ros2.TWIST_STAMPED
    assert turtlebot3.command_type("jazzy", stamped=False) == ros2.TWIST


NAN, INF = np.nan, np.inf


@pytest.mark.parametrize(
    ("first", "increment", "farthest", "distance", "seen"),
    [
        (-0.5, 0.1, 3.5, [1.0, INF, 0.0, 0.11, 3.5, 3.6, NAN], [1.0, NAN, NAN, NAN, 3.5, NAN, NAN]),
        (-0.5, 0.1, INF, [0.0, 1.0, INF, -INF], [NAN, 1.0, NAN, NAN]),
        (INF, 0.1, 3.5, [0.0, 1.0, INF, -INF], [NAN] * 4),
        (-0.5, 0.1, NAN, [0.0, 1.0, INF, -INF], [NAN] * 4),
    ],
)
def test_rays_are_finite_or_nothing(first, increment, farthest, distance, seen):
    scan = SimpleNamespace(
        angle_min=first, angle_increment=increment, range_min=0.12, range_max=farthest,
        ranges=np.array(distance, np.float32),
    )  # fmt: skip
    found = ranges(scan, 7.0)
    assert found.time == 7.0
    assert np.isfinite(found.bearing).all()
    assert first != -0.5 or increment != 0.1 or found.bearing == pytest.approx(-0.5 + 0.1 * np.arange(len(distance)))
    np.testing.assert_array_equal(found.distance, seen)


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
    stamped = StampAge(DRIFT)
    assert [stamped.age(*pair) for pair in zip(arrivals, stamps, strict=True)] == pytest.approx(ages, abs=0.005)


def test_messages_held_back_are_no_restart():
    """Of a burst over two ticks the newest four of each are read."""
    robot = TurtleBotConnection(request(NOWHERE, "ros2dds://tb3_0?distro=humble"), 0)
    ros = FakeRos(robot)
    for k, arrival in [(0, 0.0), (10, 0.5), *((k, 2.0) for k in range(11, 15)), *((k, 2.02) for k in range(36, 40))]:
        ros.odometry.append(odometry(ros.types, 0.011 * k, stamp=100.0 + 0.05 * k))
        robot.receive_messages(arrival, arrival)
    assert robot.odometry.pose[0] == pytest.approx(0.011 * 39)


@pytest.mark.parametrize("halted_in", [1, None])
def test_robot_that_drives_on_gets_zeros(halted_in):
    """Also one that nobody has halted: it drives by the last command of a process that was killed."""
    robot = TurtleBotConnection(request(NOWHERE, "ros2dds://tb3_0?distro=humble"), 0)
    ros = FakeRos(robot)
    for k in range(80):
        t = 0.05 * k
        ros.odometry.append(odometry(ros.types, 0.2 * t, stamp=100.0 + t))
        robot.receive_messages(t, t)
        robot.halt(t) if k == halted_in else robot.send_command(t)
    assert robot.odometry.speed == pytest.approx((0.2, 0.0), abs=1e-3)
    assert len(ros.sent) > 2 * ZEROS


def test_restarted_node_turns_nothing():
    """turtlebot3_node adds the yaw of its IMU to its second message."""
    robot = TurtleBotConnection(request(NOWHERE, "ros2dds://tb3_0?distro=humble"), 0)
    ros = FakeRos(robot)
    for t, way, yaw in [(0.0, 0.0, 0.8), (2.0, 0.4, 0.8), (7.0, 0.0, 0.0), (7.05, 0.0, 0.8), (7.5, 0.1, 0.8)]:
        ros.odometry.append(odometry(ros.types, way * np.cos(yaw), way * np.sin(yaw), yaw, 100.0 + t))
        robot.receive_messages(t, t)
        robot.commanded.drive(0.1, 0.0, t)
        robot.send_command(t)
    assert ros.sent == [0.0, 0.102, 0.0, 0.102], "what it drove before its frame is certain would be lost"
    assert robot.odometry.pose == pytest.approx((0.5, 0.0, 0.0))


TWO = request(NOWHERE, "rmw://a?distro=humble", "rmw://b?distro=humble", start=((0.0, 0.0), (1.0, 0.0)))


def test_unreachable_robot_keeps_no_other_from_stopping():
    body = TurtleBot3(TWO)
    _, good = FakeRos(body.robots[0], OSError("its session is closed")), FakeRos(body.robots[1])
    for what in (body.land, body.stop):
        with pytest.raises(OSError, match="its session is closed"):
            what(range(2))
    assert good.sent == [0.0, 0.0]


def test_two_robots_of_one_namespace_have_no_position():
    robot = TurtleBotConnection(request(NOWHERE, "ros2dds://tb3_0?distro=humble"), 0)
    ros = FakeRos(robot)

    def hear(first, last, place):
        for k in range(first, last):
            ros.odometry.append(odometry(ros.types, place(k), stamp=100.0 + 0.05 * k))
            robot.receive_messages(0.05 * k, 0.05 * k)
        return robot.note(0.05 * (last - 1), linked=True)

    assert "was restarted" in hear(0, 20, lambda k: 3.0 if k == 10 else 0.0)  # there and back
    assert robot.time == pytest.approx(0.95)
    assert "do two robots have this namespace?" in hear(20, 40, lambda k: 3.0 * (k % 2))
    assert robot.time < 1.1
    hear(40, 160, lambda _: 0.0)
    assert robot.time == pytest.approx(7.95)


def test_stale_commands_are_followed_by_zeros():
    """Also when the loop does not run, and when another robot cannot be told."""
    now = ManualClock(100.0)
    body = TurtleBot3(TWO, now.monotonic)
    _, good = FakeRos(body.robots[0], StopIteration()), FakeRos(body.robots[1])
    for robot in body.robots:
        robot.odometry.received = 1e9
        robot.commanded.drive(0.1, 0.0, 100.0)
    for _ in range(20):
        now.sleep(0.05)
        body.stop_stale()
    assert set(good.sent) == {0.0}
    assert len(good.sent) >= 4


def test_command_from_before_suspension_becomes_zeros():
    robot = TurtleBotConnection(request(NOWHERE, "ros2dds://tb3_0?distro=humble"), 0)
    ros = FakeRos(robot)
    robot.odometry.received = 103.0
    robot.commanded.drive(0.1, 0.0, 100.0)  # decided on what was read then, commanded after the suspension
    robot.send_command(103.0)
    assert ros.sent == [0.0]
    robot.commanded.drive(0.1, 0.0, 103.0)
    robot.send_command(103.1)
    assert ros.sent[-1] == pytest.approx(0.102)


@pytest.mark.system
@pytest.mark.parametrize(("style", "distro"), [("ros2dds", "humble"), ("rmw", "jazzy")])
def test_drives_to_goals(hub, style, distro):
    start, goal = ((1.0, 0.5), (-1.0, 0.0)), np.array([[1.3, 0.3], [-1.1, 0.3]])
    asked = request(hub.endpoint, start=start, yaw=(1.0, -2.0), device={"style": style, "distro": distro})
    with Stage(asked) as stage:
        assert stage.twin.addresses[0] == (
            f"ros2dds://TB0?distro={distro}" if style == "ros2dds" else f"rmw://TB0?domain=0&distro={distro}"
        )
        stage.tick()  # opening took its time
        state = stage.run(0.2)  # what it drives before its odometry is settled does not count
        np.testing.assert_allclose(state.position[:, :2], start, atol=1e-6)
        np.testing.assert_allclose(state.yaw, (1.0, -2.0), atol=1e-6)
        assert stage.twin.commands_received == [0, 0]  # rows of NaN are not sent

        def arrived():
            state = stage.run(0.2, goals=goal.tolist())
            apart = np.linalg.norm([stage.place - goal, state.position[:, :2] - stage.place], axis=2)
            return (apart.T < (0.01, 0.005)).all() and (stage.t - state.time < 0.2).all()

        until(arrived, "it is there, and knows it")
        state = stage.state
        assert (state.note, state.flying.any()) == (("", ""), False)
        assert (state.battery > 0.99).all()
        assert stage.body.inspect(0).volts > 12.0
        assert [len(scan.distance) for scan in state.scan] == [360, 360]
        assert np.isnan(state.scan[0].distance).all()


@pytest.mark.system
def test_speeds_are_limited_and_commands_repeated(hub):
    """By another router, in another domain."""
    with Stage(request(NOWHERE, device={"style": "rmw", "domain": 30, "endpoint": hub.endpoint})) as stage:
        assert stage.twin.addresses == ("rmw://TB0?domain=30&distro=jazzy",)
        until(lambda: stage.run(0.2, 9.0).velocity[0, 0] == pytest.approx(0.22, abs=2e-3), "its limit")
        before = stage.twin.commands_received[0]
        stage.run(2.0, 9.0)
        assert 20 <= stage.twin.commands_received[0] - before <= 60  # 20 Hz


@pytest.mark.system
def test_nobody_commands_and_it_stands(hub):
    """Without setpoints, which the robot itself would not notice; and without a loop that reads and commands."""
    with Stage(request(hub.endpoint)) as stage:
        assert stage.moved(1.0, 0.2) > 0.1
        stage.run(1.0)
        assert stage.moved(0.5) == 0.0
        stage.run(1.0, 0.2)
        before = stage.place
        until(lambda: stage.twin.robots[0].twist == (0.0, 0.0), "it stands")
        assert np.linalg.norm(stage.place - before) < 0.5
        until(lambda: stage.moved(0.5, 0.2) > 0.05, "and drives on when it is told to")


@pytest.mark.system
@pytest.mark.parametrize(
    "how", ["land", pytest.param("stop", marks=pytest.mark.mechanism("TurtleBot3 bridge: emergency stop"))]
)
def test_ends_standing(hub, how):
    with Stage(request(hub.endpoint)) as stage:
        stage.run(1.0, 0.2, 1.0)
        getattr(stage.body, how)([0])
        until(lambda: stage.moved(0.5) == 0.0, "it stands")
        stage.body.takeoff([0], [0.5])
        until(lambda: stage.moved(0.5, 0.2) > 0.05, "and drives on when it is told to")
        stage.body.close()
        threading.Event().wait(0.1)  # the twin lives on: it rolls out
        before = stage.place
        stage.body.stop([0])  # nothing left to stop, and nothing is raised
        threading.Event().wait(0.1)
        np.testing.assert_array_equal(stage.place, before)


@pytest.mark.system
def test_external_positions_with_the_speed_of_odometry(hub):
    with Stage(request(hub.endpoint, start=((2.0, 2.0),), external=True), silent_from_s=4.0) as stage:

        def truth():
            (x, y), yaw = stage.place[0], stage.twin.truth()[1][0]  # the arena is turned against the start
            return [(-y, x, 0.1)], [yaw + pi / 2]

        assert np.isnan(stage.run(0.1).position[0, :2]).all()
        stage.truth = truth
        state = stage.run(2.0, 0.2)
        until(lambda: stage.run(0.1, 0.2).position[0] == pytest.approx(truth()[0][0], abs=0.01), "its place")
        until(lambda: stage.run(0.2, 0.2).velocity[0] == pytest.approx([0.0, 0.2, 0.0], abs=0.01), "its speed")
        assert state.yaw[0] == pytest.approx(pi / 2)
        until(lambda: "odometry silent" in stage.note(0.1, 0.2), "seen from outside, but it does not answer")
        assert stage.t - stage.state.time[0] > 0.5


@pytest.mark.system
def test_robot_stands_on_start_pose_whatever_its_odometry(hub):
    asked = request(hub.endpoint, start=((1.0, 1.0),), yaw=(pi / 2,))
    with Stage(asked) as stage:
        stage.run(2.5, 0.2)
        stage.run(1.0)
        stage.body.close()
        asked = replace(asked, addresses=stage.twin.addresses)
        for origin, place in (("open", (1.0, 1.0)), ("boot", stage.place[0])):
            body = TurtleBot3(replace(asked, device=({"origin": origin},)))
            body.open()
            (state,) = body.read(0.0)
            body.close()
            assert state.position[:2] == pytest.approx(place, abs=1e-3)
            assert state.yaw == pytest.approx(pi / 2, abs=1e-3)
        assert stage.place[0, 1] > 1.3


@pytest.mark.system
@pytest.mark.parametrize("style", STYLES)
def test_wrong_command_type_moves_nothing_and_is_reported(hub, style):
    with Stage(request(hub.endpoint, device={"style": style, "stamped": False}), device={}) as stage:
        assert stage.moved(1.0, 0.2) == 0.0
        assert stage.twin.commands_received == [0]
        assert stage.state.note[0] == (
            "cmd_vel is not received: the robot expects a geometry_msgs/msg/Twist, "
            "we send a geometry_msgs/msg/TwistStamped as on jazzy: set distro or stamped"
        )


@pytest.mark.system
def test_robot_that_does_not_move_is_reported(hub):
    with Stage(request(hub.endpoint)) as stage:
        stage.twin.robots[0].move = lambda: None  # as with its motors off
        assert stage.note(1.0, 0.2) == ""
        assert stage.note(1.0, 0.2).startswith("does not move despite commands: motors on?")
        assert stage.note(0.1, 0.0) == ""


@pytest.mark.mechanism("TurtleBot3 bridge: silent robot")
@pytest.mark.system
def test_silent_robot_gets_zeros_until_it_receives_them(hub):
    with Stage(request(hub.endpoint, device={"watchdog_s": 0.5}), silent_from_s=3.0, silent_for_s=6.0) as stage:
        until(lambda: stage.note(0.1, 0.2), "its silence is noticed")
        assert stage.state.note[0].startswith("odometry silent for ")
        assert stage.t - stage.state.time[0] > 0.5
        stage.body.stop([0])
        until(lambda: stage.note(0.1).startswith(f"{UNANSWERED}; odometry silent"), "it is said")
        until(lambda: stage.moved(0.2) == 0.0, "its watchdog stops it")
        until(lambda: not stage.note(0.1), "it is heard again")
        until(lambda: stage.moved(0.5) == 0.0, "zeros have reached it")
        until(lambda: stage.moved(0.5, 0.2) > 0.05, "it drives on")


@pytest.mark.system
def test_the_router_dies_and_comes_back(router):
    with Stage(request(router.endpoint, device={"watchdog_s": 0.5})) as stage:
        stage.run(0.5, 0.2)
        router.kill()
        until(lambda: stage.note(0.1, 0.2) == "no router")
        stage.run(1.0, 0.2)
        assert stage.moved(0.5, 0.2) == 0.0
        router.start()
        until(lambda: stage.note(0.1, 0.2) == "")
        assert stage.moved(1.0, 0.2) > 0.1


@pytest.mark.system
@pytest.mark.parametrize(
    ("device", "address", "said"),
    [
        ({"style": "rmw"}, "rmw://tb3_7", r"TB0: no odometry on '.*tb3_7/odom.*is the robot on.*: TB0$"),
        (
            {"style": "rmw", "distro": "humble", "domain": 30}, "rmw://TB0?domain=0&distro=humble",
            r"published in domain 30: write rmw://TB0\?domain=30",
        ),
        (
            {"style": "rmw", "distro": "humble", "domain": 30}, "rmw://TB0?domain=30&distro=jazzy",
            "type hash TypeHashNotSupported: set another distro than jazzy",
        ),
    ],
)  # fmt: skip
def test_an_absent_robot_is_diagnosed_in_time(hub, device, address, said):
    """No robot of this namespace, or one of another domain or distribution."""
    with Stage(request(hub.endpoint, device=device)) as stage:
        stage.body.close()
        with pytest.raises(BodyError, match=said):
            TurtleBot3(request(hub.endpoint, address), clock).open()
    assert OPEN_S + DIAGNOSIS_S < 5.0


@pytest.mark.system
def test_no_router_is_named_in_time():
    begin = time.monotonic()
    with pytest.raises(BodyError, match=r"TB0: no router answers at tcp/127\.0\.0\.1:9"):
        TurtleBot3(request(NOWHERE, "ros2dds://tb3_0"), open_timeout=0.5).open()
    assert 0.5 < time.monotonic() - begin < 2.0
    with pytest.raises(BodyError, match="TB0: 'nonsense' is not an endpoint"):
        TurtleBot3(request("nonsense", "ros2dds://tb3_0")).open()
