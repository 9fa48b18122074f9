"""Orders and emergency stops: to whom they go, and what is said of those that obey."""

import signal
import subprocess
import sys
import threading
from contextlib import nullcontext
from types import SimpleNamespace

import pytest

from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.session import Unreachable
from experiments.real_time.conductor import orders
from experiments.real_time.conductor.orders import Emergency
from experiments.real_time.hosts import run_registry
from experiments.real_time.hosts.launcher import Launcher
from experiments.real_time.hosts.run_registry import RegisteredRun, StopReport, born
from tests.experiments.recordings import status
from tests.fuzz.messages import sent
from tests.network import Net, Reply, Sample
from tests.small import changed
from tests.waiting import PATIENCE_S, ManualClock, until

KEYS = Keys()


@pytest.mark.mechanism("orders to several robots at once")
@pytest.mark.system
def test_order_reaches_all_before_one_has_answered(router):
    """The first answers only when the last has the order; a storage, nearer and complete, answers by mistake."""
    names, over = ["A", "B", "C"], threading.Event()

    def answer():
        waiting = {}
        while len(waiting) < len(names) and not over.wait(0.005):
            waiting |= {name: query for name, queryable in told.items() for query, _ in queryable.read()}
        for name, query in waiting.items():
            with query:
                reply = messages.Reply(name, name != "B", "airborne", "" if name != "B" else "no")
                query.reply(KEYS.order(name), messages.encode(reply), encoding=messages.JSON)

    def recall(query):
        with query:
            query.reply(query.key_expr, b'{"order": "land"}', encoding=messages.JSON)

    with (
        network.open_session([router.endpoint], name="storage") as storage,
        network.open_session([router.endpoint], name="robots") as robots,
        network.open_session([router.endpoint], name="conductor") as conductor,
    ):
        storage.declare_queryable(KEYS.everything, recall, complete=True)
        told = {name: pubsub.Orders(robots, KEYS.order(name), messages.Order) for name in names}
        _token = pubsub.alive_token(robots, KEYS.alive("A"))
        until(lambda: network.tokens_present(conductor, KEYS.alive("A")), "robots are there, with their keys")
        thread = threading.Thread(target=answer)
        thread.start()
        try:
            replies = orders.send_order(conductor, KEYS, [*names, "D"], messages.Order("hold"), PATIENCE_S)
        finally:
            over.set()
            thread.join()
    unread = "malformed reply: no valid Reply: Object contains unknown field `order`"
    assert [(reply.ok, reply.reason) for reply in replies.values()] == [
        (True, ""), (False, "no"), (True, ""), (False, unread),
    ]  # fmt: skip


def test_replies_of_another_key_or_robot_are_none():
    good, net = messages.Reply("A", ok=False, phase="ready", reason="not now"), Net()
    for name, reply in (("A", changed(good, robot="B", ok=True)), ("B", changed(good, ok=True)), ("A", good)):
        net.replies.append(Reply(Sample(KEYS.order(name), messages.JSON, messages.encode(reply)), good=True))
    assert orders.send_order(net.session, KEYS, ["A"], messages.Order("hold")) == {"A": good}


def test_stop_is_repeated_although_a_router_hangs(monkeypatch):
    clock, stops = ManualClock(), []

    def alive(*_):
        clock.now += orders.STOP_ANSWER_S
        return {"A"}

    with Net().worn():
        monkeypatch.setattr(orders, "time", clock)
        monkeypatch.setattr(orders, "alive", alive)
        monkeypatch.setattr(orders, "closing_cleanly", lambda session: nullcontext((session, [])))
        monkeypatch.setattr(orders, "stop_publisher", lambda *_: SimpleNamespace(put=stops.append))
        stop = orders.EmergencyStop(["tcp/127.0.0.1:1"], "park", "operator")
        stop.send("a test")
    assert (stop.failure, stop.moving) == (None, {"A"})
    assert len(stops) > orders.STOP_ANSWER_S / orders.STOP_AGAIN_S


@pytest.mark.parametrize(("phase", "moving"), [("landing", {"B"}), ("done", set())])
def test_stop_names_robots_without_a_token(phase, moving, monkeypatch):
    with Net().worn() as net:
        said = sent("park/B/status", changed(status("B", at=1.0), phase=phase, reason="emergency stop by me"))[0]
        monkeypatch.setattr(orders, "time", ManualClock())
        monkeypatch.setattr(orders, "alive", lambda *_: set())
        monkeypatch.setattr(orders, "closing_cleanly", lambda session: nullcontext((session, [])))
        monkeypatch.setattr(orders, "stop_publisher", lambda *_: SimpleNamespace(put=lambda _: net.deliver(said)))
        stop = orders.EmergencyStop(["tcp/127.0.0.1:1"], "park", "operator")
        stop.send("a test")
    assert (stop.failure, stop.seen, stop.moving) == (None, {"B"}, moving)


