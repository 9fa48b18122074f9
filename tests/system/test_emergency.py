"""An emergency stop ends a run for good: who was stopped does not take off again for the next case."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from agents.network import endpoints
from experiments.real_time.conductor.orders import EmergencyStop
from experiments.real_time.hosts import run_registry
from experiments.recording import playback
from tests.system.lab import Flight
from tools.commands import orders as order_commands
from tools.commands import results

pytestmark = pytest.mark.system

TWO_CASES = """
title = "two that stay together"
duration_s = {duration}
[robots]
CF01 = {{ kind = "crazyflie", start = [-0.3, 0.0], hover = {hover} }}
KH01 = {{ kind = "khepera4", start = [0.3, 0.0] }}
[formation]
gain = 1.0
[formation.links]
"CF01 - KH01" = {apart}
[cases.first]
trigger = {{ kind = "periodic", period_s = 0.02 }}
[cases.second]
trigger = {{ kind = "send-on-delta", threshold = 0.01 }}
"""


@pytest.mark.timeout(120)
def test_every_run_of_the_machine_ends_with_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file, folder = tmp_path / "two.toml", tmp_path / "run"
    file.write_text(TWO_CASES.format(duration=90.0, hover=0.5, apart=0.8))
    flight = Flight(folder, str(file), "--no-report")
    flight.until_said(r"phase conductor: formation", 60.0)
    other = Flight(tmp_path / "other", str(file), "--no-report")
    other.until_said(r"phase conductor: formation", 60.0)
    assert (
        f"another run is up with robots of these names (CF01, KH01): two that stay together, {folder}" in other.said()
    )
    up = [[flight.endpoint()], [other.endpoint()]]
    assert [run.endpoints for run in run_registry.runs()] == up
    monkeypatch.setattr(endpoints, "DEFAULT_ENDPOINT", flight.endpoint())  # whoever else uses this machine
    assert results.runs(as_json=True) is None
    assert [run["robots"] for run in json.loads(capsys.readouterr().out)] == [{"CF01": "", "KH01": ""}] * 2
    assert order_commands.estop() == 0
    assert capsys.readouterr().out.splitlines() == [
        f"stopped: CF01, KH01 (two that stay together, {each.folder}, at {endpoint})"
        for each, (endpoint,) in zip((flight, other), up, strict=True)
    ]
    other.until_said(r"stop conductor: emergency stop by operator: zenpark estop; the run ends here")
    assert other.finish()[0] == 1
    flight.until_said(r"stop conductor: emergency stop by operator: zenpark estop; the run ends here")
    code, _ = flight.finish()
    assert run_registry.runs() == []
    said = flight.said()
    assert code == 1
    assert "zenpark: emergency stop by operator: zenpark estop" in said
    assert "second: " not in said
    assert [each.name for each in folder.glob("*.mcap")] == ["first.mcap"]
    trace = playback.read(folder / "first.mcap").trace
    assert ("stop", "conductor") in {(event.kind, event.source) for event in trace.events}
    ends = {event.source: event.text for event in trace.events if event.kind == "robot" and "done" in event.text}
    assert ends["CF01"] == "done: emergency stop by operator: zenpark estop"


@pytest.mark.mechanism("emergency stop of a run")
@pytest.mark.timeout(120)
def test_before_the_common_start_too(tmp_path: Path) -> None:
    file, folder = tmp_path / "two.toml", tmp_path / "run"
    file.write_text(TWO_CASES.format(duration=30.0, hover=2.0, apart=2.2))
    flight = Flight(folder, str(file), "--no-report")
    flight.until_said(r"ready conductor: 2 robots", 60.0)
    # not by a process: on a busy machine its start takes as long as a climb, after which comes the common start
    stop = EmergencyStop([flight.endpoint()], "park", "operator")
    stop.send("person in arena")
    assert stop.failure is None
    assert (stop.seen, stop.moving) == ({"CF01", "KH01"}, set())
    code, out = flight.finish()
    assert code == 1
    assert "common start" not in flight.said()
    assert "emergency stop by operator: person in arena, before the common start" in out
    assert not (folder / "second.mcap").exists()
