"""The watchdog on a TurtleBot3: when it stops the robot, with a ROS of our own, and installed over a real sshd."""

from __future__ import annotations

import getpass
import os
import shutil
import signal
import socket
import subprocess
import sys
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace as Thing

import pytest

from bridges.turtlebot3 import watchdog
from bridges.turtlebot3.watchdog import TYPES, StopTimer, WatchdogNode, moving, type_of_robot
from experiments.real_time.hosts import installation
from experiments.real_time.hosts.hosts import HostError
from tests.waiting import until


def vector(x: float = 0.0) -> Thing:
    return Thing(x=x, y=0.0, z=0.0)


def twist(v: float = 0.0, w: float = 0.0) -> Thing:
    return Thing(linear=vector(v), angular=Thing(x=0.0, y=0.0, z=w))


def zeros(dog: StopTimer, begin: float, end: float) -> list[float]:
    """Times of the zeros that are sent from `begin` to `end` [s]."""
    ticks = [begin + 0.02 * k for k in range(round((end - begin) / 0.02))]
    return [t for t in ticks if dog.zero_due(t)]


def test_moving_robot_stops_after_half_a_second_silence() -> None:
    dog = StopTimer(0.5)
    dog.hear(10.0, moves=True)
    sent = zeros(dog, 10.0, 14.0)
    assert sent[0] == pytest.approx(10.52)
    assert sent[-1] <= 11.6  # a second of zeros, 20 a second
    assert 15 <= len(sent) <= 21
    assert dog.stops == 1


def test_commanded_or_standing_robot_is_left_alone() -> None:
    dog = StopTimer(0.5)
    assert zeros(dog, 0.0, 5.0) == []  # nobody has ever moved it
    for k in range(50):
        dog.hear(5.0 + 0.4 * k, moves=True)
        assert zeros(dog, 5.0 + 0.4 * k, 5.4 + 0.4 * k) == []
    dog.hear(25.0, moves=False)
    assert zeros(dog, 25.0, 40.0) == []


def test_its_own_zeros_are_heard_and_end_nothing() -> None:
    dog = StopTimer(0.5)
    dog.hear(0.0, moves=True)
    first = zeros(dog, 0.0, 0.6)
    dog.hear(0.6, moves=False)
    assert first
    assert zeros(dog, 0.6, 3.0)
    dog.hear(3.0, moves=True)  # the next gap is one again
    assert zeros(dog, 3.0, 3.6)
    assert dog.stops == 2


@pytest.mark.parametrize(
    ("v", "w", "moves"), [(0.0, 0.0, False), (0.1, 0.0, True), (0.0, -0.1, True), (float("nan"), 0.0, True)]
)
def test_zero_is_what_does_not_move(v: float, w: float, moves: bool) -> None:
    assert moving(twist(v, w)) == moves


class FakeRos:
    """As much of rclpy as the node uses."""

    def __init__(self) -> None:
        self.sent: list[Thing] = []
        self.hear: Callable[[Thing], None] = lambda _: None
        self.check: Callable[[], None] = lambda: None
        self.receivers: list[Thing] = []

    def create_node(self, name: str) -> FakeRos:
        self.name = name
        return self

    def get_name(self) -> str:
        return self.name

    def get_subscriptions_info_by_topic(self, _topic: str) -> list[Thing]:
        return self.receivers

    def create_publisher(self, _kind: object, _topic: str, _depth: int) -> Thing:
        return Thing(publish=self.sent.append)

    def create_subscription(self, _kind: object, _topic: str, hear: Callable[[Thing], None], _depth: int) -> None:
        self.hear = hear

    def create_timer(self, _period: float, check: Callable[[], None]) -> None:
        self.check = check

    def get_logger(self) -> Thing:
        return Thing(info=lambda _: None, warning=lambda _: None)

    def get_clock(self) -> Thing:
        return Thing(now=lambda: Thing(to_msg=lambda: "now"))


@pytest.mark.parametrize("kind", ["twist", "stamped"])
def test_node_sends_zeros_of_the_robots_type(monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    messages = types.ModuleType("geometry_msgs.msg")
    messages.Twist = twist  # type: ignore[attr-defined]
    messages.TwistStamped = lambda: Thing(header=Thing(stamp=None), twist=twist())  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "geometry_msgs", types.ModuleType("geometry_msgs"))
    monkeypatch.setitem(sys.modules, "geometry_msgs.msg", messages)
    ros, clock = FakeRos(), [100.0]
    monkeypatch.setattr(watchdog.time, "monotonic", lambda: clock[0])
    WatchdogNode(ros, "cmd_vel", TYPES[kind], 0.5)
    ros.hear(twist(0.1) if kind == "twist" else Thing(twist=twist(0.1)))
    for _ in range(50):
        clock[0] += 0.02
        ros.check()
    assert 8 <= len(ros.sent) <= 11
    assert ros.sent[0] == (twist() if kind == "twist" else Thing(header=Thing(stamp="now"), twist=twist()))


def test_type_is_the_robots_not_the_watchdogs() -> None:
    ros = FakeRos().create_node("cmd_vel_watchdog")
    assert type_of_robot(ros, "cmd_vel") == ""
    ros.receivers = [
        Thing(node_name="cmd_vel_watchdog", topic_type=TYPES["twist"]),
        Thing(node_name="turtlebot3_node", topic_type=TYPES["stamped"]),
    ]
    assert type_of_robot(ros, "cmd_vel") == TYPES["stamped"]


