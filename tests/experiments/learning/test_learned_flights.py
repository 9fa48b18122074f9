"""Learned policies and triggers in flight: safety has the last word, and a learned trigger decides when to transmit."""

from math import isfinite

import pytest

from agents.decision.lifecycle import DONE
from agents.safety.hazards import Cause
from experiments.file import document
from experiments.virtual_time import stretch
from experiments.virtual_time.simulation import VirtualRun, simulate
from tests.agents.learned import learned

pytest.importorskip("onnxruntime", reason="policies are the extra [policy]: ./zenpark install onnxruntime")

# v = 3e38 t: enormous from the second decision on, and infinite a second later
WILD = learned(1, 2, weights=((3e38, 3e38),), observes="time", observes_each="")
# fires beyond 5 cm of deviation
HOARSE = learned(3, 1, bias=-0.05, weights=((1.0,), (0.0,), (0.0,)))


def test_wild_policies_end_landed(monkeypatch):
    monkeypatch.setattr(stretch, "WORK", [-1e6, 0.0])  # each sample is looked at
    law = f'formation.law={{kind="policy", model="{WILD}"}}'
    plan = document.load("policy", "duration_s=4.0", law).cases()["event"]
    flight, fastest, causes = VirtualRun(plan, 1), [], set()

    def look(_time):
        for robot, state in zip(flight.robots, flight.snapshot(flight.time).states, strict=True):
            low, high = robot.assignment.limits.low, robot.assignment.limits.high
            setpoint, place = robot.setpoint, state.true_position
            assert not isfinite(setpoint[0]) or all(low[k] <= setpoint[k] <= high[k] for k in range(3))
            assert all(low[k] - 0.1 <= place[k] <= high[k] + 0.1 for k in range(3))
            fastest.append(max(map(abs, state.velocity[:2])) / robot.assignment.kind.speed)

    flight.fly(landing=True, progress=look)
    for robot in flight.robots:
        causes |= {each.cause for each in robot.hazards.incidents}
        assert robot.lifecycle.phase == DONE
    assert Cause.SETPOINT in causes
    assert 0.5 < max(fastest) < 1.5
    assert max(state.true_position[2] for state in flight.snapshot(0.0).states) < 0.05


def test_learned_triggers_are_send_on_delta():
    """By the numbers of a threshold it transmits what send-on-delta does."""
    texts = f'{{kind="policy", model="{HOARSE}"}}', '{kind="send-on-delta", threshold=0.05}'
    sent = []
    for text in texts:
        plan = document.load("policy", "duration_s=2.0", f"cases.event.trigger={text}").cases()["event"]
        sent.append(simulate(plan, 3, landing=False).sent)
    assert len(sent[0].stamp) > 20
    assert (sent[0].stamp == sent[1].stamp).all()
