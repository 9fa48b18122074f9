"""Anchors pull to points, lines and planes by the gradient that they claim, row by row."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.formation.anchors import Anchors
from tests.agents.plugins.test_laws import slope_of

FEW = settings(max_examples=25)


def some(seed, count=6, rows=4):
    """Anchors of each sort, half of them at a distance of 0."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(count, 3))
    sort = np.arange(count) % 3
    anchors = Anchors(
        row=rng.integers(0, rows, count),
        point=rng.uniform(-1, 1, (count, 3)),
        axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
        whole=np.where(sort == 2, 0.0, 1.0),
        along=np.array([0.0, -1.0, 1.0])[sort],
        distance=np.where(np.arange(count) < count // 2, 0.0, rng.uniform(0.2, 1.0, count)),
        gain=rng.uniform(0.5, 3.0, count),
    )
    return rng.uniform(-1, 1, (rows, 3)), anchors


@FEW
@given(st.integers(0, 2**31))
def test_the_pull_is_a_gradient(seed):
    position, anchors = some(seed)

    def potential(place):
        square = (anchors.displacement(place) ** 2).sum(axis=1)
        ring = anchors.gain / 8.0 * (anchors.distance**2 - square) ** 2
        return np.where(anchors.distance > 0.0, ring, anchors.gain / 2.0 * square).sum()

    np.testing.assert_allclose(anchors.offset(position), -slope_of(potential, position), atol=1e-6)


@FEW
@given(st.integers(0, 2**31))
def test_a_row_gets_what_it_gets_in_every_copy(seed):
    position, anchors = some(seed)
    whole = anchors.offset(position)
    twice = anchors.repeated(2, len(position)).offset(np.tile(position, (2, 1)))
    np.testing.assert_array_equal(twice, np.tile(whole, (2, 1)))


@pytest.mark.parametrize(
    ("whole", "along", "distance"),
    [(1.0, 0.0, np.sqrt(14.0)), (1.0, -1.0, np.sqrt(5.0)), (0.0, 1.0, 3.0)],
    ids=["point", "line", "plane"],
)
def test_distances_to_the_origin_to_the_z_axis_and_to_the_floor(whole, along, distance):
    one = np.ones(1)
    anchors = Anchors(
        np.zeros(1, dtype=np.intp), np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]),
        whole * one, along * one, distance * one, one,
    )  # fmt: skip
    place = np.array([[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(anchors.error(place), 0.0, atol=1e-15)
    np.testing.assert_allclose(anchors.offset(place), 0.0, atol=1e-13)
