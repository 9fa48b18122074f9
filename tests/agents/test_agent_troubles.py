"""What a robot does when it does not know where it is, leaves the arena, or its body acts by itself."""

import numpy as np
import pytest

from agents.decision.lifecycle import AIRBORNE, DONE, IDLE, LANDING, READY, RUNNING, Phase
from experiments.definition.experiment import Formation, Robot
from tests.agents.few import drone, pair
from tests.agents.swarm import Swarm


def blinded(swarm, what, value):
    """From now on its position is lost, or elsewhere."""
    (group,) = swarm.groups

    def spoil(t, state):
        if what == "old":
            state.time[:] = value
        else:
            state.position[:] = value
        return state

    group.spoil = spoil


@pytest.mark.parametrize(("what", "grace"), [("old", 81), ("nowhere", 31)])  # 0.3 s of holding
@pytest.mark.parametrize("moment", ["climbing", "waiting", "running"])
def test_a_drone_that_does_not_know_where_it_is_lands(what, grace, moment):
    swarm = drone()
    if moment == "running":
        swarm.running().run(0.5)
    elif moment == "waiting":
        swarm.until(AIRBORNE)
    else:
        swarm.run(0.02)
        swarm.agent("F").lifecycle.takeoff(0)
        swarm.run(0.8)
        assert swarm.phase("F") == READY
    (group,) = swarm.groups
    blinded(swarm, what, swarm.t - 1e-9 if what == "old" else np.nan)  # 0.5 s are allowed
    for _ in range(grace):
        assert swarm.phase("F") < LANDING
        swarm.step()
    assert swarm.phase("F") == LANDING
    assert group.agent.lifecycle.reason == ["its own position is lost"]
    assert np.isnan(swarm.row("F", "setpoint")).all()
    for _ in range(500):
        swarm.step()
    assert swarm.phase("F") == DONE
    assert swarm.row("F", "truth")[2] == 0.0


@pytest.mark.parametrize("moment", ["climbing", "running"])
def test_a_drone_that_left_the_arena_lands(moment):
    swarm = drone()
    if moment == "running":
        swarm.running()
    else:
        swarm.run(0.02)
        swarm.agent("F").lifecycle.takeoff(0)
        swarm.run(0.5)
    blinded(swarm, "elsewhere", [2.2, 0.0, 0.5])  # the arena ends at 2 m
    swarm.agent("F").resume(0)  # it is put there: no jump
    swarm.run(0.1)
    assert swarm.phase("F") < LANDING
    blinded(swarm, "elsewhere", [2.3, 0.0, 0.5])
    swarm.step()
    assert (swarm.phase("F"), swarm.agent("F").lifecycle.reason) == (LANDING, ["it left the arena"])


def test_a_drone_whose_motors_stop_by_themselves_is_not_commanded_any_more():
    swarm = drone()
    swarm.running().run(0.2)
    (group,) = swarm.groups

    def down(t, state):
        state.flying = np.zeros_like(state.flying)
        return state

    group.spoil = down
    swarm.step()
    assert (swarm.phase("F"), group.agent.lifecycle.reason) == (LANDING, ["it came down by itself"])
    swarm.step()  # the body is told to land, all the same
    assert np.isnan(swarm.row("F", "setpoint")).all()
    swarm.step()
    assert swarm.phase("F") == DONE


def test_a_ground_robot_that_does_not_know_where_it_is_stops_and_goes_on():
    swarm = Swarm(pair(), [["A"], ["B"]]).running().run(0.5)
    group, _ = swarm.where["A"]

    def blind(t, state):
        state.position[:] = np.nan
        return state

    group.spoil = blind
    swarm.run(1.0)
    assert swarm.phase("A") == RUNNING
    np.testing.assert_array_equal(swarm.row("A", "setpoint"), np.zeros(4))
    del group.spoil
    swarm.run(0.3)
    assert swarm.row("A", "setpoint").any()


def test_a_ground_robot_outside_the_arena_rolls_out():
    swarm = Swarm(pair()).running()
    (group,) = swarm.groups

    def far(t, state):
        state.position[0] = [9.0, 0.0, 0.0]
        return state

    group.spoil = far
    swarm.agent("A").resume(0)  # it is put there: no jump
    swarm.run(0.5)
    assert [swarm.phase(name) for name in "AB"] == [DONE, RUNNING]
    assert group.agent.lifecycle.reason[0] == "it left the arena"


def test_bodies_act_by_themselves_until_they_are_in_the_air_and_from_landing_on():
    swarm = drone(duration_s=1.0).until(DONE)
    phase, setpoint = swarm.column("phase")[:, 0], swarm.column("setpoint")[:, 0]
    passive = (phase < AIRBORNE) | (phase > RUNNING)
    assert np.isnan(setpoint[passive]).all()
    assert np.isfinite(setpoint[~passive]).all()
    assert set(phase.tolist()) == {int(p) for p in Phase if p != IDLE}
    assert swarm.row("F", "truth")[2] == 0.0


def test_a_ground_robot_that_is_not_running_stands():
    swarm = Swarm(pair(duration_s=1.0)).until(DONE)
    phase, setpoint = swarm.column("phase"), swarm.column("setpoint")
    assert not setpoint[(phase < AIRBORNE) | (phase > RUNNING)].any()
    assert setpoint[phase == RUNNING].any()


def test_followers_of_wheels_that_lost_their_position_stop():
    robots = {"A": Robot(kind="khepera4", start=[-1.5, 0.0]), "B": Robot(kind="khepera4", start=[-1.0, 0.0])}
    shape = Formation(links={"B > A": 0.5})
    swarm = Swarm(pair(robots=robots, formation=shape, prediction={"kind": "constant-velocity"}), [["A"], ["B"]])
    swarm.running()
    assert swarm.agent("B").go(0, (1.5, 0.0), swarm.t) == ""
    swarm.run(2.5)

    def lost(t, state):
        state.position[0] = np.nan
        return state

    swarm.groups[1].spoil = lost
    swarm.run(20.0)
    assert np.linalg.norm(swarm.row("A", "truth") - swarm.row("B", "truth")) > 0.4
