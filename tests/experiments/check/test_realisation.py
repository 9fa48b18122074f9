"""Shapes that exist or do not, and the stiffest and slowest mode of the sampled loop."""

import math
from itertools import permutations, product

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.formation.link import BY_RELATIVE
from agents.plugins.laws import Displacement, Distance
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.khepera4.kind import KHEPERA4
from bridges.tello.kind import TELLO
from experiments.authoring import layouts
from experiments.check import realisation
from experiments.check.analysis import Analysis
from experiments.check.ideal_run import Prediction
from experiments.check.motion import formation
from experiments.check.stability import modes
from experiments.definition.experiment import Formation, LinkTable, RobotTable
from experiments.definition.formation import law_offsets, loop_gain
from experiments.definition.graph import Links, links
from experiments.definition.plan import Plan
from experiments.file import document
from tests.cases import examples
from tests.experiments.checked import PUBLISHED, findings
from tests.experiments.traces import link_errors
from tests.small import reference, small


def linked(position, pairs, gain=1.0):
    """Links of these pairs (row that receives, row that sends), with the distances that they have."""
    distance = [float(np.linalg.norm(position[i] - position[j])) for i, j in pairs]
    return links(pairs, distance, gain)


def both_ways(pairs):
    return [*pairs, *(pair[::-1] for pair in pairs)]


def by_hand(net, position, share):
    """Eigenvalues by moving one coordinate of one robot at a time; all receive it."""
    rows, columns = np.unique(net.receiver), []
    for row, axis in product(rows, (0, 1)):
        step = np.zeros_like(position)
        step[row, axis] = 1e-4
        ahead, behind = (law_offsets(Distance(), at, at[net.sender], net) for at in (position + step, position - step))
        columns.append((ahead - behind)[rows, :2].ravel() / 2e-4)
    return np.linalg.eigvals(-np.repeat(share[rows], 2)[:, None] * np.stack(columns, axis=1))


def test_stiffest_and_slowest_mode_of_the_reference():
    net, gain = Plan(reference()).links, 3.0
    net = msgspec.structs.replace(net, gain=np.full(len(net), gain))
    shape = realisation.find_shapes(net, [PUBLISHED], np.arange(7) > 0)[0]
    hz = 1000.0  # u applied as a velocity: h = 1 / hz
    found = modes(Distance(), net, shape.position, np.full(7, 1.0 / hz), hz)
    assert found.slowest_s * gain == pytest.approx(108.0, abs=0.5)
    assert 2.0 / (found.gain * hz / gain) == pytest.approx(1.05, abs=0.005)
    assert found.radius < 1.0


MIXED = np.array([(0, 0, 0), (0.9, 0.1, 0), (0.4, 0.8, 0), (0.3, 0.2, 0.7), (0.6, 0.5, 0.9)])  # two above three
LINKED = ((0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3), (0, 4), (3, 4))  # one more than it needs


@pytest.mark.parametrize(("digits", "led"), [(4, True), (3, False)])
def test_rounded_lengths_make_no_slow_turning_mode(digits, led):
    made = [*(layouts.hemisphere(count, 0.6, 0.25) for count in (5, 8, 12)), layouts.grid(3, 3, 0.5)]
    for position, both in [*((each.position, each.pairs.tolist()) for each in made), (MIXED, LINKED)]:
        rows = len(position)
        net = linked(position, [(i, j) for i, j in both_ways(both) if not (led and i == 0)])
        rounded = Links(net.receiver, net.sender, np.round(net.distance, digits), net.gain)
        share, moves = np.full(rows, 0.18), np.arange(rows) >= led
        exact = modes(Distance(), net, position, share, 10.0)
        shape = realisation.find_shapes(rounded, [position], moves)[0]
        found = modes(Distance(), rounded, shape.position, share, 10.0)
        assert found.slowest_s == pytest.approx(exact.slowest_s, rel=10.0**-digits * 300.0)


def test_modes_slower_than_the_run_are_free():
    made = layouts.hemisphere(8, 0.6, 0.25)
    net, share = linked(made.position, both_ways(made.pairs.tolist()), 1.5), np.full(8, 0.18)
    every = modes(Distance(), net, made.position, share, 10.0)
    few = modes(Distance(), net, made.position, share, 10.0, within_s=0.9 * every.slowest_s)
    assert every.free == 0 < few.free
    assert (few.gain, few.radius, few.slowest_s) == (every.gain, every.radius, every.slowest_s)


def test_relative_positions_leave_no_turn_free():
    relative = np.array([(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)])
    net = links([(0, 1), (1, 0)], 1.0, 0.5)
    net = msgspec.structs.replace(net, relative=relative, wants=np.full(2, BY_RELATIVE))
    found = modes(Displacement(), net, np.array([(1.0, 0, 0), (0, 0, 0)]), np.full(2, 0.2), 10.0)
    # twice the stiffness, by the share
    assert (found.gain, found.slowest_s) == pytest.approx((0.2, -0.1 / np.log(0.8)))


