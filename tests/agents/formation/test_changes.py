"""Shapes go smoothly from one to the next, and links come and go by the clock and by range."""

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.formation.changes import Change, NewTargets, Presence, Reshaping, changed_targets, progress
from experiments.definition.graph import Links
from tests.agents.plugins.test_laws import told_more

FEW = settings(max_examples=25)


def change(count, at=10.0, over=4.0, **parts):
    """A change of `count` links that leaves everything as it was, but for `parts`."""
    scale, turn = parts.pop("scale", 1.0), parts.pop("turn", 0.0)
    return Change(at, over, msgspec.structs.replace(NewTargets.unchanged(count), **parts), scale, turn)


def after(net, changes, t):
    return changed_targets(net, changes, np.full(len(net), t))


def test_progress_is_smooth():
    t = np.linspace(0.0, 20.0, 2001)
    way = progress(t, 5.0, 10.0)
    assert way[t <= 5.0].max() == 0.0
    assert way[t >= 15.0].min() == 1.0
    assert (np.diff(way) >= 0.0).all()
    assert progress(np.array([10.0]), 5.0, 10.0)[0] == 0.5
    assert np.diff(way).max() / 0.01 == pytest.approx(1.875 / 10.0, rel=1e-3)  # the peak of minimum jerk
    assert np.abs(np.diff(way, 2)).max() / 0.01**2 < 0.06  # no jump in speed
    np.testing.assert_array_equal(progress(np.array([4.9, 5.0, 5.1]), 5.0, 0.0), [0.0, 1.0, 1.0])


@FEW
@given(st.integers(0, 2**31))
def test_before_nothing_changes_and_after_it_has(seed):
    _, net = told_more(seed)
    count = len(net)
    new = np.full(count, np.nan)
    new[2] = 0.123
    there = after(net, [change(count, distance=new)], 14.0)
    assert there.distance[2] == 0.123
    np.testing.assert_array_equal(np.delete(there.distance, 2), np.delete(net.distance, 2))
    before = after(net, [change(count, distance=new)], 10.0)
    np.testing.assert_array_equal(before.distance, net.distance)
    half = after(net, [change(count, distance=new)], 12.0)
    assert half.distance[2] == pytest.approx((net.distance[2] + 0.123) / 2)


@FEW
@given(st.integers(0, 2**31), st.floats(0.3, 3.0), st.floats(-6.0, 6.0), st.floats(10.0, 14.0))
def test_a_drawing_that_grows_and_turns_stays_a_drawing(seed, scale, turn, t):
    """What links ask for at any time is what one set of places has, grown and turned as far as it has come."""
    position, net = told_more(seed)
    apart = position[net.receiver] - position[net.sender]
    flat = apart * [1.0, 1.0, 0.0]
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    flat[:, 2] = np.nan
    net = Links(net.receiver, net.sender, np.linalg.norm(apart, axis=1), net.gain, apart, flat, net.wants)
    now = after(net, [change(len(net), scale=scale, turn=turn, rise=apart[:, 2])], t)
    share = progress(np.array([t]), 10.0, 4.0)[0]
    angle, grown = share * turn, 1.0 + share * (scale - 1.0)
    matrix = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    there = apart @ matrix.T * [grown, grown, 1.0]
    np.testing.assert_allclose(now.relative, there, atol=1e-12)
    np.testing.assert_allclose(now.distance, np.linalg.norm(there, axis=1), atol=1e-12)


@FEW
@given(st.integers(0, 2**31), st.floats(10.0, 14.0))
def test_directions_stay_directions_on_their_way(seed, t):
    _, net = told_more(seed)
    _, other = told_more(seed + 7)
    now = after(net, [change(len(net), bearing=other.bearing, turn=1.0)], t)
    np.testing.assert_allclose(_length(now.bearing), 1.0, atol=1e-12)
    there = after(net, [change(len(net), bearing=other.bearing)], 14.0)
    np.testing.assert_allclose(there.bearing, other.bearing, atol=1e-12)


def _length(vectors):
    return np.sqrt((np.nan_to_num(vectors) ** 2).sum(axis=1))


def presence(**parts):
    given = {"since": 0.0, "until": np.inf, "reach": np.inf, "release": np.inf, **parts}
    return Presence(*(np.array([given[name]]) for name in ("since", "until", "reach", "release")))


def test_links_by_the_clock():
    one, far = presence(since=5.0, until=8.0), np.array([np.nan])
    seen = [bool(one.present_now(np.array([t]), far, np.array([False]))[0]) for t in (0.0, 4.9, 5.0, 7.9, 8.0, 20.0)]
    assert seen == [False, False, True, True, False, False]
    assert not one.planned_at(0.0)[0]
    assert presence().planned_at(0.0)[0]
    assert not presence(reach=1.0).planned_at(0.0)[0]


def test_links_by_range_do_not_flicker():
    one, were, seen = presence(reach=1.0, release=1.2), np.array([False]), []
    for apart in (1.5, 1.1, 0.9, 1.1, 1.19, 1.21, 1.1, 1.0):
        were = one.present_now(np.zeros(1), np.array([apart]), were)
        seen.append(bool(were[0]))
    assert seen == [False, False, True, True, True, False, False, True]
    assert not one.present_now(np.zeros(1), np.array([np.nan]), np.array([True]))[0]  # who is not known is not near


def test_each_row_goes_by_its_own_clock():
    net = Links(np.array([0, 1]), np.array([1, 0]), np.ones(2), np.ones(2))
    what = Reshaping(net, [change(2, distance=np.full(2, 3.0))], None)
    what.advance(np.array([20.0, -np.inf]), np.zeros((2, 3)), np.zeros((2, 3)))
    np.testing.assert_array_equal(what.links.distance, [3.0, 1.0])
