"""The loop of a robot process on a simulated clock: skipped ticks, and a hold after it stood still."""

import types
from dataclasses import replace
from functools import partial

import pytest

from agents.body.fleet import assemble
from agents.decision.lifecycle import Phase
from agents.network import messages, name_ownership
from agents.network import session as network
from agents.network.keys import Keys
from agents.plugins.registry import PluginError
from agents.plugins.triggers import Trigger
from agents.runtime import descent, loop
from agents.runtime.loop import Runtime, Setup
from experiments.definition import bodies
from experiments.definition.experiment import Formation, RobotTable
from experiments.definition.plan import Plan
from tests.agents.few import pair
from tests.fuzz.loopnet import Net, Sample

HZ = 100.0


@pytest.mark.parametrize(
    ("stands_s", "missed", "holds"), [(0.005, 0, False), (0.075, 6, False), (0.605, 59, True), (8.005, 799, True)]
)
def test_standstill_skips_ticks_and_holds(stands_s, missed, holds, monkeypatch, capsys):
    now, times = [1000.0], []

    def sleep(seconds):
        now[0] += seconds

    for module in (loop, descent):
        monkeypatch.setattr(module, "time", types.SimpleNamespace(sleep=sleep))
    monkeypatch.setattr(loop, "uptime", lambda: now[0])  # it alone goes on while the machine sleeps
    experiment = pair()
    with Net().worn() as net:
        body = assemble(bodies.body_request(Plan(experiment), ("A",), 1))
        runtime = Runtime(
            [Plan(experiment).assignment("A")],
            body,
            Setup(Keys("park"), [], "json", 50.0, lifeline=False, externally_measured=[False]),
        )
        body.open()
        runtime.subscribe_to_stops(net.session)
        runtime.join(net.session)
        tick = runtime.tick

        def worked(t):
            times.append(t)
            tick(t)
            now[0] += stands_s if len(times) == 5 else 0.001

        monkeypatch.setattr(runtime, "tick", worked)

        def stopping():
            if len(times) < 12:
                return None
            runtime.robots[0].lifecycle.phase = loop.Phase.DONE
            return "enough"

        runtime.run_ticks(stopping)
    assert times == pytest.approx([(k if k < 5 else k + missed) / HZ for k in range(12)])
    assert runtime.counts.missed == missed
    assert runtime.robots[0].tick == 12 + missed
    assert (f"stood still for {stands_s:.1f} s; holding" in capsys.readouterr().out) == holds
    assert (runtime.health.resumed_at == pytest.approx((5 + missed) / HZ)) == holds


class Stage:
    """One robot on a simulated clock, without a network; `orders` of its body, each with the time [s]."""

    def __init__(self, monkeypatch, kind: str) -> None:
        hover = {"hover": 0.5} if kind == "crazyflie" else {}
        experiment = pair(robots={"F": RobotTable(kind=kind, start=[0.1, 0.2], **hover)}, formation=Formation())
        self.now, self.orders, self.commands = 1000.0, [], 0
        for module in (loop, descent):
            monkeypatch.setattr(module, "time", types.SimpleNamespace(sleep=self.sleep))
        for module in (loop, name_ownership):
            monkeypatch.setattr(module, "uptime", lambda: self.now)
        self.body = assemble(bodies.body_request(Plan(experiment), ("F",), 1))
        self.runtime = Runtime(
            [Plan(experiment).assignment("F")],
            self.body,
            Setup(Keys("park"), [], "json", 50.0, lifeline=False, externally_measured=[False]),
        )
        for order in ("takeoff", "land", "stop", "command"):
            monkeypatch.setattr(self.body, order, partial(self.note, order, getattr(self.body, order)))
        self.in_between = lambda: None  # called before each take-off and setpoint

    def sleep(self, seconds):
        self.now += seconds

    def note(self, order, call, *args):
        if order in ("takeoff", "command"):
            self.in_between()
        self.orders += [(self.now, order)] if order != "command" else []
        self.commands += order == "command"
        call(*args)

    def begin(self, net):
        self.runtime.subscribe_to_stops(net.session)
        self.body.open()
        self.runtime.join(net.session)

    def run(self, visit):
        """Ticks until `visit`, which is called before each with the phase, is true."""
        over = []

        def stopping():
            life = self.runtime.robots[0].lifecycle
            over.append(visit(Phase(life.phase)))
            life.phase = int(Phase.DONE) if over[-1] else life.phase
            return "enough" if over[-1] else None

        self.runtime.run_ticks(stopping)


