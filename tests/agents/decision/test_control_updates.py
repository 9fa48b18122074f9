"""The place of control: a goal is kept while the input of the law stays."""

from math import dist, nan

import pytest

from agents.decision.control_updates import ControlUpdates
from agents.decision.neighbours import Incoming, Neighbours
from agents.kinds.khepera4 import KHEPERA4
from agents.plugins.predictors import HOLD, ConstantVelocity
from agents.plugins.triggers import SendOnDelta
from agents.vectors import ZERO
from experiments.definition.experiment import Formation, LegTable
from tests.agents.swarm import Swarm
from tests.small import changed, triangle

LINKS = {"A - B": 0.5, "C > A": 0.5, "C > B": 0.5}


def updating(update, **parts):
    """Three ground robots that run; C receives nobody and stands."""
    return Swarm(changed(triangle(), formation=Formation(links=LINKS, update=update), **parts)).running()


def updates(swarm):
    return [swarm.robot(name).updates for name in "ABC"]


@pytest.mark.slow
def test_standing_robots_keep_their_goals():
    swarm = updating({"kind": "send-on-delta", "threshold": 0.02}).run(25.0)
    before, after = updates(swarm), updates(swarm.run(10.0))
    assert after[2] - before[2] == 100  # it follows no law
    assert after[0] - before[0] <= 2
    assert before[0] < 150
    places = [swarm.last(name, "truth") for name in "ABC"]
    assert [dist(places[i], places[j]) for i, j in ((0, 1), (0, 2), (1, 2))] == pytest.approx([0.5] * 3, abs=0.02)


def test_goal_changes_only_when_computed():
    assert updates(updating(None).run(4.95)) == [50, 50, 50]
    swarm = updating({"kind": "periodic", "period_s": 0.5})
    begin = swarm.tick
    goals = swarm.run(5.0).column("A", "goal", begin - 1)
    changes = [k for k in range(1, len(goals)) if goals[k] != goals[k - 1]]
    assert all(k % 50 == 0 for k in changes)
    assert updates(swarm)[0] == len(changes) + 1


def test_held_robot_or_lost_neighbour_makes_it_compute():
    swarm = updating({"kind": "periodic", "period_s": 30.0}).run(1.0)
    robot, before = swarm.robot("A"), updates(swarm)
    assert robot.hold() == ""
    held = swarm.run(0.5).last("A", "goal")
    assert robot.start(0.0) == ""
    assert swarm.run(0.3).last("A", "goal") != held
    between = updates(swarm)
    assert between[0] > before[0]
    swarm.lose("B", "A", since=5.0)
    assert updates(swarm.run(0.2))[0] == between[0] + 1
    assert updates(swarm)[1] == before[1] == 1


def test_follower_with_a_plan_always_computes():
    leg = LegTable(at_s=0.0, robot="A", plan={"kind": "hold", "at": [0.0, 0.2]})
    assert updates(updating({"kind": "periodic", "period_s": 30.0}, timeline=[leg]).run(1.95)) == [20, 1, 20]


@pytest.mark.parametrize("anchored", [False, True])
def test_deviation_is_the_largest_change_on_a_link(anchored):
    neighbours = Neighbours([Incoming(k, name, KHEPERA4, 0.5) for k, name in enumerate("BC")], 1.0)
    updates = ControlUpdates(SendOnDelta(threshold=0.05), 2, anchored=anchored)
    for link in range(2):
        neighbours.mark_alive(link)
        neighbours.receive(link, (1.0, float(link), 0.0), (0.1, 0.0, 0.0), 0.0, 0.0)
    neighbours.update_active(0.0)

    def due(t, x, predictor=HOLD):
        place = (x, 0.0, 0.0)
        return updates.due(t, place, ZERO, neighbours, predictor, since_start=t, offset=ZERO, error=0.0, energy=0.0)

    assert due(0.0, 0.0)
    assert not due(0.1, nan)
    neighbours.receive(1, (1.04, 1.0, 0.0), ZERO, 0.1, 0.1)
    assert not due(0.1, 0.0)
    assert updates.asking.view.deviation == pytest.approx(0.04)
    assert due(0.2, -0.03)
    assert updates.asking.view.deviation == pytest.approx(0.07)
    assert not due(0.3, 0.01)  # 4 cm on both links
    assert due(1.0, 0.01, ConstantVelocity())  # the first sender is believed to have moved on
