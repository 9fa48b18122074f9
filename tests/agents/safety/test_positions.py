"""Positions that are believed: a robot does not jump, and what its position jumped to is not passed on to it."""

from math import inf, isfinite, isnan, nan, pi, remainder, sqrt, tau

import pytest

from agents.safety.positions import FLIP, JUMP_M, PLAUSIBLE_SPEED, Continuity, ExternalPositions
from agents.vectors import UNKNOWN
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.khepera4.kind import KHEPERA4

FAR = JUMP_M + PLAUSIBLE_SPEED * CRAZYFLIE.speed * 0.3  # [m] within a gap of 0.3 s in the measurements
FLIPPED = FLIP + PLAUSIBLE_SPEED * KHEPERA4.turn_rate * 0.02  # [rad] within 0.02 s


def test_jump_is_farther_than_a_robot_can_move():
    """A robot in motion at x [m] at several times [s], and its last jump."""
    for kind, samples, jump in (
        (CRAZYFLIE, [(0.0, 0.0), (0.01, 0.99 * JUMP_M)], nan),
        (CRAZYFLIE, [(0.0, 0.0), (0.01, 1.0), (9.0, 1.0)], 1.0),  # time does not heal it
        (CRAZYFLIE, [(0.0, 0.0), (0.01, 1.0), (0.02, 0.0)], nan),
        (CRAZYFLIE, [(0.0, 0.0), (0.01, 1.0), (0.02, nan), (0.03, 1.0)], 1.0),
        (CRAZYFLIE, [(0.0, 0.0), (0.3, FAR - 0.01)], nan),
        (KHEPERA4, [(0.0, 0.0), (0.3, FAR - 0.01)], FAR - 0.01),
        (CRAZYFLIE, [(0.0, 0.0), (9.0, 5.0)], 5.0),
    ):
        continuity = Continuity(kind)
        for t, x in samples:
            found = continuity.jump(t, (x, 0.0, 0.0), 0.0, True)
            assert continuity.jumped == (isfinite(found) or isnan(x))  # an unknown position ends no jump
        assert found == pytest.approx(jump, nan_ok=True)


def test_robot_at_rest_or_forgotten_may_be_carried():
    here, there = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
    carried, moved = Continuity(KHEPERA4), Continuity(KHEPERA4)
    for continuity in (carried, moved):
        continuity.jump(0.0, here, 0.0, True)
    assert isnan(carried.jump(0.01, there, 0.0, False))
    assert moved.jump(0.01, there, 0.0, True) == pytest.approx(sqrt(3.0))
    assert moved.jump(0.02, there, 0.0, False) == pytest.approx(sqrt(3.0))  # it has jumped, and stays so
    moved.forget()
    for continuity in (carried, moved):
        assert isnan(continuity.jump(0.03, there, 0.0, True))
        assert continuity.jump(0.04, here, 0.0, True) == pytest.approx(sqrt(3.0))


def test_wheels_whose_yaw_jumps_have_jumped():
    """Yaws [rad] at several times [s], and the last jump."""
    for kind, watched, samples, jump in (
        (KHEPERA4, True, [(0.0, 0.0), (0.02, FLIPPED - 0.001)], nan),
        (KHEPERA4, True, [(0.0, 0.0), (0.02, FLIPPED + 0.001)], FLIPPED + 0.001),
        (KHEPERA4, True, [(0.0, 3.1), (0.02, -3.1)], nan),
        (KHEPERA4, True, [(0.0, 0.0), (0.02, 1.2), (9.0, 1.2)], 1.2),
        (KHEPERA4, True, [(0.0, 0.0), (0.02, 1.2), (0.04, 0.1)], nan),
        (KHEPERA4, True, [(0.0, 0.0), (0.02, nan), (0.04, 1.2)], 1.2),
        (KHEPERA4, True, [(0.0, nan), (0.02, inf), (0.04, 1.2)], nan),
        (CRAZYFLIE, True, [(0.0, 0.0), (0.02, 1.2)], nan),
        (KHEPERA4, False, [(0.0, 0.0), (0.02, 1.2)], nan),
    ):
        continuity = Continuity(kind)
        for t, yaw in samples:
            found = continuity.jump(t, (0.0, 0.0, 0.0), yaw, watched)
        assert isnan(found) == isnan(continuity.yaw_jump)
        assert continuity.yaw_jump == pytest.approx(jump, nan_ok=True)


