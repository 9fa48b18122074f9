"""A pose of a neighbour wakes the loop between two ticks: on a simulated clock, and by Zenoh."""

import types

import pytest

from agents.body.fleet import assemble
from agents.network import messages, name_ownership, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from agents.runtime import descent, loop
from agents.runtime.loop import Phase, Runtime, Setup
from experiments.definition import bodies
from experiments.definition.plan import Plan
from tests.agents.few import pair
from tests.conftest import RouterProcess
from tests.fuzz.loopnet import Net, Sample
from tests.waiting import until

HZ, KEYS = 100.0, Keys("park")


class Stage:
    """A, alone in its process on a simulated clock; poses of B arrive at given times of it [s]."""

    def __init__(self, monkeypatch, net, arrivals, *, wake):
        self.now, self.net, self.arrivals, self.rung = 1000.0, net, list(arrivals), False
        self.known, self.ticks = [], []  # times of A: of the reception of each pose, of each tick
        self.stopped_at = float("inf")
        for module in (loop, descent):
            monkeypatch.setattr(module, "time", types.SimpleNamespace(sleep=self.wait))
        monkeypatch.setattr(pubsub, "Bell", lambda: self)
        for module in (loop, name_ownership):
            monkeypatch.setattr(module, "uptime", lambda: self.now)
        experiment = pair()
        body = assemble(bodies.body_request(Plan(experiment), ("A",), 1))
        setup = Setup(KEYS, [], "json", 50.0, lifeline=False, externally_measured=[False], wake=wake)
        self.runtime = Runtime([Plan(experiment).assignment("A")], body, setup)
        self.body = body
        self.seq = 0

    def ring(self):
        self.rung = True

    def wait(self, seconds):
        """As of a bell and of a sleep: only the former ends with the first ring."""
        rings, end = self.runtime._bell is not None, self.now + seconds
        while self.arrivals and self.arrivals[0] <= end - 1000.0:
            self.now = max(self.now, 1000.0 + self.arrivals.pop(0))
            self.seq += 1
            stamp = self.runtime._utc + self.now - 1000.0
            pose = messages.pose("B", self.seq, stamp, [0.4, 0.0, 0.0], [0.0] * 3, yaw=0.0)
            for channel in self.net.channels:
                if channel.key == KEYS.pose("B"):
                    channel.add(Sample(channel.key, messages.JSON, messages.encode(pose)))
            if self.now - 1000.0 >= self.stopped_at:
                self.runtime._cut_off = True
            if rings and self.rung:
                self.rung = False
                return True
        self.now = end
        return False

    def run(self, ticks):
        runtime = self.runtime
        runtime.subscribe_to_stops(self.net.session)
        self.body.open()
        runtime.join(self.net.session)
        runtime._utc = runtime._setup.clock.utc()
        (neighbour,) = runtime.robots[0].neighbours.all
        deliver, tick = runtime._neighbours.deliver, runtime.tick

        def delivered(t, utc):
            deliver(t, utc)
            if neighbour.arrival == t:
                self.known.append(t)

        def ticked(t):
            tick(t)
            self.ticks.append(t)

        runtime._neighbours.deliver, runtime.tick = delivered, ticked

        def stopping():
            if len(self.ticks) < ticks:
                return None
            runtime.robots[0].lifecycle.phase = int(Phase.DONE)
            return "enough"

        runtime.run_ticks(stopping)


@pytest.mark.parametrize(("wake", "known"), [(True, [0.013, 0.016, 0.052]), (False, [0.02, 0.06])])
def test_pose_between_ticks_wakes_loop(wake, known, monkeypatch):
    with Net().worn() as net:
        stage = Stage(monkeypatch, net, [0.013, 0.016, 0.052], wake=wake)
        stage.run(10)
    assert stage.known == pytest.approx(known)
    assert stage.ticks == pytest.approx([k / HZ for k in range(10)])
    assert stage.runtime.robots[0].tick == 10
    assert stage.runtime.counts.missed == 0


def test_stopped_robot_is_not_woken(monkeypatch):
    with Net().worn() as net:
        stage = Stage(monkeypatch, net, [0.013, 0.033], wake=True)
        stage.stopped_at = 0.033
        stage.run(10)
    assert stage.known[0] == pytest.approx(0.013)
    assert stage.known[1] >= 0.08  # on the tick after the pause that leaves the CPU to others


def test_rings_before_a_wait_are_one():
    bell = pubsub.Bell()
    bell.ring()
    bell.ring()
    assert bell.wait(0.0)
    assert not bell.wait(0.0)


@pytest.mark.system
def test_sample_rings_bell(router: RouterProcess):
    bell = pubsub.Bell()
    with network.open_session([router.endpoint], name="A") as a, network.open_session([router.endpoint], name="B") as b:
        poses = pubsub.pose_publisher(b, KEYS.pose("B"), messages.JSON)
        heard = pubsub.RingingSubscriber(a, KEYS.pose("B"), bell, depth=2)
        poses.put(b"first")
        assert bell.wait(10.0)
        until(lambda: (sample := heard.try_recv()) is not None and sample.payload.to_bytes() == b"first")
        assert heard.try_recv() is None
        for number in range(5):
            poses.put(str(number).encode())
        until(lambda: bell.wait(10.0) and heard.handler._waiting[-1].payload.to_bytes() == b"4")
        assert [sample.payload.to_bytes() for sample in network.received(heard)] == [b"3", b"4"]
        heard.undeclare()
