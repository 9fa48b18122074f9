"""Every registered trigger keeps intervals and silences; each family fires exactly when its inequality says."""

import itertools
import re
from math import dist, exp, hypot, inf, nan, sqrt
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.decision.transmission import Transmitter
from agents.plugins import registry
from agents.plugins.predictors import HOLD, ConstantVelocity, Predictor
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
from agents.plugins.triggers import LastEvent, Periodic, SendOnDelta, Trigger, TriggerState
from agents.vectors import NO_SETPOINT, ZERO, Vector
from bridges.khepera4.kind import KHEPERA4
from tests.cases import examples

DT = 0.02


class Moment(NamedTuple):
    position: Vector
    velocity: Vector
    offset: Vector
    error: float
    energy: float


def wander(seed: int, ticks: int) -> list[Moment]:
    rng = np.random.default_rng(seed)
    speed = rng.choice([0.0, 0.05, 0.5], (ticks, 1)) * rng.normal(size=(ticks, 3))
    place = np.cumsum(speed * DT, axis=0) + rng.normal(size=3)
    offset = np.cumsum(0.005 * rng.normal(size=(ticks, 3)), axis=0)
    error, energy = rng.uniform(0, 0.3, ticks), np.exp(rng.uniform(-9, -2, ticks))
    columns = (place, speed, offset, error, energy)
    vectors = [[tuple(row) if isinstance(row, list) else row for row in column.tolist()] for column in columns]
    return [Moment(*values) for values in zip(*vectors, strict=True)]


def standing(ticks: int, position: Vector = (0.0, 0.0, 0.0)) -> list[Moment]:
    return [Moment(position, ZERO, ZERO, 0.0, 0.0)] * ticks


class Play:
    """Asks a trigger on every tick, as a robot does from the start of its experiment on.

    Attributes:
        fired: Whether there was an event, at each question.
        intervals: Questions from each event to the next.
    """

    def __init__(self, trigger: Trigger, signal: list[Moment], *, predictor: Predictor = HOLD, dt: float = DT) -> None:
        transmitter = Transmitter(trigger, predictor, KHEPERA4)
        self.fired: list[bool] = []
        for k, moment in enumerate(signal):
            t = k * dt
            fired = transmitter.transmits(
                t, moment.position, moment.velocity, moment.error, moment.energy, t, moment.offset, NO_SETPOINT
            )
            self.fired.append(fired)
        events = [k for k, fired in enumerate(self.fired) if fired]
        self.intervals = [later - earlier for earlier, later in itertools.pairwise(events)]


NAMES = [name for name in registry.names(registry.TRIGGERS) if not registry.struct(registry.TRIGGERS, name).FILES]
FAMILIES = {
    "periodic", "send-on-delta", "relative", "mixed", "decaying", "dynamic", "integral", "predictive",
    "self-triggered", "lyapunov", "relative-control",
}  # fmt: skip
SEEDS, FEW, SOME = st.integers(0, 2**32 - 1), examples(10), examples(15)


def made(name, **parameters):
    """A trigger with its defaults; parameters without one get a small number."""
    kind = registry.struct(registry.TRIGGERS, name)
    needed = {f.encode_name for f in msgspec.structs.fields(kind) if f.required}
    return registry.build(registry.TRIGGERS, {"kind": name, **dict.fromkeys(needed, 0.05), **parameters})


@pytest.mark.parametrize("name", NAMES)
@FEW
@given(seed=SEEDS, ticks=st.integers(1, 15))
def test_intervals_and_silences_are_kept(name, seed, ticks):
    for options in ({}, {"minimum_interval_s": 0.5}, {"maximum_silence_s": 1.0}, {"evaluate_every_s": 0.5}):
        assert Play(made(name, **options), wander(seed, 1)).fired == [True]
    seldom = Play(made(name, minimum_interval_s=ticks * DT), wander(seed, 150))
    assert min(seldom.intervals, default=ticks) >= ticks
    often = Play(made(name, maximum_silence_s=ticks * DT), standing(60))
    assert len(often.intervals) >= 60 // ticks - 1
    assert max(often.intervals) <= ticks
    lost = Play(made(name), standing(1) + standing(20, (nan, nan, nan)))
    assert lost.fired == [True] + [False] * 20  # an unknown position is no event


@pytest.mark.parametrize("name", sorted(FAMILIES - {"periodic"}))
@FEW
@given(seed=SEEDS, ticks=st.integers(2, 10))
def test_periodic_evaluation_is_asking_seldom(name, seed, ticks):
    signal = wander(seed, 60)
    seldom = Play(made(name, evaluate_every_s=ticks * DT), signal).fired
    assert seldom[::ticks] == Play(made(name), signal[::ticks], dt=ticks * DT).fired
    assert sum(seldom) == sum(seldom[::ticks])


@pytest.mark.parametrize(("deviation", "fires"), [(0.25, False), (0.2500001, True), (0.3, True), (nan, False)])
def test_send_on_delta_fires_beyond_its_threshold(deviation, fires):
    state = TriggerState(SendOnDelta(threshold=0.25))
    state.view.t, state.view.since_event, state.view.deviation, state.last.time = 9.0, 9.0, deviation, 0.0
    assert state.due() == fires
    with pytest.raises(TypeError, match="Trigger must define `fires`"):
        Trigger().fires(state.view)