def believed(external, places, dt=0.01, begin=0.0):
    """Which external positions at x [m] are believed; a robot that is not watched is marked by a pair."""
    pairs = [place if isinstance(place, tuple) else (place, True) for place in places]
    return [external.believes(begin + dt * k, (x, 0.0, 1.0), watched=watched) for k, (x, watched) in enumerate(pairs)]


def test_external_position_jumps_by_more_than_a_robot():
    for dt, places, expected in (
        (0.01, [0.0, 0.12, 0.0, 0.15, 0.0], [True, True, True, False, True]),
        (0.01, [0.0, *[0.3] * 200, 0.12, 0.2], [True, *[False] * 200, True, True]),
        (0.01, [0.0, 0.3, nan, 0.0], [True, False, False, True]),
        (0.01, [0.015 * k for k in range(300)], [True] * 300),  # as fast as it can
        (0.3, [0.0, 0.4], [True, True]),  # a gap in the measurements
        (0.3, [0.0, 0.6], [True, False]),
        (0.01, [(0.0, False), (0.5, False), (0.5, True), (0.0, True)], [True, True, True, False]),
    ):
        assert believed(ExternalPositions(CRAZYFLIE), places, dt) == expected


def test_doubted_position_is_forgotten_or_stays_wrong():
    for lands in (False, True):
        external = ExternalPositions(CRAZYFLIE)
        believed(external, [0.0, 0.3])
        assert (external.doubted, external.jump) == (True, pytest.approx(0.3))
        if lands:
            external.disbelieve()
            assert believed(external, [0.0], begin=0.5) == [False]  # where it was before
            assert believed(external, [(0.0, False)], begin=0.4) == [False]  # older
            assert external.doubted
            assert believed(external, [(3.0, False)], begin=0.6) == [True]  # it stands, and may be carried
        else:
            external.forget()
            assert believed(external, [5.0], begin=9.0) == [True]
        assert not external.doubted
    for places, place in (([0.0, 0.01], (0.02, 0.0, 1.0)), ([0.0, 0.3], UNKNOWN)):  # it disobeys, or jumped
        external = ExternalPositions(CRAZYFLIE)
        believed(external, places)
        external.disbelieve()
        assert not external.believes(1.0, (places[-1] + 0.01, 0.0, 1.0), watched=True)
        assert external.place == pytest.approx(place, nan_ok=True)
        external.believes(2.0, (0.0, 0.0, 0.0), watched=False)
        assert all(map(isnan, external.place))
    inside = ExternalPositions(CRAZYFLIE)
    inside.disbelieve()  # it measures its position itself
    assert not inside.doubted


def test_flipped_yaw_is_unknown_until_it_is_back():
    external = ExternalPositions(CRAZYFLIE)

    def known(since, until, off, *, watched=True):
        """Which yaws of a robot that turns at 1.5 rad/s, `off` [rad] from one tick to another, are believed."""
        times = [0.01 * tick for tick in range(since, until)]
        yaws = [external.believed_yaw(t, remainder(1.5 * t + off, tau), watched=watched) for t in times]
        return [isfinite(yaw) for yaw in yaws]

    assert all(known(0, 300, 0.0))
    assert not any(known(300, 1000, pi))  # it turns right round meanwhile
    assert all(known(1000, 1100, 0.0))
    assert not any(known(1100, 1200, -pi / 2))
    assert all(known(1200, 1300, -pi / 2, watched=False))  # it stands: it may have been turned
    for absurd in (nan, 1e308, -1e308):
        assert isnan(external.believed_yaw(99.0, absurd, watched=True))
