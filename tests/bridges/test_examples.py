"""The example simulators, with Zenoh and the simulator's own modules faked: what they do with commands."""

import json
from collections import deque
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest

from bridges.examples import gazebo_bridge, webots_controller

DRIVE = [0.1, 0.0, 0.0, 0.0]


def encoded(seq, action):
    return json.dumps({"robot": "KH01", "seq": seq, "action": action, "setpoint": DRIVE if action == "drive" else None})


class Ended(Exception):
    """End of the commands."""


class Session:
    """A session whose subscriber gets one command in each turn of the example."""

    def __init__(self, commands):
        self.handler, self._commands, self._looks = self, deque(commands), 0

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def declare_subscriber(self, *_):
        return self

    def declare_publisher(self, *_, **__):
        return MagicMock()

    def try_recv(self):
        self._looks += 1
        if self._looks % 2 == 0:  # the queue is empty for the rest of this turn
            return None
        if not self._commands:
            raise Ended
        return SimpleNamespace(payload=SimpleNamespace(to_string=self._commands.popleft))


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
    modules["zenoh"].open.return_value = Session(commands)
    moving, *stopped = speeds(modules)
    assert moving > 0.0
    assert stopped[0] == 0.0
    assert not any(stopped)
