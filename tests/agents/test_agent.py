"""The decision: what was heard, neighbours that go and come back, orders, formations, leaders and plans."""

import numpy as np
import pytest

from agents.agent import Agent
from agents.body.interface import BodyState
from agents.decision.lifecycle import AIRBORNE, IDLE, READY, RUNNING
from agents.decision.neighbours import NeighbourPoses
from agents.network.messages import Order
from agents.runtime.orders import carry_out
from experiments.definition.experiment import Formation, Leg, Robot, Start
from experiments.definition.plan import Plan
from tests.agents.few import pair, triangle
from tests.agents.swarm import Swarm
from tests.agents.things import poses

# ---------------------------------------------------------------- what was heard


def bare(**parts):
    """The decision of A alone, ready to be told things; B is on link 0."""
    experiment = pair(**parts)
    agent = Agent(Plan(experiment).assignment(["A"]))
    agent.neighbours.mark_alive(np.arange(len(agent.assignment.links)))
    return agent


def say(agent, position, stamp, at=0):
    agent.neighbours.receive(
        poses(np.array([at]), np.array([position]), np.zeros((1, 3)), np.array([stamp]), np.array([stamp + 0.01]))
    )


def test_older_samples_than_known_are_left_out():
    agent = bare()
    say(agent, [1.0, 0.0, 0.0], 2.0)
    say(agent, [9.0, 9.0, 9.0], 1.0)
    say(agent, [9.0, 9.0, 9.0], 2.0)
    np.testing.assert_array_equal(agent.neighbours.poses.position, [[1.0, 0.0, 0.0]])
    assert agent.neighbours.poses.stamp[0] == 2.0
    say(agent, [0.5, 0.0, 0.0], 2.5)
    np.testing.assert_array_equal(agent.neighbours.poses.position, [[0.5, 0.0, 0.0]])


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 1, 0], [1, 2, 0], [0, 2, 1]])
def test_of_samples_that_arrive_together_the_newest_stays(order):
    stamps, places = np.array([1.0, 2.0, 3.0])[order], np.array([[1.0, 0, 0], [2.0, 0, 0], [3.0, 0, 0]])[order]
    together, one_by_one = bare(), bare()
    together.neighbours.receive(poses(np.zeros(3, dtype=np.intp), places, np.zeros((3, 3)), stamps, np.full(3, 4.0)))
    for place, stamp in zip(places.tolist(), stamps.tolist(), strict=True):
        say(one_by_one, place, stamp)
    for agent in (together, one_by_one):
        np.testing.assert_array_equal(agent.neighbours.poses.position, [[3.0, 0.0, 0.0]])
        assert agent.neighbours.poses.stamp[0] == 3.0


def test_nothing_heard_is_nothing():
    heard = NeighbourPoses(2)
    assert np.isnan(heard.position).all()
    assert (heard.stamp == -np.inf).all()
    assert (heard.lost_since == -np.inf).all()
    heard.stamp[0] = 1.0
    assert heard.arrival[0] == -np.inf


def seen(t, position=(-0.4, 0.0, 0.0), **parts):
    """A measurement of A, now."""
    state = {
        "time": np.array([t]), "position": np.array([position], dtype=float), "velocity": np.zeros((1, 3)),
        "yaw": np.zeros(1), "true_position": np.zeros((1, 3)), "true_yaw": np.zeros(1), "battery": np.ones(1),
        "flying": np.zeros(1, dtype=bool),
    }  # fmt: skip
    return BodyState(**{**state, **{name: np.array([value]) for name, value in parts.items()}})


def test_who_misses_a_neighbour_is_not_ready_and_says_whom():
    agent = bare()
    agent.step(0.0, seen(0.0))
    assert (agent.lifecycle.phase[0], agent.lifecycle.reason[0]) == (IDLE, "never heard B")
    assert agent.missing_neighbours(0) == ["B"]
    agent.step(0.01, seen(0.01, position=(np.nan, 0, 0)))
    assert agent.lifecycle.reason[0] == "no position of its own"
    agent.step(0.7, seen(0.1))
    assert agent.lifecycle.reason[0] == "no position of its own"  # too old
    say(agent, [0.4, 0.1, 0.0], 0.7)
    agent.step(0.71, seen(0.71))
    assert (agent.lifecycle.phase[0], agent.lifecycle.reason[0]) == (READY, "")
    assert agent.missing_neighbours(0) == []
    agent.neighbours.mark_lost(np.array([0]), 0.8)
    assert agent.missing_neighbours(0) == ["B"]


