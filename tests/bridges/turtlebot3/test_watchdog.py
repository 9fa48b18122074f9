"""The watchdog on a TurtleBot3: when it stops the robot, with a ROS of our own, and its installation."""

import math
import os
import signal
import sys
from pathlib import Path
from types import SimpleNamespace as Thing
from unittest.mock import MagicMock

import pytest

from bridges.turtlebot3 import watchdog
from bridges.turtlebot3.kind import TURTLEBOT3
from bridges.turtlebot3.watchdog import TYPES, StopTimer, WatchdogNode, moving, type_of_robot
from experiments.real_time.hosts import installation
from experiments.real_time.hosts.hosts import HostError
from tests.waiting import ManualClock, until


def twist(v=0.0, w=0.0):
    return Thing(linear=Thing(x=v, y=0.0, z=0.0), angular=Thing(x=0.0, y=0.0, z=w))


def zeros(dog, begin, end):
    """Times of the zeros that are sent from `begin` to `end` [s]."""
    ticks = [begin + 0.02 * k for k in range(round((end - begin) / 0.02))]
    return [t for t in ticks if dog.zero_due(t)]


@pytest.mark.parametrize("heard", [True, False])
def test_moving_robot_stops_after_half_a_second_silence(heard):
    """Also at its start, by a command from before, of a sender that is gone."""
    dog = StopTimer(0.5, 0.0 if heard else 10.0)
    if heard:
        assert [moving(twist(v, w)) for v, w in ((0.1, 0.0), (0.0, -0.1), (math.nan, 0.0), (0.0, 0.0))] == [1, 1, 1, 0]
        dog.hear(10.0, moves=True)
    sent = zeros(dog, 10.0, 14.0)
    assert sent[0] == pytest.approx(10.52)
    assert sent[-1] <= 11.6  # a second of zeros, 20 a second
    assert 15 <= len(sent) <= 21
    assert dog.stops == 1


def test_commanded_or_standing_robot_is_left_alone():
    dog = StopTimer(0.5, 0.0)
    dog.hear(0.0, moves=False)
    assert zeros(dog, 0.0, 5.0) == []
    for k in range(50):
        dog.hear(5.0 + 0.4 * k, moves=True)
        assert zeros(dog, 5.0 + 0.4 * k, 5.4 + 0.4 * k) == []
    dog.hear(25.0, moves=False)
    assert zeros(dog, 25.0, 40.0) == []


def test_its_own_zeros_are_heard_and_end_nothing():
    dog = StopTimer(0.5, 0.0)
    dog.hear(0.0, moves=True)
    first = zeros(dog, 0.0, 0.6)
    dog.hear(0.6, moves=False)
    assert first
    assert zeros(dog, 0.6, 3.0)
    dog.hear(3.0, moves=True)  # the next gap is one again
    assert zeros(dog, 3.0, 3.6)
    assert dog.stops == 2


@pytest.mark.parametrize("kind", ["twist", "stamped"])
def test_node_sends_zeros_of_the_robots_type(monkeypatch, kind):
    messages = Thing(Twist=twist, TwistStamped=lambda: Thing(header=Thing(stamp=None), twist=twist()))
    monkeypatch.setitem(sys.modules, "geometry_msgs", messages)
    monkeypatch.setitem(sys.modules, "geometry_msgs.msg", messages)
    ros, clock = MagicMock(), ManualClock(100.0)
    monkeypatch.setattr(watchdog, "time", clock)
    WatchdogNode(ros, "cmd_vel", TYPES[kind], 0.5)
    node = ros.create_node.return_value
    (_, _, hear, _), (_, check) = node.create_subscription.call_args.args, node.create_timer.call_args.args
    hear(twist(0.1) if kind == "twist" else Thing(twist=twist(0.1)))
    for _ in range(50):
        clock.sleep(0.02)
        check()
    sent = [call.args[0] for call in node.create_publisher.return_value.publish.call_args_list]
    stamp = node.get_clock().now().to_msg()
    assert 8 <= len(sent) <= 11
    assert sent[0] == (twist() if kind == "twist" else Thing(header=Thing(stamp=stamp), twist=twist()))


def test_type_is_the_robots_not_the_watchdogs():
    node = MagicMock(get_name=lambda: "cmd_vel_watchdog", get_subscriptions_info_by_topic=lambda _: found)
    found = []
    assert type_of_robot(node, "cmd_vel") == ""
    for name, kind in {"cmd_vel_watchdog": "twist", "turtlebot3_node": "stamped"}.items():
        found.append(Thing(node_name=name, topic_type=TYPES[kind]))
    assert type_of_robot(node, "cmd_vel") == TYPES["stamped"]


