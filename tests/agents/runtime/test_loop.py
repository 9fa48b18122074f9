"""The loop of a robot process on a simulated clock: skipped ticks, standstills, stops, and poses that wake it."""

from dataclasses import replace
from functools import partial
from math import inf

import pytest

from agents.decision.lifecycle import Phase
from agents.decision.neighbours import Neighbours
from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from agents.plugins.registry import PluginError
from agents.plugins.triggers import Trigger
from agents.robot import Robot
from agents.runtime.loop import Runtime
from experiments.definition.plan import Plan
from tests.agents.runtime.process import BEGIN, DRONE, Stage, setup, twins
from tests.network import Net, Sample
from tests.small import pair, small
from tests.waiting import ManualClock

STOP = Sample("park/estop", messages.JSON, b"{}")
WHEELS = small({"F": "khepera4"})


@pytest.fixture
def net():
    with Net().worn() as worn:
        yield worn


@pytest.fixture
def on_stage(monkeypatch, net):
    """Puts a process on a stage."""
    return partial(Stage, monkeypatch, net)


@pytest.mark.parametrize(
    ("stands_s", "missed", "holds"), [(0.005, 0, False), (0.075, 6, False), (0.605, 59, True), (8.005, 799, True)]
)
def test_standstill_skips_ticks_and_holds(stands_s, missed, holds, on_stage, capsys):
    stage = on_stage(pair(), "A", asks_for_owners=False)
    stage.begin()

    def visit(_phase):
        stage.clock.sleep(stands_s if len(stage.ticks) == 5 else 0.001)
        return len(stage.ticks) == 12

    stage.run(visit)
    assert stage.ticks == pytest.approx([0.01 * (k if k < 5 else k + missed) for k in range(12)])
    assert stage.runtime.counts.missed == missed
    assert stage.robot.tick == 12 + missed
    assert (f"stood still for {stands_s:.1f} s; holding" in capsys.readouterr().out) == holds
    assert (stage.runtime.health.resumed_at == pytest.approx(0.01 * (5 + missed))) == holds


@pytest.mark.parametrize(("experiment", "after_s"), [(WHEELS, [1.0, 10.0]), (DRONE, [10.0])], ids=["wheels", "drone"])
def test_standstill_without_router_halts_then_lands(experiment, after_s, on_stage, monkeypatch):
    stage, woke = on_stage(experiment), []

    def visit(phase):
        if phase == Phase.READY:
            stage.robot.lifecycle.takeoff()
        elif phase == Phase.AIRBORNE:
            assert not woke, "it went on"
            stage.clock.sleep(0.8)
            woke.append(stage.clock.now)
            stage.orders.clear()
            monkeypatch.setattr(network, "connected", lambda _session: False)
        return phase == Phase.DONE

    stage.begin()
    stage.run(visit)
    stage.runtime.keeper.ownership.end()
    landed = [at - woke[0] for at, order in stage.orders if order == "land"]
    assert landed[: len(after_s)] == pytest.approx(after_s, abs=0.05)
    assert "no router answers about the owner of its name" in stage.robot.lifecycle.reason


def test_standstill_before_takeoff_keeps_it_down(on_stage, monkeypatch):
    stage = on_stage(DRONE)
    act = Robot.act

    def stands(robot, t):
        act(robot, t)
        stage.clock.sleep(0.8 if robot.takes_off else 0.0)

    def visit(phase):
        if phase == Phase.READY:
            stage.robot.lifecycle.takeoff()
        return phase == Phase.DONE

    monkeypatch.setattr(Robot, "act", stands)
    stage.begin()
    stage.run(visit)
    assert "takeoff" not in [order for _, order in stage.orders]


@pytest.mark.parametrize("during", [Phase.READY, Phase.AIRBORNE])
def test_stop_during_command_has_last_word(during, on_stage):
    stage, stops = on_stage(DRONE), []

    def stop():
        if not stops and stage.robot.lifecycle.phase == during:
            stops.append(stage.clock.now)
            stage.runtime.estop.receive(STOP)

    def visit(phase):
        if phase == Phase.READY:
            stage.in_between = stop
            stage.robot.lifecycle.takeoff()
        return phase == Phase.DONE

    stage.begin()
    stage.run(visit)
    assert len(stops) == 1
    assert [order for at, order in stage.orders if at >= stops[0]][-2:] == ["stop", "stop"]
    assert not stage.body.read(stage.runtime.ticks.t + 0.01)[0].flying


