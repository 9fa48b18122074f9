"""Who says where robots are dies in mid-run: it is started again, and what cannot be is told."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest

from experiments.recording import playback
from tests.system.lab import Flight, Watcher

pytestmark = pytest.mark.system

PAIR = """
title = "one leads, measured from outside"
duration_s = 30.0
positioning = "vicon-twin"
trigger = { kind = "periodic", period_s = 0.02 }
[robots]
TB01 = { kind = "turtlebot3", body = "turtlebot3-twin", position = "external", start = [0.0, 0.0] }
KH01 = { kind = "khepera4", start = [-0.5, 0.0] }
[formation.links]
"TB01 > KH01" = 0.5
[[timeline]]
at_s = 0.5
robot = "TB01"
plan = { kind = "line", move_by = [0.8, 0.0], speed = 0.2 }
"""


@pytest.mark.timeout(120)
def test_positioning_is_restarted_and_devices_end_is_reported(tmp_path: Path) -> None:
    file, folder = tmp_path / "pair.toml", tmp_path / "run"
    file.write_text(PAIR)
    flight = Flight(folder, str(file), "--json", "--no-report")
    flight.until_said(r"phase conductor: TB01 under way", 60.0)
    watcher = Watcher(flight.endpoint())
    watcher.until(lambda: "TB01" in watcher.state and watcher.state["TB01"].position[0] > 0.1, "the leader drives")
    flight.children()["vicon"].kill()
    flight.until_said(
        r"vicon conductor: the vicon ended \(killed by SIGKILL\); started again: robots without a position"
    )
    watcher.until(lambda: watcher.state["TB01"].position[0] > 0.4, "it goes on")
    flight.children()["vicon-twin"].kill()
    flight.until_said(r"device conductor: the vicon-twin ended \(killed by SIGKILL\); robots that need it hold")
    watcher.close()
    flight.signal(signal.SIGINT)
    code, said = flight.finish()
    assert code == 130, said
    trace = playback.read(folder / "default.mcap").trace
    last = trace.true_position if np.isfinite(trace.true_position).all() else trace.position
    assert 0.4 < np.nanmax(last[:, 0, 0]) < 0.85
    events = [(event.kind, event.source) for event in trace.events if event.kind in {"vicon", "device"}]
    assert events[0] == ("vicon", "conductor")
    assert ("device", "conductor") in events
