"""The network model: what is lost, when the rest arrives, and that it is the same wherever it is asked."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.arrays import PoseTable, no_poses
from agents.network.channel_model import LOSS, USES, Channel, Conditions, Outage, key, uniform

MANY = 40_000


def conditions(links=1, *, seed=1, **values):
    """The same on all links."""
    columns = {name: np.full(links, value) for name, value in values.items() if name not in {"outages", "duration"}}
    rest = {name: value for name, value in values.items() if name not in columns}
    made = replace(Conditions.ideal(links), **columns, **rest)
    return replace(made, key=np.array([key(seed, "S", f"L{k}") for k in range(links)], dtype=np.uint64))


def say(channel, link, seq, stamp, *, start=0.0, size=100, now=-np.inf):
    """One sample on each of some links."""
    link = np.atleast_1d(link)
    blank = np.zeros((len(link), 3))
    stamps = np.full(len(link), stamp)
    poses = PoseTable(link, np.full(len(link), seq), stamps, stamps, blank, blank, bytes=np.full(len(link), size))
    channel.send(poses, start=start, now=now)


def heard(channel, t=np.inf):
    got = channel.due(t)
    return no_poses() if got is None else got


def lost(made, link=0, count=MANY):
    return Channel(made).lost(np.full(count, link), np.arange(1, count + 1))


def runs(mask):
    """Lengths of the runs of true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return np.diff(edges)[::2]


# ---------------------------------------------------------------------- losses


@pytest.mark.parametrize("loss", [0.05, 0.3, 0.9])
def test_losses_by_chance(loss):
    gone = lost(conditions(loss=loss))
    assert gone.mean() == pytest.approx(loss, abs=4 * np.sqrt(loss * (1 - loss) / MANY))
    assert runs(gone).mean() == pytest.approx(1 / (1 - loss), rel=0.05)
    after = gone[1:][gone[:-1]].mean()  # whether the one before was lost says nothing
    assert after == pytest.approx(loss, abs=0.03)


LONG = [pytest.param(*each, marks=pytest.mark.slow) for each in ((0.3, 20.0), (0.02, 100.0))]


@pytest.mark.parametrize(("loss", "burst"), [(0.1, 5.0), (0.3, 2.0), *LONG])
def test_losses_in_bursts(loss, burst):
    gone = np.concatenate([lost(conditions(8, loss=loss, burst=burst), link) for link in range(8)])
    length = runs(gone)
    spread = np.sqrt(2 * burst * loss / (8 * MANY)) * 4  # samples of one burst are no independent evidence
    assert gone.mean() == pytest.approx(loss, abs=spread)
    assert length.mean() == pytest.approx(burst, rel=4 / np.sqrt(len(length)))
    # the lengths are geometric: as many longer than twice the mean as there must be
    assert (length > 2 * burst).mean() == pytest.approx(
        (1 - 1 / burst) ** (2 * burst), abs=4 * 0.4 / np.sqrt(len(length))
    )


def test_a_burst_of_the_length_that_chance_has_is_chance():
    chance, bursts = conditions(loss=0.25), conditions(loss=0.25, burst=1 / 0.75)
    np.testing.assert_array_equal(lost(chance), lost(bursts))


@pytest.mark.parametrize(("loss", "burst"), [(0.0, np.nan), (0.0, 4.0), (1.0, np.nan), (1.0, 3.0)])
def test_nothing_or_everything(loss, burst):
    assert (lost(conditions(loss=loss, burst=burst), count=500) == bool(loss)).all()


def walked(loss, burst, u, before):
    """The chain step by step, as it is defined: `u` of samples 1, 2, ... and whether the link is bad before them."""
    enter, stays = loss / (burst * (1 - loss)), 1 - 1 / burst
    bad, found = before, []
    for each in u:
        bad = each < stays if bad else each < enter
        found.append(bad)
    return found


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.9), st.floats(1.0, 30.0))
def test_bursts_are_a_chain_though_nothing_is_remembered(seed, loss, more):
    burst = more / (1 - loss)
    made = conditions(seed=seed, loss=loss, burst=burst)
    u = uniform(np.repeat(made.key, 301), np.arange(301) * USES + LOSS)
    expected = walked(loss, burst, u[1:], bool(u[0] < loss))
    np.testing.assert_array_equal(lost(made, count=300), expected)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.permutations(range(1, 61)), st.sampled_from([np.nan, 8.0]))
def test_a_fate_depends_on_no_other_sample_and_no_other_link(seed, order, burst):
    made = conditions(3, seed=seed, loss=0.3, burst=burst, jitter=0.01)
    together, alone = Channel(made), Channel(conditions(seed=seed, loss=0.3, burst=burst, jitter=0.01))
    for seq in range(1, 61):
        say(together, [0, 1, 2], seq, 0.1 * seq)
    for seq in order:
        say(alone, 0, seq, 0.1 * seq)
    got, other = heard(together), heard(alone)
    mine = got.link == 0
    np.testing.assert_array_equal(np.sort(got.seq[mine]), np.sort(other.seq))
    np.testing.assert_array_equal(np.sort(got.arrival[mine]), np.sort(other.arrival))
    assert together.dropped[0] == alone.dropped[0] == 60 - len(other.seq)


