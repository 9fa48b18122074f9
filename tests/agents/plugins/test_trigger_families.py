"""Each family fires exactly when its inequality says, on random signals, by an account of its own."""

import math
from dataclasses import dataclass
from math import dist, hypot

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.plugins.predictors import HOLD, ConstantVelocity
from agents.plugins.trigger_families import (
    Decaying,
    Dynamic,
    IntegralTrigger,
    Lyapunov,
    MixedTrigger,
    Predictive,
    Relative,
    RelativeControl,
    SelfTriggered,
)
from agents.plugins.triggers import LastEvent, Periodic, SendOnDelta, TriggerView
from tests.agents import signals
from tests.agents.signals import DT, Play, standing, wander

SEEDS = st.integers(0, 2**32 - 1)
SOME = settings(max_examples=15)
LENGTH, SHARE = st.floats(0.002, 0.1), st.floats(0.01, 0.9)
TICKS = 150


@dataclass
class Question:
    """What is known at one question; `then` is the moment of the last event."""

    t: float
    t_k: float
    gap: float
    now: signals.Moment
    then: signals.Moment


def check(trigger, seed, margin, predictor=HOLD):
    """`margin` of a question is positive when it must fire; on the edge rounding decides. Most are decided."""
    signal = wander(seed, TICKS)
    play = Play(trigger, signal, predictor=predictor)
    last = decided = 0
    for k in range(1, TICKS):
        if play.fired[k - 1]:
            last = k - 1
        sent = LastEvent()
        sent.position, sent.velocity = signal[last].position, signal[last].velocity
        held = predictor.position(sent, (k - last) * DT)
        beyond = margin(Question(k * DT, last * DT, dist(signal[k].position, held), signal[k], signal[last]))
        if abs(beyond) > 1e-12:
            assert play.fired[k] == (beyond > 0.0), k
            decided += 1
    assert decided > TICKS / 2


@SOME
@given(SEEDS, st.integers(1, 20))
def test_periodic(seed, ticks):
    period = ticks * DT
    check(Periodic(period_s=period), seed, lambda q: q.t - q.t_k - period + 1e-6)


@SOME
@given(SEEDS, LENGTH)
def test_send_on_delta(seed, threshold):
    check(SendOnDelta(threshold=threshold), seed, lambda q: q.gap - threshold)


@SOME
@given(SEEDS, SHARE)
def test_relative(seed, share):
    check(Relative(share=share), seed, lambda q: q.gap - share * q.now.error)


@SOME
@given(SEEDS, SHARE, LENGTH)
def test_mixed(seed, share, floor):
    check(MixedTrigger(share=share, floor=floor), seed, lambda q: q.gap**2 - share * q.now.error**2 - floor**2)


@SOME
@given(SEEDS, LENGTH, LENGTH, st.floats(0.1, 5.0))
def test_decaying(seed, floor, extra, rate):
    trigger = Decaying(floor=floor, extra=extra, rate=rate)
    check(trigger, seed, lambda q: q.gap - floor - extra * math.exp(-rate * q.t))


@SOME
@given(SEEDS, SHARE, LENGTH, st.floats(0.1, 50.0), st.floats(0.0, 2.0))
def test_dynamic(seed, share, floor, decay, weight):
    eta, before = 0.0, 0.0  # at the first question ε was infinite, and nothing was added

    def margin(q):
        nonlocal eta, before
        kept = math.exp(-decay * (q.t - before))
        w = share * q.now.error**2 + floor**2 - q.gap**2
        eta, before = max(kept * eta + (1.0 - kept) / decay * w, 0.0), q.t
        return -(eta + weight * w) + 1e-300

    check(Dynamic(share=share, floor=floor, decay=decay, weight=weight), seed, margin)


@pytest.mark.parametrize(("decay", "fires"), [(0.1, False), (1e3, True)])  # saved for 2 s, or forgotten at once
def test_dynamic_spends_saved_margin(decay, fires):
    signal = standing(100) + standing(1, (0.015, 0.0, 0.0))
    assert Play(Dynamic(share=0.0, floor=0.01, decay=decay, weight=0.5), signal).fired[-1] == fires


