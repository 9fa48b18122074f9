"""Orders reach all robots at once, and who begins late is known."""

from __future__ import annotations

import signal
import subprocess
import threading
from contextlib import nullcontext
from types import SimpleNamespace

import msgspec
import pytest
import zenoh

from agents.clock import Clock
from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from agents.safety.hazards import failed
from experiments.real_time.conductor import orders
from experiments.real_time.conductor.run_view import NetworkView, RobotView
from experiments.real_time.hosts.run_registry import RegisteredRun, born
from tests.conftest import RouterProcess
from tests.experiments.recordings import START, status
from tests.network import Net
from tests.waiting import ManualClock, until

KEYS = Keys()


@pytest.mark.mechanism("orders to several robots at once")
@pytest.mark.system
def test_order_reaches_all_before_one_has_answered(router: RouterProcess) -> None:
    """The first answers only when the last has the order: whoever is asked one after the other waits in vain.

    A storage of the network, nearer and complete, answers with what was put there by mistake.
    """
    names = ["A", "B", "C"]
    over = threading.Event()

    def answer() -> None:
        waiting = {}
        while not over.wait(0.005):
            for name, queryable in told.items():
                for query, _ in queryable.read():
                    waiting[name] = query
            if len(waiting) == len(names):
                for name, query in waiting.items():
                    with query:
                        reply = messages.Reply(name, name != "B", "airborne", "" if name != "B" else "no")
                        query.reply(KEYS.order(name), messages.encode(reply), encoding=messages.JSON)
                waiting = {}

    def recall(query: zenoh.Query) -> None:
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
            replies = orders.send_order(conductor, KEYS, [*names, "D"], messages.Order("hold"), 20.0)
        finally:
            over.set()
            thread.join()
    unread = "malformed reply: not a Reply: Object contains unknown field `order`"
    assert [(name, reply.ok, reply.reason) for name, reply in replies.items()] == [
        ("A", True, ""), ("B", False, "no"), ("C", True, ""), ("D", False, unread),
    ]  # fmt: skip


class Replies:
    """Stands for a session, and replies to each query with the same samples."""

    def __init__(self, *said: tuple[str, messages.Reply]) -> None:
        self._said = said

    def get(self, *_: object, **__: object) -> list[SimpleNamespace]:
        return [
            SimpleNamespace(ok=SimpleNamespace(key_expr=key, payload=zenoh.ZBytes(messages.encode(reply)),
                                               encoding=messages.JSON), err=None)
            for key, reply in self._said
        ]  # fmt: skip


def test_replies_of_another_key_or_robot_are_none() -> None:
    good = messages.Reply("A", ok=False, phase="ready", reason="not now")
    late = messages.Reply("A", ok=True, phase="ready", reason="")
    others = messages.Reply("B", ok=True, phase="ready", reason="")
    session = Replies((KEYS.order("A"), others), (KEYS.order("B"), late), (KEYS.order("A"), good))
    assert orders.send_order(session, KEYS, ["A"], messages.Order("hold")) == {"A": good}  # type: ignore[arg-type]


def test_stop_is_repeated_although_a_router_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, stops = ManualClock(), []

    def alive(*_: object) -> set[str]:
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


def test_stop_without_robots_ends_the_run() -> None:
    with subprocess.Popen(["sleep", "60"]) as process, Net().worn():
        run = RegisteredRun("run", process.pid, born(process.pid) or "", 0.0, "mesh", "", ["tcp/127.0.0.1:1"])
        stop = orders.EmergencyStop(run.endpoints, run.realm, run.identity, run)
        stop.look()
        assert (stop.expected, stop.run_ended, process.poll()) == (True, False, None)
        stop.send("a test")
        assert stop.run_ended
        assert process.wait(10.0) == -signal.SIGTERM
        again = orders.EmergencyStop(run.endpoints, run.realm, run.identity, run)
        again.send("a test")
        assert not again.run_ended


class View(NetworkView):
    """The network as a conductor sees it, without a network."""

    def __init__(self) -> None:
        self.clock, self.robots = Clock(), {"TB01": RobotView()}
        self.said: list[tuple[str, str, str]] = []

    def report(self, kind: str, source: str, text: str, stamp: float | None = None) -> None:
        self.said.append((kind, source, text))


def test_robots_beginning_is_its_first_status_within_experiment() -> None:
    view = View()
    for phase, at in (("airborne", -0.1), ("running", 0.28), ("running", 1.28), ("landing", 2.0)):
        view.receive_status(msgspec.structs.replace(status(at=at), phase=phase))
    assert view.robots["TB01"].began == START + 0.28
    view.robots["TB01"].forget_process()
    assert view.robots["TB01"].began is None


@pytest.mark.parametrize(
    ("reason", "incidents", "fault"),
    [
        ("its control loop hangs: no tick for 0.5 s", (), True),
        ("its control loop hangs: no tick for 0.5 s", ("over: a neighbour is lost, after 2.00 s",), True),
        ("the starter is gone", (), True),
        ("its battery is low", ("land: its battery is low: 5% (limit 10%)",), False),
        ("finished", (), False),
        ("ordered to land", (), False),
        ("ordered to leave", (), False),
        ("asked to end", (), False),
        ("lands as its file says", (), False),
        ("emergency stop by a test", (), False),
    ],
)
def test_unasked_landing_is_a_hazard_with_reason_once(reason: str, incidents: tuple[str, ...], fault: bool) -> None:
    view = View()
    told = [messages.Incident(k + 1, START, text) for k, text in enumerate(incidents)]
    for at, phase in enumerate(("running", "landing", "landing", "done")):
        down = phase != "running"
        changes = {"reason": reason, "incidents": told} if down else {}
        view.receive_status(msgspec.structs.replace(status(at=float(at)), phase=phase, **changes))
    found = [text for kind, source, text in view.said if (kind, source) == ("hazard", "TB01")]
    assert found == [*incidents, *([f"land: {reason}"] if fault else [])]
    assert any(failed(text) for text in found) == (fault or reason == "its battery is low")
