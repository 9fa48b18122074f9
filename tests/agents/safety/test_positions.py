"""Positions that are believed: a robot does not jump, and what its position jumped to it is not told again."""

import math

import numpy as np
import pytest

from agents.body.kinds import CRAZYFLIE, KHEPERA4
from agents.safety.positions import FLIP, JUMP_M, REACH, Continuity, ExternalPositions


def test_a_jump_is_farther_than_a_robot_can_move_between_two_measurements():
    kinds, watched = [KHEPERA4, CRAZYFLIE], np.ones(2, dtype=bool)

    def jumps(*places):
        continuity = Continuity(kinds)
        return [continuity.jumps(np.full(2, t), np.array([[x, 0.0, 0.0]] * 2), watched) for t, x in places][-1]

    assert jumps((0.0, 0.0), (0.01, 0.99 * JUMP_M)) is None
    assert jumps((0.0, 0.0), (0.01, 1.0)) == pytest.approx([1.0, 1.0])
    assert jumps((0.0, 0.0), (0.01, 1.0), (9.0, 1.0)) == pytest.approx([1.0, 1.0])  # time does not heal it
    assert jumps((0.0, 0.0), (0.01, 1.0), (0.02, 0.0)) is None
    assert jumps((0.0, 0.0), (0.01, 1.0), (0.02, np.nan)) == pytest.approx([np.nan, np.nan], nan_ok=True)
    assert jumps((0.0, 0.0), (0.01, 1.0), (0.02, np.nan), (0.03, 1.0)) == pytest.approx([1.0, 1.0])
    far = JUMP_M + REACH * CRAZYFLIE.speed * 0.3  # a gap in the measurements
    assert jumps((0.0, 0.0), (0.3, far - 0.01)) == pytest.approx([far - 0.01, np.nan], nan_ok=True)
    assert jumps((0.0, 0.0), (9.0, 5.0)) == pytest.approx([5.0, 5.0])


def test_rows_that_are_not_watched_or_forgotten_are_where_their_position_says():
    continuity, here, there = Continuity([KHEPERA4] * 2), np.zeros((2, 3)), np.ones((2, 3))
    both, second = np.array([True, True]), np.array([False, True])
    continuity.jumps(np.zeros(2), here, both)
    assert continuity.jumps(np.full(2, 0.01), there, second) == pytest.approx([np.nan, math.sqrt(3.0)], nan_ok=True)
    continuity.forget(1)
    assert continuity.jumps(np.full(2, 0.02), there, both) is None
    assert continuity.jumps(np.full(2, 0.03), here, both) == pytest.approx([math.sqrt(3.0)] * 2)


def test_wheels_whose_yaw_jumps_have_jumped():
    kinds, still, watched = [KHEPERA4, CRAZYFLIE], np.zeros((2, 3)), np.ones(2, dtype=bool)

    def turns(*yaws, kinds=kinds, watched=watched):
        continuity = Continuity(kinds)
        found = [continuity.jumps(np.full(2, t), still, watched, np.full(2, yaw)) for t, yaw in yaws][-1]
        assert (found is None) == (continuity.turned is None)
        return continuity.turned

    most = FLIP + REACH * KHEPERA4.turn_rate * 0.02
    assert turns((0.0, 0.0), (0.02, most - 0.001)) is None
    assert turns((0.0, 0.0), (0.02, most + 0.001)) == pytest.approx([most + 0.001, np.nan], nan_ok=True)
    assert turns((0.0, 3.1), (0.02, -3.1)) is None
    assert turns((0.0, 0.0), (0.02, 1.2), (9.0, 1.2)) == pytest.approx([1.2, np.nan], nan_ok=True)
    assert turns((0.0, 0.0), (0.02, 1.2), (0.04, 0.1)) is None
    assert turns((0.0, 0.0), (0.02, np.nan), (0.04, 1.2)) == pytest.approx([1.2, np.nan], nan_ok=True)
    assert turns((0.0, np.nan), (0.02, np.inf), (0.04, 1.2)) is None
    assert turns((0.0, 0.0), (0.02, 1.2), kinds=[CRAZYFLIE] * 2) is None
    assert turns((0.0, 0.0), (0.02, 1.2), watched=~watched) is None


def believed(samples, kind=CRAZYFLIE, dt=0.01):
    """Which positions x [m] of a row, from one sample to the next, are believed; it is in motion."""
    external = ExternalPositions([kind])
    found = [external.believes(0, dt * k, np.array([x, 0.0, 1.0]), watched=True) for k, x in enumerate(samples)]
    return found, external


def test_an_external_position_jumps_by_more_than_a_robot():
    assert believed([0.0, 0.12, 0.0, 0.15, 0.0])[0] == [True, True, True, False, True]
    assert believed([0.0, *[0.3] * 200, 0.12, 0.2])[0] == [True, *[False] * 200, True, True]
    assert all(believed(0.015 * np.arange(300))[0])  # as fast as it can
    assert believed([0.0, 0.4], dt=0.3)[0] == [True, True]  # a gap in the measurements
    assert believed([0.0, 0.6], dt=0.3)[0] == [True, False]
    _, external = believed([0.0, 0.3])
    assert external.doubted
    assert external.jump == pytest.approx([0.3])
    external.forget(0)
    assert external.believes(0, 9.0, np.array([5.0, 0.0, 1.0]), watched=True)
    assert not external.doubted


def test_positions_that_led_to_landing_stay_wrong():
    _, external = believed([0.0, 0.3])
    external.disbelieve(0)
    here = np.array([0.0, 0.0, 1.0])
    assert not external.believes(0, 0.5, here, watched=True)  # where it was before
    assert external.doubted
    assert not external.believes(0, 0.4, here, watched=False)  # older
    assert external.believes(0, 0.6, np.array([3.0, 0.0, 0.0]), watched=False)  # it stands, and may be carried
    assert not external.doubted
    own = ExternalPositions([CRAZYFLIE])
    own.disbelieve(0)  # it measures its position itself
    assert not own.doubted


def test_a_jump_at_take_off_is_seen():
    external = ExternalPositions([CRAZYFLIE])
    places = [(0.0, False), (0.5, False), (0.5, True), (0.0, True)]
    found = [
        external.believes(0, 0.01 * k, np.array([x, 0.0, 0.0]), watched=watched)
        for k, (x, watched) in enumerate(places)
    ]
    assert found == [True, True, True, False]


def test_a_yaw_that_flips_is_unknown_until_it_is_back():
    external = ExternalPositions([CRAZYFLIE])

    def known(since, until, off, watched=True):
        """Of a robot that turns at 1.5 rad/s, whose yaw is `off` [rad] from one tick to another: which are believed."""
        ticks = 0.01 * np.arange(since, until)
        yaws = [external.believed_yaw(0, t, math.remainder(1.5 * t + off, math.tau), watched=watched) for t in ticks]
        return np.isfinite(yaws)

    assert known(0, 300, 0.0).all()
    assert not known(300, 1000, math.pi).any()  # it turns right round meanwhile
    assert known(1000, 1100, 0.0).all()
    assert not known(1100, 1200, -math.pi / 2).any()
    assert known(1200, 1300, -math.pi / 2, watched=False).all()  # it stands: it may have been turned
    assert np.isnan(external.believed_yaw(0, 99.0, math.nan, watched=True))
