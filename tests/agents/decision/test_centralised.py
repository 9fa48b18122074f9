"""The central controller: the same decision as the robots', from what they transmitted."""

from math import inf, isnan

import msgspec
import numpy as np
import pytest

from agents.body.interface import BodyState
from agents.decision.centralised import Centre
from agents.decision.lifecycle import AIRBORNE, DONE, IDLE, RUNNING
from agents.robot import Robot
from experiments.definition.experiment import Hybrid
from experiments.definition.plan import Plan
from tests.small import changed, reference

STILL = (0.0, 0.0, 0.0)
ALL = list(range(7))  # TB01, the leader, then KH01 to KH03 and CF01 to CF03


PARK = reference("event")


class Desk:
    """A central controller, and poses to tell it."""

    def __init__(self, experiment):
        plan = Plan(experiment)
        self.names = plan.names
        self.centre = Centre([plan.assignment(name, centrally=True) for name in plan.names])
        for row in self.centre.needed:
            self.centre.mark_alive(row)
        self.places = [tuple(row) for row in np.random.default_rng(3).uniform(-0.8, 0.8, (7, 3)).tolist()]
        self.phase, self.start = [RUNNING] * 7, [0.0] * 7

    def ground(self, row):
        return self.centre.assignments[row].ground

    def hear(self, rows, t, places=None, stamp=None):
        for row in rows:
            place = (self.places if places is None else places)[row]
            self.centre.receive(row, place, STILL, t if stamp is None else stamp, t, yaw=0.0)

    def seen_as(self, row):
        """A robot as each of its receivers knows it."""
        known = (sender for robot in self.centre.robots for sender in robot.computer.neighbours.all)
        return [sender for sender in known if sender.sender == row]

    def decide(self, t):
        """Goals by row."""
        return {goal.row: goal for goal in self.centre.decide(t, self.phase, self.start)}


def central(**parts):
    return Desk(changed(PARK, architecture="centralised", **parts))


@pytest.mark.parametrize("update", [None, {"kind": "send-on-delta", "threshold": 0.08}])
def test_decides_what_robots_would(update):
    formation = msgspec.structs.replace(PARK.formation, update=update)
    parts = {"formation": formation, "duration_s": 5.0, "timeline": []}
    desk, plan, rng = central(**parts), Plan(changed(PARK, **parts)), np.random.default_rng(1)
    robots = [Robot(plan.assignment(name)) for name in plan.names]
    places, sent = [(x, y, desk.ground(row)) for row, (x, y, _) in enumerate(desk.places)], 0
    for robot in robots:
        robot.lifecycle.phase, robot.lifecycle.start_at = AIRBORNE, 0.0
        for link in range(len(robot.neighbours.all)):
            robot.neighbours.mark_alive(link)
    for tick in range(100):
        t = 0.01 * tick
        if tick % 10 == 0:
            steps = rng.normal(0.0, 0.02, (7, 2)).tolist()
            places = [(x + a, y + b, z) for (x, y, z), (a, b) in zip(places, steps, strict=True)]
            for robot in robots:
                for link, sender in enumerate(robot.neighbours.all):
                    robot.neighbours.receive(link, places[sender.sender], STILL, t, t)
            desk.hear(ALL, t, places)
            goals = desk.decide(t)
            sent += len(goals)
            assert {goal.pose_stamp for goal in goals.values()} <= {t}
        for robot, place, followed in zip(robots, places, desk.centre.robots, strict=True):
            robot.transmit(t, BodyState(t, place, STILL, 0.0, flying=robot.assignment.kind.flies))
            robot.act(t)
            assert followed.goal == robot.goal
    assert [each.updates for each in desk.centre.robots] == [robot.updates for robot in robots]
    assert desk.centre.decisions == robots[0].decisions == 10
    assert sent == 70 if update is None else 20 < sent < 55


def test_goals_that_stay_are_repeated():
    formation = msgspec.structs.replace(PARK.formation, update={"kind": "periodic", "period_s": 60.0})
    desk = central(formation=formation)
    desk.hear(ALL, 0.0)
    goals = [desk.decide(0.1 * tick) for tick in range(13)]
    followers = [len(each.keys() - {0}) for each in goals]
    assert followers == [6, 0, 0, 0, 0, 6, 0, 0, 0, 0, 6, 0, 0]  # every half of neighbour_timeout_s
    assert {goals[10][row].pose_stamp for row in ALL[1:]} == {0.0}  # they rest on what was known at the computation


