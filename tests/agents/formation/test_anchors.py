"""Anchors pull to points, lines and planes by the gradient that they claim."""

from math import sqrt

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.formation.anchors import Anchor
from agents.vectors import norm
from tests.agents.plugins.test_laws import VECTOR, slope

SORTS = {"point": (1.0, 0.0), "line": (1.0, -1.0), "plane": (0.0, 1.0)}  # `whole` and `along`
SORT = pytest.mark.parametrize("sort", SORTS)


@SORT
@pytest.mark.parametrize("distance", [0.0, 0.7])
@settings(max_examples=25)
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
