"""Every robot behind its real bridge and a protocol twin, in one command."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from experiments import playback
from experiments.launcher import LAND_S
from tests.system.lab import Flight, gone, until

pytestmark = pytest.mark.system


@pytest.mark.timeout(180)
def test_the_reference_experiment_flies_behind_real_bridges(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    flight = Flight(
        folder, "robotic-park", "--bodies", "protocol", "--case", "event", "--json", "--no-report",
        "--set", "duration_s=24", "--set", "timeline=[]",
    )  # fmt: skip
    flight.until_said(r"phase conductor: formation", 60.0)
    children = flight.children()
    bodies = {name: line for name in children for line in [children[name].cmdline()]}
    assert bodies["CF01"] == bodies["CF02"] == bodies["CF03"], "one radio, one process"
    addressed = json.loads((folder / "event-addressed.json").read_text())["robots"]
    assert addressed["CF01"]["body"].startswith("udp://127.0.0.1:")
    assert addressed["KH01"]["body"].startswith("khepera4://127.0.0.1:")
    assert addressed["TB01"]["body"].startswith(("ros2dds://", "rmw://"))
    everyone = list(children.values())
    code, out = flight.finish(90.0)
    assert code == 0
    until(lambda: gone(everyone), "nothing is left", LAND_S)
    robots = json.loads(out)["cases"]["event"]["robots"]
    assert all(robot["lost"] == 0 for robot in robots.values())
    followers = {name: robot for name, robot in robots.items() if name != "TB01"}
    assert all(robot["acquired_s"] is not None for robot in followers.values()), followers
    trace = playback.read(folder / "event.mcap").trace
    assert np.isfinite(trace.true_position).all(axis=(1, 2)).mean() > 0.98, "the truth is known"
    heights = trace.true_position[trace.time > 5.0][:, 4:, 2]
    assert np.abs(heights - 0.8).max() < 0.1
    last = trace.time > trace.time[-1] - 1.0
    rows = {name: row for row, name in enumerate(trace.robots)}
    for text, link in trace.experiment.formation.links.items():
        one, _, other = text.split()
        apart = np.linalg.norm(trace.true_position[last, rows[one]] - trace.true_position[last, rows[other]], axis=1)
        distance = link if isinstance(link, float) else link.distance
        assert np.abs(apart - distance).mean() < 0.05, text