@pytest.mark.parametrize("of_run", [False, True], ids=["routers", "run"])
def test_stop_goes_to_each_router(of_run, monkeypatch):
    """Where the network is split, A and B are at one router, C is at another; a third one does not answer."""
    places = [f"tcp/127.0.0.1:{port}" for port in (1, 2, 3)]
    there = {places[0]: ({"A", "B"}, {"B"}), places[1]: ({"B", "C"}, {"C"})}

    def by_network(_, routers, *__):
        if routers[0] not in there:
            raise Unreachable("no router answers")
        return there[routers[0]]

    monkeypatch.setattr(orders.EmergencyStop, "_send", by_network)
    monkeypatch.setattr(run_registry, "tell", lambda *_: run_registry.StopReport(["A", "B", "C"], ["C"]))
    run = changed(run_registry.own_entry("run", "three", places), robots=dict.fromkeys("ABC", "")) if of_run else None
    stop = orders.EmergencyStop(places, "park", "operator", run)
    stop.send("a test")
    assert (stop.failure, stop.seen, stop.unreached) == (None, {"A", "B", "C"}, places[2:])
    assert (stop.moving, stop.missed) == (set() if of_run else {"C"}, not of_run)


@pytest.mark.parametrize(("phase", "ok"), [("landing", False), ("done", True)])
def test_order_to_stop_waits_for_the_motors(phase, ok, monkeypatch):
    said = sent("park/A/status", changed(status("A", at=1.0), phase=phase))[0]
    with Net().worn() as net:

        def answer(*_):
            net.deliver(said)
            return {"A": messages.Reply("A", ok=True, phase="done")}

        monkeypatch.setattr(orders, "time", ManualClock())
        monkeypatch.setattr(orders, "send_order", answer)
        reply = orders.send_stop_order(net.session, KEYS, ["A"])["A"]
    assert (reply.ok, "NOT known to have stopped" in reply.reason) == (ok, not ok)


def test_stop_without_robots_ends_the_run():
    with subprocess.Popen(["sleep", "60"]) as process, Net().worn():
        run = RegisteredRun("run", process.pid, born(process.pid) or "", 0.0, "mesh", "", ["tcp/127.0.0.1:1"])
        stop, again = (orders.EmergencyStop(run.endpoints, run.realm, run.identity, run) for _ in range(2))
        stop.look()
        assert (stop.expected, stop.run_ended, process.poll()) == (True, False, None)
        stop.send("a test")
        assert stop.run_ended
        assert process.wait(100.0) == -signal.SIGTERM
        again.send("a test")
        assert not again.run_ended


@pytest.fixture
def stopped(monkeypatch):
    """A stop of a run with the robots A and B: what its process answers, and which robots are seen at its router."""

    def send(report, seen, *, moving=()):
        run = changed(run_registry.own_entry("run", "two", ["tcp/127.0.0.1:1"]), robots={"A": "", "B": ""})
        stop = orders.EmergencyStop(run.endpoints, run.realm, run.identity, run)

        def by_network(*_):
            if isinstance(seen, Exception):
                raise seen
            return set(seen), set(moving)

        monkeypatch.setattr(run_registry, "tell", lambda *_: report)
        monkeypatch.setattr(stop, "_send", by_network)
        monkeypatch.setattr(orders.os, "kill", lambda *_: None)
        stop.send("a test")
        return stop

    return send


DEAF = Unreachable("no router answers")


@pytest.mark.parametrize(
    ("report", "seen", "result"),  # robots: reported by the run; seen at its router; down, moving, strangers
    [
        (StopReport(["A", "B"], ["A", "B"]), "AB", ("AB", "", "")),
        (StopReport(["A", "B"], ["A", "B"]), DEAF, ("AB", "", "")),
        (StopReport(["A"], ["A"]), DEAF, ("A", "B", "")),  # B may be there, started by others
        (StopReport(["A", "B"], ["A"]), "CD", ("A", "B", "CD")),  # another run has its router's address
        (None, "CD", ("", "AB", "CD")),  # likewise, and its process stands still
        (None, "AB", ("AB", "", "")),
        (None, DEAF, ("", "AB", "")),
        (StopReport([], []), "", ("", "", "")),  # no case is up
    ],
)
def test_stopped_are_robots_of_that_run(report, seen, result, stopped):
    stop = stopped(report, seen)
    assert (stop.seen - stop.moving, stop.moving, stop.strangers) == tuple(map(set, result))
    assert stop.missed == bool(result[1])


def test_late_report_is_made_up_by_run(stopped):
    stop = stopped(StopReport(["A", "B"], ["A"]), "AB", moving="AB")
    assert (stop.seen, stop.moving, stop.missed) == ({"A", "B"}, {"B"}, True)


def test_launcher_passes_stops_on_by_lifelines(tmp_path):
    emergency = Emergency()
    echo = "import sys\nfor line in sys.stdin:\n    if line.strip(): print('A: done', line, flush=True)"
    with Launcher(tmp_path / "logs") as launcher:
        emergency.guard(launcher)
        robot, station = (launcher.spawn(name, [sys.executable, "-c", echo], answers=name == "s") for name in "As")
        robot.robots = ("A", "B")
        assert launcher.stopped() == {"A": False, "B": False}
        report = emergency.obey(messages.Stop("operator", "a test"))
        assert report == StopReport(["A", "B"], ["A"])
        later = launcher.spawn("later", [sys.executable, "-c", echo])
        until(lambda: "stop" in later.output, "a process that starts later gets it too")
        launcher.end(["A", "later"], grace_s=5.0)
        station.close()
        assert station.handle.stdout.read() == b"", "a station gets questions only"
    assert emergency.words == "emergency stop by operator: a test"
