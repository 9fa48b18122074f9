"""Robots that a centre guides: what they obey, when they hold, and what stays in the robot."""

import numpy as np
import pytest

from agents.agent import Agent
from agents.body.interface import BodyState
from agents.decision.centralised import Guidance
from agents.decision.lifecycle import AIRBORNE, IDLE, LANDING, READY, RUNNING
from experiments.definition.experiment import Experiment, Formation, Hybrid, Robot, Start
from experiments.definition.plan import Plan

NAN = np.nan


def pair(**parts):
    """A Khepera and a Tello that listen to each other, decided for by a centre; `parts` changes that."""
    given = {
        "title": "A pair",
        "duration_s": 60.0,
        "robots": {
            "A": Robot(kind="khepera4", start=[-0.4, 0.0]),
            "B": Robot(kind="crazyflie", start=[0.4, 0.1], hover=0.8),
        },
        "formation": Formation(links={"A - B": 0.9}),
        "architecture": "centralised",
        **parts,
    }
    return Experiment(**given)


class Bench:
    """The rows of an experiment on a clock, where they are put."""

    def __init__(self, experiment, names=("A", "B")):
        self.agent = Agent(Plan(experiment).assignment(names))
        self.agent.neighbours.mark_alive(np.arange(len(self.agent.assignment.links)))
        self.position = np.array([[-0.4, 0.0, 0.0], [0.4, 0.1, 0.8]])[: len(names)]
        self.climbed = np.zeros(len(names))
        self.t = 0.0

    def step(self, count=1):
        for _ in range(count):
            rows = len(self.position)
            still, flying = np.zeros((rows, 3)), np.array([False, True])[:rows]
            life, position = self.agent.lifecycle, self.position.copy()
            waits = (life.phase <= READY) & ~life.active  # on the floor, until it is told to climb
            self.climbed = np.where(waits, 0.0, self.climbed + 0.005)
            position[:, 2] = np.minimum(position[:, 2], self.climbed)
            state = BodyState(
                time=np.full(rows, self.t), position=position, velocity=still, yaw=np.zeros(rows),
                battery=np.full(rows, NAN), flying=flying, true_position=position, true_yaw=np.zeros(rows),
            )  # fmt: skip
            self.actions = self.agent.step(self.t, state)
            self.t = round(self.t + 0.01, 9)
        return self

    def told(self, rows, goal, *, stamp=None, toward=NAN):
        count = len(rows)
        stamps = np.full(count, self.t if stamp is None else stamp)
        return self.agent.guidance.receive(np.array(rows), np.array(goal, dtype=float), np.full(count, toward), stamps)

    def running(self):
        rows = range(len(self.position))
        self.told(list(rows), self.position)
        self.step()
        for row in rows:
            assert self.agent.lifecycle.takeoff(row) == ""
        self.step(200)  # up at 0.5 m/s
        for row in rows:
            assert self.agent.start(row, self.t) == ""
        self.told(list(rows), self.position)
        return self.step()

    @property
    def phases(self):
        return self.agent.lifecycle.phase.tolist()


def test_it_is_ready_when_the_centre_has_spoken():
    bench = Bench(pair()).step()
    assert bench.phases == [IDLE, IDLE]
    assert bench.agent.lifecycle.reason == ["never heard centre"] * 2
    assert bench.agent.missing_neighbours(0) == ["centre"]
    bench.told([0], [[0.0, 0.0, 0.0]])
    bench.step()
    assert bench.phases == [READY, IDLE]
    assert bench.agent.missing_neighbours(0) == []


def test_without_a_centre_it_goes_on_after_the_deadline_where_the_file_says_so():
    bench = Bench(pair(start=Start(deadline_s=0.05, missing="go-on"))).step(5)
    assert bench.phases == [IDLE, IDLE]
    assert bench.step(2).phases == [READY, READY]


