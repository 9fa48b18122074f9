"""Laws that remember at a central controller: the same theorems, and its memory in the recording."""

from __future__ import annotations

import numpy as np
import pytest

from agents.decision.centralised import ReceivedGoals
from agents.network import messages, validation
from agents.network.messages import Malformed
from experiments.file.document import load
from experiments.recording import playback
from experiments.run import simulate
from tests.experiments.virtual_time.test_gallery import flown, trace

CENTRALISED = "architecture=centralised"


@pytest.mark.slow
def test_centre_finds_the_average():
    known = trace("average", "periodic", CENTRALISED)
    assert np.abs(known.memory["x"][-1] - 3.0).max() < 1e-4
    assert np.abs(known.memory["x"][0] - 3.0).max() > 1.0
    assert known.measures["disagreement"].shape == (len(known.time), 6)
    own = trace("average", "periodic")
    assert known.memory["x"][-1] == pytest.approx(own.memory["x"][-1], abs=1e-3)


def test_centre_moves_robots_by_velocities():
    known = trace("consensus", "periodic", CENTRALISED)
    offset = np.array([*known.plan.experiment.formation.law["offset"].values()])
    place = known.true_position[..., :2] - offset
    mean = place.mean(axis=1)
    assert np.abs(mean - mean[0]).max() < 0.01
    assert np.linalg.norm(place - mean[:, None], axis=(1, 2))[-1] < 0.02


def test_guided_and_free_robots_meet():
    hybrid = 'architecture={ kind = "hybrid", robots = ["CF01", "CF03"] }'
    known = trace("consensus", "periodic", hybrid)
    offset = np.array([*known.plan.experiment.formation.law["offset"].values()])
    place = known.true_position[..., :2] - offset
    assert np.linalg.norm(place - place.mean(axis=1)[:, None], axis=(1, 2))[-1] < 0.03


@pytest.mark.slow
def test_leaders_say_their_velocity_at_the_centre():
    known = trace("leader-observer", "periodic", CENTRALISED)
    own = trace("leader-observer", "periodic")
    assert np.nanmax(known.measures["lag"][-1]) == pytest.approx(np.nanmax(own.measures["lag"][-1]), abs=0.01)


def test_memory_of_the_centre_is_recorded(tmp_path):
    run = simulate(load("average", CENTRALISED, "duration_s=4.0"), cases=["periodic"], folder=tmp_path)
    again = playback.read(tmp_path / "periodic.mcap").trace
    assert again.memory["x"] == pytest.approx(run.traces["periodic"].memory["x"], nan_ok=True)
    assert flown("average", "periodic", CENTRALISED)[0].sent.position.shape[0] > 0


def test_velocity_of_a_goal_is_checked_and_kept():
    plain = messages.Goal("A", 1, 2.0, (0.0, 0.0, 0.0), None, 2.0)
    assert messages.encode(plain, "json") == (
        b'{"robot":"A","seq":1,"stamp":2.0,"position":[0.0,0.0,0.0],"yaw":null,"pose":2.0}'
    )
    for velocity in ([0.1], [0.1, 99.0], [float("nan"), 0.0], [0.0] * 4):
        goal = messages.Goal("A", 1, 2.0, (0.0, 0.0, 0.0), None, 2.0, velocity)
        with pytest.raises(Malformed, match="velocity"):
            validation.check_goal(goal, now=2.0, valid_box=(1.0, 1.0, 1.0), oldest_s=1.0)
    assert messages.wanted((0.1, 0.2, float("nan"))) == [0.1, 0.2]
    assert messages.wanted((float("nan"),) * 3) is None
    guidance = ReceivedGoals(flies=True, silence_s=1.0)
    assert guidance.receive((0.0, 0.0, 1.0), 0.0, 1.0, (0.1, 0.0, 0.0))
    assert guidance.receive((0.0, 0.0, 1.0), 0.0, 2.0)
    assert np.isnan(guidance.velocity).all()
