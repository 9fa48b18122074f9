"""Transmitted poses: smoothed without lag, and none of a robot that does not know where it is."""

from math import exp, floor, inf, isnan, log, nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.decision.transmission import LowPass, Transmitter
from agents.kinds.crazyflie import CRAZYFLIE
from agents.kinds.khepera4 import KHEPERA4
from agents.kinds.tello import TELLO
from agents.plugins.predictors import HOLD, ConstantVelocity
from agents.plugins.triggers import SendOnDelta
from agents.vectors import NO_SETPOINT
from tests.cases import examples

DT = 0.02
STILL, LOST = (0.0, 0.0, 0.0), (nan, nan, nan)


def say(transmitter, t, position, velocity=STILL):
    return transmitter.transmits(t, position, velocity, 0.0, 0.0, t, STILL, NO_SETPOINT)


@examples(25)
@given(st.floats(0.05, 2.0), st.floats(-0.5, 0.5))
def test_low_pass_does_not_lag(constant, speed):
    smooth, velocity = LowPass(KHEPERA4), (speed, 0.0, 0.0)
    for k in range(200):
        smooth.smooth(k * DT, (speed * k * DT, 0.0, 0.0), velocity, constant, NO_SETPOINT)
    assert smooth.position == pytest.approx((speed * 199 * DT, 0.0, 0.0), abs=1e-12)
    assert smooth.velocity == pytest.approx(velocity, abs=1e-12)


def test_low_pass_has_its_time_constant():
    smooth, step = LowPass(KHEPERA4), (1.0, 0.0, 0.0)
    smooth.smooth(0.0, STILL, STILL, 0.5, NO_SETPOINT)
    for k in range(1, 51):
        smooth.smooth(k * 0.01, step, step, 0.5, NO_SETPOINT)
    # the speed carries it on as well, by 1 m/s · τ · (1 − 1/e)
    assert smooth.velocity[0] == pytest.approx(1.0 - exp(-1.0), rel=1e-9)
    assert smooth.position[0] == pytest.approx((1.0 - exp(-1.0)) * 1.5, rel=0.01)


@pytest.mark.parametrize("kind", [CRAZYFLIE, TELLO])
def test_drones_are_carried_by_their_setpoints(kind):
    rng, speed, wobble = np.random.default_rng(2), 0.2, np.zeros(2)
    smooth, off, x = LowPass(kind), [], 0.0
    for k in range(9000):
        wobble = 0.96 * wobble + 0.28 * rng.normal(0.0, 0.01, 2)
        setpoint = (x + speed / kind.response, 0.0, 0.0, 0.0) if kind is CRAZYFLIE else (speed, 0.0, 0.0, 0.0)
        measured = (x + float(wobble[0]), float(wobble[1]), 0.0)
        smooth.smooth(k * DT, measured, (9.0 + speed, 9.0, 0.0), 0.4, setpoint)
        off.append([smooth.position[0] - x, smooth.position[1]])
        x += DT * speed
    assert np.abs(np.mean(off[2000:], axis=0)).max() < 0.003
    assert np.std(off[2000:], axis=0).max() < 0.009  # of a wobble of 0.01 m; its velocity would be 0.1 m/s and more


def test_drone_without_setpoints_is_believed():
    smooth, velocity = LowPass(CRAZYFLIE), (0.3, 0.3, 0.3)
    for k in range(200):
        smooth.smooth(k * DT, STILL, velocity, 0.4, NO_SETPOINT)
    assert smooth.velocity == pytest.approx(velocity, abs=1e-3)


def test_low_pass_begins_anew_after_a_loss():
    smooth, found = LowPass(KHEPERA4), []
    for k, place in enumerate((STILL, LOST, (1.0, 1.0, 1.0), (2.0, 1.0, 1.0))):
        smooth.smooth(k * DT, place, STILL, 1.0, NO_SETPOINT)
        found.append(smooth.position)
    assert found[:3] == [STILL, pytest.approx(LOST, nan_ok=True), (1.0, 1.0, 1.0)]
    assert 1.0 < found[3][0] < 1.1


def test_smoothed_pose_is_judged_and_transmitted():
    transmitter = Transmitter(SendOnDelta(threshold=0.01, smoothing_s=0.5), HOLD, KHEPERA4)
    assert say(transmitter, 0.0, STILL)
    quiet = 0
    while not say(transmitter, (quiet + 1) * DT, (0.1, 0.0, 0.0)):
        quiet += 1
    assert quiet == floor(-0.5 * log(0.9) / DT)
    assert transmitter.position == transmitter.asking.last.position
    assert 0.01 < transmitter.position[0] < 0.0137


def test_neither_unknown_places_nor_believed_motion_are_transmitted():
    transmitter = Transmitter(SendOnDelta(threshold=0.01), ConstantVelocity(), KHEPERA4)
    assert not say(transmitter, 0.0, LOST)
    assert transmitter.asking.last.time == -inf
    assert say(transmitter, DT, STILL, (0.1, 0.0, 0.0))
    assert transmitter.velocity == (0.1, 0.0, 0.0)
    assert not say(transmitter, 2 * DT, (0.1 * DT, 0.0, 0.0), (0.1, 0.0, 0.0))
    assert transmitter.position == (0.1 * DT, 0.0, 0.0)


@pytest.mark.parametrize("smoothing_s", [0.0, 0.5])
@pytest.mark.parametrize("velocity", [LOST, (60.0, 0.0, 0.0), (inf, 0.0, 0.0)])
def test_unknown_velocity_counts_as_standing(smoothing_s, velocity):
    transmitter = Transmitter(SendOnDelta(threshold=0.01, smoothing_s=smoothing_s), ConstantVelocity(), KHEPERA4)
    assert say(transmitter, 0.0, STILL, velocity)
    assert all(map(isnan, transmitter.velocity))
    assert transmitter.asking.last.velocity == STILL
    assert say(transmitter, 4.0, (1.0, 0.0, 0.0), velocity)
