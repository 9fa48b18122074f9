"""What is said: smoothed positions without lag, and nothing by those who do not know where they are."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.body.kinds import CRAZYFLIE, TELLO
from agents.decision.transmission import LowPass, Transmitter
from agents.plugins.predictors import ConstantVelocity
from agents.plugins.registry import PluginError
from agents.plugins.triggers import SendOnDelta, Trigger

DT = 0.02


def say(voice, t, position, velocity=None):
    rows = len(position)
    zeros = np.zeros(rows)
    still = np.zeros((rows, 3)) if velocity is None else velocity
    return voice.transmit(t, position, still, error=zeros, energy=zeros, start=zeros, offset=np.zeros((rows, 3)))


@settings(max_examples=25)
@given(st.floats(0.05, 2.0), st.floats(-0.5, 0.5))
def test_the_low_pass_does_not_lag_behind_a_constant_velocity(constant, speed):
    smooth, velocity = LowPass(1), np.array([[speed, 0.0, 0.0]])
    for k in range(200):
        position, moves = smooth.smooth(k * DT, velocity * (k * DT), velocity, constant)
    np.testing.assert_allclose(position, velocity * (199 * DT), atol=1e-12)
    np.testing.assert_allclose(moves, velocity, atol=1e-12)


def test_the_low_pass_has_its_time_constant():
    smooth, still = LowPass(1), np.zeros((1, 3))
    smooth.smooth(0.0, still, still, 0.5)
    step = np.array([[1.0, 0.0, 0.0]])
    for k in range(1, 51):
        position, velocity = smooth.smooth(k * 0.01, step, step, 0.5)
    # the speed carries it on as well, by 1 m/s · τ · (1 − 1/e)
    assert velocity[0, 0] == pytest.approx(1.0 - math.exp(-1.0), rel=1e-9)
    assert position[0, 0] == pytest.approx((1.0 - math.exp(-1.0)) * 1.5, rel=0.01)


def test_the_low_pass_takes_away_what_wobbles():
    rng = np.random.default_rng(1)
    noise = rng.normal(0.0, 0.01, (3000, 4, 3))
    smooth = LowPass(4)
    said = np.array([smooth.smooth(k * DT, at, np.zeros((4, 3)), 0.4)[0] for k, at in enumerate(noise)])
    share = 1.0 - math.exp(-DT / 0.4)
    assert said[200:].std() == pytest.approx(0.01 * math.sqrt(share / (2.0 - share)), rel=0.05)


def test_what_wobbles_is_carried_by_its_setpoints_and_follows_them_without_a_lag():
    rng = np.random.default_rng(2)
    response, speed = np.array([[CRAZYFLIE.response], [TELLO.response]]), 0.2
    smooth, place, velocity, wobble = LowPass(2, (CRAZYFLIE, TELLO)), np.zeros((2, 3)), np.zeros((2, 3)), 0.0
    said = []
    for k in range(3000):
        wobble = 0.96 * wobble + 0.28 * rng.normal(0.0, 0.01, (2, 3)) * [1.0, 1.0, 0.0]
        asked = np.array([[speed, 0.0, 0.0]] * 2)
        setpoint = np.zeros((2, 4))
        setpoint[0, :3], setpoint[1, :3] = place[0] + asked[0] / response[0], asked[1]
        position, said_velocity = smooth.smooth(k * DT, place + wobble, velocity + 9.0, 0.4, setpoint)
        said.append(np.concatenate([position - place, said_velocity - asked], axis=1)[:, :2])
        place = place + DT * asked
    off = np.array(said)[1500:]
    assert np.abs(off.mean(axis=0)).max() < 0.003
    assert off.std(axis=0).max() < 0.009  # of a wobble of 0.01 m; its velocity would be 0.1 m/s and more
    smooth = LowPass(1, (CRAZYFLIE,))
    for k in range(200):  # who drives itself, while it takes off or lands, is believed what it measures
        _, said_velocity = smooth.smooth(k * DT, np.zeros((1, 3)), np.full((1, 3), 0.3), 0.4, np.full((1, 4), np.nan))
    np.testing.assert_allclose(said_velocity, [[0.3] * 3], atol=1e-3)


def test_who_was_lost_begins_anew_where_it_is():
    smooth, here, there = LowPass(2), np.zeros((2, 3)), np.ones((2, 3))
    lost = np.array([[np.nan] * 3, [0.0] * 3])
    smooth.smooth(0.0, here, here, 1.0)
    assert np.isnan(smooth.smooth(DT, lost, here, 1.0)[0][0]).all()
    position, _ = smooth.smooth(2 * DT, there, here, 1.0)
    np.testing.assert_array_equal(position[0], there[0])
    assert 0.0 < position[1, 0] < 0.1


def test_what_is_judged_is_what_is_said():
    voice = Transmitter(SendOnDelta(threshold=0.01, smoothing_s=0.5), 1)
    assert say(voice, 0.0, np.zeros((1, 3))).rows.tolist() == [0]
    aside = np.array([[0.1, 0.0, 0.0]])
    quiet = 0
    while not len((said := say(voice, (quiet + 1) * DT, aside)).rows):
        quiet += 1
    assert quiet == math.floor(-0.5 * math.log(0.9) / DT)
    np.testing.assert_array_equal(voice.last_event.position, said.position)
    assert 0.01 < said.position[0, 0] < 0.0137


def test_who_does_not_know_where_it_is_says_nothing():
    voice = Transmitter(SendOnDelta(), 2)
    said = say(voice, 0.0, np.array([[np.nan] * 3, [0.0] * 3]))
    assert said.rows.tolist() == [1]
    assert voice.last_event.time.tolist() == [-np.inf, 0.0]


def test_a_trigger_that_fails_is_named():
    class Broken(Trigger, frozen=True):
        def fires(self, view, memory):
            return view.nothing

    with pytest.raises(PluginError, match=r"the trigger Broken failed: AttributeError.* \(.*\.py:\d+\)$"):
        say(Transmitter(Broken(), 1), 0.0, np.zeros((1, 3)))


def test_an_unknown_velocity_is_said_as_unknown_and_counts_as_standing():
    position, velocity = np.zeros((2, 3)), np.array([[np.nan] * 3, [0.1, 0.0, 0.0]])
    for trigger in (SendOnDelta(threshold=0.01), SendOnDelta(threshold=0.01, smoothing_s=0.5)):
        voice = Transmitter(trigger, 2, ConstantVelocity())
        said = say(voice, 0.0, position, velocity)
        assert said.rows.tolist() == [0, 1]
        np.testing.assert_array_equal(said.velocity, velocity)
        np.testing.assert_array_equal(voice.last_event.velocity, [[0.0] * 3, [0.1, 0.0, 0.0]])
        moved = np.array([[1.0, 0.0, 0.0], [DT * 0.1, 0.0, 0.0]])
        assert say(voice, DT, moved, velocity).rows.tolist() == [0]
