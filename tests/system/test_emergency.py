"""An emergency stop ends a run for good: who was stopped does not take off again for the next case."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from agents.network import endpoints
from agents.runtime import run_registry
from experiments.recording import playback
from tests.system.lab import ENVIRONMENT, ROOT, Flight
from tools.commands import orders as order_commands
from tools.commands import results

pytestmark = pytest.mark.system

TWO_CASES = """
title = "two that stay together"
duration_s = {duration}
[robots]
CF01 = {{ kind = "crazyflie", start = [-0.3, 0.0], hover = 0.5 }}
KH01 = {{ kind = "khepera4", start = [0.3, 0.0] }}
[formation.links]
"CF01 - KH01" = 0.8
[cases.first]
trigger = {{ kind = "periodic", period_s = 0.02 }}
[cases.second]
trigger = {{ kind = "send-on-delta", threshold = 0.01 }}
"""


def estop(endpoint: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "tools.guard", "estop", "--connect", endpoint, "--reason", "person in arena"]
    return subprocess.run(command, cwd=ROOT, env=ENVIRONMENT, capture_output=True, text=True, check=False, timeout=30)


@pytest.mark.timeout(120)
def test_every_run_of_the_machine_ends_says_why_and_no_other_case_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file, folder = tmp_path / "two.toml", tmp_path / "run"
    file.write_text(TWO_CASES.format(duration=90.0))
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
    assert order_commands.estop(reason="person in arena") == 0
    assert capsys.readouterr().out.splitlines() == [
        f"stopped: CF01, KH01 (two that stay together, {each.folder}, at {endpoint})"
        for each, (endpoint,) in zip((flight, other), up, strict=True)
    ]
    other.until_said(r"stop conductor: emergency stop by operator: person in arena; the run ends here")
    assert other.finish()[0] == 1
    flight.until_said(r"stop conductor: emergency stop by operator: person in arena; the run ends here")
    code, _ = flight.finish()
    assert run_registry.runs() == []
    said = flight.said()
    assert code == 1
    assert "zenpark: emergency stop by operator: person in arena" in said
    assert "second: " not in said
    assert [each.name for each in folder.glob("*.mcap")] == ["first.mcap"]
    trace = playback.read(folder / "first.mcap").trace
    assert ("stop", "conductor") in {(event.kind, event.source) for event in trace.events}
    ends = {event.source: event.text for event in trace.events if event.kind == "robot" and "done" in event.text}
    assert ends["CF01"] == "done: emergency stop by operator: person in arena"


@pytest.mark.mechanism("emergency stop of a run")
@pytest.mark.timeout(120)
def test_before_the_common_start_too(tmp_path: Path) -> None:
    file, folder = tmp_path / "two.toml", tmp_path / "run"
    file.write_text(TWO_CASES.format(duration=30.0))
    flight = Flight(folder, str(file), "--no-report")
    flight.until_said(r"ready conductor: 2 robots", 60.0)
    assert estop(flight.endpoint()).stdout == "stopped: CF01, KH01\n"
    code, out = flight.finish()
    assert code == 1
    assert "common start" not in flight.said()
    assert "emergency stop by operator: person in arena, before the common start" in out
    assert not (folder / "second.mcap").exists()
