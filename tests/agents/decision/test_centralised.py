"""The central controller decides as robots would, of what they transmitted; guided robots pursue its goals."""

from math import inf, isnan, nan

import numpy as np
import pytest

from agents.body.interface import BodyState
from agents.decision.centralised import Centre, ReceivedGoals
from agents.decision.lifecycle import AIRBORNE, DONE, IDLE, LANDING, READY, RUNNING
from agents.robot import Robot
from agents.vectors import ZERO
from experiments.definition.experiment import Formation, Hybrid, RobotTable, Start
from experiments.definition.plan import Plan
from tests.agents.bench import Bench
from tests.small import changed, reference, small

ALL = list(range(7))  # TB01, the leader, then KH01 to KH03 and CF01 to CF03
PARK = reference("event")


class Desk:
    def __init__(self, update=None, **parts):
        formation = changed(PARK.formation, update=update)
        plan = Plan(changed(PARK, formation=formation, **{"architecture": "centralised", **parts}))
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
            self.centre.receive(row, place, ZERO, t if stamp is None else stamp, t, yaw=0.0)

    def seen_as(self, row):
        """A robot as each of its receivers knows it."""
        known = (sender for robot in self.centre.robots for sender in robot.computer.neighbours.all)
        return [sender for sender in known if sender.sender == row]

    def decide(self, t):
        """Goals by row."""
        return {goal.row: goal for goal in self.centre.decide(t, self.phase, self.start)}


@pytest.mark.parametrize("update", [None, {"kind": "send-on-delta", "threshold": 0.08}])
def test_decides_what_robots_would(update):
    parts = {"duration_s": 5.0, "timeline": []}
    desk, rng = Desk(update, **parts), np.random.default_rng(1)
    plan = Plan(changed(PARK, formation=changed(PARK.formation, update=update), **parts))
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
                    robot.neighbours.receive(link, places[sender.sender], ZERO, t, t)
            desk.hear(ALL, t, places)
            goals = desk.decide(t)
            sent += len(goals)
            assert {goal.pose_stamp for goal in goals.values()} <= {t}
        for robot, place, followed in zip(robots, places, desk.centre.robots, strict=True):
            robot.transmit(t, BodyState(t, place, ZERO, 0.0, flying=robot.assignment.kind.flies))
            robot.act(t)
            assert followed.goal == robot.goal
    assert [each.updates for each in desk.centre.robots] == [robot.updates for robot in robots]
    assert desk.centre.decisions == robots[0].decisions == 10
    assert sent == 70 if update is None else 20 < sent < 55


def test_goals_that_stay_are_repeated():
    desk = Desk({"kind": "periodic", "period_s": 60.0})
    desk.hear(ALL, 0.0)
    goals = [desk.decide(0.1 * tick) for tick in range(13)]
    followers = [len(each.keys() - {0}) for each in goals]
    assert followers == [6, 0, 0, 0, 0, 6, 0, 0, 0, 0, 6, 0, 0]  # every half of neighbour_timeout_s
    assert {goals[10][row].pose_stamp for row in ALL[1:]} == {0.0}  # they rest on what was known at the computation


def test_late_older_poses_are_left_out():
    desk = Desk()
    for x, stamp in ((0.3, 0.9), (0.1, 0.8), (0.7, 0.85)):
        desk.hear([1], 1.0, {1: (x, 0.0, 0.0)}, stamp)
    assert desk.centre.robots[1].position == (0.3, 0.0, 0.0)
    assert {(sender.position, sender.stamp) for sender in desk.seen_as(1)} == {((0.3, 0.0, 0.0), 0.9)}


def test_waiting_robot_stays_once_neighbours_are_known():
    desk = Desk()
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


def test_lost_robot_gets_no_goals_others_stay():
    desk = Desk()
    desk.hear(ALL, 0.0)
    assert list(desk.decide(0.0)) == ALL
    desk.centre.mark_lost(5, 0.1)
    assert list(desk.decide(0.1)) == [0, 1, 2, 3, 4, 6]
    assert any(sender.active for sender in desk.seen_as(5))
    desk.decide(1.2)
    assert not any(sender.active for sender in desk.seen_as(5))  # its neighbours go on without it
    assert desk.centre.missing_robots() == [5]
    desk.centre.mark_lost(4, 0.1)
    x, y, z = desk.places[6]  # CF03 receives nobody else
    assert desk.decide(1.3)[6].goal == (x, y, 0.8)
    desk.hear([6], 1.35, {6: (x + 0.05, y + 0.05, z)})
    assert desk.decide(1.4)[6].goal == (x, y, 0.8)
    desk.centre.mark_alive(4)
    desk.centre.mark_alive(5)
    assert list(desk.decide(1.5)) == ALL


