"""Each family fires exactly when its inequality says, on random signals, by an account of its own."""

from dataclasses import dataclass
from math import dist, exp, hypot, sqrt

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
from agents.plugins.triggers import LastEvent, Periodic, SendOnDelta
from tests.agents import signals
from tests.agents.signals import DT, Play, wander

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


FOLLOWING = st.builds(Predictive, threshold=LENGTH)
CASES = {  # triggers without memory: when they must fire, and what is believed of the robot
    "periodic": (st.builds(Periodic, period_s=st.integers(1, 20).map(lambda ticks: ticks * DT)),
                 lambda q, own: q.t - q.t_k - own.period_s + 1e-6, HOLD),
    "send-on-delta": (st.builds(SendOnDelta, threshold=LENGTH), lambda q, own: q.gap - own.threshold, HOLD),
    "relative": (st.builds(Relative, share=SHARE), lambda q, own: q.gap - own.share * q.now.error, HOLD),
    "mixed": (st.builds(MixedTrigger, share=SHARE, floor=LENGTH),
              lambda q, own: q.gap**2 - own.share * q.now.error**2 - own.floor**2, HOLD),
    "decaying": (st.builds(Decaying, floor=LENGTH, extra=LENGTH, rate=st.floats(0.1, 5.0)),
                 lambda q, own: q.gap - own.floor - own.extra * exp(-own.rate * q.t), HOLD),
    "predictive, hold": (FOLLOWING, lambda q, own: q.gap - own.threshold, HOLD),
    "predictive": (FOLLOWING, lambda q, own: q.gap - own.threshold, ConstantVelocity()),
    "predictive, horizon": (FOLLOWING, lambda q, own: q.gap - own.threshold, ConstantVelocity(horizon_s=0.1)),
    "lyapunov": (
        st.builds(Lyapunov, level=st.floats(0.2, 0.9), floor=st.floats(0.0, 0.2), largest=st.floats(0.05, 1.0)),
        lambda q, own: max(own.level * q.then.energy - 0.5 * own.floor**2 - q.now.energy,
                           q.now.energy - q.then.energy / own.level - 0.5 * own.floor**2, q.gap - own.largest),
        HOLD,
    ),
    "relative-control": (
        st.builds(RelativeControl, floor=st.floats(0.002, 0.05), share=SHARE),
        lambda q, own: dist(q.now.offset, q.then.offset) - own.floor - min(own.share * hypot(*q.now.offset), own.share),
        HOLD,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
@SOME
@given(data=st.data(), seed=SEEDS)
def test_fires_by_its_inequality(name, data, seed):
    triggers, margin, predictor = CASES[name]
    trigger = data.draw(triggers)
    check(trigger, seed, lambda question: margin(question, trigger), predictor)


@SOME
@given(SEEDS, SHARE, LENGTH, st.floats(0.1, 50.0), st.floats(0.0, 2.0))
def test_dynamic(seed, share, floor, decay, weight):
    eta, before = 0.0, 0.0  # at the first question ε was infinite, and nothing was added

    def margin(q):
        nonlocal eta, before
        kept = exp(-decay * (q.t - before))
        w = share * q.now.error**2 + floor**2 - q.gap**2
        eta, before = max(kept * eta + (1.0 - kept) / decay * w, 0.0), q.t
        return -(eta + weight * w) + 1e-300

    check(Dynamic(share=share, floor=floor, decay=decay, weight=weight), seed, margin)


@SOME
@given(SEEDS, st.floats(1e-4, 5e-2))
def test_integral(seed, area):
    so_far = 0.0

    def margin(q):
        nonlocal so_far
        so_far = q.gap * DT if q.t - q.t_k < 1.5 * DT else so_far + q.gap * DT
        return so_far - area

    check(IntegralTrigger(area=area), seed, margin)


@pytest.mark.parametrize(("predictor", "reach"), [(HOLD, 9.0), (ConstantVelocity(horizon_s=0.3), 0.3)])
@SOME
@given(SEEDS, LENGTH, st.floats(0.05, 5.0))
def test_self_triggered(predictor, reach, seed, threshold, bound):
    def margin(q):
        drift = hypot(*q.then.velocity) if predictor is HOLD else 0.0
        wait = min((sqrt(drift**2 + 2.0 * bound * threshold) - drift) / bound, 1.0, reach)
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
