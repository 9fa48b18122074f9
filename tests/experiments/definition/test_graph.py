"""Graphs and frameworks against networkx, against sums done by hand, and against what is known of rigid frameworks."""

from itertools import combinations

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.definition.graph import Links, adjacency, components, degree, edges, laplacian, links, reachable
from experiments.definition.rigidity import rigidity, rigidity_matrix

NAMES = ("TB01", "KH01", "KH02", "KH03", "CF01", "CF02", "CF03")
PLACES = np.array(
    [
        [0, 0, 0],
        [0.6, 0, 0],
        [0.6, -0.6, 0],
        [0, -0.6, 0],
        [0.3, 0.098, 0.8],
        [0.3, -0.502, 0.8],
        [-0.2196, -0.2021, 0.8],
    ]
)
# paper, eq. (11): who listens to whom
HEARS = {1: (0, 2, 3, 4), 2: (1, 3, 5), 3: (0, 1, 2, 5), 4: (0, 1, 5, 6), 5: (2, 3, 4, 6), 6: (4, 5)}
FEW = settings(max_examples=40)
REFERENCE = [(listener, speaker) for listener, heard in HEARS.items() for speaker in heard]


def network(pairs):
    """Links with a distance and a gain that tell them apart."""
    return links(pairs, [1.0 + 0.1 * k for k in range(len(pairs))], [2.0 + 0.01 * k for k in range(len(pairs))])


@st.composite
def digraphs(draw, most=9):
    rows = draw(st.integers(1, most))
    possible = [(i, j) for i in range(rows) for j in range(rows) if i != j]
    pairs = draw(st.lists(st.sampled_from(possible), unique=True, max_size=30)) if possible else []
    return rows, pairs


def as_networkx(rows, pairs):
    """An arrow from listener to speaker, as in the adjacency matrix."""
    graph = nx.DiGraph()
    graph.add_nodes_from(range(rows))
    graph.add_edges_from(pairs)
    return graph


@FEW
@given(digraphs())
def test_matrices_are_those_of_networkx(made):
    rows, pairs = made
    net, graph = network(pairs), as_networkx(rows, pairs)
    a = nx.to_numpy_array(graph, nodelist=range(rows))
    np.testing.assert_array_equal(adjacency(net, rows), a)
    np.testing.assert_array_equal(np.diag(degree(net, rows)), [graph.out_degree(i) for i in range(rows)])
    np.testing.assert_array_equal(laplacian(net, rows), np.diag(a.sum(axis=1)) - a)
    assert not laplacian(net, rows).sum(axis=1).any()


@FEW
@given(digraphs(), st.data())
def test_reached_and_components_are_those_of_networkx(made, data):
    rows, pairs = made
    net, graph = network(pairs), as_networkx(rows, pairs)
    sources = data.draw(st.lists(st.integers(0, rows - 1), unique=True, max_size=3))
    told = set(sources).union(*(nx.ancestors(graph, source) for source in sources))  # arrows point at the speaker
    found = reachable(net, rows, np.array(sources, dtype=np.intp))
    assert set(np.flatnonzero(found).tolist()) == told
    assert components(net, rows) == nx.number_weakly_connected_components(graph)
    undirected = {tuple(sorted(pair)) for pair in pairs}
    assert {tuple(edge) for edge in edges(net).tolist()} == undirected


def test_no_links_at_all():
    net = links([], [], [])
    assert len(net) == 0
    assert len(edges(net)) == 0
    assert components(net, 4) == 4


def test_the_reference_network():
    net = network(REFERENCE)
    assert len(edges(net)) == 12
    assert components(net, 7) == 1
    np.testing.assert_array_equal(np.diag(degree(net, 7)), [0, 4, 3, 4, 4, 4, 2])
    assert reachable(net, 7, np.array([0])).all()
    assert np.flatnonzero(~reachable(net, 7, np.array([6]))).tolist() == [0]


# ---------------------------------------------------------------- rigidity


def held_heights(rows):
    moves = np.ones((rows, 3), dtype=bool)
    moves[:, 2] = False
    return moves


