"""The place of control: goals are kept while the input of the law stays, each row for itself."""

import msgspec
import numpy as np
import pytest

from agents.plugins.trigger_families import RelativeControl, SelfTriggered
from agents.plugins.triggers import SendOnDelta
from experiments.definition.experiment import Experiment, Formation, Leg, Robot
from experiments.definition.plan import Plan
from tests.agents.swarm import Swarm

LINKS = {"A - B": 0.5, "C > A": 0.5, "C > B": 0.5}


def triangle(update, **parts):
    """Three ground robots; C listens to nobody and stands."""
    places = {"A": [-0.4, 0.0], "B": [0.4, 0.1], "C": [0.0, -0.5]}
    robots = {name: Robot(kind="khepera4", start=start) for name, start in places.items()}
    given = {
        "title": "Triangle",
        "duration_s": 60.0,
        "robots": robots,
        "formation": Formation(links=LINKS, update=update),
    }
    return Experiment(**{**given, **parts})


def updates(swarm):
    return {name: int(group.agent.updates[row]) for name, (group, row) in swarm.where.items()}


def test_without_it_every_decision_computes_the_law():
    swarm = Swarm(triangle(None)).running().run(4.95)
    assert updates(swarm) == {"A": 50, "B": 50, "C": 50}


@pytest.mark.slow
def test_who_stands_still_among_those_who_stand_keeps_its_goal():
    swarm = Swarm(triangle({"kind": "send-on-delta", "threshold": 0.02})).running().run(25.0)
    before = updates(swarm)
    swarm.run(10.0)
    after = updates(swarm)
    assert after["C"] - before["C"] == 100  # it follows no law
    assert after["A"] - before["A"] <= 2
    assert before["A"] < 150
    a, b, c = (swarm.row(name, "truth") for name in "ABC")
    for one, other in ((a, b), (a, c), (b, c)):
        assert np.linalg.norm(one - other) == pytest.approx(0.5, abs=0.02)


def test_the_goal_changes_only_when_it_is_computed():
    swarm = Swarm(triangle({"kind": "periodic", "period_s": 0.5}), [["A"], ["B"], ["C"]]).running()
    begin = swarm.tick
    swarm.run(5.0)
    goals = swarm.column("goal")[begin - 1 :, 0]
    changes = np.flatnonzero((np.diff(goals, axis=0) != 0).any(axis=1)) + 1
    np.testing.assert_array_equal(changes % 50, 0)
    assert updates(swarm)["A"] == len(changes) + 1


def test_who_was_held_computes_at_once_when_it_goes_on():
    swarm = Swarm(triangle({"kind": "periodic", "period_s": 5.0})).running().run(1.0)
    group, row = swarm.where["A"]
    before = updates(swarm)
    assert group.agent.hold(row) == ""
    swarm.run(0.5)
    held = swarm.row("A", "goal")
    assert group.agent.start(row, 0.0) == ""
    swarm.run(0.3)
    assert updates(swarm)["A"] > before["A"]
    assert not np.array_equal(swarm.row("A", "goal"), held)
    assert updates(swarm)["B"] == before["B"]


def test_who_loses_a_neighbour_computes_at_once():
    swarm = Swarm(triangle({"kind": "periodic", "period_s": 30.0}), [["A"], ["B"], ["C"]]).running().run(0.55)
    agent = swarm.agent("A")
    before = int(agent.updates[0])
    agent.neighbours.mark_lost(np.array([0]), swarm.t - 5.0)
    swarm.groups[0].by_speaker.pop("B")
    swarm.run(0.2)
    assert int(agent.updates[0]) == before + 1
    assert updates(swarm)["B"] == 1


def test_a_follower_with_a_plan_of_its_own_computes_always():
    leg = Leg(at_s=0.0, robot="A", plan={"kind": "hold", "at": [0.0, 0.2]})
    swarm = Swarm(triangle({"kind": "periodic", "period_s": 30.0}, timeline=[leg])).running().run(1.95)
    assert updates(swarm) == {"A": 20, "B": 1, "C": 20}


@pytest.mark.parametrize("trigger", [SendOnDelta(), SelfTriggered(), RelativeControl()])
def test_what_moved_is_the_largest_change_on_a_link(trigger):
    chosen = {"kind": {"SendOnDelta": "send-on-delta", "SelfTriggered": "self-triggered"}.get(
        type(trigger).__name__, "relative-control"), **msgspec.structs.asdict(trigger)}  # fmt: skip
    swarm = Swarm(triangle({key: value for key, value in chosen.items() if value is not None})).running().run(0.5)
    (group,) = swarm.groups
    agent, state = group.agent, group.state
    view = agent.goal_computer.control_view(swarm.t, state.position, state.velocity, agent.lifecycle.start_at)
    links = Plan(swarm.experiment).links
    apart = state.position[links.receiver] - agent.neighbours.poses.position
    moved = np.linalg.norm(apart - agent.goal_computer._updating._apart, axis=1)
    for row in range(2):
        assert view.deviation[row] == pytest.approx(moved[links.receiver == row].max(), abs=1e-15)
    assert view.deviation[2] == 0.0
    np.testing.assert_array_equal(view.offset, agent.goal_computer.law_offset(swarm.t, state.position))
    error, energy = agent.goal_computer.errors(swarm.t, state.position)
    np.testing.assert_array_equal(view.error, error)
    np.testing.assert_array_equal(view.energy, energy)
