"""The example simulators, with Zenoh and the simulator's own modules faked: what they do with commands."""

import json
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest

from bridges.examples import gazebo_bridge, webots_controller

DRIVE = [0.1, 0.0, 0.0, 0.0]


def encoded(seq, action):
    return json.dumps({"robot": "KH01", "seq": seq, "action": action, "setpoint": DRIVE if action == "drive" else None})


class Ended(Exception):
    """End of the commands."""


def ring(commands):
    """A subscriber's handler that has one command in each turn of an example."""
    looks = [each for command in commands for each in (command, None)]

    def try_recv():
        if not looks:
            raise Ended
        text = looks.pop(0)
        return text and SimpleNamespace(payload=SimpleNamespace(to_string=lambda: text))

    return SimpleNamespace(try_recv=try_recv)


@pytest.fixture
def modules(monkeypatch):
    """Modules that the examples import."""
    made = {"zenoh": MagicMock()}
    for example in (webots_controller, gazebo_bridge):
        monkeypatch.setattr(example.importlib, "import_module", made.__getitem__)
    return made


def speeds_in_webots(modules):
    """Speed of the wheels after each command [rad/s]."""
    wheel, robot = MagicMock(), MagicMock()
    robot.step.return_value = 0
    robot.getDevice.return_value = wheel
    robot.getSelf().getOrientation.return_value = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    robot.getSelf().getPosition.return_value = [0.0, 0.0, 0.0]
    modules["controller"] = SimpleNamespace(Supervisor=lambda: robot)
    with pytest.raises(Ended):
        webots_controller.main("KH01", "tcp/127.0.0.1:7447")
    return [call.args[0] for call in wheel.setVelocity.call_args_list[2::2]]


def speeds_in_gazebo(modules):
    """Commanded speed after each command [m/s]."""
    node, speeds = MagicMock(), []
    node.advertise().publish.side_effect = lambda message: speeds.append(message.linear.x)
    modules["gz.transport13"] = SimpleNamespace(Node=lambda: node)
    modules["gz.msgs10.twist_pb2"] = modules["gz.msgs10.pose_v_pb2"] = MagicMock()
    with pytest.raises(Ended):
        gazebo_bridge.main("tcp/127.0.0.1:7447", "default", ["KH01"])
    return speeds


@pytest.mark.parametrize("speeds", [speeds_in_webots, speeds_in_gazebo])
def test_stop_with_lower_number_is_the_last_word(modules, speeds):
    """Of repeated and overtaken commands none is obeyed after it."""
    commands = [encoded(7, "drive"), encoded(5, "stop"), encoded(6, "drive"), encoded(7, "drive")]
    session = modules["zenoh"].open.return_value.__enter__.return_value
    session.declare_subscriber.return_value.handler = ring(commands)
    moving, *stopped = speeds(modules)
    assert moving > 0.0
    assert stopped[0] == 0.0
    assert not any(stopped)
