"""Take-offs that overshoot as the firmware's do: the robot gets to its height, and no hazard is seen in it."""

import pytest

from agents.decision.lifecycle import Lifecycle, Phase
from agents.kinds.crazyflie import CRAZYFLIE
from agents.safety.detection import Ascent
from agents.safety.motion_check import MotionCheck
from agents.safety.setpoint_filter import OUTSIDE_M
from experiments.real_time.conductor.hot_changes import CLIMB_S
from tests.bridges.crazyflie_clock import TICK, Fleet

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
            if since is None and lifecycle.phase == Phase.AIRBORNE:
                assert lifecycle.start(t + 1.0) == ""
                since = fleet.now
            assert not ascent.carried
            assert not ascent.stalled
            assert not motion_check.unresponsive
            assert not motion_check.uncommanded
            assert t < soon or since is not None
            highest = max(highest, float(fleet.heights[0]))
        assert lifecycle.phase == Phase.RUNNING
        assert not fleet.troubles
        assert height < highest < (1.0 + CRAZYFLIE.overshoot) * height
        assert highest < height + OUTSIDE_M  # it does not count as having left an arena that ends above its height
