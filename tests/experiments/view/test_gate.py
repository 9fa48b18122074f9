"""Gate of the view's page: which requests reach it, and whose orders count."""

import os
import threading
import time
from math import inf
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest

pytest.importorskip("viser", reason="needs viser")

from websockets.datastructures import Headers
from websockets.http11 import Request

from agents.errors import ExplainedError
from agents.network import messages
from experiments.file.document import load
from experiments.real_time.hosts.run_registry import RegisteredRun
from experiments.scene.stage import SceneModel
from experiments.view import acting as orders
from experiments.view import heartbeat
from experiments.view.gate import Gate, Seen
from tests.experiments.scene.test_stage import at_start
from tests.waiting import PATIENCE_S, until

HOST = "127.0.0.1:8080"
HANDSHAKE = ("Upgrade", "websocket")


def answered(gate, path, *headers):
    """Status of the answer to a request, or the path that the page's server is asked for."""
    asked, given = [], Headers()
    for name, value in headers:
        given[name] = value
    response = gate.answer(lambda _, request: asked.append(request.path), None, Request(path, given))
    return asked[0] if asked else response.status_code


OWN, EVIL = ("Origin", f"http://{HOST}"), ("Origin", "http://evil.example")
HERE, THERE = ("Host", HOST), ("Host", "evil.example:8080")


def test_own_page_opens_its_websocket():
    gate = Gate("secret")
    for host in (HOST, "localhost:8080", "localhost", "[::1]:9000"):
        assert answered(gate, "/secret", ("Host", host), ("Origin", f"http://{host}"), HANDSHAKE) == "/secret"
        assert answered(gate, "/secret/", ("Host", host)) == "/"


@pytest.mark.parametrize(
    ("path", "headers"),
    [
        ("/", [HERE]),
        ("/", [HERE, OWN, HANDSHAKE]),
        ("/former-secret", [HERE, OWN, HANDSHAKE]),
        ("/clock", [HERE]),
        ("/open/guessed", [HERE]),
        ("/sécret", [HERE]),
        ("/secret", [HERE, HANDSHAKE]),
        ("/secret", [HERE, EVIL, HANDSHAKE]),
        ("/secret", [HERE, ("Origin", "null"), HANDSHAKE]),
        ("/secret", [HERE, ("Origin", "http://127.0.0.1:3000"), HANDSHAKE]),
        ("/secret", [HERE, OWN, EVIL, HANDSHAKE]),
        ("/secret", [THERE, ("Origin", "http://evil.example:8080"), HANDSHAKE]),
        ("/secret", [("Host", "127.0.0.1.evil.example"), ("Origin", "http://127.0.0.1.evil.example"), HANDSHAKE]),
        ("/secret/", [("Host", "evil.example")]),
        ("/secret/", [HERE, HERE]),
        ("/secret/", [HERE, EVIL]),
        ("/secret/", []),
    ],
)
def test_others_are_refused(path, headers):
    assert answered(Gate("secret"), path, *headers) == 403


def test_address_for_once_leads_in_once():
    gate = Gate()
    path = f"/{gate.ticket()}"
    assert [answered(gate, path, host) for host in (THERE, HERE, HERE)] == [403, 303, 403]
    assert gate.secret not in (Gate().secret, repr(gate))


def test_page_reports_what_it_shows():
    gate, now = Gate("secret"), time.time()
    gate.open(1)
    lags = [gate.lag(gate.seen[1].opened + late) for late in (3.0, 3600.0)]
    assert lags == pytest.approx([3.0, 0.0]), "a page without reports slows for a while"
    for query in ("page=1&drawn=x&stage=1", "page=9&drawn=1&stage=1", f"page=1&drawn={now + 3600}&stage=1", "&" * 99):
        assert answered(gate, f"/secret/clock?{query}", HERE) == 200
        assert gate.seen[1].drawn == -inf
    drawn = f"/secret/clock?page=1&drawn={now - 7.0:.3f}&stage=4"
    answered(gate, f"{drawn}&hidden=0", HERE)
    assert (gate.seen[1].stage, gate.lag(now)) == (4, pytest.approx(7.0, abs=1e-3))
    answered(gate, f"{drawn}&hidden=1", HERE)
    assert gate.lag(now) == 0.0, "a page that nobody sees slows nothing"
    gate.close(1)
    assert gate.seen == {}


@pytest.fixture
def operator(monkeypatch):
    """Buttons of an operator's page without a network, and the orders that they gave."""
    monkeypatch.setattr(orders.pubsub, "pose_publisher", lambda *_, **__: SimpleNamespace(put=lambda _: None))
    monkeypatch.setattr(orders.orders, "stop_publisher", lambda *_: None)
    given = []
    monkeypatch.setattr(orders.orders, "send_order", lambda _s, _k, _r, order: given.append(order) or {})
    made, gate = orders.Acting(None, orders.WatchedRun(["tcp/127.0.0.1:7447"], "park", "operator")), Gate()
    made.build(MagicMock(gate=gate))
    made.set_stage(SceneModel.of_robots(()), 2)
    made.follow(MagicMock(), ["CF01"])
    return made, gate, given


OLD = Seen(1000.0 - heartbeat.STALE_S - 1.0, 2), Seen(1000.0, 1), Seen(-inf, 2), None


