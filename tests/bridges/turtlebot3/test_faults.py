"""The TurtleBot3 bridge when something goes wrong: a robot that is silent, killed or absent, a router that is gone."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from agents.body.interface import UNANSWERED, BodyError
from agents.protocols import ros2
from bridges.turtlebot3.body import DIAGNOSIS_S, OPEN_S, TurtleBot3
from bridges.turtlebot3.robot import TurtleBotConnection
from tests.bridges.turtlebots import STYLES, Stage, clock, request
from tests.waiting import until
from twins.devices.device import Faults

ROOT = Path(__file__).resolve().parents[3]
NOWHERE = "tcp/127.0.0.1:9"


@pytest.mark.system
@pytest.mark.parametrize("style", STYLES)
def test_wrong_command_type_moves_nothing_and_is_reported(hub, style):
    asked = request(hub.endpoint, device={"style": style, "stamped": False})
    with Stage(asked) as stage:
        stage.body = TurtleBot3(replace(asked, addresses=stage.twin.addresses, device=({},)))
        stage.body.open()
        assert stage.moved(1.0, stage.constant(0.2))[0] == 0.0
        assert stage.twin.commands_received == [0]
        assert stage.state.note[0] == (
            "cmd_vel is not received: the robot expects a geometry_msgs/msg/Twist, "
            "we send a geometry_msgs/msg/TwistStamped as on jazzy: set distro or stamped"
        )


@pytest.mark.system
def test_robot_that_does_not_move_is_reported(hub):
    with Stage(request(hub.endpoint)) as stage:
        stage.body.open()
        stage.twin.robots[0].model._acceleration = 0.0  # as with its motors off
        stage.run(1.0, stage.constant(0.2))
        assert stage.state.note == ("",)
        stage.run(1.0, stage.constant(0.2))
        assert stage.state.note[0].startswith("does not move despite commands: motors on?")
        stage.run(0.1, stage.constant(0.0))
        assert stage.state.note == ("",)


@pytest.mark.system
@pytest.mark.parametrize(
    "watchdog", [None, pytest.param(0.5, marks=pytest.mark.mechanism("TurtleBot3 bridge: silent robot"))]
)
def test_silent_robot_gets_zeros_until_it_receives_them(hub, watchdog):
    device = {"watchdog_s": watchdog} if watchdog else {}
    with Stage(request(hub.endpoint, device=device), faults=Faults(silent_from_s=3.0, silent_for_s=3.0)) as stage:
        stage.body.open()
        until(lambda: stage.run(0.1, stage.constant(0.2)).note[0], "its silence is noticed")
        assert stage.state.note[0].startswith("odometry silent for ")
        assert stage.t - stage.state.time[0] > 0.5
        if watchdog:
            until(lambda: stage.moved(0.2)[0] == 0.0, "its watchdog stops it")
        else:  # it goes on with the last command
            assert stage.moved(1.0)[0] == pytest.approx(0.2, abs=0.1)
        until(lambda: not stage.run(0.1).note[0], "it is heard again")
        until(lambda: stage.moved(0.5)[0] == 0.0, "zeros have reached it")
        until(lambda: stage.moved(0.5, stage.constant(0.2))[0] > 0.05, "it drives on")


@pytest.mark.system
def test_a_stop_that_is_not_answered_is_said(hub):
    with Stage(request(hub.endpoint), faults=Faults(silent_from_s=2.0, silent_for_s=8.0)) as stage:
        stage.body.open()
        while stage.run(0.1, stage.constant(0.2)).note[0] == "":
            assert stage.t < 6.0
        stage.body.stop([0])
        stage.run(1.0, stage.constant(0.0))
        assert stage.state.note[0].startswith("odometry silent")
        while not stage.run(0.1).note[0].startswith(f"{UNANSWERED}; odometry silent"):
            assert stage.t < 9.0
        while stage.run(0.1).note[0]:
            assert stage.t < 15.0
        assert stage.moved(0.5)[0] == 0.0


def test_unreachable_robot_keeps_no_other_from_stopping():
    body = TurtleBot3(request("tcp/127.0.0.1:1", start=((0.0, 0.0), (1.0, 0.0)), addresses=("rmw://a", "rmw://b")))
    told = []

    def fails(_now):
        raise OSError("its session is closed")

    body._robots[0].halt, body._robots[1].halt, body._sessions = fails, told.append, {(): None}
    for what in (body.land, body.stop):
        with pytest.raises(OSError, match="its session is closed"):
            what(range(2))
    assert len(told) == 2


TWIN = """
import select, sys, time
from tests.bridges.turtlebots import STYLES, request
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
            [sys.executable, "-c", TWIN, endpoint], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
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

    def read():
        (state,) = body.read(time.monotonic() - zero)
        body.command([(0.2, 0.0, 0.0, 0.0)])
        return state

    eventually(lambda: read().position[0] > 1.15)
    twin.kill()
    eventually(lambda: read().note == "odometry silent for 1 s")
    last = read()
    assert time.monotonic() - zero - last.time > 0.5
    twin = TwinProcess(hub.endpoint)  # counts from zero again
    eventually(lambda: read().note.startswith("odometry was restarted"))
    assert abs(read().position[0] - last.position[0]) < 0.1
    eventually(lambda: read().position[0] > last.position[0] + 0.1)
    body.close()
    twin.kill()


