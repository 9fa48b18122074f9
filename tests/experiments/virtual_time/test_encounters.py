"""Robots that change sides: with the barrier none touches another, and all arrive."""

import msgspec
import numpy as np
import pytest

from agents.decision.lifecycle import RUNNING
from experiments.definition.experiment import ChannelTable, Start
from experiments.definition.plan import Plan
from experiments.virtual_time.simulation import simulate
from tests.experiments.encounters import ANGLES, Outcome, encounter, meet, random_pairs

pytestmark = pytest.mark.slow

POTENTIAL = {"kind": "potential", "hears": "all"}
BARRIER = {"kind": "barrier", "hears": "all"}
SOME = (("khepera4", "turtlebot3"), ("tello", "tello"))
FOUR = ("khepera4", "turtlebot3", "crazyflie", "tello")


def met(kinds, avoidance, each, **settings):
    parts = (meet(encounter(kinds, avoidance, between=b, **settings), range(1, each + 1)) for b in ANGLES)
    return Outcome.joined(parts)


def test_without_avoidance_robots_collide():
    outcome = met(("turtlebot3", "turtlebot3"), None, 3, duration_s=12.0)
    assert outcome.collided.sum() >= 3
    assert outcome.gap.min() < -0.1
    assert outcome.arrived.all()
    assert not outcome.avoided.any()


def test_barrier_keeps_robots_apart_until_arrival():
    outcome = met(("khepera4", "tello"), BARRIER, 3, duration_s=20.0)
    assert outcome.gap.min() > 0.01
    assert outcome.arrived.all()
    assert (outcome.avoided > 0.0).any()


def test_gap_is_between_true_surfaces():
    experiment = encounter(("khepera4", "tello"), None, duration_s=10.0)
    log = simulate(Plan(experiment), 3)
    place = log.true_position[(log.phase == RUNNING).all(axis=1)]
    expected = np.hypot(*(place[:, 0] - place[:, 1])[:, :2].T).min() - 0.07 - 0.1
    assert meet(experiment, [3]).gap[0] == pytest.approx(expected, abs=1e-12)
    robots = {**experiment.robots, "R1": msgspec.structs.replace(experiment.robots["R1"], hover=0.5)}
    assert np.isinf(meet(msgspec.structs.replace(experiment, robots=robots), [3]).gap[0])


@pytest.mark.timeout(600)
@pytest.mark.nightly
def test_thousand_random_encounters_without_collision():
    outcomes = random_pairs(BARRIER, 50)
    whole = Outcome.joined(outcomes.values())
    assert len(whole.gap) == 1000
    assert whole.collided.sum() == 0
    assert whole.gap.min() > 0.02
    assert whole.arrived.sum() >= 995  # arrival is not guaranteed


@pytest.mark.timeout(300)
@pytest.mark.nightly
def test_potential_keeps_pairs_apart():
    whole = Outcome.joined([met(kinds, POTENTIAL, 10) for kinds in SOME])
    assert whole.collided.sum() == 0
    assert whole.arrived.all()


def test_wheels_pass_edge_of_the_potential():
    # these did, as long as the push jumped to its full size there
    for between, seed in ((np.pi, 7), (0.5 * np.pi, 23)):
        outcome = meet(encounter(("turtlebot3", "turtlebot3"), POTENTIAL, between=between), [seed])
        assert outcome.arrived.all()
        assert outcome.gap.min() > 0.1


@pytest.mark.parametrize("kinds", [("khepera4", "khepera4"), ("tello", "turtlebot3"), ("crazyflie", "crazyflie")])
def test_head_on_encounters_pass(kinds):
    experiment = msgspec.structs.replace(encounter(kinds, POTENTIAL), disturbance={}, start=Start())
    outcome = meet(experiment, [1])
    assert outcome.arrived.all()
    assert outcome.gap.min() > 0.1


@pytest.mark.timeout(300)
@pytest.mark.nightly
def test_robot_without_avoidance_is_avoided():
    whole = Outcome.joined([met(kinds, BARRIER, 10, stubborn=1) for kinds in SOME])
    assert whole.collided.sum() == 0
    assert whole.arrived.all()


@pytest.mark.parametrize("seeds", [3, pytest.param(20, marks=pytest.mark.nightly)])
def test_four_kinds_change_sides(seeds):
    outcome = meet(encounter(FOUR, BARRIER), range(1, 1 + seeds))
    assert outcome.collided.sum() == 0
    assert outcome.arrived.mean() >= 0.95


@pytest.mark.parametrize(
    ("kind", "sensors"),
    [pytest.param("turtlebot3", ["lds01"], marks=pytest.mark.nightly), ("khepera4", ["infrared", "ultrasonic"])],
)
def test_robots_with_sensors_alone_keep_clear(kind, sensors):
    outcome = met((kind, kind), {"kind": "barrier"}, 2, sensors=sensors)
    assert outcome.collided.sum() == 0
    assert outcome.arrived.all()


@pytest.mark.nightly
def test_bad_network_causes_no_collision():
    bad = ChannelTable(delay_s=0.02, jitter_s=0.02, loss=0.2)
    for kinds in (("tello", "tello"), ("crazyflie", "turtlebot3")):
        outcome = meet(msgspec.structs.replace(encounter(kinds, BARRIER), channel=bad), range(1, 21))
        assert outcome.collided.sum() == 0
        assert outcome.arrived.all()
