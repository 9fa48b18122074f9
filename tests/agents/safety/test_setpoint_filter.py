"""The last word: whatever comes in, what goes out is a setpoint that the robot may have."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from agents.body.kinds import CRAZYFLIE, KHEPERA4, KINDS, TELLO
from agents.body.limits import Limits
from agents.safety.setpoint_filter import FLOOR_M, OUTSIDE_M, SetpointFilter

FEW = settings(max_examples=60)
ALL = tuple(KINDS.values())
TAKES = np.array([kind.takes for kind in ALL])
FLIES = np.array([kind.flies for kind in ALL])
LIMITS = Limits(np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 2.5]), margin=0.05, speed=0.5, goal_step=0.4)
ROWS = len(ALL)
anything = st.one_of(
    st.floats(-3.0, 3.0), st.floats(), st.sampled_from([np.nan, np.inf, -np.inf, 1e308, -1e308, 1e6, 0.0, -0.0])
)
nearby = st.floats(-1.3, 1.3)
FRESH = np.zeros(ROWS)


def bounds(limits=LIMITS):
    """Where goals may lie (rows, 3): heights of ground robots are nobody's business."""
    low, high = np.tile(limits.low, (ROWS, 1)), np.tile(limits.high, (ROWS, 1))
    low[:, :2] += limits.margin
    high[:, :2] -= limits.margin
    high[:, 2] -= limits.margin
    low[:, 2] += [max(kind.height, FLOOR_M) for kind in ALL]
    low[~FLIES, 2], high[~FLIES, 2] = -np.inf, np.inf
    return low, high


@FEW
@given(
    arrays(float, (ROWS, 4), elements=anything),
    arrays(float, (ROWS, 3), elements=st.one_of(nearby, anything)),
    arrays(float, ROWS, elements=anything),
    arrays(float, ROWS, elements=st.one_of(st.floats(0, 1), anything)),
)
def test_whatever_comes_in_a_lawful_setpoint_goes_out(setpoint, position, yaw, age):
    before = setpoint.copy(), position.copy(), yaw.copy()
    verdict = SetpointFilter(ALL, LIMITS).check(setpoint, position, yaw, age)
    for kept, now in zip(before, (setpoint, position, yaw), strict=True):
        np.testing.assert_array_equal(kept, now)
    safe, blind = verdict.setpoint, verdict.invalid_pose
    believable = (np.abs(position) < 1e6).all(axis=1) & (np.abs(yaw) < 1e6)
    np.testing.assert_array_equal(blind, ~(believable & (np.abs(age) <= LIMITS.own_silence_s)))
    by_position = TAKES == "position"
    assert np.isnan(safe[blind & by_position]).all()
    assert np.isfinite(safe[~(blind & by_position)]).all()
    assert not safe[blind & ~by_position].any()
    speed = np.minimum([kind.speed for kind in ALL], LIMITS.speed)
    turn = np.array([kind.turn_rate for kind in ALL])
    for row in np.flatnonzero(~by_position):
        linear = safe[row, :3] if TAKES[row] == "velocity" else safe[row, 0]
        rate = safe[row, 3] if TAKES[row] == "velocity" else safe[row, 1]
        assert np.abs(linear).max() <= speed[row]
        assert abs(rate) <= turn[row]
    low, high = bounds()
    for row in np.flatnonzero(by_position & ~blind):
        step = safe[row, :3] - position[row]
        longest = min(LIMITS.goal_step, speed[row] / ALL[row].response)
        assert np.linalg.norm(step) <= longest * (1 + 1e-9) + 1e-9 * np.abs(position[row]).max()
        inside = (position[row] >= low[row]) & (position[row] <= high[row])
        assert (safe[row, :3][inside] >= low[row][inside] - 1e-12).all()
        assert (safe[row, :3][inside] <= high[row][inside] + 1e-12).all()
        assert (step[position[row] > high[row]] <= 0.0).all()  # from outside, only inward
        assert (step[position[row] < low[row]] >= 0.0).all()


@FEW
@given(arrays(float, (ROWS, 4), elements=nearby), arrays(float, (ROWS, 3), elements=nearby), nearby)
def test_nobody_is_driven_farther_out(setpoint, position, turned):
    yaw = np.full(ROWS, 3.0 * turned)
    safe = SetpointFilter(ALL, LIMITS).check(setpoint, position, yaw, FRESH).setpoint
    low, high = bounds()
    for row in range(ROWS):
        if TAKES[row] == "position":
            continue
        velocity = safe[row, :3]
        if TAKES[row] == "twist":
            velocity = np.array([safe[row, 0] * math.cos(yaw[row]), safe[row, 0] * math.sin(yaw[row]), 0.0])
        assert not (velocity[position[row] > high[row]] > 0.0).any()
        assert not (velocity[position[row] < low[row]] < 0.0).any()


@FEW
@given(arrays(float, (ROWS, 4), elements=st.one_of(nearby, anything)), arrays(float, (ROWS, 3), elements=nearby))
def test_changed_says_whether_it_was_changed(setpoint, position):
    verdict = SetpointFilter(ALL, LIMITS).check(setpoint, position, np.zeros(ROWS), FRESH)
    same = np.isclose(verdict.setpoint, setpoint, rtol=0, atol=1e-9).all(axis=1)
    np.testing.assert_array_equal(verdict.changed, ~same)


