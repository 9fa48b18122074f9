"""The network in virtual time: delays, jitter and losses as the file has them, each repetition with its own luck."""

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from agents.arrays import PoseTable
from agents.network import messages
from experiments.definition.experiment import Channel as Parameters
from experiments.definition.experiment import Experiment, LinkChannel, Network, Outage, Robot
from experiments.definition.graph import links
from experiments.recording.trace import EPOCH
from experiments.virtual_time.network import VirtualChannel

DT = 0.01
# 0 and 1 hear each other, 2 hears both
NET = links([(0, 1), (1, 0), (2, 0), (2, 1)], [1.0] * 4, [1.0] * 4)


def crowd(parameters, names="ABC", **parts):
    robots = {name: Robot(kind="khepera4", start=[0.0, 0.0]) for name in names}
    return Experiment(title="A crowd", duration_s=1e4, robots=robots, channel=parameters, **parts)


def sent(rows, seq, t, position):
    """Poses of rows that transmit."""
    now = np.full(len(rows), t)
    return PoseTable(rows, seq, now, now, position, -position, np.zeros(len(rows)))


class Talk:
    """Rows that say their number and the time, and what arrives of it."""

    def __init__(self, parameters, *, net=NET, names="ABC", seeds=(1,), start=0.0, **parts):
        rows = len(names)
        self.rows, self.seq, self.tick = rows * len(seeds), np.zeros(rows * len(seeds), dtype=np.intp), 0
        self.channel = VirtualChannel(crowd(parameters, names, **parts), net.repeated(len(seeds), rows), seeds)
        self.start = start
        self.heard = []

    def step(self, speak=()):
        """One tick: what arrived first, then what is said."""
        t = self.tick * DT
        if (got := self.channel.due(t)) is not None:
            self.heard.append((t, got))
        speak = np.array(speak, dtype=np.intp)
        if len(speak):
            self.seq[speak] += 1
            position = np.stack([np.arange(self.rows), np.full(self.rows, t), self.seq], axis=1).astype(float)
            self.channel.transmit(t, sent(speak, self.seq[speak], t, position[speak]), self.start)
        self.tick += 1

    def run(self, ticks, speak):
        for _ in range(ticks):
            self.step(speak)
        return self

    def all(self):
        """Everything that arrived, in order: when it was taken in, and the samples."""
        when = np.concatenate([np.full(len(got.link), t) for t, got in self.heard])
        return when, PoseTable.joined([got for _, got in self.heard])


def test_nothing_said_nothing_heard():
    talk = Talk(Parameters()).run(5, [])
    assert talk.heard == []


def test_every_listener_hears_what_was_said():
    talk = Talk(Parameters(delay_s=0.001))
    talk.step([0, 2])
    talk.step()
    ((t, got),) = talk.heard
    assert t == DT
    assert got.link.tolist() == [1, 2]  # 1 and 2 listen to 0; nobody listens to 2
    np.testing.assert_array_equal(got.position, [[0, 0, 1], [0, 0, 1]])
    np.testing.assert_array_equal(got.velocity, -got.position)
    assert got.seq.tolist() == [1, 1]
    np.testing.assert_array_equal(got.stamp, [0.0, 0.0])
    np.testing.assert_array_equal(got.arrival, [0.001, 0.001])


@pytest.mark.parametrize(("delay", "ticks"), [(0.0, 1), (0.001, 1), (0.01, 1), (0.02, 2), (0.07, 7), (0.071, 8)])
def test_a_delay_is_the_same_number_of_ticks_for_every_sample(delay, ticks):
    talk = Talk(Parameters(delay_s=delay)).run(500, [0])
    when, got = talk.all()
    np.testing.assert_array_equal(np.round((when - got.stamp) / DT), ticks)
    assert len(got.link) == 2 * (500 - ticks)
    np.testing.assert_array_equal(got.seq[got.link == 1], np.arange(1, 501 - ticks))


