"""The formation law is the gradient that it claims to be, and forces that come from distances turn with the frame."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.formation.graph import BY_BEARING, BY_DISTANCE, BY_RELATIVE, Links, links
from agents.plugins import registry
from agents.plugins.laws import Bearing, Displacement, Distance, Mixed, goal_position, tracking_offset

SEEDS = st.integers(0, 2**32 - 1)
FEW = settings(max_examples=25)


def formation(seed, rows=5, count=8):
    """Random places, and random links among them whose distances they do not have."""
    rng = np.random.default_rng(seed)
    position = rng.uniform(-1, 1, (rows, 3))
    possible = [(i, j) for i in range(rows) for j in range(rows) if i != j]
    pairs = [possible[k] for k in rng.choice(len(possible), count, replace=False)]
    return position, links(pairs, rng.uniform(0.3, 1.5, count), rng.uniform(0.5, 5.0, count))


def told_more(seed, wants=None):
    """As `formation`, with relative positions and directions; every third direction is one seen from above."""
    position, net = formation(seed)
    rng = np.random.default_rng(seed + 1)
    relative = rng.uniform(-1, 1, (len(net), 3))
    bearing = rng.normal(size=(len(net), 3))
    bearing[::3, 2] = 0.0
    bearing /= np.linalg.norm(bearing, axis=1, keepdims=True)
    bearing[::3, 2] = np.nan
    asked = rng.choice([BY_DISTANCE, BY_RELATIVE, BY_BEARING], len(net)) if wants is None else np.full(len(net), wants)
    return position, Links(net.receiver, net.sender, net.distance, net.gain, relative, bearing, asked)


def slope_of(potential, position):
    """Derivatives (N, 3) of a potential, by central differences."""
    slope, step = np.zeros_like(position), 1e-6
    for row, axis in np.ndindex(position.shape):
        ahead, behind = position.copy(), position.copy()
        ahead[row, axis] += step
        behind[row, axis] -= step
        slope[row, axis] = (potential(ahead) - potential(behind)) / (2 * step)
    return slope


def rotation(seed):
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.diag(r))


@FEW
@given(SEEDS)
def test_the_offset_is_minus_the_gradient_of_its_potential(seed):
    position, net = formation(seed)
    heard = position[net.sender] + 0.01  # not quite where the neighbours are

    def potential(place):
        error = net.distance**2 - ((place[net.receiver] - heard) ** 2).sum(axis=1)
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
    heard = position[net.sender] + 0.02
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
    heard = position[net.sender]
    reached = links(
        list(zip(net.receiver, net.sender, strict=True)),
        np.linalg.norm(position[net.receiver] - heard, axis=1),
        net.gain,
    )
    np.testing.assert_allclose(Distance().offset(position, heard, reached), 0.0, atol=1e-13)
    np.testing.assert_allclose(Distance().error(position, heard, reached), 0.0, atol=1e-13)


def test_a_pair_that_is_too_far_apart_closes_up():
    net = links([(0, 1), (1, 0)], [1.0, 1.0], [3.0, 1.0])
    position = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    offset = Distance().offset(position, position[net.sender], net)
    # 1/2 * 3 * (1 - 4) * (0 - 2) = 9, and 1/2 * 1 * (1 - 4) * 2 = -3
    np.testing.assert_array_equal(offset, [[9.0, 0.0, 0.0], [-3.0, 0.0, 0.0]])
    np.testing.assert_array_equal(Distance().error(position, position[net.sender], net), [1.0, 1.0])


def test_who_does_not_know_where_it_is_moves_nobody_else():
    position, net = formation(7)
    heard = position[net.sender]
    whole = Distance().offset(position, heard, net)
    position[2] = np.nan
    part = Distance().offset(position, heard, net)
    others = np.arange(5) != 2
    np.testing.assert_array_equal(part[others], whole[others])
    assert np.isnan(part[2]).all() == bool((net.receiver == 2).any())


@pytest.mark.parametrize("name", registry.names(registry.LAWS))
@FEW
@given(seed=SEEDS)
def test_a_law_gives_each_row_what_it_gives_it_alone(name, seed):
    law = registry.build(registry.LAWS, name)
    position, net = told_more(seed)
    heard = position[net.sender] + 0.03
    whole, error = law.offset(position, heard, net), law.error(position, heard, net)
    assert (error >= 0.0).all()
    for row in range(len(position)):
        mine, rows = net.receiver == row, np.array([row])
        np.testing.assert_array_equal(law.offset(position[rows], heard[mine], net.to_receivers(rows))[0], whole[row])
        np.testing.assert_array_equal(law.error(position[rows], heard[mine], net.to_receivers(rows)), error[mine])


# ---------------------------------------------------------------- relative positions, directions, and all together


@FEW
@given(SEEDS)
def test_a_linear_law_is_the_gradient_of_half_its_squared_errors(seed):
    for law, wants in ((Displacement(), BY_RELATIVE), (Bearing(), BY_BEARING)):
        position, net = told_more(seed, wants)
        heard = position[net.sender] + 0.01

        def potential(place, law=law, net=net, heard=heard):
            return (net.gain / 2.0 * law.error(place, heard, net) ** 2).sum()

        np.testing.assert_allclose(law.offset(position, heard, net), -slope_of(potential, position), atol=1e-7)


@FEW
@given(SEEDS)
def test_a_law_for_all_does_on_each_link_what_its_own_law_does(seed):
    position, net = told_more(seed)
    heard = position[net.sender] + 0.02
    total, error = np.zeros_like(position), np.zeros(len(net))
    for law, wants in ((Distance(), BY_DISTANCE), (Displacement(), BY_RELATIVE), (Bearing(), BY_BEARING)):
        mine = net.wants == wants
        total += law.offset(position, heard[mine], net.take(mine))
        error[mine] = law.error(position, heard[mine], net.take(mine))
    np.testing.assert_allclose(Mixed().offset(position, heard, net), total, atol=1e-12)
    np.testing.assert_array_equal(Mixed().error(position, heard, net), error)


@FEW
@given(SEEDS)
def test_what_a_law_does_not_see(seed):
    """Displacement is blind for a shift; bearing for a shift and a growth, and seen from above also for heights."""
    position, net = told_more(seed)
    heard, shift = position[net.sender], np.array([3.0, -2.0, 0.5])
    for law in (Displacement(), Bearing(), Mixed(dead_zone=0.1)):
        np.testing.assert_allclose(
            law.offset(position + shift, heard + shift, net), law.offset(position, heard, net), atol=1e-12
        )
    np.testing.assert_allclose(Bearing().error(2 * position, 2 * heard, net), 2 * Bearing().error(position, heard, net))
    lifted = heard + np.array([0.0, 0.0, 1.0])
    above = np.isnan(net.bearing[:, 2])
    error = Bearing().error(position, heard, net)
    np.testing.assert_array_equal(Bearing().error(position, lifted, net)[above], error[above])
    turn = rotation(seed)
    error = Displacement().error(position, heard, net)
    assert np.abs(Displacement().error(position @ turn.T, heard @ turn.T, net) - error).max() > 1e-3


@FEW
@given(SEEDS)
def test_where_everything_is_met_nothing_moves(seed):
    position, net = told_more(seed)
    heard = position[net.sender]
    apart = position[net.receiver] - heard
    length = np.linalg.norm(apart, axis=1)
    flat = apart.copy()
    flat[:, 2] = np.nan
    flat[:, :2] /= np.linalg.norm(flat[:, :2], axis=1, keepdims=True)
    above = np.isnan(net.bearing[:, 2])[:, None]
    met = Links(
        net.receiver, net.sender, length, net.gain, apart, np.where(above, flat, apart / length[:, None]), net.wants
    )
    for law in (Distance(), Displacement(), Bearing(), Mixed()):
        np.testing.assert_allclose(law.offset(position, heard, met), 0.0, atol=1e-13)
        np.testing.assert_allclose(law.error(position, heard, met), 0.0, atol=1e-13)


def test_consensus_is_displacement_by_nothing_and_meets_in_the_middle():
    pairs = [(i, j) for i in range(4) for j in range(4) if i != j]
    net = links(pairs, [0.0] * 12, [0.1] * 12)
    net = Links(net.receiver, net.sender, net.distance, net.gain, np.zeros((12, 3)), None, np.full(12, BY_RELATIVE))
    position = np.random.default_rng(3).uniform(-1, 1, (4, 3))
    middle = position.mean(axis=0)
    for _ in range(60):
        position = position + Displacement().offset(position, position[net.sender], net)
    np.testing.assert_allclose(position, np.tile(middle, (4, 1)), atol=1e-12)


def test_robots_on_the_wrong_side_of_a_direction_turn_round():
    net = links([(1, 0)], [1.0], [1.0])
    net = Links(net.receiver, net.sender, net.distance, net.gain, None, np.array([[1.0, 0.0, np.nan]]), None)
    ahead, behind = np.array([[0, 0, 0], [0.5, 0.2, 0.7]]), np.array([[0, 0, 0], [-0.5, 0.2, 0.7]])
    heard = np.zeros((1, 3))
    np.testing.assert_allclose(Bearing().offset(ahead, heard, net)[1], [0.0, -0.2, 0.0], atol=1e-15)
    np.testing.assert_allclose(Bearing().offset(behind, heard, net)[1], [0.5, -0.2, 0.0], atol=1e-15)
    np.testing.assert_allclose(Bearing().error(behind, heard, net), [np.hypot(0.5, 0.2)])


@pytest.mark.parametrize(("length", "as_if"), [(1.2, 1.15), (0.8, 0.85), (1.05, 1.0), (0.95, 1.0), (1.0, 1.0)])
def test_a_dead_zone_takes_its_width_from_every_error(length, as_if):
    net = links([(0, 1)], [1.0], [3.0])
    position = np.array([[length, 0.0, 0.0], [0.0, 0.0, 0.0]])
    offset = Distance(dead_zone=0.05).offset(position, position[[1]], net)
    np.testing.assert_allclose(offset[0], [1.5 * (1.0 - as_if**2) * length, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(Distance(dead_zone=0.05).error(position, position[[1]], net), [abs(1.0 - length)])


def turning(law, disagree, steps=3000):
    """Rate [rad/decision] at which a triangle turns of which each robot wants the sides to its two neighbours longer
    and shorter by `disagree` [m] than these want them; and the worst error of a side at the end [m]."""
    pairs = [(i, (i + s) % 3) for i in range(3) for s in (1, 2)]
    net = links(pairs, [0.6 + (disagree if (j - i) % 3 == 1 else -disagree) for i, j in pairs], [0.3] * 6)
    angle = 2 * np.pi * np.arange(3) / 3
    position = np.stack([np.cos(angle), np.sin(angle), np.zeros(3)], axis=1) * 0.4
    facing = []
    for _ in range(steps):
        position = position + law.offset(position, position[net.sender], net)
        facing.append(np.arctan2(*(position[0] - position.mean(axis=0))[1::-1]))
    late = np.unwrap(facing)[-100:]
    sides = np.linalg.norm(position - np.roll(position, 1, axis=0), axis=1)
    return abs(late[-1] - late[0]) / 99, np.abs(sides - 0.6).max()


def test_robots_that_disagree_turn_for_ever_unless_a_dead_zone_spans_what_they_disagree_by():
    rate, _ = turning(Distance(), 0.01)
    assert 1e-3 < rate < 1e-2
    assert turning(Distance(), 0.02)[0] == pytest.approx(2 * rate, rel=0.1)
    assert turning(Distance(), 0.0)[0] < 1e-12
    still, error = turning(Distance(dead_zone=0.0101), 0.01)
    assert still < 1e-9
    assert error < 0.01
    assert turning(Distance(dead_zone=0.005), 0.01)[0] > rate / 4


@FEW
@given(SEEDS)
def test_tracking_is_the_paper_s_cubic_pull(seed):
    rng = np.random.default_rng(seed)
    position, target, gain = rng.normal(size=(4, 3)), rng.normal(size=(4, 3)), rng.uniform(0.1, 5.0, 4)
    pull = tracking_offset(position, target, gain)
    for i in range(4):
        away = position[i] - target[i]
        np.testing.assert_allclose(pull[i], -0.5 * gain[i] * (away @ away) * away, rtol=1e-12)
    np.testing.assert_allclose(tracking_offset(position, target, 2.0)[1], pull[1] * 2.0 / gain[1], rtol=1e-12)


def test_tracking_ignores_rows_without_a_target():
    position = np.ones((2, 3))
    target = np.array([[np.nan, np.nan, np.nan], [0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(tracking_offset(position, target, 2.0), [[0, 0, 0], [-2, -2, 0]])


@FEW
@given(SEEDS, st.floats(0.01, 0.5))
def test_the_goal_is_within_the_clamp_on_every_axis(seed, limit):
    rng = np.random.default_rng(seed)
    position, offset = rng.normal(size=(6, 3)), rng.normal(size=(6, 3))
    step = goal_position(position, offset, limit) - position
    assert (np.abs(step) <= limit + 1e-12).all()
    free = np.abs(offset) < limit
    np.testing.assert_allclose(step[free], offset[free], atol=1e-12)
    np.testing.assert_allclose(step[~free], limit * np.sign(offset[~free]), atol=1e-12)
