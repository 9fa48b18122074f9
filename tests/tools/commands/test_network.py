import json
import signal
import subprocess

import msgspec
import pytest
from zenoh import SourceInfo

from agents.errors import ExplainedError
from agents.network.messages import encode
from agents.network.pubsub import ImmediateSubscriber, alive_token, pose_publisher, publisher
from agents.network.session import open_session, tokens_present
from experiments.real_time.conductor.orders import EmergencyStop
from experiments.real_time.hosts.run_registry import own_entry, registered
from tests.cases import for_each
from tests.commands import GUARD, started, zenpark
from tests.fuzz.messages import good
from tests.waiting import until
from tools.commands import orders
from tools.commands.network import HEADING, Cadence, echo, key_expression, readable
from tools.options import Place, place

JSON, MSGPACK = "application/json", "application/msgpack"
LISTEN = ("echo", "park/*/pose", "--seconds", "30", "--connect")


def test_key_expressions():
    for text in ("park/*/pose", "park/**", "park/CF01/pose", "**"):
        assert key_expression(text) == text
    for text, why in (("", "empty chunks"), ("park/x?", "forbidden characters"), ("park/x*", "may only be preceded")):
        with pytest.raises(ExplainedError, match=rf"is not a key expression: .*{why}.*park/\*/pose"):
            key_expression(text)


@for_each(
    "payload, mime, line",
    [
        (b'{ "x": 1.5 }', JSON, '{"x":1.5}'),
        (msgspec.msgpack.encode({"x": [1, None]}), f"{MSGPACK};park", '{"x":[1,null]}'),
        (b"hello \x1b[2J", "text/plain", '"hello \\u001b[2J"'),
        (b'"\xc2\x9b2J"', JSON, '"\\u009b2J"'),
        (b"\x1b[2J", JSON, "<4 bytes, application/json>"),
        (b"\xff\xfe", "zenoh/bytes", "<2 bytes, zenoh/bytes>"),
        (msgspec.msgpack.encode({"x": b"raw"}), MSGPACK, f"<8 bytes, {MSGPACK}>"),
        (b"[" * 100_000, JSON, "<100000 bytes, application/json>"),
    ],
)
def test_payloads_become_one_harmless_line(payload, mime, line):
    assert readable(payload, mime) == line


def test_cadence_counts_per_window_and_keeps_silent_keys():
    cadence = Cadence()
    for arrived in (10.0, 10.1, 10.3):
        cadence.add("b", arrived, 50)
    cadence.add("a", 10.0, 7)
    a, b = map(str, cadence.window(0.5, 10.4))
    assert a.split() == ["2.00", "14", "-", "-", "-", "-", "a"]
    assert b.split() == ["6.00", "300", "150.00", "50.00", "100.00", "200.00", "b"]
    cadence.add("b", 11.3, 50)
    a, b = map(str, cadence.window(0.5, 12.0))
    assert b == "    2.00        100   1000.00      0.00   1000.00   1000.00  b"
    assert len(b) == len(HEADING) - 2
    assert a.split() == ["0.00", "0", "-", "-", "-", "-", "a", "silent", "for", "2", "s"]


@pytest.fixture
def robot(router):
    """Session of a robot."""
    with open_session([router.endpoint], name="CF01") as session:
        yield session


@pytest.fixture
def pose(robot):
    return pose_publisher(robot, "park/CF01/pose", JSON)


@pytest.mark.mechanism("keys")
@pytest.mark.system
def test_keys_shows_members_and_what_they_publish(router, robot, pose, runtime_folder):
    status = pose_publisher(robot, "park/CF01/status", JSON)
    status.put(encode(msgspec.structs.replace(good("CF01", 1)["status"][0], phase="running")))
    life = f"park/CF01/alive/life/{robot.zid()}"
    held = [alive_token(robot, key) for key in ("park/CF01/alive", life, "park/run/conductor")]
    listed = own_entry("router", "of this test", [router.endpoint])
    with registered(listed):  # a run of this machine needs no --connect
        shown = zenpark("keys", "--json")
        assert shown.stderr == ""
        first, second = json.loads(shown.stdout)
        assert first == {
            "name": "CF01", "phase": "running", "sessions": [str(robot.zid())],
            "alive": ["park/CF01/alive", life], "publishes": ["park/CF01/pose", "park/CF01/status"],
        }  # fmt: skip
        assert (second["name"], second["alive"]) == ("run", ["park/run/conductor"])
    assert "  publishes   park/CF01/pose\n" in zenpark("keys", "--connect", router.endpoint).stdout
    del held


