"""The loop of a robot process: skipped ticks, standstills, stops, poses that wake it, and robots that come back."""

import math
import re
import threading
from collections.abc import Mapping
from dataclasses import replace
from math import inf
from typing import ClassVar

import pytest

from agents.body.device_address import plain_device
from agents.body.device_locks import Claims
from agents.body.interface import BodyError
from agents.body.limits import Safety
from agents.decision.lifecycle import AIRBORNE, READY, RUNNING, Phase
from agents.decision.neighbours import Neighbours
from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from agents.plugins.law import Control, Law, Said
from agents.plugins.registry import PluginError
from agents.plugins.triggers import Trigger
from agents.robot import Robot
from agents.runtime.lifeline import stop_line
from agents.runtime.loop import Runtime
from agents.runtime.orders import carry_out
from experiments.definition.experiment import Formation, LegTable, RobotTable
from experiments.definition.plan import Plan
from tests.agents.bench import Bench
from tests.agents.runtime.process import BEGIN, DRONE, Airborne, Stage, process, setup, twins
from tests.fuzz.messages import sent
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
def on_stage(net, monkeypatch):  # the order matters: else the patch would stay for later tests
    stages = []
    yield lambda *given, **more: stages.append(Stage(monkeypatch, net, *given, **more)) or stages[-1]
    for stage in stages:
        stage.runtime.keeper.ownership.end()
    for thread in threading.enumerate():  # a question that outlives its network ends a later test
        if thread.name == "owner of the name":
            thread.join()


@pytest.mark.parametrize(
    ("stands_s", "missed", "holds"), [(0.005, 0, False), (0.075, 6, False), (0.605, 59, True), (8.005, 799, True)]
)
def test_standstill_skips_ticks_and_holds(stands_s, missed, holds, on_stage, capsys):
    stage = on_stage(pair(), "A", asks_for_owners=False)

    def visit(_phase):
        stage.clock.sleep(stands_s if len(stage.ticks) == 5 else 0.001)
        return len(stage.ticks) == 12

    stage.run(visit)
    assert stage.ticks == pytest.approx([0.01 * (k if k < 5 else k + missed) for k in range(12)])
    assert (stage.runtime.counts.missed, stage.robot.tick) == (missed, 12 + missed)
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

    stage.run(visit)
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
    stage.run(visit)
    assert "takeoff" not in [order for _, order in stage.orders]


def test_stop_is_done_when_body_confirms(on_stage, capsys):
    stage = on_stage(DRONE)
    cut, answers_at = stage.body.stop, BEGIN + 12.0
    stage.body.stop = lambda rows: cut(rows) if stage.clock.now >= answers_at else None
    phases = []

    def visit(phase):
        if phase == Phase.READY:
            stage.robot.lifecycle.takeoff()
        elif phase == Phase.AIRBORNE:
            stage.runtime.estop.receive(STOP)
        elif stage.clock.now >= answers_at:
            stage.body.stop([0])
        phases.extend(re.findall(r"^F: (\w+)", capsys.readouterr().out, re.MULTILINE))
        return stage.clock.now >= answers_at + 0.1

    stage.run(visit)
    assert phases == ["ready", "airborne", "landing", "done"]


@pytest.mark.parametrize(("lifted", "height"), [(False, 0.0), (True, 0.5)])
def test_hold_before_the_start_holds(lifted, height, on_stage):
    stage = on_stage(DRONE)
    answers, held = [], []

    def visit(phase):
        life, t = stage.robot.lifecycle, stage.clock.now - BEGIN
        if phase == Phase.READY and lifted and not life.climbing:
            life.takeoff()
        if phase == Phase.READY and life.climbing == lifted and not answers:
            answers.append(carry_out(stage.robot, messages.Order("hold"), t, BEGIN))
            answers.append(carry_out(stage.robot, messages.Order("takeoff"), t, BEGIN))
        if phase == Phase.AIRBORNE:
            carry_out(stage.robot, messages.Order("start", at=BEGIN + t), t, BEGIN)
        if phase == Phase.RUNNING:
            held.append(stage.robot.hazards.held)
        return t > 4.0

    stage.run(visit)
    assert answers == [("", None), ("" if lifted else "cannot take off now: ordered to hold", None)]
    assert stage.runtime.states[0].position[2] == pytest.approx(height, abs=0.01)
    assert {*held} == ({True} if lifted else set())


def test_start_by_a_wrong_clock_is_refused(on_stage):
    stage, answers = on_stage(DRONE), []

    def visit(phase):
        t = stage.clock.now - BEGIN
        if phase == Phase.READY:
            stage.robot.lifecycle.takeoff()
        if phase == Phase.AIRBORNE:
            orders = [messages.Order("start", at=BEGIN + t + ahead_s) for ahead_s in (60.0, 1.0)]
            answers.extend(carry_out(stage.robot, order, t, BEGIN)[0] for order in orders)
        return phase == Phase.AIRBORNE

    stage.run(visit)
    assert ["are the clocks set?" in each for each in answers] == [True, False]


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

    stage.run(visit)
    assert len(stops) == 1
    assert [order for at, order in stage.orders if at >= stops[0]][-2:] == ["stop", "stop"]
    assert not stage.body.read(stage.runtime.ticks.t + 0.01)[0].flying


