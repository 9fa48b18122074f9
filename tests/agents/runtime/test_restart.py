"""A robot that comes back goes on with its plan, and one that runs keeps its ticks."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agents.agent import Agent
from agents.body.interface import BodyState
from agents.body.limits import Safety
from agents.decision.lifecycle import AIRBORNE, READY, RUNNING
from agents.network import messages
from agents.network.keys import Keys
from agents.runtime.loop import Runtime, Setup
from agents.runtime.orders import carry_out
from experiments.definition.experiment import Formation, Leg, Robot
from experiments.definition.plan import Plan
from tests.agents.few import pair
from tests.agents.runtime.test_shutdown import Airborne
from tests.agents.things import poses
from tests.fuzz.loopnet import Net
from tests.fuzz.messages import sent

UTC = 1.7e9
START, WAY, BEGINS_S, SPEED = (-0.6, 0.1), 0.75, 5.0, 0.15


def leader(*, listens: bool = False):
    """A, which drives `WAY` along x from `BEGINS_S` on."""
    return pair(
        robots={"A": Robot(kind="turtlebot3", start=list(START)), "B": Robot(kind="khepera4", start=[0.6, 0.6])},
        formation=Formation(links={"B > A": 0.5} if listens else {"A > B": 0.5}),
        timeline=[Leg(robot="A", at_s=BEGINS_S, plan={"kind": "line", "move_by": [WAY, 0.0], "speed": SPEED})],
        safety=Safety(start_within=0.0),  # as processes get it that are started in mid-run
    )


class Life:
    """A process of A, at a place, `late_s` after the common start."""

    def __init__(self, place, late_s: float, origin: messages.Setpoint | None = None, *, listens: bool = False) -> None:
        self.agent = Agent(Plan(leader(listens=listens)).assignment(("A",)))
        links = np.arange(len(self.agent.assignment.links))
        self.agent.neighbours.mark_alive(links)
        self.t, self.place = 0.0, np.array([[*place, 0.0]])
        if len(links):
            self.agent.neighbours.receive(
                poses(links, np.array([[0.6, 0.6, 0.0]]), np.zeros((1, 3)), np.zeros(1), np.zeros(1))
            )
        self.step(READY)
        assert self.order(messages.Order("takeoff")) == ""
        self.step(AIRBORNE)
        self.start = messages.Order("start", at=UTC + self.t - late_s, origin=origin)
        assert self.order(self.start) == ""
        self.step(RUNNING)
        for _ in range(20):
            self.step(RUNNING)

    def order(self, order: messages.Order) -> str:
        return carry_out(self.agent, 0, order, self.t, UTC)[0]

    def step(self, phase: int) -> None:
        for _ in range(3):
            still, one = np.zeros((1, 3)), np.zeros(1)
            state = BodyState(
                np.full(1, self.t), self.place, still, one, self.place, one, np.ones(1), np.zeros(1, dtype=bool)
            )
            self.agent.step(self.t, state)
            self.t += 0.01
        assert self.agent.lifecycle.phase[0] == phase


def test_a_leader_that_is_restarted_where_it_stands_does_not_drive_its_plan_a_second_time():
    first = Life(START, 0.0)
    origin = first.agent.origin(0)
    assert origin == (*START, 0.0, 0.0)
    there = (START[0] + WAY, START[1])
    second = Life(there, 30.0, origin)
    np.testing.assert_allclose(second.agent.goal[0, :2], there)
    assert second.agent.origin(0) == origin  # for the next one of its name
    assert Life(there, 30.0).agent.goal[0, 0] == pytest.approx(there[0] + WAY)  # without the origin
    anew = Life(START, 30.0, origin)  # a twin of its own stands at its start again
    np.testing.assert_allclose(anew.agent.goal[0, :2], there)


def test_a_leg_that_was_under_way_goes_on_from_where_it_began():
    origin = (*START, 0.0, 0.0)
    half = Life((0.0, 0.0), BEGINS_S + 2.0, origin)
    gone = SPEED * (half.t - half.start.at + UTC - BEGINS_S)
    assert half.agent.goal[0, 0] == pytest.approx(START[0] + gone, abs=0.02)


def test_the_plan_of_a_robot_that_listens_begins_where_its_first_leg_did():
    before = Life(START, 0.0, listens=True)
    assert before.agent.origin(0) is None  # its leg is yet to come
    first = Life(START, BEGINS_S, listens=True)
    assert first.agent.origin(0)[:2] == START
    second = Life((START[0] + WAY, START[1]), 30.0, first.agent.origin(0), listens=True)
    assert second.agent.origin(0)[:2] == START


def test_a_start_with_an_origin_that_is_not_known_is_refused():
    life = Life(START, 0.0)
    life.agent.lifecycle.phase[0] = AIRBORNE
    start = messages.Order("start", at=UTC + life.t, origin=(0.0, math.nan, 0.0, 0.0))
    assert "origin" in life.order(start)


def test_a_start_that_is_repeated_does_not_move_the_ticks_of_a_robot_that_runs():
    setup = Setup(Keys("park"), [], "json", 50.0, lifeline=False, located=[False])
    with Net().worn() as net:
        robot = Runtime(Plan(pair()).assignment(("A",)), Airborne(), setup)
        robot._subscribe_to_stops(net.session)
        robot._join(net.session)
        robot._utc, robot._ticks.t, robot._ticks.next = UTC, 7.0, 7.01

        def start(at: float) -> None:
            net.deliver(sent("park/A/order", messages.Order("start", at=UTC + at))[0])
            for query, order in robot._orders[0].read():
                robot._obey(0, query, order, robot._ticks.t)

        robot.agent.lifecycle.phase[0] = AIRBORNE
        start(7.504)
        assert robot._ticks.next == pytest.approx(7.004)
        robot.agent.lifecycle.phase[0] = RUNNING
        start(7.508)
        assert robot._ticks.next == pytest.approx(7.004)
