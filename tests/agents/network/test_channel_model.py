"""The network model: what is lost, when the rest arrives, and that it is the same wherever it is asked."""

from collections import defaultdict
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
    """A sample that got through."""

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


def received(made, t=inf):
    return [Got(link, arrival, *sample) for link, arrival, sample in made.due(t)]


def arrivals(made, t=inf):
    return [got.arrival for got in received(made, t)]


def lost(link=0, count=MANY, **values):
    made = LinkChannel(conditions(link, **values))
    return np.array([made.loses(seq) for seq in range(1, count + 1)])


def bursts(gone):
    """Lengths of the runs of lost samples."""
    return np.array([len(list(run)) for bad, run in groupby(gone.tolist()) if bad])


# ---------------------------------------------------------------------- random numbers


def test_first_numbers_of_splitmix64():
    """SplitMix64 with seed 0 begins with these words (as in the tests of its other implementations)."""
    words = [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]
    assert [uniform(0, counter) for counter in (1, 2, 3)] == [(word >> 11) / 2**53 for word in words]


def test_keys_differ_by_seed_names_and_order():
    """Another key loses other samples than earlier runs did."""
    made = [key(1, "A", "B"), key(2, "A", "B"), key(1, "B", "A"), key(1, "AB"), key(1, "A", "B", ""), key(11, "B")]
    assert made[0] == 0x2E2988F8CB8FE3C8
    assert len(set(made)) == len(made)
    assert all(0 <= each < 2**64 for each in made)


# ---------------------------------------------------------------------- losses


@pytest.mark.parametrize("loss", [0.05, 0.3, 0.9])
def test_losses_by_chance(loss):
    gone = lost(loss=loss)
    assert gone.mean() == pytest.approx(loss, abs=4 * sqrt(loss * (1 - loss) / MANY))
    assert bursts(gone).mean() == pytest.approx(1 / (1 - loss), rel=0.05)
    assert gone[1:][gone[:-1]].mean() == pytest.approx(loss, abs=0.03)  # the sample before tells nothing


@pytest.mark.parametrize(
    ("loss", "burst", "count"), [(0.3, 2.0, MANY), pytest.param(0.3, 20.0, 10_000, marks=pytest.mark.slow)]
)
def test_losses_in_bursts(loss, burst, count):
    gone = np.concatenate([lost(link, count, loss=loss, burst=burst) for link in range(8)])
    length = bursts(gone)
    spread = sqrt(2 * burst * loss / (8 * count)) * 4  # samples of one burst are no independent evidence
    assert gone.mean() == pytest.approx(loss, abs=spread)
    assert length.mean() == pytest.approx(burst, rel=4 / sqrt(len(length)))


@pytest.mark.parametrize(("loss", "burst"), [(0.0, nan), (0.0, 4.0), (1.0, nan), (1.0, 3.0)])
def test_nothing_or_everything_is_lost(loss, burst):
    assert (lost(loss=loss, burst=burst, count=500) == bool(loss)).all()


def test_shortest_bursts_are_chance():
    assert (lost(loss=0.25, count=4000) == lost(loss=0.25, burst=1 / 0.75, count=4000)).all()


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
    for seq in order:
        alone.send(0, (seq, 0.1 * seq), seq, 0.1 * seq, start=0.0, size=100)
    got = [each for each in received(together) if each.link == 0]
    assert sorted(got) == sorted(other := received(alone))
    assert together.dropped[0] == alone.dropped[0] == 60 - len(other)


@pytest.mark.parametrize("other", [{"seed": 2}, {"link": 1}], ids=str)
def test_repetitions_and_links_lose_others(other):
    assert (lost(loss=0.3) & lost(loss=0.3, **other)).mean() == pytest.approx(0.09, abs=0.01)


# ---------------------------------------------------------------------- delay and jitter


@pytest.mark.parametrize("loss", [0.0, 0.5])
def test_delay_and_jitter(loss):
    made = channel(delay=0.02, jitter=0.03, loss=loss)
    send(made, range(1, 5001))
    extra = np.array([got.arrival - got.stamp - 0.02 for got in received(made)])
    assert extra.min() >= -1e-9
    assert extra.mean() == pytest.approx(0.03, rel=0.06)
    assert np.quantile(extra, 0.5) == pytest.approx(0.03 * log(2.0), rel=0.06)
    assert made.dropped == [5000 - len(extra)]
    assert (made.dropped[0] > 0) == (loss > 0.0)


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
    made = channel(delay=0.05)
    send(made, [0.0, 0.02])
    assert [[got.seq for got in received(made, t)] for t in (0.04, 0.05, 0.06, 0.08)] == [[], [1], [], [2]]


def test_forgotten_samples_never_arrive():
    made = Channel([conditions(link, delay=0.05) for link in range(3)])
    send(made, [0.0], links=range(3))
    made.forget(0)
    made.forget(2)
    assert [got.link for got in received(made)] == [1]
    made.forget(1)
    assert made.due(1.0) == []


# ---------------------------------------------------------------------- bandwidth


@pytest.mark.parametrize(
    ("size", "expected"), [(100, [0.105, 0.205, 0.305, 0.605]), (50, [0.055, 0.105, 0.155, 0.555])], ids=str
)
def test_narrow_link_takes_its_time(size, expected):
    made = channel(delay=0.005, bandwidth=8000.0, queue=10.0)  # 100 bytes take 0.1 s
    send(made, [0.0, 0.02, 0.04, 0.5], size=size)
    assert arrivals(made) == pytest.approx(expected, abs=1e-12)


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


def test_every_link_has_its_queue():
    made = Channel([conditions(0, bandwidth=8000.0, queue=10.0), conditions(1, queue=10.0)])
    send(made, [0.0] * 5, links=(0, 1))
    by_link = defaultdict(list)
    for got in received(made):
        by_link[got.link].append(got.arrival)
    assert by_link == {0: pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5]), 1: [0.0] * 5}
    assert made.limited


# ---------------------------------------------------------------------- outages, the start and the end


def test_nothing_passes_in_an_outage():
    made = Channel([conditions(0, delay=0.05, outages=((1.0, 2.0),)), conditions(1, delay=0.05)])
    send(made, [10.0 + 0.01 * k for k in range(300)], links=(0, 1), start=10.0)
    stamps = [round(got.stamp - 10.0, 6) for got in received(made) if got.link == 0]
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


# ---------------------------------------------------------------------- the two places


@pytest.mark.slow
@examples(25)
@given(st.integers(0, 2**32 - 1), st.lists(st.floats(0.0, 0.04), min_size=100, max_size=100))
def test_real_receiver_loses_what_virtual_does(seed, took):
    """The same sequence at both: as transmitted, and as it comes in over a real network."""
    values = {"delay": 0.05, "jitter": 0.02, "loss": 0.3, "burst": 3.0, "bandwidth": 40_000.0, "queue": 0.01}
    virtual, real = channel(seed=seed, **values), channel(seed=seed, **values)
    stamps = [0.02 * k for k in range(100)]
    send(virtual, stamps)
    # a publisher's samples come in order
    send(real, stamps, nows=np.maximum.accumulate(np.add(stamps, took)).tolist())
    one, other = ({got.seq: got.arrival for got in received(made)} for made in (virtual, real))
    assert one.keys() == other.keys()
    assert all(other[seq] >= one[seq] for seq in one)
    assert virtual.dropped == real.dropped
    assert virtual.dropped[0] > 0
