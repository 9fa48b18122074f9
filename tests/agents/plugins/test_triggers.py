"""Every registered trigger: rows decide as if alone, first asks are answered, intervals and silences are kept."""

import re
from pathlib import Path
from typing import get_type_hints

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.plugins import registry
from agents.plugins.predictors import HOLD
from agents.plugins.triggers import LastEvent, Periodic, SendOnDelta, Trigger, View
from tests.agents.signals import DT, Play, wander

NAMES = registry.names(registry.TRIGGERS)
FAMILIES = {
    "periodic", "send-on-delta", "relative", "mixed", "decaying", "dynamic", "integral", "predictive",
    "self-triggered", "lyapunov", "relative-control",
}  # fmt: skip
SEEDS = st.integers(0, 2**32 - 1)
FEW = settings(max_examples=10)


def made(name, **parameters):
    """A trigger with its defaults; parameters without one get a small number."""
    kind = registry.struct(registry.TRIGGERS, name)
    needed = {f.encode_name for f in msgspec.structs.fields(kind) if f.required}
    return registry.build(registry.TRIGGERS, {"kind": name, **dict.fromkeys(needed, 0.05), **parameters})


def gaps(fired):
    """Ticks between events of each row."""
    return [np.diff(np.flatnonzero(column)) for column in fired.T]


def view(position, last_event, *, t=0.0, error=0.0):
    """A moment of rows that stand at `position`."""
    rows = len(position)
    zeros = np.zeros(rows)
    return View(
        t, np.asarray(position, dtype=float), np.zeros((rows, 3)), last_event,
        error=zeros + error, energy=zeros, start=zeros, offset=np.zeros((rows, 3)), predictor=HOLD,
    )  # fmt: skip


def last_event(position, t=0.0):
    """Everybody said this at `t`."""
    said = LastEvent(len(position))
    said.position[:], said.time[:] = position, t
    return said


def test_all_families_are_registered():
    assert set(NAMES) >= FAMILIES
    for name in NAMES:
        assert isinstance(made(name), Trigger)


@pytest.mark.parametrize("name", NAMES)
@FEW
@given(seed=SEEDS)
def test_rows_have_events_as_if_each_were_alone(name, seed):
    trigger = made(name, minimum_interval_s=0.04, maximum_silence_s=0.3, evaluate_every_s=0.04, smoothing_s=0.1)
    signal = wander(seed, 4, 40)
    together = Play(trigger, signal)
    for row in range(4):
        alone = Play(trigger, signal.of(row))
        np.testing.assert_array_equal(alone.fired[:, 0], together.fired[:, row])
        np.testing.assert_array_equal(alone.state[0], together.state[row])
        for what in ("position", "velocity", "time", "offset", "energy"):
            np.testing.assert_array_equal(getattr(alone.last_event, what)[0], getattr(together.last_event, what)[row])


@pytest.mark.parametrize("name", NAMES)
@FEW
@given(seed=SEEDS)
def test_who_had_no_event_has_one_when_first_asked(name, seed):
    for options in ({}, {"minimum_interval_s": 0.5}, {"maximum_silence_s": 1.0}, {"evaluate_every_s": 0.5}):
        assert Play(made(name, **options), wander(seed, 3, 1)).fired.all()


@pytest.mark.parametrize("name", NAMES)
@FEW
@given(seed=SEEDS, ticks=st.integers(1, 15))
def test_the_minimum_interval_is_kept(name, seed, ticks):
    for gap in gaps(Play(made(name, minimum_interval_s=ticks * DT), wander(seed, 4, 60)).fired):
        assert (gap >= ticks).all()


@pytest.mark.parametrize("name", NAMES)
@FEW
@given(seed=SEEDS, ticks=st.integers(1, 15))
def test_the_maximum_silence_is_kept(name, seed, ticks):
    signal = wander(seed, 4, 60)
    signal.position[:], signal.velocity[:] = signal.position[:1], 0.0  # nobody moves: only silence makes them speak
    for gap in gaps(Play(made(name, maximum_silence_s=ticks * DT), signal).fired):
        assert len(gap) >= 60 // ticks - 1
        assert (gap <= ticks).all()