ROS = {
    "rclpy/__init__.py": '''"""A ROS that does nothing, for the watchdog on a robot that is not there."""
import sys, time
from unittest.mock import MagicMock
robot = MagicMock(node_name="turtlebot3_node", topic_type="geometry_msgs/msg/TwistStamped")
log = MagicMock(info=lambda text: print(text, sys.argv, flush=True))
node = MagicMock(get_subscriptions_info_by_topic=lambda topic: [robot], get_logger=lambda: log)
create_node = lambda name: node
init = spin_once = shutdown = MagicMock()
ok = lambda: False
spin = lambda node: time.sleep(600)
''',
    "rclpy/utilities.py": "def remove_ros_args(args): return args[:args.index('--ros-args')]\n",
    "rclpy/signals.py": "class SignalHandlerOptions: NO = None\n",
    "geometry_msgs/__init__.py": "",
    "geometry_msgs/msg.py": "class Twist: pass\nclass TwistStamped: pass\n",
}


@pytest.fixture
def robot_home(tmp_path, monkeypatch):
    """The home folder of a robot whose sshd is a shell on this machine, with a ROS of ours, and no cron."""
    home, site, programs = tmp_path / "home", tmp_path / "site", tmp_path / "bin"
    table = f'[ "$1" = -l ] && exec cat {home}/crontab\nexec cat > {home}/crontab\n'
    there = f"HOME={home} PATH={programs}:{Path(sys.executable).parent}:/usr/bin:/bin ROS_SETUP={site}/setup.sh"
    files = {site / name: text for name, text in ROS.items()}
    files[home / "crontab"] = ""
    files[site / "setup.sh"] = f"export PYTHONPATH={site}\n"
    files[programs / "crontab"] = f"#!/bin/sh\n{table}"
    files[tmp_path / "ssh" / "ssh"] = f'#!/bin/sh\nfor command; do :; done\nexec env -i {there} sh -c "$command"\n'
    for path, text in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        path.chmod(0o700)
    monkeypatch.setenv("PATH", f"{tmp_path / 'ssh'}:{os.environ['PATH']}")
    yield home
    for pid in (home / "zenpark-watchdog").glob("pid"):
        (pid.parent / "stop").touch()
        os.kill(int(pid.read_text()), signal.SIGTERM)


@pytest.mark.mechanism("TurtleBot3: watchdog on the robot")
@pytest.mark.system
def test_watchdog_is_installed_kept_and_removed(robot_home):
    for attempt in range(2):  # a second time replaces the first
        said = installation.put_watchdog(TURTLEBOT3, "robot", namespace="tb3_0", domain=30, silence_s=0.5)
        assert "it is started at each boot (crontab -l)" in said
        assert "watches cmd_vel (geometry_msgs/msg/TwistStamped): stops the robot after 0.5 s" in said[-1], attempt
        assert "__ns:=/tb3_0" in said[-1]
    folder = robot_home / "zenpark-watchdog"
    assert (robot_home / "crontab").read_text() == f"@reboot {folder}/run\n"
    assert (folder / "watchdog.py").read_bytes() == installation.watchdog(TURTLEBOT3).read_bytes()
    first = int((folder / "pid").read_text())
    os.kill(first, signal.SIGKILL)
    until(lambda: int((folder / "pid").read_text() or first) != first, "it is started anew")
    assert installation.remove_watchdog(TURTLEBOT3, "robot") == ["removed"]
    assert not folder.exists()
    assert (robot_home / "crontab").read_text() == ""
    assert installation.remove_watchdog(TURTLEBOT3, "robot") == ["there is none"]


@pytest.mark.system
@pytest.mark.usefixtures("robot_home")
def test_a_robot_without_ros_is_named(monkeypatch, tmp_path):
    program = installation.watchdog(TURTLEBOT3)
    script = program.with_name("put_watchdog.sh").read_text("utf-8")
    (tmp_path / "put_watchdog.sh").write_text(script.replace("${ROS_SETUP:-$setup}", "$setup"))
    without = tmp_path / program.name
    without.write_bytes(program.read_bytes())
    monkeypatch.setattr(installation, "watchdog", lambda _: without)
    with pytest.raises(HostError, match=r"(?s)^robot: .*there is no ROS 2 under /opt/ros$"):
        installation.put_watchdog(TURTLEBOT3, "robot", namespace="", domain=30, silence_s=0.5)
