"""Stiffest and slowest mode of the sampled loop."""

from itertools import product

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.formation.link import BY_RELATIVE
from agents.plugins.laws import Displacement, Distance
from experiments.authoring import layouts
from experiments.check.realisation import find_shapes
from experiments.check.stability import modes
from experiments.definition.formation import law_offsets
from experiments.definition.graph import Links, links
from experiments.definition.plan import Plan
from tests.cases import examples
from tests.experiments.checked import PUBLISHED
from tests.small import reference


def linked(position, pairs, gain=1.0):
    """Links of these pairs (row that receives, row that sends), with the distances that they have."""
    distance = [float(np.linalg.norm(position[i] - position[j])) for i, j in pairs]
    return links(pairs, distance, gain)


def both_ways(made, gain):
    pairs = made.pairs.tolist()
    return linked(made.position, [*pairs, *(pair[::-1] for pair in pairs)], gain)


def rounded(net, digits=4):
    return Links(net.receiver, net.sender, np.round(net.distance, digits), net.gain)


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
    shape = find_shapes(net, [PUBLISHED], np.arange(7) > 0)[0]
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
    for position, both in [*((each.position, each.pairs) for each in made), (MIXED, LINKED)]:
        rows = len(position)
        pairs = [*both, *(pair[::-1] for pair in both)]
        net = linked(position, [(int(i), int(j)) for i, j in pairs if not (led and i == 0)])
        share, moves = np.full(rows, 0.18), np.arange(rows) >= led
        exact = modes(Distance(), net, position, share, 10.0)
        shape = find_shapes(rounded(net, digits), [position], moves)[0]
        found = modes(Distance(), rounded(net, digits), shape.position, share, 10.0)
        assert found.slowest_s == pytest.approx(exact.slowest_s, rel=10.0**-digits * 300.0)


def test_modes_slower_than_the_run_are_free():
    made = layouts.hemisphere(8, 0.6, 0.25)
    net, share = both_ways(made, 1.5), np.full(8, 0.18)
    every = modes(Distance(), net, made.position, share, 10.0)
    assert every.free == 0
    few = modes(Distance(), net, made.position, share, 10.0, within_s=0.9 * every.slowest_s)
    assert few.free >= 1
    assert (few.gain, few.radius, few.slowest_s) == (every.gain, every.radius, every.slowest_s)


def test_relative_positions_leave_no_turn_free():
    relative = np.array([(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)])
    net = links([(0, 1), (1, 0)], 1.0, 0.5)
    net = msgspec.structs.replace(net, relative=relative, wants=np.full(2, BY_RELATIVE))
    found = modes(Displacement(), net, np.array([(1.0, 0, 0), (0, 0, 0)]), np.full(2, 0.2), 10.0)
    assert found.gain == pytest.approx(0.2)  # twice the stiffness, by the share
    assert found.slowest_s == pytest.approx(-0.1 / np.log(0.8))


@examples(30)
@given(st.integers(0, 2**32 - 1), st.integers(3, 8))
def test_derivative_by_links_is_that_by_robots(seed, rows):
    rng = np.random.default_rng(seed)
    position = rng.uniform(-1.0, 1.0, (rows, 3))
    pairs = [(i, j) for i in range(rows) for j in range(rows) if i != j and rng.random() < 0.6] or [(1, 0)]
    net = linked(position, pairs, rng.uniform(0.2, 0.6, len(pairs)).tolist())
    share = rng.uniform(0.05, 0.2, rows)
    found = modes(Distance(), net, position, share, 10.0)
    assert found.gain == pytest.approx(max(by_hand(net, position, share).real.max(), 0.0), abs=1e-5)