def test_hang_that_ends_stays_out_of_formation(on_stage, monkeypatch):
    stage, declared, sent = on_stage(DRONE), [], []
    monkeypatch.setattr(stage.runtime.keeper, "declare", lambda _, rows: declared.append(list(rows)))
    monkeypatch.setattr(stage.runtime, "_send_pose", lambda *_: sent.append(stage.clock.now))

    def visit(phase):
        life = stage.robot.lifecycle
        if phase == Phase.READY:
            life.takeoff()
        elif phase == Phase.AIRBORNE:
            life.start(stage.runtime.ticks.t)
        elif phase == Phase.RUNNING and sent:
            sent.clear()
            stage.runtime.watchdog.tripped = "it hangs"
        return phase == Phase.DONE or len(stage.ticks) > 5000

    stage.run(visit)
    assert stage.robot.lifecycle.reason == "it hangs"
    assert declared == [[0], []], "its token is not declared again"
    assert sent == [], "nor is a pose sent"


def test_stop_on_the_lifeline_needs_no_router(on_stage, monkeypatch):
    stage, stops = on_stage(DRONE), []
    line = stop_line(messages.Stop("operator", "without a router")).strip()

    def stop():
        if not stops and stage.robot.lifecycle.phase == Phase.AIRBORNE:
            stops.append(stage.clock.now)
            stage.runtime.follow_line(line)
            assert stage.orders[-1] == (stage.clock.now, "stop"), "at once, in the thread of the lifeline"

    def visit(phase):
        if phase == Phase.READY:
            monkeypatch.setattr(network, "connected", lambda _session: False)
            stage.in_between = stop
            stage.robot.lifecycle.takeoff()
        return phase == Phase.DONE

    stage.run(visit)
    assert len(stops) == 1
    assert not stage.body.read(stage.runtime.ticks.t + 0.01)[0].flying
    assert stage.robot.lifecycle.reason == "emergency stop by operator: without a router"


@pytest.mark.parametrize("way", ["network", "lifeline"])
def test_stop_while_body_opens_keeps_it_down(way, on_stage, net):
    stage = on_stage(DRONE)

    def visit(phase):
        assert stage.robot.lifecycle.takeoff() != ""
        return phase == Phase.DONE

    if way == "lifeline":  # before the network is joined
        stage.runtime.follow_line(stop_line(messages.Stop("operator", "early")).strip())
    stage.runtime.subscribe_to_stops(net.session)
    if way == "network":
        stage.runtime.estop.receive(STOP)
    assert stage.orders == [], "a closed body is left alone"
    stage.body.open()
    stage.runtime.join(net.session)
    stage.run(visit, joined=True)
    assert [order for _, order in stage.orders] == ["stop"]
    assert stage.robot.lifecycle.reason.startswith(messages.EMERGENCY)


@pytest.mark.usefixtures("net", "runtime_folder")
def test_body_stays_closed_while_another_drives():
    claims = Claims([("F", plain_device("rover://localhost:5005"))])
    driver = Claims([("R7", plain_device("rover://127.0.0.1"))])
    body = Airborne()
    driver.take()
    with pytest.raises(BodyError, match="in use: this process drives it for R7"):
        process(WHEELS, body, claims=claims).run()
    assert body.calls == []
    driver.release()
    with Net().worn(), pytest.raises(OSError, match="the loop breaks"):
        process(WHEELS, body, claims=claims).run()
    driver.take()  # let go of at the end
    assert body.order[0] == "open"


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
    stage.run(lambda _phase: len(stage.ticks) == 10)
    assert received == pytest.approx(known)
    assert stage.ticks == pytest.approx([0.01 * k for k in ((0, 1, *range(7, 15)) if stop_at < inf else range(10))])
    assert stage.robot.tick == round(100 * stage.ticks[-1]) + 1
    assert stage.runtime.counts.missed == 0


class Faulty(Trigger, frozen=True):
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


UTC = 1.7e9
START, WAY, BEGINS_S, SPEED = (-0.6, 0.1), 0.75, 5.0, 0.15


def leader(*, listens: bool = False):
    """A, which drives `WAY` along x from `BEGINS_S` on."""
    return pair(
        robots={
            "A": RobotTable(kind="turtlebot3", start=list(START)),
            "B": RobotTable(kind="khepera4", start=[0.6, 0.6]),
        },
        formation=Formation(links={"B > A": 0.5} if listens else {"A > B": 0.5}),
        timeline=[LegTable(robot="A", at_s=BEGINS_S, plan={"kind": "line", "move_by": [WAY, 0.0], "speed": SPEED})],
        safety=Safety(start_within=0.0),  # as processes get it that are started in mid-run
    )


