"""Robots of all kinds that are told to go beyond a wall, the ceiling or the floor stop before it."""

import numpy as np
import pytest

from agents.body.interface import Disturbance
from agents.body.kinds import KINDS
from agents.decision.lifecycle import RUNNING
from experiments.definition.experiment import Formation, Robot
from tests.agents.few import pair
from tests.agents.swarm import Group

HOVER = 0.8
WALLS = [(kind, axis, side) for kind in KINDS for axis, side in ((0, 1.0), (1, -1.0))]
WALLS += [(kind, 2, 1.0) for kind in KINDS if KINDS[kind].flies]


def farthest(kind: str, axis: int, side: float, latency_s: float = 0.0) -> float:
    """How far beyond that wall [m] a guided robot gets, 1 m before it, whose goal is 0.9 m beyond it."""
    start = [0.1, 0.1]
    if axis < 2:
        start[axis] = side
    robot = Robot(kind=kind, start=start, **({"hover": HOVER} if KINDS[kind].flies else {}))
    disturbed = {"all": Disturbance(latency_s=latency_s)} if latency_s else {}
    experiment = pair(
        robots={"R": robot}, formation=Formation(), architecture="centralised", disturbance=disturbed, duration_s=30.0
    )
    group = Group(experiment, ["R"])
    agent, limits = group.agent, group.assignment.limits
    goal = np.array([[0.0, 0.0, HOVER]])
    wall = (limits.high if side > 0.0 else limits.low)[axis]
    goal[0, axis] = wall + 0.9 * side
    reached, dt = -np.inf, 1.0 / experiment.rates.body_hz
    for tick in range(round(9.0 / dt)):
        t = tick * dt
        if tick % 10 == 0:
            agent.guidance.receive(np.array([0]), goal, np.array([np.nan]), np.array([t]))
        group.step(t)
        agent.lifecycle.takeoff(0)
        if not np.isfinite(agent.lifecycle.start_at[0]):
            agent.start(0, t + 0.1)
        if agent.lifecycle.phase[0] == RUNNING:
            reached = max(reached, side * (group.state.true_position[0, axis] - wall))
    assert agent.lifecycle.phase[0] == RUNNING, agent.lifecycle.reason[0]
    return reached


@pytest.mark.parametrize(("kind", "axis", "side"), WALLS)
def test_nobody_gets_beyond_a_wall(kind, axis, side):
    assert -0.1 < farthest(kind, axis, side) < 0.001


@pytest.mark.parametrize("kind", KINDS)
def test_nor_where_commands_take_effect_late(kind):
    assert -0.1 < farthest(kind, 0, 1.0, latency_s=0.15) < 0.001
