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
from tests.waiting import PATIENCE_S, until

DT, UNCERTAINTY_S = 0.01, 1e-4


def simulated(ppm, seconds, *, follows):
    """Offset, what is left of it in the robots' stamps (T), what was measured, and stamps beside true times."""
    rng = np.random.default_rng(7)
    true = np.arange(round(seconds / DT)) * DT
    offset = 0.2 + ppm * 1e-6 * true
    before = HostClock("lab2", 0.0, 0.2, UNCERTAINTY_S, ["CF01"], 0.2)
    clock, measured, left, due = Clock(-0.2), [before], [], hosts.DRIFT_S
    for t, lies in zip(true, offset, strict=True):
        if t >= due:
            now = HostClock("lab2", t, lies + rng.uniform(-1, 1) * UNCERTAINTY_S, UNCERTAINTY_S, ["CF01"])
            due = t + hosts.DRIFT_S
            wanted = hosts.applied(now, measured[-1].applied) if follows else 0.2
            clock.follow(correction_line(-wanted).strip())
            measured.append(HostClock("lab2", t, now.offset, UNCERTAINTY_S, ["CF01"], wanted))
        clock.slew(DT)
        left.append(lies + clock.correction_s)
    return true, offset, np.array(left), measured


@pytest.mark.parametrize(("ppm", "most"), [(50, 0.9e-3), (-50, 0.9e-3), (500, 2.5e-3), (2000, 3.5e-3)])
def test_remaining_drift_stays_small_whatever_the_runs_length(ppm, most):
    true, _, left, measured = simulated(ppm, 600.0, follows=True)
    assert np.abs(left).max() < most
    _, _, without, _ = simulated(ppm, 600.0, follows=False)
    assert np.abs(without).max() == pytest.approx(abs(ppm) * 6e-4, abs=1e-3)
    assert (np.diff(true + left) > 0.9 * DT).all(), "stamps never go back"
    right = Correction(measured)
    until = true <= measured[-1].stamp
    stamps = (true + left)[until]
    mended = np.array([right("CF01", float(stamp)) for stamp in stamps[::50]])
    assert np.abs(mended - true[until][::50]).max() < 2.5 * UNCERTAINTY_S, "what is left is taken off the recording"
    (lie,) = right.offsets()
    assert lie.worst == pytest.approx(np.abs(left).max(), abs=1e-3)


@given(st.floats(-1.0, 1.0), st.floats(0.0, 0.1), st.floats(-1.0, 1.0))
def test_a_measurement_never_makes_it_worse(offset, uncertainty, before):
    now = hosts.applied(HostClock("lab2", 1.0, offset, uncertainty, []), before)
    for true in np.linspace(offset - uncertainty, offset + uncertainty, 5):
        assert abs(now - true) <= abs(before - true) + 1e-12


class Host:
    """A host whose clock says what it is given, then jumps, then is silent."""

    def __init__(self, offsets):
        self.name, self.clock = "lab2", HostClock("lab2", 0.0, 0.2, UNCERTAINTY_S, ["CF01"], 0.2)
        self.offsets, self.told = list(offsets), []

    def measure(self, samples):
        if not self.offsets:
            raise HostError("lab2: says nothing")
        self.clock = HostClock("lab2", time.time(), self.offsets.pop(0), UNCERTAINTY_S, ["CF01"], self.clock.applied)
        return self.clock

    def correct(self, applied):
        self.told.append(applied)
        self.clock = HostClock("lab2", 0.0, self.clock.offset, UNCERTAINTY_S, self.clock.robots, applied)
        return self.clock


def test_robots_are_told_drift_and_no_jump():
    host = Host([0.21, 0.21 + 2 * STEP_S, 0.22])
    measured, trouble = [], []

    def followed():
        for every, more in zip((measured, trouble), following.news(), strict=True):
            every.extend(more)
        return len(trouble) >= 2

    with hosts.Drift([host], 0.01) as following:
        until(followed, "a jump and silence are noticed")
    assert host.told == pytest.approx([0.21 - UNCERTAINTY_S, 0.22 - UNCERTAINTY_S])
    assert [each.offset for each in measured] == pytest.approx([0.21, 0.21 + 2 * STEP_S, 0.22])
    assert "its clock jumped by +1" in trouble[0]
    assert "says nothing; its clock is not corrected any more" in trouble[1]


def test_host_that_ends_meanwhile_leaves_the_others_corrected():
    class Ended(Host):
        def measure(self, samples):
            raise ValueError("I/O operation on closed file")

    other, trouble = Host([0.21, 0.22]), []
    with hosts.Drift([Ended([]), other], 0.01) as following:
        until(lambda: trouble.extend(following.news()[1]) or len(trouble) == 2, "both are out")
    assert len(other.told) == 2


def test_end_waits_only_for_the_host_being_asked():
    asked, ending = [], threading.Event()

    class Silent(Host):
        def measure(self, samples):
            asked.append(self)
            ending.wait(PATIENCE_S)
            return super().measure(samples)

    with hosts.Drift([Silent([]), Silent([]), Silent([])], 0.01) as following:
        until(lambda: asked, "the first is asked")
        closing = threading.Thread(target=following.close)
        closing.start()
        threading.Event().wait(0.05)  # it has ended, and waits for the first
        ending.set()
        closing.join()
    assert len(asked) == 1


def test_nobody_abroad_nothing_to_follow():
    with hosts.Drift([]) as following:
        assert following.news() == ([], [])