def test_repetitions_lose_others():
    gone = np.stack([lost(conditions(seed=seed, loss=0.3)) for seed in (1, 2)])
    assert (gone[0] & gone[1]).mean() == pytest.approx(0.09, abs=0.01)


# ---------------------------------------------------------------------- delay and jitter


def test_delay_and_jitter():
    channel = Channel(conditions(delay=0.02, jitter=0.03))
    for seq in range(1, 5001):
        say(channel, 0, seq, 1.0 * seq)
    got = heard(channel)
    extra = got.arrival - got.stamp - 0.02
    assert extra.min() >= -1e-9
    assert extra.mean() == pytest.approx(0.03, rel=0.06)
    assert np.quantile(extra, 0.5) == pytest.approx(0.03 * np.log(2.0), rel=0.06)
    assert channel.dropped.tolist() == [0]


def test_loss_and_jitter_of_a_sample_have_nothing_to_do_with_each_other():
    channel = Channel(conditions(jitter=0.03, loss=0.5))
    for seq in range(1, 4001):
        say(channel, 0, seq, 1.0 * seq)
    got = heard(channel)
    assert (got.arrival - got.stamp).mean() == pytest.approx(0.03, rel=0.1)


def test_what_the_real_network_took_counts_towards_the_delay():
    channel = Channel(conditions(delay=0.05))
    for seq, (stamp, now) in enumerate([(1.0, 1.0), (1.1, 1.13), (1.2, 1.25), (1.3, 1.42)], start=1):
        say(channel, 0, seq, stamp, now=now)
    np.testing.assert_allclose(heard(channel).arrival, [1.05, 1.15, 1.25, 1.42])


def test_an_ideal_network_adds_nothing():
    channel = Channel(Conditions.ideal(2))
    assert channel.ideal
    say(channel, [0, 1], 1, 0.97, now=1.0)
    got = heard(channel, 1.0)
    assert got.arrival.tolist() == [1.0, 1.0]
    assert channel.due(2.0) is None
    out = Outage(0.0, 1.0, np.array([True]))
    for value in ({"delay": 0.01}, {"jitter": 0.01}, {"loss": 0.1}, {"bandwidth": 1e4}, {"outages": (out,)}):
        assert not Channel(conditions(**value)).ideal


def test_it_waits_until_its_time_has_come():
    channel = Channel(conditions(delay=0.05))
    say(channel, 0, 1, 0.0)
    say(channel, 0, 2, 0.02)
    assert channel.due(0.04) is None
    assert heard(channel, 0.05).seq.tolist() == [1]
    assert channel.due(0.06) is None
    assert heard(channel, 0.08).seq.tolist() == [2]


def test_what_a_speaker_said_before_it_was_gone_does_not_bring_it_back():
    channel = Channel(conditions(3, delay=0.05))
    say(channel, [0, 1, 2], 1, 0.0)
    channel.forget(np.array([0, 2]))
    got = heard(channel)
    assert got.link.tolist() == [1]
    channel.forget(np.array([1]))
    assert channel.due(1.0) is None


# ---------------------------------------------------------------------- bandwidth


def test_a_narrow_link_takes_its_time():
    channel = Channel(conditions(delay=0.005, bandwidth=8000.0, queue=10.0))  # 100 bytes take 0.1 s
    for seq, stamp in enumerate([0.0, 0.02, 0.04, 0.5], start=1):
        say(channel, 0, seq, stamp, size=100 if seq < 4 else 50)
    np.testing.assert_allclose(heard(channel).arrival, [0.105, 0.205, 0.305, 0.555], atol=1e-12)


def test_a_full_queue_drops():
    channel = Channel(conditions(bandwidth=8000.0, queue=0.15))
    for seq in range(1, 101):  # said every 20 ms, sent every 100 ms
        say(channel, 0, seq, 0.02 * (seq - 1))
    got = heard(channel)
    waits = got.arrival - 0.1 - got.stamp
    assert waits.max() <= 0.15 + 2e-6
    np.testing.assert_allclose(np.diff(got.arrival), 0.1, atol=1e-12)  # always busy
    assert got.seq.tolist() == [1, 2, *range(4, 100, 5)]  # from the second on, those that wait for 0.14 s
    assert channel.dropped.tolist() == [78]


def test_without_a_queue_what_finds_its_link_busy_is_dropped():
    channel = Channel(conditions(bandwidth=8000.0, queue=0.0))
    for seq in range(1, 11):
        say(channel, 0, seq, 0.05 * (seq - 1))
    assert heard(channel).seq.tolist() == [1, 3, 5, 7, 9]


def test_lost_samples_have_been_sent():
    free, lossy = (Channel(conditions(bandwidth=8000.0, queue=np.inf, loss=loss)) for loss in (0.0, 0.5))
    for seq in range(1, 51):
        for channel in (free, lossy):
            say(channel, 0, seq, 0.02 * seq)
    all_of_them, some = heard(free), heard(lossy)
    np.testing.assert_array_equal(some.arrival, all_of_them.arrival[some.seq - 1])


