"""Robots of all kinds that are told to go beyond a wall, the ceiling or the floor stop before it."""

import numpy as np
import pytest

from agents.body.interface import Disturbance
from agents.body.kinds import KINDS, TELLO
from agents.body.limits import Limits
from agents.decision.lifecycle import RUNNING
from agents.safety.setpoint_filter import SetpointFilter
from experiments.definition.experiment import Formation, Robot
from tests.agents.few import pair
from tests.agents.swarm import Group

HOVER = 0.8
LIMITS = Limits(np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 2.5]), margin=0.05)
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


def test_velocities_toward_a_wall_are_what_would_close_in_on_a_goal_there():
    def out(x: float, age: float = 0.0) -> float:
        return float(
            SetpointFilter((TELLO,), LIMITS)
            .check(np.array([[1.0, 0.5, 0.0, 0.0]]), np.array([[x, 0.0, 1.0]]), np.zeros(1), np.array([age]))
            .setpoint[0, 0]
        )

    assert out(-0.5) == 1.0
    assert out(0.65) == pytest.approx(0.3 * TELLO.response)
    assert out(0.95) == 0.0
    assert out(1.0) == pytest.approx(-0.05 * TELLO.response)  # back
    assert out(0.65, age=0.2) == pytest.approx(0.3 / (1.0 / TELLO.response + 0.2))  # it may have come nearer since


@pytest.mark.parametrize("kind", ["khepera4", "turtlebot3"])
def test_wheels_slow_down_toward_a_wall_whichever_way_they_look(kind):
    made = KINDS[kind]

    def driven(v: float, yaw: float, x: float = 0.85) -> float:
        return float(
            SetpointFilter((made,), LIMITS)
            .check(np.array([[v, 1.0, 0.0, 0.0]]), np.array([[x, 0.0, 0.0]]), np.array([yaw]), np.zeros(1))
            .setpoint[0, 0]
        )

    assert driven(0.2, 0.0) == pytest.approx(0.1 * made.response)
    assert driven(0.2, np.pi) == 0.2
    assert driven(-0.2, np.pi) == pytest.approx(-0.1 * made.response)
    assert driven(0.2, 1.2) == 0.2  # along the wall
    assert driven(0.2, 0.0, x=0.96) == 0.0
