"""Seeds of a run in virtual time, shared between processes."""

import numpy as np
import pytest

from experiments import run
from experiments.file import document

pytestmark = pytest.mark.slow

READ = document.load("triangle", "duration_s=1.0")


def test_seeds_of_several_processes_are_those_of_one(monkeypatch, tmp_path):
    told = []
    alone = run.simulate_seeds(READ, range(4, 7), cases=["event"])
    monkeypatch.setattr(run, "SHARED", 0.0)
    monkeypatch.setattr(run, "cores", lambda: 2)
    shared = run.simulate_seeds(READ, range(4, 7), cases=["event"], folder=tmp_path, progress=lambda *t: told.append(t))
    assert [each.seed for each in shared] == [4, 5, 6]
    assert [file.name for file in tmp_path.iterdir()] == ["event.mcap"]
    assert told[-1] == ("event", 1, 1)
    for one, other in zip(alone, shared, strict=True):
        ours, theirs = one.traces["event"], other.traces["event"]
        assert np.array_equal(ours.true_position, theirs.true_position)
        assert np.array_equal(ours.sent.stamp, theirs.sent.stamp)
        assert repr(one.metrics["event"]) == repr(other.metrics["event"])