def test_patience_ends():
    agent = bare(start=Start(deadline_s=2.0, missing="go-on"))
    agent.step(2.0, seen(2.0))
    assert agent.lifecycle.phase[0] == IDLE
    agent.step(2.01, seen(2.01))
    assert agent.lifecycle.phase[0] == READY


def test_a_position_that_is_not_known_is_not_told():
    agent = bare()
    assert not len(agent.step(0.0, seen(0.0, position=(np.nan, 0, 0))).transmit)
    assert len(agent.step(0.02, seen(0.02)).transmit) == 0  # asked on every second tick
    assert agent.step(0.03, seen(0.03)).transmit.tolist() == [0]


def live(agent):
    """The links that take part in the decision."""
    return agent.neighbours.active.tolist()


def test_a_neighbour_that_is_gone_is_left_out_after_the_silence_and_back_when_found():
    swarm = Swarm(triangle(), [["A"], ["B"], ["C"]]).running().run(0.5)
    agent = swarm.agent("A")
    assert live(agent) == [0, 1]
    begin = swarm.t
    agent.neighbours.mark_lost(np.array([0]), begin)
    swarm.groups[0].by_speaker.pop("B")  # and A hears nothing of it any more
    swarm.run(1.0)
    assert live(agent) == [0, 1]
    swarm.run(0.02)
    assert live(agent) == [1]
    assert agent.missing_neighbours(0) == ["B"]
    before = swarm.row("A", "goal")
    swarm.run(0.1)
    assert not np.array_equal(swarm.row("A", "goal"), before)  # it still follows C
    agent.neighbours.mark_alive(np.array([0]))
    swarm.step()
    assert live(agent) == [0, 1]


def test_a_neighbour_that_is_gone_is_not_back_because_it_is_heard_again():
    swarm = Swarm(triangle(), [["A"], ["B"], ["C"]]).running().run(0.5)
    agent = swarm.agent("A")
    agent.neighbours.mark_lost(np.array([0]), swarm.t - 5.0)
    swarm._flying.clear()
    swarm.step()
    assert live(agent) == [1]
    swarm.run(0.03)
    assert agent.neighbours.poses.arrival[0] > swarm.t - 0.03
    assert live(agent) == [1]


def test_a_neighbour_never_heard_does_not_hide_one_that_is_gone():
    experiment = triangle(start=Start(deadline_s=0.1, missing="go-on"))
    agent = Agent(Plan(experiment).assignment(["A"]))
    agent.neighbours.mark_alive(np.array([1]))
    say(agent, [0.0, -0.5, 0.0], 0.1, at=1)  # C is heard, B never
    for tick in range(30):
        agent.step(0.01 * tick, seen(0.01 * tick))
    assert agent.lifecycle.takeoff(0) == ""
    agent.step(0.3, seen(0.3))
    agent.step(0.31, seen(0.31))
    assert agent.start(0, 0.32) == ""
    agent.step(0.32, seen(0.32))
    assert live(agent) == [1]
    agent.neighbours.mark_lost(np.array([1]), 0.33)
    for tick in range(33, 200):
        agent.step(0.01 * tick, seen(0.01 * tick))
    assert live(agent) == []
    np.testing.assert_array_equal(agent.goal, [[-0.4, 0.0, 0.0]])  # alone: it holds


def test_who_is_alone_holds_where_it_was_then():
    swarm = Swarm(pair(), [["A"], ["B"]]).running().run(0.5)
    moving = swarm.row("A", "goal")
    agent = swarm.agent("A")
    agent.neighbours.mark_lost(np.array([0]), swarm.t)
    swarm.groups[0].by_speaker.clear()
    swarm.run(1.2)
    held = swarm.row("A", "goal")
    assert not np.array_equal(held, moving)
    swarm.run(1.0)
    np.testing.assert_array_equal(swarm.row("A", "goal"), held)
    assert np.linalg.norm(swarm.row("A", "truth") - held) < 0.02
    agent.neighbours.mark_alive(np.array([0]))
    swarm.run(0.2)
    assert not np.array_equal(swarm.row("A", "goal"), held)


