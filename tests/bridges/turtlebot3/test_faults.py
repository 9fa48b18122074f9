"""The TurtleBot3 bridge when something goes wrong: a robot that is silent, killed or absent, a router that is gone."""

import time
from contextlib import contextmanager

import pytest

from agents.body.interface import UNANSWERED, BodyError
from bridges.turtlebot3.body import DIAGNOSIS_S, OPEN_S, TurtleBot3
from bridges.turtlebot3.robot import TurtleBotConnection
from tests.bridges.driver import Driver, constant
from tests.bridges.turtlebots import NOWHERE, STYLES, FakeRos, Stage, clock, odometry, request
from tests.commands import started
from tests.waiting import ManualClock, until


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


@pytest.mark.system
@pytest.mark.parametrize(
    "watchdog", [None, pytest.param(0.5, marks=pytest.mark.mechanism("TurtleBot3 bridge: silent robot"))]
)
def test_silent_robot_gets_zeros_until_it_receives_them(hub, watchdog):
    device = {"watchdog_s": watchdog} if watchdog else {}
    with Stage(request(hub.endpoint, device=device), silent_from_s=3.0, silent_for_s=3.0) as stage:
        until(lambda: stage.note(0.1, 0.2), "its silence is noticed")
        assert stage.state.note[0].startswith("odometry silent for ")
        assert stage.t - stage.state.time[0] > 0.5
        if watchdog:
            until(lambda: stage.moved(0.2) == 0.0, "its watchdog stops it")
        else:  # it goes on with the last command
            assert stage.moved(1.0) == pytest.approx(0.2, abs=0.1)
        until(lambda: not stage.note(0.1), "it is heard again")
        until(lambda: stage.moved(0.5) == 0.0, "zeros have reached it")
        until(lambda: stage.moved(0.5, 0.2) > 0.05, "it drives on")


@pytest.mark.system
def test_a_stop_that_is_not_answered_is_said(hub):
    with Stage(request(hub.endpoint), silent_from_s=2.0, silent_for_s=8.0) as stage:
        until(lambda: stage.note(0.1, 0.2), "its silence is noticed")
        stage.body.stop([0])
        assert stage.note(1.0, 0.0).startswith("odometry silent")
        until(lambda: stage.note(0.1).startswith(f"{UNANSWERED}; odometry silent"), "it is said")
        until(lambda: not stage.note(0.1), "it is heard again")
        assert stage.moved(0.5) == 0.0


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


@contextmanager
def twin_process(endpoint):
    """Address of a twin that is killed at the end."""
    with started("-c", TWIN, endpoint) as process:
        yield process.stdout.readline().strip()


@pytest.mark.system
def test_a_killed_robot_goes_stale_and_comes_back(hub):
    with twin_process(hub.endpoint) as address:
        body = TurtleBot3(request(hub.endpoint, address, start=((1.0, 1.0),)))
        body.open()
        driver = Driver(body, constant(0.2))
        driver.until(lambda: driver.state.position[0, 0] > 1.15)
    driver.until(lambda: driver.state.note[0] == "odometry silent for 1 s")
    last = driver.state
    assert driver.t - last.time[0] > 0.5
    with twin_process(hub.endpoint):  # counts from zero again
        driver.until(lambda: driver.state.note[0].startswith("odometry was restarted"))
        assert abs(driver.state.position[0, 0] - last.position[0, 0]) < 0.1
        driver.until(lambda: driver.state.position[0, 0] > last.position[0, 0] + 0.1)
        body.close()


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
        ({"style": "ros2dds"}, "ros2dds://tb3_7", r"TB0: no odometry on '.*tb3_7/odom.*is the robot on.*: TB0$"),
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


# ---------------------------------------------------------------------- without a network

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
