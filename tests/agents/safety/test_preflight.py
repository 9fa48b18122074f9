"""Checks before take-off: who fails one is not ready, says why, and is ready when it is mended."""

import math
from dataclasses import replace

import numpy as np
import pytest

from agents.body.limits import Safety
from agents.decision.lifecycle import IDLE, READY, RUNNING
from experiments.definition.experiment import Formation, Robot
from tests.agents.few import drone, pair
from tests.agents.safety.test_detection import leant, spoiled
from tests.agents.swarm import Swarm

FAILURES = {
    "no position": ({"position": np.nan}, "no position of its own"),
    "no heading": ({"yaw": np.nan}, "it does not know which way it looks"),
    "outside": ({"position": [2.3, 0.0, 0.0]}, "it is 0.30 m outside the arena"),
    "locked": ({"refusals": ("locked: switch it off and on",)}, "locked: switch it off and on"),
    "elsewhere": ({"position": [0.5, 0.2, 0.0]}, "it is 0.40 m from its start (0.1, 0.2), more than 0.3 m"),
    "on a table": ({"position": [0.1, 0.2, 0.7]}, "it does not stand on the floor, but at z = 0.70 m"),
    "carried": ({"velocity": [0.0, 0.4, 0.3]}, "it is not at rest: 0.50 m/s"),
    "upside down": ({"attitude": leant(math.pi)}, "it is not level: it leans 180°"),
    "empty": ({"battery": 0.15}, "its battery is at 15%, less than 20%"),
}


@pytest.mark.parametrize("what", FAILURES)
def test_a_drone_is_not_ready_while_something_is_wrong(what):
    values, reason = FAILURES[what]
    swarm = drone()
    agent = swarm.agent("F")
    spoiled(swarm, **values)
    swarm.run(0.1)
    assert (agent.lifecycle.phase[0], agent.lifecycle.reason[0]) == (IDLE, reason)
    assert agent.lifecycle.takeoff(0) == f"cannot take off while idle: {reason}"
    del swarm.groups[0].spoil
    swarm.step()
    assert (agent.lifecycle.phase[0], agent.lifecycle.reason[0]) == (READY, "")


@pytest.mark.parametrize("what", FAILURES)
def test_and_is_ready_no_more_when_it_lasts(what):
    values, reason = FAILURES[what]
    swarm = drone().run(0.1)
    agent = swarm.agent("F")
    assert agent.lifecycle.phase[0] == READY
    spoiled(swarm, **values)
    swarm.run(0.4)
    assert agent.lifecycle.phase[0] == READY  # what flickers does not matter
    assert agent.lifecycle.takeoff(0) == f"cannot take off now: {reason}"
    del swarm.groups[0].spoil
    swarm.run(0.4)
    spoiled(swarm, **values)
    swarm.run(0.52)
    assert (agent.lifecycle.phase[0], agent.lifecycle.reason[0]) == (IDLE, reason)
    assert not agent.hazards.incidents  # it stands: nothing is unsafe yet


def side_by_side(**parts):
    """Two drones that start 0.25 m apart, and receive each other."""
    robots = {"F": Robot(kind="crazyflie", start=[0.0, 0.0], hover=0.5)}
    robots["G"] = Robot(kind="crazyflie", start=[0.25, 0.0], hover=0.5)
    formation = Formation(links={"F - G": 0.25})
    return Swarm(pair(robots=robots, formation=formation, **parts), [["F"], ["G"]])


def test_subjects_swapped_within_reach_of_start():
    swarm = side_by_side()
    for group, x in zip(swarm.groups, (0.25, 0.0), strict=True):
        group.spoil = lambda t, state, x=x: replace(state, position=np.array([[x, 0.0, 0.0]]))
    swarm.run(0.2)
    assert [swarm.phase(name) for name in "FG"] == [IDLE, IDLE]
    assert swarm.agent("F").lifecycle.reason == ["it stands where G begins: addresses or markers are swapped"]
    anywhere = side_by_side(safety=Safety(start_within=0.0))
    for group, x in zip(anywhere.groups, (0.25, 0.0), strict=True):
        group.spoil = lambda t, state, x=x: replace(state, position=np.array([[x, 0.0, 0.0]]))
    assert [anywhere.run(0.2).phase(name) for name in "FG"] == [READY, READY]


@pytest.mark.parametrize(("x", "z", "phase"), [(0.18, 0.6, IDLE), (0.18, 0.05, READY), (0.25, 0.6, READY)])
def test_nothing_takes_off_below_another(x, z, phase):
    swarm = side_by_side()
    swarm.groups[1].spoil = lambda t, state: replace(state, position=np.array([[x, 0.0, z]]))
    swarm.run(0.2)
    assert swarm.phase("F") == phase
    spoil = swarm.groups[1].spoil
    del swarm.groups[1].spoil
    swarm.run(0.1)
    assert swarm.phase("F") == READY
    swarm.groups[1].spoil = spoil
    swarm.run(0.05)
    assert swarm.phase("F") == phase  # at once: the take-off would pass it


def test_what_is_not_known_is_allowed():
    swarm = drone()
    spoiled(swarm, battery=np.nan, velocity=np.nan, attitude=[np.nan] * 4)
    swarm.run(0.1)
    assert swarm.phase("F") == READY


def test_ground_robots_may_roll_and_stand_on_a_table():
    swarm = Swarm(pair())
    spoiled(swarm, velocity=[0.5, 0.0, 0.0])
    swarm.run(0.1)
    assert swarm.phase("A") == READY


def test_without_a_router_nobody_takes_off():
    swarm = drone().run(0.1)
    agent = swarm.agent("F")
    agent.health.offline_since = swarm.t
    swarm.run(0.6)
    assert agent.lifecycle.reason == ["no connection to a router"]
    agent.health.offline_since = np.inf
    swarm.step()
    assert swarm.phase("F") == READY


def test_who_stands_too_near_to_another_does_not_take_off():
    robots = {"A": Robot(kind="khepera4", start=[-0.1, 0.0]), "B": Robot(kind="khepera4", start=[0.1, 0.1])}
    swarm = Swarm(pair(robots=robots, safety=Safety(separation=0.3)), [["A"], ["B"]]).run(0.2)
    assert [swarm.phase(name) for name in "AB"] == [IDLE, IDLE]
    assert swarm.agent("A").lifecycle.reason == ["it is 0.22 m from B, nearer than 0.3 m"]
    near = Swarm(pair(robots=robots, safety=Safety(separation=0.2))).running()
    assert near.phase("A") == RUNNING


def test_a_law_that_wants_nonsense_is_known_before():
    swarm = Swarm(pair(), [["A"], ["B"]])
    swarm.agent("A").goal_computer.law_offset = lambda t, position: np.full_like(position, np.nan)
    swarm.run(0.2)
    assert swarm.agent("A").lifecycle.reason == ["its law wants something that is not finite"]
    assert swarm.phase("B") == READY
