"""Robot processes started by hand: whom they hear, what they notice and survive, how they end, are watched."""

import itertools
import json
import math
import os
import threading
import time
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import msgspec
import psutil
import pytest
import zenoh

from agents.clock import Clock
from agents.network import messages, pubsub
from agents.network.keys import Keys
from experiments.definition import access_rights
from experiments.file import catalogue
from experiments.file.document import load
from experiments.run import simulate
from tests.commands import zenpark
from tests.conftest import RouterProcess
from tests.system.lab import TRIANGLE, RobotProcess, typed, until
from tests.tools.commands.test_live_table import STATUS

pytestmark = pytest.mark.system

BLOCK = zenoh.CongestionControl.BLOCK  # a stop must not be dropped where a hundred kilobytes go before it


@pytest.fixture
def low_file(tmp_path):
    """The triangle, whose drone is soon up and soon down."""
    file = tmp_path / "low.toml"
    file.write_text(catalogue.path("triangle").read_text("utf-8").replace("hover = 0.6", "hover = 0.3"), "utf-8")
    return str(file)


@pytest.fixture
def robots(router):
    """The processes of a triangle, by name."""
    with ExitStack() as stack:
        yield {name: stack.enter_context(RobotProcess(router.endpoint, "triangle", name)) for name in TRIANGLE}


def subscriptions(session):
    """Keys that each session subscribes to, by its name: from the admin space of sessions and router."""
    found = {}
    for reply in session.get("@/*/router/subscriber/**", timeout=2.0):
        key = str(reply.ok.key_expr).partition("/subscriber/")[2]
        for zid in itertools.chain(*json.loads(reply.ok.payload.to_string()).values()):
            found.setdefault(zid, set()).add(key)
    clients = [reply.ok.payload.to_string() for reply in session.get("@/*/client", timeout=2.0) if reply.ok is not None]
    return {about["metadata"]["name"]: found.get(about["zid"], set()) for about in map(json.loads, clients)}


@pytest.mark.parametrize(
    "file", ["robotic-park", pytest.param("convoy", marks=pytest.mark.mechanism("subscriptions of neighbours only"))]
)  # nobody listens to the last robot of a convoy
def test_each_robot_hears_exactly_its_neighbours(router, watcher, file):
    wanted = access_rights.senders_by_receiver(load(file).plan)
    with ExitStack() as stack:
        for name in wanted:
            stack.enter_context(RobotProcess(router.endpoint, file, name))
        watcher.until_all("ready", *wanted)
        keys = subscriptions(watcher.session)
        for name, neighbours in wanted.items():
            poses = {key for key in keys[name] if key.endswith("/pose") or "/pose/" in key}
            plain = {key for key in poses if "@adv" not in key}
            assert plain == {f"park/{neighbour}/pose" for neighbour in neighbours}, name
            assert all("estop" in key or "@adv" in key for key in keys[name] - poses), keys[name]


@pytest.mark.mechanism("orders")
def test_orders_are_answered_and_refused_with_a_reason(router, watcher, low_file):
    with RobotProcess(router.endpoint, low_file, *TRIANGLE):
        watcher.until_all("ready", *TRIANGLE)

        def order(word, **fields):
            return watcher.order("CF01", messages.Order(word, **fields))

        for reply in (order("start", at=time.time()), order("go"), order("set", name="trigger.period_s", value=0.0)):
            assert not reply.ok
        assert "needs `at`" in order("start").reason
        assert order("get", name="clamp").value == pytest.approx(0.1)
        assert order("set", name="clamp", value=0.05).value == pytest.approx(0.05)
        assert "known: clamp" in order("set", name="clmp", value=1.0).reason
        assert watcher.order("nobody", messages.Order("land")).reason == "no answer"
        bare = [b'{"order": "get", "name": "clamp"}', b'{"order": "go"}']  # as z_get sends them: without an encoding
        answers = [
            messages.decode(reply.ok.payload.to_bytes(), messages.JSON, messages.Reply)
            for payload in bare
            for reply in watcher.session.get("park/*/order", payload=payload, timeout=2.0)
            if reply.ok is not None
        ]
        assert sorted((answer.robot, answer.value, answer.reason) for answer in answers if answer.ok) == [
            ("CF01", 0.05, ""), ("KH01", 0.1, ""), ("KH02", 0.1, "")
        ]  # fmt: skip
        assert {answer.reason for answer in answers if not answer.ok} == {
            "an order to go needs a `goal`, x and y in metres"
        }
        watcher.take_off(*TRIANGLE)
        watcher.start(*TRIANGLE)
        watcher.give(messages.Order("hold"), "CF01")
        watcher.give(messages.Order("land"), *TRIANGLE)
        watcher.until_all("done", *TRIANGLE)


