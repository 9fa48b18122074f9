"""Telemetry of robots that hear much, or do not know where they are."""

from __future__ import annotations

from copy import copy
from math import pi

import pytest

from agents.network import messages, pubsub
from agents.network.keys import Keys
from agents.robot import Robot as Decision
from agents.runtime.pose_inbox import MAX_UNREPORTED, PoseInbox
from agents.runtime.telemetry import Counts, TelemetryPublisher
from agents.vectors import UNKNOWN
from experiments.definition import bodies
from experiments.definition.plan import Plan
from tests.agents.few import pair
from twins.body import TwinBody

UTC = 1_760_000_000.0


class Taken:
    """In the place of a publisher, or of a subscriber to which nobody speaks."""

    def __init__(self) -> None:
        self.states: list[messages.State] = []
        self.waiting: list[object] = []

    def put(self, payload: bytes) -> None:
        self.states.append(messages.decode(payload, messages.JSON, messages.State))

    @property
    def handler(self) -> Taken:
        return self

    def try_recv(self) -> None:
        return None


class Robot:
    """A of a pair, with what it hears of B put into its ears."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        for name in ("publisher", "pose_publisher", "pose_subscriber", "AliveWatch"):
            monkeypatch.setattr(pubsub, name, lambda *_: Taken())
        experiment = pair()
        self.decision = Decision(Plan(experiment).assignment("A"))
        self.body = TwinBody(bodies.body_request(Plan(experiment), ("A",), 1))
        self.body.open()
        nowhere = None
        self.neighbours = PoseInbox(nowhere, Keys(), [self.decision], valid_box=(2.0, 2.0, 2.0))  # type: ignore[arg-type]
        self.telemetry = TelemetryPublisher(
            nowhere, Keys(), "json",  # type: ignore[arg-type]
            robots=[self.decision], neighbours=self.neighbours, counts=Counts(1), malformed=lambda: 0, ranged=[True],
        )  # fmt: skip
        self.telemetry.utc = UTC

    def hear(self, count: int, first: int = 1) -> None:
        for seq in range(first, first + count):
            self.neighbours.unreported[0].append(
                messages.PoseReceipt(
                    "B", seq, UTC + 0.02 * seq, UTC + 0.02 * seq, (0.4, 0.1, 0.0), (0.123456, 0.0, 0.0)
                )
            )

    def tell(self, t: float, **changed: object) -> list[messages.State]:
        """One sample of telemetry, some values of the body's state `changed`."""
        state = copy(self.body.read(t)[0])
        for name, value in changed.items():
            setattr(state, name, value)
        self.decision.transmit(t, state)
        self.decision.act(t)
        (publisher,) = self.telemetry._states
        publisher.states.clear()
        self.telemetry.send_states(t)
        return publisher.states


@pytest.fixture
def robot(monkeypatch: pytest.MonkeyPatch) -> Robot:
    return Robot(monkeypatch)


def test_blind_robot_reports_received_poses(robot: Robot) -> None:
    robot.hear(100)
    (said,) = robot.tell(0.02, position=UNKNOWN)
    assert (said.position, len(said.received)) == (None, 100)
    assert not robot.neighbours.unreported[0]
    (said,) = robot.tell(0.04)
    assert said.position is not None
    assert said.received == []


def test_waiting_receipts_are_bounded(robot: Robot) -> None:
    robot.hear(MAX_UNREPORTED + 500)
    assert len(robot.neighbours.unreported[0]) == MAX_UNREPORTED
    states = robot.tell(0.02)
    assert len(states) > 1
    assert [each.seq for state in states for each in state.received] == list(range(501, MAX_UNREPORTED + 501))
    assert {state.seq for state in states} == {1}


def test_unknown_velocity_is_reported_as_none(robot: Robot) -> None:
    (said,) = robot.tell(0.02, velocity=UNKNOWN)
    assert said.velocity is None
    assert said.position is not None


def test_reported_yaw_is_wrapped(robot: Robot) -> None:
    (said,) = robot.tell(0.02, yaw=2000.0 * pi + 0.5, true_yaw=-2000.0 * pi + 0.5)
    assert said.yaw == pytest.approx(0.5, abs=1e-9)
    assert said.true_yaw == pytest.approx(0.5, abs=1e-9)
