"""What the emergency stop prints: whom it stopped, whom not, and where."""

import json

import pytest

from agents.network import pubsub
from agents.network import session as network
from agents.network.keys import Keys
from experiments.real_time.conductor.orders import EmergencyStop
from tests.waiting import until
from tools.commands import orders

NAMES = [f"CF{number:03}" for number in range(1, 51)]
DEFAULT = "tcp/127.0.0.1:7447"


@pytest.fixture
def stop(monkeypatch):
    """Stops without a network: at port 1 are fifty robots, of which CF001 to CF030 do not stop; elsewhere is nobody."""

    def look(self):
        if self.endpoints == ["tcp/127.0.0.1:1"]:
            self.seen = set(NAMES)
        else:
            self.failure = ConnectionError("no router answers")

    def send(self, _reason):
        look(self)
        self.moving = self.seen & {*NAMES[:30]}

    monkeypatch.setattr(EmergencyStop, "look", look)
    monkeypatch.setattr(EmergencyStop, "send", send)
    monkeypatch.setenv(orders.CONNECT, "tcp/127.0.0.1:1")
    monkeypatch.setattr("experiments.real_time.hosts.run_registry.runs", list)
    return EmergencyStop


@pytest.mark.usefixtures("stop")
def test_estop_names_both_kinds_of_robots(capsys):
    assert orders.estop() == 1
    out, err = capsys.readouterr()
    assert out == f"stopped: {', '.join(NAMES[30:])} (at tcp/127.0.0.1:1)\n"
    first = ", ".join(NAMES[:20])
    assert err.splitlines() == [
        f"NOT known to have stopped: {first} and 10 more (--json names all) (30 of 50 robots; at tcp/127.0.0.1:1)",
        f"also tried, at {DEFAULT}: no router answers",
    ]
    assert orders.estop(as_json=True) == 1
    assert json.loads(capsys.readouterr().out)["routers"][0]["not_known_to_have_stopped"] == NAMES[:30]


@pytest.mark.usefixtures("stop")
def test_dry_run_names_robots_and_sends_no_stop(monkeypatch, capsys):
    monkeypatch.delattr(EmergencyStop, "send")
    assert orders.estop(dry_run=True, connect=["tcp/127.0.0.1:1"]) == 0
    first = ", ".join(NAMES[:20])
    said = f"would be stopped: {first} and 30 more (--json names all) (at tcp/127.0.0.1:1)\n"
    assert tuple(capsys.readouterr()) == (said, "")
    assert orders.estop(dry_run=True, as_json=True) == 0
    asked = json.loads(capsys.readouterr().out)["routers"]
    assert [each["would_be_stopped"] for each in asked] == [NAMES, []]


@pytest.mark.system
def test_dry_run_finds_robots_that_hear_nothing(router):
    keys = Keys()
    with network.open_session([router.endpoint], name="CF01") as robot:
        _token = pubsub.alive_token(robot, keys.alive("CF01"))
        stops = []
        _heard = pubsub.ImmediateSubscriber(robot, keys.estop, stops.append)
        until(lambda: network.tokens_present(robot, keys.alive("CF01")), "the robot is there")
        look = EmergencyStop([router.endpoint], "park", "operator")
        look.look()
        assert (look.failure, look.seen, look.moving, stops) == (None, {"CF01"}, set(), [])
        send = EmergencyStop([router.endpoint], "park", "operator")
        send.send("a test")
        assert send.seen == send.moving == {"CF01"}
        until(lambda: stops, "the stop is received")
