"""The laws are the gradients that they claim to be."""

from math import cos, hypot, nan, sin, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.formation.link import BY_BEARING, BY_DISTANCE, BY_RELATIVE, Link
from agents.plugins.laws import Bearing, Displacement, Distance, Mixed, goal_position, tracking_offset
from agents.vectors import difference, is_finite, norm
from tests.cases import examples

FEW, NUMBER = examples(25), st.floats(-1.5, 1.5)
VECTOR = st.tuples(NUMBER, NUMBER, NUMBER)
GAIN, LENGTH = st.floats(0.5, 5.0), st.floats(0.3, 1.5)


def direction(azimuth, rise, *, flat):
    """Unit vector; `flat`: seen from above."""
    share = 1.0 if flat else cos(rise)
    return share * cos(azimuth), share * sin(azimuth), nan if flat else sin(rise)


BEARING = st.builds(direction, st.floats(-3.0, 3.0), st.floats(-1.2, 1.2), flat=st.booleans())
LINK = st.builds(Link, LENGTH, GAIN, VECTOR, BEARING, st.sampled_from([BY_DISTANCE, BY_RELATIVE, BY_BEARING]))
EAST = Link(gain=1.0, relative=(0.5, 0.0, 0.0), wants=BY_RELATIVE)
EASTWARD = Link(1.0, 1.0, bearing=(1.0, 0.0, nan), wants=BY_BEARING)
LAWS = (Distance(), Displacement(), Bearing(), Mixed(), Mixed(dead_zone=0.1))


def slope(potential, place):
    """Derivatives of a potential at a place, by central differences."""
    steps = 1e-6 * np.eye(3)
    return [(potential(tuple(place + step)) - potential(tuple(place - step))) / 2e-6 for step in steps]


@pytest.mark.parametrize("law", [Distance(), Displacement(), Bearing()], ids=repr)
@FEW
@given(VECTOR, LINK)
def test_pull_is_minus_the_gradient(law, apart, link):
    def potential(place):
        if law == Distance():
            return link.gain / 8.0 * (link.distance**2 - norm(place) ** 2) ** 2
        return link.gain / 2.0 * law.error(place, link) ** 2

    assert law.pull(apart, link) == pytest.approx([-each for each in slope(potential, apart)], rel=1e-6, abs=1e-4)


@FEW
@given(VECTOR.filter(lambda v: hypot(v[0], v[1]) > 0.01), LINK)
def test_met_targets_pull_nothing(apart, link):
    flat, length = hypot(apart[0], apart[1]), norm(apart)
    bearing = tuple(each / length for each in apart)
    if link.bearing[2] != link.bearing[2]:
        bearing = apart[0] / flat, apart[1] / flat, nan
    met = Link(length, link.gain, apart, bearing, link.wants)
    for law in LAWS:
        assert law.pull(apart, met) == pytest.approx((0.0, 0.0, 0.0), abs=1e-13)
        assert law.error(apart, met) == pytest.approx(0.0, abs=1e-13)


def test_pulls_that_are_known():
    for law, apart, link, pull, error in (
        (Distance(), (-2.0, 0.0, 0.0), Link(1.0, 3.0), (9.0, 0.0, 0.0), 1.0),  # ½ · 3 · (1 − 4) · (−2) = 9
        (Distance(), (2.0, 0.0, 0.0), Link(1.0, 1.0), (-3.0, 0.0, 0.0), 1.0),
        (Displacement(), (0.5, 0.0, 0.0), EAST, (0.0, 0.0, 0.0), 0.0),
        (Displacement(), (0.0, 0.5, 0.0), EAST, (0.5, -0.5, 0.0), 0.5 * sqrt(2.0)),
        (Bearing(), (0.5, 0.2, 0.7), EASTWARD, (0.0, -0.2, 0.0), 0.2),
        (Bearing(), (-0.5, 0.2, 0.7), EASTWARD, (0.5, -0.2, 0.0), hypot(0.5, 0.2)),  # on the wrong side
    ):
        assert law.pull(apart, link) == pytest.approx(pull, abs=1e-15)
        assert law.error(apart, link) == pytest.approx(error)


@FEW
@given(VECTOR, LINK)
def test_mixed_is_each_and_bearing_ignores_growth(apart, link):
    same = {BY_DISTANCE: Distance(), BY_RELATIVE: Displacement(), BY_BEARING: Bearing()}[link.wants]
    assert Mixed().pull(apart, link) == same.pull(apart, link)
    assert Mixed().error(apart, link) == same.error(apart, link)
    law, (x, y, z) = Bearing(), apart
    assert law.error((2 * x, 2 * y, 2 * z), link) == pytest.approx(2 * law.error(apart, link), abs=1e-12)
    if link.bearing[2] != link.bearing[2]:
        assert law.error((x, y, z + 1.0), link) == law.error(apart, link)
        assert law.pull(apart, link)[2] == 0.0


@pytest.mark.parametrize(("length", "as_if"), [(1.2, 1.15), (0.8, 0.85), (1.05, 1.0), (0.95, 1.0), (1.0, 1.0)])
def test_dead_zone_narrows_every_error(length, as_if):
    law, apart, link = Distance(dead_zone=0.05), (length, 0.0, 0.0), Link(1.0, 3.0)
    assert law.pull(apart, link) == pytest.approx((1.5 * (1.0 - as_if**2) * length, 0.0, 0.0), abs=1e-12)
    assert law.error(apart, link) == pytest.approx(abs(1.0 - length))


@FEW
@given(VECTOR, VECTOR, GAIN, st.floats(0.01, 0.5))
def test_tracking_is_cubic_and_goals_are_clamped(position, other, gain, limit):
    away = difference(position, other)
    pull = -0.5 * gain * norm(away) ** 2
    assert tracking_offset(position, other, gain) == pytest.approx([pull * each for each in away], abs=1e-12)
    assert tracking_offset(position, (nan, nan, nan), gain) == (0.0, 0.0, 0.0)
    step = difference(goal_position(position, other, limit), position)
    assert step == pytest.approx([min(max(each, -limit), limit) for each in other], abs=1e-12)
    assert not is_finite(goal_position(position, (nan, 0.0, 0.0), limit))