def nonsense():
    honest = messages.Pose("KH02", 10**6, time.time(), (0.1, 0.1, 0.0), (0.0, 0.0, 0.0), 0.0)
    wrong = [
        *({"position": (x, 0.0, 0.0)} for x in (math.nan, math.inf, 1e6)),
        *({"velocity": (x, 0.0, 0.0)} for x in (math.nan, 1e9)),
        *({"stamp": stamp} for stamp in (math.nan, 1e300, time.time() + 3600.0)),
        *({"yaw": math.nan}, {"seq": -1}, {"robot": "CF01"}),
    ]
    texts = (b"", os.urandom(200), b"[" * 50_000, b'{"robot": 7}', b'{"order": "dance"}', b'"text"', b"x" * 100_000)
    return [
        *((text, messages.JSON) for text in texts),
        (os.urandom(200), messages.MSGPACK),
        (b"\xff\xfe", "text/plain"),
        *((messages.encode(msgspec.structs.replace(honest, **each), "msgpack"), messages.MSGPACK) for each in wrong),
    ]


@pytest.mark.mechanism("malformed messages")
def test_nonsense_on_every_key_is_counted_moving_nobody(router, watcher, low_file):
    with RobotProcess(router.endpoint, low_file, *TRIANGLE):
        watcher.take_off(*TRIANGLE)
        given = nonsense()
        expected = 2 * len(given)  # a pose and an order each
        for payload, mime in given:
            watcher.session.put(watcher.keys.pose("KH02"), payload, encoding=mime)
            for key in (watcher.keys.state("KH02"), watcher.keys.alive("KH02"), watcher.keys.event):
                watcher.session.put(key, payload, encoding=mime)
            for reply in watcher.session.get(watcher.keys.order("CF01"), payload=payload, encoding=mime, timeout=2.0):
                assert reply.err is not None
        watcher.session.put("park/*/pose", b"{}", encoding=messages.JSON)
        watcher.session.delete(watcher.keys.pose("KH02"))
        watcher.session.delete(watcher.keys.estop)

        def counted():
            """Refused payloads, and poses that were well formed and came from another source than the robot."""
            status = watcher.status["CF01"]
            return status.malformed + status.foreign.get("KH02", 0)

        watcher.until(lambda: counted() >= expected, f"{expected} are counted")
        assert {watcher.phase(name) for name in TRIANGLE} == {"airborne"}
        state = watcher.state["CF01"]
        assert state.position[2] == pytest.approx(0.3, abs=0.05)
        assert math.dist(state.position[:2], state.goal[:2] if state.goal else (9.0, 9.0)) < 0.1


@pytest.mark.mechanism("lifeline: a robot lands with its starter")
def test_a_robot_whose_starter_falls_silent_lands(router, watcher, low_file):
    with RobotProcess(router.endpoint, low_file, *TRIANGLE, lifeline=True) as robot:
        stdin = robot.process.stdin

        def starter_is_heard_and_all_are_ready():
            stdin.write("\n")
            stdin.flush()
            return all(watcher.phase(name) == "ready" for name in TRIANGLE)

        watcher.until(starter_is_heard_and_all_are_ready, "all are ready")
        assert watcher.order("CF01", messages.Order("takeoff")).ok
        silent = "nothing from the starter"
        watcher.until(lambda: watcher.status["CF01"].reason.startswith(silent), "silence is noticed")
        assert robot.wait() == 0
        watcher.look()
        assert watcher.phase("CF01") == "done"
        assert watcher.state["CF01"].position[2] < 0.03


@pytest.mark.mechanism("frozen neighbour")
def test_a_killed_and_a_frozen_neighbour_are_noticed(watcher, robots, router):
    watcher.until_all("ready", *TRIANGLE)
    with watcher.session.liveliness().declare_token("park/**"):  # somebody who says that everybody lives ...
        watcher.until(lambda: "KH01" in watcher.state, "they go on")
    told = watcher.state["KH01"].seq  # ... and then that everybody is dead
    watcher.until(lambda: watcher.state["KH01"].seq > told + 10, "they still go on")
    assert not any(watcher.status[name].missing for name in TRIANGLE)
    robots["KH02"].freeze()
    watcher.until(lambda: watcher.status["KH01"].missing == ["KH02"], "it hangs")
    robots["KH02"].thaw()
    watcher.until(lambda: not watcher.status["KH01"].missing, "it is back")
    watcher.until(lambda: "KH02" in watcher.alive, "its token too")
    robots["CF01"].kill()
    watcher.until(lambda: watcher.status["KH01"].missing == ["CF01"], "it is dead")
    with RobotProcess(router.endpoint, "triangle", "CF01"):
        watcher.until(lambda: watcher.status["CF01"].received >= 2 and watcher.all("ready", "CF01"), "another is there")
        watcher.until(lambda: not watcher.status["KH01"].missing, "it is heard again")


