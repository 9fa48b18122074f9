"""Laws that remember and talk, in real processes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from experiments.recording import playback
from tests.system.lab import Flight, typed

pytestmark = pytest.mark.system


@pytest.mark.mechanism("words")
def test_robots_agree_on_an_average_in_real_time(tmp_path: Path) -> None:
    """With a fifth of the messages lost, in two processes of three robots."""
    groups = [
        part
        for number in range(1, 7)
        for part in ("--set", f"robots.KH0{number}.process={'even' if number % 2 == 0 else 'odd'}")
    ]
    flight = Flight(tmp_path / "run", "average", "--case", "event-loss", *groups, "--set", "duration_s=12")
    code, _ = flight.finish(120.0)
    assert code == 0, flight.said()
    file = tmp_path / "run" / "event-loss.mcap"
    trace = playback.read(file).trace
    end = trace.memory["x"][-5, :, 0]
    assert np.abs(end - 3.0).max() < 0.06, end
    assert np.abs(trace.memory["x"][0] - 3.0).max() > 1.0
    assert trace.measures["disagreement"].shape == (len(trace.time), 6)
    assert trace.dropped is not None
    assert trace.dropped.sum() > 0
    spoken = typed(file, "/KH01/spoken_pose")
    assert [each.name for each in spoken[-1].shared] == ["x", "q", "n"]
    assert len(typed(file, "/KH01/pose")) < len(spoken) / 3  # those before its first step