@SOME
@given(SEEDS, st.floats(1e-4, 5e-2))
def test_integral(seed, area):
    so_far = 0.0

    def margin(q):
        nonlocal so_far
        so_far = q.gap * DT if q.t - q.t_k < 1.5 * DT else so_far + q.gap * DT
        return so_far - area

    check(IntegralTrigger(area=area), seed, margin)


@pytest.mark.parametrize("predictor", [HOLD, ConstantVelocity(), ConstantVelocity(horizon_s=0.1)])
@SOME
@given(SEEDS, LENGTH)
def test_predictive(predictor, seed, threshold):
    check(Predictive(threshold=threshold), seed, lambda q: q.gap - threshold, predictor)


@pytest.mark.parametrize(("predictor", "reach"), [(HOLD, 9.0), (ConstantVelocity(horizon_s=0.3), 0.3)])
@SOME
@given(SEEDS, LENGTH, st.floats(0.05, 5.0))
def test_self_triggered(predictor, reach, seed, threshold, bound):
    def margin(q):
        drift = hypot(*q.then.velocity) if predictor is HOLD else 0.0
        wait = min((math.sqrt(drift**2 + 2.0 * bound * threshold) - drift) / bound, 1.0, reach)
        return q.t - q.t_k - wait + 1e-6

    check(SelfTriggered(threshold=threshold, acceleration=bound, longest_s=1.0), seed, margin, predictor)


@SOME
@given(SEEDS, st.floats(0.02, 0.5))
def test_self_triggered_bounds_bounded_accelerations(seed, bound):
    dt, rng = 0.005, np.random.default_rng(seed)
    push = rng.normal(size=(400, 3))
    push *= bound / np.maximum(np.linalg.norm(push, axis=1), 1e-9)[:, None]
    speed = np.cumsum(push * dt, axis=0)
    place = np.cumsum(speed * dt - 0.5 * push * dt**2, axis=0)
    poses = zip(place.tolist(), speed.tolist(), strict=True)
    signal = [signals.Moment(tuple(p), tuple(v), (0.0, 0.0, 0.0), 0.0, 0.0) for p, v in poses]
    play = Play(SelfTriggered(threshold=0.01, acceleration=bound), signal, dt=dt)
    for k in range(1, 400):  # it may be late by one question
        assert play.gap_before[k] <= 0.01 + dt * hypot(*signal[k].velocity) + 1e-9
    assert 2 <= sum(play.fired) <= 200


def test_self_triggered_knows_its_next_event():
    """It uses neither position nor errors between two events."""
    trigger, view = SelfTriggered(), TriggerView({})
    view.drift, fired = 0.05, []
    for name in ("position", "velocity", "error", "energy", "offset", "deviation"):
        delattr(view, name)
    for k in range(60):
        view.since_event = k * DT
        fired.append(trigger.fires(view))
    wait = 2 * 0.01 / (0.05 + math.sqrt(0.05**2 + 2 * 0.25 * 0.01))
    assert fired.index(True) == math.ceil(wait / DT)


@SOME
@given(SEEDS, st.floats(0.2, 0.9), st.floats(0.0, 0.2), st.floats(0.05, 1.0))
def test_lyapunov(seed, level, floor, largest):
    def margin(q):
        slack, now, then = 0.5 * floor**2, q.now.energy, q.then.energy
        return max(level * then - slack - now, now - then / level - slack, q.gap - largest)

    check(Lyapunov(level=level, floor=floor, largest=largest), seed, margin)


@SOME
@given(SEEDS, st.floats(0.002, 0.05), SHARE)
def test_relative_control(seed, floor, share):
    def margin(q):
        return dist(q.now.offset, q.then.offset) - floor - min(share * hypot(*q.now.offset), share)

    check(RelativeControl(floor=floor, share=share), seed, margin)


def test_where_they_belong():
    assert Predictive.PLACES == ("communication",)
    assert Predictive.PREDICTION == "constant-velocity"
    assert RelativeControl.PLACES == ("control",)
    assert SendOnDelta.PLACES == ("communication", "control")
    assert SendOnDelta.PREDICTION == "hold"
