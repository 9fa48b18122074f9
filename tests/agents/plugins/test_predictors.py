"""Beliefs: the same place at both ends of a link, the horizon, and what a wrong one costs."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.decision.neighbours import NeighbourPoses
from agents.plugins import registry
from agents.plugins.predictors import HOLD, ConstantVelocity, Hold, Predictor

NAMES = registry.names(registry.PREDICTORS)
FEW = settings(max_examples=25)
SEEDS = st.integers(0, 2**32 - 1)


def test_both_are_registered():
    assert {"hold", "constant-velocity"} <= set(NAMES)
    assert registry.build(registry.PREDICTORS, "hold") == HOLD == Hold()


@pytest.mark.parametrize("name", NAMES)
@FEW
@given(SEEDS)
def test_rows_are_predicted_as_if_each_were_alone_and_nothing_is_changed(name, seed):
    predictor: Predictor = registry.build(registry.PREDICTORS, name)
    rng = np.random.default_rng(seed)
    position, velocity, age = rng.normal(size=(5, 3)), rng.normal(size=(5, 3)), rng.uniform(-1.0, 4.0, 5)
    kept = position.copy(), velocity.copy(), age.copy()
    together = predictor.position(position, velocity, age), predictor.velocity(velocity, age)
    for row in range(5):
        one = slice(row, row + 1)
        np.testing.assert_array_equal(predictor.position(position[one], velocity[one], age[one])[0], together[0][row])
        np.testing.assert_array_equal(predictor.velocity(velocity[one], age[one])[0], together[1][row])
    for before, after in zip(kept, (position, velocity, age), strict=True):
        np.testing.assert_array_equal(before, after)


def test_constant_velocity_goes_on_until_its_horizon():
    position, velocity = np.zeros((4, 3)), np.tile([1.0, -2.0, 0.5], (4, 1))
    age = np.array([-0.5, 0.0, 1.0, 9.0])
    told = ConstantVelocity(horizon_s=2.0).position(position, velocity, age)
    np.testing.assert_allclose(told, np.array([0.0, 0.0, 1.0, 2.0])[:, None] * velocity)
    moves = ConstantVelocity(horizon_s=2.0).velocity(velocity, age)
    np.testing.assert_array_equal(moves[:, 0], [1.0, 1.0, 1.0, 0.0])
    np.testing.assert_allclose(ConstantVelocity().position(position, velocity, age)[3], 9.0 * velocity[3])
    assert (HOLD.reach_s, ConstantVelocity().reach_s, ConstantVelocity(horizon_s=2.0).reach_s) == (
        math.inf,
        math.inf,
        2.0,
    )


def test_what_was_heard_is_carried_on_from_the_time_of_its_sample():
    heard = NeighbourPoses(3)
    heard.position[:2], heard.velocity[:2] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [[0.1, 0.0, 0.0], [0.0, 0.2, 0.0]]
    heard.stamp[:2], heard.arrival[:2] = [4.0, 4.5], [4.4, 4.9]  # the delay of the network is made up for
    both = np.array([0, 1])
    found = heard.extrapolate_position(ConstantVelocity(), 5.0, both)
    np.testing.assert_allclose(found, [[1.1, 0.0, 0.0], [0.0, 1.1, 0.0]])
    np.testing.assert_array_equal(heard.extrapolate_position(HOLD, 5.0, both), heard.position[:2])
    np.testing.assert_array_equal(heard.extrapolate_velocity(HOLD, 5.0, both), np.zeros((2, 3)))