def test_hybrid_guides_its_robots_alone():
    desk = Desk(architecture=Hybrid(kind="hybrid", robots=["CF03", "KH02"]))
    needed = [desk.names[row] for row in desk.centre.needed]
    assert needed == ["KH01", "KH02", "KH03", "CF01", "CF02", "CF03"]  # not the leader
    desk.hear(desk.centre.needed, 0.0)
    assert [desk.names[row] for row in desk.decide(0.0)] == ["KH02", "CF03"]
    desk.phase[6] = DONE
    assert [desk.names[row] for row in desk.decide(0.1)] == ["KH02"]


def test_plans_begin_where_the_robots_did():
    first, second = Desk(), Desk()  # the leader drives 0.75 m from 21 s on, at 0.15 m/s
    (x, y, z) = first.places[0]
    first.hear(ALL, 0.0)
    assert isnan(first.decide(0.0)[0].yaw)
    second.centre.begin_plan(0, (x, y, 0.0, 0.0))  # this one came later
    second.hear(ALL[1:], 23.0)
    assert 0 not in second.decide(22.9)  # nothing is known of its place
    for desk in (first, second):
        desk.hear([0], 23.0, {0: (x + 0.2, y, z)})
        goal = desk.decide(23.0)[0].goal
        assert (goal[0] - x, goal[1] - y) == pytest.approx((0.3, 0.0), abs=1e-12)
    second.centre.discard_pose(1)  # restarted: it waits for a pose
    assert 1 not in second.decide(23.1)
    second.hear([1], 23.2, stamp=-50.0)  # its clock may be behind that of its former process
    assert 1 in second.decide(23.2)


PLACES = {"A": (-0.4, 0.0, 0.0), "B": (0.4, 0.1, 0.8)}


def led(**parts):
    """A Khepera and a Crazyflie that receive each other, guided by a central controller; `parts` changes that."""
    robots = {
        name: RobotTable(kind=kind, start=[*PLACES[name][:2]], hover=hover)
        for name, kind, hover in (("A", "khepera4", None), ("B", "crazyflie", 0.8))
    }
    return Plan(small(robots, {"A - B": 0.9}, **{"duration_s": 60.0, "architecture": "centralised", **parts}))


def guided(name="A", **parts):
    return Bench(led(**parts).assignment(name), PLACES[name])


def guide(bench, goal=None, yaw=nan):
    """Receive a goal; returns whether it is new."""
    return bench.robot.guidance.receive(goal or bench.position, yaw, bench.t)


def running(name="A", **parts):
    return guided(name, **parts).running(guide)


def test_ready_once_the_centre_is_known():
    bench = guided().step()
    assert (bench.life.phase, bench.life.reason) == (IDLE, "never received centre")
    assert bench.robot.missing_neighbours() == ["centre"]
    guide(bench)
    assert bench.step().life.phase == READY
    assert bench.robot.missing_neighbours() == []
    patient = guided(start=Start(deadline_s=0.05, missing="go-on")).step(0.05)
    assert patient.life.phase == IDLE
    assert patient.step(0.02).life.phase == READY


@pytest.mark.parametrize(("name", "height"), [("A", 0.0), ("B", 0.7)])  # on wheels there is none
def test_goal_is_pursued_on_its_tick(name, height):
    early = guided(name)
    guide(early, (1.0, 0.0, 0.8))
    early.step()
    assert early.life.takeoff() == ""
    assert early.step(2.0).life.phase == AIRBORNE
    assert (early.robot.goal, early.robot.updates) == (PLACES[name], 0)  # nothing is pursued before the start
    bench = running(name).step(0.03)  # no decision falls on the next tick
    robot, before = bench.robot, bench.robot.updates
    x, y, _ = bench.position
    assert guide(bench, (x + 0.1, y + 0.1, 0.7), 0.5)
    bench.step()
    assert (robot.goal, robot.goal_yaw) == ((x + 0.1, y + 0.1, height), 0.5)
    assert name == "A" or robot.setpoint == (*robot.goal, 0.5)
    bench.step(0.05)
    assert robot.updates - before == 1  # one goal is one update