@pytest.mark.parametrize(("kind", "after_s"), [("khepera4", [1.0, 10.0]), ("crazyflie", [10.0])])
def test_standstill_without_router_halts_then_lands(kind, after_s, monkeypatch):
    stage, woke = Stage(monkeypatch, kind), []

    def visit(phase):
        life = stage.runtime.robots[0].lifecycle
        if phase == Phase.READY:
            life.takeoff()
        elif phase == Phase.AIRBORNE and not woke:
            stage.now += 0.8
            woke.append(stage.now)
            stage.orders.clear()
            stage.commands = 0
            monkeypatch.setattr(network, "connected", lambda _session: False)
            stage.runtime.robots[0].hazards.incidents.clear()
        elif woke and phase == Phase.AIRBORNE:
            raise AssertionError("it went on")
        return phase == Phase.DONE

    with Net().worn() as net:
        stage.begin(net)
        stage.run(visit)
    stage.runtime._keeper.end()
    landed = [at - woke[0] for at, order in stage.orders if order == "land"]
    assert landed[: len(after_s)] == pytest.approx(after_s, abs=0.05)
    assert "no router answers about the owner of its name" in stage.runtime.robots[0].lifecycle.reason


@pytest.mark.parametrize("phase", [Phase.READY, Phase.AIRBORNE])
def test_stop_during_command_has_last_word(phase, monkeypatch):
    stage, stops = Stage(monkeypatch, "crazyflie"), []

    def stop():
        if not stops and stage.runtime.robots[0].lifecycle.phase == phase:
            stops.append(stage.now)
            stage.runtime.estop.receive(Sample("park/estop", messages.JSON, b"{}"))

    def visit(now):
        if now == Phase.READY:
            stage.in_between = stop
            stage.runtime.robots[0].lifecycle.takeoff()
        return now == Phase.DONE

    with Net().worn() as net:
        stage.begin(net)
        stage.run(visit)
    assert len(stops) == 1
    assert [order for at, order in stage.orders if at >= stops[0]][-2:] == ["stop", "stop"]
    assert not stage.body.read(stage.runtime.ticks.t + 0.01)[0].flying


def test_stop_while_body_opens_keeps_it_down(monkeypatch):
    stage = Stage(monkeypatch, "crazyflie")

    def visit(phase):
        assert stage.runtime.robots[0].lifecycle.takeoff() != ""
        return phase == Phase.DONE

    with Net().worn() as net:
        stage.runtime.subscribe_to_stops(net.session)
        stage.runtime.estop.receive(Sample("park/estop", messages.JSON, b"{}"))
        assert stage.orders == [], "a closed body is left alone"
        stage.body.open()
        stage.runtime.join(net.session)
        stage.run(visit)
    assert [order for _, order in stage.orders] == ["stop"]
    assert stage.runtime.robots[0].lifecycle.reason.startswith(messages.EMERGENCY)


def test_standstill_before_takeoff_keeps_it_down(monkeypatch):
    stage = Stage(monkeypatch, "crazyflie")
    act = stage.runtime._act

    def late():
        stage.now += 0.8 if stage.runtime.robots[0].takes_off else 0.0
        act()

    def visit(phase):
        if phase == Phase.READY:
            stage.runtime.robots[0].lifecycle.takeoff()
        return phase == Phase.DONE

    with Net().worn() as net:
        stage.begin(net)
        monkeypatch.setattr(stage.runtime, "_act", late)
        stage.run(visit)
    assert "takeoff" not in [order for _, order in stage.orders]


class Faulty(Trigger, frozen=True):
    """Fails at any question."""

    def fires(self, view):
        return view.nothing


def test_plugins_of_all_robots_are_named():
    plan = Plan(pair())
    assignments = [plan.assignment("A"), replace(plan.assignment("B"), trigger=Faulty())]
    setup = Setup(Keys("park"), [], "json", 50.0, lifeline=False, externally_measured=[False, False])
    with Net().worn() as net:
        runtime = Runtime(assignments, assemble(bodies.body_request(plan, ("A", "B"), 1)), setup)
        runtime.subscribe_to_stops(net.session)
        runtime.join(net.session)
        with pytest.raises(PluginError, match="the trigger Faulty failed: AttributeError"):
            runtime.tick(0.01)
