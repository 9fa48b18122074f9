"""Telemetry of robots that receive much, or do not know where they are."""

from copy import copy
from math import pi
from types import SimpleNamespace

import pytest

from agents.network import messages, pubsub
from agents.network.keys import Keys
from agents.robot import Robot
from agents.runtime.pose_inbox import MAX_UNREPORTED, PoseInbox
from agents.runtime.telemetry import Counts, TelemetryPublisher
from agents.vectors import UNKNOWN
from experiments.definition.plan import Plan
from tests.agents.runtime.process import twins
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


def test_waiting_receipts_are_bounded(a):
    a.receive(MAX_UNREPORTED + 500)
    assert len(a.inbox.unreported[0]) == MAX_UNREPORTED
    states = a.report(0.02)
    assert len(states) > 1
    assert [each.seq for state in states for each in state.received] == list(range(501, MAX_UNREPORTED + 501))
    assert {state.seq for state in states} == {1}


def test_reported_yaw_is_wrapped(a):
    (state,) = a.report(0.02, yaw=2000.0 * pi + 0.5, true_yaw=-2000.0 * pi + 0.5)
    assert (state.yaw, state.true_yaw) == pytest.approx((0.5, 0.5), abs=1e-9)
