"""Guided robots: which goals they pursue, when they hold, and what stays in the robot."""

from math import inf, isnan, nan

import pytest

from agents.decision.centralised import ReceivedGoals
from agents.decision.lifecycle import AIRBORNE, IDLE, LANDING, READY, RUNNING
from agents.robot import Robot
from agents.vectors import ZERO
from experiments.definition.experiment import Formation, Hybrid, RobotTable, Start
from experiments.definition.plan import Plan
from tests.agents.bench import Bench
from tests.small import small

PLACES = {"A": (-0.4, 0.0, 0.0), "B": (0.4, 0.1, 0.8)}


def led(**parts):
    """A Khepera and a Crazyflie that receive each other, guided by a central controller; `parts` changes that."""
    robots = {
        "A": RobotTable(kind="khepera4", start=[-0.4, 0.0]),
        "B": RobotTable(kind="crazyflie", start=[0.4, 0.1], hover=0.8),
    }
    return Plan(small(robots, {"A - B": 0.9}, **{"duration_s": 60.0, "architecture": "centralised", **parts}))


def guided(name="A", **parts):
    return Bench(led(**parts).assignment(name), PLACES[name])


def guide(bench, goal=None, yaw=nan, *, stamp=None):
    """Receive a goal; returns whether it is new."""
    stamp = bench.t if stamp is None else stamp
    return bench.robot.guidance.receive(goal or bench.position, yaw, stamp)


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


@pytest.mark.parametrize("name", PLACES)
def test_nothing_is_pursued_before_the_start(name):
    bench = guided(name)
    guide(bench, (1.0, 0.0, 0.8))
    bench.step()
    assert bench.life.takeoff() == ""
    bench.step(2.0)
    assert bench.life.phase == AIRBORNE
    assert bench.robot.goal == PLACES[name]
    assert bench.robot.updates == 0


@pytest.mark.parametrize(("name", "height"), [("A", 0.0), ("B", 0.7)])  # on wheels there is none
def test_goal_is_pursued_on_its_tick(name, height):
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
    bench = running()
    assert guide(bench, (0.1, 0.0, 0.0))
    assert not guide(bench, (nan, 0.0, 0.0), stamp=bench.t + 1.0)
    assert not guide(bench, (0.2, 0.0, 0.0), stamp=bench.t - 0.1)
    assert not guide(bench, (0.2, 0.0, 0.0))  # the same instant once more
    assert bench.step().robot.goal == (0.1, 0.0, 0.0)


def test_old_goal_makes_it_stay():
    bench = running()
    at = bench.t
    guide(bench, (-0.3, 0.1, 0.0), 0.3)
    bench.step(0.5)
    bench.position = (-0.35, 0.0, 0.0)
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
    bench.step()
    bench.robot.guidance.mark_lost(bench.t)
    assert bench.step().robot.goal == bench.position
    assert bench.robot.missing_neighbours() == ["centre"]
    assert bench.life.phase == RUNNING
    bench.robot.guidance.mark_alive()
    assert bench.step().robot.goal == goal  # back in time: the last goal is still young
    bench.robot.guidance.mark_lost(bench.t)
    bench.step()
    guide(bench, (x + 0.05, y + 0.1, z))  # who is received is there
    assert bench.step().robot.goal == (x + 0.05, y + 0.1, z)


def test_orders_come_before_goals():
    bench = running()
    assert bench.robot.hold() == ""
    guide(bench, (-0.3, 0.1, 0.0))
    assert bench.step().robot.goal == (-0.4, 0.0, 0.0)
    assert bench.robot.start(0.0) == ""
    assert bench.step().robot.goal == (-0.3, 0.1, 0.0)
    drone = running("B")
    drone.life.land("told to")
    guide(drone, (0.6, 0.2, 0.8))
    drone.step()
    assert drone.life.phase == LANDING
    assert isnan(drone.robot.setpoint[0])


def test_cut_off_from_the_network_it_holds():
    bench = running()
    bench.robot.health.offline_since = bench.t
    bench.step(0.5)
    guide(bench, (-0.3, 0.1, 0.0))  # the last that came through
    assert bench.step(0.5).robot.goal == (-0.3, 0.1, 0.0)
    assert bench.step(0.02).robot.goal == bench.position


def test_guided_robot_receives_for_avoidance_alone():
    assert led().assignment("A").neighbours == ()
    avoids = led(avoidance={"kind": "barrier", "hears": "neighbours"}).assignment("A")
    assert [(each.name, each.in_law) for each in avoids.neighbours] == [("B", False)]


def test_hybrid_leaves_the_law_to_others():
    plan = led(architecture=Hybrid(kind="hybrid", robots=["B"]))
    alone, follower = plan.assignment("A"), plan.assignment("B")
    assert (alone.guided, follower.guided) == (False, True)
    assert [each.name for each in alone.neighbours] == ["B"]
    assert follower.neighbours == ()
    assert Robot(alone).guidance is None  # a robot that decides for itself takes no goals


def test_goals_of_another_controller_begin_anew():
    guidance = ReceivedGoals(flies=True, silence_s=1.0)
    assert guidance.missing
    assert guidance.receive(ZERO, nan, 4.0)
    guidance.mark_lost(4.5)
    assert guidance.unguided(4.6)
    assert guidance.receive(ZERO, nan, 4.7)
    assert guidance.lost_since == inf
    guidance.begin_anew()
    assert guidance.receive(ZERO, nan, -3.0)  # its clock is behind


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
    assert robot.stepping is None
    assert robot.words == ()
