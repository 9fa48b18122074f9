"""The watchdog on a TurtleBot3: when it stops the robot, with a ROS of our own, and installed over a real sshd."""

from __future__ import annotations

import getpass
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace as Thing
from unittest.mock import MagicMock

import pytest

from bridges.turtlebot3 import watchdog
from bridges.turtlebot3.watchdog import TYPES, StopTimer, WatchdogNode, moving, type_of_robot
from experiments.real_time.hosts import installation
from experiments.real_time.hosts.hosts import HostError
from tests.waiting import ManualClock, until


def twist(v: float = 0.0, w: float = 0.0) -> Thing:
    return Thing(linear=Thing(x=v, y=0.0, z=0.0), angular=Thing(x=0.0, y=0.0, z=w))


def zeros(dog: StopTimer, begin: float, end: float) -> list[float]:
    """Times of the zeros that are sent from `begin` to `end` [s]."""
    ticks = [begin + 0.02 * k for k in range(round((end - begin) / 0.02))]
    return [t for t in ticks if dog.zero_due(t)]


@pytest.mark.parametrize("heard", [True, False])
def test_moving_robot_stops_after_half_a_second_silence(heard: bool) -> None:
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


def test_commanded_or_standing_robot_is_left_alone() -> None:
    dog = StopTimer(0.5, 0.0)
    dog.hear(0.0, moves=False)
    assert zeros(dog, 0.0, 5.0) == []
    for k in range(50):
        dog.hear(5.0 + 0.4 * k, moves=True)
        assert zeros(dog, 5.0 + 0.4 * k, 5.4 + 0.4 * k) == []
    dog.hear(25.0, moves=False)
    assert zeros(dog, 25.0, 40.0) == []


def test_its_own_zeros_are_heard_and_end_nothing() -> None:
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
def test_node_sends_zeros_of_the_robots_type(monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
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


def test_type_is_the_robots_not_the_watchdogs() -> None:
    node = MagicMock(get_name=lambda: "cmd_vel_watchdog", get_subscriptions_info_by_topic=lambda _: found)
    found: list[Thing] = []
    assert type_of_robot(node, "cmd_vel") == ""
    for name, kind in {"cmd_vel_watchdog": "twist", "turtlebot3_node": "stamped"}.items():
        found.append(Thing(node_name=name, topic_type=TYPES[kind]))
    assert type_of_robot(node, "cmd_vel") == TYPES["stamped"]


SSHD = shutil.which("sshd") or "/usr/sbin/sshd"
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


def new_file(path: Path, text: str) -> Path:
    """A file in a folder that may be new, which may run."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o700)
    return path


@pytest.fixture
def robot_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The home folder of a robot with a real sshd on loopback, a ROS of ours, and no cron; ssh finds it as `robot`."""
    if not Path(SSHD).exists() or shutil.which("ssh-keygen") is None:
        pytest.skip("needs openssh-server")
    home, site, bin_ = tmp_path / "home", tmp_path / "site", tmp_path / "bin"
    home.mkdir()
    for name, text in ROS.items():
        new_file(site / name, text)
    new_file(site / "setup.sh", f"export PYTHONPATH={site}\n")
    table = f'#!/bin/sh\n[ "$1" = -l ] && exec cat {home}/crontab\nexec cat > {home}/crontab\n'
    new_file(bin_ / "crontab", table)
    for name in ("host_key", "key"):
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(tmp_path / name)], check=True)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    config = new_file(
        tmp_path / "sshd_config",
        f"Port {port}\nListenAddress 127.0.0.1\nHostKey {tmp_path}/host_key\nAuthorizedKeysFile {tmp_path}/key.pub\n"
        f"PidFile {tmp_path}/sshd.pid\nPasswordAuthentication no\nUsePAM no\nStrictModes no\n"
        f"SetEnv HOME={home} PATH={bin_}:{Path(sys.executable).parent}:/usr/bin:/bin ROS_SETUP={site}/setup.sh\n",
    )
    Path("/run/sshd").mkdir(exist_ok=True)
    with (tmp_path / "sshd.log").open("wb") as log:
        sshd = subprocess.Popen([SSHD, "-D", "-e", "-f", str(config)], stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    ours = new_file(
        tmp_path / "ssh_config",
        f"Host robot\n HostName 127.0.0.1\n Port {port}\n User {getpass.getuser()}\n IdentityFile {tmp_path}/key\n"
        f" StrictHostKeyChecking no\n UserKnownHostsFile {tmp_path}/known\n",
    )
    ssh = new_file(tmp_path / "ours" / "ssh", f'#!/bin/sh\nexec {shutil.which("ssh")} -F {ours} "$@"\n')
    monkeypatch.setenv("PATH", f"{ssh.parent}:{os.environ['PATH']}")
    until((tmp_path / "sshd.pid").exists, "its sshd runs")
    yield home
    (home / "zenpark-watchdog" / "stop").touch() if (home / "zenpark-watchdog").exists() else None
    for pid in (home / "zenpark-watchdog").glob("pid"):
        os.kill(int(pid.read_text()), signal.SIGTERM)
    sshd.terminate()
    sshd.wait(30)


@pytest.mark.mechanism("TurtleBot3: watchdog on the robot")
@pytest.mark.system
def test_watchdog_is_installed_kept_and_removed_over_ssh(robot_home: Path) -> None:
    for attempt in range(2):  # a second time replaces the first
        said = installation.put_watchdog("robot", namespace="tb3_0", domain=30, silence_s=0.5)
        assert "it is started at each boot (crontab -l)" in said
        assert "watches cmd_vel (geometry_msgs/msg/TwistStamped): stops the robot after 0.5 s" in said[-1], attempt
        assert "__ns:=/tb3_0" in said[-1]
    folder = robot_home / "zenpark-watchdog"
    assert (robot_home / "crontab").read_text() == f"@reboot {folder}/run\n"
    assert (folder / "watchdog.py").read_bytes() == installation.WATCHDOG.read_bytes()
    first = int((folder / "pid").read_text())
    os.kill(first, signal.SIGKILL)
    until(lambda: int((folder / "pid").read_text() or first) != first, "it is started anew")
    assert installation.remove_watchdog("robot") == ["removed"]
    assert not folder.exists()
    assert (robot_home / "crontab").read_text() == ""
    assert installation.remove_watchdog("robot") == ["there is none"]


@pytest.mark.system
def test_a_robot_without_ros_is_named(robot_home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        installation, "PUT_WATCHDOG", installation.PUT_WATCHDOG.replace("${ROS_SETUP:-$setup}", "$setup")
    )
    with pytest.raises(HostError, match=r"(?s)^robot: .*there is no ROS 2 under /opt/ros$"):
        installation.put_watchdog("robot", namespace="", domain=30, silence_s=0.5)
    with pytest.raises(HostError, match=r"^nowhere: .*no machine of that name"):
        installation.put_watchdog("nowhere", namespace="", domain=30, silence_s=0.5)
