"""The barrier: the nearest allowed velocity, exactly; numbers within limits, whatever comes in; nobody is touched."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from agents.arrays import norm
from agents.body.kinds import CRAZYFLIE, KHEPERA4, KINDS, TELLO, TURTLEBOT3
from agents.plugins.barrier import Barrier, _closest
from tests.agents.things import NOTHING, near, own

FEW = settings(max_examples=50)
ALL = tuple(KINDS.values())
nearby = st.floats(-1.5, 1.5)
BARRIER = Barrier()


# ---------------------------------------------------------------- the quadratic program


def half_planes(angles, bounds):
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)[None], np.array(bounds)[None]


@FEW
@given(
    st.lists(st.tuples(st.floats(-math.pi, math.pi), st.floats(-0.5, 1.0)), min_size=1, max_size=8),
    arrays(float, 2, elements=st.floats(-1, 1)),
)
def test_it_is_the_nearest_point_that_obeys_all_half_planes(planes, wanted):
    normal, bound = half_planes(*map(np.array, zip(*planes, strict=True)))
    found = _closest(wanted[None], normal, bound)[0]
    violation = (normal[0] @ found - bound[0]).max()
    grid = np.stack(np.meshgrid(*[np.linspace(-2, 2, 101)] * 2), axis=-1).reshape(-1, 2)
    over = (grid @ normal[0].T - bound[0]).max(axis=1)
    if violation <= 1e-7:
        allowed = grid[over <= 0.0]
        assert not len(allowed) or norm(found - wanted) <= norm(allowed - wanted).min() + 1e-9
    else:  # not all can be kept: nobody violates less
        assert over.min() >= violation - 1e-6


def test_a_wanted_velocity_that_is_allowed_is_taken_as_it_is():
    normal, bound = half_planes([0.0, 2.0], [0.3, 0.4])
    wanted = np.array([[0.1, 1 / 3]])
    np.testing.assert_array_equal(_closest(wanted, normal, bound), wanted)


def test_a_corner_of_two_half_planes():
    normal, bound = half_planes([0.0, 0.5 * math.pi], [0.1, 0.2])
    np.testing.assert_allclose(_closest(np.array([[1.0, 1.0]]), normal, bound), [[0.1, 0.2]], atol=1e-12)


def test_the_least_violation_of_two_that_face_each_other_and_of_three_around():
    normal, bound = half_planes([0.0, math.pi], [-0.1, -0.3])
    np.testing.assert_allclose(_closest(np.zeros((1, 2)), normal, bound), [[0.1, 0.0]], atol=1e-6)
    normal, bound = half_planes(np.radians([0.0, 120.0, 240.0]), [-0.2, -0.2, -0.2])
    np.testing.assert_allclose(_closest(np.ones((1, 2)), normal, bound), [[0.0, 0.0]], atol=1e-6)


# ---------------------------------------------------------------- what is allowed


def test_a_robot_gets_half_of_the_gap_and_less_of_one_that_comes_faster():
    here = own((TELLO,), [0.0, 0.0, 1.0], velocity=[0.3, 0.0, 0.0])
    place = [TELLO.radius + CRAZYFLIE.radius + 0.05 + 0.4, 0.0]
    left = 0.4 - 0.3 * TELLO.lag
    thing = near([0], place, radius=CRAZYFLIE.radius)
    normal, bound = BARRIER.bounds(here, thing)
    np.testing.assert_allclose(normal, [[1.0, 0.0]])
    np.testing.assert_allclose(bound, [0.5 * 3.0 * left])
    comes = near([0], place, radius=CRAZYFLIE.radius, velocity=[-0.2, 0.7], heard=True, lag=CRAZYFLIE.lag)
    left -= 0.2 * CRAZYFLIE.lag
    np.testing.assert_allclose(BARRIER.bounds(here, comes)[1], [min(1.5 * left, 3.0 * left - 0.2)])
    leaves = near([0], place, radius=CRAZYFLIE.radius, velocity=[0.2, 0.0], heard=True, lag=CRAZYFLIE.lag)
    np.testing.assert_allclose(BARRIER.bounds(here, leaves)[1], [1.5 * (0.4 - 0.3 * TELLO.lag)])


def test_both_halves_together_never_use_up_more_than_alpha_of_the_gap():
    gap = np.linspace(-0.04, 0.6, 40)
    for g in gap:
        both = own((TELLO, TELLO), [[0.0, 0.0], [0.25 + g, 0.0]])
        other = near([0, 1], [[0.25 + g, 0.0], [0.0, 0.0]], radius=TELLO.radius, heard=True)
        setpoint = np.array([[1.0, 0, 0, 0], [-1.0, 0, 0, 0]])
        u = Barrier(right=0.0).restrain(setpoint, both, other)[:, 0]
        assert u[0] - u[1] <= max(3.0 * g, 2 * 3.0 * g * (g < 0)) + 1e-9
        if g < -0.01:
            assert u[0] < 0.0 < u[1]


@pytest.mark.parametrize("kind", [TELLO, CRAZYFLIE])
def test_velocities_and_positions_are_restrained_alike(kind):
    here = own((kind,), [0.2, -0.1, 1.0])
    wanted = np.array([0.4, 0.3])
    reach = kind.radius + 0.05 + 0.1
    thing = near([0], [0.2 + reach, -0.1])
    sent = [*wanted, 0.1, 0.2] if kind is TELLO else [*(here.position[0, :2] + wanted / kind.response), 1.1, 0.2]
    out = Barrier(right=0.0).restrain(np.array([sent]), here, thing)[0]
    u = out[:2] if kind is TELLO else kind.response * (out[:2] - here.position[0, :2])
    np.testing.assert_allclose(u, [0.15, 0.3], atol=1e-9)
    assert out[2:].tolist() == sent[2:]


def test_a_robot_on_wheels_is_slowed_along_its_heading_exactly_and_may_always_turn():
    reach = KHEPERA4.radius + 0.05
    for yaw in np.linspace(-3.1, 3.1, 21):
        here = own((KHEPERA4,), [0.0, 0.0], yaw=yaw)
        thing = near([0], [reach + 0.06, 0.0])
        out = BARRIER.restrain(np.array([[0.25, 3.0, 0.0, 0.0]]), here, thing)[0]
        toward = 0.25 * math.cos(yaw)
        assert out[0] == pytest.approx(0.25 if toward <= 0.09 else 0.09 / math.cos(yaw))
        assert out[1:].tolist() == [3.0, 0.0, 0.0]
        touching = near([0], [reach, 0.0])
        out = BARRIER.restrain(np.array([[0.25, 3.0, 0.0, 0.0]]), here, touching)[0]
        assert out[0] * math.cos(yaw) <= 1e-9


def test_one_on_wheels_backs_off_and_stands_where_it_is_torn():
    here = own((KHEPERA4,), [0.0, 0.0])
    inside = KHEPERA4.radius + 0.03  # 2 cm of the margin are used up
    out = BARRIER.restrain(np.zeros((1, 4)), here, near([0], [inside, 0.0]))
    assert -0.06 <= out[0, 0] < -0.05
    both = near([0, 0], [[inside, 0.0], [-inside, 0.0]])
    assert BARRIER.restrain(np.array([[0.2, 0, 0, 0]]), here, both)[0, 0] == 0.0
    fast = near([0], [0.3, 0.0], velocity=[-2.0, 0.0], heard=True)
    assert BARRIER.restrain(np.zeros((1, 4)), here, fast)[0, 0] == -KHEPERA4.speed


def test_things_in_all_directions_are_all_obeyed():
    rng = np.random.default_rng(5)
    rows = 200
    kinds = (TELLO,) * rows
    here = own(kinds, rng.uniform(-9, 9, (rows, 2)))
    row = np.repeat(np.arange(rows), 30)
    angle, gap = rng.uniform(-math.pi, math.pi, rows * 30), rng.uniform(0.0, 0.5, rows * 30)
    reach = (TELLO.radius + 0.05 + gap)[:, None]
    things = near(row, here.position[row, :2] + reach * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    setpoint = rng.uniform(-1, 1, (rows, 4))
    out = BARRIER.restrain(setpoint, here, things)
    normal, bound = BARRIER.bounds(here, things)
    assert (np.vecdot(normal, out[row, :2]) <= bound + 1e-6).all()
    assert norm(out[:, :2]).max() <= TELLO.speed * (1 + 1e-12)


# ---------------------------------------------------------------- whatever comes in


def anywhere(kinds, things):
    return st.tuples(
        arrays(float, (len(kinds), 4), elements=nearby),
        arrays(float, (len(kinds), 3), elements=nearby),
        arrays(float, (len(kinds), 3), elements=nearby),
        arrays(float, len(kinds), elements=st.floats(-7, 7)),
        arrays(np.intp, things, elements=st.integers(0, len(kinds) - 1)),
        arrays(float, (things, 2), elements=nearby),
        arrays(float, (things, 2), elements=nearby),
        arrays(bool, things),
    )


@FEW
@given(anywhere(ALL, 12), st.floats(0, 2), st.floats(0.1, 10))
def test_what_comes_out_are_numbers_within_the_limits(given_, right, alpha):
    setpoint, place, velocity, yaw, row, at, moves, heard = given_
    here = own(ALL, place, yaw=yaw, velocity=velocity)
    things = near(row, at, velocity=np.where(heard[:, None], moves, 0.0), radius=np.where(heard, 0.1, 0.0), heard=heard)
    barrier = Barrier(right=right, alpha=alpha)
    before = setpoint.copy()
    out, goal = barrier.restrain(setpoint, here, things), barrier.deviate(place + 0.1, here, things, 0.01)
    np.testing.assert_array_equal(setpoint, before)
    assert np.isfinite(out).all()
    assert np.isfinite(goal).all()
    other = (out != setpoint).any(axis=1)
    u = np.where(here.by_position[:, None], here.response[:, None] * (out[:, :2] - place[:, :2]), out[:, :2])
    u[here.by_twist, 1] = 0.0
    assert (norm(u)[other] <= here.speed[other] * (1 + 1e-9)).all()
    alone = ~np.isin(np.arange(len(ALL)), row)
    np.testing.assert_array_equal(out[alone], setpoint[alone])
    np.testing.assert_array_equal(out[:, 2:], setpoint[:, 2:])
    np.testing.assert_array_equal(out[here.by_twist, 1], setpoint[here.by_twist, 1])


@FEW
@given(anywhere(ALL, 12))
def test_a_row_gets_the_same_bits_alone_and_among_others(given_):
    setpoint, place, velocity, yaw, row, at, moves, heard = given_
    here = own(ALL, place, yaw=yaw, velocity=velocity)
    things = near(row, at, velocity=moves, radius=0.07, heard=heard, lag=0.1)
    goal = place + setpoint[:, :3]
    out, steered = BARRIER.restrain(setpoint, here, things), BARRIER.deviate(goal, here, things, 0.01)
    for k, kind in enumerate(ALL):
        mine = row == k
        single = own((kind,), place[[k]], yaw=yaw[[k]], velocity=velocity[[k]])
        own_things = near(row[mine] * 0, at[mine], velocity=moves[mine], radius=0.07, heard=heard[mine], lag=0.1)
        np.testing.assert_array_equal(BARRIER.restrain(setpoint[[k]], single, own_things)[0], out[k])
        np.testing.assert_array_equal(BARRIER.deviate(goal[[k]], single, own_things, 0.01)[0], steered[k])


def test_without_things_nearby_nothing_is_touched():
    rows = len(ALL)
    setpoint, goal = np.full((rows, 4), 0.3), np.full((rows, 3), 0.3)
    here = own(ALL, np.zeros((rows, 3)))
    assert BARRIER.restrain(setpoint, here, NOTHING) is setpoint
    assert BARRIER.deviate(goal, here, NOTHING, 0.01) is goal
    far = near(list(range(rows)), np.full((rows, 2), 2.0))
    assert BARRIER.restrain(setpoint, here, far) is setpoint


# ---------------------------------------------------------------- what it leads to


def flown(barrier, place, goal, filters, *, seconds=8.0, kind=TELLO, speed=1.0):
    """Bodies whose velocity follows with the lag of their kind, at 100 Hz; smallest gap, and where they end."""
    many, dt = len(place), 0.01
    kinds = (kind,) * many
    place, velocity, least = np.array(place, dtype=float), np.zeros((many, 3)), np.inf
    pairs = np.array([(i, j) for i in range(many) for j in range(many) if i != j])
    row, other = pairs[np.isin(pairs[:, 0], np.flatnonzero(filters))].T
    for _ in range(round(seconds / dt)):
        here = own(kinds, place, velocity=velocity)
        way = np.array(goal) - place
        wanted = np.zeros((many, 4))
        wanted[:, :2] = way * np.minimum(1.0, speed / np.maximum(norm(way), 1e-9))[:, None]
        heard = near(row, place[other], velocity=velocity[other, :2], radius=kind.radius, heard=True, lag=kind.lag)
        u = barrier.restrain(wanted, here, heard)
        velocity[:, :2] += dt / kind.lag * (u[:, :2] - velocity[:, :2])
        place = place + dt * velocity[:, :2]
        apart = norm(place[:, None] - place)[np.triu_indices(many, 1)]
        least = min(least, float(apart.min()) - 2 * kind.radius)
    return least, place


@pytest.mark.slow
def test_with_both_halves_kept_the_margin_itself_is_kept_in_spite_of_the_lag():
    rng = np.random.default_rng(11)
    for _ in range(8):
        angle = rng.uniform(0, 2 * math.pi, 2)
        start = np.array([[-1.0, 0.0], [math.cos(angle[0]), math.sin(angle[0])]]) + rng.uniform(-0.2, 0.2, (2, 2))
        if norm(start[0] - start[1]) < 0.7:
            continue
        least, _ = flown(BARRIER, start, -start, [True, True], seconds=4.0)
        assert least >= BARRIER.margin - 0.005  # 5 mm for steps of 10 ms and vectors that turn


def test_one_that_does_not_avoid_is_kept_clear_of():
    for start, goal in (([[0.0, 0.0], [1.5, 0.02]], [[0, 0], [-1.5, 0.02]]), ([[-1, 0], [0, -1]], [[1, 0], [0, 1]])):
        least, _ = flown(BARRIER, start, goal, [True, False], speed=0.5)
        assert least > 0.03


def test_head_on_both_pass_on_their_right_and_arrive():
    start = [[-1.0, 0.0], [1.0, 0.0]]
    _, early = flown(BARRIER, start, [[1.0, 0.0], [-1.0, 0.0]], [True, True], seconds=1.5)
    assert early[0, 1] < -0.01
    assert early[1, 1] > 0.01
    least, there = flown(BARRIER, start, [[1.0, 0.0], [-1.0, 0.0]], [True, True])
    np.testing.assert_allclose(there, [[1.0, 0.0], [-1.0, 0.0]], atol=0.01)
    assert least > 0.04
    _, stuck = flown(Barrier(right=0.0), start, [[1.0, 0.0], [-1.0, 0.0]], [True, True])
    assert stuck[0, 0] < 0.0 < stuck[1, 0]  # without the preference the symmetry is never broken


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_one_that_is_too_fast_is_dodged_to_the_side_where_the_robot_is(side):
    here = own((TURTLEBOT3,), [0.0, 0.0])
    comes = near([0], [0.6, -0.05 * side], velocity=[-0.8, 0.0], radius=0.1, heard=True, lag=0.1)
    goal = BARRIER.deviate(np.zeros((1, 3)), here, comes, 0.01)
    assert goal[0, 1] * side > 0.02


def test_a_robot_on_wheels_is_steered_around_what_is_in_its_way():
    here = own((KHEPERA4,), [0.0, 0.0])
    thing = near([0], [0.3, 0.0], radius=0.07, heard=True)
    goal = BARRIER.deviate(np.array([[1.0, 0.0, 0.0]]), here, thing, 0.01)
    assert goal[0, 1] < -0.05  # to the right
    clear = near([0], [-0.3, 0.0], radius=0.07, heard=True)
    ahead = np.array([[1.0, 0.0, 0.0]])
    assert BARRIER.deviate(ahead, here, clear, 0.01) is ahead


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
def test_a_velocity_of_any_size_is_answered_within_the_limits(kind):
    """Beyond 1e8 m/s no half-plane is met exactly, and one alone has no pair that it could give way to."""
    for exponent in range(2, 39):
        me = own([kind], [[0.0, 0.0]], velocity=[-(10.0**exponent), 0.0, 0.0])
        thing = near([0], [[-0.5, 0.07]], radius=0.07, heard=True, lag=0.1)
        restrained = BARRIER.restrain(np.array([[-1.0, 0.0, 0.0, 0.0]]), me, thing)
        assert np.isfinite(restrained).all()
        speed = norm(restrained[:, :2]) * (kind.response if kind.takes == "position" else 1.0)
        assert speed <= kind.speed + 1e-9
