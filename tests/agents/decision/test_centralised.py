"""The centre: the same decision as the robots', from what they said."""

import msgspec
import numpy as np
import pytest

from agents.agent import Agent
from agents.body.interface import BodyState
from agents.decision.centralised import Centre
from agents.decision.lifecycle import AIRBORNE, DONE, IDLE, RUNNING
from experiments.definition.experiment import Hybrid
from experiments.definition.plan import Plan
from experiments.file import document
from tests.agents.things import poses

NAN = np.nan


@pytest.fixture(scope="module")
def park():
    return document.read("robotic-park").cases()["event"]


def replaced(experiment, **parts):
    return msgspec.structs.replace(experiment, **parts)


class Desk:
    """A centre, and poses to tell it."""

    def __init__(self, experiment, copies=1, seed=3):
        self.centre = Centre(Plan(experiment).assignment(copies=copies, centrally=True))
        self.centre.mark_alive(self.centre.needed)
        self.rows = len(self.centre.guided)
        rng = np.random.default_rng(seed)
        one = rng.uniform(-0.8, 0.8, (self.rows // copies, 3))
        self.position = np.tile(one, (copies, 1))
        self.phase, self.start = np.full(self.rows, RUNNING), np.zeros(self.rows)

    def hear(self, rows, t, position=None, stamp=None):
        rows = np.array(rows, dtype=np.intp)
        place = self.position[rows] if position is None else np.array(position, dtype=float)
        stamps = np.full(len(rows), t) if stamp is None else np.array(stamp, dtype=float)
        self.centre.receive(
            poses(rows, place, np.zeros((len(rows), 3)), stamps, np.full(len(rows), t), yaw=np.zeros(len(rows)))
        )

    def decide(self, t):
        return self.centre.decide(t, self.phase, self.start)


@pytest.mark.parametrize("update", [None, {"kind": "send-on-delta", "threshold": 0.08}])
def test_it_decides_what_the_robots_would_to_the_last_bit(park, update):
    formation = msgspec.structs.replace(park.formation, update=update)
    park = replaced(park, formation=formation, duration_s=5.0, timeline=[])
    desk = Desk(replaced(park, architecture="centralised"))
    agent = Agent(Plan(park).assignment(tuple(park.robots)))
    links, rng = agent.assignment.links, np.random.default_rng(1)
    agent.neighbours.mark_alive(np.arange(len(links)))
    agent.lifecycle.phase[:] = AIRBORNE
    agent.lifecycle.start_at[:] = 0.0
    still, place = np.zeros((7, 3)), desk.position.copy()
    place[:, 2] = desk.centre.goal_computer.ground
    sent = 0
    for tick in range(100):
        t = 0.01 * tick
        if tick % 10 == 0:
            place[:, :2] += rng.normal(0.0, 0.02, (7, 2))
            agent.neighbours.receive(poses(np.arange(len(links)), place[links.sender], still[links.sender],
                       np.full(len(links), t), np.full(len(links), t)))  # fmt: skip
            desk.hear(range(7), t, place)
            told = desk.decide(t)
            sent += len(told.rows)
            np.testing.assert_array_equal(told.pose_stamp, np.full(len(told.rows), t))
        state = BodyState(
            time=np.full(7, t), position=place.copy(), velocity=still, yaw=np.zeros(7), battery=np.full(7, NAN),
            flying=desk.centre.goal_computer.ground > 0, true_position=place.copy(), true_yaw=np.zeros(7),
        )  # fmt: skip
        agent.step(t, state)
        np.testing.assert_array_equal(desk.centre.goal, agent.goal)
    np.testing.assert_array_equal(desk.centre.updates, agent.updates)
    assert desk.centre.decisions == agent.decisions == 10
    assert sent == 70 if update is None else 20 < sent < 55


def test_goals_that_stay_are_said_again_before_they_are_too_old(park):
    formation = msgspec.structs.replace(park.formation, update={"kind": "periodic", "period_s": 60.0})
    desk = Desk(replaced(park, formation=formation, architecture="centralised"))
    desk.hear(range(7), 0.0)
    told = {tick: desk.decide(0.1 * tick) for tick in range(13)}
    followers = [len(set(each.rows.tolist()) - {0}) for each in told.values()]
    assert followers == [6, 0, 0, 0, 0, 6, 0, 0, 0, 0, 6, 0, 0]  # every half of link_silence_s
    assert set(told[10].pose_stamp[1:].tolist()) == {0.0}  # they rest on what was known when they were computed


def test_older_poses_that_come_late_are_left_out(park):
    desk = Desk(replaced(park, architecture="centralised"))
    desk.hear([1, 2, 1], 1.0, [[0.3, 0, 0], [0.2, 0, 0], [0.1, 0, 0]], [0.9, 0.9, 0.8])  # the first one is newer
    np.testing.assert_array_equal(desk.centre.poses.position[[1, 2], 0], [0.3, 0.2])
    desk.hear([1], 1.1, [[0.7, 0, 0]], [0.85])
    assert desk.centre.poses.position[1, 0] == 0.3
    links = desk.centre.assignment.links
    heard = desk.centre.goal_computer.neighbours.poses
    assert set(heard.position[links.sender == 1, 0].tolist()) == {0.3}
    assert set(heard.stamp[links.sender == 1].tolist()) == {0.9}


def test_who_waits_is_told_to_stay_once_all_his_neighbours_were_heard(park):
    desk = Desk(replaced(park, architecture="centralised"))
    desk.phase[:], desk.start[:] = IDLE, np.inf
    assert len(desk.decide(0.0).rows) == 0
    assert desk.centre.missing_robots().tolist() == list(range(7))
    desk.hear([0, 1, 2, 3, 5], 0.1)  # CF01 listens to CF03, whom nobody heard; so does CF02
    assert desk.decide(0.1).rows.tolist() == [0, 2, 3]  # KH01 (1) needs CF01
    desk.hear([4, 6], 0.2)
    told = desk.decide(0.2)
    assert told.rows.tolist() == list(range(7))
    wanted = desk.position.copy()
    wanted[:, 2] = desk.centre.goal_computer.ground
    np.testing.assert_array_equal(told.goal, wanted)
    assert desk.centre.decisions == 0
    desk.phase[:], desk.start[:] = AIRBORNE, 0.3
    np.testing.assert_array_equal(desk.decide(0.2999).goal, wanted)
    assert desk.decide(0.3).rows.tolist() == list(range(7))
    assert desk.centre.decisions == 1  # it begins with the robots, though none has said yet that it runs


def test_who_is_gone_gets_no_goals_and_his_neighbours_go_on_without_him(park):
    desk = Desk(replaced(park, architecture="centralised"))
    desk.hear(range(7), 0.0)
    assert desk.decide(0.0).rows.tolist() == list(range(7))
    desk.centre.mark_lost(np.array([6]), 0.1)
    assert desk.decide(0.1).rows.tolist() == list(range(6))
    live = desk.centre.goal_computer.neighbours
    assert 6 in desk.centre.assignment.links.sender[live.active]
    desk.decide(1.2)
    assert 6 not in desk.centre.assignment.links.sender[live.active]
    assert desk.centre.missing_robots().tolist() == [6]
    desk.centre.mark_alive(np.array([6]))
    assert desk.decide(1.3).rows.tolist() == list(range(7))


def test_who_has_lost_all_his_neighbours_stays_where_he_was_then(park):
    desk = Desk(replaced(park, architecture="centralised"))
    desk.hear(range(7), 0.0)
    desk.decide(0.0)
    desk.centre.mark_lost(np.array([4, 5]), 0.0)  # CF03 hears nobody else
    at = desk.position[6].copy()
    told = desk.decide(1.1)
    at[2] = 0.8
    np.testing.assert_array_equal(told.goal[told.rows == 6], [at])
    desk.hear([6], 1.15, at[None] + 0.05)
    told = desk.decide(1.2)
    np.testing.assert_array_equal(told.goal[told.rows == 6], [at])


def test_a_hybrid_listens_to_those_who_matter_and_guides_its_own(park):
    desk = Desk(replaced(park, architecture=Hybrid(kind="hybrid", robots=["CF03", "KH02"])))
    names = np.array(list(park.robots))
    assert names[desk.centre.guided].tolist() == ["KH02", "CF03"]
    assert names[desk.centre.needed].tolist() == ["KH01", "KH02", "KH03", "CF01", "CF02", "CF03"]  # not the leader
    desk.hear(desk.centre.needed, 0.0)
    assert names[desk.decide(0.0).rows].tolist() == ["KH02", "CF03"]
    desk.phase[6] = DONE
    assert names[desk.decide(0.1).rows].tolist() == ["KH02"]


def test_copies_know_nothing_of_each_other(park):
    park = replaced(park, architecture="centralised")
    alone, many = Desk(park), Desk(park, copies=3)
    rng = np.random.default_rng(5)
    for tick in range(30):
        t = 0.1 * tick
        place, others = rng.uniform(-0.8, 0.8, (7, 3)), rng.uniform(-0.8, 0.8, (14, 3))
        rows = np.flatnonzero(rng.random(7) < 0.6)
        alone.hear(rows, t, place[rows])
        far = np.flatnonzero(rng.random(14) < 0.6)
        many.hear([*rows + 7, *np.where(far < 7, far, far + 7)], t, [*place[rows], *others[far]])
        one, all_of_them = alone.decide(t), many.decide(t)
        mine = (all_of_them.rows >= 7) & (all_of_them.rows < 14)
        np.testing.assert_array_equal(all_of_them.rows[mine] - 7, one.rows)
        np.testing.assert_array_equal(all_of_them.goal[mine], one.goal)
        np.testing.assert_array_equal(all_of_them.pose_stamp[mine], one.pose_stamp)
    assert len(one.rows) == 7


def test_plans_begin_where_the_robots_did_though_the_centre_came_later(park):
    park = replaced(park, architecture="centralised")  # the leader drives 0.75 m from 21 s on, at 0.15 m/s
    first, second = Desk(park), Desk(park)
    first.hear(range(7), 0.0)
    first.decide(0.0)
    first.hear([0], 23.0, [first.position[0] + [0.2, 0.0, 0.0]])
    second.centre.begin_plan(0, (*first.position[0, :2].tolist(), 0.0, 0.0))
    second.hear([*range(1, 7)], 23.0)
    assert 0 not in second.decide(22.9).rows  # where it is, nobody knows
    second.hear([0], 23.0, [first.position[0] + [0.2, 0.0, 0.0]])
    for desk in (first, second):
        told = desk.decide(23.0)
        goal = told.goal[told.rows == 0]
        np.testing.assert_allclose(goal[0, :2] - first.position[0, :2], [0.3, 0.0], atol=1e-12)


def test_who_was_not_heard_in_time_begins_his_plan_when_he_is(park):
    desk = Desk(replaced(park, architecture="centralised"))
    desk.hear(range(1, 7), 0.0)
    assert 0 not in desk.decide(0.0).rows
    desk.hear([0], 0.1)
    told = desk.decide(0.1)
    np.testing.assert_array_equal(told.goal[told.rows == 0][0, :2], desk.position[0, :2])
