"""Poses as young as the budget of a radio promises, and take-offs that overshoot, on a simulated clock."""

import numpy as np
import pytest

from agents.decision.lifecycle import AIRBORNE, RUNNING, Lifecycle
from agents.kinds.crazyflie import CRAZYFLIE
from agents.protocols.crazyflie import YOUNG_S, CrazyflieSettings, oldest_pose, overload
from agents.safety.detection import Ascent
from agents.safety.motion_check import MotionCheck
from agents.safety.setpoint_filter import OUTSIDE_M
from bridges.crazyflie.flight import FlightPhase
from experiments.real_time.conductor.hot_changes import CLIMB_S
from tests.bridges.crazyflie_clock import HEIGHT, TICK, Fleet, flight_of

SINKS = 0.5  # [m/s] a landing is slower


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rows", "exchanges", "rates"),
    [
        pytest.param(1, 400.0, {}, marks=pytest.mark.nightly),
        (4, 400.0, {}),
        pytest.param(8, 400.0, {"stream_hz": 7.0}, marks=pytest.mark.nightly),
        pytest.param(15, 664.0, {"stream_hz": 5.0}, marks=pytest.mark.nightly),
        pytest.param(5, 250.0, {"stream_hz": 7.0}, marks=pytest.mark.nightly),
    ],
)
def test_rates_that_a_radio_carries_leave_poses_young(monkeypatch, rows, exchanges, rates):
    settings = [CrazyflieSettings(**rates)] * rows
    assert overload("0", settings, exchanges) == ""
    with Fleet(monkeypatch, rows, exchanges, **rates) as fleet:
        age = np.percentile(flight_of(fleet), 99)
        assert fleet.fastest < SINKS
    print(f"{rows} robots, {exchanges:g} exchanges/s: 99 % of poses are younger than {1e3 * age:.0f} ms")
    assert age < oldest_pose(settings, exchanges) <= YOUNG_S


@pytest.mark.slow
def test_take_off_with_yaw_leaves_poses_young(monkeypatch):
    """Seventeen parts of polynomials, one at a time: in a burst their answers made poses 0.2 s old."""
    with Fleet(monkeypatch, 8, 400.0, stream_hz=4.0) as fleet:
        fleet.twin.flock.quadrotor.yaw[:] = 0.5
        assert np.percentile(flight_of(fleet), 99) < YOUNG_S


@pytest.mark.slow
def test_full_queue_ages_poses_and_prevents_take_off(monkeypatch):
    """More logs than polls: the drone says so by its stamps, long before a packet is lost."""
    with Fleet(monkeypatch, 1, 90.0, log_hz=100.0) as fleet:
        (line,) = fleet.twin.lines
        while len(line.queue) < 150:
            fleet.run(0.1)
        assert fleet.ages[-1][0] == pytest.approx(len(line.queue) / 100.0, rel=0.05)
        fleet.order(lambda flight: flight.takeoff(HEIGHT))
        fleet.run(0.5)
        (trouble,) = fleet.troubles
        assert "s old; is its radio too full" in trouble
        assert fleet.phases == {FlightPhase.GROUND}
        assert line.dropped == 0
        assert not fleet.twin.flock.quadrotor.flying.any()


@pytest.mark.slow
def test_gaps_after_the_take_off(monkeypatch):
    """Of the file: the first is flown through, the second ends in a landing."""
    with Fleet(monkeypatch, 2, 400.0, gaps=[[4.0, 1.2], [2.0, 0.5]]) as fleet:
        fleet.run(1.0)
        fleet.order(lambda flight: flight.takeoff(HEIGHT))
        gaps = []
        for _ in range(700):
            fleet.run(0.01, speed=0.1)
            gaps.append([fleet.now - line.heard - 100.0 for line in fleet.twin.lines])
        assert np.max(gaps[:400], axis=0) == pytest.approx(0.5, abs=0.02)
        assert np.max(gaps, axis=0) == pytest.approx(1.2, abs=0.02)


HEIGHTS = [
    (0.5, 3.0),
    (2.0, 9.0),
    *(pytest.param(*each, marks=pytest.mark.nightly) for each in ((0.8, 3.5), (1.0, 4.5), (4.0, CLIMB_S - 1.0))),
]


@pytest.mark.slow
@pytest.mark.parametrize(("height", "soon"), HEIGHTS)
def test_ready_at_height_in_spite_of_the_overshoot(monkeypatch, height, soon):
    """Followed by lifecycle and detectors as in a robot's process, for 12 s at its height."""
    lifecycle, setpoint = Lifecycle(CRAZYFLIE, height, 100.0), (0.0, 0.0, height, 0.0)
    ascent, motion_check = Ascent(CRAZYFLIE, height), MotionCheck(CRAZYFLIE)
    with Fleet(monkeypatch, 1, 500.0) as fleet:
        flock = fleet.twin.flock

        def advance(t, *, ready=False):
            position, velocity = (tuple(each[0].tolist()) for each in (flock.place, flock.velocity))
            flying, yaw = bool(flock.quadrotor.flying[0]), float(flock.quadrotor.yaw[0])
            lifecycle.advance(t, position, velocity, flying=flying, ready=ready)
            ascent.update(t, lifecycle.climbing, flying, position)
            motion_check.update(t, setpoint, position, yaw, not lifecycle.climbing)

        advance(0.0, ready=True)
        assert lifecycle.takeoff() == ""
        lifecycle.takeoff_due = False
        fleet.climb(height)
        begin, since, highest = fleet.now, None, 0.0
        while since is None or fleet.now < since + 12.0:
            fleet.run(TICK)
            t = fleet.now - begin
            advance(t)
            if since is None and lifecycle.phase == AIRBORNE:
                assert lifecycle.start(t + 1.0) == ""
                since = fleet.now
            assert not ascent.carried
            assert not ascent.stalled
            assert not motion_check.unresponsive
            assert not motion_check.uncommanded
            assert t < soon or since is not None
            highest = max(highest, float(fleet.heights[0]))
        assert lifecycle.phase == RUNNING
        assert not fleet.troubles
        assert height < highest < (1.0 + CRAZYFLIE.overshoot) * height
        assert highest < height + OUTSIDE_M  # it does not count as having left an arena that ends above its height
