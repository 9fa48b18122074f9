"""Whoever ends does so in time: when the router does not answer, and when a robot is frozen and the launcher dies."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import psutil
import pytest

from agents.network import pubsub
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.shutdown import leave
from tests.conftest import RouterProcess
from tests.system.lab import ENVIRONMENT, ROOT, Flight, RobotProcess, Watcher, gone, until

pytestmark = pytest.mark.system

CUT_OFF_S = 3.0  # until the loss of the router is noticed: before that good-byes are still taken


def test_robot_leaves_a_router_that_does_not_answer(router: RouterProcess) -> None:
    watcher = Watcher(router.endpoint)
    robot = RobotProcess(router.endpoint, "triangle", "KH01")
    try:
        watcher.until(lambda: watcher.phase("KH01") == "idle", "it is there")
        router.process.send_signal(signal.SIGSTOP)
        threading.Event().wait(CUT_OFF_S)
        began = time.monotonic()
        assert robot.end() == 0
        assert time.monotonic() - began < 10.0  # Zenoh alone takes 13 s
    finally:
        router.process.send_signal(signal.SIGCONT)
        watcher.close()
        if robot.process.returncode is None:
            robot.kill()


def stopped(pid: int) -> bool:
    return bool(psutil.Process(pid).status() == psutil.STATUS_STOPPED)


def test_router_that_was_frozen_ends_when_ordered() -> None:
    """The kernel then gives the signal to any of its threads, at every second time to one that does not heed it."""
    for _ in range(4):
        router = RouterProcess()
        router.process.send_signal(signal.SIGSTOP)
        until(partial(stopped, router.process.pid), "it is frozen")
        router.process.send_signal(signal.SIGCONT)
        assert router.stop() == 0


def test_session_closes_in_time_and_live_ones_immediately(router: RouterProcess) -> None:
    sessions = [network.open_session([router.endpoint], name="test", lease_s=1.0) for _ in range(2)]
    declared = [pubsub.pose_subscriber(sessions[1], Keys().status("*"))]
    assert leave(sessions[0])
    router.process.send_signal(signal.SIGSTOP)
    try:
        threading.Event().wait(CUT_OFF_S)
        began = time.monotonic()
        in_time = leave(sessions[1], declared, limit_s=0.5)
        assert time.monotonic() - began < 1.5
        assert not in_time
    finally:
        router.process.send_signal(signal.SIGCONT)
        for thread in threading.enumerate():
            if thread is not threading.main_thread() and thread.name == "leaving the network":
                thread.join(15.0)


@pytest.mark.mechanism("emergency stop: frozen router")
def test_an_estop_that_nobody_answers_ends(router: RouterProcess) -> None:
    command = [sys.executable, "-m", "tools.guard", "estop", "--connect", router.endpoint]
    router.process.send_signal(signal.SIGSTOP)
    try:
        done = subprocess.run(
            command, cwd=ROOT, env=ENVIRONMENT, capture_output=True, text=True, timeout=30, check=False
        )
    finally:
        router.process.send_signal(signal.SIGCONT)
    assert done.returncode in {1, 2}
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("bodies", ["twin", "world"])
def test_frozen_robot_delays_nobody_when_launcher_is_killed(tmp_path: Path, bodies: str) -> None:
    flight = Flight(tmp_path / "run", "triangle", "--bodies", bodies, "--set", "duration_s=60")
    flight.until_said("formation")
    children = flight.children()
    frozen = children.pop("KH01")
    frozen.suspend()
    try:
        threading.Event().wait(0.5)
        flight.process.kill()
        until(lambda: gone([children["CF01"], children["KH02"]]), "the robots have landed")
        until(lambda: gone(list(children.values())), "everybody else is gone")
        frozen.resume()
        until(lambda: gone([frozen]), "the frozen one too")
    finally:
        flight.finish()
        for process in (frozen, *children.values()):
            try:
                process.kill()
            except psutil.NoSuchProcess:
                continue


def test_suspended_conductor_gives_no_further_order(tmp_path: Path) -> None:
    flight = Flight(tmp_path / "run", "triangle", "--case", "event", "--no-report")
    flight.until_said(r"phase conductor: formation", 60.0)
    robots = [process for name, process in flight.children().items() if name in ("KH01", "KH02", "CF01")]
    flight.signal(signal.SIGSTOP)
    until(lambda: gone(robots), "the robots land and end", 40.0)
    flight.signal(signal.SIGCONT)
    code, _ = flight.finish()
    assert code == 2
    assert "this process stood still for more than 3 s; its robots have landed without it" in flight.said()
    assert "landing" not in [line.rpartition("phase conductor: ")[2] for line in flight.said().splitlines()]