@FEW
@given(arrays(float, (ROWS, 4), elements=anything), arrays(float, (ROWS, 3), elements=st.one_of(nearby, anything)))
def test_rows_are_checked_as_if_each_were_alone(setpoint, position):
    yaw, age = np.linspace(-3, 3, ROWS), np.linspace(0, 0.7, ROWS)
    whole = SetpointFilter(ALL, LIMITS).check(setpoint, position, yaw, age)
    for row in range(ROWS):
        one = slice(row, row + 1)
        alone = SetpointFilter(ALL[one], LIMITS).check(setpoint[one], position[one], yaw[one], age[one])
        for field in ("setpoint", "changed", "invalid_pose", "not_finite"):
            np.testing.assert_array_equal(getattr(alone, field)[0], getattr(whole, field)[row])


def check(kind, setpoint, position, *, yaw=0.0, age=0.0, limits=LIMITS):
    return SetpointFilter((kind,), limits).check(
        np.array([setpoint]), np.array([position]), np.array([yaw]), np.array([age])
    )


def whereabouts(kind, position, *, yaw=0.0, age=0.0, limits=LIMITS):
    return SetpointFilter((kind,), limits).validate_poses(np.array([position]), np.array([yaw]), np.array([age]))


def test_lawful_setpoints_pass_untouched():
    for kind, setpoint in (
        (CRAZYFLIE, [0.1, 0.2, 0.8, 0.3]),
        (TELLO, [0.2, 0.1, -0.1, 1.0]),
        (KHEPERA4, [0.2, 2.0, 0, 0]),
    ):
        verdict = check(kind, setpoint, [0.0, 0.0, 0.8])
        np.testing.assert_array_equal(verdict.setpoint, [setpoint])
        assert (verdict.changed[0], verdict.invalid_pose[0], verdict.not_finite[0]) == (False, False, False)


def test_goals_are_pulled_into_the_arena_and_near_the_robot():
    high = check(CRAZYFLIE, [0.0, 0.0, 9.0, 0.5], [0.0, 0.0, 2.3])
    np.testing.assert_allclose(high.setpoint, [[0.0, 0.0, 2.39, 0.5]])
    # 0.5 m/s, closed at 2/s: a goal may be 0.25 m ahead
    far = check(CRAZYFLIE, [0.9, 0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
    np.testing.assert_allclose(far.setpoint, [[0.25, 0.0, 1.0, 0.0]])
    near = check(
        CRAZYFLIE, [0.9, 0.0, 1.0, 0.0], [0.0, 0.0, 1.0], limits=Limits(LIMITS.low, LIMITS.high, goal_step=0.1)
    )
    np.testing.assert_allclose(near.setpoint, [[0.1, 0.0, 1.0, 0.0]])
    assert high.changed[0]
    assert far.changed[0]


def test_the_lower_of_two_speed_limits_counts():
    np.testing.assert_array_equal(check(KHEPERA4, [9.0, 0, 0, 0], [0, 0, 0]).setpoint, [[KHEPERA4.speed, 0, 0, 0]])
    np.testing.assert_array_equal(check(TELLO, [9.0, 0, 0, 0], [0, 0, 1]).setpoint, [[0.5, 0, 0, 0]])


def test_a_ground_robot_beyond_the_wall_may_turn_and_come_back():
    out, back = (check(KHEPERA4, [v, 1.0, 0, 0], [0.97, 0.0, 0.0]) for v in (0.2, -0.2))
    np.testing.assert_array_equal(out.setpoint, [[0.0, 1.0, 0.0, 0.0]])
    np.testing.assert_array_equal(back.setpoint, [[-0.2, 1.0, 0.0, 0.0]])
    assert (out.changed[0], back.changed[0]) == (True, False)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_escaped_is_far_outside(axis, side):
    edge = np.array([0.0, 0.0, 1.25])
    edge[axis] = LIMITS.high[axis] if side > 0 else LIMITS.low[axis]
    for beyond, escaped in ((OUTSIDE_M - 0.01, False), (OUTSIDE_M + 0.01, True)):
        place = edge.copy()
        place[axis] += side * beyond
        where = whereabouts(CRAZYFLIE, place.tolist())
        assert (bool(where.outside[0]), bool(where.invalid[0]), where.all_valid) == (escaped, False, False)
        assert where.excess[0] == pytest.approx(beyond)
        assert bool(where.outside_wall[0]) == (axis < 2 or side > 0)  # floors are measured a little below themselves


@pytest.mark.parametrize(("age", "blind"), [(0.0, False), (0.5, False), (0.51, True), (np.inf, True), (np.nan, True)])
def test_an_old_position_is_none(age, blind):
    verdict = check(TELLO, [0.1, 0, 0, 0], [0, 0, 1.0], age=age)
    assert verdict.invalid_pose[0] == blind
    np.testing.assert_array_equal(verdict.setpoint, [[0.0 if blind else 0.1, 0, 0, 0]])


def test_a_goal_that_is_no_number_means_stay_here():
    verdict = check(CRAZYFLIE, [np.nan, 0.0, 0.0, 0.0], [0.3, 0.2, 0.8])
    np.testing.assert_array_equal(verdict.setpoint, [[0.3, 0.2, 0.8, 0.0]])
    assert verdict.changed[0]