def test_place_is_named_or_the_newest_here(monkeypatch, capsys):
    def up(*runs):
        monkeypatch.setattr("experiments.real_time.hosts.run_registry.runs", lambda: [*runs])

    first, second = own_entry("run", "one", ["tcp/127.0.0.1:1"]), own_entry("run", "two", [DEFAULT], realm="hall")
    assert place(["tcp/127.0.0.1:9"], None, acting=True) == Place(["tcp/127.0.0.1:9"])
    up(first)
    assert place(None, None, acting=True) == Place(["tcp/127.0.0.1:1"])
    up(first, second)
    assert place(None, None) == Place([DEFAULT], "hall")
    assert "2 runs and routers are up; this is the newest one" in capsys.readouterr().err
    with pytest.raises(ExplainedError, match=r"choose one\n.*two.*: --connect tcp/127.0.0.1:7447\n.*one"):
        place(None, None, acting=True)
    up()
    assert place(None, None) == Place([DEFAULT], strange=True)
    with pytest.raises(ExplainedError, match="no run or router of yours is up"):
        place(None, None, acting=True)


@pytest.mark.mechanism("echo")
@pytest.mark.system
def test_echo_prints_every_sample_of_every_publisher(router, robot, pose):
    pose.put(b'{"x": 1}')
    plain = robot.declare_publisher("park/KH01/pose")
    with started(*GUARD, *LISTEN, router.endpoint, "-n", "5") as listening:
        assert listening.stdout.readline() == 'park/CF01/pose {"x":1}\n'
        pose.put(msgspec.msgpack.encode({"x": 2.5}), encoding=MSGPACK)
        assert listening.stdout.readline() == 'park/CF01/pose {"x":2.5}\n'
        for number in (0, 0, None):  # as other programs may number their samples
            source = None if number is None else SourceInfo(plain.id, number)
            plain.put(b"3", source_info=source)
            assert listening.stdout.readline() == 'park/KH01/pose "3"\n'
        assert listening.stdout.read() == ""
        assert listening.wait(100.0) == 0


@pytest.mark.mechanism("echo: Ctrl-C")
@pytest.mark.system
def test_ctrl_c_ends_echo_quietly(router, pose):
    pose.put(b"2")
    with started(*GUARD, *LISTEN, router.endpoint) as listening:
        assert listening.stdout.readline() == "park/CF01/pose 2\n"
        listening.send_signal(signal.SIGINT)
        assert (listening.communicate(timeout=100)[1], listening.returncode) == ("", 130)


@pytest.mark.system
def test_rates_of_a_live_publisher(router, robot, capsys):
    echo("park/**", connect=[router.endpoint], seconds=0.1)
    assert capsys.readouterr().out == ""
    state = publisher(robot, "park/CF01/state", JSON)
    with started(*GUARD, "echo", "park/**", "--rates", "--connect", router.endpoint, "--seconds", "1.5") as measuring:
        assert measuring.stdout.readline() == HEADING + "\n"
        while measuring.poll() is None:
            state.put(b"x" * 100)
            robot.delete("park/CF01/pose")
            subprocess.run(["true"], check=True)  # paces the loop
        lines = measuring.stdout.read().splitlines()
    assert measuring.returncode == 0
    assert {line.split()[-1] for line in lines} == {"park/CF01/state", "park/CF01/pose"}
    rate, speed = map(float, lines[1].split()[:2])
    assert speed / rate == pytest.approx(100.0, rel=0.01)
    for line in lines:
        _, _, mean, _, shortest, longest = map(float, line.split()[:-1])
        assert 0.0 <= shortest <= mean <= longest <= 1500.0


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
def test_estop_reaches_each_realm_of_a_router(monkeypatch):
    hall = own_entry("run", "two", [DEFAULT], realm="hall")
    monkeypatch.setattr("experiments.real_time.hosts.run_registry.runs", lambda: [hall])
    assert [each.realm for each in orders.stops_of_all_runs([DEFAULT])] == ["hall", "park"]


@pytest.mark.usefixtures("stop")
def test_estop_names_what_it_cannot_reach(monkeypatch, capsys):
    frozen = own_entry("router", "frozen", [DEFAULT])
    monkeypatch.setattr("experiments.real_time.hosts.run_registry.runs", lambda: [frozen])
    assert orders.estop(dry_run=True) == 1
    assert capsys.readouterr().err == f"no robot would be stopped: frozen, at {DEFAULT}: no router answers\n"


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
def test_dry_run_finds_robots_that_hear_nothing(router, robot):
    stops, _token = [], alive_token(robot, "park/CF01/alive")
    _heard = ImmediateSubscriber(robot, "park/estop", stops.append)
    until(lambda: tokens_present(robot, "park/CF01/alive"), "the robot is there")
    look = EmergencyStop([router.endpoint], "park", "operator")
    look.look()
    assert (look.failure, look.seen, look.moving, stops) == (None, {"CF01"}, set(), [])
    send = EmergencyStop([router.endpoint], "park", "operator")
    send.send("a test")
    assert send.seen == send.moving == {"CF01"}
    until(lambda: stops, "the stop is received")
