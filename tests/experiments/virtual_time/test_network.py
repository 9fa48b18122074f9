"""The network in virtual time: delays, losses and sizes as the file has them, for poses and for goals."""

from math import inf

import numpy as np
import pytest

from agents.network import messages
from agents.robot import Robot
from experiments.definition.experiment import ChannelTable, LinkChannelTable, NetworkTable, Outage, RobotTable
from experiments.definition.plan import Plan
from experiments.recording.trace import EPOCH
from experiments.virtual_time.network import VirtualNetwork
from tests.small import small

DT = 0.01
LINKS = {"A - B": 0.5, "A > C": 0.5, "B > C": 0.5}  # A and B receive each other, C receives both
A_TO_B, B_TO_A, A_TO_C, B_TO_C = 1, 0, 2, 3


class Talk:
    """Robots that transmit their number and the time, tick by tick."""

    def __init__(self, channel, links=LINKS, *, seed=1, start=0.0, **more):
        robots = {name: RobotTable(kind="khepera4", start=[k, 0.0]) for k, name in enumerate("ABC")}
        plan = Plan(small(robots, links, duration_s=1e4, channel=channel, **more))
        self.robots = [Robot(plan.assignment(name)) for name in plan.names]
        self.network = VirtualNetwork(plan, self.robots, seed, lean=False)
        self.start, self.tick = start, 0

    def run(self, ticks, rows=()):
        """Some ticks: what arrived first, then these rows transmit."""
        for _ in range(ticks):
            t = self.tick * DT
            self.network.deliver(t)
            for row in rows:
                self.robots[row].sent_position = (float(row), t, 1.0)
                self.robots[row].sent_velocity = (-float(row), -t, -1.0)
                self.network.transmit(row, self.robots[row], t, 0.0, self.start)
            self.tick += 1
        return self

    @property
    def received(self):
        return self.network.logged(0.0)["received"]

    @property
    def lost(self):
        return self.network.logged(0.0)["lost"].tolist()


def test_each_receiver_gets_what_is_sent():
    talk = Talk(ChannelTable(delay_s=0.001)).run(1, [0, 2]).run(1)
    got = talk.received
    assert sorted(got.link.tolist()) == [A_TO_B, A_TO_C]
    assert got.position.tolist() == (-got.velocity).tolist() == [[0, 0, 1]] * 2
    assert (got.seq.tolist(), got.stamp.tolist(), got.arrival.tolist()) == ([1, 1], [0, 0], [0.001, 0.001])
    (known,) = talk.robots[1].neighbours.all
    assert (known.position, known.stamp, known.arrival) == ((0.0, 0.0, 1.0), 0.0, 0.001)
    silent = Talk(ChannelTable(loss=0.5, jitter_s=0.1), links={}).run(10, [0])
    assert (len(silent.received.link), silent.lost) == (0, [])


@pytest.mark.parametrize(("delay", "ticks"), [(0.0, 1), (0.01, 1), (0.07, 7), (0.071, 8)])
def test_delay_is_a_number_of_ticks(delay, ticks):
    talk, newest = Talk(ChannelTable(delay_s=delay)), []
    for _ in range(100):
        talk.run(1, [0])
        newest.append(talk.robots[1].neighbours.all[0].stamp)
    assert newest[ticks:] == pytest.approx(np.arange(100 - ticks) * DT)


def test_order_of_arrival_is_logged():
    got = Talk(ChannelTable(jitter_s=0.05)).run(200, [0, 1]).received
    assert (np.diff(got.arrival) >= 0.0).all()
    assert (np.diff(got.seq[got.link == A_TO_B]) < 0).any()  # some overtook others


def test_all_nothing_or_the_seeds_samples_are_lost():
    for loss, lost in ((0.0, 0), (1.0, 50)):
        talk = Talk(ChannelTable(loss=loss)).run(50, [0, 1, 2]).run(1)
        assert (talk.lost, len(talk.received.link)) == ([lost] * 4, 200 - 4 * lost)
    talks = [Talk(ChannelTable(loss=0.5), seed=seed).run(100, [0, 1]).run(1) for seed in (1, 1, 2)]
    first, again, other = (talk.received.seq.tolist() for talk in talks)
    assert first == again != other


def test_nothing_is_lost_before_the_start():
    channel = ChannelTable(loss=1.0, bandwidth=800.0, outages=[Outage(from_s=0.0)])
    talk = Talk(channel, start=0.5).run(60, [0])
    got = talk.received
    np.testing.assert_allclose(got.arrival - got.stamp, 0.001)
    assert (got.stamp.max(), talk.lost) == (pytest.approx(0.49), [0, 10, 10, 0])
    unknown = Talk(ChannelTable(loss=1.0), start=inf).run(60, [0])
    assert len(unknown.received.link) == 2 * 59


@pytest.mark.parametrize("encoding", ["json", "msgpack"])
def test_samples_have_their_size_on_the_wire(encoding):
    bandwidth = 10_000.0
    channel = ChannelTable(delay_s=0.0, bandwidth=bandwidth)
    got = Talk(channel, network=NetworkTable(encoding=encoding)).run(1, [0, 1]).run(40).received
    for link, row in ((A_TO_C, 0), (B_TO_A, 1)):
        pose = messages.pose("AB"[row], 1, EPOCH, [float(row), 0.0, 1.0], [-float(row), -0.0, -1.0], yaw=0.0)
        size = len(messages.encode(pose, encoding))
        assert size > 60
        assert got.arrival[got.link == link] == pytest.approx(8.0 * size / bandwidth, abs=1e-12)


def test_links_differ_by_name():
    own = {"A > C": LinkChannelTable(delay_s=0.05), "A - B": LinkChannelTable(loss=1.0)}
    talk = Talk(ChannelTable(delay_s=0.01, links=own)).run(20, [0, 1]).run(10)
    got = talk.received
    delays = {*zip(got.link.tolist(), (got.arrival - got.stamp).round(9).tolist(), strict=True)}
    assert (delays, talk.lost) == ({(A_TO_C, 0.05), (B_TO_C, 0.01)}, [20, 20, 0, 0])


def test_instant_network():
    for channel in ({"delay_s": 0.0}, {"delay_s": 0.0, "loss": 0.5}):
        assert Talk(ChannelTable(**channel)).network.instant
        for late in ({"jitter_s": 0.1}, {"bandwidth": 1e6}, {"delay_s": 0.001}):
            assert not Talk(ChannelTable(**channel | late)).network.instant


def test_poses_to_the_centre_are_lost_alike():
    talk = Talk(ChannelTable(loss=0.5), architecture="centralised").run(400, [0, 1, 2]).run(1)
    centre = talk.network.logged(0.0)["centre"]
    assert len(centre.received.link) + centre.lost_poses.sum() == 3 * 400
    assert centre.lost_poses / 400 == pytest.approx(0.5, abs=0.1)
