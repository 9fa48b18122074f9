"""Runs flown in plain Python, by compiled functions, or read back from their recordings, which must be the same."""

from dataclasses import fields, is_dataclass
from math import isnan

import msgspec
import numpy as np

from experiments.definition.plan import Plan
from experiments.recording import playback
from experiments.virtual_time import stretch
from experiments.virtual_time.simulation import VirtualRun


def evaluated(experiment, *, compiled, seed=1, lean=False, change=None):
    """Log of a run with changed assignments, and the ticks of it that were compiled."""

    class Changed(Plan):
        def assignment(self, name, **how):
            given = super().assignment(name, **how)
            return given if change is None else change(given)

    stretch.WORK[0] = 1e6 if compiled else -1e6  # compilation pays, or nothing does
    try:
        flight = VirtualRun(Changed(experiment), seed, quiet=False, lean=lean)
        flight.fly(landing=True)
    finally:
        stretch.WORK[:] = 0.0, 0.0
    assert compiled or flight.stretches is None
    return flight.log(), 0 if flight.stretches is None else flight.stretches.flown


def same(experiment, **options):
    """Log of a plain run, the same as the compiled one in every bit, and the number of ticks that were compiled."""
    plain, _ = evaluated(experiment, compiled=False, **options)
    other, ticks = evaluated(experiment, compiled=True, **options)
    for field in fields(plain):
        assert alike(getattr(plain, field.name), getattr(other, field.name)), field.name
    assert [*plain.measures] == [*other.measures]
    return plain, ticks


def played_back(recorder, folder):
    """The trace of a run, the same as the one that is read back from its recording, and the latter."""
    recorder.record(folder / "run.mcap", "")
    played, trace = playback.read(folder / "run.mcap"), recorder.trace()
    assert (played.complete, played.trace.goals is None) == (True, trace.goals is None)
    for field in fields(trace):
        if field.name != "goals":  # a recording has less of them
            assert alike(getattr(trace, field.name), getattr(played.trace, field.name), 3e-6), field.name
    return trace, played.trace


def alike(one, other, within=0.0):
    """Whether two values are the same, numbers to a tolerance; unknown ones are the same."""
    if isinstance(one, msgspec.Struct):
        one, other = msgspec.structs.astuple(one), msgspec.structs.astuple(other)
    if is_dataclass(one):
        one, other = (tuple(getattr(each, field.name) for field in fields(each)) for each in (one, other))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(alike(one[name], other[name], within) for name in one)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(alike(*each, within) for each in zip(one, other, strict=True))
    if isinstance(one, np.ndarray) and one.dtype.kind == "f":
        return one.dtype == other.dtype and np.allclose(one, other, rtol=0.0, atol=within, equal_nan=True)
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other)
    if isinstance(one, float):
        return abs(one - other) <= within or one == other or (isnan(one) and isnan(other))
    return one == other