def test_late_older_poses_are_left_out():
    desk = central()
    for x, stamp in ((0.3, 0.9), (0.1, 0.8), (0.7, 0.85)):
        desk.hear([1], 1.0, {1: (x, 0.0, 0.0)}, stamp)
    assert desk.centre.robots[1].position == (0.3, 0.0, 0.0)
    found = {(sender.position, sender.stamp) for sender in desk.seen_as(1)}
    assert found == {((0.3, 0.0, 0.0), 0.9)}


def test_waiting_robot_stays_once_neighbours_are_known():
    desk = central()
    desk.phase, desk.start = [IDLE] * 7, [inf] * 7
    assert desk.decide(0.0) == {}
    assert desk.centre.missing_robots() == ALL
    desk.hear([0, 1, 2, 3, 5], 0.1)  # CF01 receives CF03, which is unknown; so does CF02
    assert list(desk.decide(0.1)) == [0, 2, 3]  # KH01 (1) needs CF01
    desk.hear([4, 6], 0.2)
    wanted = {row: (*desk.places[row][:2], desk.ground(row)) for row in ALL}
    assert {row: goal.goal for row, goal in desk.decide(0.2).items()} == wanted
    assert desk.centre.decisions == 0
    desk.phase, desk.start = [AIRBORNE] * 7, [0.3] * 7
    assert {row: goal.goal for row, goal in desk.decide(0.2999).items()} == wanted
    assert list(desk.decide(0.3)) == ALL
    assert desk.centre.decisions == 1  # it begins with the robots, though none has said yet that it runs


def test_lost_robot_gets_no_goals():
    desk = central()
    desk.hear(ALL, 0.0)
    assert list(desk.decide(0.0)) == ALL
    desk.centre.mark_lost(6, 0.1)
    assert list(desk.decide(0.1)) == ALL[:6]

    assert any(sender.active for sender in desk.seen_as(6))
    desk.decide(1.2)
    assert not any(sender.active for sender in desk.seen_as(6))  # its neighbours go on without it
    assert desk.centre.missing_robots() == [6]
    desk.centre.mark_alive(6)
    assert list(desk.decide(1.3)) == ALL


def test_robot_without_neighbours_stays():
    desk = central()
    desk.hear(ALL, 0.0)
    desk.decide(0.0)
    for row in (4, 5):  # CF03 receives nobody else
        desk.centre.mark_lost(row, 0.0)
    x, y, z = desk.places[6]
    assert desk.decide(1.1)[6].goal == (x, y, 0.8)
    desk.hear([6], 1.15, {6: (x + 0.05, y + 0.05, z)})
    assert desk.decide(1.2)[6].goal == (x, y, 0.8)


def test_hybrid_guides_its_robots_alone():
    desk = Desk(changed(PARK, architecture=Hybrid(kind="hybrid", robots=["CF03", "KH02"])))
    needed = [desk.names[row] for row in desk.centre.needed]
    assert needed == ["KH01", "KH02", "KH03", "CF01", "CF02", "CF03"]  # not the leader
    desk.hear(desk.centre.needed, 0.0)
    assert [desk.names[row] for row in desk.decide(0.0)] == ["KH02", "CF03"]
    desk.phase[6] = DONE
    assert [desk.names[row] for row in desk.decide(0.1)] == ["KH02"]


def test_plans_begin_where_the_robots_did():
    first, second = central(), central()  # the leader drives 0.75 m from 21 s on, at 0.15 m/s
    (x, y, z) = first.places[0]
    first.hear(ALL, 0.0)
    first.decide(0.0)
    second.centre.begin_plan(0, (x, y, 0.0, 0.0))  # this one came later
    second.hear(ALL[1:], 23.0)
    assert 0 not in second.decide(22.9)  # nothing is known of its place
    for desk in (first, second):
        desk.hear([0], 23.0, {0: (x + 0.2, y, z)})
        goal = desk.decide(23.0)[0].goal
        assert (goal[0] - x, goal[1] - y) == pytest.approx((0.3, 0.0), abs=1e-12)


def test_late_robot_begins_its_plan_then():
    desk = central()
    desk.hear(ALL[1:], 0.0)
    assert 0 not in desk.decide(0.0)
    desk.hear([0], 0.1)
    goal = desk.decide(0.1)[0]
    assert goal.goal[:2] == desk.places[0][:2]
    assert isnan(goal.yaw)
    desk.centre.discard_pose(1)  # restarted: it waits for a pose
    assert 1 not in desk.decide(0.2)
    desk.hear([1], 0.3, stamp=-50.0)  # its clock may be behind that of its former process
    assert 1 in desk.decide(0.3)