@pytest.mark.system
def test_the_router_dies_and_comes_back(router, eventually):
    with Stage(request(router.endpoint, device={"watchdog_s": 0.5})) as stage:
        stage.body.open()
        stage.run(0.5, stage.constant(0.2))
        router.kill()
        eventually(lambda: stage.run(0.1, stage.constant(0.2)).note == ("no router",))
        stage.run(1.0, stage.constant(0.2))
        assert stage.moved(0.5, stage.constant(0.2))[0] == 0.0
        router.start()
        eventually(lambda: stage.run(0.1, stage.constant(0.2)).note == ("",))
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
def test_robot_of_other_domain_or_distribution_is_recognised(hub):
    with Stage(request(hub.endpoint, device={"style": "rmw", "distro": "humble", "domain": 30})) as stage:
        other = TurtleBot3(request(hub.endpoint, addresses=("rmw://TB0?domain=0&distro=humble",)), clock)
        with pytest.raises(BodyError, match=r"published in domain 30: write rmw://TB0\?domain=30"):
            other.open()
        stage.body = TurtleBot3(request(hub.endpoint, addresses=("rmw://TB0?domain=30&distro=jazzy",)), clock)
        with pytest.raises(BodyError, match="type hash TypeHashNotSupported: set another distro than jazzy"):
            stage.body.open()


@pytest.mark.system
def test_no_router_is_named_in_time():
    begin = time.monotonic()
    with pytest.raises(BodyError, match=r"TB0: no router answers at tcp/127\.0\.0\.1:9"):
        TurtleBot3(request(NOWHERE, addresses=("ros2dds://tb3_0",)), open_timeout=0.5).open()
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
    robot = TurtleBotConnection(request("tcp/127.0.0.1:1", addresses=("ros2dds://tb3_0",)), 0)
    robot._types, robot._command_type = ros2.types("humble"), ros2.TWIST
    waiting: list[SimpleNamespace] = []
    nothing = SimpleNamespace(newest=lambda: None)
    robot._odometry_inbox = SimpleNamespace(received=lambda: [waiting.pop()])  # type: ignore[assignment]
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
        robot.odometry.received = 1e9
        robot.commanded._sent_at = 100.0
        robot.drive(0.1, 0.0, 100.0)

    class Rounds:
        def wait(self, period):
            now[0] += period
            return now[0] > 101.0

    body._ending = Rounds()  # type: ignore[assignment]
    body._stop_stale()
    assert set(sent) == {0.0}
    assert len(sent) >= 4


def test_command_from_before_suspension_becomes_zeros() -> None:
    robot = TurtleBotConnection(request("tcp/127.0.0.1:1", addresses=("ros2dds://tb3_0",)), 0)
    sent = []
    robot._types, robot._command_type = ros2.types("humble"), ros2.TWIST
    robot._command = SimpleNamespace(put=lambda message: sent.append(message.linear.x))  # type: ignore[assignment]
    robot.odometry.received = 103.0
    robot.drive(0.1, 0.0, 100.0)  # decided on what was read then, commanded after the suspension
    robot.send_command(103.0)
    assert sent == [0.0]
    robot.drive(0.1, 0.0, 103.0)
    robot.send_command(103.1)
    assert sent[-1] == pytest.approx(0.102)