def test_stop_while_body_opens_keeps_it_down(on_stage, net):
    stage = on_stage(DRONE)

    def visit(phase):
        assert stage.robot.lifecycle.takeoff() != ""
        return phase == Phase.DONE

    stage.runtime.subscribe_to_stops(net.session)
    stage.runtime.estop.receive(STOP)
    assert stage.orders == [], "a closed body is left alone"
    stage.body.open()
    stage.runtime.join(net.session)
    stage.run(visit)
    assert [order for _, order in stage.orders] == ["stop"]
    assert stage.robot.lifecycle.reason.startswith(messages.EMERGENCY)


class Wire(ManualClock):
    """A clock on which poses of B arrive at some times; a bell and a sleep, which both end when the bell is rung.

    With the pose at `stop_at` comes an emergency stop.
    """

    net: Net

    def __init__(self, arrivals, stop_at):
        super().__init__(BEGIN)
        self.arrivals, self.stop_at = list(arrivals), stop_at
        self.seq, self.rung = 0, False

    def ring(self):
        self.rung = True

    def wait(self, seconds):
        end = self.now + seconds
        while self.arrivals and BEGIN + self.arrivals[0] <= end:
            at = self.arrivals.pop(0)
            self.now = max(self.now, BEGIN + at)
            self.seq += 1
            pose = messages.pose("B", self.seq, at, [0.4, 0.0, 0.0], [0.0] * 3, yaw=0.0)
            self.deliver(Keys().pose("B"), messages.encode(pose))
            if at >= self.stop_at:
                self.deliver(Keys().estop, b"{}")
            if self.rung:
                self.rung = False
                return True
        self.now = end
        return False

    sleep = wait

    def deliver(self, key, payload):
        self.net.deliver(b"\0".join([key.encode(), messages.JSON.encode(), payload]))


@pytest.mark.parametrize(
    ("wake", "stop_at", "known"),
    [
        (True, inf, [0.013, 0.016, 0.052]),
        (False, inf, [0.02, 0.02, 0.06]),
        (True, 0.016, [0.013, 0.07, 0.07]),  # on the tick after the pause that leaves the CPU to others
    ],
    ids=["woken", "polled", "stopped"],
)
def test_pose_between_ticks_wakes_loop(wake, stop_at, known, on_stage, monkeypatch):
    wire, received = Wire([0.013, 0.016, 0.052], stop_at), []
    monkeypatch.setattr(pubsub, "Bell", lambda: wire)
    stage = on_stage(pair(), "A", clock=wire, wake=wake)
    wire.net = stage.net
    receive = Neighbours.receive

    def noted(*pose, **more):
        receive(*pose, **more)
        received.append(pose[-1])

    monkeypatch.setattr(Neighbours, "receive", noted)
    stage.begin()
    stage.run(lambda _phase: len(stage.ticks) == 10)
    assert received == pytest.approx(known)
    assert stage.ticks == pytest.approx([0.01 * k for k in ((0, 1, *range(7, 15)) if stop_at < inf else range(10))])
    assert stage.robot.tick == round(100 * stage.ticks[-1]) + 1
    assert stage.runtime.counts.missed == 0


class Faulty(Trigger, frozen=True):
    """Fails at any question."""

    def fires(self, view):
        return view.nothing


def test_plugins_of_all_robots_are_named(net):
    plan = Plan(pair())
    assignments = [plan.assignment("A"), replace(plan.assignment("B"), trigger=Faulty())]
    runtime = Runtime(assignments, twins(pair()), setup(2))
    runtime.subscribe_to_stops(net.session)
    runtime.join(net.session)
    with pytest.raises(PluginError, match="the trigger Faulty failed: AttributeError"):
        runtime.tick(0.01)
