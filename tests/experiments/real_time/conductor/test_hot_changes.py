"""Changes in mid-run, step by step: who is asked for what, in which order, what is refused. No process, no network."""

from unittest.mock import Mock

import numpy as np
import pytest

from agents.network import messages, pubsub
from agents.network.keys import Keys
from experiments.definition.experiment import RobotTable
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.real_time.conductor import hot_changes
from experiments.real_time.conductor.hot_changes import HotChanges
from experiments.real_time.conductor.run_view import RobotView
from tests.network import Net, Query
from tests.small import changed
from tests.waiting import ManualClock

KEYS = Keys()
START = 1000.0
PHASES = {"takeoff": "airborne", "start": "running"}


class Stage:
    """The triangle in flight, with a spare, as view and processes of a run; all obey at once, unless they hang."""

    land_s = 15.0

    def __init__(self, monkeypatch, **more):
        self.clock = ManualClock(START)
        monkeypatch.setattr(hot_changes, "time", self.clock)
        spare = RobotTable(kind="crazyflie", start=[0.8, 0.8], hover=0.5)
        experiment = changed(document.read("triangle").experiment, spares={"S1": spare}, **more)
        self.bodies = dict(experiment.robots)
        self.robots = {name: RobotView(place=(*robot.start[:2], 0.0)) for name, robot in self.bodies.items()}
        self.hung, self.running, self.adopted, self.away = set(), set(self.robots), set(), {}
        self.together = ()  # robots of one process
        self.given, self.said, self.did = [], [], []
        self._pid = 1
        net = Net()
        self.orders = pubsub.Orders(net.session, KEYS.run_order, messages.RunOrder)
        self._add = net.channels[0].add
        for name in self.robots:
            self.appear(name, "running")
        self.changes = HotChanges(Plan(experiment), self, self, KEYS)
        self.changes.begin(START)

    def report(self, *said):
        self.said.append(said)

    def order(self, names, order):
        return {name: self._order(name, order) for name in names}

    def _order(self, name, order):
        self.given.append((name, order.order))
        if name in self.hung:
            return messages.Reply(name, ok=False, phase="unknown", reason="no answer")
        if order.order == "leave":
            self.end(name)
        elif order.order in PHASES:
            assert order.at == START
            self.appear(name, PHASES[order.order])
        return messages.Reply(name, ok=True, phase=self.robots[name].phase)

    def companions(self, name):
        return list(self.together) if name in self.together else [name]

    def runs(self, name):
        return name in self.running

    def robot(self, name):
        return self.bodies[name]

    def place(self, name, robot=None):
        return np.array((robot or self.bodies[name]).start[:2])

    def release(self, name):
        self.did.append(("release", name))

    def kill(self, name):
        self.did.append(("kill", name))
        self.end(name)

    def start_again(self, names, bodies=None):
        self.did.append(("start", *names))
        self.bodies |= bodies or {}
        for name in names:
            self.running.add(name)
            self._pid += 1
            self.appear(name)

    def appear(self, name, phase="ready"):
        self.robots[name].alive = True
        self.robots[name].status = messages.Status(name, self.clock.utc(), phase, "", pid=self._pid)

    def end(self, name):
        """End the process of a robot."""
        self.running.discard(name)
        self.robots[name].alive = False
        if not self.changes.expects(name, "its process ended"):
            self.changes.mark_lost(name)

    def ask(self, what, *names, payload=None, **more):
        order = payload or messages.encode(messages.RunOrder(what, list(names), **more))
        self._add(query := Query(KEYS.run_order, messages.JSON, order))
        return query

    def go_on(self, seconds=1.0):
        for _ in range(round(seconds / 0.5)):
            self.changes.advance()
            self.clock.now += 0.5

    def after(self, query, seconds=1.0):
        self.go_on(seconds)
        return reply_to(query)


def reply_to(query):
    key, payload, encoding = query.answer
    assert key == KEYS.run_order
    return messages.decode(payload, encoding, messages.RunReply)


@pytest.fixture
def stage(monkeypatch):
    return Stage(monkeypatch)


def test_restart_lands_starts_and_joins_by_common_clock(stage):
    assert set(stage.after(stage.ask("restart", "CF01"), 5.0).done) == {"CF01"}
    assert stage.given == [("CF01", "leave"), ("CF01", "takeoff"), ("CF01", "start")]
    assert stage.did == [("start", "CF01")]
    assert (stage.robots["CF01"].phase, stage.robots["CF01"].left_because) == ("running", "")


def test_order_for_several_is_answered_when_all_finish(stage):
    stage.hung.add("KH02")
    query = stage.ask("remove", "KH01", "KH02", "KH01")
    stage.go_on(2.0)
    assert (query.answer, stage.robots["KH01"].left_because) == (None, "removed")
    assert set(stage.after(query, 4.0).done) == {"KH01", "KH02"}
    assert stage.did == [("release", "KH02"), ("kill", "KH02")], "who hangs lands if it can, and is ended else"


@pytest.mark.parametrize("answers", [True, False])
def test_process_of_a_flying_companion_is_never_ended(stage, answers):
    stage.together = ("KH01", "KH02")
    stage.hung |= set() if answers else {"KH01"}
    stage.end = lambda name: None  # it lands, and goes on landing
    reply = stage.after(stage.ask("remove", "KH01"), 20.0)
    assert "shares its process with KH02: name them all" in reply.refused["KH01"]
    assert (stage.did, stage.robots["KH02"].phase) == ([], "running")