def test_older_and_unknown_goals_are_left_out():
    guidance, here = ReceivedGoals(flies=True, silence_s=1.0), (0.1, 0.0, 0.5)
    assert guidance.missing
    assert guidance.receive(here, nan, 4.0)
    for goal, stamp in (((nan, 0.0, 0.0), 5.0), (ZERO, 3.9), (ZERO, 4.0)):  # unknown, older, once more
        assert not guidance.receive(goal, nan, stamp)
    assert guidance.goal == here
    guidance.mark_lost(4.5)
    assert guidance.unguided(4.6)
    assert guidance.receive(ZERO, nan, 4.7)
    assert guidance.lost_since == inf
    guidance.begin_anew()  # another controller
    assert guidance.receive(ZERO, nan, -3.0)  # its clock is behind


def test_old_goal_makes_it_stay():
    bench = running()
    at = bench.t
    guide(bench, (-0.3, 0.1, 0.0), 0.3)
    bench.step(0.5).position = (-0.35, 0.0, 0.0)
    while bench.t <= at + 1.0 + 1e-9:
        assert bench.robot.goal == (-0.3, 0.1, 0.0)
        bench.step()
    bench.step()
    assert bench.robot.goal == (-0.35, 0.0, 0.0)
    assert isnan(bench.robot.goal_yaw)
    bench.position = (-0.34, 0.01, 0.0)
    assert bench.step(0.05).robot.goal == (-0.35, 0.0, 0.0)  # drift does not move the place
    guide(bench, (-0.2, 0.1, 0.0))
    assert bench.step().robot.goal == (-0.2, 0.1, 0.0)


@pytest.mark.parametrize("name", PLACES)
def test_dead_centre_stops_at_once(name):
    bench = running(name)
    x, y, z = bench.position
    goal = (x + 0.1, y + 0.1, z)
    guide(bench, goal)
    bench.step().robot.guidance.mark_lost(bench.t)
    assert bench.step().robot.goal == bench.position
    assert (bench.robot.missing_neighbours(), bench.life.phase) == (["centre"], RUNNING)
    bench.robot.guidance.mark_alive()
    assert bench.step().robot.goal == goal  # back in time: the last goal is still young
    bench.robot.guidance.mark_lost(bench.t)
    bench.step()
    guide(bench, (x + 0.05, y + 0.1, z))  # who is received is there
    assert bench.step().robot.goal == (x + 0.05, y + 0.1, z)


def test_orders_and_a_lost_network_come_before_goals():
    bench = running()
    assert bench.robot.hold() == ""
    guide(bench, (-0.3, 0.1, 0.0))
    assert bench.step().robot.goal == (-0.4, 0.0, 0.0)
    assert bench.robot.start(0.0) == ""
    assert bench.step().robot.goal == (-0.3, 0.1, 0.0)
    bench.robot.health.offline_since = bench.t
    bench.step(0.5)
    guide(bench, (-0.3, 0.2, 0.0))  # the last that came through
    assert bench.step(0.5).robot.goal == (-0.3, 0.2, 0.0)
    assert bench.step(0.02).robot.goal == bench.position
    drone = running("B")
    drone.life.land("told to")
    guide(drone, (0.6, 0.2, 0.8))
    assert drone.step().life.phase == LANDING
    assert isnan(drone.robot.setpoint[0])


def test_guided_robots_leave_the_law_to_others():
    avoids = led(avoidance={"kind": "barrier", "hears": "neighbours"}).assignment("A")
    assert [(each.name, each.in_law) for each in avoids.neighbours] == [("B", False)]
    plan = led(architecture=Hybrid(kind="hybrid", robots=["B"]))
    alone, follower = plan.assignment("A"), plan.assignment("B")
    assert (alone.guided, follower.guided) == (False, True)
    assert [each.name for each in alone.neighbours] == ["B"]
    assert follower.neighbours == ()
    assert Robot(alone).guidance is None  # a robot that decides for itself takes no goals


@pytest.mark.parametrize("name", PLACES)
def test_velocity_of_the_centre_ends_with_its_goals(name):
    bench = running(name, formation=Formation(links={"A - B": 0.9}, law="consensus"))
    robot, (x, y, z) = bench.robot, bench.position

    def move(bench):
        if round(bench.t * 100) % 10 == 0:
            robot.guidance.receive(bench.position, nan, bench.t, (0.1, 0.0, nan))

    bench.step(1.0, move)
    assert robot.goal[0] > x + 0.05
    assert robot.setpoint[0] > (0.02 if name == "A" else x + 0.05)
    bench.step(0.35)
    assert robot.goal == (x, y, z)  # long before it counts as unguided
    assert not robot.hazards.held
    bench.step(0.8)
    assert robot.hazards.held
    assert (robot.stepping, robot.words) == (None, ())