@pytest.mark.parametrize("seen", [Seen(1000.0, 2), *OLD])
def test_old_pictures_order_no_motion(seen, operator, monkeypatch):
    monkeypatch.setattr(orders.time, "time", lambda: 1001.0)
    acting, gate, given = operator
    if seen is not None:
        gate.seen[7] = seen
    for what in ("hold", "land", "resume"):
        acting.press(messages.Order(what), what, SimpleNamespace(client_id=7))
    assert [order.order for order in given] == ["hold", "land", *([] if seen in OLD else ["resume"])]


def test_late_orders_of_closed_pages_are_dropped(operator):
    acting, given, now = operator[0], threading.Event(), time.monotonic()
    acting.due["A"] = now - heartbeat.STALE_S - 1.0, given.set
    acting.follow(MagicMock(), ["A"])
    assert not given.wait(0.2)
    acting.due["A"] = now, given.set
    acting.set_stage(SceneModel.of_robots(()), 3)
    assert acting.due == {}, "an order is not for the next case"


@pytest.mark.parametrize(
    ("apart", "said", "count"),
    [
        (0.1, "not ordered: it would touch KH02 there.", 0),
        (-0.6, "0 of 0 robots; KH02 is on the straight way", 1),
        (-9.0, "0 of 0 robots", 1),
    ],
)
def test_leader_is_not_sent_into_a_robot(apart, said, count, operator):
    acting, gate, given = operator
    scene = SceneModel.of_plan(load("robotic-park").cases()["event"])
    page = MagicMock()
    acting._server.get_clients = lambda: {7: page}
    acting.set_stage(scene, 2)
    moment = at_start(scene)
    moment.position[:, 1] += 100.0
    leader, other = (scene.names.index(name) for name in ("TB01", "KH02"))
    moment.position[leader], moment.position[other] = (0.6, 0.0, 0.0), (0.0, 0.0, 0.0)
    acting.follow(moment, scene.names)
    gate.seen[7] = Seen(time.time(), 2)
    target = SimpleNamespace(position=(apart, 0.004, 0.0))
    acting._drag("TB01", SimpleNamespace(client=object(), client_id=7, phase="end", target=target))
    for _, order in acting.due.values():
        order()
    assert [order.goal for order in given] == [(apart, 0.0)] * count
    title, text = page.add_notification.call_args.args
    assert (title, text[: len(said)]) == (f"TB01 to x = {apart:.2f} m, y = 0.00 m", said)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize("blocked", [False, True])
def test_emergency_stop_tells_its_result_without_session(blocked, operator, monkeypatch):
    acting, _, _ = operator
    free = threading.Event()

    def put(_):
        if not blocked:
            raise RuntimeError("closed")
        free.wait(60.0)

    acting._urgent = acting._events = SimpleNamespace(put=put)
    monkeypatch.setattr(orders.orders.EmergencyStop, "send", lambda self, _: self.seen.add("KH01"))
    page = MagicMock()
    acting._server.get_clients = lambda: {1: page}
    others = set(threading.enumerate())
    stopping = threading.Thread(target=acting.emergency_stop, daemon=True)
    stopping.start()
    stopping.join(PATIENCE_S)
    free.set()
    until(lambda: set(threading.enumerate()) <= others, "those that tell of it have ended")
    assert "stopped: KH01" in page.add_notification.call_args.args[1]


@pytest.mark.parametrize("ended", [True, False])
def test_orders_after_the_end_say_so(ended, operator, monkeypatch):
    acting, gate, given = operator
    page, over = MagicMock(), RegisteredRun("run", os.getpid(), "of another process", 0.0, "a run", "", [])
    acting._watched = orders.WatchedRun(["tcp/127.0.0.1:7447"], "park", "operator", None if ended else over)
    acting.follow(MagicMock(), [], ended=ended)
    acting._server.get_clients = lambda: {7: page}
    acting._urgent = acting._events = SimpleNamespace(put=lambda _: None)
    gone = ExplainedError("no router answers: is one running, --connect")
    monkeypatch.setattr(orders.orders.EmergencyStop, "send", lambda self, _: setattr(self, "failure", gone))
    for order in (acting.emergency_stop, lambda: acting.press(messages.Order("land"), "land", None)):
        order()
        said = page.add_notification.call_args.args[1]
        assert ("the run is over" in said, "--connect" in said) == (True, False)
    assert (given, gate.stops) == ([], 1)


def test_slider_orders_what_is_limited(operator):
    found = orders.parameters(SceneModel.of_plan(load("robotic-park").cases()["event"]))
    known = {"trigger.threshold [m]": 0.01, "clamp [m]": 0.1, "tracking_gain [1/(m²·decision)]": 3.0}
    assert [(each.label, each.value) for each in found] == [*known.items()]
    for sent in (-1.0, 0.0, 1e9, inf, float("nan")):
        assert 0.0 < found[0].limited(sent) <= 0.04
    acting, gate, given = operator
    gate.seen[7] = Seen(time.time(), 2)
    event = SimpleNamespace(client=object(), client_id=7, target=SimpleNamespace(value=1e6))
    acting.slide(orders.Parameter("clamp", 0.1, "m"), event)
    acting.due["clamp"][1]()
    assert [(each.name, each.value) for each in given] == [("clamp", 0.4)]
