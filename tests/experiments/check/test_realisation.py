"""The numbers of the reference experiment (IEEE Access 2023, section IV), and shapes that do not exist."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.kinds.crazyflie import CRAZYFLIE
from agents.kinds.khepera4 import KHEPERA4
from agents.kinds.tello import TELLO
from experiments.check import realisation
from experiments.check.analysis import Analysis
from experiments.check.ideal_run import Prediction
from experiments.check.motion import formation
from experiments.definition.experiment import Formation, RobotTable
from experiments.definition.graph import links
from experiments.definition.plan import Plan
from experiments.file import document
from tests.cases import examples
from tests.experiments.check.test_stability import linked
from tests.experiments.checked import findings
from tests.experiments.traces import link_errors
from tests.small import small


def test_heights_and_lengths_that_make_no_triangle():
    reference = document.read("robotic-park").plan.links
    height = np.where(np.arange(7) < 4, 0.0, 0.81)
    found = realisation.conflicts(reference, height)
    assert [each.high for each in found] == [(4,), (5,)]
    assert [each.ceiling for each in found] == pytest.approx([math.sqrt(0.86**2 - 0.3**2)] * 2)
    assert realisation.conflicts(reference, np.where(np.arange(7) < 4, 0.0, 0.805)) == []
    (found,) = realisation.conflicts(links([(1, 0)], [0.5], [1.0]), np.array([0.2, 0.9]))
    assert (found.rows, found.high) == ((0, 1), (1,))
    assert found.ceiling == pytest.approx(0.7)
    (found,) = realisation.conflicts(links([(1, 0), (2, 1), (2, 0)], [1.0, 1.0, 2.5], [1.0] * 3), np.zeros(3))
    assert found.rows == (0, 1, 2)
    assert math.isnan(found.ceiling)


def test_rigidity_and_connectivity_of_known_graphs():
    position = np.array([(0, 0, 0), (1, 0, 0), (0.5, math.sqrt(0.75), 0)])
    net = links([(2, 0), (2, 1)], [1.0, 1.0], [1.0, 1.0])
    assert realisation.formation_rigidity(position, net, np.array([0, 1]))[0].rigid  # two leaders stand in for a bar
    assert realisation.formation_rigidity(position, net, np.array([0]))[0].rank == 2
    ring = links([(0, 1), (1, 2), (2, 3), (3, 0)], [1.0] * 4, [1.0] * 4)
    assert realisation.algebraic_connectivity(ring, 4) == pytest.approx(2.0)
    assert realisation.algebraic_connectivity(ring, 5) == pytest.approx(0.0)
    assert realisation.algebraic_connectivity(links([], [], []), 1) == 0.0


@examples(25)
@given(seed=st.integers(0, 10_000), rows=st.integers(3, 10))
def test_distances_of_a_drawing_are_met_again(seed, rows):
    rng = np.random.default_rng(seed)
    height = rng.choice([0.0, 0.5], rows)
    drawn = np.column_stack([rng.uniform(-1.0, 1.0, (rows, 2)), height])
    net = linked(drawn, [(i, j) for i in range(rows) for j in range(rows) if i != j])
    unfolded = realisation.unfold_distances(net, height)
    assert link_errors(net, unfolded).max() < 1e-6
    assert realisation.find_shapes(net, [unfolded], np.ones(rows, dtype=bool))[-1].worst < 1e-6
    assert realisation.conflicts(net, height) == []


def test_robots_on_the_wrong_side_are_named():
    rng = np.random.default_rng(0)
    shape = np.column_stack([rng.uniform(-1.0, 1.0, (5, 2)), np.zeros(5)])
    pairs = [(i, j) for i in range(5) for j in range(i)]
    wanted = linked(shape, pairs)
    moves, held = np.arange(5) > 1, np.ones((5, 3), dtype=bool)
    held[:2], held[:, 2] = False, False
    turned = shape.copy()
    way = shape[1, :2] - shape[0, :2]
    across = np.array([-way[1], way[0]]) / np.linalg.norm(way)
    turned[4, :2] -= 2.0 * ((turned[4] - turned[0])[:2] @ across) * across
    end = realisation.fitted_shape(wanted, (), turned, held)
    assert end.worst > 0.05  # a local minimum
    (found,) = realisation.mirrored_robots(wanted, end.position, moves)
    assert found.row == 4
    assert found.place == pytest.approx(shape[4], abs=1e-3)
    assert realisation.mirrored_robots(wanted, shape, moves) == []
    robots = {f"K{k}": RobotTable(kind="khepera4", start=list(place[:2])) for k, place in enumerate(end.position)}
    given = {f"K{i} - K{j}": d for (i, j), d in zip(pairs, wanted.distance.tolist(), strict=True)}
    made = small(robots, formation=Formation(links=given, leader=None), duration_s=5.0)
    motion = Prediction(np.array([0.0, 5.0]), np.stack([end.position] * 2), 10, 2.0)
    (finding,) = formation(Analysis(Plan(made), motion))
    assert finding.code == "local-minimum"
    assert "K4 near (-0.14, 0.86) in the room" in finding.remedy


def test_robots_in_one_another_are_found():
    kinds, all_of_them = [CRAZYFLIE, TELLO, KHEPERA4], np.ones(3, dtype=bool)
    solids = realisation.Solids.of(kinds, links([(0, 1), (1, 2)]), all_of_them, clearance=0.1)
    near = np.array([(0.0, 0.0, 0.5), (0.1, 0.0, 0.5), (0.0, 0.05, 0.0)])
    assert solids.overlaps(near).tolist() == [[0, 1]]
    assert solids.overlaps(near + np.array([[0, 0, 0.1], [0, 0, 0], [0, 0, 0]])).tolist() == [[0, 1]]
    assert not len(solids.overlaps(near + np.array([[0, 0, 0.2], [0, 0, 0], [0, 0, 0]])))
    parts = realisation.Solids.of(kinds, links([(1, 2)]), all_of_them)
    assert not len(parts.overlaps(near))  # places of parts are their own
    pair = realisation.Solids.of(kinds[:2], links([(0, 1)]), all_of_them[:2], clearance=0.5)
    touch = CRAZYFLIE.radius + TELLO.radius
    assert len(pair.overlaps(np.array([(0.0, 0.0, 0.5), (0.99 * touch, 0.0, 0.9)])))  # seen from above
    assert not len(pair.overlaps(np.array([(0.0, 0.0, 0.5), (touch, 0.0, 0.5)])))


def test_best_shape_keeps_robots_apart():
    def shape(worst, overlaps=0):
        return realisation.Shape(np.zeros((2, 3)), np.array([worst]), overlaps=np.zeros((overlaps, 2), dtype=np.intp))

    crossed, apart, far = shape(0.1 * realisation.OFF, 1), shape(realisation.OFF), shape(2.0 * realisation.OFF)
    assert realisation.best_shape([crossed, far, apart]) is apart
    assert realisation.best_shape([crossed, far]) is crossed
    assert realisation.best_shape([shape(0.5 * realisation.OFF), apart]).worst == 0.5 * realisation.OFF


def test_shape_in_one_place_is_an_error():
    """A square of four links and a diagonal of nothing: two corners are to be in one place."""
    robots = {f"K{k}": RobotTable(kind="khepera4", start=[0.5 * k, 0.1 * k]) for k in range(4)}
    sides = {"K0 - K1": 1.0, "K1 - K2": 1.0, "K2 - K3": 1.0, "K0 - K3": 1.0, "K0 - K2": 0.01}
    found = findings(small(robots, formation=Formation(links=sides, gain=1.0), duration_s=5.0))
    assert found["in-one-place"].severity == "error"
    assert "K0 and K2 would stand 0.01 m apart" in found["in-one-place"].message