@pytest.mark.parametrize("name", sorted(FAMILIES - {"periodic"}))
@FEW
@given(seed=SEEDS, ticks=st.integers(2, 10))
def test_evaluated_periodically_it_is_as_if_it_were_asked_that_seldom(name, seed, ticks):
    signal = wander(seed, 3, 60)
    seldom = Play(made(name, evaluate_every_s=ticks * DT), signal).fired
    assert not np.delete(seldom, slice(None, None, ticks), axis=0).any()
    np.testing.assert_array_equal(seldom[::ticks], Play(made(name), signal.every(ticks), dt=ticks * DT).fired)


@pytest.mark.parametrize("name", NAMES)
def test_parameters_have_units_in_their_descriptions(name):
    kind = registry.struct(registry.TRIGGERS, name)
    hints = get_type_hints(kind, include_extras=True)
    assert kind.__struct_fields__
    for field in kind.__struct_fields__:
        assert any("[" in str(note) for note in getattr(hints[field], "__metadata__", ())), field


@pytest.mark.parametrize("name", NAMES)
def test_a_position_that_is_not_known_is_not_news(name):
    rows = view([[np.nan] * 3], last_event([[0.0] * 3]), t=1e-3, error=1.0)
    trigger = made(name)
    if name != "relative-control":  # it looks at the offset alone
        assert not len(trigger.due(rows, trigger.state(1)))


@FEW
@given(SEEDS, st.floats(0.002, 0.05))
def test_send_on_delta_bounds_what_the_neighbours_do_not_know(seed, threshold):
    signal = wander(seed, 3, 80)
    play = Play(SendOnDelta(threshold=threshold), signal)
    assert (play.gap_after <= threshold).all()
    moved = np.linalg.norm(np.diff(signal.position, axis=0), axis=2)
    assert (play.gap_before[1:] <= threshold + moved + 1e-12).all()


def test_send_on_delta_speaks_beyond_the_threshold_and_not_at_it():
    position = [[0.25, 0.0, 0.0], [0.0, 0.0, 0.2500001], [0.2, 0.2, 0.0]]
    trigger = SendOnDelta(threshold=0.25)
    assert trigger.due(view(position, last_event(np.zeros((3, 3))), t=9.0), trigger.state(3)).tolist() == [1, 2]


@pytest.mark.parametrize(
    ("period", "hz", "begin_s", "length_s", "expected"),
    [
        pytest.param(0.02, 50, 0, 3600, 180_000, marks=pytest.mark.slow),
        (0.1, 50, 86_400, 300, 3_000),  # late in the day a float has fewer digits behind the point
        (1 / 30, 30, 86_400, 300, 9_000),
        (0.05, 50, 86_400, 300, 5_000),  # 2.5 asks, so every third: never sooner than the period
    ],
)
def test_periodic_counts_are_exact_however_long_it_runs(period, hz, begin_s, length_s, expected):
    trigger = Periodic(period_s=period)
    said, state, sent = LastEvent(1), trigger.state(1), 0
    moment = view([[0.0] * 3], said)
    for tick in range(begin_s * hz, (begin_s + length_s) * hz):
        moment.t = tick / hz
        if len(trigger.due(moment, state)):
            said.time[0] = moment.t
            sent += 1
    assert sent == expected


def test_a_trigger_must_say_when_it_fires():
    with pytest.raises(TypeError, match="Trigger must define `fires`"):
        Trigger().due(view([[0.0] * 3], LastEvent(1)), Trigger().state(1))


def test_what_fires_must_be_one_bool_per_row():
    class Wrong(Trigger, frozen=True):
        def fires(self, view, memory):
            return np.array([True])

    with pytest.raises(ValueError, match=r"`fires` must give one bool per row, \(2,\), not \(1,\)"):
        Wrong().due(view(np.zeros((2, 3)), LastEvent(2)), Wrong().state(2))


def test_the_table_of_the_docs_has_every_family_with_its_defaults():
    text = (Path(__file__).parents[3] / "docs" / "triggers.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([a-z-]+)` \| .* \| (.*) \|$", text, re.MULTILINE)
    last_event = {name: parameters for name, parameters in rows if name in NAMES}
    assert set(last_event) >= FAMILIES
    for name, parameters in last_event.items():
        kind = registry.struct(registry.TRIGGERS, name)
        defaults = {field.name: field.default for field in msgspec.structs.fields(kind)}
        own = set(kind.__struct_fields__) - set(Trigger.__struct_fields__)
        said = {field: float(value) for field, value in re.findall(r"`(\w+)`: \$[^$]+\$, ([0-9.]+)", parameters)}
        assert said == {field: defaults[field] for field in own}, name
