"""Directed scripts: each sentence here was once wrong in a whole run, with all its processes."""

import re

import pytest

from tests.simulated.experiments import MIX
from tests.simulated.faults import Fault
from tests.simulated.laboratory import Flight, fly
from tests.simulated.small import TRIO

SPAN_S = 8.0
pytestmark = pytest.mark.slow


def triangle(*script: Fault, **options) -> Flight:
    """Two Kheperas and a Crazyflie, for eight seconds."""
    settings = [f"duration_s={SPAN_S:g}", *options.pop("settings", [])]
    return fly("triangle", *script, case="event", settings=settings, **options)


def test_run_without_faults_is_good():
    flight = triangle()
    assert (flight.code, flight.violations, flight.crashes) == (0, [], [])
    assert [case["case"] for case in flight.metrics] == ["event"]
    assert {each.code for each in flight.processes} == {0}
    for name in ("KH01", "KH02", "CF01"):
        assert abs(flight.robots[name].entered("running")[0]) < 0.021, name
    assert SPAN_S < flight.robots["CF01"].off() < SPAN_S + 2.5


def test_former_owner_is_silent_when_it_is_back():
    flight = triangle(Fault(1.0, "cut", "KH02", lasts=3.0), Fault(2.4, "twice", "KH02"))
    former, second = flight.of("KH02")[0], flight.of("second KH02")[0]
    track = flight.robots["KH02"]
    assert [t for t, pid in track.poses if pid == second.pid]
    assert not [t for t, pid in (*track.poses, *track.commands) if pid == former.pid and t > 4.2]
    assert former.code == 2
    assert flight.violations == []


def test_recorder_killed_before_its_file_costs_no_result():
    flight = triangle(Fault(0.027, "kill", "recorder", since="launch"))
    assert "event.mcap" in flight.files
    assert not [file for file in flight.files if "part2.mcap" in file]
    assert flight.metrics is not None
    assert flight.code in {0, 1}, flight.output


def test_robot_that_is_left_out_delays_nobody():
    late = ['robots.KH02.position="external"', 'start.missing="go-on"', "start.deadline_s=3.0"]
    flight = triangle(Fault(0.0, "capture", "KH02", "gone", since="launch"), settings=late)
    assert flight.code == 1
    assert "takes no part" in flight.output
    assert flight.started < 3.0 + 5.0 + 6.0
    assert flight.ended < SPAN_S + 5.0


def test_robot_that_begins_early_fails_the_run():
    flight = triangle(Fault(0.3, "order", "KH01", "start", since="ready"))
    began = flight.robots["KH01"].entered("running")[0]
    assert began < -0.5
    assert flight.code == 1
    assert flight.happened("failed", "KH01", "before the common start")


def test_robot_with_a_slow_clock_is_counted():
    flight = triangle(clocks={"KH02": -4.5})
    began = flight.robots["KH02"].entered("running")
    assert (began and began[0] < 0.1) or flight.code == 1, flight.describe()


def test_recording_of_one_state_period_is_no_traceback():
    flight = triangle(Fault(0.02, "pause", "recorder", lasts=1.0), Fault(0.8, "kill", "recorder"))
    assert flight.crashes == []
    assert "Traceback" not in flight.output


def test_robot_that_an_operator_held_spoils_the_run():
    flight = triangle(Fault(0.5, "order", "KH02", "hold"), Fault(7.5, "order", "KH02", "resume"))
    assert [answer.code for answer in flight.answers] == [0, 0]
    assert flight.code == 3


def test_robot_that_an_operator_removed_spoils_the_run():
    flight = triangle(Fault(2.0, "order", "KH02", "remove"))
    assert flight.answers[0].code == 0
    assert flight.code == 3


def test_emergency_stop_cuts_motors_at_once():
    flight = triangle(Fault(2.0, "estop"))
    assert flight.answers[0].code == 0
    assert "stopped: CF01, KH01, KH02" in flight.answers[0].output
    assert 2.0 <= flight.robots["CF01"].off(after=2.0) < 2.3
    assert flight.code == 1


def test_run_without_any_recorder_does_not_begin():
    flight = triangle(Fault(0.01, "disk", "recorder", "full", since="launch"))
    assert (flight.code, flight.started) == (2, None)
    assert "nothing would be recorded" in flight.output
    assert flight.violations == []


def test_recorder_is_awaited_before_the_start():
    flight = triangle(Fault(0.5, "kill", "recorder", since="ready"))
    assert flight.code == 0, flight.output
    assert flight.metrics[0]["planned_s"] == SPAN_S


def test_drone_found_aloft_is_down_when_done():
    flight = fly(MIX, Fault(4.1, "kill", "C"), case="world")
    former, later = flight.of("world-C")
    done = [each.t for each in flight.robots["C"].phases if (each.phase, each.pid) == ("done", later.pid)]
    assert (former.code, later.code) == (-9, 0)
    assert done[0] >= flight.robots["C"].off(after=4.1)
    assert flight.violations == []


def test_world_lands_drone_of_frozen_process():
    thawed = 8.0
    flight = fly(MIX, Fault(0.5, "pause", "C", lasts=thawed - 0.5), case="world", settings=["duration_s=10"])
    robot = flight.robots["C"]
    assert robot.at(0.5 + 1.5).position[2] > 0.9 - 0.1, "it is held first"
    assert 0.5 + 3.0 < robot.off(after=0.5) < thawed
    assert next(each.reason for each in robot.phases if each.t > 0.5).startswith("it came down by itself")
    assert robot.at(flight.ended).position[2] < 0.02
    assert flight.code == 1


def test_climbs_and_landings_continue_in_next_world():
    climbing, landing = Fault(1.0, "kill", "world", since="ready"), Fault(0.4, "kill", "world", since="landing")
    flight = fly(MIX, climbing, landing, case="world")
    assert (flight.code, flight.violations) == (0, [])
    event = flight.happened("world", text="started again")[-1]
    assert {*event.text.rpartition("; ")[2].removesuffix(" where they were").split(", ")} == {*"ABC"}
    for name, height in (("B", 0.6), ("C", 0.9)):
        robot = flight.robots[name]
        assert robot.at(-2.5).position[2] < 0.5 * height
        assert robot.at(0.0).position[2] > height - 0.1
        assert robot.at(event.t + 0.3).position[2] > height - 0.1, "it is where it was"
        assert robot.phases[-1].reason == "finished"


def test_centre_communicates_over_modelled_channel():
    bad = ["channel.loss=0.3", "channel.delay_s=0.05", 'architecture="centralised"', "duration_s=20"]
    (case,) = fly(TRIO, settings=[*bad, "rates.body_hz=50"]).metrics
    centre, sent = case["guidance"], sum(robot["messages"] for robot in case["robots"])
    assert (case["lost"], sent) == (0, 600), "of the network itself nothing is lost"
    assert centre["poses_lost"] / sent == pytest.approx(0.3, abs=0.05)
    assert centre["goals_lost"] / centre["goals"] == pytest.approx(0.3, abs=0.05)
    assert 0.1 < centre["delay_mean_s"] < 0.25, "both ways, and up to a period of decisions"


def test_recording_that_breaks_off_fails_the_run():
    flight = triangle(Fault(7.0, "cut", "recorder", lasts=20.0))
    assert flight.code == 1
    assert re.search(r"Failed in event: the recording breaks off after [67]\.\d s of 8 s\.", flight.output)
    assert flight.violations == []