def test_who_is_cut_off_holds_and_goes_on():
    swarm = Swarm(pair(), [["A"], ["B"]]).running().run(0.5)
    agent = swarm.agent("A")
    agent.health.offline_since = swarm.t
    swarm.run(1.0)
    busy = swarm.row("A", "goal")
    swarm.run(0.2)
    held = swarm.row("A", "goal")
    assert not np.array_equal(held, busy)
    swarm.run(0.5)
    np.testing.assert_array_equal(swarm.row("A", "goal"), held)
    agent.health.offline_since = np.inf
    swarm.run(0.2)
    assert not np.array_equal(swarm.row("A", "goal"), held)


def test_hold_and_start_again():
    swarm = Swarm(pair(), [["A"], ["B"]])
    agent = swarm.agent("A")
    swarm.step()
    assert agent.hold(0) == "cannot hold while idle"
    swarm.running().run(0.3)
    assert agent.hold(0) == ""
    swarm.run(0.2)
    held = swarm.row("A", "goal")
    swarm.run(0.5)
    np.testing.assert_array_equal(swarm.row("A", "goal"), held)
    assert swarm.phase("A") == RUNNING
    assert agent.start(0, 0.0) == ""
    swarm.run(0.2)
    assert not np.array_equal(swarm.row("A", "goal"), held)
    assert agent.lifecycle.start_at[0] == swarm.start_at


def test_another_row_that_arrives_in_the_air_does_not_move_a_place_that_is_held():
    robots = {
        "A": Robot(kind="khepera4", start=[-0.4, 0.0]),
        "B": Robot(kind="khepera4", start=[0.4, 0.1]),
        "F": Robot(kind="crazyflie", start=[0.0, 0.6], hover=0.5),
    }
    swarm = Swarm(pair(robots=robots))
    agent = swarm.agent("A")
    swarm.run(0.05)
    for row in range(3):
        assert agent.lifecycle.takeoff(row) == ""
    swarm.run(0.05)
    for row in range(2):
        assert agent.start(row, swarm.t) == ""
    swarm.run(0.2)
    assert agent.hold(0) == ""
    swarm.run(0.2)
    held = swarm.row("A", "goal")
    while swarm.phase("F") < AIRBORNE:
        swarm.step()
        np.testing.assert_array_equal(swarm.row("A", "goal"), held)
    swarm.run(0.3)
    np.testing.assert_array_equal(swarm.row("A", "goal"), held)
    np.testing.assert_allclose(swarm.row("F", "goal"), [0.0, 0.6, 0.5], atol=1e-9)


# ---------------------------------------------------------------- formations, leaders, plans


def test_a_pair_comes_to_the_distance_wanted():
    swarm = Swarm(pair()).running().run(25.0)
    a, b = swarm.log[-1]["truth"]
    assert np.linalg.norm(a - b) == pytest.approx(0.5, abs=0.012)  # both stand within 5 mm of their goals
    np.testing.assert_allclose(swarm.log[-1]["error"], abs(np.linalg.norm(a - b) - 0.5), atol=1e-9)
    assert swarm.agent("A").decisions == 251  # at 0 and at 25 s


def test_decisions_and_questions_keep_to_their_rates():
    swarm = Swarm(pair()).running()
    begin = swarm.tick
    swarm.run(2.0)
    goals = swarm.column("goal")[begin - 1 :, 0]
    changes = np.flatnonzero((np.diff(goals, axis=0) != 0).any(axis=1)) + 1
    np.testing.assert_array_equal(changes % 10, 0)
    asked = [tick - begin + 1 for tick, name in swarm.sent if tick >= begin and name == "A"]
    np.testing.assert_array_equal(asked, np.arange(2, 201, 2))


def test_steps_of_the_goal_are_clamped():
    swarm = Swarm(pair(formation=Formation(links={"A - B": 0.5}, gain=50.0, clamp=0.07))).running().run(0.05)
    step = swarm.row("A", "goal") - swarm.log[-5]["position"][0]
    assert step[0] == pytest.approx(0.07, abs=0.01)
    assert np.abs(step).max() < 0.075


