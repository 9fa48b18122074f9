import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.authoring import layouts
from experiments.authoring.layouts import LayoutError
from experiments.definition.rigidity import rigidity


def held(made):
    free = np.ones((len(made), 3), dtype=bool)
    free[:, 2] = False
    return rigidity(made.position, made.pairs, free)


def lengths(made):
    return np.linalg.norm(made.position[made.pairs[:, 0]] - made.position[made.pairs[:, 1]], axis=1)


def nearest(points):
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    return apart[np.triu_indices(len(points), 1)].min()


@pytest.mark.parametrize("count", [3, 4, 5, 6, 7, 12, 40])
def test_polygons_are_regular_and_rigid(count):
    made = layouts.polygon(count, 0.6)
    assert held(made).rigid
    assert nearest(made.position) == pytest.approx(0.6)
    around = np.linalg.norm(made.position, axis=1)
    assert around == pytest.approx(np.full(count, 0.3 / np.sin(np.pi / count)))
    assert len(made.pairs) == min(2 * count, count * (count - 1) // 2)


@pytest.mark.parametrize(("rows", "columns"), [(2, 2), (2, 7), (4, 3)])
def test_grids_have_all_neighbours(rows, columns):
    made = layouts.grid(rows, columns, 0.5)
    assert held(made).rigid
    assert set(np.round(lengths(made), 6)) == {0.5, round(0.5 * np.sqrt(2.0), 6)}
    assert len(made.pairs) == rows * (columns - 1) + (rows - 1) * columns + 2 * (rows - 1) * (columns - 1)
    assert made.position.mean(axis=0) == pytest.approx(np.zeros(3))


@pytest.mark.slow
@settings(max_examples=8)
@given(st.integers(4, 80))
def test_hemispheres_are_rigid_and_keep_their_distances(count):
    made = layouts.hemisphere(count, 0.6, 0.25)
    assert held(made).rigid
    assert nearest(made.position) >= 0.6 - 1e-9
    assert nearest(made.position[:, :2]) >= 0.25 - 1e-9
    assert made.position[:, 2].min() == pytest.approx(layouts.LOWEST)
    assert lengths(made).max() < 2.1 * 0.6  # no link bridges a bay of the rim


def test_hemisphere_links_are_edges_of_the_convex_hull():
    scipy_spatial = pytest.importorskip("scipy.spatial")
    made = layouts.hemisphere(60, 0.6, 0.25)
    hull = scipy_spatial.ConvexHull(made.position)
    edges = {tuple(sorted((int(a), int(b)))) for t in hull.simplices for a, b in zip(t, np.roll(t, 1), strict=True)}
    own = {(int(a), int(b)) for a, b in made.pairs}
    assert own <= edges
    inner = made.position[:, 2] > made.position[:, 2].min() + 0.5  # away from the rim none is missing
    assert {edge for edge in edges if inner[list(edge)].all()} <= own


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: layouts.polygon(2, 0.6), "3 robots or more"),
        (lambda: layouts.hemisphere(3, 0.6, 0.2), "4 robots or more"),
        (lambda: layouts.grid(1, 9, 0.6), "2x2 or more"),
    ],
)
def test_what_cannot_be_had_says_what_can(made, said):
    with pytest.raises(LayoutError, match=said):
        made()