def test_reference_formation_is_rigid_only_with_heights_held():
    pairs = edges(network(REFERENCE))
    held, free = rigidity(PLACES, pairs, held_heights(7)), rigidity(PLACES, pairs)
    assert (held.rank, held.needed, held.rigid) == (2 * 7 - 3, 11, True)
    assert (free.rank, free.needed, free.rigid) == (12, 15, False)
    assert held.smallest > 0.1
    assert free.smallest == 0.0


def test_rigidity_rows_are_half_gradients_of_squared_lengths():
    pairs = edges(network(REFERENCE))
    matrix = rigidity_matrix(PLACES, pairs)
    motion = np.random.default_rng(3).normal(size=PLACES.shape)

    def squared(position):
        offset = position[pairs[:, 0]] - position[pairs[:, 1]]
        return (offset**2).sum(axis=1)

    step = 1e-6
    slope = (squared(PLACES + step * motion) - squared(PLACES - step * motion)) / (2 * step)
    np.testing.assert_allclose(matrix @ motion.ravel(), 0.5 * slope, atol=1e-9)


def triangulation(rng, rows, dimension):
    """A triangle (tetrahedron), then each further point joined to `dimension` points known already: 2n − 3 (3n − 6)."""
    pairs = list(combinations(range(dimension + 1), 2))
    for new in range(dimension + 1, rows):
        pairs += [(int(old), new) for old in rng.choice(new, dimension, replace=False)]
    return np.array(pairs, dtype=np.intp)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(4, 12), st.sampled_from([2, 3]))
def test_triangulation_is_rigid_only_with_all_edges(seed, rows, dimension):
    rng = np.random.default_rng(seed)
    position = rng.uniform(-1, 1, (rows, 3))
    moves = None
    if dimension == 2:
        position[:, 2] = rng.choice([0.0, 0.8], rows)  # at heights that are held: plane rigidity all the same
        moves = held_heights(rows)
    pairs = triangulation(rng, rows, dimension)
    whole = rigidity(position, pairs, moves)
    wanted = 2 * rows - 3 if dimension == 2 else 3 * rows - 6
    assert len(pairs) == wanted == whole.needed
    if whole.smallest < 1e-6:
        return  # four points that lie in a plane but for the rounding
    assert whole.rigid
    assert whole.rank == wanted
    missing = rigidity(position, np.delete(pairs, rng.integers(len(pairs)), axis=0), moves)
    assert not missing.rigid
    assert (missing.rank, missing.smallest) == (wanted - 1, 0.0)


def rigid_motions(position, free):
    """How many rigid motions move only what is free, by fitting: the rank of what a motion does to free coordinates."""
    rows = len(position)
    spins = [np.cross(axis, position) for axis in np.eye(3)]
    slides = [np.tile(axis, (rows, 1)) for axis in np.eye(3)]
    motions = np.array([motion.ravel() for motion in slides + spins]).T  # (3N, 6)
    held = ~free.ravel()
    values, vectors = np.linalg.eigh(motions[held].T @ motions[held])
    allowed = vectors[:, values < 1e-12]
    return np.linalg.matrix_rank(motions @ allowed, tol=1e-8) if allowed.size else 0


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(1, 7), st.booleans())
def test_the_rank_needed_is_what_rigid_motions_leave(seed, rows, flat):
    rng = np.random.default_rng(seed)
    position = rng.uniform(-1, 1, (rows, 3))
    if flat:
        position[:, rng.integers(3)] = 0.5
    free = rng.random((rows, 3)) < rng.choice([0.2, 0.7, 1.0])
    found = rigidity(position, np.zeros((0, 2), dtype=np.intp), free)
    assert found.needed == free.sum() - rigid_motions(position, free)
    assert found.rank == 0


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


def test_links_know_their_number():
    assert len(Links(np.array([0, 0]), np.array([1, 2]), np.ones(2), np.ones(2))) == 2


def test_pairs_are_enough_for_the_matrices():
    path = links([(1, 0), (0, 1), (2, 1), (1, 2)])
    assert laplacian(path, 3).tolist() == [[1, -1, 0], [-1, 2, -1], [0, -1, 1]]
    assert np.isnan(path.distance).all()
    assert links([(1, 0), (2, 0)], 0.6, 3.0).distance.tolist() == [0.6, 0.6]
    assert links([(1, 0), (2, 0)], 0.6, [3.0, 4.0]).gain.tolist() == [3.0, 4.0]
