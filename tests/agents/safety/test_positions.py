"""Positions that are believed: a robot does not jump, and what its position jumped to is not passed on to it."""

import math
from math import inf, nan

import pytest

from agents.kinds.crazyflie import CRAZYFLIE
from agents.kinds.khepera4 import KHEPERA4
from agents.safety.positions import FLIP, JUMP_M, PLAUSIBLE_SPEED, Continuity, ExternalPositions


def jump(*samples, kind=CRAZYFLIE):
    """Last jump of a robot in motion that was at x [m] at several times [s]."""
    continuity = Continuity(kind)
    return [continuity.jump(t, (x, 0.0, 0.0), 0.0, True) for t, x in samples][-1]


def test_jump_is_farther_than_a_robot_can_move():
    assert math.isnan(jump((0.0, 0.0), (0.01, 0.99 * JUMP_M)))
    assert jump((0.0, 0.0), (0.01, 1.0)) == 1.0
    assert jump((0.0, 0.0), (0.01, 1.0), (9.0, 1.0)) == 1.0  # time does not heal it
    assert math.isnan(jump((0.0, 0.0), (0.01, 1.0), (0.02, 0.0)))
    assert jump((0.0, 0.0), (0.01, 1.0), (0.02, nan), (0.03, 1.0)) == 1.0
    far = JUMP_M + PLAUSIBLE_SPEED * CRAZYFLIE.speed * 0.3  # a gap in the measurements
    assert math.isnan(jump((0.0, 0.0), (0.3, far - 0.01)))
    assert jump((0.0, 0.0), (0.3, far - 0.01), kind=KHEPERA4) == pytest.approx(far - 0.01)
    assert jump((0.0, 0.0), (9.0, 5.0)) == 5.0


def test_unknown_position_does_not_end_a_jump():
    continuity = Continuity(CRAZYFLIE)
    for t, x in ((0.0, 0.0), (0.01, 1.0), (0.02, nan)):
        continuity.jump(t, (x, 0.0, 0.0), 0.0, True)
    assert continuity.jumped


def test_robot_at_rest_or_forgotten_may_be_carried():
    here, there = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
    carried, moved = Continuity(KHEPERA4), Continuity(KHEPERA4)
    for continuity in (carried, moved):
        continuity.jump(0.0, here, 0.0, True)
    assert math.isnan(carried.jump(0.01, there, 0.0, False))
    assert moved.jump(0.01, there, 0.0, True) == pytest.approx(math.sqrt(3.0))
    assert moved.jump(0.02, there, 0.0, False) == pytest.approx(math.sqrt(3.0))  # it has jumped, and stays so
    moved.forget()
    for continuity in (carried, moved):
        assert math.isnan(continuity.jump(0.03, there, 0.0, True))
        assert continuity.jump(0.04, here, 0.0, True) == pytest.approx(math.sqrt(3.0))


def turned(*yaws, kind=KHEPERA4, watched=True):
    """Last jump of the yaw of a robot that had several yaws [rad] at times [s]."""
    continuity = Continuity(kind)
    for t, yaw in yaws:
        found = continuity.jump(t, (0.0, 0.0, 0.0), yaw, watched)
    assert math.isnan(found) == math.isnan(continuity.yaw_jump)
    return continuity.yaw_jump


def test_wheels_whose_yaw_jumps_have_jumped():
    most = FLIP + PLAUSIBLE_SPEED * KHEPERA4.turn_rate * 0.02
    assert math.isnan(turned((0.0, 0.0), (0.02, most - 0.001)))
    assert turned((0.0, 0.0), (0.02, most + 0.001)) == pytest.approx(most + 0.001)
    assert math.isnan(turned((0.0, 3.1), (0.02, -3.1)))
    assert turned((0.0, 0.0), (0.02, 1.2), (9.0, 1.2)) == pytest.approx(1.2)
    assert math.isnan(turned((0.0, 0.0), (0.02, 1.2), (0.04, 0.1)))
    assert turned((0.0, 0.0), (0.02, nan), (0.04, 1.2)) == pytest.approx(1.2)
    assert math.isnan(turned((0.0, nan), (0.02, inf), (0.04, 1.2)))
    assert math.isnan(turned((0.0, 0.0), (0.02, 1.2), kind=CRAZYFLIE))
    assert math.isnan(turned((0.0, 0.0), (0.02, 1.2), watched=False))


def believed(samples, dt=0.01):
    """Which positions x [m] of a robot in motion are believed."""
    external = ExternalPositions(CRAZYFLIE)
    return [external.believes(dt * k, (x, 0.0, 1.0), watched=True) for k, x in enumerate(samples)], external


def test_external_position_jumps_by_more_than_a_robot():
    assert believed([0.0, 0.12, 0.0, 0.15, 0.0])[0] == [True, True, True, False, True]
    assert believed([0.0, *[0.3] * 200, 0.12, 0.2])[0] == [True, *[False] * 200, True, True]
    assert believed([0.0, 0.3, nan, 0.0])[0] == [True, False, False, True]
    assert all(believed([0.015 * k for k in range(300)])[0])  # as fast as it can
    assert believed([0.0, 0.4], dt=0.3)[0] == [True, True]  # a gap in the measurements
    assert believed([0.0, 0.6], dt=0.3)[0] == [True, False]
    _, external = believed([0.0, 0.3])
    assert external.doubted
    assert external.jump == pytest.approx(0.3)
    external.forget()
    assert external.believes(9.0, (5.0, 0.0, 1.0), watched=True)
    assert not external.doubted


def test_positions_that_led_to_landing_stay_wrong():
    _, external = believed([0.0, 0.3])
    external.disbelieve()
    here = (0.0, 0.0, 1.0)
    assert not external.believes(0.5, here, watched=True)  # where it was before
    assert external.doubted
    assert not external.believes(0.4, here, watched=False)  # older
    assert external.believes(0.6, (3.0, 0.0, 0.0), watched=False)  # it stands, and may be carried
    assert not external.doubted
    inside = ExternalPositions(CRAZYFLIE)
    inside.disbelieve()  # it measures its position itself
    assert not inside.doubted


def test_jump_at_take_off_is_seen():
    external = ExternalPositions(CRAZYFLIE)
    places = [(0.0, False), (0.5, False), (0.5, True), (0.0, True)]
    found = [external.believes(0.01 * k, (x, 0.0, 0.0), watched=watched) for k, (x, watched) in enumerate(places)]
    assert found == [True, True, True, False]


def test_flipped_yaw_is_unknown_until_it_is_back():
    external = ExternalPositions(CRAZYFLIE)

    def known(since, until, off, *, watched=True):
        """Which yaws of a robot that turns at 1.5 rad/s, `off` [rad] from one tick to another, are believed."""
        times = [0.01 * tick for tick in range(since, until)]
        yaws = [external.believed_yaw(t, math.remainder(1.5 * t + off, math.tau), watched=watched) for t in times]
        return [math.isfinite(yaw) for yaw in yaws]

    assert all(known(0, 300, 0.0))
    assert not any(known(300, 1000, math.pi))  # it turns right round meanwhile
    assert all(known(1000, 1100, 0.0))
    assert not any(known(1100, 1200, -math.pi / 2))
    assert all(known(1200, 1300, -math.pi / 2, watched=False))  # it stands: it may have been turned
    assert math.isnan(external.believed_yaw(99.0, nan, watched=True))
    assert math.isnan(external.believed_yaw(99.1, 1e308, watched=True))
    assert math.isnan(external.believed_yaw(99.2, -1e308, watched=True))
