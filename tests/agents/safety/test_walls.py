"""Robots of all kinds that are told to go beyond a wall, the ceiling or the floor stop before it."""

from math import inf, nan

import pytest

from agents.body.interface import Disturbance
from agents.body.kinds import KINDS
from agents.decision.lifecycle import RUNNING
from experiments.definition.experiment import Formation, Robot
from tests.agents.few import pair
from tests.agents.swarm import Swarm

HOVER = 0.8
WALLS = [(kind, axis, side) for kind in KINDS for axis, side in ((0, 1.0), (1, -1.0))]
WALLS += [(kind, 2, 1.0) for kind in KINDS if KINDS[kind].flies]


def farthest(kind: str, axis: int, side: float, latency_s: float = 0.0) -> float:
    """How far beyond that wall [m] a guided robot gets, 1 m before it, whose goal is 0.9 m beyond it."""
    start = [0.1, 0.1]
    if axis < 2:
        start[axis] = side
    member = Robot(kind=kind, start=start, **({"hover": HOVER} if KINDS[kind].flies else {}))
    disturbed = {"all": Disturbance(latency_s=latency_s)} if latency_s else {}
    swarm = Swarm(
        pair(
            robots={"R": member}, formation=Formation(), architecture="centralised", disturbance=disturbed,
            duration_s=30.0,
        )
    )  # fmt: skip
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


@pytest.mark.parametrize(("kind", "axis", "side"), WALLS)
def test_no_robot_gets_beyond_a_wall(kind, axis, side):
    assert -0.1 < farthest(kind, axis, side) < 0.001


@pytest.mark.parametrize("kind", KINDS)
def test_late_commands_keep_before_walls(kind):
    assert -0.1 < farthest(kind, 0, 1.0, latency_s=0.15) < 0.001
