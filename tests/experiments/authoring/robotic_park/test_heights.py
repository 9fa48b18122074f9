import numpy as np
import pytest

from agents.formation.anchors import Anchor
from agents.formation.link import BY_DISTANCE, BY_RELATIVE
from agents.kinds.crazyflie import CRAZYFLIE
from agents.kinds.khepera4 import KHEPERA4
from experiments.authoring import layouts
from experiments.authoring.robotic_park.heights import Room, find_shape
from experiments.check.realisation import ENOUGH, Solids
from experiments.definition.graph import Links, links


def asked(position, pairs=None, *, relative=False):
    pairs = np.stack(np.triu_indices(len(position), 1), axis=1) if pairs is None else pairs
    i, j = pairs.T
    apart = position[i] - position[j]
    distance, blank = np.linalg.norm(apart, axis=1), np.full_like(apart, np.nan)
    wants = np.full(len(pairs), BY_RELATIVE if relative else BY_DISTANCE)
    return Links(i, j, distance, np.ones(len(pairs)), apart, blank, wants)


def to_origin(position, *rows):
    zero = (0.0, 0.0, 0.0)
    return [(row, Anchor(zero, zero, 1.0, 0.0, float(np.linalg.norm(position[row])), 1.0)) for row in rows]


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("rows", [4, 5, 7, 9])
def test_a_shape_is_found_again_from_nearby(rows, relative):
    rng = np.random.default_rng(rows)
    shape = rng.uniform(-1.0, 1.0, (rows, 3))
    start = shape + rng.uniform(-0.02, 0.02, shape.shape)
    found = find_shape(asked(shape, relative=relative), to_origin(shape, 0, 1), start, np.ones(rows, dtype=bool))
    assert found.worst < ENOUGH


def ring(count, height=0.0):
    return np.array([(np.cos(a), np.sin(a), height) for a in 2.0 * np.pi * np.arange(count) / count])


def test_what_contradicts_itself_is_measured():
    wanted = links([(0, 1), (1, 2), (0, 2)], [1.0, 1.0, 2.3])
    start = np.array([(0.0, 0, 0), (1.0, 0.1, 0), (2.0, 0, 0)])
    found = find_shape(wanted, (), start, np.zeros(3, dtype=bool))
    assert found.worst == pytest.approx(0.1, abs=1e-3)  # 0.3 m, shared by three


def test_shape_met_at_start_heights_is_not_folded():
    shape = ring(6, 0.7)
    found = find_shape(asked(shape).take(np.arange(0, 15, 2)), (), shape * [1.3, 0.8, 1.0], np.ones(6, dtype=bool))
    assert found.worst < ENOUGH
    assert found.position[:, 2] == pytest.approx(0.7)


@pytest.mark.parametrize("seed", range(4))
def test_space_shapes_are_found_from_coplanar_starts(seed):
    """Twelve drones on a hemisphere, linked to their nearest: a single beginning misses most of them."""
    made = layouts.hemisphere(12, 0.6, 0.25)
    shape = made.position
    start = shape * [1.2, 1.2, 0.0] + np.random.default_rng(seed).normal(0.0, [0.25, 0.25, 0.0], shape.shape)
    assert find_shape(asked(shape, made.pairs), (), start, np.ones(12, dtype=bool)).worst < ENOUGH


def solids(flies):
    kinds = [CRAZYFLIE if each else KHEPERA4 for each in flies]
    return Room(Solids.of(kinds, links([(0, k) for k in range(1, len(flies))]), flies, 0.1), flies, 0.3)


def test_a_shape_below_the_floor_is_mirrored():
    shape = np.concatenate([ring(5), [[0.1, 0.0, 0.9], [-0.3, 0.2, 0.8]]])
    climbs = np.arange(7) >= 5
    start = shape * [1.2, 1.0, -0.2]  # nearer to the mirror image
    below = find_shape(asked(shape), (), start, climbs)
    assert below.worst < ENOUGH
    assert below.position[climbs, 2].max() < 0.0
    above = find_shape(asked(shape), (), start, climbs, solids(climbs))
    assert above.worst < ENOUGH
    assert above.position[:5, 2] == pytest.approx(np.zeros(5))
    assert above.position[climbs, 2] == pytest.approx([0.9, 0.8], abs=1e-3)


def test_robots_in_one_place_are_no_shape():
    """A square without diagonals may fold: two corners then are in one place."""
    square = np.array([(0.0, 0, 0.7), (1.0, 0, 0.7), (1.0, 1.0, 0.7), (0.0, 1.0, 0.7)])
    pairs = np.array([(0, 1), (1, 2), (2, 3), (0, 3)])
    flies = np.ones(4, dtype=bool)
    start = np.array([(0.0, 0, 0.7), (1.0, 0, 0.7), (0.01, 0.1, 0.7), (1.0, 0.01, 0.7)])
    assert np.ptp(find_shape(asked(square, pairs), (), start, flies).position, axis=0)[2] < 0.01
    found = find_shape(asked(square, pairs), (), start, flies, solids(flies))
    assert found.worst < ENOUGH
    assert not len(solids(flies).solids.overlaps(found.position))
