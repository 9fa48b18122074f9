"""A robot that comes back goes on with its plan, and one that runs keeps its ticks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import pytest

from agents.body.limits import Safety
from agents.decision.lifecycle import AIRBORNE, READY, RUNNING
from agents.network import messages
from agents.plugins.law import Control, Law, Said
from agents.runtime.orders import carry_out
from experiments.definition.experiment import Formation, LegTable, RobotTable
from experiments.definition.plan import Plan
from tests.agents.bench import Bench
from tests.agents.runtime.process import Airborne, process
from tests.fuzz.messages import sent
from tests.network import Net
from tests.small import pair

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
    """Says the time, and wants to move."""

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
