"""The cascade by itself: what each loop answers to what, with the firmware's figures worked out by hand."""

import math

import numpy as np
import pytest

from bridges.crazyflie.mujoco.cascade import BASE, FULL, LEAST, MIX, OUTER, RATE_HZ, SPEED, TILT, Firmware, Gains, Pid

DT = 1.0 / RATE_HZ
NONE = np.zeros((1, 3))


def guided(offset=NONE, velocity=NONE, wanted=None, yaw=0.0):
    """A cascade after one step of its outer loops."""
    made = Firmware(1, DT)
    by_velocity = np.array([wanted is not None])
    flown = NONE if wanted is None else np.array([wanted])
    made.advance_outer_loops(
        np.array(offset, dtype=float), np.array(velocity, dtype=float), flown, by_velocity, np.array([yaw])
    )
    return made


def test_a_pid_is_its_formula():
    gains = Gains((2.0, 3.0, 0.0), (0.5, 0.0, 0.0), (0.0, 0.1, 0.0), (0.3, 1.0, 1.0))
    pid = Pid(gains, 1, 0.1)
    first = pid.advance(np.array([[1.0, 1.0, 1.0]]), np.array([[0.0, 5.0, 0.0]]))
    np.testing.assert_allclose(first, [[2.0 + 0.5 * 0.1, 3.0, 0.0]])  # no derivative of the first value
    second = pid.advance(np.array([[1.0, 1.0, 1.0]]), np.array([[0.0, 5.2, 0.0]]))
    np.testing.assert_allclose(second, [[2.0 + 0.5 * 0.2, 3.0 - 0.1 * 0.2 / 0.1, 0.0]])
    for _ in range(10):
        last = pid.advance(np.array([[1.0, 1.0, 1.0]]), np.array([[0.0, 5.2, 0.0]]))
    np.testing.assert_allclose(last, [[2.0 + 0.5 * 0.3, 3.0, 0.0]])  # the integral has its limit
    pid.reset(np.array([0]))
    np.testing.assert_allclose(pid.advance(np.array([[1.0, 1.0, 1.0]]), np.array([[0.0, 9.0, 0.0]])), first)


def test_ahead_pitches_nose_down_and_left_rolls_left():
    roll, pitch = guided([[0.1, 0.0, 0.0]]).angles[0, :2]
    assert pitch == pytest.approx(25.0 * 0.2 + 1.0 * 0.2 * OUTER * DT)
    assert roll == 0.0
    roll, pitch = guided([[0.0, 0.1, 0.0]]).angles[0, :2]
    assert roll == pytest.approx(-(25.0 * 0.2 + 0.2 * OUTER * DT))
    assert pitch == 0.0
    turned = guided([[0.0, 0.1, 0.0]], yaw=math.pi / 2).angles[0, :2]  # what is left of the room is ahead of it
    np.testing.assert_allclose(turned, [0.0, 25.0 * 0.2 + 0.2 * OUTER * DT], atol=1e-12)
    by_velocity = guided([[9.0, 9.0, 9.0]], wanted=[0.2, 0.0, 0.0]).angles[0, :2]  # instead of by position
    np.testing.assert_allclose(by_velocity, [0.0, 25.0 * 0.2 + 0.2 * OUTER * DT])


def test_limits_of_speed_tilt_and_thrust():
    far = guided([[9.0, 0.0, 0.0]], [[SPEED - 0.1, 0.0, 0.0]])
    assert far.angles[0, 1] == pytest.approx(25.0 * 0.1 + 0.1 * OUTER * DT)  # only 0.1 m/s are missing
    assert guided([[9.0, -9.0, 0.0]]).angles[0, :2].tolist() == pytest.approx([TILT, TILT])
    level = (NONE, NONE, np.zeros(1))
    up = guided([[0.0, 0.0, 9.0]]).advance_inner_loops(*level)
    lift = 25.0 * SPEED + 15.0 * SPEED * OUTER * DT
    np.testing.assert_allclose(up, np.full((1, 4), (BASE + 1000.0 * lift) / FULL))
    down = guided([[0.0, 0.0, -9.0]]).advance_inner_loops(*level)
    np.testing.assert_allclose(down, np.full((1, 4), LEAST / FULL))
    rest = guided().advance_inner_loops(*level)
    np.testing.assert_allclose(4 * 0.12 * rest[0, 0], 0.995 * 0.027 * 9.81, rtol=1e-3)


def test_torques_turn_the_right_way():
    assert np.allclose(MIX.sum(axis=0), 0.0)  # a torque does not lift
    made = guided()
    step = math.radians(1.0)
    rate = 6.0 + 3.0 * DT  # deg/s asked for by one degree
    units = (250.0 + 500.0 * DT) * rate
    leaning = made.advance_inner_loops(np.array([[-step, 0.0, 0.0]]), NONE, np.zeros(1))
    np.testing.assert_allclose(FULL * leaning[0] - BASE, 0.5 * units * np.array([-1.0, -1.0, 1.0, 1.0]))
    nose_up = guided().advance_inner_loops(np.array([[0.0, -step, 0.0]]), NONE, np.zeros(1))
    np.testing.assert_allclose(FULL * nose_up[0] - BASE, 0.5 * units * np.array([-1.0, 1.0, 1.0, -1.0]))
    turn = guided().advance_inner_loops(NONE, NONE, np.array([step]))
    yawing = (120.0 + 16.7 * DT) * (6.0 + 1.0 * DT)
    np.testing.assert_allclose(FULL * turn[0] - BASE, yawing * np.array([-1.0, 1.0, -1.0, 1.0]))


def test_yaw_turns_the_short_way():
    for yaw, heading, left in ((0.0, 1.0, True), (1.0, -1.0, False), (3.0, -3.0, True), (-3.0, 3.0, False)):
        motors = guided().advance_inner_loops(np.array([[0.0, 0.0, yaw]]), NONE, np.array([heading]))[0]
        assert (motors[1] > motors[0]) == left


def test_motors_stay_in_range():
    for values in np.random.default_rng(1).uniform(-3.0, 3.0, (50, 4, 1, 3)):
        motors = guided(values[0], values[1], yaw=values[2, 0, 2]).advance_inner_loops(
            values[2], 5.0 * values[3], np.zeros(1)
        )
        assert 0.0 <= motors.min() <= motors.max() <= 1.0


def test_outer_loops_run_at_a_fifth_rate():
    made = guided([[0.1, 0.0, 0.0]])
    rolls = []
    for _ in range(OUTER):
        made.advance_outer_loops(np.array([[0.0, 0.1, 0.0]]), NONE, NONE, np.array([False]), np.zeros(1))
        rolls.append(made.angles[0, 0])
    assert rolls[:-1] == [0.0] * (OUTER - 1)
    assert rolls[-1] < -4.9
