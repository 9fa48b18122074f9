"""A process that was suspended holds until its neighbours were heard again."""

import math

import pytest

from agents.decision.situation import SILENT_S
from agents.kinds.khepera4 import KHEPERA4
from tests.agents.safety.watched import DT, Watched


def woken(slept=0.6, neighbours=(("B", KHEPERA4),)):
    """A robot with one neighbour, the process of which has just resumed."""
    robot = Watched(KHEPERA4, neighbours, hover=0.0).step(1.0)
    robot.health.mark_resumed(robot.t, slept)
    return robot


def held(robot, seconds, every_tick=None):
    """Ticks on which a robot is held."""
    return sum(robot.step(DT, every_tick).hazards.held for _ in range(round(seconds / DT)))


def test_standstill_holds_until_neighbours_are_heard():
    robot = woken()
    assert held(robot, 0.03) == 3
    robot.hear(0, (1.0, 0.0, 0.0))
    assert held(robot, 3.0) == 0
    begin, end = robot.texts
    assert begin == "hold: its process stood still: for 0.6 s; it waits for its neighbours"
    assert end.startswith("over: its process stood still, after ")


@pytest.mark.parametrize("slept", [0.6, 1.5, 2.2])
def test_silent_neighbours_are_not_awaited_for_long(slept):
    assert held(woken(slept), 3.0) == pytest.approx(SILENT_S / DT, abs=1)


def test_lost_neighbours_are_not_awaited():
    robot = woken()
    robot.neighbours.mark_lost(0, robot.t)
    assert held(robot, 0.5) == 0


def test_waiting_begins_when_the_router_is_back():
    robot = woken()
    robot.health.offline_since = robot.t
    assert held(robot, 3.0) == 300
    robot.health.offline_since = math.inf
    assert held(robot, 3.0) == pytest.approx(SILENT_S / DT, abs=1)
    robot.health.offline_since = robot.t  # much later: that standstill is over
    assert held(robot, 0.5) == 0


def test_robot_without_neighbours_does_not_hold():
    assert held(woken(neighbours=()), 0.5) == 0


def test_guided_robot_waits_for_a_new_goal():
    robot = woken(neighbours=())
    robot.status.goal_stamp = robot.t - 0.5
    assert held(robot, 0.1) == 10
    robot.status.goal_stamp = robot.t
    assert held(robot, 0.1) == 0