@pytest.mark.parametrize(
    ("period", "hz", "begin_s", "length_s", "expected"),
    [
        pytest.param(0.02, 50, 0, 3600, 180_000, marks=pytest.mark.slow),
        (0.1, 50, 86_400, 300, 3_000),  # late in the day a float has fewer digits behind the point
        (1 / 30, 30, 86_400, 300, 9_000),
        (0.05, 50, 86_400, 300, 5_000),  # 2.5 questions, so every third: never sooner than the period
    ],
)
def test_periodic_counts_stay_exact(period, hz, begin_s, length_s, expected):
    state, sent = TriggerState(Periodic(period_s=period)), 0
    for tick in range(begin_s * hz, (begin_s + length_s) * hz):
        state.view.t, state.view.since_event = tick / hz, tick / hz - state.last.time
        if state.due():
            state.record()
            sent += 1
    assert sent == expected


def test_docs_table_has_families_and_defaults():
    text = (Path(__file__).parents[3] / "docs" / "triggers.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([a-z-]+)` \| .* \| (.*) \|$", text, re.MULTILINE)
    told = {name: parameters for name, parameters in rows if name in NAMES}
    assert set(told) >= FAMILIES
    for name, parameters in told.items():
        kind = registry.struct(registry.TRIGGERS, name)
        defaults = {field.name: field.default for field in msgspec.structs.fields(kind)}
        own = set(kind.__struct_fields__) - set(Trigger.__struct_fields__)
        said = {field: float(value) for field, value in re.findall(r"`(\w+)`: \$[^$]+\$, ([0-9.]+)", parameters)}
        assert said == {field: defaults[field] for field in own}, name


LENGTH, SHARE, TICKS = st.floats(0.002, 0.1), st.floats(0.01, 0.9), 150


class Question(NamedTuple):
    """Knowledge at one question; `then` is the moment of the last event."""

    t: float
    t_k: float
    gap: float
    now: Moment
    then: Moment


def fires_when(trigger, seed, margin, predictor=HOLD):
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


def waited(q, own, drift, longest):
    """Time since the last event [s] beyond what a self-triggered one waits at a `drift` [m/s]."""
    wait = (sqrt(drift**2 + 2.0 * own.acceleration * own.threshold) - drift) / own.acceleration
    return q.t - q.t_k - min(wait, longest) + 1e-6


FOLLOWING = st.builds(Predictive, threshold=LENGTH)
FORESEEING = st.builds(SelfTriggered, threshold=LENGTH, acceleration=st.floats(0.05, 5.0), longest_s=st.just(1.0))
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
    "self-triggered": (FORESEEING, lambda q, own: waited(q, own, hypot(*q.then.velocity), 1.0), HOLD),
    "self-triggered, horizon": (FORESEEING, lambda q, own: waited(q, own, 0.0, 0.3), ConstantVelocity(horizon_s=0.3)),
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
    fires_when(trigger, seed, lambda question: margin(question, trigger), predictor)


@SOME
@given(SEEDS, SHARE, LENGTH, st.floats(0.1, 50.0), st.floats(0.0, 2.0))
def test_dynamic_fires_when_its_variable_is_spent(seed, share, floor, decay, weight):
    eta, before = 0.0, 0.0  # at the first question ε was infinite, and nothing was added

    def margin(q):
        nonlocal eta, before
        kept = exp(-decay * (q.t - before))
        w = share * q.now.error**2 + floor**2 - q.gap**2
        eta, before = max(kept * eta + (1.0 - kept) / decay * w, 0.0), q.t
        return -(eta + weight * w) + 1e-300

    fires_when(Dynamic(share=share, floor=floor, decay=decay, weight=weight), seed, margin)


@SOME
@given(SEEDS, st.floats(1e-4, 5e-2))
def test_integral_fires_beyond_its_area(seed, area):
    so_far = 0.0

    def margin(q):
        nonlocal so_far
        so_far = q.gap * DT if q.t - q.t_k < 1.5 * DT else so_far + q.gap * DT
        return so_far - area

    fires_when(IntegralTrigger(area=area), seed, margin)


@pytest.mark.parametrize(("age", "seconds"), [(-0.5, 0.0), (0.0, 0.0), (1.0, 1.0), (2.0, 2.0), (9.0, 2.0)])
def test_constant_velocity_goes_on_until_its_horizon(age, seconds):
    sent = LastEvent()
    sent.position, sent.velocity = (1.0, 2.0, 3.0), (1.0, -2.0, 0.5)
    predictor = ConstantVelocity(horizon_s=2.0)
    assert predictor.position(sent, age) == pytest.approx((1.0 + seconds, 2.0 - 2.0 * seconds, 3.0 + 0.5 * seconds))
    assert predictor.velocity(sent, age) == (sent.velocity if age < 2.0 else (0.0, 0.0, 0.0))
    assert (predictor.reach(), ConstantVelocity().reach()) == (2.0, inf)
    assert ConstantVelocity().position(sent, 9.0) == pytest.approx((10.0, -16.0, 7.5))
