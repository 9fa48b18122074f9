"""Clocks of several machines: what a round trip tells, and what drift adds to stamps."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.network.messages import GoalReceipt, HostClock, State
from experiments.recording.clocks import ClockSample, Correction, host_offset

SMALL = st.floats(0.0, 0.5)


@given(st.floats(-10.0, 10.0), st.lists(st.tuples(SMALL, SMALL), min_size=1, max_size=20))
def test_offset_is_within_uncertainty_despite_unequal_ways(true, ways):
    samples = [
        ClockSample(100.0 + k, 100.0 + k + there + true, 100.0 + k + there + back)
        for k, (there, back) in enumerate(ways)
    ]
    found, uncertainty = host_offset(samples)
    assert abs(found - true) <= uncertainty + 1e-9
    assert uncertainty == pytest.approx(min(there + back for there, back in ways) / 2, abs=1e-9)


def test_the_shortest_way_tells_most():
    slow, quick = ClockSample(0.0, 0.2, 1.0), ClockSample(2.0, 2.2005, 2.001)
    assert host_offset([slow, quick, slow]) == (pytest.approx(0.2), pytest.approx(0.0005))


def measured(host, stamp, lies, robots=("CF01",)):
    return HostClock(host, stamp, lies, 1e-4, list(robots))


def test_drift_is_removed_after_the_initial_offset():
    begin, drift = 1.7e9, 50e-6
    said = [measured("lab2", begin, 0.2), measured("lab1", begin, 0.0, ["KH01"]), measured("lab2", begin + 600.0, 0.23)]
    right = Correction(said)
    true = begin + np.array([0.0, 10.0, 300.0, 600.0])
    stamped = true + drift * (true - begin)  # its offset of 0.2 s was taken off when it stamped
    assert stamped[-1] - true[-1] == pytest.approx(0.03, abs=1e-6), "six times what starts may differ"
    assert [right("CF01", float(stamp)) for stamp in stamped] == pytest.approx(list(true), abs=1e-5)
    assert right("KH01", begin + 5.0) == begin + 5.0, "measured once"
    assert right("TB01", begin + 5.0) == begin + 5.0, "it ran here"
    lab2, lab1 = right.offsets()
    assert (lab2.host, lab2.robots, lab2.over) == ("lab2", ("CF01",), 600.0)
    assert lab2.drift == pytest.approx(drift)
    assert lab1.drift is None


def test_goals_in_transit_keep_their_delay():
    drift, true = 50e-6, 300.0
    right = Correction([measured("lab2", 0.0, 0.2), measured("lab2", 600.0, 0.23)])
    pose, acted = true * (1 + drift), (true + 0.1) * (1 + drift)
    followed, rest = [GoalReceipt(7, 300.05, pose, acted)], (0.0, 0.0, 0.0)
    said = State("CF01", 1, acted, "running", rest, rest, 0.0, None, None, 0.0, goal_receipts=followed)
    goal = right.state(said).goal_receipts[0]
    assert goal.stamp == 300.05, "the centre runs where the conductor does"
    assert (goal.pose, goal.acted) == pytest.approx((true, true + 0.1), abs=1e-5)


def test_nothing_measured_nothing_changed():
    assert Correction([])("CF01", 12.5) == 12.5
    assert Correction([]).offsets() == ()
