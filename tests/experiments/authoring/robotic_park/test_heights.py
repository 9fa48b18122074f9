import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.authoring import layouts
from experiments.authoring.robotic_park.heights import ShapeTargets, find_shape
from experiments.check.realisation import ENOUGH

NOWHERE = np.zeros(0)


def asked(position, *, points=(), relative=False):
    pairs = np.stack(np.triu_indices(len(position), 1), axis=1)
    apart = position[pairs[:, 0]] - position[pairs[:, 1]]
    distance = np.linalg.norm(apart, axis=1)
    rows = np.array(points, dtype=np.intp)
    return ShapeTargets(
        pairs,
        np.full(len(pairs), np.nan) if relative else distance,
        apart,
        rows,
        np.zeros((len(rows), 3)),
        np.linalg.norm(position[rows], axis=1),
    )


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(4, 9), st.booleans())
def test_a_shape_is_found_again_from_nearby(seed, rows, relative):
    rng = np.random.default_rng(seed)
    shape = rng.uniform(-1.0, 1.0, (rows, 3))
    start = shape + rng.uniform(-0.02, 0.02, shape.shape)
    found = find_shape(asked(shape, points=[0, 1], relative=relative), start, np.ones(rows, dtype=bool))
    assert found.worst < ENOUGH


def test_drones_from_one_plane_find_their_dome_and_robots_stay_on_the_floor():
    ring = np.array([(np.cos(a), np.sin(a), 0.0) for a in 2.0 * np.pi * np.arange(5) / 5])
    shape = np.concatenate([ring, [[0.0, 0.0, 1.0]]])
    climbs = np.arange(6) == 5
    flat = shape * [1.2, 1.2, 0.1]
    found = find_shape(asked(shape), flat, climbs)
    assert found.worst < 1e-4
    assert found.position[:5, 2] == pytest.approx(np.zeros(5))
    assert found.position[5, 2] == pytest.approx(1.0, abs=1e-3)


def test_what_contradicts_itself_is_measured():
    wanted = ShapeTargets(
        np.array([[0, 1], [1, 2], [0, 2]]), np.array([1.0, 1.0, 2.3]), np.zeros((3, 3)),
        np.zeros(0, dtype=np.intp), np.zeros((0, 3)), NOWHERE,
    )  # fmt: skip
    start = np.array([(0.0, 0, 0), (1.0, 0.1, 0), (2.0, 0, 0)])
    found = find_shape(wanted, start, np.zeros(3, dtype=bool))
    assert found.links == pytest.approx(0.1, abs=1e-3)  # 0.3 m, shared by three
    assert found.points == 0.0


def test_a_shape_that_is_met_at_the_heights_of_the_starts_is_not_folded():
    ring = np.array([(np.cos(a), np.sin(a), 0.7) for a in 2.0 * np.pi * np.arange(6) / 6])
    wanted = asked(ring)
    sparse = ShapeTargets(
        wanted.pairs[::2], wanted.distance[::2], wanted.relative[::2], *(wanted.row, wanted.point, wanted.radius)
    )
    found = find_shape(sparse, ring * [1.3, 0.8, 1.0], np.ones(6, dtype=bool))
    assert found.worst < ENOUGH
    assert found.position[:, 2] == pytest.approx(0.7)


@pytest.mark.parametrize("seed", range(8))
def test_shapes_in_space_are_found_from_starts_in_one_plane(seed):
    """Twelve drones on a hemisphere, linked to their nearest: a single beginning misses most of them."""
    made = layouts.hemisphere(12, 0.6, 0.25)
    pairs, shape = made.pairs, made.position
    apart = shape[pairs[:, 0]] - shape[pairs[:, 1]]
    none = np.zeros(0, dtype=np.intp)
    wanted = ShapeTargets(pairs, np.linalg.norm(apart, axis=1), apart, none, np.zeros((0, 3)), NOWHERE)
    start = shape * [1.2, 1.2, 0.0] + np.random.default_rng(seed).normal(0.0, [0.25, 0.25, 0.0], shape.shape)
    assert find_shape(wanted, start, np.ones(12, dtype=bool)).worst < ENOUGH
