"""What robots notice: a neighbour that is killed, one that hangs and comes back, and an emergency stop, all of them."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
import zenoh

from tests.conftest import RouterProcess
from tests.system.lab import RobotProcess, Watcher

pytestmark = pytest.mark.system

BLOCK = zenoh.CongestionControl.BLOCK  # a stop must not be dropped where a hundred kilobytes go before it
TRIANGLE = ("KH01", "KH02", "CF01")


@pytest.fixture
def robots(router: RouterProcess, watcher: Watcher) -> Iterator[dict[str, RobotProcess]]:
    """The triangle, each robot in a process of its own, all ready."""
    with ExitStack() as stack:
        made = {}
        for name in TRIANGLE:
            made[name] = RobotProcess(router.endpoint, "triangle", name)
            stack.callback(lambda robot=made[name]: robot.process.returncode is not None or robot.end())
        watcher.until(lambda: all(watcher.phase(name) == "ready" for name in TRIANGLE), "all are ready")
        yield made


@pytest.mark.mechanism("frozen neighbour")
def test_a_killed_and_a_frozen_neighbour_are_noticed(robots: dict[str, RobotProcess], watcher: Watcher) -> None:
    with watcher.session.liveliness().declare_token("park/**"):  # somebody who says that everybody lives ...
        watcher.until(lambda: "KH01" in watcher.state, "they go on")
    told = watcher.state["KH01"].seq  # ... and then that everybody is dead
    watcher.until(lambda: watcher.state["KH01"].seq > told + 10, "they still go on")
    assert not any(watcher.status[name].missing for name in TRIANGLE)
    hanging = robots["KH02"].process
    hanging.send_signal(signal.SIGSTOP)
    try:
        watcher.until(lambda: watcher.status["KH01"].missing == ["KH02"], "it hangs")
    finally:
        hanging.send_signal(signal.SIGCONT)
    watcher.until(lambda: not watcher.status["KH01"].missing, "it is back")
    watcher.until(lambda: "KH02" in watcher.alive, "its token too")
    robots["CF01"].kill()
    watcher.until(lambda: watcher.status["KH01"].missing == ["CF01"], "it is dead")


@pytest.mark.mechanism("emergency stop from any Zenoh client")
def test_an_emergency_stop_reaches_every_process(robots: dict[str, RobotProcess], watcher: Watcher) -> None:
    key = watcher.keys.estop
    watcher.session.delete(key)  # no stop
    watcher.until(lambda: not any(watcher.phase(name) == "done" for name in TRIANGLE), "nobody was stopped")
    watcher.session.put(key, b"all of you", congestion_control=BLOCK)  # as z_put and zenoh-cli: without an encoding
    watcher.until(lambda: all(watcher.phase(name) == "done" for name in TRIANGLE), "all motors are off")
    assert {watcher.status[name].reason for name in TRIANGLE} == {"emergency stop by an unknown sender: all of you"}
    assert all(watcher.status[name].malformed == 0 for name in TRIANGLE)
    assert all(robot.process.poll() is None for robot in robots.values())
