"""Every registered trigger: rows decide as if alone, first asks are answered, intervals and silences are kept."""

from typing import get_type_hints

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents import plugins
from agents.triggers import Periodic, SendOnDelta, Told, Trigger, View

DT = 0.02
NAMES = plugins.names(plugins.TRIGGERS)
SEEDS = st.integers(0, 2**32 - 1)
FEW = settings(max_examples=15, deadline=None)


def made(name, **parameters):
    """A trigger with its defaults; parameters without one get a small number."""
    kind = plugins.struct(plugins.TRIGGERS, name)
    needed = {f.encode_name for f in msgspec.structs.fields(kind) if f.required}
    return plugins.build(plugins.TRIGGERS, {"kind": name, **dict.fromkeys(needed, 0.05), **parameters})


def wander(seed, rows, ticks):
    """Random walks with rests: (K, N, 3) positions and velocities, and an error (K, N)."""
    rng = np.random.default_rng(seed)
    speed = rng.choice([0.0, 0.05, 0.5], (ticks, rows, 1)) * rng.normal(size=(ticks, rows, 3))
    return np.cumsum(speed * DT, axis=0) + rng.normal(size=(rows, 3)), speed, rng.uniform(0, 0.3, (ticks, rows))


def play(trigger, positions, velocities, errors):
    """Who speaks when (K, N), and what is remembered at the end."""
    rows = positions.shape[1]
    told, memory, spoke = Told.nothing(rows), trigger.memory(rows), []
    for k, (position, velocity, error) in enumerate(zip(positions, velocities, errors, strict=True)):
        t = k * DT
        now = trigger.speaks(View(t, position, velocity, told, error), memory)
        told.tell(now, t, position, velocity)
        spoke.append(np.isin(np.arange(rows), now))
    return np.array(spoke), told, memory


def gaps(spoke):
    """Ticks between messages of each row."""
    return [np.diff(np.flatnonzero(column)) for column in spoke.T]


def test_triggers_are_registered():
    assert {"periodic", "send-on-delta"} <= set(NAMES)
    for name in NAMES:
        assert isinstance(made(name), Trigger)


@pytest.mark.parametrize("name", NAMES)
@FEW
@given(seed=SEEDS)
def test_rows_speak_as_if_each_were_alone(name, seed):
    trigger, signal = made(name, minimum_interval_s=0.04, maximum_silence_s=0.3), wander(seed, 4, 40)
    together, told, memory = play(trigger, *signal)
    for row in range(4):
        alone, mine, remembered = play(trigger, *(part[:, row : row + 1] for part in signal))
        np.testing.assert_array_equal(alone[:, 0], together[:, row])
        np.testing.assert_array_equal(remembered[0], memory[row])
        np.testing.assert_array_equal(mine.position[0], told.position[row])
        np.testing.assert_array_equal(mine.velocity[0], told.velocity[row])
        assert mine.time[0] == told.time[row]


@pytest.mark.parametrize("name", NAMES)
@FEW
@given(seed=SEEDS)
def test_who_never_spoke_speaks_when_first_asked(name, seed):
    for options in ({}, {"minimum_interval_s": 0.5}, {"maximum_silence_s": 1.0}):
        spoke, _, _ = play(made(name, **options), *wander(seed, 3, 1))
        assert spoke.all()


@pytest.mark.parametrize("name", NAMES)
@FEW
@given(seed=SEEDS, ticks=st.integers(1, 15))
def test_the_minimum_interval_is_kept(name, seed, ticks):
    spoke, _, _ = play(made(name, minimum_interval_s=ticks * DT), *wander(seed, 4, 60))
    for gap in gaps(spoke):
        assert (gap >= ticks).all()


@pytest.mark.parametrize("name", NAMES)
@FEW
@given(seed=SEEDS, ticks=st.integers(1, 15))
def test_the_maximum_silence_is_kept(name, seed, ticks):
    signal = wander(seed, 4, 60)
    signal[0][:], signal[1][:] = signal[0][:1], 0.0  # nobody moves: only silence makes them speak
    spoke, _, _ = play(made(name, maximum_silence_s=ticks * DT), *signal)
    for gap in gaps(spoke):
        assert len(gap) >= 60 // ticks - 1
        assert (gap <= ticks).all()


@pytest.mark.parametrize("name", NAMES)
def test_parameters_have_units_in_their_descriptions(name):
    hints = get_type_hints(plugins.struct(plugins.TRIGGERS, name), include_extras=True)
    assert hints
    for hint in hints.values():
        assert any("[" in str(note) for note in getattr(hint, "__metadata__", ())), hint


@FEW
@given(SEEDS, st.floats(0.002, 0.05))
def test_send_on_delta_bounds_what_the_neighbours_do_not_know(seed, threshold):
    positions, velocities, errors = wander(seed, 3, 80)
    told, memory, trigger = Told.nothing(3), np.zeros((3, 0)), SendOnDelta(threshold=threshold)
    moved = np.zeros(3)
    for k, position in enumerate(positions):
        if k:
            moved = np.linalg.norm(position - positions[k - 1], axis=1)
            before = np.linalg.norm(position - told.position, axis=1)  # just before it may speak again
            assert (before <= threshold + moved + 1e-12).all()
        now = trigger.speaks(View(k * DT, position, velocities[k], told, errors[k]), memory)
        told.tell(now, k * DT, position, velocities[k])
        assert (np.linalg.norm(position - told.position, axis=1) <= threshold).all()


def test_send_on_delta_speaks_beyond_the_threshold_and_not_at_it():
    told = Told(np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3))
    position = np.array([[0.25, 0.0, 0.0], [0.0, 0.0, 0.2500001], [0.2, 0.2, 0.0]])
    view = View(9.0, position, np.zeros((3, 3)), told, np.zeros(3))
    assert SendOnDelta(threshold=0.25).speaks(view, np.zeros((3, 0))).tolist() == [1, 2]


@pytest.mark.parametrize(
    ("period", "hz", "begin_s", "length_s", "expected"),
    [
        (0.02, 50, 0, 3600, 180_000),
        (0.1, 50, 86_400, 300, 3_000),  # late in the day a float has fewer digits behind the point
        (1 / 30, 30, 86_400, 300, 9_000),
        (0.05, 50, 86_400, 300, 5_000),  # 2.5 asks, so every third: never sooner than the period
    ],
)
def test_periodic_counts_are_exact_however_long_it_runs(period, hz, begin_s, length_s, expected):
    trigger = Periodic(period_s=period)
    told, still, memory = Told.nothing(1), np.zeros((1, 3)), np.zeros((1, 0))
    sent = 0
    for tick in range(begin_s * hz, (begin_s + length_s) * hz):
        t = tick / hz
        if len(trigger.speaks(View(t, still, still, told, still[0]), memory)):
            told.time[0] = t
            sent += 1
    assert sent == expected


def test_a_position_that_is_not_known_is_not_news():
    told = Told(np.zeros((1, 3)), np.zeros((1, 3)), np.zeros(1))
    nowhere = np.full((1, 3), np.nan)
    assert not len(SendOnDelta().speaks(View(1.0, nowhere, nowhere, told, np.zeros(1)), np.zeros((1, 0))))


def test_a_trigger_must_say_when_it_fires():
    view = View(0.0, np.zeros((1, 3)), np.zeros((1, 3)), Told.nothing(1), np.zeros(1))
    with pytest.raises(TypeError, match="Trigger must say when it fires"):
        Trigger().speaks(view, np.zeros((1, 0)))
