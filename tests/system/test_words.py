"""Laws that remember and talk, in real processes."""

import numpy as np
import pytest

from experiments.recording import playback
from tests.system.lab import Flight, Watcher, typed

pytestmark = pytest.mark.system

RUN_S = 20.0


@pytest.mark.mechanism("words")
def test_robots_agree_on_an_average_in_real_time(tmp_path):
    """With a fifth of the messages lost, in two processes of three robots."""
    groups = [f"robots.KH0{number}.process={'odd' if number % 2 else 'even'}" for number in range(1, 7)]
    flight = Flight(tmp_path / "run", "average", "--case", "event-loss", *groups, "duration_s=9")
    code, _ = flight.finish(120.0)
    assert code == 0, flight.said()
    file = tmp_path / "run" / "event-loss.mcap"
    trace = playback.read(file).trace
    end = trace.memory["x"][-5, :, 0]
    assert np.abs(end - 3.0).max() < 0.06, end
    assert np.abs(trace.memory["x"][0] - 3.0).max() > 1.0
    assert trace.measures["disagreement"].shape == (len(trace.time), 6)
    assert trace.dropped.sum() > 0
    spoken = typed(file, "/KH01/spoken_pose")
    assert [each.name for each in spoken[-1].shared] == ["x", "q", "n"]
    assert len(typed(file, "/KH01/pose")) < len(spoken) / 3  # those before its first step


@pytest.mark.mechanism("words: restart")
def test_a_restarted_robot_joins_without_drawing_the_others(tmp_path):
    """The first words of a restarted robot are a step old; the others keep to their average meanwhile."""
    words = ("--case", "periodic", 'on_loss="restart"', f"duration_s={RUN_S}")
    flight = Flight(tmp_path / "run", "average", *words)
    flight.until_flown()
    agreed = RUN_S / 2.0  # they have agreed by then
    with Watcher(flight.endpoint()) as watcher:
        state, status = watcher.state, watcher.status
        watcher.until(lambda: state["KH03"].stamp > status["KH03"].started + agreed > agreed, "half of it is over")
        flight.children()["KH03"].kill()
        code, _ = flight.finish(120.0)
    assert code in (0, 1), flight.said()  # a robot was lost
    file = tmp_path / "run" / "periodic.mcap"
    trace = playback.read(file).trace
    x, late = trace.memory["x"][..., 0], trace.time > agreed
    others = np.delete(x[late], 2, axis=1)
    assert np.nanmax(np.abs(others - 3.0)) < 0.45, np.nanmax(np.abs(others - 3.0))
    assert np.abs(x[-5] - 3.0).max() < 0.06, x[-5]
