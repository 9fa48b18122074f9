"""Robots that know their places by cameras alone: images of a twin over HTTP, detection, fusion, and a run."""

import numpy as np
import pytest

from tests.bridges.motion_capture.cameras_lab import text
from tests.system.lab import Flight, assert_formed

EXPERIMENT = """
title = "Kheperas seen by two webcams"
duration_s = 12.0
positioning = "cameras-twin://cameras.toml"
safety.position_timeout_s = 2.0   # machines of tests are busy
start.deadline_s = 60.0
robots.KH01 = { kind = "khepera4", body = "khepera4-twin", position = "external", start = [-0.3, 0.0] }
robots.KH02 = { kind = "khepera4", body = "khepera4-twin", position = "external", start = [0.3, 0.2] }
[formation.links]
"KH01 - KH02" = 0.5
"""


@pytest.mark.mechanism("positions by cameras")
@pytest.mark.system
def test_robots_drive_by_cameras(tmp_path):
    (tmp_path / "seen.toml").write_text(EXPERIMENT)
    bodies = {"KH01": (1, 0.2, 0.06, True), "KH02": (2, 0.2, 0.06, True)}
    (tmp_path / "cameras.toml").write_text(text(bodies, "AC", 8.0, size=(800, 600), view_deg=71.08))
    flight = Flight(tmp_path / "run", tmp_path / "seen.toml", "--json")
    flight.until_flown()
    assert {"cameras", "cameras-twin"} <= flight.children().keys()
    code, _ = flight.finish(120.0)
    assert code == 0, flight.said()
    trace = flight.read("default").trace
    late = trace.time > trace.time[-1] - 1.0
    away = np.linalg.norm(trace.position[late] - trace.true_position[late], axis=-1)
    assert np.nanmedian(away) < 0.005
    assert_formed(trace, 0.02, since_s=trace.time[-1] - 1.0)
