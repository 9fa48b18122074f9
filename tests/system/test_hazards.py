"""Hazards of real processes: what robots notice lands them, and becomes events of the run."""

import re

import pytest

from agents.network import pubsub
from experiments.recording import playback
from tests.system.lab import NEAR_TRIANGLE, Flight, RobotProcess, typed

pytestmark = pytest.mark.system

PAIR = """
title = "Two that want to be nearer than they may"
duration_s = 6.0
trigger = "periodic"
[robots]
A = {{ kind = "khepera4", start = [-0.3, 0.0] }}
B = {{ kind = "khepera4", start = [0.3, 0.0] }}
[formation]
links = {{ "A - B" = 0.3 }}
[safety]
{safety}
"""


def pair_file(folder, safety):
    file = folder / "pair.toml"
    file.write_text(PAIR.format(safety=safety))
    return file


def test_robot_too_near_holds_and_is_reported(tmp_path):
    folder = tmp_path / "run"
    flight = Flight(folder, pair_file(tmp_path, "separation = 0.5"))
    flight.until_said(r"hazard [AB]: hold: minimum separation: 0\.\d\d m from [AB] \(limit 0\.5 m\)")
    assert flight.finish()[0] == 0
    (file,) = folder.glob("*.mcap")
    trace = playback.read(file).trace
    for name in ("A", "B"):
        begins, ends = [event.text for event in trace.events if (event.kind, event.source) == ("hazard", name)]
        assert begins.startswith("hold: minimum separation: ")
        assert ends.startswith("unresolved at the end: minimum separation, for ")
    last = trace.true_position[-1]
    assert 0.4 < abs(last[0, 0] - last[1, 0]) < 0.51
    status = typed(file, "/A/status")[-1]
    assert [incident.text.partition(":")[0] for incident in status.incidents] == ["hold", "unresolved at the end"]


def test_drone_with_low_battery_lands_and_others_continue(tmp_path):
    folder = tmp_path / "run"
    low = "safety.battery_low=0.985"  # it flies for 7 minutes on a charge
    flight = Flight(folder, "triangle", "--case", "event", low, "duration_s=8")
    flight.until_said(r"hazard CF01: land: its battery is low: 98% \(limit 98%\)")
    assert flight.finish()[0] == 1
    assert "zenpark: Failed in event: CF01 at " in flight.said()
    played = playback.read(folder / "event.mcap")
    trace = played.trace
    said = [pose.position[2] for pose in typed(folder / "event.mcap", "/CF01/pose") if pose.stamp > played.started]
    hover = trace.plan.experiment.robots["CF01"].hover
    assert said, "it has flown"
    assert min(said) > hover - 0.1  # nobody follows it to the floor
    ends = {event.source: event.text for event in trace.events if event.kind == "robot"}
    assert ends["CF01"] == "done: its battery is low"
    assert ends["KH01"] == "done: finished"


def test_run_with_a_scripted_landing_succeeds(tmp_path):
    folder = tmp_path / "run"
    flight = Flight(folder, "triangle", "--case", "event", *NEAR_TRIANGLE, "robots.CF01.lands_at_s=2", "duration_s=5")
    code, _ = flight.finish()
    assert code == 0, flight.said()
    trace = playback.read(folder / "event.mcap").trace
    ends = {event.source: (event.stamp, event.text) for event in trace.events if event.kind == "robot"}
    assert ends["CF01"][1] == "done: lands as its file says"
    assert 2.0 < ends["CF01"][0] < 5.0 < ends["KH01"][0]


@pytest.mark.mechanism("hazard: conductor lost")
def test_robots_without_conductor_end_if_file_says_so(router, watcher, tmp_path):
    token = pubsub.alive_token(watcher.session, watcher.keys.conductor)
    with RobotProcess(router.endpoint, pair_file(tmp_path, 'lost_conductor = "land"'), "A", "B"):
        watcher.take_off("A", "B")
        token.undeclare()
        watcher.until_all("done", "A", "B")
        status = watcher.status["A"]
        assert status.reason == "the conductor is gone"
        silent = re.fullmatch(r"land: the conductor is gone: for (\d+\.\d+) s.*", status.hazard)
        assert float(silent[1]) >= 2.0
        assert [incident.text for incident in status.incidents] == [status.hazard]
