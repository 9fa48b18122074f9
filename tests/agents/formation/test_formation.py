"""Shapes go smoothly from one to the next, links come and go by the clock and by range, and anchors pull."""

from itertools import pairwise
from math import cos, hypot, inf, isnan, nan, sin, sqrt

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.formation.anchors import Anchor
from agents.formation.changes import Change, Target, change_target, exists, planned_at, progress
from agents.formation.link import BY_DISTANCE, Link
from agents.vectors import UNKNOWN, norm
from tests.agents.plugins.test_laws import BEARING, VECTOR, slope
from tests.cases import examples

FEW = examples(50)
TIME = st.floats(10.0, 14.0)
SPREAD = VECTOR.filter(lambda v: hypot(v[0], v[1]) > 0.05)


def after(t, *, distance=1.0, relative=UNKNOWN, bearing=UNKNOWN, to=None, scale=1.0, turn=0.0):
    """A link `t` [s] after the start, with a change from 10 s on, over 4 s."""
    link, given_ = (Link(distance, 2.0, relative, bearing, BY_DISTANCE) for _ in range(2))
    change_target(link, given_, [Change(10.0, 4.0, scale, turn)], [to or Target()], t)
    return link


def test_progress_is_smooth():
    way = [progress(0.01 * k, 5.0, 10.0) for k in range(2001)]
    assert (way[0], way[500], way[1000], way[1500], way[2000]) == (0.0, 0.0, 0.5, 1.0, 1.0)
    steps = [b - a for a, b in pairwise(way)]
    assert min(steps) >= 0.0
    assert max(steps) / 0.01 == pytest.approx(1.875 / 10.0, rel=1e-3)  # the peak of minimum jerk
    assert max(abs(b - a) for a, b in pairwise(steps)) / 0.01**2 < 0.06  # no jump in speed
    assert [progress(t, 5.0, 0.0) for t in (4.9, 5.0, 5.1)] == [0.0, 1.0, 1.0]


def test_target_changes_on_the_way():
    found = [after(t, distance=0.8, to=Target(distance=0.2)).distance for t in (0.0, 10.0, 12.0, 14.0, 99.0)]
    assert found == [0.8, 0.8, pytest.approx(0.5), pytest.approx(0.2), pytest.approx(0.2)]
    kept = after(12.0, distance=0.8)
    assert kept.distance == 0.8
    assert isnan(kept.relative[0])
    link, given_, changes, targets = Link(0.8), Link(0.8), [Change(10.0, 4.0, 1.0, 0.0)], [Target(distance=0.2)]
    told = [change_target(link, given_, changes, targets, t) for t in (9.0, 12.0, 12.0, 14.0, 20.0)]
    assert told == [False, True, False, True, False], "once"


@FEW
@given(SPREAD, st.floats(0.3, 3.0), st.floats(-6.0, 6.0), TIME)
def test_scaled_and_turned_drawing_stays_one(apart, scale, turn, t):
    """Targets at any time are those of one set of places, scaled and turned as far as the change has come."""
    x, y, z = apart
    share = progress(t, 10.0, 4.0)
    angle, grown = share * turn, 1.0 + share * (scale - 1.0)
    link = after(t, distance=norm(apart), relative=apart, to=Target(rise=z), scale=scale, turn=turn)
    there = grown * (cos(angle) * x - sin(angle) * y), grown * (sin(angle) * x + cos(angle) * y), z
    assert link.relative == pytest.approx(there, abs=1e-12)
    assert link.distance == pytest.approx(norm(there), abs=1e-12)


@FEW
@given(BEARING, BEARING, TIME)
def test_directions_stay_directions(before, to, t):
    x, y, z = after(t, bearing=before, to=Target(bearing=to), turn=1.0).bearing
    assert hypot(x, y, 0.0 if isnan(z) else z) == pytest.approx(1.0, abs=1e-12) or isnan(before[2]) != isnan(to[2])
    if isnan(before[2]) == isnan(to[2]):
        assert after(14.0, bearing=before, to=Target(bearing=to)).bearing == pytest.approx(to, abs=1e-12, nan_ok=True)


def test_links_by_clock_and_range():
    times = (0.0, 4.9, 5.0, 7.9, 8.0, 20.0)
    assert [exists(5.0, 8.0, inf, t, nan) for t in times] == [False, False, True, True, False, False]
    assert [exists(0.0, inf, 1.2, 0.0, apart) for apart in (1.19, 1.2, 1.21, nan)] == [True, True, False, False]
    assert planned_at(0.0, inf, inf, 0.0)
    assert not planned_at(5.0, 8.0, inf, 0.0)
    assert not planned_at(0.0, inf, 1.0, 0.0)


SORTS = {"point": (1.0, 0.0), "line": (1.0, -1.0), "plane": (0.0, 1.0)}  # `whole` and `along`


@pytest.mark.parametrize("sort", SORTS)
@pytest.mark.parametrize("distance", [0.0, 0.7])
@examples(25)
@given(st.tuples(VECTOR, VECTOR, VECTOR.filter(lambda v: norm(v) > 0.1)), st.floats(0.5, 3.0))
def test_pull_is_a_gradient(sort, distance, vectors, gain):
    place, point, axis = vectors
    length = norm(axis)
    anchor = Anchor(point, tuple(each / length for each in axis), *SORTS[sort], distance, gain)

    def potential(position):
        square = norm(anchor.displacement(position)) ** 2
        return gain / 8.0 * (distance**2 - square) ** 2 if distance > 0.0 else gain / 2.0 * square

    assert anchor.pull(place) == pytest.approx([-s for s in slope(potential, place)], rel=1e-5, abs=1e-6)
    assert anchor.error(place) == abs(distance - norm(anchor.displacement(place)))


@pytest.mark.parametrize(("sort", "distance"), [("point", sqrt(14.0)), ("line", sqrt(5.0)), ("plane", 3.0)])
def test_distance_to_origin_axis_and_floor(sort, distance):
    anchor = Anchor((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), *SORTS[sort], distance, 1.0)
    assert anchor.error((1.0, 2.0, 3.0)) == pytest.approx(0.0, abs=1e-15)
    assert anchor.pull((1.0, 2.0, 3.0)) == pytest.approx((0.0, 0.0, 0.0), abs=1e-13)
