"""Clocks that drift during a run: what is left in stamps when robots follow."""

import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.clock import STEP_S, Clock, correction_line
from agents.network.messages import HostClock
from experiments.real_time.hosts import hosts
from experiments.real_time.hosts.hosts import HostError
from experiments.recording.clocks import Correction
from tests.small import changed
from tests.waiting import PATIENCE_S, until

DT, UNCERTAINTY_S = 0.01, 1e-4


@pytest.mark.parametrize(("ppm", "most"), [(50, 0.9e-3), (-50, 0.9e-3), (2000, 3.5e-3)])
def test_remaining_drift_stays_small_whatever_the_runs_length(ppm, most):
    """Ten minutes; without corrections up to 1.2 s would be left in stamps."""
    rng = np.random.default_rng(7)
    true = np.arange(round(600.0 / DT)) * DT
    clock, measured, left, due = Clock(-0.2), [HostClock("lab2", 0.0, 0.2, UNCERTAINTY_S, ["CF01"], 0.2)], [], 0.0
    for t, offset in zip(true, 0.2 + ppm * 1e-6 * true, strict=True):
        if t >= due + hosts.DRIFT_S:
            now = HostClock("lab2", t, offset + rng.uniform(-1, 1) * UNCERTAINTY_S, UNCERTAINTY_S, ["CF01"])
            due, applied = t, hosts.applied(now, measured[-1].applied)
            clock.follow(correction_line(-applied).strip())
            measured.append(changed(now, applied=applied))
        clock.slew(DT)
        left.append(offset + clock.correction_s)
    left = np.array(left)
    assert np.abs(left).max() < most
    assert (np.diff(true + left) > 0.9 * DT).all(), "stamps never go back"
    right = Correction(measured)
    until = true <= measured[-1].stamp
    mended = [right("CF01", float(stamp)) for stamp in (true + left)[until][::50]]
    assert np.abs(mended - true[until][::50]).max() < 2.5 * UNCERTAINTY_S, "what is left is taken off the recording"
    (lie,) = right.offsets()
    assert lie.worst == pytest.approx(np.abs(left).max(), abs=1e-3)


@given(st.floats(-1.0, 1.0), st.floats(0.0, 0.1), st.floats(-1.0, 1.0))
def test_a_measurement_never_makes_it_worse(offset, uncertainty, before):
    now = hosts.applied(HostClock("lab2", 1.0, offset, uncertainty, []), before)
    for true in np.linspace(offset - uncertainty, offset + uncertainty, 5):
        assert abs(now - true) <= abs(before - true) + 1e-12


class Host:
    """A host whose clock says what it is given, then is silent; or one that only calls `asked`."""

    def __init__(self, *offsets, asked=None):
        self.name, self.clock = "lab2", HostClock("lab2", 0.0, 0.2, UNCERTAINTY_S, ["CF01"], 0.2)
        self.offsets, self.told, self.asked = list(offsets), [], asked or (lambda: None)

    def measure(self, samples):
        self.asked()
        if not self.offsets:
            raise HostError("lab2: says nothing")
        self.clock = HostClock("lab2", time.time(), self.offsets.pop(0), UNCERTAINTY_S, ["CF01"], self.clock.applied)
        return self.clock

    def correct(self, applied):
        self.told.append(applied)
        self.clock = HostClock("lab2", 0.0, self.clock.offset, UNCERTAINTY_S, self.clock.robots, applied)
        return self.clock


def followed(*there):
    """Measurements of hosts and what went wrong with them, until two things have."""
    measured, trouble = [], []

    def over():
        for every, more in zip((measured, trouble), following.news(), strict=True):
            every.extend(more)
        return len(trouble) >= 2

    with hosts.Drift(there, 0.01) as following:
        until(over, "two things went wrong")
    return measured, trouble


def test_robots_are_told_drift_and_no_jump():
    host = Host(0.21, 0.21 + 2 * STEP_S, 0.22)
    measured, trouble = followed(host)
    assert host.told == pytest.approx([0.21 - UNCERTAINTY_S, 0.22 - UNCERTAINTY_S])
    assert [each.offset for each in measured] == pytest.approx([0.21, 0.21 + 2 * STEP_S, 0.22])
    assert "its clock jumped by +1" in trouble[0]
    assert "says nothing; its clock is not corrected any more" in trouble[1]


def test_host_that_ends_meanwhile_leaves_the_others_corrected():
    def ended():
        raise ValueError("I/O operation on closed file")

    other = Host(0.21, 0.22)
    followed(Host(asked=ended), other)
    assert len(other.told) == 2
    with hosts.Drift([]) as following:
        assert following.news() == ([], []), "nobody abroad"


def test_end_waits_only_for_the_host_being_asked():
    asked, ending = [], threading.Event()

    def silent():
        asked.append(1)
        ending.wait(PATIENCE_S)

    with hosts.Drift([Host(asked=silent) for _ in range(3)], 0.01) as following:
        until(lambda: asked, "the first is asked")
        closing = threading.Thread(target=following.close)
        closing.start()
        threading.Event().wait(0.05)  # it has ended, and waits for the first
        ending.set()
        closing.join()
    assert len(asked) == 1