def test_nothing_is_pursued_before_the_start():
    bench = Bench(pair())
    bench.told([0, 1], [[1.0, 0.0, 0.0], [1.0, 0.0, 0.8]])
    bench.step()
    assert bench.agent.lifecycle.takeoff(0) == bench.agent.lifecycle.takeoff(1) == ""
    bench.step(200)
    assert bench.phases == [AIRBORNE, AIRBORNE]
    np.testing.assert_array_equal(bench.agent.goal, [[-0.4, 0.0, 0.0], [0.4, 0.1, 0.8]])
    assert bench.agent.updates.tolist() == [0, 0]


def test_a_goal_is_pursued_on_the_tick_on_which_it_comes():
    bench = Bench(pair()).running().step(3)  # no decision falls on the next tick
    before = bench.agent.updates.copy()
    assert bench.told([0, 1], [[-0.3, 0.1, 0.7], [0.5, 0.2, 0.7]], toward=0.5).all()
    bench.step()
    np.testing.assert_array_equal(bench.agent.goal, [[-0.3, 0.1, 0.0], [0.5, 0.2, 0.7]])  # the Khepera has no height
    assert bench.agent.goal_yaw.tolist() == [0.5, 0.5]
    np.testing.assert_array_equal(bench.actions.setpoint[1], [0.5, 0.2, 0.7, 0.5])
    assert (bench.agent.updates - before).tolist() == [1, 1]
    bench.step(5)
    assert (bench.agent.updates - before).tolist() == [1, 1]  # one goal is one update


def test_older_goals_and_those_of_nobody_are_left_out():
    bench = Bench(pair()).running()
    assert bench.told([0, 1], [[0.1, 0.0, 0.0], [NAN, 0.0, 0.8]]).tolist() == [True, False]
    assert not bench.told([0], [[0.2, 0.0, 0.0]], stamp=bench.t - 0.1).any()
    assert not bench.told([0], [[0.2, 0.0, 0.0]]).any()  # the same instant once more
    bench.step()
    np.testing.assert_array_equal(bench.agent.goal[0], [0.1, 0.0, 0.0])


def test_an_old_goal_is_none_and_the_robot_stays_where_it_is_then():
    bench = Bench(pair()).running()
    at = bench.t
    bench.told([0, 1], [[-0.3, 0.1, 0.0], [0.5, 0.2, 0.8]])
    bench.step(50)
    bench.position[0, 0] = -0.35
    bench.told([1], [[0.5, 0.25, 0.8]])
    while bench.t <= at + 1.0 + 1e-9:
        np.testing.assert_array_equal(bench.agent.goal[0], [-0.3, 0.1, 0.0])
        bench.step()
    bench.step()
    np.testing.assert_array_equal(bench.agent.goal, [[-0.35, 0.0, 0.0], [0.5, 0.25, 0.8]])  # the other has a fresh one
    assert np.isnan(bench.agent.goal_yaw[0])
    bench.position[0] = [-0.34, 0.01, 0.0]
    bench.step(5)
    np.testing.assert_array_equal(bench.agent.goal[0], [-0.35, 0.0, 0.0])  # drift does not move the place
    bench.told([0], [[-0.2, 0.1, 0.0]])
    bench.step()
    np.testing.assert_array_equal(bench.agent.goal[0], [-0.2, 0.1, 0.0])


def test_a_dead_centre_stops_all_that_it_guides_at_once():
    bench = Bench(pair()).running()
    bench.told([0, 1], [[-0.3, 0.1, 0.0], [0.5, 0.2, 0.8]])
    bench.step()
    bench.agent.guidance.mark_lost(bench.t)
    bench.step()
    np.testing.assert_array_equal(bench.agent.goal, bench.position)
    assert bench.agent.missing_neighbours(1) == ["centre"]
    assert bench.phases == [RUNNING, RUNNING]
    bench.agent.guidance.mark_alive()
    bench.step()  # back in time: the last goal is still young
    np.testing.assert_array_equal(bench.agent.goal, [[-0.3, 0.1, 0.0], [0.5, 0.2, 0.8]])
    bench.agent.guidance.mark_lost(bench.t)
    bench.step()
    bench.told([0], [[-0.25, 0.1, 0.0]])  # whoever is heard is there
    bench.step()
    np.testing.assert_array_equal(bench.agent.goal, [[-0.25, 0.1, 0.0], [0.5, 0.2, 0.8]])


