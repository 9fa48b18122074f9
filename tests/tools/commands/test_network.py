import json
import math
import signal
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from agents.errors import ExplainedError
from agents.network.messages import Order
from agents.network.pubsub import Orders, alive_token, pose_publisher, publisher, subscriber
from agents.network.session import open_session
from tools.commands.network import HEADING, Cadence, echo, key_expression, members, readable

ROOT = Path(__file__).resolve().parents[3]
JSON, MSGPACK = "application/json", "application/msgpack"


def zenpark(*arguments):
    return subprocess.Popen(
        [sys.executable, "-m", "tools.guard", *arguments],
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize("text", ["park/*/pose", "park/**", "park/CF01/pose", "**"])
def test_key_expressions(text):
    assert key_expression(text) == text


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("park//pose", "empty chunks"),
        ("/park", "empty chunks"),
        ("", "empty chunks"),
        ("park/x?", "forbidden characters"),
        ("park/x*", "may only be preceded"),
    ],
)
def test_what_is_no_key_expression(text, why):
    with pytest.raises(ExplainedError, match=rf"is not a key expression: .*{why}.*park/\*/pose"):
        key_expression(text)


@pytest.mark.parametrize(
    ("payload", "mime", "line"),
    [
        (b'{ "x": 1.5 }', JSON, '{"x":1.5}'),
        (msgspec.msgpack.encode({"x": [1, None]}), MSGPACK, '{"x":[1,null]}'),
        (msgspec.msgpack.encode({"x": [1, None]}), f"{MSGPACK};park", '{"x":[1,null]}'),
        (b"hello \x1b[2J", "text/plain", '"hello \\u001b[2J"'),
        (b'"\xc2\x9b2J"', JSON, '"\\u009b2J"'),
        (b"\x1b[2J", JSON, "<4 bytes, application/json>"),
        (b"\xff\xfe", "zenoh/bytes", "<2 bytes, zenoh/bytes>"),
        (
            msgspec.msgpack.encode({"x": b"raw"}),
            MSGPACK,
            f"<{len(msgspec.msgpack.encode({'x': b'raw'}))} bytes, {MSGPACK}>",
        ),
        (b"[" * 100_000, JSON, "<100000 bytes, application/json>"),
    ],
)
def test_payloads_become_one_harmless_line(payload, mime, line):
    assert readable(payload, mime) == line


def test_cadence_counts_per_window_and_keeps_last_stamp():
    cadence = Cadence()
    for stamp in (10.0, 10.1, 10.3):
        cadence.add("b", stamp, 50)
    cadence.add("a", 10.0, 7)
    a, b = cadence.window(0.5)
    assert (a.key, a.hz, a.bytes_per_s) == ("a", 2.0, 14.0)
    assert math.isnan(a.mean)
    assert math.isnan(a.longest)
    assert (b.key, b.hz, b.bytes_per_s) == ("b", 6.0, 300.0)
    assert (b.mean, b.sigma) == pytest.approx((0.15, 0.05))
    assert (b.shortest, b.longest) == pytest.approx((0.1, 0.2))
    cadence.add("b", 11.3, 50)
    a, b = cadence.window(0.5)
    assert (a.hz, b.hz) == (0.0, 2.0)
    assert b.mean == pytest.approx(1.0)
    assert str(b) == "    2.00        100   1000.00      0.00   1000.00   1000.00  b"
    assert len(str(b)) == len(HEADING) - 2
    assert str(a).split() == ["0.00", "0", "-", "-", "-", "-", "a"]


@pytest.mark.mechanism("keys")
@pytest.mark.system
def test_keys_shows_who_holds_what(router, eventually):
    with (
        open_session([router.endpoint], name="CF01") as robot,
        open_session([router.endpoint], name="recorder") as recorder,
    ):
        held = [
            pose_publisher(robot, "park/CF01/pose", JSON),
            Orders(robot, "park/CF01/order", Order),
            alive_token(robot, "park/CF01/alive"),
            subscriber(recorder, "park/**"),
        ]
        eventually(lambda: sum(len(m.alive) + len(m.subscribers) for m in members(recorder)) == 1)
        shown = zenpark("keys", "--connect", router.endpoint, "--json")
        out, err = shown.communicate(timeout=30)
        assert (shown.returncode, err) == (0, "")
        first, second, third = json.loads(out)
        assert first == {
            "name": "CF01",
            "id": str(robot.zid()),
            "alive": ["park/CF01/alive"],
            "publishers": ["park/CF01/pose"],
            "subscribers": [],
            "queryables": ["park/CF01/order"],
        }
        assert (second["name"], second["subscribers"]) == ("recorder", ["park/**"])
        assert third["name"] == "router"
        plain = zenpark("keys", "--connect", router.endpoint)
        out, _ = plain.communicate(timeout=30)
        assert "  answers     park/CF01/order\n" in out
        del held


@pytest.mark.system
def test_echo_prints_last_pose_and_then_new_ones(router):
    with open_session([router.endpoint], name="CF01") as robot:
        pose = pose_publisher(robot, "park/CF01/pose", JSON)
        pose.put(b'{"x": 1}')
        listening = zenpark("echo", "park/*/pose", "--connect", router.endpoint, "-n", "2", "--seconds", "30")
        with listening:
            assert listening.stdout.readline() == 'park/CF01/pose {"x":1}\n'
            pose.put(msgspec.msgpack.encode({"x": 2.5}), encoding=MSGPACK)
            assert listening.stdout.readline() == 'park/CF01/pose {"x":2.5}\n'
            assert listening.stdout.read() == ""
        assert listening.returncode == 0


@pytest.mark.system
def test_echo_ends_after_its_time(router, capsys):
    echo("park/**", connect=[router.endpoint], seconds=0.1)
    assert capsys.readouterr().out == ""


@pytest.mark.mechanism("echo: Ctrl-C")
@pytest.mark.system
def test_ctrl_c_ends_echo_quietly(router):
    with open_session([router.endpoint], name="CF01") as robot:
        pose = pose_publisher(robot, "park/CF01/pose", JSON)
        pose.put(b"2")
        listening = zenpark("echo", "park/*/pose", "--connect", router.endpoint, "--seconds", "30")
        assert listening.stdout.readline() == "park/CF01/pose 2\n"
        listening.send_signal(signal.SIGINT)
        _, err = listening.communicate(timeout=30)
        assert (listening.returncode, err) == (130, "")


@pytest.mark.system
def test_hz_measures_a_live_publisher(router):
    with open_session([router.endpoint], name="CF01") as robot:
        state = publisher(robot, "park/CF01/state", JSON)
        measuring = zenpark("hz", "park/**", "--connect", router.endpoint, "--seconds", "1.5")
        with measuring:
            assert measuring.stdout.readline() == HEADING + "\n"
            lines = []
            while measuring.poll() is None:
                state.put(b"x" * 100)
                if measuring.poll() is None:
                    subprocess.run(["true"], check=True)  # paces the loop
            lines = measuring.stdout.read().splitlines()
        assert measuring.returncode == 0
        assert {line.split()[-1] for line in lines} == {"park/CF01/state"}
        rate, speed, mean, _, shortest, longest = map(float, lines[0].split()[:-1])
        assert speed / rate == pytest.approx(100.0, rel=0.01)
        assert shortest <= mean <= longest
