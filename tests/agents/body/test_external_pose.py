"""Velocities of bodies that measure only positions, and poses from outside."""

from math import isnan, nan

import pytest

from agents.body.external_pose import FASTEST, PATIENCE_S, External
from agents.body.interface import BodyState
from agents.vectors import UNKNOWN


def state(t, position, velocity=UNKNOWN, yaw=0.0):
    return BodyState(t, position, velocity, yaw)


def test_velocity_follows_from_positions():
    external = External()
    for k in range(151):
        t = 0.01 * k
        moving = state(t, (0.2 * min(t, 1.0), 0.0, 0.0))
        external.estimate(t, moving)
        if k == 100:
            assert moving.velocity == pytest.approx((0.2, 0.0, 0.0), abs=1e-3)
    assert 0.0 <= moving.velocity[0] < 0.003  # it stands now


def test_measured_velocity_is_kept():
    measured = state(0.0, (0.0, 0.0, 0.0), (0.0, 0.7, 0.0))
    External().estimate(0.0, measured)
    assert measured.velocity == (0.0, 0.7, 0.0)


def test_velocity_of_old_position_is_unknown():
    external, first, old = External(), state(0.0, (0.0, 0.0, 0.0)), state(0.0, (0.0, 0.0, 0.0))
    external.estimate(0.1, first)
    assert first.velocity == (0.0, 0.0, 0.0)
    external.estimate(PATIENCE_S, old)
    assert all(map(isnan, old.velocity))
    nowhere = state(0.0, (nan, 0.0, 0.0))
    External().estimate(0.1, nowhere)
    assert all(map(isnan, nowhere.velocity))


def test_poses_that_are_old_or_jump_are_refused():
    external = External()
    assert external.update(1.0, (0.0, 0.0, 0.0), 0.0)
    assert not external.update(1.0, (0.0, 0.0, 0.0), 0.0)
    assert not external.update(1.1, (nan, 0.0, 0.0), 0.0)
    assert not external.update(1.1, (FASTEST * 0.1 + 0.1, 0.0, 0.0), 0.0)
    assert (external.refused, external.time) == (1, 1.0)
    assert external.update(1.0 + PATIENCE_S, (9.0, 0.0, 0.0), 0.0)
    assert external.velocity == (0.0, 0.0, 0.0)


def test_own_yaw_continues_without_measured_yaw():
    external = External()

    def yaw(t, measured, own):
        external.update(t, (0.1 * t, 0.0, 0.0), measured)
        filled = state(t - 0.5, (7.0, 7.0, 7.0), yaw=own)
        external.fill(filled)
        assert (filled.time, filled.position, filled.velocity) == (t, external.position, external.velocity)
        return filled.yaw

    assert yaw(0.0, nan, 0.3) == 0.3  # none was measured yet
    assert yaw(0.1, 1.0, 0.2) == 1.0
    assert yaw(0.2, nan, 0.7) == pytest.approx(1.5)  # turned by 0.5 since
    assert yaw(5.0, nan, -0.2) == pytest.approx(0.6)
    assert yaw(5.1, 2.0, -0.2) == 2.0
    assert isnan(yaw(5.2, nan, nan))