# ---------------------------------------------------------------------- over ssh

SSHD = shutil.which("sshd") or "/usr/sbin/sshd"
ROS = '''
"""A ROS that does nothing, for the watchdog on a robot that is not there."""
import sys, time
class _Node:
    def __init__(self, name): self.name = name
    def get_name(self): return self.name
    def destroy_node(self): pass
    def get_subscriptions_info_by_topic(self, topic):
        return [type("Info", (), {"node_name": "turtlebot3_node", "topic_type": "geometry_msgs/msg/TwistStamped"})]
    def create_publisher(self, *a): return type("Publisher", (), {"publish": staticmethod(lambda m: None)})
    def create_subscription(self, *a): pass
    def create_timer(self, *a): pass
    def get_logger(self): return type("Log", (), {"info": staticmethod(lambda t: print(t, sys.argv, flush=True))})
def init(args=None, signal_handler_options=None): pass
def create_node(name): return _Node(name)
def spin_once(node, timeout_sec=0): pass
def spin(node): time.sleep(600)
def ok(): return False
def shutdown(): pass
'''


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The home folder of a robot with a real sshd on loopback, a ROS of ours, and no cron; ssh finds it as `robot`."""
    if not Path(SSHD).exists() or shutil.which("ssh-keygen") is None:
        pytest.skip("needs openssh-server")
    home, site, bin_ = tmp_path / "home", tmp_path / "site", tmp_path / "bin"
    for folder in (home, site / "rclpy", site / "geometry_msgs", bin_):
        folder.mkdir(parents=True)
    (site / "rclpy" / "__init__.py").write_text(ROS)
    (site / "rclpy" / "utilities.py").write_text("def remove_ros_args(args): return args[:args.index('--ros-args')]\n")
    (site / "rclpy" / "signals.py").write_text("class SignalHandlerOptions: NO = None\n")
    (site / "geometry_msgs" / "__init__.py").touch()
    (site / "geometry_msgs" / "msg.py").write_text("class Twist: pass\nclass TwistStamped: pass\n")
    (site / "setup.sh").write_text(f"export PYTHONPATH={site}\n")
    (bin_ / "crontab").write_text(f'#!/bin/sh\n[ "$1" = -l ] && exec cat {home}/crontab\nexec cat > {home}/crontab\n')
    (bin_ / "crontab").chmod(0o755)
    for name in ("host_key", "key"):
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(tmp_path / name)], check=True)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    python = Path(sys.executable).parent
    config = tmp_path / "sshd_config"
    config.write_text(
        f"Port {port}\nListenAddress 127.0.0.1\nHostKey {tmp_path}/host_key\nAuthorizedKeysFile {tmp_path}/key.pub\n"
        f"PidFile {tmp_path}/sshd.pid\nPasswordAuthentication no\nUsePAM no\nStrictModes no\n"
        f"SetEnv HOME={home} PATH={bin_}:{python}:/usr/bin:/bin ROS_SETUP={site}/setup.sh\n"
    )
    Path("/run/sshd").mkdir(exist_ok=True)
    with (tmp_path / "sshd.log").open("wb") as log:
        sshd = subprocess.Popen([SSHD, "-D", "-e", "-f", str(config)], stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    (tmp_path / "ssh_config").write_text(
        f"Host robot\n HostName 127.0.0.1\n Port {port}\n User {getpass.getuser()}\n IdentityFile {tmp_path}/key\n"
        f" StrictHostKeyChecking no\n UserKnownHostsFile {tmp_path}/known\n"
    )
    ssh = tmp_path / "ours" / "ssh"
    ssh.parent.mkdir()
    ssh.write_text(f'#!/bin/sh\nexec {shutil.which("ssh")} -F {tmp_path}/ssh_config "$@"\n')
    ssh.chmod(0o755)
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
def test_watchdog_is_installed_kept_and_removed_over_ssh(robot: Path) -> None:
    for attempt in range(2):  # a second time replaces the first
        said = installation.put_watchdog("robot", namespace="tb3_0", domain=30, silence_s=0.5)
        assert "it is started at each boot (crontab -l)" in said
        assert "watches cmd_vel (geometry_msgs/msg/TwistStamped): stops the robot after 0.5 s" in said[-1], attempt
        assert "__ns:=/tb3_0" in said[-1]
    folder = robot / "zenpark-watchdog"
    assert (robot / "crontab").read_text() == f"@reboot {folder}/run\n"
    assert (folder / "watchdog.py").read_bytes() == installation.WATCHDOG.read_bytes()
    first = int((folder / "pid").read_text())
    os.kill(first, signal.SIGKILL)
    until(lambda: int((folder / "pid").read_text() or first) != first, "it is started anew")
    assert installation.remove_watchdog("robot") == ["removed"]
    assert not folder.exists()
    assert (robot / "crontab").read_text() == ""
    assert installation.remove_watchdog("robot") == ["there is none"]


@pytest.mark.system
def test_a_robot_without_ros_is_named(robot: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        installation, "PUT_WATCHDOG", installation.PUT_WATCHDOG.replace("${ROS_SETUP:-$setup}", "$setup")
    )
    with pytest.raises(HostError, match=r"(?s)^robot: .*there is no ROS 2 under /opt/ros$"):
        installation.put_watchdog("robot", namespace="", domain=30, silence_s=0.5)
    with pytest.raises(HostError, match=r"^nowhere: .*no machine of that name"):
        installation.put_watchdog("nowhere", namespace="", domain=30, silence_s=0.5)
