"""Faults of a virtual run are in its trace and in its recording; a run without faults has none."""

import numpy as np
import pytest

from agents.body.limits import Safety
from agents.decision.lifecycle import DONE, LANDING, RUNNING
from experiments.definition.experiment import Formation, RobotTable
from experiments.recording import playback
from tests.experiments.checked import findings
from tests.runs import fly
from tests.small import changed, pair, reference, small


def hazards(trace):
    return [(event.source, event.text) for event in trace.events if event.kind == "hazard"]


def three(hover=0.3, **of_drone):
    """A drone over one ground robot, which has another one beside it."""
    robots = {
        "F": RobotTable(kind="crazyflie", start=[0.0, 0.0], hover=hover, **of_drone),
        "G": RobotTable(kind="khepera4", start=[1.3, 0.1]),
        "H": RobotTable(kind="khepera4", start=[0.0, 0.9]),
    }
    return {"robots": robots, "formation": Formation(links={"F > G": 0.8, "G - H": 0.9}), "duration_s": 12.0}


def test_a_run_without_trouble_has_no_incidents():
    assert fly(changed(reference(), duration_s=3.0, timeline=[])).log.incidents == ()


def test_robots_that_come_too_near_hold(tmp_path):
    run = fly(pair(formation=Formation(links={"A - B": 0.3}), safety=Safety(separation=0.6), duration_s=8.0))
    first, second = run.log.true_position[-1]
    assert np.linalg.norm(first - second) > 0.55
    found = hazards(run.trace)
    assert {source for source, _ in found} == {"A", "B"}
    assert ("A", "hold: minimum separation: 0.60 m from B (limit 0.6 m)") in found
    run.recorder.record(tmp_path / "case.mcap", 'title = "A pair"')
    read = playback.read(tmp_path / "case.mcap").trace
    assert {*hazards(read)} == {*found}
    assert all(0.0 < event.stamp <= 8.0 for event in read.events if event.kind == "hazard")  # unresolved at the end


@pytest.mark.slow
def test_drone_with_low_battery_lands_and_reports_it():
    robots = {"F": "crazyflie", "G": RobotTable(kind="khepera4", start=[0.9, 0.1])}
    run = fly(small(robots, {"F > G": 0.8}, safety=Safety(battery_low=0.985), duration_s=12.0))
    during = run.log.phase[(run.log.time > 10.0) & (run.log.time < 12.0)]
    assert (during[:, 0] == DONE).all()
    assert (during[:, 1] < DONE).all()
    low = "land: its battery is low: 98% (limit 98%)"
    assert hazards(run.trace)[:3] == [
        ("F", low), ("G", "warn: a neighbour is lost: F"), ("G", "hold: all its neighbours are lost: F"),
    ]  # fmt: skip
    assert [status.reason for status in run.recorder.statuses()][:2] == [low, "finished"]


@pytest.mark.parametrize("architecture", ["distributed", "centralised"])
@pytest.mark.parametrize(
    ("low", "planar"),
    [(0.1, np.sqrt(0.8**2 - 0.3**2)), (0.99, 0.89)],  # G stops on its way to a drone that is gone
)
def test_drone_that_lands_is_lost_to_the_formation(architecture, low, planar):
    log = fly(pair(**three(), safety=Safety(battery_low=low), architecture=architecture)).log
    end = log.true_position[np.searchsorted(log.time, 11.9), :, :2]
    assert np.linalg.norm(end[1] - end[[0, 2]], axis=1) == pytest.approx([planar, 0.9], abs=0.02)


def test_tello_between_other_kinds_keeps_its_links():
    robots = {"K": "khepera4", "T": "tello", "F": "crazyflie"}
    run = fly(small(robots, {"K > T": 0.8, "F - T": 0.6}, duration_s=15.0))
    assert not hazards(run.trace)
    end = run.log.true_position[np.searchsorted(run.log.time, 14.9)]
    assert [np.linalg.norm(end[1] - end[k]) for k in (0, 2)] == pytest.approx([0.8, 0.6], abs=0.05)


@pytest.mark.parametrize("architecture", ["distributed", "centralised"])
def test_scripted_landing_silences_and_loses_a_robot(architecture):
    run = fly(pair(**three(lands_at_s=4.0), architecture=architecture))
    log = run.log
    assert log.time[np.argmax(log.phase[:, 0] == LANDING)] == pytest.approx(4.0, abs=0.03)
    assert log.phase[np.searchsorted(log.time, 9.0)].tolist() == [DONE, RUNNING, RUNNING]
    assert log.sent.stamp[log.sent.link == 0].max() < 4.03
    assert architecture == "centralised" or ("G", "warn: a neighbour is lost: F") in hazards(run.trace)
    reasons = [status.reason for status in run.recorder.statuses()]
    assert reasons[:3] == ["lands as its file says", "finished", "finished"]
    assert not run.metrics.failures


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "code"),
    [
        ({"battery_low": 0.5}, "battery"),
        ({"cut_beyond_m": 0.2}, "cut-outside"),
        ({"separation": 0.9}, "separation-start"),
        ({"separation": 0.6}, "separation-link"),
    ],
)
def test_check_finds_settings_that_make_no_sense(settings, code):
    assert code in findings(pair(safety=Safety(**settings), duration_s=20.0))
