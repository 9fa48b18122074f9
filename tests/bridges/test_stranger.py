"""A stranger's simulator, which owes nothing to zenpark, flies our robots."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from agents.network import messages, pubsub
from agents.network import session as network
from tests.bridges.test_external import ALONE, KEYS, PLACES
from tests.conftest import ROOT, RouterProcess
from tests.system.lab import Flight, RobotProcess, Watcher, until


class Simulator:
    """tests/bridges/simulator.py, which knows nothing of zenpark."""

    def __init__(self, endpoint: str, *names: str) -> None:
        takes = {"KH": "twist", "CF": "position", "TE": "velocity"}
        robots = [f"{n}:{takes[n[:2]]}:{':'.join(map(str, {**PLACES, **ALONE}[n]))}:0" for n in names]
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        self.process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("simulator.py")), endpoint, *robots],
            cwd="/",
            env=environment,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "ready\n"

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(30)
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture
def simulator(router: RouterProcess) -> Iterator[Simulator]:
    made = Simulator(router.endpoint, *PLACES)
    yield made
    made.kill()


def elsewhere(*names: str) -> list[str]:
    return [part for name in names for part in ("--set", f'robots.{name}.body="external"')]


def test_the_simulator_owes_nothing_to_zenpark() -> None:
    text = Path(__file__).with_name("simulator.py").read_text()
    imported = {line.split()[1] for line in text.splitlines() if line.startswith(("import", "from"))}
    assert imported == {"json", "math", "sys", "time", "zenoh"}


@pytest.mark.system
def test_the_triangle_forms_up_in_a_strangers_simulator(
    router: RouterProcess, simulator: Simulator, tmp_path: Path
) -> None:
    settings = [*elsewhere(*PLACES), "--set", f'network.connect=["{router.endpoint}"]', "--set", "duration_s=8"]
    flight = Flight(tmp_path / "run", "triangle", "--json", "--no-report", "--case", "event", *settings)
    code, out = flight.finish(60.0)
    assert code == 0, out
    robots = json.loads(out)["cases"]["event"]["robots"]
    assert set(robots) == set(PLACES)
    for robot in robots.values():
        assert robot["acquired_s"] < 6.0
        assert robot["lost"] == 0


@pytest.mark.mechanism("foreign simulator hangs")
@pytest.mark.system
def test_hanging_simulator_lands_its_robots_and_others_stay(router: RouterProcess, tmp_path: Path) -> None:
    flying = Simulator(router.endpoint, "CF01")
    watcher = Watcher(router.endpoint)
    file = ROOT / "experiments" / "catalogue" / "triangle.toml"
    text = file.read_text().replace('kind = "crazyflie" ', 'body = "external"\nkind = "crazyflie" ')
    assert "external" in text
    changed = tmp_path / "triangle.toml"
    changed.write_text(text)
    robots = RobotProcess(router.endpoint, changed, "KH01", "KH02", "CF01")
    try:
        watcher.until(lambda: watcher.phase("CF01") == "ready", "it is ready")
        assert watcher.order("CF01", messages.Order("takeoff")).ok
        assert watcher.order("KH01", messages.Order("takeoff")).ok
        watcher.until(lambda: watcher.phase("CF01") == "airborne", "it is up")
        flying.process.send_signal(signal.SIGSTOP)
        watcher.until(lambda: watcher.phase("CF01") == "landing", "silence is noticed")
        assert watcher.status["CF01"].reason == "its own position is lost"
        assert watcher.phase("KH01") == "airborne"
        flying.process.send_signal(signal.SIGCONT)
        watcher.until(lambda: watcher.phase("CF01") == "done", "it lands as soon as the simulator goes on")
        assert watcher.state["CF01"].position[2] < 0.1
        assert watcher.phase("KH01") == "airborne"
    finally:
        flying.process.send_signal(signal.SIGCONT)
        robots.end()
        flying.kill()
        watcher.close()


@pytest.mark.system
def test_dead_robot_process_is_landed_by_simulator(router: RouterProcess, tmp_path: Path) -> None:
    """What `docs/external-simulators.md` asks of a simulator, kept by ours."""
    file = tmp_path / "alone.toml"
    file.write_text(
        'title = "alone"\nduration_s = 30.0\n[arena]\nsize = [2.0, 2.0, 2.0]\n'
        '[robots.TE01]\nkind = "tello"\nbody = "external"\nstart = [0.0, 0.0]\nhover = 0.6\n'
    )
    simulator = Simulator(router.endpoint, "TE01")
    watcher = Watcher(router.endpoint)
    positions = pubsub.subscriber(watcher.session, KEYS.position("TE01"), 64)
    height = [0.0]

    def look() -> float:
        for sample in network.received(positions.handler):
            height[0] = json.loads(sample.payload.to_string())["position"][2]
        return height[0]

    robot = RobotProcess(router.endpoint, file, "TE01")
    try:
        watcher.until(lambda: watcher.phase("TE01") == "ready", "it is ready")
        assert watcher.order("TE01", messages.Order("takeoff")).ok
        watcher.until(lambda: watcher.phase("TE01") == "airborne", "it is up")
        assert look() == pytest.approx(0.6, abs=0.06)
        robot.kill()
        until(lambda: look() < 0.02, "it is down")
    finally:
        if robot.process.returncode is None:
            robot.end()
        simulator.kill()
        watcher.close()
