"""A stranger's simulator, which owes nothing to zenpark, flies our robots; examples, with their imports faked."""

import json
import os
import signal
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest

from agents.network import pubsub
from agents.network import session as network
from bridges.examples import gazebo_bridge, webots_controller
from tests.commands import started
from tests.conftest import ROOT
from tests.system.lab import Flight, RobotProcess, Watcher
from tests.waiting import until

PLACES = {"KH01": (-0.6, -0.5), "KH02": (0.6, -0.5), "CF01": (0.1, 0.6)}
SIMULATOR = Path(__file__).with_name("simulator.py")
TAKES = {"KH": "twist", "CF": "position", "TE": "velocity"}


@contextmanager
def simulator(endpoint, *names):
    places = {name: PLACES.get(name, (0.0, 0.0)) for name in names}
    robots = [f"{name}:{TAKES[name[:2]]}:{x}:{y}:0" for name, (x, y) in places.items()]
    alone = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    with started(SIMULATOR, endpoint, *robots, cwd="/", env=alone, stderr=None) as process:
        assert process.stdout.readline() == "ready\n"
        yield process


@pytest.mark.system
def test_the_triangle_forms_up_in_a_strangers_simulator(router, tmp_path):
    imports = [line.split()[1] for line in SIMULATOR.read_text().splitlines() if line.startswith(("import", "from"))]
    assert imports == ["json", "math", "sys", "time", "zenoh"], "it owes nothing to zenpark"
    elsewhere = [f'robots.{name}.body="external"' for name in PLACES]
    words = ("--json", "--case", "event", *elsewhere, f'network.connect=["{router.endpoint}"]', "duration_s=8")
    with simulator(router.endpoint, *PLACES):
        code, out = Flight(tmp_path / "run", "triangle", *words).finish(60.0)
    assert code == 0, out
    robots = json.loads(out)["cases"]["event"]["robots"]
    assert (robots.keys(), {robot["lost"] for robot in robots.values()}) == (PLACES.keys(), {0})
    assert max(robot["acquired_s"] for robot in robots.values()) < 6.0


@pytest.mark.mechanism("foreign simulator hangs")
@pytest.mark.system
def test_hanging_simulator_lands_its_robots_and_others_stay(router, tmp_path):
    text = (ROOT / "experiments" / "catalogue" / "triangle.toml").read_text()
    file = tmp_path / "triangle.toml"
    file.write_text(text.replace('kind = "crazyflie" ', 'body = "external"\nkind = "crazyflie" '))
    with (
        Watcher(router.endpoint) as watcher,
        simulator(router.endpoint, "CF01") as flying,
        RobotProcess(router.endpoint, file, *PLACES),
    ):
        watcher.take_off("CF01", "KH01")
        flying.send_signal(signal.SIGSTOP)
        watcher.until(lambda: watcher.phase("CF01") == "landing", "silence is noticed")
        assert watcher.status["CF01"].reason == "its own position is lost"
        assert watcher.phase("KH01") == "airborne"
        flying.send_signal(signal.SIGCONT)
        watcher.until(lambda: watcher.phase("CF01") == "done", "it lands as soon as the simulator goes on")
        assert watcher.state["CF01"].position[2] < 0.1
        assert watcher.phase("KH01") == "airborne"


@pytest.mark.system
def test_dead_robot_process_is_landed_by_simulator(router, tmp_path):
    """Requirements of `docs/external-simulators.md`, kept by our simulator."""
    file, heights = tmp_path / "alone.toml", [0.0]
    file.write_text(
        'title = "alone"\nduration_s = 30.0\n[arena]\nsize = [2.0, 2.0, 2.0]\n'
        '[robots.TE01]\nkind = "tello"\nbody = "external"\nstart = [0.0, 0.0]\nhover = 0.6\n'
    )

    def height():
        samples = network.received(positions.handler)
        heights.extend(json.loads(sample.payload.to_string())["position"][2] for sample in samples)
        return heights[-1]

    with (
        Watcher(router.endpoint) as watcher,
        simulator(router.endpoint, "TE01"),
        RobotProcess(router.endpoint, file, "TE01") as robot,
    ):
        positions = pubsub.subscriber(watcher.session, watcher.keys.position("TE01"), 64)
        watcher.take_off("TE01")
        assert height() == pytest.approx(0.6, abs=0.06)
        robot.kill()
        until(lambda: height() < 0.02, "it is down")


def speeds_in_webots(modules):
    """Speeds of the wheels, set after each command [rad/s]."""
    wheel, robot = MagicMock(), MagicMock()
    robot.step.return_value, robot.getDevice.return_value = 0, wheel
    robot.getSelf().getOrientation.return_value = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    robot.getSelf().getPosition.return_value = [0.0, 0.0, 0.0]
    modules["controller"] = SimpleNamespace(Supervisor=lambda: robot)
    with pytest.raises(IndexError):
        webots_controller.main("KH01", "tcp/127.0.0.1:7447")
    return [call.args[0] for call in wheel.setVelocity.call_args_list[2::2]]


def speeds_in_gazebo(modules):
    """Speeds commanded after each command [m/s]."""
    node, speeds = MagicMock(), []
    node.advertise().publish.side_effect = lambda message: speeds.append(message.linear.x)
    modules["gz.transport13"] = SimpleNamespace(Node=lambda: node)
    modules["gz.msgs10.twist_pb2"] = modules["gz.msgs10.pose_v_pb2"] = MagicMock()
    with pytest.raises(IndexError):
        gazebo_bridge.main("tcp/127.0.0.1:7447", "default", ["KH01"])
    return speeds


@pytest.mark.parametrize("speeds", [speeds_in_webots, speeds_in_gazebo])
def test_stop_with_lower_number_is_the_last_word(monkeypatch, speeds):
    """Of repeated and overtaken commands none is obeyed after it; an example ends where there are no more."""
    waiting = []
    for seq, action in ((7, "drive"), (5, "stop"), (6, "drive"), (7, "drive")):  # one in each turn
        setpoint = [0.1, 0.0, 0.0, 0.0] if action == "drive" else None
        text = json.dumps({"robot": "KH01", "seq": seq, "action": action, "setpoint": setpoint})
        waiting += [MagicMock(**{"payload.to_string.return_value": text}), None]
    modules = {"zenoh": MagicMock()}
    session = modules["zenoh"].open.return_value.__enter__.return_value
    session.declare_subscriber.return_value.handler.try_recv = lambda: waiting.pop(0)
    for example in (webots_controller, gazebo_bridge):
        monkeypatch.setattr(example.importlib, "import_module", modules.__getitem__)
    moving, *stopped = speeds(modules)
    assert (moving > 0.0, {*stopped}) == (True, {0.0})
