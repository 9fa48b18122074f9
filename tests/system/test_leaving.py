"""Whoever ends does so in time: when the router does not answer, and when a robot is frozen and the launcher dies."""

import contextlib
import signal
import threading
import time
from functools import partial

import psutil
import pytest

from agents.network import pubsub
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.shutdown import leave
from experiments.recording import playback
from tests.commands import zenpark
from tests.conftest import RouterProcess
from tests.system.lab import TRIANGLE, Flight, RobotProcess, gone, until

pytestmark = pytest.mark.system

CUT_OFF_S = 3.0  # until the loss of the router is noticed: before that good-byes are still taken


def test_robot_leaves_a_router_that_does_not_answer(router, watcher):
    with RobotProcess(router.endpoint, "triangle", "KH01") as robot:
        watcher.until_all("idle", "KH01")
        with router.frozen():
            threading.Event().wait(CUT_OFF_S)
            began = time.monotonic()
            assert robot.end() == 0
            assert time.monotonic() - began < 10.0  # Zenoh alone takes 13 s


def stopped(pid):
    return bool(psutil.Process(pid).status() == psutil.STATUS_STOPPED)


def test_router_that_was_frozen_ends_when_ordered():
    """The kernel then gives the signal to any of its threads, at every second time to one that does not heed it."""
    for _ in range(4):
        router = RouterProcess()
        router.process.send_signal(signal.SIGSTOP)
        until(partial(stopped, router.process.pid), "it is frozen")
        router.process.send_signal(signal.SIGCONT)
        assert router.stop() == 0


def test_session_closes_in_time_and_live_ones_immediately(router):
    sessions = [network.open_session([router.endpoint], name="test", lease_s=1.0) for _ in range(2)]
    declared = [pubsub.pose_subscriber(sessions[1], Keys().status("*"))]
    assert leave(sessions[0])
    with router.frozen():
        threading.Event().wait(CUT_OFF_S)
        began = time.monotonic()
        assert not leave(sessions[1], declared, limit_s=0.5)
        assert time.monotonic() - began < 1.5
    for thread in threading.enumerate():
        if thread.name == "leaving the network":
            thread.join(15.0)


@pytest.mark.mechanism("emergency stop: frozen router")
def test_an_estop_that_nobody_answers_ends(router):
    with router.frozen():
        done = zenpark("estop", "--connect", router.endpoint, code=None, timeout_s=30)
    assert done.returncode in {1, 2}
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("bodies", ["twin", "world"])
def test_frozen_robot_delays_nobody_when_launcher_is_killed(tmp_path, bodies):
    flight = Flight(tmp_path / "run", "triangle", "--case", "event", "--bodies", bodies, "duration_s=60")
    flight.until_flown()
    children = flight.children()
    frozen = children.pop("KH01")
    frozen.suspend()
    try:
        threading.Event().wait(0.5)
        flight.process.kill()
        until(lambda: gone([children["CF01"], children["KH02"]]), "the robots have landed")
        until(lambda: gone(list(children.values())), "everybody else is gone")
        assert playback.read(flight.folder / "event.mcap").complete
        assert flight.logs().count("done (the starter is gone)") == 2
        frozen.resume()
        until(lambda: gone([frozen]), "the frozen one too")
    finally:
        flight.finish()
        for process in (frozen, *children.values()):
            with contextlib.suppress(psutil.NoSuchProcess):
                process.kill()


def test_suspended_conductor_gives_no_further_order(tmp_path):
    flight = Flight(tmp_path / "run", "triangle", "--case", "event")
    flight.until_flown()
    robots = [process for name, process in flight.children().items() if name in TRIANGLE]
    flight.signal(signal.SIGSTOP)
    until(lambda: gone(robots), "the robots land and end", 40.0)
    flight.signal(signal.SIGCONT)
    code, _ = flight.finish()
    assert code == 2
    assert "this process stood still for more than 3 s; its robots have landed without it" in flight.said()
    assert "landing" not in [line.rpartition("phase conductor: ")[2] for line in flight.said().splitlines()]