class Life:
    """A process of A, at a place, `late_s` after the common start."""

    def __init__(self, place, late_s: float, origin: messages.Setpoint | None = None, *, listens: bool = False) -> None:
        self.bench = Bench(Plan(leader(listens=listens)).assignment("A"), (*place, 0.0))
        self.robot = self.bench.robot
        for link in range(len(self.bench.neighbours.all)):
            self.bench.hear(link, (0.6, 0.6, 0.0))
        self.step(READY)
        assert self.order(messages.Order("takeoff")) == ""
        self.step(AIRBORNE)
        self.start = messages.Order("start", at=UTC + self.bench.t - late_s, origin=origin)
        assert self.order(self.start) == ""
        for _ in range(21):
            self.step(RUNNING)

    def order(self, order: messages.Order) -> str:
        return carry_out(self.robot, order, self.bench.t, UTC)[0]

    def step(self, phase: int) -> None:
        self.bench.step(0.03)
        assert self.robot.lifecycle.phase == phase


def test_restarted_leader_does_not_repeat_its_plan():
    first = Life(START, 0.0)
    origin = first.robot.origin
    assert origin == (*START, 0.0, 0.0)
    there = (START[0] + WAY, START[1])
    second = Life(there, 30.0, origin)
    assert second.robot.goal[:2] == pytest.approx(there)
    assert second.robot.origin == origin  # for the next one of its name
    assert Life(there, 30.0).robot.goal[0] == pytest.approx(there[0] + WAY)  # without the origin
    anew = Life(START, 30.0, origin)  # a twin of its own stands at its start again
    assert anew.robot.goal[:2] == pytest.approx(there)
    half = Life((0.0, 0.0), BEGINS_S + 2.0, origin)
    gone = SPEED * (half.bench.t - half.start.at + UTC - BEGINS_S)
    assert half.robot.goal[0] == pytest.approx(START[0] + gone, abs=0.02)


def test_plan_of_a_follower_keeps_its_origin():
    life = Life(START, 0.0, listens=True)
    assert life.robot.origin is None  # its leg is yet to come
    first = Life(START, BEGINS_S, listens=True)
    assert first.robot.origin[:2] == START
    second = Life((START[0] + WAY, START[1]), 30.0, first.robot.origin, listens=True)
    assert second.robot.origin[:2] == START
    life.robot.lifecycle.phase = AIRBORNE
    start = messages.Order("start", at=UTC + life.bench.t, origin=(0.0, math.nan, 0.0, 0.0))
    assert "origin" in life.order(start)


class Clock(Law, frozen=True):
    SAYS: ClassVar[Mapping[str, Said]] = {"time": Said()}

    def begin(self, robot):
        return {"time": (math.nan,)}

    def step(self, view, memory):
        return Control(
            memory={"time": (view.time,)},
            velocity=(0.1, 0.0, math.nan),
            measures={"moves": float(view.moves), "step_s": view.step_s},
        )


def test_restarted_robot_steps_before_it_runs():
    assignment = replace(Plan(pair()).assignment("B"), law=Clock(), start=None, starts=())
    bench = Bench(assignment, (0.0, 0.0, 0.0))
    stepping, life = bench.robot.stepping, bench.life

    def step(seconds):
        bench.step(seconds, lambda bench: bench.hear(0, (0.5, 0.0, 0.0)))

    def order(name, at):
        return carry_out(bench.robot, messages.Order(name, at=at), bench.t, UTC)[0]

    step(0.05)
    began = UTC + bench.t - 30.0
    assert "not within this experiment" in order("takeoff", UTC - 1e5)
    assert order("takeoff", began) == ""
    step(0.02)
    while life.phase != AIRBORNE:
        assert bench.robot.words == ()
        step(0.01)
    step(1.0)
    since = UTC + bench.t - began
    assert life.phase == AIRBORNE
    assert stepping.memory["time"][0] == pytest.approx(since, abs=0.11)
    assert bench.robot.words == (("time", (pytest.approx(stepping.memory["time"][0]),)),)
    assert stepping.measures == {"moves": 0.0, "step_s": pytest.approx(0.1)}
    assert bench.robot.setpoint[:2] == (0.0, 0.0)
    assert order("start", began) == ""
    step(0.5)
    assert stepping.memory["time"][0] == pytest.approx(since + 0.5, abs=0.11)
    assert stepping.measures == {"moves": 1.0, "step_s": pytest.approx(0.1)}
    assert bench.robot.setpoint[0] > 0.0


def test_repeated_start_keeps_the_ticks():
    with Net().worn() as net:
        runtime = process(pair(), Airborne(), "A")
        runtime.subscribe_to_stops(net.session)
        runtime.join(net.session)
        runtime.ticks.t, runtime.ticks.next = 7.0, 7.01
        for phase, at in ((AIRBORNE, 7.504), (RUNNING, 7.508)):
            runtime.robots[0].lifecycle.phase = phase
            net.deliver(sent("park/A/order", messages.Order("start", at=at))[0])
            runtime.tick(7.0)
            assert runtime.ticks.next == pytest.approx(7.004)