@examples(30)
@given(st.integers(0, 2**32 - 1), st.integers(3, 8))
def test_derivative_by_links_is_that_by_robots(seed, rows):
    rng = np.random.default_rng(seed)
    position = rng.uniform(-1.0, 1.0, (rows, 3))
    pairs = [(i, j) for i in range(rows) for j in range(rows) if i != j and rng.random() < 0.6] or [(1, 0)]
    net = linked(position, pairs, rng.uniform(0.2, 0.6, len(pairs)).tolist())
    share = rng.uniform(0.05, 0.2, rows)
    found = modes(Distance(), net, position, share, 10.0)
    assert found.gain == pytest.approx(loop_gain(by_hand(net, position, share)), rel=1e-3, abs=1e-5)


@pytest.mark.parametrize("robots", [3, 4, 7])
def test_one_way_ring_is_unstable_from_one(robots):
    """Its modes g (1 - exp(i a)) grow from g = 1 on: with three robots by a real part of 1.5."""
    angle = math.tau * np.arange(robots) / robots
    place = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    pairs = [(k, (k + 1) % robots) for k in range(robots)]
    net = links(pairs, 1.0, 1.0)
    relative = place[net.receiver] - place[net.sender]
    net = msgspec.structs.replace(net, relative=relative, wants=np.full(robots, BY_RELATIVE))
    for step in (0.9, 1.1):
        found = modes(Displacement(), net, place, np.full(robots, step), 10.0)
        law = step * (np.eye(robots) - np.roll(np.eye(robots), 1, axis=1))
        grows = np.abs(1.0 - np.linalg.eigvals(law)).max() > 1.0 + 1e-9
        assert (found.gain > 2.0) == grows == (step > 1.0)


def test_heights_and_lengths_that_make_no_triangle():
    reference = document.read("robotic-park").plan.links
    height = np.where(np.arange(7) < 4, 0.0, 0.81)
    found = realisation.conflicts(reference, height)
    assert [each.high for each in found] == [(4,), (5,)]
    assert [each.ceiling for each in found] == pytest.approx([math.sqrt(0.86**2 - 0.3**2)] * 2)
    assert realisation.conflicts(reference, np.where(np.arange(7) < 4, 0.0, 0.805)) == []
    (found,) = realisation.conflicts(links([(1, 0)], [0.5], [1.0]), np.array([0.2, 0.9]))
    assert (found.rows, found.high, found.ceiling) == ((0, 1), (1,), pytest.approx(0.7))
    (found,) = realisation.conflicts(links([(1, 0), (2, 1), (2, 0)], [1.0, 1.0, 2.5], [1.0] * 3), np.zeros(3))
    assert (found.rows, found.ceiling) == ((0, 1, 2), pytest.approx(math.nan, nan_ok=True))


def test_rigidity_and_connectivity_of_known_graphs():
    position = np.array([(0, 0, 0), (1, 0, 0), (0.5, math.sqrt(0.75), 0)])
    net = links([(2, 0), (2, 1)], [1.0, 1.0], [1.0, 1.0])
    assert realisation.formation_rigidity(position, net, np.array([0, 1]))[0].rigid  # two leaders stand in for a bar
    assert realisation.formation_rigidity(position, net, np.array([0]))[0].rank == 2
    ring, connectivity = links([(0, 1), (1, 2), (2, 3), (3, 0)], 1.0, 1.0), realisation.algebraic_connectivity
    assert (connectivity(ring, 4), connectivity(ring, 5)) == pytest.approx((2.0, 0.0))
    assert connectivity(links([], [], []), 1) == 0.0


@examples(25)
@given(seed=st.integers(0, 10_000), rows=st.integers(3, 10))
def test_distances_of_a_drawing_are_met_again(seed, rows):
    rng = np.random.default_rng(seed)
    height = rng.choice([0.0, 0.5], rows)
    drawn = np.column_stack([rng.uniform(-1.0, 1.0, (rows, 2)), height])
    net = linked(drawn, [*permutations(range(rows), 2)])
    unfolded = realisation.unfold_distances(net, height)
    worst = realisation.find_shapes(net, [unfolded], np.ones(rows, dtype=bool))[-1].worst
    assert max(link_errors(net, unfolded).max(), worst) < 1e-6
    assert realisation.conflicts(net, height) == []