@pytest.mark.slow
def test_jitter_adds_an_exponential_with_its_mean():
    talk = Talk(Parameters(delay_s=0.005, jitter_s=0.03)).run(4000, [0, 1]).run(200, [])
    when, got = talk.all()
    extra = got.arrival - got.stamp - 0.005
    assert len(extra) == 4 * 4000
    assert extra.min() >= 0.0
    assert extra.mean() == pytest.approx(0.03, rel=0.03)
    assert extra.std() == pytest.approx(0.03, rel=0.05)
    assert np.quantile(extra, 0.5) == pytest.approx(0.03 * np.log(2.0), rel=0.05)
    assert (when - got.arrival >= -2e-6).all()
    assert (when - got.arrival < DT + 1e-9).all()


def test_what_arrives_is_in_order_of_arrival_though_not_of_sending():
    talk = Talk(Parameters(jitter_s=0.05)).run(500, [0, 1])
    for _, got in talk.heard:
        assert (np.diff(got.arrival) >= 0.0).all()
    _, got = talk.all()
    assert (np.diff(got.seq[got.link == 1]) < 0).any()  # some overtook others


@pytest.mark.slow
@pytest.mark.parametrize("loss", [0.1, 0.5])
def test_the_share_that_is_lost(loss):
    talk = Talk(Parameters(loss=loss)).run(5000, [0, 1]).run(2, [])
    _, got = talk.all()
    arrived = np.bincount(got.link, minlength=4)
    np.testing.assert_array_equal(arrived + talk.channel.dropped, 5000)
    np.testing.assert_allclose(talk.channel.dropped / 5000, loss, atol=0.025)
    together = np.isin(got.seq[got.link == 1], got.seq[got.link == 2]).mean()  # links lose independently
    assert together == pytest.approx(1.0 - loss, abs=0.03)


def test_everything_or_nothing():
    everything = Talk(Parameters(loss=1.0)).run(50, [0, 1, 2])
    assert everything.heard == []
    assert everything.channel.dropped.tolist() == [50] * 4
    nothing = Talk(Parameters(loss=0.0, jitter_s=0.001)).run(50, [0])
    assert not nothing.channel.dropped.any()


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_repetitions_have_the_luck_that_they_would_have_alone(seed):
    rng = np.random.default_rng(seed)
    parameters, seeds = Parameters(delay_s=0.004, jitter_s=0.02, loss=0.3), (11, 12, 13)
    speak = rng.random((40, 9)) < 0.15  # now one repetition speaks, now another
    together = Talk(parameters, seeds=seeds)
    for moment in speak:
        together.step(np.flatnonzero(moment))
    when, got = together.all()
    for copy, own in enumerate(seeds):
        alone = Talk(parameters, seeds=(own,))
        for moment in speak[:, 3 * copy : 3 * copy + 3]:
            alone.step(np.flatnonzero(moment))
        mine = got.link // 4 == copy
        np.testing.assert_array_equal(together.channel.dropped[4 * copy : 4 * copy + 4], alone.channel.dropped)
        if not alone.heard:
            assert not mine.any()
            continue
        moment, expected = alone.all()
        np.testing.assert_array_equal(when[mine], moment)
        np.testing.assert_array_equal(got.link[mine] - 4 * copy, expected.link)
        np.testing.assert_array_equal(got.arrival[mine], expected.arrival)
        np.testing.assert_array_equal(got.seq[mine], expected.seq)


def test_a_network_without_links():
    talk = Talk(Parameters(loss=0.5, jitter_s=0.1), net=links([], [], []), names="A").run(10, [0])
    assert talk.heard == []
    assert talk.channel.dropped.shape == (0,)