def test_orders_are_obeyed_whatever_the_centre_says():
    bench = Bench(pair()).running()
    assert bench.agent.hold(0) == ""
    bench.told([0, 1], [[-0.3, 0.1, 0.0], [0.5, 0.2, 0.8]])
    bench.step()
    np.testing.assert_array_equal(bench.agent.goal, [[-0.4, 0.0, 0.0], [0.5, 0.2, 0.8]])
    assert bench.agent.start(0, 0.0) == ""
    bench.step()
    np.testing.assert_array_equal(bench.agent.goal[0], [-0.3, 0.1, 0.0])
    bench.agent.lifecycle.land(1, "told to")
    bench.told([1], [[0.6, 0.2, 0.8]])
    bench.step()
    assert bench.phases == [RUNNING, LANDING]
    assert np.isnan(bench.actions.setpoint[1]).all()


def test_cut_off_from_the_network_it_holds():
    bench = Bench(pair()).running()
    bench.agent.health.offline_since = bench.t
    bench.step(50)
    bench.told([0, 1], [[-0.3, 0.1, 0.0], [0.5, 0.2, 0.8]])  # the last that came through
    bench.step(50)
    np.testing.assert_array_equal(bench.agent.goal[0], [-0.3, 0.1, 0.0])
    bench.step(2)
    np.testing.assert_array_equal(bench.agent.goal, bench.position)


def test_safety_has_the_last_word_on_goals_too():
    bench = Bench(pair()).running()
    bench.told([1], [[3.0, 0.1, 0.8]])
    bench.step()
    assert bench.actions.changed.tolist() == [False, True]
    assert bench.actions.setpoint[1, 0] == pytest.approx(0.9)  # goal_step from where it is


def test_who_is_guided_listens_to_nobody_but_to_keep_clear():
    assert len(Plan(pair()).assignment(["A", "B"]).links) == 0
    told = Plan(pair(avoidance={"kind": "barrier", "hears": "neighbours"})).assignment(["A"])
    assert told.avoidance_only.tolist() == [True]
    assert told.robots[told.links.sender[0]] == "B"


def test_in_a_hybrid_only_the_others_have_a_law_of_their_own():
    hybrid = pair(architecture=Hybrid(kind="hybrid", robots=["B"]))
    told = Plan(hybrid).assignment(["A", "B"])
    assert told.guided.tolist() == [False, True]
    assert told.links.receiver.tolist() == [0]
    assert told.links.sender.tolist() == [1]
    assert Agent(Plan(hybrid).assignment(["A"])).guidance is None  # whoever decides for himself takes no goals


def test_rows_are_guided_each_for_itself():
    guided, flies = np.array([True, False, True]), np.array([False, True, True])
    many, one = Guidance(guided, flies, 1.0), Guidance(np.array([True]), np.array([True]), 1.0)
    rng = np.random.default_rng(7)
    for t in rng.uniform(0.0, 5.0, 40):
        goal = rng.normal(size=(3, 3))
        many.receive(np.array([0, 1, 2]), goal, np.zeros(3), np.full(3, t))
        one.receive(np.array([0]), goal[2:], np.zeros(1), np.array([t]))
        np.testing.assert_array_equal(many.goal[2], one.goal[0])
        for now in (t, t + 0.7, t + 2.0):
            assert many.unguided(now)[2] == one.unguided(now)[0]
    assert np.isnan(many.goal[1]).all()
    assert not many.unguided(99.0)[1]
