"""Take-offs that overshoot as the firmware's do: the robot gets to its height, and no hazard is seen in it."""

import numpy as np
import pytest

from agents.body.kinds import CRAZYFLIE
from agents.decision.lifecycle import Lifecycle, Phase
from agents.safety.detection import Ascent
from agents.safety.obedience import Obedience
from agents.safety.setpoint_filter import OUTSIDE_M
from experiments.real_time.conductor.hot_changes import CLIMB_S
from tests.bridges.crazyflie_clock import TICK, Fleet

ROW = np.array([True])


@pytest.mark.parametrize(("height", "soon"), [(0.5, 3.0), (0.8, 3.5), (1.0, 4.5), (2.0, 9.0), (4.0, CLIMB_S - 1.0)])
def test_ready_at_height_in_spite_of_the_overshoot(monkeypatch, height, soon):
    """Followed by lifecycle and detectors as in a robot's process, for 12 s at its height."""
    lifecycle = Lifecycle(ROW, np.array([height]), 100.0)
    ascent, obedience = Ascent([CRAZYFLIE], np.array([height])), Obedience([CRAZYFLIE])
    setpoint = np.array([[0.0, 0.0, height, 0.0]])
    with Fleet(monkeypatch, 1, 500.0) as fleet:
        flock = fleet.twin.flock
        lifecycle.advance(0.0, ROW, flock.place, flock.velocity, ~ROW)
        assert lifecycle.takeoff(0) == ""
        fleet.climb(height)
        begin, since, highest = fleet.now, None, 0.0
        while since is None or fleet.now < since + 12.0:
            fleet.run(TICK)
            t, flying = fleet.now - begin, flock.quadrotor.flying
            lifecycle.advance(t, ROW, flock.place, flock.velocity, flying)
            climbing = ROW & (lifecycle.climbing is not None)
            if since is None and lifecycle.phase[0] == Phase.AIRBORNE:
                assert lifecycle.start(0, t + 1.0) == ""
                since = fleet.now
            ascent.update(t, climbing, flying, flock.place)
            obedience.update(t, setpoint, flock.place, flock.quadrotor.yaw, ~climbing)
            assert not ascent.amiss
            assert not obedience.still.any()
            assert not obedience.strays.any()
            assert t < soon or since is not None
            highest = max(highest, float(fleet.heights[0]))
        assert lifecycle.phase[0] == Phase.RUNNING
        assert not fleet.troubles
        assert height < highest < (1.0 + CRAZYFLIE.overshoot) * height
        assert highest < height + OUTSIDE_M  # it does not count as having left an arena that ends above its height
