"""Graphs against networkx; rigidity against known frameworks, and redundancy against leaving each link out."""

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.definition.graph import adjacency, components, degree, edges, laplacian, links, reachable
from experiments.definition.rigidity import redundancy, rigidity
from tests.cases import examples
from tests.experiments.checked import PUBLISHED

# paper, eq. (11): rows from which each robot receives
HEARS = {1: (0, 2, 3, 4), 2: (1, 3, 5), 3: (0, 1, 2, 5), 4: (0, 1, 5, 6), 5: (2, 3, 4, 6), 6: (4, 5)}
REFERENCE = links([(listener, speaker) for listener, heard in HEARS.items() for speaker in heard])


@st.composite
def digraphs(draw, most=9):
    rows = draw(st.integers(1, most))
    possible = [(i, j) for i in range(rows) for j in range(rows) if i != j]
    pairs = draw(st.lists(st.sampled_from(possible), unique=True, max_size=30)) if possible else []
    return rows, pairs


@examples(40)
@given(digraphs(), st.data())
def test_graph_is_that_of_networkx(made, data):
    rows, pairs = made
    net, graph = links(pairs), nx.DiGraph(pairs)  # an arrow from receiver to sender, as in the adjacency matrix
    graph.add_nodes_from(range(rows))
    a = nx.to_numpy_array(graph, nodelist=range(rows))
    np.testing.assert_array_equal(adjacency(net, rows), a)
    np.testing.assert_array_equal(np.diag(degree(net, rows)), a.sum(axis=1))
    np.testing.assert_array_equal(laplacian(net, rows), np.diag(a.sum(axis=1)) - a)
    assert components(net, rows) == nx.number_weakly_connected_components(graph)
    assert {tuple(edge) for edge in edges(net).tolist()} == {tuple(sorted(pair)) for pair in pairs}
    sources = data.draw(st.lists(st.integers(0, rows - 1), unique=True, max_size=3))
    told = set(sources).union(*(nx.ancestors(graph, source) for source in sources))  # arrows point at the speaker
    found = reachable(net, rows, np.array(sources, dtype=np.intp))
    assert set(np.flatnonzero(found).tolist()) == told


def test_links_take_pairs_with_or_without_targets():
    path = links([(1, 0), (0, 1), (2, 1), (1, 2)])
    assert laplacian(path, 3).tolist() == [[1, -1, 0], [-1, 2, -1], [0, -1, 1]]
    assert np.isnan(path.distance).all()
    assert links([(1, 0), (2, 0)], 0.6, 3.0).distance.tolist() == [0.6, 0.6]
    assert links([(1, 0), (2, 0)], 0.6, [3.0, 4.0]).gain.tolist() == [3.0, 4.0]
    nothing = links([], [], [])
    assert (len(nothing), len(edges(nothing)), components(nothing, 4)) == (0, 0, 4)


def held_heights(rows):
    moves = np.ones((rows, 3), dtype=bool)
    moves[:, 2] = False
    return moves


def test_reference_formation_is_rigid_only_with_heights_held():
    pairs = edges(REFERENCE)
    assert (len(REFERENCE), len(pairs)) == (21, 12)
    assert np.flatnonzero(~reachable(REFERENCE, 7, np.array([6]))).tolist() == [0]
    held, free = rigidity(PUBLISHED, pairs, held_heights(7)), rigidity(PUBLISHED, pairs)
    assert (held.rank, held.needed, held.rigid, held.smallest > 0.1) == (11, 2 * 7 - 3, True, True)
    assert (free.rank, free.needed, free.rigid, free.smallest) == (12, 3 * 7 - 6, False, 0.0)


@pytest.mark.parametrize(
    ("position", "free", "motions"),
    [
        ([[0, 0, 0]], "xyz", 3),  # one point: it cannot be seen to turn
        ([[0, 0, 0], [1, 0, 0]], "xyz", 5),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "xyz", 6),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "xy", 3),
        ([[0, 0, 0], [1, 0, 0.8], [2, 0, 0.3]], "xy", 4),  # in a vertical plane: it may also lean out of it
        ([[0, 0, 0], [1, 0, 0.8], [2, 1, 0.3]], "z", 1),
        ([[0, 0, 0], [1, 0, 0.8]], "", 0),
    ],
)
def test_rigid_motions_that_held_coordinates_allow(position, free, motions):
    position = np.array(position, dtype=float)
    moves = np.tile([axis in free for axis in "xyz"], (len(position), 1))
    assert rigidity(position, np.array([[0, len(position) - 1]]), moves).needed == moves.sum() - motions


def one_by_one(position, pairs, free):
    """Whether the rest is rigid without each link, and without each robot."""
    without_link = [rigidity(position, np.delete(pairs, k, axis=0), free).rigid for k in range(len(pairs))]
    without_robot = []
    for row in range(len(position)):
        keeps = np.arange(len(position)) != row
        rest = pairs[(pairs != row).all(axis=1)]
        without_robot.append(rigidity(position[keeps], rest - (rest > row), free[keeps]).rigid)
    return without_link, without_robot


@examples(60)
@given(st.integers(0, 2**32 - 1), st.integers(3, 9), st.sampled_from([0.5, 0.7, 0.9]), st.booleans())
def test_redundancy_is_that_of_leaving_each_out(seed, rows, share, in_space):
    rng = np.random.default_rng(seed)
    position = rng.uniform(-1.0, 1.0, (rows, 3))
    free = np.ones((rows, 3), dtype=bool) if in_space else held_heights(rows)
    every = np.stack(np.triu_indices(rows, 1), axis=1)
    pairs = every[rng.random(len(every)) < share].reshape(-1, 2)
    found = redundancy(position, pairs, free)
    rigid = rigidity(position, pairs, free).rigid
    wanted = one_by_one(position, pairs, free) if rigid else ([False] * len(pairs), [False] * rows)
    assert (found.pairs.tolist(), found.robots.tolist()) == wanted
