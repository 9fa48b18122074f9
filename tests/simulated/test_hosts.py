"""Promises of docs/hosts.md where the launcher, the network, a robot or a clock breaks.

Connections through ssh are not simulated: tests/system/test_machines.py has them.
"""

from math import inf

import pytest

from tests.simulated.faults import Fault
from tests.simulated.laboratory import fly
from tests.simulated.small import AT_S, DRONE, PAIR, TICK_S, TRIO

SOON_S = 2.5 * TICK_S
BEAT_S = 0.5  # period of the launcher's heartbeat


def test_killed_launcher_leaves_nobody_aloft():
    flight = fly(DRONE, Fault(AT_S, "kill", "conductor"))
    for name in ("A", "C"):
        landing = next(phase for phase in flight.robots[name].phases if phase.phase == "landing")
        assert landing.reason == "the starter is gone"
        assert AT_S < landing.t < AT_S + SOON_S
    assert max(each.ended for each in flight.processes) < AT_S + 3.2
    assert flight.robots["C"].off() < AT_S + 2.5
    assert "default.mcap" in flight.files


def test_frozen_launcher_lands_all_and_gives_no_order():
    flight = fly(DRONE, Fault(AT_S, "pause", "conductor", lasts=7.0), settings=["duration_s=9"])
    for name in ("A", "C"):
        (landing,) = [phase for phase in flight.robots[name].phases if phase.phase == "landing"]
        assert landing.reason == "nothing from the starter for 3 s"
        assert AT_S + 3.0 - BEAT_S <= landing.t < AT_S + 3.0 + SOON_S
    assert flight.code == 2
    assert "this process stood still for more than 3 s" in flight.output
    assert not flight.happened("phase", text="landing")


def test_short_cut_holds_and_goes_on():
    flight = fly(TRIO, Fault(0.505, "cut", "A", lasts=2.5), settings=["duration_s=6"])
    hold, over = [each for each in flight.robots["A"].hazards if "router" in each[1]]
    assert 0.505 + 1.3 <= hold[0] < 0.505 + 1.8
    assert hold[1].startswith("hold: ")
    assert over[1].startswith("over: ")
    assert over[0] < 6.0
    assert [phase.reason for phase in flight.robots["A"].phases][-1] == "finished"
    assert flight.violations == []


def test_frozen_robot_is_ordered_down_then_killed():
    flight = fly(PAIR, Fault(0.505, "pause", "B", lasts=inf), settings=["duration_s=1", "rates.body_hz=50"])
    ordered = flight.happened("refused", "B", "land: ")
    assert 1.0 + 3.0 <= ordered[0].t < 1.0 + 3.0 + 1.2
    (lost,) = flight.happened("lost", "B", "did not end its landing within 15 s")
    assert lost.t == pytest.approx(1.0 + 3.0 + 15.0, abs=0.2)
    assert flight.of("default-B")[0].ended < lost.t + 0.1
    assert flight.code == 1


def test_steps_of_wall_clocks_move_nobody():
    steps = Fault(AT_S, "step", "A", 60.0), Fault(1.5, "step", "B", -60.0), Fault(1.7, "step", "recorder", 5.0)
    flight = fly(TRIO, *steps)
    assert (flight.code, flight.violations) == (0, [])
    for robot in flight.robots.values():
        assert robot.hazards == []
        assert robot.entered("landing")[0] == pytest.approx(3.0, abs=SOON_S)


# error of a clock [s], whether the run says so before the start, and the exit code
CLOCKS = {
    "right": (0.0, False, 0),
    "hardly_ahead": (0.015, False, 0),
    "ahead": (0.03, True, 0),
    "hardly_behind": (-0.04, False, 0),
    "behind": (-0.2, True, 3),
}


@pytest.mark.parametrize("name", CLOCKS)
def test_clock_of_another_machine(name):
    off, said, code = CLOCKS[name]
    flight = fly(PAIR, clocks={"A": off}, settings=["duration_s=1", "rates.body_hz=50"])
    assert flight.robots["A"].entered("running")[0] == pytest.approx(-off, abs=0.04)
    told = flight.happened("clock", "A")
    assert [float(each.text.split()[3]) for each in told] == [pytest.approx(off, abs=0.02)] * said
    assert all(each.t < 0.0 for each in told)
    assert flight.code == code


def test_killed_launcher_waits_for_no_frozen_robot():
    thawed = 8.0
    flight = fly(DRONE, Fault(0.5, "pause", "A", lasts=thawed - 0.5), Fault(AT_S, "kill", "conductor"))
    frozen = flight.of("default-A")[0]
    assert max(each.ended for each in flight.processes if each is not frozen) < AT_S + 3.2
    assert thawed + 10.0 < frozen.ended < thawed + 10.5, "its router is gone"
    assert flight.robots["C"].off() < AT_S + 2.5
    assert "default.mcap" in flight.files


def test_robot_frozen_in_its_landing_is_lost():
    flight = fly(DRONE, Fault(0.1, "pause", "C", lasts=inf, since="landing"), settings=["duration_s=1"])
    landing = flight.happened("phase", text="landing")[0].t
    (lost,) = flight.happened("lost", "C", "did not end its landing within 15 s: ")
    assert lost.t == pytest.approx(landing + 15.0, abs=0.2)
    assert flight.code == 1
    assert "Failed in default: C at " in flight.output


def test_killed_router_is_started_again_in_flight():
    flight = fly(TRIO, Fault(AT_S, "kill", "router"))
    (told,) = flight.happened("router")
    assert told.text.startswith("the router ended (killed by SIGKILL); started again")
    assert [phase.reason for track in flight.robots.values() for phase in track.phases[-1:]] == ["finished"] * 3
    assert not any(text.startswith("land") for track in flight.robots.values() for _, text in track.hazards)
    assert flight.violations == []


def test_second_router_carries_on_at_once():
    flight = fly(TRIO, Fault(AT_S, "kill", "router"), settings=["network.routers=2"])
    assert flight.happened("router", text="the router ended (killed by SIGKILL); started again: all go on at another")
    hazards = [text for track in flight.robots.values() for _, text in track.hazards]
    assert {text.partition(", after")[0] for text in hazards} == {
        "hold: it asked who owns its name: for 0.2 s", "over: it asked who owns its name",
    }  # fmt: skip
    assert (flight.code, flight.violations) == (0, [])
