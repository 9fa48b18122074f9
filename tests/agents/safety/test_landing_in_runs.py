"""Landings and walls in whole runs: a drone goes aside, and all stop before walls."""

from math import dist, inf, nan

import pytest

from agents.body.interface import Disturbance
from agents.body.kinds import KINDS
from agents.decision.lifecycle import DONE, LANDING, RUNNING
from agents.kinds.crazyflie import CRAZYFLIE
from agents.kinds.khepera4 import KHEPERA4
from agents.safety.hazards import Cause
from agents.safety.landing import NEAR
from experiments.definition.experiment import LegTable, RobotTable
from tests.agents.swarm import Swarm
from tests.small import small


def test_run_ends_beside_a_robot_below():
    """The links put the drone over the robot on wheels; the process and the event are the real ones."""
    robots = {
        "G": RobotTable(kind="khepera4", start=[0.0, 0.0]),
        "F": RobotTable(kind="crazyflie", start=[0.3, 0.0], hover=0.8),
        "H": RobotTable(kind="crazyflie", start=[-0.4, 0.0], hover=0.8),
    }
    swarm = Swarm(small(robots, {"G > F": 0.8, "H > F": 0.4}, duration_s=3.0)).until(LANDING)
    robot, waited = swarm.robot("F"), False
    while swarm.phase("F") != DONE:
        assert swarm.since < 15.0
        swarm.step()
        waited |= robot.landing.aside
    assert waited
    assert dist(swarm.last("F", "truth")[:2], swarm.last("G", "truth")[:2]) > 0.09
    told = [each.text for each in robot.hazards.incidents if each.cause == Cause.BELOW]
    assert told[0] == "warn: a robot is below it: G; it goes aside first"
    assert swarm.phase("G") == DONE


@pytest.mark.parametrize("trigger", ["send-on-delta", "predictive"])
def test_drone_lands_beside_robot_that_died_moving(trigger):
    robots = {
        "F": RobotTable(kind="crazyflie", start=[0.0, 0.0], hover=1.0),
        "K": RobotTable(kind="khepera4", start=[-0.4, 0.0]),
    }
    leg = LegTable(at_s=0.0, robot="K", plan={"kind": "line", "move_by": [1.0, 0.0], "speed": 0.2})
    avoidance, sends = {"kind": "barrier", "hears": "all"}, {"kind": trigger, "threshold": 0.01}
    swarm = Swarm(small(robots, duration_s=60.0, trigger=sends, avoidance=avoidance, timeline=[leg])).running()
    while swarm.last("K", "truth")[0] < -0.02:
        swarm.step()
    place, robot = swarm.last("K", "truth")[:2], swarm.robot("F")
    swarm.groups.remove(swarm.where["K"][0])
    swarm.names = ("F",)
    robot.neighbours.mark_lost(0, swarm.t)
    swarm.run(3.0)
    robot.lifecycle.land("ordered to land")
    swarm.until(DONE)
    assert dist(swarm.last("F", "truth")[:2], place) - CRAZYFLIE.radius - KHEPERA4.radius > NEAR


HOVER = 0.8
WALLS = [(kind, axis, side) for kind in KINDS for axis, side in ((0, 1.0), (1, -1.0))]
WALLS += [(kind, 2, 1.0) for kind in KINDS if KINDS[kind].flies]


def farthest(kind, axis, side, latency_s):
    """How far beyond that wall [m] a guided robot gets, 1 m before it, whose goal is 0.9 m beyond it."""
    start = [0.1, 0.1]
    if axis < 2:
        start[axis] = side
    member = RobotTable(kind=kind, start=start, **({"hover": HOVER} if KINDS[kind].flies else {}))
    disturbance = {"all": Disturbance(latency_s=latency_s)}
    swarm = Swarm(small({"R": member}, architecture="centralised", disturbance=disturbance, duration_s=30.0))
    robot = swarm.robot("R")
    limits = robot.assignment.limits
    wall = (limits.high if side > 0.0 else limits.low)[axis]
    goal = [0.0, 0.0, HOVER]
    goal[axis] = wall + 0.9 * side
    reached = -inf
    for tick in range(round(9.0 / swarm.dt)):
        if tick % 10 == 0:
            robot.guidance.receive(tuple(goal), nan, swarm.t)
        swarm.step()
        robot.lifecycle.takeoff()
        if robot.lifecycle.start_at == inf:
            robot.start(swarm.t + 0.1)
        if swarm.phase("R") == RUNNING:
            reached = max(reached, side * (swarm.last("R", "truth")[axis] - wall))
    assert swarm.phase("R") == RUNNING, robot.lifecycle.reason
    return reached


@pytest.mark.parametrize(
    ("kind", "axis", "side", "latency_s"),
    [*((*wall, 0.0) for wall in WALLS), *((kind, 0, 1.0, 0.15) for kind in KINDS)],
)
def test_no_robot_gets_beyond_a_wall(kind, axis, side, latency_s):
    assert -0.1 < farthest(kind, axis, side, latency_s) < 0.001
