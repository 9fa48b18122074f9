import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.definition.rigidity import redundancy, rigidity


def planar(rows):
    free = np.ones((rows, 3), dtype=bool)
    free[:, 2] = False
    return free


def one_by_one(position, pairs, free):
    """The same by leaving each out."""
    links = [rigidity(position, np.delete(pairs, k, axis=0), free).rigid for k in range(len(pairs))]
    robots = []
    for row in range(len(position)):
        keeps = np.arange(len(position)) != row
        rest = pairs[(pairs != row).all(axis=1)]
        robots.append(rigidity(position[keeps], rest - (rest > row), free[keeps]).rigid)
    return links, robots


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(3, 9), st.sampled_from([0.5, 0.7, 0.9]), st.booleans())
def test_it_is_what_leaving_each_out_would_tell(seed, rows, share, in_space):
    rng = np.random.default_rng(seed)
    position = rng.uniform(-1.0, 1.0, (rows, 3))
    free = np.ones((rows, 3), dtype=bool) if in_space else planar(rows)
    every = np.stack(np.triu_indices(rows, 1), axis=1)
    pairs = every[rng.random(len(every)) < share].reshape(-1, 2)
    found = redundancy(position, pairs, free)
    if not rigidity(position, pairs, free).rigid:
        assert not found.pairs.any()
        assert not found.robots.any()
        return
    links, robots = one_by_one(position, pairs, free)
    assert found.pairs.tolist() == links
    assert found.robots.tolist() == robots


def test_a_triangle_needs_every_link_and_no_robot():
    position = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    found = redundancy(position, np.array([[0, 1], [0, 2], [1, 2]]), planar(3))
    assert found.pairs.tolist() == [False] * 3
    assert found.robots.tolist() == [True] * 3  # two that are linked are rigid


def test_a_braced_square_can_lose_any_link():
    position = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    every = np.stack(np.triu_indices(4, 1), axis=1)
    found = redundancy(position, every, planar(4))
    assert found.pairs.all()
    assert found.robots.all()
    one_less = redundancy(position, every[1:], planar(4))
    assert not one_less.pairs.any()


@pytest.mark.parametrize("rows", [1, 2])
def test_hardly_anything_can_be_lost_of_hardly_anything(rows):
    position = np.array([[0.0, 0, 0], [1, 0, 0]])[:rows]
    pairs = np.array([[0, 1]])[: rows - 1].reshape(-1, 2)
    assert redundancy(position, pairs, planar(rows)).pairs.tolist() == [False] * (rows - 1)
