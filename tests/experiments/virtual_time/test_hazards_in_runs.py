"""What goes wrong in a virtual run is in its trace and in its recording, and nothing is where nothing does."""

import numpy as np
import pytest

from agents.body.limits import Safety
from agents.decision.lifecycle import DONE, LANDING, RUNNING
from experiments.check.check import check
from experiments.definition.experiment import Formation, RobotTable
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.metrics.measure import measure
from experiments.recording import playback
from experiments.virtual_time.log import RunRecorder
from experiments.virtual_time.simulation import simulate
from tests.agents.few import pair
from tests.agents.swarm import changed


def events(log, experiment):
    trace = RunRecorder(log, Plan(experiment), "case").trace()
    return [(event.source, event.text) for event in trace.events if event.kind == "hazard"]


def test_a_run_without_trouble_has_no_incidents():
    experiment = changed(document.read("robotic-park").cases()["event"].experiment, duration_s=3.0, timeline=[])
    assert simulate(Plan(experiment), 1).incidents == ()


def test_robots_that_come_too_near_hold(tmp_path):
    experiment = pair(formation=Formation(links={"A - B": 0.3}), safety=Safety(separation=0.6), duration_s=8.0)
    log = simulate(Plan(experiment), 1)
    first, second = log.true_position[-1]
    assert np.linalg.norm(first - second) > 0.55
    found = events(log, experiment)
    assert {source for source, _ in found} == {"A", "B"}
    assert ("A", "hold: minimum separation: 0.60 m from B (limit 0.6 m)") in found
    book = RunRecorder(log, Plan(experiment), "case")
    book.record(tmp_path / "case.mcap", 'title = "A pair"')
    read = [event for event in playback.read(tmp_path / "case.mcap").trace.events if event.kind == "hazard"]
    assert {(event.source, event.text) for event in read} == set(found)
    assert all(0.0 < event.stamp <= 8.0 for event in read)  # the hold is unresolved at the end


@pytest.mark.slow
def test_drone_with_low_battery_lands_and_reports_it():
    robots = {
        "F": RobotTable(kind="crazyflie", start=[0.0, 0.0], hover=0.5),
        "G": RobotTable(kind="khepera4", start=[0.9, 0.1]),
    }
    experiment = pair(
        robots=robots, formation=Formation(links={"F > G": 0.8}), safety=Safety(battery_low=0.985), duration_s=12.0
    )
    log = simulate(Plan(experiment), 1)
    during = np.flatnonzero((log.time > 10.0) & (log.time < 12.0))
    assert (log.phase[during, 0] == DONE).all()
    assert (log.phase[during, 1] < DONE).all()
    found = events(log, experiment)
    assert found[0] == ("F", "land: its battery is low: 98% (limit 98%)")
    assert found[1:3] == [("G", "warn: a neighbour is lost: F"), ("G", "hold: all its neighbours are lost: F")]
    reasons = [status.reason for status in RunRecorder(log, Plan(experiment), "case").statuses()]
    assert reasons[:2] == ["land: its battery is low: 98% (limit 98%)", "finished"]


@pytest.mark.parametrize("architecture", ["distributed", "centralised"])
def test_drone_that_lands_is_lost_to_the_formation(architecture):
    robots = {
        "F": RobotTable(kind="crazyflie", start=[0.0, 0.0], hover=0.3),
        "G": RobotTable(kind="khepera4", start=[1.3, 0.1]),
        "H": RobotTable(kind="khepera4", start=[0.0, 0.9]),
    }
    formation, ends = Formation(links={"F > G": 0.8, "G - H": 0.9}), {}
    for low in (0.1, 0.99):
        experiment = pair(
            robots=robots, formation=formation, safety=Safety(battery_low=low), duration_s=12.0,
            architecture=architecture,
        )  # fmt: skip
        log = simulate(Plan(experiment), 1)
        ends[low] = log.true_position[np.searchsorted(log.time, 11.9), :, :2]
    lengths = {low: np.linalg.norm(end[1] - end[[0, 2]], axis=1) for low, end in ends.items()}
    for low, planar in ((0.1, np.sqrt(0.8**2 - 0.3**2)), (0.99, 0.89)):  # G stops on its way to a drone that is gone
        assert lengths[low] == pytest.approx([planar, 0.9], abs=0.02)


@pytest.mark.parametrize("architecture", ["distributed", "centralised"])
def test_scripted_landing_silences_and_loses_a_robot(architecture):
    robots = {
        "F": RobotTable(kind="crazyflie", start=[0.0, 0.0], hover=0.3, lands_at_s=4.0),
        "G": RobotTable(kind="khepera4", start=[1.3, 0.1]),
        "H": RobotTable(kind="khepera4", start=[0.0, 0.9]),
    }
    experiment = pair(
        robots=robots, formation=Formation(links={"F > G": 0.8, "G - H": 0.9}), duration_s=12.0,
        architecture=architecture,
    )  # fmt: skip
    log = simulate(Plan(experiment), 1)
    assert log.time[np.argmax(log.phase[:, 0] == LANDING)] == pytest.approx(4.0, abs=0.03)
    assert log.phase[np.searchsorted(log.time, 9.0)].tolist() == [DONE, RUNNING, RUNNING]
    assert log.sent.stamp[log.sent.link == 0].max() < 4.03
    if architecture == "distributed":
        assert ("G", "warn: a neighbour is lost: F") in events(log, experiment)
    reasons = [status.reason for status in RunRecorder(log, Plan(experiment), "case").statuses()]
    assert reasons[:3] == ["lands as its file says", "finished", "finished"]
    assert not measure(RunRecorder(log, Plan(experiment), "case").trace()).failures


FINDINGS = {
    "battery": ({"battery_low": 0.5}, "battery"),
    "cut": ({"cut_beyond_m": 0.2}, "cut-outside"),
    "start": ({"separation": 0.9}, "separation-start"),
    "link": ({"separation": 0.6}, "separation-link"),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", FINDINGS)
def test_check_finds_settings_that_make_no_sense(what, tmp_path):
    chosen, code = FINDINGS[what]
    settings = "\n".join(f"{name} = {value}" for name, value in chosen.items())
    file = tmp_path / "pair.toml"
    file.write_text(
        'title = "A pair"\nduration_s = 20.0\n[robots]\nA = { kind = "khepera4", start = [-0.4, 0.0] }\n'
        'B = { kind = "khepera4", start = [0.4, 0.0] }\n[formation]\nlinks = { "A - B" = 0.5 }\n'
        f"[safety]\n{settings}\n"
    )
    assert code in {finding.code for finding in check(document.read(file))}
