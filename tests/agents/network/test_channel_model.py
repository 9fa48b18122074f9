"""The network model: what is lost, when the rest arrives, and that it is the same wherever it is asked."""

from itertools import groupby
from math import inf, log, nan, sqrt
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.network.channel_model import LOSS, USES, Channel, Conditions, LinkChannel, key, uniform
from tests.cases import examples

MANY = 40_000


class Got(NamedTuple):
    link: int
    arrival: float
    seq: int
    stamp: float


def conditions(link=0, *, seed=1, **values):
    return Conditions(key=key(seed, "S", f"L{link}"), **values)


def channel(**values):
    return Channel([conditions(**values)])


def send(made, stamps, *, links=(0,), start=0.0, size=100, nows=()):
    """Send samples 1, 2, … at `stamps` [s] on each of the links; `nows` [s] are their receptions."""
    for k, stamp in enumerate(stamps):
        for link in links:
            made.send(link, (k + 1, stamp), k + 1, stamp, start=start, size=size, now=nows[k] if nows else -inf)


def received(made, t=inf, link=None):
    """What got through, on all links or on one."""
    return [Got(number, at, *sample) for number, at, sample in made.due(t) if link in (None, number)]


def arrivals(made, t=inf):
    return [got.arrival for got in received(made, t)]


def lost(link=0, count=MANY, **values):
    made = LinkChannel(conditions(link, **values))
    return np.array([made.loses(seq) for seq in range(1, count + 1)])


def test_keys_and_first_numbers_of_splitmix64():
    """SplitMix64 with seed 0 begins with these words; another key loses other samples than earlier runs did."""
    words = [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]
    assert [uniform(0, counter) for counter in (1, 2, 3)] == [(word >> 11) / 2**53 for word in words]
    made = [key(1, "A", "B"), key(2, "A", "B"), key(1, "B", "A"), key(1, "AB"), key(1, "A", "B", ""), key(11, "B")]
    assert (made[0], len(set(made))) == (0x2E2988F8CB8FE3C8, len(made))


@pytest.mark.parametrize(("loss", "burst"), [(0.05, nan), (0.9, nan), (0.3, 2.0)])
def test_losses_alone_and_in_bursts(loss, burst):
    gone = lost(loss=loss, burst=burst)
    mean = 1 / (1 - loss) if np.isnan(burst) else burst
    lengths = [len(list(run)) for bad, run in groupby(gone.tolist()) if bad]
    assert gone.mean() == pytest.approx(loss, abs=4 * sqrt(2 * mean * loss * (1 - loss) / MANY))
    assert np.mean(lengths) == pytest.approx(mean, rel=0.05)


@pytest.mark.parametrize(("loss", "burst"), [(0.0, nan), (0.0, 4.0), (1.0, nan), (1.0, 3.0)])
def test_nothing_or_everything_is_lost(loss, burst):
    assert (lost(loss=loss, burst=burst, count=500) == bool(loss)).all()


@examples(40)
@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.9), st.floats(1.0, 30.0))
def test_bursts_are_a_chain_without_memory(seed, loss, more):
    burst, word = more / (1 - loss), key(seed, "S", "L0")
    enter, stays = loss / (burst * (1 - loss)), 1 - 1 / burst
    bad, expected = uniform(word, LOSS) < loss, []
    for seq in range(1, 301):  # step by step, as the chain is defined
        bad = uniform(word, seq * USES + LOSS) < (stays if bad else enter)
        expected.append(bad)
    assert lost(seed=seed, loss=loss, burst=burst, count=300).tolist() == expected


@examples(30)
@given(st.integers(0, 2**32 - 1), st.permutations(range(1, 61)), st.sampled_from([nan, 8.0]))
def test_fate_depends_on_no_other_sample(seed, order, burst):
    values = {"seed": seed, "loss": 0.3, "burst": burst, "jitter": 0.01}
    together, alone = Channel([conditions(link, **values) for link in range(3)]), channel(**values)
    send(together, [0.1 * seq for seq in range(1, 61)], links=range(3))
    for seq in order:  # as samples come in over a real network, which counts towards no delay
        alone.send(0, (seq, 0.1 * seq), seq, 0.1 * seq, start=0.0, size=100, now=0.1 * seq)
    got, other = received(together, link=0), received(alone)
    assert sorted(got) == sorted(other)
    assert together.dropped[0] == alone.dropped[0] == 60 - len(other)


def test_delay_and_jitter():
    made = channel(delay=0.02, jitter=0.03)
    send(made, range(1, 5001))
    extra = np.array([got.arrival - got.stamp - 0.02 for got in received(made)])
    assert extra.min() >= -1e-9
    assert extra.mean() == pytest.approx(0.03, rel=0.06)
    assert np.quantile(extra, 0.5) == pytest.approx(0.03 * log(2.0), rel=0.06)
    assert (made.dropped, len(extra)) == ([0], 5000)


