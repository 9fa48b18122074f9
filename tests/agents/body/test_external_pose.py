"""Velocities of bodies that measure only positions."""

import numpy as np
import pytest

from agents.body.external_pose import PATIENCE_S, External
from agents.body.interface import BodyState


def reading(t, position):
    unknown = np.full((2, 3), np.nan)
    return BodyState(
        time=np.full(2, t),
        position=np.array(position),
        velocity=unknown.copy(),
        yaw=np.zeros(2),
        true_position=unknown,
        true_yaw=unknown[:, 0],
        battery=unknown[:, 0],
        flying=np.zeros(2, dtype=bool),
    )


def test_a_row_without_a_velocity_gets_that_of_its_positions_and_the_others_keep_theirs():
    estimator = External(2)
    for k in range(101):
        t = 0.01 * k
        state = reading(t, [[0.2 * t, 0.0, 0.0], [0.0, 0.0, 0.0]])
        state.velocity[1] = [0.0, 0.7, 0.0]
        estimator.estimate(t, state)
    assert state.velocity == pytest.approx(np.array([[0.2, 0.0, 0.0], [0.0, 0.7, 0.0]]), abs=1e-3)
    for k in range(101, 151):  # it stands now
        t = 0.01 * k
        state = reading(t, [[0.2, 0.0, 0.0], [0.0, 0.0, 0.0]])
        estimator.estimate(t, state)
    assert 0.0 <= state.velocity[0, 0] < 0.003


def test_the_velocity_of_an_old_position_and_of_none_is_unknown():
    estimator = External(2)
    state = reading(0.0, [[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    estimator.estimate(0.1, state)
    assert state.velocity[0] == pytest.approx([0.0, 0.0, 0.0])
    assert np.isnan(state.velocity[1]).all()
    late = reading(0.0, [[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    estimator.estimate(PATIENCE_S, late)
    assert np.isnan(late.velocity).all()


def test_one_array_of_unknowns_in_several_fields_stays_unknown():
    state = reading(0.0, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    state.true_position = state.velocity
    External(2).estimate(0.0, state)
    assert np.isfinite(state.velocity).all()
    assert np.isnan(state.true_position).all()


def test_without_a_measured_yaw_the_own_one_goes_on():
    external, row = External(1), np.array([0])
    state = reading(0.0, [[0.0, 0.0, 0.0]] * 2)

    def yaw(t, measured, own):
        external.update(0, t, np.array([0.1 * t, 0.0, 0.0]), measured)
        state.yaw = np.array([own, 0.0])
        external.fill(state, row)
        return state.yaw[0]

    assert yaw(0.0, np.nan, 0.3) == 0.3  # none was measured yet
    assert yaw(0.1, 1.0, 0.2) == 1.0
    assert yaw(0.2, np.nan, 0.7) == pytest.approx(1.5)  # turned by 0.5 since
    assert yaw(5.0, np.nan, -0.2) == pytest.approx(0.6)
    assert yaw(5.1, 2.0, -0.2) == 2.0
    assert np.isnan(yaw(5.2, np.nan, np.nan))
