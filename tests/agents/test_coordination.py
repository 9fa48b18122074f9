"""The formation law is the gradient that it claims to be, and forces that come from distances turn with the frame."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents import plugins
from agents.coordination import Distance, goal, tracking
from agents.graph import links

SEEDS = st.integers(0, 2**32 - 1)
FEW = settings(max_examples=25, deadline=None)


def formation(seed, rows=5, count=8):
    """Random places, and random links among them whose distances they do not have."""
    rng = np.random.default_rng(seed)
    position = rng.uniform(-1, 1, (rows, 3))
    possible = [(i, j) for i in range(rows) for j in range(rows) if i != j]
    pairs = [possible[k] for k in rng.choice(len(possible), count, replace=False)]
    return position, links(pairs, rng.uniform(0.3, 1.5, count), rng.uniform(0.5, 5.0, count))


def rotation(seed):
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.diag(r))


@FEW
@given(SEEDS)
def test_the_offset_is_minus_the_gradient_of_its_potential(seed):
    position, net = formation(seed)
    heard = position[net.speaker] + 0.01  # not quite where the neighbours are

    def potential(place):
        error = net.distance**2 - ((place[net.listener] - heard) ** 2).sum(axis=1)
        return (net.gain / 8.0 * error**2).sum()

    slope = np.zeros_like(position)
    step = 1e-6
    for row in range(len(position)):
        for axis in range(3):
            ahead, behind = position.copy(), position.copy()
            ahead[row, axis] += step
            behind[row, axis] -= step
            slope[row, axis] = (potential(ahead) - potential(behind)) / (2 * step)
    np.testing.assert_allclose(Distance().offset(position, heard, net), -slope, rtol=1e-6, atol=1e-6)


@FEW
@given(SEEDS)
def test_turning_and_moving_the_world_turns_the_offset(seed):
    position, net = formation(seed)
    heard = position[net.speaker] + 0.02
    turn, shift = rotation(seed), np.array([3.0, -2.0, 0.5])
    law = Distance()
    before, after = law.offset(position, heard, net), law.offset(position @ turn.T + shift, heard @ turn.T + shift, net)
    np.testing.assert_allclose(after, before @ turn.T, atol=1e-12)
    np.testing.assert_allclose(
        law.error(position @ turn.T + shift, heard @ turn.T + shift, net), law.error(position, heard, net), atol=1e-12
    )


@FEW
@given(SEEDS)
def test_at_the_distances_wanted_nothing_moves(seed):
    position, net = formation(seed)
    heard = position[net.speaker]
    reached = links(
        list(zip(net.listener, net.speaker, strict=True)),
        np.linalg.norm(position[net.listener] - heard, axis=1),
        net.gain,
    )
    np.testing.assert_allclose(Distance().offset(position, heard, reached), 0.0, atol=1e-14)
    np.testing.assert_allclose(Distance().error(position, heard, reached), 0.0, atol=1e-14)


def test_a_pair_that_is_too_far_apart_closes_up():
    net = links([(0, 1), (1, 0)], [1.0, 1.0], [3.0, 1.0])
    position = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    offset = Distance().offset(position, position[net.speaker], net)
    # 1/2 * 3 * (1 - 4) * (0 - 2) = 9, and 1/2 * 1 * (1 - 4) * 2 = -3
    np.testing.assert_array_equal(offset, [[9.0, 0.0, 0.0], [-3.0, 0.0, 0.0]])
    np.testing.assert_array_equal(Distance().error(position, position[net.speaker], net), [1.0, 1.0])


def test_who_does_not_know_where_it_is_moves_nobody_else():
    position, net = formation(7)
    heard = position[net.speaker]
    whole = Distance().offset(position, heard, net)
    position[2] = np.nan
    part = Distance().offset(position, heard, net)
    others = np.arange(5) != 2
    np.testing.assert_array_equal(part[others], whole[others])
    assert np.isnan(part[2]).all() == bool((net.listener == 2).any())


@pytest.mark.parametrize("name", plugins.names(plugins.LAWS))
@FEW
@given(seed=SEEDS)
def test_a_law_gives_each_row_what_it_gives_it_alone(name, seed):
    law = plugins.build(plugins.LAWS, name)
    position, net = formation(seed)
    heard = position[net.speaker] + 0.03
    whole, error = law.offset(position, heard, net), law.error(position, heard, net)
    assert (error >= 0.0).all()
    for row in range(len(position)):
        mine, rows = net.listener == row, np.array([row])
        np.testing.assert_array_equal(law.offset(position[rows], heard[mine], net.of(rows))[0], whole[row])
        np.testing.assert_array_equal(law.error(position[rows], heard[mine], net.of(rows)), error[mine])


@FEW
@given(SEEDS)
def test_tracking_is_the_paper_s_cubic_pull(seed):
    rng = np.random.default_rng(seed)
    position, target, gain = rng.normal(size=(4, 3)), rng.normal(size=(4, 3)), rng.uniform(0.1, 5.0, 4)
    pull = tracking(position, target, gain)
    for i in range(4):
        away = position[i] - target[i]
        np.testing.assert_allclose(pull[i], -0.5 * gain[i] * (away @ away) * away, rtol=1e-12)
    np.testing.assert_allclose(tracking(position, target, 2.0)[1], pull[1] * 2.0 / gain[1], rtol=1e-12)


def test_tracking_ignores_rows_without_a_target():
    position = np.ones((2, 3))
    target = np.array([[np.nan, np.nan, np.nan], [0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(tracking(position, target, 2.0), [[0, 0, 0], [-2, -2, 0]])


@FEW
@given(SEEDS, st.floats(0.01, 0.5))
def test_the_goal_is_within_the_clamp_on_every_axis(seed, limit):
    rng = np.random.default_rng(seed)
    position, offset = rng.normal(size=(6, 3)), rng.normal(size=(6, 3))
    step = goal(position, offset, limit) - position
    assert (np.abs(step) <= limit + 1e-12).all()
    free = np.abs(offset) < limit
    np.testing.assert_allclose(step[free], offset[free], atol=1e-12)
    np.testing.assert_allclose(step[~free], limit * np.sign(offset[~free]), atol=1e-12)