@pytest.mark.mechanism("emergency stop from any Zenoh client")
def test_an_emergency_stop_reaches_every_process(watcher, robots):
    watcher.until_all("ready", *TRIANGLE)
    watcher.session.delete(watcher.keys.estop)  # no stop
    watcher.until(lambda: not any(watcher.phase(name) == "done" for name in TRIANGLE), "nobody was stopped")
    watcher.session.put(watcher.keys.estop, b"all of you", congestion_control=BLOCK)  # as zenoh-cli, without encoding
    watcher.until_all("done", *TRIANGLE)
    assert {watcher.status[name].reason for name in TRIANGLE} == {"emergency stop by an unknown sender: all of you"}
    assert all(watcher.status[name].malformed == 0 for name in TRIANGLE)
    assert all(robot.process.poll() is None for robot in robots.values())


CUT_OFF_S = 3.0  # until the loss of the router is noticed: before that good-byes are still taken


def test_robot_leaves_a_router_that_does_not_answer(router, watcher):
    with RobotProcess(router.endpoint, "triangle", "KH01") as robot:
        watcher.until_all("idle", "KH01")
        with router.frozen():
            threading.Event().wait(CUT_OFF_S)
            began = time.monotonic()
            assert robot.end() == 0
            assert time.monotonic() - began < 13.0, "Zenoh alone takes longer, however quick the machine"


def test_router_that_was_frozen_ends_when_ordered():
    """The kernel then gives the signal to any of its threads, at every second time to one that does not heed it."""
    for _ in range(4):
        router = RouterProcess()
        with router.frozen():
            process = psutil.Process(router.process.pid)
            until(lambda process=process: process.status() == psutil.STATUS_STOPPED, "it is frozen")
        assert router.stop() == 0


@pytest.mark.mechanism("emergency stop: frozen router")
def test_an_estop_that_nobody_answers_ends(router):
    with router.frozen():
        done = zenpark("estop", "--connect", router.endpoint, code=None)
    assert done.returncode in {1, 2}
    assert "Traceback" not in done.stderr


@pytest.mark.mechanism("table of a run from another shell")
def test_top_shows_a_routers_robots_worst_first(router, watcher):
    session, keys, over, begin = watcher.session, watcher.keys, threading.Event(), Clock().utc()
    tokens = [pubsub.alive_token(session, keys.alive(name)) for name in ("alpha", "beta", "gamma")]

    def report():
        """Ten times a second; the last one has a hazard, and uses half a core."""
        while not over.wait(0.1):
            now = Clock().utc()
            held = {"hazard": "hold: link silence", "cpu_s": 0.5 * (now - begin)}
            for name, more in (("alpha", {}), ("beta", {}), ("gamma", held)):
                status = msgspec.structs.replace(STATUS, robot=name, stamp=now, **more)
                session.put(keys.status(name), messages.encode(status), encoding=messages.JSON)

    with ThreadPoolExecutor() as pool:
        pool.submit(report)
        done = zenpark("top", "--connect", router.endpoint)
        over.set()
    del tokens
    title, *rows = done.stdout.splitlines()
    assert "held 1" in title
    assert "running 2" in title
    assert [row.split()[0] for row in rows[:4]] == ["robot", "gamma", "alpha", "beta"]
    assert rows[1].split()[1] == "held"
    assert "50 %" in rows[1]


@pytest.mark.mechanism("recording played onto a network")
def test_recording_plays_with_keys_and_payloads_as_flown(router, watcher, tmp_path):
    simulate(load("triangle", "duration_s=3.0", "timeline=[]"), cases=["event"], folder=tmp_path)
    seen = defaultdict(list)
    listening = watcher.session.declare_subscriber(
        "park/**", lambda sample: seen[str(sample.key_expr)].append(sample.payload.to_bytes())
    )
    zenpark("view", tmp_path, "--send", "--connect", router.endpoint)
    sent = [messages.decode(each, messages.JSON, messages.Pose) for each in seen["park/CF01/pose"]]
    assert [(p.seq, p.stamp, p.position) for p in sent] == [
        (p.seq, p.stamp, tuple(p.position)) for p in typed(tmp_path / "event.mcap", "/CF01/pose")
    ]
    assert {"park/run/event", "park/run/experiment", "park/CF01/state", "park/CF01/status"} <= seen.keys()
    for robot in ("park/KH01/state", "park/KH02/state"):
        assert len(seen[robot]) == len(typed(tmp_path / "event.mcap", robot.removeprefix("park")))
    seen.clear()
    token = pubsub.alive_token(watcher.session, Keys().conductor)
    refused = zenpark("view", tmp_path, "--send", "--connect", router.endpoint, code=2)
    assert seen == {}
    assert "a run is up (park/run/conductor)" in refused.stderr
    token.undeclare()
    listening.undeclare()