def test_nothing_is_lost_before_the_start_nor_waits_for_a_busy_link():
    talk = Talk(Parameters(loss=1.0, bandwidth=800.0, outages=[Outage(from_s=0.0)]), start=0.5).run(60, [0])
    _, got = talk.all()
    np.testing.assert_allclose(got.arrival - got.stamp, 0.001)
    assert got.stamp.max() == pytest.approx(0.49)
    assert talk.channel.dropped.tolist() == [0, 10, 10, 0]


def test_before_the_start_is_known_nothing_is_lost():
    talk = Talk(Parameters(loss=1.0), start=np.nan).run(60, [0])
    assert len(talk.all()[1].link) == 2 * 59


@pytest.mark.parametrize("encoding", ["json", "msgpack"])
def test_what_is_sent_has_the_size_that_it_has_on_the_wire(encoding):
    bandwidth = 10_000.0
    parameters = Parameters(delay_s=0.0, bandwidth=bandwidth)
    talk = Talk(parameters, start=0.0, network=Network(encoding=encoding))
    talk.step([0, 1])
    talk.run(40, [])
    _, got = talk.all()
    sizes = {}
    for row, name in enumerate("AB"):
        pose = messages.pose(name, 1, EPOCH, [float(row), 0.0, 1.0], [-float(row), -0.0, -1.0], 0.0)
        sizes[row] = len(messages.encode(pose, encoding))
    assert sizes[0] > 60
    for link, speaker in enumerate(NET.sender):
        assert got.arrival[got.link == link] == pytest.approx(8.0 * sizes[speaker] / bandwidth, abs=1e-12)


def test_links_differ_by_name():
    own = {"A > C": LinkChannel(delay_s=0.05), "A - B": LinkChannel(loss=1.0)}
    talk = Talk(Parameters(delay_s=0.01, links=own)).run(20, [0, 1]).run(10, [])
    _, got = talk.all()
    delay = got.arrival - got.stamp
    assert set(got.link.tolist()) == {2, 3}
    np.testing.assert_allclose(delay[got.link == 2], 0.05)
    np.testing.assert_allclose(delay[got.link == 3], 0.01)
    assert talk.channel.dropped.tolist() == [20, 20, 0, 0]


def test_the_default_is_what_it_was():
    assert msgspec.structs.asdict(Parameters()) == {
        "delay_s": 0.001, "jitter_s": 0.0, "loss": 0.0, "burst": None, "bandwidth": None, "queue_s": 0.5,
        "outages": [], "links": {},
    }  # fmt: skip


def test_what_goes_along_arrives_with_its_pose():
    channel = VirtualChannel(crowd(Parameters(delay_s=0.01, loss=0.4)), NET, [1], stream="goals")
    for k in range(100):
        place = np.full((2, 3), float(k))
        poses = sent(np.array([0, 1]), np.full(2, k), 0.02 * k, place)
        channel.transmit(0.02 * k, replace(poses, extra=place[:, :2] + 0.5), 0.0)
    got = channel.due(10.0)
    assert len(got.link) == 400 - channel.dropped.sum() < 300
    np.testing.assert_array_equal(got.extra, got.position[:, :2] + 0.5)


def test_streams_have_their_own_luck():
    gone = []
    for stream in ("", "goals"):
        channel = VirtualChannel(crowd(Parameters(loss=0.5)), NET, [1], stream=stream)
        gone.append(channel.lost(np.zeros(2000, dtype=np.intp), np.arange(2000)))
    assert (gone[0] & gone[1]).mean() == pytest.approx(0.25, abs=0.04)


@pytest.mark.parametrize(
    ("parameters", "instant"),
    [
        (Parameters(), False),
        (Parameters(delay_s=0.0), True),
        (Parameters(delay_s=0.0, loss=0.5), True),
        (Parameters(delay_s=0.0, jitter_s=0.1), False),
        (Parameters(delay_s=0.0, bandwidth=1e6), False),
    ],
)
def test_what_takes_no_time_is_known_at_once(parameters, instant):
    assert VirtualChannel(crowd(parameters), NET, [1]).instant == instant
