"""An emergency stop ends a run for good: who was stopped does not take off again for the next case."""

import json

import pytest

from experiments.real_time.conductor.orders import EmergencyStop
from experiments.real_time.hosts import run_registry
from experiments.recording import playback
from tests.system.lab import Flight
from tools.commands import orders as order_commands
from tools.commands import results

pytestmark = pytest.mark.system

TWO_CASES = """
title = "two that stay together"
duration_s = 90.0
[robots]
CF01 = { kind = "crazyflie", start = [-0.3, 0.0], hover = 0.5 }
KH01 = { kind = "khepera4", start = [0.3, 0.0] }
[formation]
gain = 1.0
[formation.links]
"CF01 - KH01" = 0.8
[cases.first]
trigger = { kind = "periodic", period_s = 0.02 }
[cases.second]
trigger = { kind = "send-on-delta", threshold = 0.01 }
"""


@pytest.fixture
def two_cases_file(tmp_path):
    made = tmp_path / "two.toml"
    made.write_text(TWO_CASES)
    return made


@pytest.mark.timeout(120)
def test_every_run_of_the_machine_ends_with_reason(two_cases_file, tmp_path, capsys):
    flight = Flight(tmp_path / "run", two_cases_file)
    flight.until_flown()
    other = Flight(tmp_path / "other", two_cases_file)
    other.until_flown()
    there = f"two that stay together, {flight.folder}"
    assert f"another run is up with robots of these names (CF01, KH01): {there}" in other.said()
    up = [[flight.endpoint()], [other.endpoint()]]
    assert [run.endpoints for run in run_registry.runs()] == up
    assert results.runs(as_json=True) is None
    assert [run["robots"] for run in json.loads(capsys.readouterr().out)] == [{"CF01": "", "KH01": ""}] * 2
    # without the default router: whoever else uses this machine has a run there
    assert order_commands.stop_all(order_commands.stops_of_all_runs(), dry_run=False, as_json=False) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"stopped: CF01, KH01 (two that stay together, {each.folder}, at {endpoint})"
        for each, (endpoint,) in zip((flight, other), up, strict=True)
    ]
    for each in (flight, other):
        each.until_said(r"stop conductor: emergency stop by operator: zenpark estop; the run ends here")
        assert each.finish()[0] == 1
        assert "zenpark: emergency stop by operator: zenpark estop" in each.said()
        assert "second: " not in each.said()
        assert [recording.name for recording in each.folder.glob("*.mcap")] == ["first.mcap"]
    assert run_registry.runs() == []
    trace = playback.read(flight.folder / "first.mcap").trace
    assert ("stop", "conductor") in {(event.kind, event.source) for event in trace.events}
    ends = {event.source: event.text for event in trace.events if event.kind == "robot" and "done" in event.text}
    assert ends["CF01"] == "done: emergency stop by operator: zenpark estop"


@pytest.mark.mechanism("emergency stop of a run")
@pytest.mark.timeout(120)
def test_before_the_common_start_too(two_cases_file, tmp_path):
    flight = Flight(tmp_path / "run", two_cases_file, "robots.CF01.hover=2.0", 'formation.links={"CF01 - KH01" = 2.2}')
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
    assert not (flight.folder / "second.mcap").exists()