@pytest.mark.parametrize("kind", ["khepera4", "crazyflie", "tello"])
def test_a_leader_follows_its_plan(kind):
    hover = None if kind == "khepera4" else 0.6
    robots = {"L": Robot(kind=kind, start=[0.0, 0.0], hover=hover), "F": Robot(kind="khepera4", start=[-0.5, 0.0])}
    plan = {"kind": "line", "move_by": [0.3, 0.0], "speed": 0.1}
    experiment = pair(
        robots=robots, formation=Formation(links={"L > F": 0.8}), timeline=[Leg(at_s=1.0, robot="L", plan=plan)]
    )
    swarm = Swarm(experiment, [["L"], ["F"]]).running()
    height = hover or 0.0
    begin = swarm.row("L", "goal")
    np.testing.assert_allclose(begin, [0.0, 0.0, height], atol=1e-9)
    swarm.run(1.0)
    np.testing.assert_allclose(swarm.row("L", "goal"), begin, atol=1e-9)
    swarm.run(2.0)
    np.testing.assert_allclose(swarm.row("L", "goal") - begin, [0.2, 0.0, 0.0], atol=0.0101)
    swarm.run(6.0)
    np.testing.assert_allclose(swarm.row("L", "goal") - begin, [0.3, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(swarm.row("L", "truth"), begin + np.array([0.3, 0.0, 0.0]), atol=0.006)


def test_a_leader_goes_where_it_is_sent_and_a_follower_does_not():
    robots = {"L": Robot(kind="khepera4", start=[0.0, 0.0]), "F": Robot(kind="khepera4", start=[-0.5, 0.0])}
    swarm = Swarm(pair(robots=robots, formation=Formation(links={"L > F": 0.5})), [["L"], ["F"]])
    order = Order("go", goal=(0.2, 0.1))
    assert "cannot go anywhere while idle" in carry_out(swarm.agent("L"), 0, order, 0.0, 0.0)[0]
    swarm.running()
    for wrong, why in (
        (Order("go", goal=(9.0, 0.0)), "outside the arena"),
        (Order("go"), "needs a `goal`"),
        (Order("go", goal=(float("nan"), 0.0)), "needs a `goal`"),
    ):
        assert why in carry_out(swarm.agent("L"), 0, wrong, swarm.t, 0.0)[0]
    assert "only a leader" in carry_out(swarm.agent("F"), 0, order, swarm.t, 0.0)[0]
    assert carry_out(swarm.agent("L"), 0, order, swarm.t, 0.0) == ("", None)
    swarm.run(0.5)
    gone = np.linalg.norm(swarm.row("L", "goal"))
    assert 0.0 < gone < 0.5 * 0.5 * 0.28  # it goes at half its speed, not at once
    swarm.run(8.0)
    np.testing.assert_allclose(swarm.row("L", "truth")[:2], [0.2, 0.1], atol=0.006)
    carry_out(swarm.agent("L"), 0, Order("go", goal=(0.0, 0.1)), swarm.t, 0.0)
    swarm.run(8.0)
    np.testing.assert_allclose(swarm.row("L", "truth")[:2], [0.0, 0.1], atol=0.006)


@pytest.mark.slow
def test_a_follower_with_a_plan_is_pulled_by_both():
    robots = {"L": Robot(kind="khepera4", start=[0.0, 0.0]), "F": Robot(kind="khepera4", start=[-0.5, 0.0])}
    plan = {"kind": "hold", "at": [0.0, 0.5]}
    formation = Formation(links={"L > F": 0.5}, tracking_gain=3.0)
    experiment = pair(robots=robots, formation=formation, timeline=[Leg(at_s=0.0, robot="F", plan=plan)])
    swarm = Swarm(experiment).running().run(40.0)
    place = swarm.row("F", "truth")
    assert np.linalg.norm(place - [0.0, 0.5, 0.0]) < 0.2  # the pull ends with the third power of what is left
    assert np.linalg.norm(place) == pytest.approx(0.5, abs=0.02)


def test_whoever_has_neither_neighbours_nor_a_plan_stays():
    swarm = Swarm(triangle()).running().run(5.0)
    np.testing.assert_allclose(swarm.row("C", "truth"), [0.0, -0.5, 0.0], atol=1e-9)


def test_who_joins_late_is_where_the_plan_is_now():
    plan = {"kind": "line", "move_by": [0.3, 0.0], "speed": 0.1}
    robots = {"L": Robot(kind="khepera4", start=[0.0, 0.0])}
    swarm = Swarm(pair(robots=robots, formation=Formation(), timeline=[Leg(at_s=1.0, robot="L", plan=plan)]))
    swarm.run(0.05)
    agent = swarm.agent("L")
    agent.lifecycle.takeoff(0)
    swarm.run(0.05)
    begin = swarm.t - 3.0
    assert agent.start(0, begin) == ""
    swarm.step()
    assert swarm.phase("L") == RUNNING
    assert agent.tick == 301
    np.testing.assert_allclose(swarm.row("L", "goal"), [0.2, 0.0, 0.0], atol=1e-9)
    assert agent.decisions == 1
