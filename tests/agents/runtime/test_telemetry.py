"""Telemetry of robots that receive much, or do not know where they are; and range readings on the network."""

from copy import copy
from math import nan, pi
from types import SimpleNamespace

import pytest

from agents.body.interface import BodyState, RangeScan
from agents.network import messages, pubsub, validation
from agents.network.keys import Keys
from agents.robot import Robot
from agents.runtime import range_inbox
from agents.runtime.pose_inbox import MAX_UNREPORTED, PoseInbox
from agents.runtime.telemetry import Counts, TelemetryPublisher
from agents.vectors import UNKNOWN
from experiments.definition.plan import Plan
from tests.agents.runtime.process import twins
from tests.fuzz.messages import sent
from tests.network import Net
from tests.small import pair

UTC, KEYS = 1_760_000_000.0, Keys()


class Reporter:
    """A of a pair, with receipts of poses of B."""

    def __init__(self, session):
        self.robot, self.body = Robot(Plan(pair()).assignment("A")), twins(pair(), "A")
        self.body.open()
        self.inbox = PoseInbox(session, KEYS, [self.robot], valid_box=(2.0, 2.0, 2.0))
        self.states = []
        self.telemetry = TelemetryPublisher(
            session, KEYS, "json",
            robots=[self.robot], neighbours=self.inbox, counts=Counts([0]), malformed=lambda: 0, ranged=[True],
        )  # fmt: skip
        self.telemetry.utc = UTC

    def receive(self, count):
        for seq in range(1, count + 1):
            at = UTC + 0.02 * seq
            self.inbox.unreported[0].append(messages.PoseReceipt("B", seq, at, at, (0.4, 0.1, 0.0), (0.123456, 0, 0)))

    def report(self, t, **changed):
        """One sample of telemetry, some values of the body's state `changed`."""
        state = copy(self.body.read(t)[0])
        for name, value in changed.items():
            setattr(state, name, value)
        self.robot.transmit(t, state)
        self.robot.act(t)
        self.states.clear()
        self.telemetry.send_states(t)
        return self.states


@pytest.fixture
def a(monkeypatch):
    def publisher(_session, key, _mime):
        def put(payload):
            if key == KEYS.state("A"):
                made.states.append(messages.decode(payload, messages.JSON, messages.State))

        return SimpleNamespace(put=put)

    with Net().worn() as net:
        monkeypatch.setattr(pubsub, "publisher", publisher)
        made = Reporter(net.session)
        yield made


def test_blind_robot_reports_received_poses(a):
    a.receive(100)
    (state,) = a.report(0.02, position=UNKNOWN)
    assert (state.position, len(state.received)) == (None, 100)
    assert not a.inbox.unreported[0]
    (state,) = a.report(0.04, velocity=UNKNOWN)
    assert state.position is not None
    assert (state.velocity, state.received) == (None, [])
    (state,) = a.report(0.06, yaw=2000.0 * pi + 0.5, true_yaw=-2000.0 * pi + 0.5)
    assert (state.yaw, state.true_yaw) == pytest.approx((0.5, 0.5), abs=1e-9)


def test_waiting_receipts_are_bounded(a):
    a.receive(MAX_UNREPORTED + 500)
    assert len(a.inbox.unreported[0]) == MAX_UNREPORTED
    states = a.report(0.02)
    assert len(states) > 1
    assert [each.seq for state in states for each in state.received] == list(range(501, MAX_UNREPORTED + 501))
    assert {state.seq for state in states} == {1}


def test_sweep_as_a_message():
    scan = RangeScan(2.5, (0.0, 0.5, 1.0), (0.0,) * 3, (0.12345678, nan, 1.0))
    ranges = range_inbox.message("KH01", 1000.0, scan)
    assert ranges == messages.Ranges("KH01", 1002.5, [0.0, 0.5, 1.0], [0.0, 0.0, 0.0], [0.123457, None, 1.0])
    validation.check_ranges(ranges, now=1002.5)


def test_newest_sweep_is_known_until_old():
    net = Net()
    inbox = range_inbox.RangeInbox(net.session, KEYS, ("CF01", "KH01"), [1])

    def known(at, *distance, robot="KH01", stamp=None):
        """The sweep that is known at a time [s], after one of that time or `stamp` was received."""
        angles = [0.0] * len(distance)
        message = messages.Ranges(robot, UTC + (stamp or at), angles, angles, list(distance))
        if distance:
            net.deliver(sent(KEYS.ranges("KH01"), message)[0])
        return inbox.read(UTC, at)[1]

    assert known(10.0) is None
    first = known(10.0, 0.5, None)
    assert first.distance == pytest.approx((0.5, nan), nan_ok=True)
    assert first.time == pytest.approx(10.0, abs=1e-6)
    assert known(10.5) is first, "nothing new costs nothing"
    states = [BodyState(), BodyState()]
    inbox.replace_scans(states, UTC, 10.5)
    assert [state.scan for state in states] == [None, first]
    assert known(10.5, 0.7, 0.8, stamp=9.5) is first, "it was overtaken"
    assert known(10.5, 0.7, 0.8, robot="CF01") is first
    assert (inbox.malformed, inbox.trouble) == (1, "ranges of 'CF01' on the key of 'KH01'")
    assert known(10.5, 0.9, stamp=10.2).distance == (0.9,)
    assert known(11.3) is None, "a second later it says nothing of where things are"
