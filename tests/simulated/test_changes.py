"""Robots that are removed, restarted, replaced and added while the others fly on (docs/hot-changes.md)."""

import pytest

from tests.simulated.faults import Fault
from tests.simulated.laboratory import fly
from tests.simulated.small import DRONE, TRIO

pytestmark = pytest.mark.slow
SPARES = """
[robots.D]
kind = "khepera4"
start = [0.9, 0.7]
standby = true
[spares]
S1 = { kind = "khepera4", start = [0.9, -0.6] }
S2 = { kind = "turtlebot3", start = [-0.9, -0.6] }
[robots.T]
kind = "turtlebot3"
start = [-0.9, 0.7]
standby = true
[formation]
"""
HOT = TRIO.replace("[formation]\n", SPARES).replace('"A - B" =', '"A - D" = 1.0, "A - T" = 1.0, "A - B" =')


def order(at, words, who, **more):
    return Fault(at, "order", who, words, **more)


def misses(flight):
    """Robots that A misses in its last second."""
    end = flight.robots["A"].entered("landing")[-1]
    return {*[missing for t, missing in flight.robots["A"].missing if t < end - 0.05][-1]} - {"T"}


def test_killed_robot_is_restarted_and_takes_part():
    flight = fly(TRIO, Fault(0.7, "kill", "B"), order(1.0, "restart", "B"))
    robot, (_, second) = flight.robots["B"], flight.of("default-B")
    assert flight.answers[0].output.startswith("B: takes part again after 0.")
    told = [event.kind for event in flight.events if event.source == "B"]
    assert [kind for kind in told if kind not in {"robot", "hazard"}] == ["lost", "restart", "changed"]
    assert [phase.phase for phase in robot.phases if phase.pid == second.pid][-3:] == ["running", "landing", "done"]
    assert robot.entered("landing")[-1] == pytest.approx(3.0, abs=0.03), "its time is that of the others"
    assert any(t > 2.0 for t, pid in robot.poses if pid == second.pid)
    assert "a tool sends poses" not in str(flight.robots["A"].hazards), "they are those of the new process"
    assert misses(flight) == set()
    assert (flight.code, flight.violations) == (1, [])


def test_lost_robot_is_restarted_without_an_operator():
    flight = fly(TRIO, Fault(0.7, "kill", "B"), settings=['on_loss="restart"'])
    assert flight.happened("changed", "B", "takes part again")
    assert flight.robots["B"].entered("running")[-1] < 2.0
    assert misses(flight) == set()


def test_removed_drone_leaves_formation_before_it_is_down():
    flight = fly(DRONE, order(1.0, "remove", "C"))
    left = flight.robots["C"].entered("landing")[0]
    assert flight.robots["C"].phases[-2].reason == "ordered to leave"
    missed = next(t for t, missing in flight.robots["A"].missing if t > 0.0 and missing == ("C",))
    assert left < missed < left + 0.15
    assert flight.robots["C"].off() > missed + 0.5
    assert flight.code == 3


def test_robots_leave_and_come_while_others_continue():
    flight = fly(
        HOT, order(0.5, "remove", "C"), order(1.0, "hold", "C"), order(2.2, "add", "C"), order(2.7, "add", "D"),
        order(3.5, "add", "D"), settings=["duration_s=5"],
    )  # fmt: skip
    removed, held, again, standby, twice = flight.answers
    assert removed.output == "C: removed: it is down, and the others go on\n"
    assert (held.code, held.output[:16]) == (1, "C: no: no answer")
    assert again.output.startswith("C: takes part again after ")
    assert standby.output.startswith("D: takes part")
    assert (twice.code, twice.output[:32]) == (1, "D: no: takes part already; `./ze")
    for name in "ABCD":
        assert flight.robots[name].entered("landing")[-1] == pytest.approx(5.0, abs=0.03), name
    assert misses(flight) == set()
    assert not flight.happened("lost")


def test_spare_takes_over_name_of_frozen_robot():
    flight = fly(
        HOT, Fault(0.5, "pause", "B", lasts=60.0), order(0.6, "replace --with S2", "B"),
        order(0.8, "replace --with S1", "B"), order(6.5, "replace --with S1", "B"), settings=["duration_s=8"],
    )  # fmt: skip
    wrong, right, used = flight.answers
    assert wrong.output == "B: no: S2 is a turtlebot3 and cannot be B, a khepera4\n"
    assert right.output.startswith("B: S1 has its name and takes part after ")
    assert used.output == "B: no: S1 has taken over B already\n"
    robot, (former, second) = flight.robots["B"], flight.of("default-B")
    assert former.code == -9
    assert 0.8 + 3.0 < former.ended < 0.8 + 1.0 + 3.2, "no answer, then 3 s of silence"
    assert [phase.reason for phase in robot.phases if phase.pid == second.pid][-1] == "finished"
    assert misses(flight) == {"D"}, "which is on standby"


@pytest.mark.parametrize("words", ["replace --body twin", "restart"])
def test_robot_stopped_while_it_leaves_stays_down(words):
    """Seed 160378: its next process took off two seconds after the stop."""
    flight = fly(DRONE, order(0.06, words, "C"), order(0.6, "stop", "C"), settings=["duration_s=5"])
    change, stop = flight.answers
    assert (stop.code, change.code) == (0, 1)
    assert "was ordered to stop meanwhile" in change.output
    assert flight.robots["C"].motors[-1][1] is False
    assert flight.robots["C"].motors[-1][0] < 0.7
    assert (flight.code, flight.violations) == (1, [])