def test_large_shapes_are_fitted_by_conjugate_gradients():
    """A grid with diagonals, from a guess that is off by a tenth of its distances."""
    grid = np.array([(k % 15, k // 15, 0.0) for k in range(225)])
    near = [(i, j) for i, j in permutations(range(225), 2) if 0.0 < np.linalg.norm(grid[i] - grid[j]) < 1.5]
    guess = grid + 0.1 * np.random.default_rng(1).normal(size=grid.shape) * (1.0, 1.0, 0.0)
    free = np.broadcast_to(np.array([True, True, False]), grid.shape)
    assert free.sum() > realisation.DENSE
    assert realisation.fitted_shape(linked(grid, near), (), guess, free).worst < 1e-6


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
    assert (found.row, *found.place) == pytest.approx((4, *shape[4]), abs=1e-3)
    assert realisation.mirrored_robots(wanted, shape, moves) == []
    robots = {f"K{k}": RobotTable(kind="khepera4", start=list(place[:2])) for k, place in enumerate(end.position)}
    given = {f"K{i} - K{j}": d for (i, j), d in zip(pairs, wanted.distance.tolist(), strict=True)}
    made = small(robots, formation=Formation(links=given, leader=None), duration_s=5.0)
    plan = Plan(made)
    motion = Prediction(plan, np.array([0.0, 5.0]), np.stack([end.position] * 2), 10, 2.0)
    (finding,) = formation(Analysis(plan, motion))
    assert (finding.code, "K4 near (-0.14, 0.86) in the room" in finding.remedy) == ("local-minimum", True)


def test_robots_in_one_another_are_found():
    kinds, all_of_them = [CRAZYFLIE, TELLO, KHEPERA4], np.ones(3, dtype=bool)
    solids = realisation.Solids.of(kinds, links([(0, 1), (1, 2)]), all_of_them, clearance=0.1)
    near = np.array([(0.0, 0.0, 0.5), (0.1, 0.0, 0.5), (0.0, 0.05, 0.0)])
    for higher, overlaps in ((0.0, [[0, 1]]), (0.1, [[0, 1]]), (0.2, [])):
        assert solids.overlaps(near + np.array([[0, 0, higher], [0, 0, 0], [0, 0, 0]])).tolist() == overlaps
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


@pytest.mark.parametrize(("last", "agree"), [([1.0, -1.0], True), ([1.0, 1.0], False)])
def test_directions_that_contradict_are_named(last, agree):
    robots = {f"K{k}": RobotTable(kind="khepera4", start=[0.5 * k, 0.1 * k]) for k in range(3)}
    given = {"K0 - K1": [-1.0, 0.0], "K0 - K2": [0.0, -1.0], "K1 - K2": last}
    drawn = Formation(links={name: LinkTable(bearing=each) for name, each in given.items()}, law="bearing")
    found = findings(small(robots, formation=drawn, duration_s=5.0))
    assert ("not-realisable" in found) is not agree
    assert ("rigid" in found) is agree
    if not agree:
        assert found["not-realisable"].severity == "error"
        assert "the directions of K0 - K1, K0 - K2, K1 - K2 contradict" in found["not-realisable"].message


STARTS = [(-0.17, -0.97), (0.73, -0.76), (0.85, -1.1), (-0.37, 0.29), (-1.15, 0.9)]
CHAIN = {"K0 - K1": (-0.155, 0.988), "K1 - K2": (-0.79, 0.613), "K2 - K3": (0.708, -0.706), "K3 - K4": (-0.345, 0.939)}
NET = {
    "K0 - K1": (-0.749, -0.662), "K1 - K2": (0.265, 0.964), "K0 - K3": (-0.853, -0.522), "K1 - K3": (-1.0, -0.022),
    "K2 - K3": (-0.685, -0.729), "K0 - K4": (0.813, 0.582), "K1 - K4": (0.766, 0.643), "K3 - K4": (0.845, 0.535),
}  # fmt: skip


@pytest.mark.parametrize("given", [CHAIN, NET], ids=["two that are not linked", "rounded"])
def test_bearings_of_a_drawing_are_realisable(given):
    """Guesses in which robots met in one point were all that was tried."""
    robots = {f"K{k}": RobotTable(kind="khepera4", start=list(start)) for k, start in enumerate(STARTS)}
    drawn = Formation(links={name: LinkTable(bearing=list(each)) for name, each in given.items()}, law="bearing")
    found = findings(small(robots, formation=drawn, duration_s=5.0))
    assert {"realisable", "in-one-place", "not-realisable"} & found.keys() == {"realisable"}


def test_shape_in_one_place_is_an_error():
    """A square of four links and a diagonal of nothing: two corners are to be in one place."""
    robots = {f"K{k}": RobotTable(kind="khepera4", start=[0.5 * k, 0.1 * k]) for k in range(4)}
    sides = {"K0 - K1": 1.0, "K1 - K2": 1.0, "K2 - K3": 1.0, "K0 - K3": 1.0, "K0 - K2": 0.01}
    found = findings(small(robots, formation=Formation(links=sides, gain=1.0), duration_s=5.0))["in-one-place"]
    assert (found.severity, "K0 and K2 would stand 0.01 m apart" in found.message) == ("error", True)