def test_a_place_is_free_or_not(stage):
    x, y = stage.bodies["CF01"].start[:2]
    stage.robots["KH01"].place = (x + 0.1, y, 0.0)
    assert "m from KH01: it needs 0.1 m around it" in stage.after(stage.ask("restart", "CF01"), 5.0).refused["CF01"]
    assert not stage.given, "who is refused is left alone"
    stage.robots["KH01"].place = (x + 0.3, y, 0.0)
    assert stage.after(stage.ask("restart", "CF01"), 5.0).done
    stage.robots["KH01"].place = (x, y, 0.0)
    stage.end("KH01")
    twin = stage.bodies["KH01"]
    stage.bodies["KH01"] = changed(twin, body="khepera4://192.0.2.1")
    assert "from KH01" in stage.after(stage.ask("restart", "CF01"), 2.0).refused["CF01"], "its body lies there"
    stage.bodies["KH01"] = twin
    assert stage.after(stage.ask("restart", "CF01"), 5.0).done


def test_whole_orders_that_are_refused(stage):
    for query, said in (
        (stage.ask("remove", "KH1"), "no robot 'KH1' in this run"),
        (stage.ask("add", ""), "no robot '' in this run"),
        (stage.ask("remove"), "name one or more of KH01, KH02, CF01"),
        (stage.ask("restart", "KH01", body="twin"), "belong to replace"),
        (stage.ask("replace", "KH01", "KH02", body="twin"), "one robot at a time"),
    ):
        assert said in stage.after(query).reason
    mad = stage.ask("", payload=b'{"order": "explode", "robots": []}')
    stage.go_on()
    assert b"no valid RunOrder" in mad.error
    assert not stage.given


def test_refused_change_leaves_the_one_under_way(stage, monkeypatch):
    end, appear = stage.end, stage.appear
    for slow in ("end", "appear"):  # it takes a while to land, and to be ready
        monkeypatch.setattr(stage, slow, lambda *_: None)
    first = stage.ask("replace", "CF01")
    stage.go_on(1.0)
    assert "is being changed already" in stage.after(stage.ask("remove", "CF01")).refused["CF01"]
    end("CF01")
    stage.go_on(2.0)
    monkeypatch.setattr(stage, "appear", appear)
    stage.appear("CF01")
    assert "takes part after" in stage.after(first, 5.0).done["CF01"]


def test_the_end_of_the_run_answers_everybody(stage):
    stage.hung.add("CF01")
    query, second = stage.ask("remove", "CF01"), stage.ask("restart", "CF01")
    assert "is being changed already" in stage.after(second).refused["CF01"]
    stage.changes.close()
    assert reply_to(query).refused == {"CF01": "the run is over"}
    assert "this run is not there" in stage.after(stage.ask("remove", "KH01")).reason


def test_a_lost_robot_is_started_again_three_times(monkeypatch):
    stage = Stage(monkeypatch, on_loss="restart")
    for _ in range(3):
        stage.end("KH01")
        assert stage.robots["KH01"].left_because == "lost"
        stage.go_on(5.0)
        assert stage.robots["KH01"].phase == "running"
    stage.end("KH01")
    stage.go_on(5.0)
    assert (stage.robots["KH01"].left_because, stage.said[-1]) == ("lost", ("given up", "KH01", "lost 4 times"))


@pytest.mark.parametrize(
    ("calmed", "reason", "restarts"),
    [
        ("KH01", "ordered to land", 0),
        ("KH01", "ordered to stop", 0),
        ("CF01", "ordered to hold", 0),
        ("CF01", "ordered to land", 1),
        ("CF01", "", 1),
    ],
)
def test_no_robot_restarts_by_itself_among_people(calmed, reason, restarts, monkeypatch):
    stage = Stage(monkeypatch, on_loss="restart")
    stage.robots[calmed].status = changed(stage.robots[calmed].status, reason=reason)
    stage.end("KH01")
    stage.go_on(5.0)
    assert stage.did == [("start", "KH01")] * restarts
    assert [kind for kind, *_ in stage.said].count("given up") == 1 - restarts


def test_a_spare_takes_over_once(monkeypatch):
    stage = Stage(monkeypatch, on_loss="replace")
    stage.end("CF01")
    stage.go_on(5.0)
    assert (stage.bodies["CF01"].start, stage.robots["CF01"].phase) == ([0.8, 0.8], "running")
    stage.end("CF01")
    stage.go_on(5.0)
    assert stage.said[-1][:2] == ("refused", "CF01")
    assert "no spare crazyflie left" in stage.said[-1][2]


def test_process_that_cannot_join_is_reported(stage):
    stage.start_again = lambda names, bodies=None: stage.end("KH01")
    assert stage.after(stage.ask("restart", "KH01"), 5.0).refused == {"KH01": "KH01: its process ended"}
    assert stage.changes.under_way == set()
    stage.start_again = Mock(side_effect=OSError(28, "No space left on device"))
    assert "No space left on device" in stage.after(stage.ask("restart", "KH02"), 5.0).refused["KH02"]
    assert [stage.robots[name].left_because for name in ("KH01", "KH02")] == ["removed"] * 2
    assert stage.after(stage.ask("remove", "CF01")).done


def test_lost_orders_are_repeated_within_limited_time(stage):
    start = stage.start_again

    def hanging(names, bodies=None):
        start(names, bodies)
        stage.hung.add("KH01")

    stage.start_again = hanging
    assert stage.after(stage.ask("restart", "KH01"), 10.0).refused == {"KH01": "KH01, takeoff: no answer"}
    assert stage.given.count(("KH01", "takeoff")) > 3
