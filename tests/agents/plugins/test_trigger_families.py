"""Each family fires exactly when its inequality says, on random signals, by an account that is kept for one row."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.arrays import norm
from agents.decision.control_updates import ControlView
from agents.plugins.predictors import HOLD, ConstantVelocity
from agents.plugins.trigger_families import (
    Decaying,
    Dynamic,
    Integral,
    Lyapunov,
    Mixed,
    Predictive,
    Relative,
    RelativeControl,
    SelfTriggered,
)
from agents.plugins.triggers import Periodic, SendOnDelta, View
from tests.agents.signals import DT, Play, wander

SEEDS = st.integers(0, 2**32 - 1)
SOME = settings(max_examples=15)
LENGTH, SHARE = st.floats(0.002, 0.1), st.floats(0.01, 0.9)


@dataclass
class Moment:
    """What one row knows at one question; a `_k` is from its last event."""

    t: float
    t_k: float
    gap: float
    error: float
    energy: float
    energy_k: float
    u: np.ndarray
    u_k: np.ndarray
    v_k: np.ndarray


def moments(signal, play, predictor=HOLD):
    """Of every row, all its questions after the first."""
    for row in range(signal.position.shape[1]):
        own, last = [], 0
        for k in range(1, len(signal.position)):
            if play.fired[k - 1, row]:
                last = k - 1
            age = np.array([(k - last) * DT])
            held = predictor.position(signal.position[last, row][None], signal.velocity[last, row][None], age)[0]
            own.append(
                Moment(
                    k * DT,
                    last * DT,
                    math.dist(signal.position[k, row], held),
                    signal.error[k, row],
                    signal.energy[k, row],
                    signal.energy[last, row],
                    signal.offset[k, row],
                    signal.offset[last, row],
                    signal.velocity[last, row],
                )
            )
        yield own, play.fired[1:, row]


def check(trigger, seed, margin, predictor=HOLD):
    """`margin` of a moment is positive when it must fire; on the edge rounding decides. At least half is decided."""
    signal = wander(seed, 3, 60)
    play = Play(trigger, signal, predictor=predictor)
    decided = 0
    for own, fired in moments(signal, play, predictor):
        for moment, spoke in zip(own, fired, strict=True):
            beyond = margin(moment)
            if abs(beyond) > 1e-12:
                assert spoke == (beyond > 0.0), moment
                decided += 1
    assert decided > 88


@SOME
@given(SEEDS, st.integers(1, 20))
def test_periodic(seed, ticks):
    period = ticks * DT
    check(Periodic(period_s=period), seed, lambda m: m.t - m.t_k - period + 1e-6)


@SOME
@given(SEEDS, LENGTH)
def test_send_on_delta(seed, threshold):
    check(SendOnDelta(threshold=threshold), seed, lambda m: m.gap - threshold)


@SOME
@given(SEEDS, SHARE)
def test_relative(seed, share):
    check(Relative(share=share), seed, lambda m: m.gap - share * m.error)


@SOME
@given(SEEDS, SHARE, LENGTH)
def test_mixed(seed, share, floor):
    check(Mixed(share=share, floor=floor), seed, lambda m: m.gap**2 - share * m.error**2 - floor**2)


@SOME
@given(SEEDS, LENGTH, LENGTH, st.floats(0.1, 5.0))
def test_decaying(seed, floor, extra, rate):
    trigger = Decaying(floor=floor, extra=extra, rate=rate)
    check(trigger, seed, lambda m: m.gap - floor - extra * math.exp(-rate * m.t))


@SOME
@given(SEEDS, SHARE, LENGTH, st.floats(0.1, 50.0), st.floats(0.0, 2.0))
def test_dynamic(seed, share, floor, decay, weight):
    eta, before = 0.0, 0.0

    def margin(m):
        nonlocal eta, before
        if m.t == DT:  # another row; at its first question ε was infinite, and nothing was added
            eta, before = 0.0, 0.0
        kept = math.exp(-decay * (m.t - before))
        w = share * m.error**2 + floor**2 - m.gap**2
        eta, before = max(kept * eta + (1.0 - kept) / decay * w, 0.0), m.t
        return -(eta + weight * w) + 1e-300

    check(Dynamic(share=share, floor=floor, decay=decay, weight=weight), seed, margin)


def test_dynamic_spends_what_it_saved():
    still, far = np.zeros((101, 1, 3)), np.zeros((101, 1, 3))
    far[100:, :, 0] = 0.015
    signal = wander(0, 1, 101)
    signal.position[:], signal.error[:] = still + far, 0.0
    for decay, spoken in ((0.1, False), (1e3, True)):  # saved for 2 s, or forgotten at once
        play = Play(Dynamic(share=0.0, floor=0.01, decay=decay, weight=0.5), signal)
        assert play.fired[-1, 0] == spoken


@SOME
@given(SEEDS, st.floats(1e-4, 5e-2))
def test_integral(seed, area):
    so_far = 0.0

    def margin(m):
        nonlocal so_far
        so_far = m.gap * DT if m.t - m.t_k < 1.5 * DT else so_far + m.gap * DT
        return so_far - area

    check(Integral(area=area), seed, margin)


@pytest.mark.parametrize("predictor", [HOLD, ConstantVelocity(), ConstantVelocity(horizon_s=0.1)])
@SOME
@given(SEEDS, LENGTH)
def test_predictive(predictor, seed, threshold):
    def margin(m):
        return m.gap - threshold

    check(Predictive(threshold=threshold), seed, margin, predictor)


@pytest.mark.parametrize(("predictor", "reach"), [(HOLD, 9.0), (ConstantVelocity(horizon_s=0.3), 0.3)])
@SOME
@given(SEEDS, LENGTH, st.floats(0.05, 5.0))
def test_self_triggered(predictor, reach, seed, threshold, bound):
    def margin(m):
        drift = norm(m.v_k[None])[0] if predictor is HOLD else 0.0
        wait = min((math.sqrt(drift**2 + 2.0 * bound * threshold) - drift) / bound, 1.0, reach)
        return m.t - m.t_k - wait + 1e-6

    check(SelfTriggered(threshold=threshold, acceleration=bound, longest_s=1.0), seed, margin, predictor)


@SOME
@given(SEEDS, st.floats(0.02, 0.5))
def test_self_triggered_keeps_its_bound_when_the_acceleration_keeps_to_its_own(seed, bound):
    rng = np.random.default_rng(seed)
    push = rng.normal(size=(400, 2, 3))
    push *= bound / np.maximum(norm(push), 1e-9)[..., None]
    signal = wander(seed, 2, 400)
    dt = 0.005
    velocity = np.cumsum(push * dt, axis=0)
    position = np.cumsum(velocity * dt - 0.5 * push * dt**2, axis=0)
    signal.position[:], signal.velocity[:] = position, velocity
    play = Play(SelfTriggered(threshold=0.01, acceleration=bound), signal, dt=dt)
    assert (play.gap_before[1:] <= 0.01 + dt * norm(velocity[1:]) + 1e-9).all()  # it may be late by one question
    assert 4 <= play.fired.sum() <= 400


class Unseen(View):
    """A view in which nothing can be seen but what was last_event."""

    def __getattribute__(self, name):
        if name in {"position", "velocity", "error", "energy", "offset", "deviation", "believed", "since"}:
            raise AssertionError(f"looked at {name}")
        return super().__getattribute__(name)


@SOME
@given(SEEDS)
def test_self_triggered_looks_at_nothing_between_its_own_instants(seed):
    trigger, signal = SelfTriggered(longest_s=0.5), wander(seed, 3, 80)
    play = Play(trigger, signal)
    last_event = Play(trigger, signal.every(1)).last_event
    instants = [np.flatnonzero(column) for column in play.fired.T]
    rows = np.arange(3)
    last_event.time[:] = [times[0] * DT for times in instants]
    last_event.velocity[:] = [signal.velocity[times[0], row] for row, times in enumerate(instants)]
    blind = Unseen.__new__(Unseen)
    blind.last_event, blind.predictor = last_event, HOLD
    for k in range(1, max(times[1] if len(times) > 1 else 0 for times in instants) + 1):
        blind.t = k * DT
        due = np.isin(rows, trigger.due(blind, trigger.state(3)))
        for row, times in enumerate(instants):  # the next instant was known when the last message was sent
            if len(times) > 1:
                assert due[row] == (k >= times[1])


@SOME
@given(SEEDS, st.floats(0.2, 0.9), st.floats(0.0, 0.2), st.floats(0.05, 1.0))
def test_lyapunov(seed, level, floor, largest):
    def margin(m):
        slack = 0.5 * floor**2
        return max(level * m.energy_k - slack - m.energy, m.energy - m.energy_k / level - slack, m.gap - largest)

    check(Lyapunov(level=level, floor=floor, largest=largest), seed, margin)


@SOME
@given(SEEDS, st.floats(0.002, 0.05), SHARE)
def test_relative_control(seed, floor, share):
    def margin(m):
        return math.dist(m.u, m.u_k) - floor - min(share * math.hypot(*m.u), share)

    check(RelativeControl(floor=floor, share=share), seed, margin)


def test_where_they_belong():
    assert Predictive.places == ("communication",)
    assert Predictive.prediction == "constant-velocity"
    assert RelativeControl.places == ("control",)
    assert SendOnDelta.places == ("communication", "control")
    assert SendOnDelta.prediction == "hold"
    assert issubclass(ControlView, View)