def test_time_of_the_real_network_counts():
    made = channel(delay=0.05)
    send(made, [1.0, 1.1, 1.2, 1.3], nows=[1.0, 1.13, 1.25, 1.42])
    assert arrivals(made) == pytest.approx([1.05, 1.15, 1.25, 1.42])


def test_ideal_network_adds_nothing():
    made = Channel([Conditions(), Conditions()])
    assert made.ideal
    send(made, [0.97], links=(0, 1), nows=[1.0])
    assert arrivals(made, 1.0) == [1.0, 1.0]
    assert made.due(2.0) == []
    for value in ({"delay": 0.01}, {"jitter": 0.01}, {"loss": 0.1}, {"bandwidth": 1e4}, {"outages": ((0.0, 1.0),)}):
        assert not channel(**value).ideal


def test_samples_wait_for_their_time():
    made = Channel([conditions(link, delay=0.05) for link in range(3)])
    send(made, [0.0, 0.02])
    assert [[got.seq for got in received(made, t)] for t in (0.04, 0.05, 0.06, 0.08)] == [[], [1], [], [2]]
    send(made, [1.0], links=range(3))
    made.forget(0)
    made.forget(2)
    assert [got.link for got in received(made)] == [1]


@pytest.mark.parametrize(
    ("size", "expected"), [(100, [0.105, 0.205, 0.305, 0.605]), (50, [0.055, 0.105, 0.155, 0.555])], ids=str
)
def test_narrow_link_takes_its_time(size, expected):
    made = Channel([conditions(0, delay=0.005, bandwidth=8000.0, queue=10.0), conditions(1)])  # 100 bytes take 0.1 s
    send(made, [0.0, 0.02, 0.04, 0.5], size=size, links=(0, 1))
    assert made.limited
    got = received(made)
    assert [each.arrival for each in got if not each.link] == pytest.approx(expected, abs=1e-12)
    assert all(each.arrival == each.stamp for each in got if each.link), "each link has its queue"


def test_full_queue_drops():
    made = channel(bandwidth=8000.0, queue=0.0)
    send(made, [0.05 * k for k in range(10)])
    assert [got.seq for got in received(made)] == [1, 3, 5, 7, 9]
    made = channel(bandwidth=8000.0, queue=0.15)
    send(made, [0.02 * k for k in range(100)])  # transmitted every 20 ms, sent every 100 ms
    got = received(made)
    assert max(each.arrival - 0.1 - each.stamp for each in got) <= 0.15 + 2e-6
    assert np.diff([each.arrival for each in got]) == pytest.approx(0.1, abs=1e-12)  # always busy
    assert [each.seq for each in got] == [1, 2, *range(4, 100, 5)]  # from the second on, those that wait for 0.14 s
    assert made.dropped == [78]


def test_lost_samples_have_been_sent():
    free, lossy = (channel(bandwidth=8000.0, queue=inf, loss=loss) for loss in (0.0, 0.5))
    for made in (free, lossy):
        send(made, [0.02 * k for k in range(50)])
    whole = {got.seq: got.arrival for got in received(free)}
    part = received(lossy)
    assert 10 < len(part) < 40
    assert all(got.arrival == whole[got.seq] for got in part)


def test_nothing_passes_in_an_outage():
    made = Channel([conditions(0, delay=0.05, outages=((1.0, 2.0),)), conditions(1, delay=0.05)])
    send(made, [10.0 + 0.01 * k for k in range(300)], links=(0, 1), start=10.0)
    stamps = [round(got.stamp - 10.0, 6) for got in received(made, link=0)]
    assert not any(0.945 < stamp < 1.995 for stamp in stamps)  # what would arrive in it is lost too
    assert {0.94, 2.0} <= set(stamps)
    assert made.dropped == [105, 0]


@pytest.mark.parametrize("start", [inf, nan, 2.0])
def test_before_the_start_nothing_is_lost(start):
    made = channel(loss=1.0, delay=0.05, bandwidth=8.0, queue=0.0, outages=((0.0, inf),))
    send(made, [0.01 * k for k in range(100)], start=start)
    assert arrivals(made) == pytest.approx([0.01 * k + 0.05 for k in range(100)])


@pytest.mark.parametrize(
    ("values", "passes"),
    [({"outages": ((0.5, inf),)}, range(1, 51)), ({"loss": 1.0, "duration": 0.5}, range(51, 101))],
    ids=["outage to the end", "after the end nothing is lost"],
)
def test_end_of_run_and_outage(values, passes):
    made = channel(**values)
    send(made, [0.01 * k for k in range(100)])
    assert [got.seq for got in received(made)] == list(passes)
    assert made.dropped == [50]
