"""A stranger's simulator, which owes nothing to zenpark, flies our robots."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from tests.commands import started
from tests.conftest import ROOT, RouterProcess
from tests.system.lab import Flight, RobotProcess, Watcher, until

PLACES = {"KH01": (-0.6, -0.5), "KH02": (0.6, -0.5), "CF01": (0.1, 0.6)}
SIMULATOR = Path(__file__).with_name("simulator.py")
TAKES = {"KH": "twist", "CF": "position", "TE": "velocity"}


@contextmanager
def simulator(endpoint: str, *names: str) -> Iterator[subprocess.Popen[str]]:
    """tests/bridges/simulator.py, which knows nothing of zenpark."""
    places = {name: PLACES.get(name, (0.0, 0.0)) for name in names}
    robots = [f"{name}:{TAKES[name[:2]]}:{x}:{y}:0" for name, (x, y) in places.items()]
    alone = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    with started(SIMULATOR, endpoint, *robots, cwd="/", env=alone, stderr=None) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        yield process


@contextmanager
def process_of(endpoint: str, file: Path, *names: str) -> Iterator[RobotProcess]:
    made = RobotProcess(endpoint, file, *names)
    try:
        yield made
    finally:
        if made.process.returncode is None:
            made.end()


@pytest.fixture
def watcher(router: RouterProcess) -> Iterator[Watcher]:
    made = Watcher(router.endpoint)
    yield made
    made.close()


def take_off(watcher: Watcher, name: str) -> None:
    watcher.until(lambda: watcher.phase(name) == "ready", "it is ready")
    assert watcher.order(name, messages.Order("takeoff")).ok


def test_the_simulator_owes_nothing_to_zenpark() -> None:
    lines = SIMULATOR.read_text().splitlines()
    assert {line.split()[1] for line in lines if line.startswith(("import", "from"))} == {
        "json", "math", "sys", "time", "zenoh",
    }  # fmt: skip


@pytest.mark.system
def test_the_triangle_forms_up_in_a_strangers_simulator(router: RouterProcess, tmp_path: Path) -> None:
    elsewhere = [part for name in PLACES for part in ("--set", f'robots.{name}.body="external"')]
    settings = [*elsewhere, "--set", f'network.connect=["{router.endpoint}"]', "--set", "duration_s=8"]
    with simulator(router.endpoint, *PLACES):
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
def test_hanging_simulator_lands_its_robots_and_others_stay(
    router: RouterProcess, watcher: Watcher, tmp_path: Path
) -> None:
    file = ROOT / "experiments" / "catalogue" / "triangle.toml"
    text = file.read_text().replace('kind = "crazyflie" ', 'body = "external"\nkind = "crazyflie" ')
    assert "external" in text
    changed = tmp_path / "triangle.toml"
    changed.write_text(text)
    with simulator(router.endpoint, "CF01") as flying, process_of(router.endpoint, changed, *PLACES):
        take_off(watcher, "CF01")
        take_off(watcher, "KH01")
        watcher.until(lambda: watcher.phase("CF01") == "airborne", "it is up")
        flying.send_signal(signal.SIGSTOP)
        watcher.until(lambda: watcher.phase("CF01") == "landing", "silence is noticed")
        assert watcher.status["CF01"].reason == "its own position is lost"
        assert watcher.phase("KH01") == "airborne"
        flying.send_signal(signal.SIGCONT)
        watcher.until(lambda: watcher.phase("CF01") == "done", "it lands as soon as the simulator goes on")
        assert watcher.state["CF01"].position[2] < 0.1
        assert watcher.phase("KH01") == "airborne"


@pytest.mark.system
def test_dead_robot_process_is_landed_by_simulator(router: RouterProcess, watcher: Watcher, tmp_path: Path) -> None:
    """Requirements of `docs/external-simulators.md`, kept by our simulator."""
    file = tmp_path / "alone.toml"
    file.write_text(
        'title = "alone"\nduration_s = 30.0\n[arena]\nsize = [2.0, 2.0, 2.0]\n'
        '[robots.TE01]\nkind = "tello"\nbody = "external"\nstart = [0.0, 0.0]\nhover = 0.6\n'
    )
    positions, heights = pubsub.subscriber(watcher.session, Keys().position("TE01"), 64), [0.0]

    def look() -> float:
        told = [json.loads(sample.payload.to_string()) for sample in network.received(positions.handler)]
        heights.extend(each["position"][2] for each in told)
        return heights[-1]

    with simulator(router.endpoint, "TE01"), process_of(router.endpoint, file, "TE01") as robot:
        take_off(watcher, "TE01")
        watcher.until(lambda: watcher.phase("TE01") == "airborne", "it is up")
        assert look() == pytest.approx(0.6, abs=0.06)
        robot.kill()
        until(lambda: look() < 0.02, "it is down")