def test_every_link_has_a_queue_of_its_own():
    bandwidth = np.array([8000.0, np.inf])
    channel = Channel(replace(conditions(2), bandwidth=bandwidth, queue=np.full(2, 10.0)))
    for seq in range(1, 6):
        say(channel, [0, 1], seq, 0.0)
    got = heard(channel)
    np.testing.assert_allclose(got.arrival[got.link == 0], 0.1 * np.arange(1, 6))
    np.testing.assert_array_equal(got.arrival[got.link == 1], 0.0)


def test_a_narrow_link_wants_to_know_sizes():
    channel, blank = Channel(conditions(bandwidth=1e4)), np.zeros((1, 3))
    with pytest.raises(ValueError, match="sizes"):
        channel.send(PoseTable(np.array([0]), np.array([1]), np.zeros(1), np.zeros(1), blank, blank))


# ---------------------------------------------------------------------- outages, the start and the end


def test_nothing_passes_in_an_outage():
    out = Outage(1.0, 2.0, np.array([True, False]))
    channel = Channel(conditions(2, delay=0.05, outages=(out,)))
    for k in range(300):
        say(channel, [0, 1], k + 1, 10.0 + 0.01 * k, start=10.0)
    got = heard(channel)
    stamps = np.round(got.stamp[got.link == 0] - 10.0, 6)
    assert not ((stamps > 0.945) & (stamps < 1.995)).any()  # what would arrive in it is lost too
    assert {0.94, 2.0} <= set(stamps.tolist())
    assert channel.dropped.tolist() == [105, 0]


def test_an_outage_to_the_end():
    channel = Channel(conditions(outages=(Outage(0.5, np.inf, np.array([True])),)))
    for k in range(100):
        say(channel, 0, k + 1, 0.01 * k)
    assert heard(channel).seq.tolist() == list(range(1, 51))


@pytest.mark.parametrize("start", [np.inf, np.nan, 2.0])
def test_before_the_start_nothing_is_lost(start):
    out = Outage(0.0, np.inf, np.array([True]))
    channel = Channel(conditions(loss=1.0, delay=0.05, bandwidth=8.0, queue=0.0, outages=(out,)))
    for k in range(100):
        say(channel, 0, k + 1, 0.01 * k, start=start)
    np.testing.assert_allclose(heard(channel).arrival, 0.01 * np.arange(100) + 0.05)


def test_after_the_end_nothing_is_lost():
    channel = Channel(conditions(loss=1.0, duration=0.5))
    for k in range(100):
        say(channel, 0, k + 1, 0.01 * k)
    assert heard(channel).seq.tolist() == list(range(51, 101))
    assert channel.dropped.tolist() == [50]


# ---------------------------------------------------------------------- the two places


@pytest.mark.slow
@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.lists(st.floats(0.0, 0.04), min_size=200, max_size=200))
def test_the_listener_of_a_real_network_loses_what_the_virtual_one_does(seed, took):
    """The same sequence at both: by ticks, and one by one as it comes in over a real network."""
    made = conditions(2, seed=seed, delay=0.05, jitter=0.02, loss=0.3, burst=3.0, bandwidth=40_000.0, queue=0.01)
    virtual, real = Channel(made), Channel(made)
    latest = [0.0, 0.0]
    for k in range(100):
        stamp = 0.02 * k
        say(virtual, [0, 1], k + 1, stamp)
        for link in (0, 1):
            latest[link] = max(latest[link], stamp + took[2 * k + link])  # a publisher's samples come in order
            say(real, link, k + 1, stamp, start=np.zeros(1), now=latest[link])
    one, other = heard(virtual), heard(real)
    for link in (0, 1):
        a, b = one.link == link, other.link == link
        assert sorted(one.seq[a].tolist()) == sorted(other.seq[b].tolist())
        x, y = np.argsort(one.seq[a]), np.argsort(other.seq[b])
        assert (other.arrival[b][y] >= one.arrival[a][x]).all()
    np.testing.assert_array_equal(virtual.dropped, real.dropped)
    assert virtual.dropped.min() > 0


def test_repetitions_side_by_side_are_what_each_is_alone():
    out = (Outage(0.3, 0.4, np.array([True, False])),)
    parts = [conditions(2, seed=seed, loss=0.3, jitter=0.02, outages=out) for seed in (5, 6)]
    both, alone = Channel(Conditions.side_by_side(parts)), [Channel(part) for part in parts]
    for k in range(100):
        say(both, [0, 1, 2, 3], k + 1, 0.01 * k)
        for each in alone:
            say(each, [0, 1], k + 1, 0.01 * k)
    got = heard(both)
    for copy, each in enumerate(alone):
        own = heard(each)
        mine = got.link // 2 == copy
        np.testing.assert_array_equal(got.seq[mine], own.seq)
        np.testing.assert_array_equal(got.arrival[mine], own.arrival)
        np.testing.assert_array_equal(both.dropped[2 * copy : 2 * copy + 2], each.dropped)
