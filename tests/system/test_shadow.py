"""Twins beside robots that stand behind real bridges: what they are off by is small, and known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.metrics.measure import measure
from experiments.recording import playback
from tests.system.lab import Flight

pytestmark = pytest.mark.system


def test_twins_shadow_a_crazyflie_and_a_khepera(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    flight = Flight(
        folder, "triangle", "--case", "periodic", "--json", "duration_s=4",
        "robots.CF01.body=crazyflie-twin", "robots.CF01.shadow={restart_s=1.5}",
        "robots.KH01.body=khepera4-twin", "robots.KH01.shadow={}",
    )  # fmt: skip
    code, out = flight.finish()
    assert code == 0, flight.said()
    assert json.loads(out)["cases"]["periodic"]["collisions"] == 0
    trace = playback.read(folder / "periodic.mcap").trace
    assert trace.shadow_position is not None
    known = np.isfinite(trace.shadow_position).all(axis=2).mean(axis=0)
    assert known.tolist() == [pytest.approx(1.0, abs=0.05), 0.0, pytest.approx(1.0, abs=0.05)]
    khepera, none, crazyflie = (robot.shadow for robot in measure(trace).robots)
    assert none is None
    assert khepera is not None
    assert crazyflie is not None
    assert (khepera.horizon_s, crazyflie.horizon_s) == (5.0, 1.5)
    moved = np.ptp(trace.position[:, [0, 2], :2], axis=0)
    assert (moved.max(axis=1) > 0.1).all()
    assert khepera.rmse < 0.03  # measured: 6 mm
    assert crazyflie.rmse < 0.05
    assert -0.05 < crazyflie.bias[2] < -0.01  # the law of the shadow does not overshoot its take-off
    for shadow, far in ((khepera, moved[0]), (crazyflie, moved[1])):
        axis = int(far.argmax())
        correlation = shadow.correlation[axis]
        assert correlation is not None
        assert correlation > 0.98
