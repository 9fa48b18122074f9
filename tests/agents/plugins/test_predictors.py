"""Beliefs: the same place at both ends of a link, and the horizon."""

import pytest

from agents.decision.neighbours import Incoming, Neighbours
from agents.kinds.khepera4 import KHEPERA4
from agents.plugins import registry
from agents.plugins.predictors import HOLD, ConstantVelocity, HoldPrediction
from agents.plugins.triggers import LastEvent


def test_both_are_registered():
    assert {"hold", "constant-velocity"} <= set(registry.names(registry.PREDICTORS))
    assert registry.build(registry.PREDICTORS, "hold") == HOLD == HoldPrediction()


@pytest.mark.parametrize(("age", "seconds"), [(-0.5, 0.0), (0.0, 0.0), (1.0, 1.0), (2.0, 2.0), (9.0, 2.0)])
def test_constant_velocity_goes_on_until_its_horizon(age, seconds):
    sent = LastEvent()
    sent.position, sent.velocity = (1.0, 2.0, 3.0), (1.0, -2.0, 0.5)
    predictor = ConstantVelocity(horizon_s=2.0)
    assert predictor.position(sent, age) == pytest.approx((1.0 + seconds, 2.0 - 2.0 * seconds, 3.0 + 0.5 * seconds))
    assert predictor.velocity(sent, age) == (sent.velocity if age < 2.0 else (0.0, 0.0, 0.0))
    assert ConstantVelocity().position(sent, 9.0) == pytest.approx((10.0, -16.0, 7.5))


def test_reach_is_the_horizon():
    assert HOLD.reach() == ConstantVelocity().reach() == float("inf")
    assert ConstantVelocity(horizon_s=2.0).reach() == 2.0


def test_received_pose_counts_from_its_stamp():
    neighbours = Neighbours([Incoming(0, "B", KHEPERA4, 1.0)], 1.0)
    (sender,) = neighbours.all
    neighbours.receive(0, (1.0, 0.0, 0.0), (0.1, 0.0, 0.0), 4.0, 4.4)  # the delay of the network is made up for
    neighbours.mark_alive(0)
    assert sender.place(ConstantVelocity(), 5.0) == pytest.approx((1.1, 0.0, 0.0))
    assert sender.place(HOLD, 5.0) == (1.0, 0.0, 0.0)
    neighbours.mark_lost(0, 4.5)
    assert sender.place(ConstantVelocity(), 9.0) == pytest.approx((1.05, 0.0, 0.0))
