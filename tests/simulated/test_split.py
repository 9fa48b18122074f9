"""Promises of docs/hosts.md for a network that splits: routers on two machines go on, and the link between them breaks.

"router2" and the processes beside it in a fault are the far side.
"""

import pytest

from tests.simulated.faults import Fault
from tests.simulated.laboratory import fly
from tests.simulated.small import DRONE, TICK_S, TRIO

SOON_S = 2.5 * TICK_S
MEET_S = 0.15  # time from the end of a split until its routers are linked, and tokens have passed
FIRST = Fault(0.505, "split", "router2 B C", lasts=4.0)  # B and C stay at the router of their side


def split(*faults, experiment=TRIO, **more):
    return fly(experiment, *faults, sites=2, **more)


def test_robots_go_to_the_router_of_their_side():
    flight = split(FIRST, settings=["duration_s=7"])
    for name in "BC":
        (held, _), (over, _) = [each for each in flight.robots[name].hazards if "router" in each[1]]
        assert FIRST.at + 1.3 <= held < FIRST.at + 1.8 + SOON_S
        assert FIRST.at + 3.0 + 1.0 < over < FIRST.at + 3.0 + 1.0 + 0.5, "over when absent for a second"
    assert flight.violations == []


def test_robots_beyond_are_lost_and_found():
    second = Fault(8.005, "split", "router2 B C", lasts=5.0)
    flight = split(FIRST, second, settings=["duration_s=16"])
    lost = second.at + 2.0 + 1.0  # lease of a router, and `neighbour_timeout_s`
    over = second.at + second.lasts
    for name, texts in {"A": ["warn: a neighbour", "hold: all"], "B": ["warn: a neighbour"], "C": ["warn: a"]}.items():
        hazards = [each for each in flight.robots[name].hazards if "neighbour" in each[1] and each[0] > second.at]
        begun, ended = [hazards[: len(texts)], hazards[len(texts) :]]
        for (t, found), text in zip(begun, texts, strict=True):
            assert found.startswith(text)
            assert lost - 0.5 < t < lost + 0.1
        assert all(text.startswith("over") and over + 1.0 < t < over + 1.0 + MEET_S for t, text in ended)
        assert len(ended) == len(begun)
    assert [track.phases[-1].reason for track in flight.robots.values()] == ["finished"] * 3
    assert flight.violations == []


def test_conductor_beyond_is_missed_and_the_robots_finish():
    gone = Fault(1.005, "split", "router2 conductor", lasts=5.0)
    flight = split(gone, settings=["duration_s=8"])
    for robot in flight.robots.values():
        (warned, text), _ = robot.hazards
        assert text.startswith("warn: the conductor is gone: for 2.0 s")
        assert gone.at + 2.0 + 1.4 < warned < gone.at + 2.0 + 2.1
        assert robot.phases[-1].reason == "finished"
    assert (flight.code, flight.violations) == (0, [])


def test_order_to_a_robot_beyond_is_refused():
    flight = split(
        Fault(0.5, "split", "router2 B C", lasts=9.0), Fault(5.0, "order", "B", "land"), settings=["duration_s=8"]
    )
    (answer,) = flight.answers
    assert (answer.code, "no answer" in answer.output) == (1, True)
    assert flight.robots["B"].phases[-1].reason == "finished"


STOPS = {
    "estop": ("", "A C", 0),  # lifelines reach the robots beyond
    "estop --connect tcp/127.0.0.1:7447 --connect tcp/127.0.0.1:7448": ("", "A C", 1),  # it knows of no run
    "estop --connect tcp/127.0.0.1:7448 --connect tcp/127.0.0.1:7447": (" operator", "C", 1),
}


@pytest.mark.parametrize("command", STOPS)
def test_stop_names_what_it_does_not_reach(command):
    beyond, stopped, code = STOPS[command]
    parts, stop = Fault(0.5, "split", f"router2 C{beyond}", lasts=8.0), Fault(4.505, "command", "", command)
    flight = split(parts, stop, experiment=DRONE, settings=["duration_s=6"])
    for name, robot in flight.robots.items():
        cut = [phase.t for phase in robot.phases if phase.reason.startswith("emergency stop")]
        assert [t < stop.at + 0.1 for t in cut] == [True] * (name in stopped)
    (answer,) = flight.answers
    assert answer.code == code
    assert ("where no router answers, are NOT known to have stopped" in answer.output) == (code == 1)
    assert flight.violations == []


@pytest.mark.parametrize("lasts", [2.0, 6.0, 60.0])
def test_robots_beyond_land_without_ssh(lasts):
    parts, stop = Fault(0.505, "split", "router2 C ssh", lasts=lasts), Fault(1.5, "command", "A", "estop")
    flight = split(parts, *[stop] * (lasts == 6.0), experiment=DRONE, settings=["duration_s=8"])
    robot, (process,) = flight.robots["C"], flight.of("default-C")
    if lasts > 3.0:
        (landing,) = [phase for phase in robot.phases if phase.phase == "landing"]
        assert landing.reason == "nothing from the starter for 3 s"
        assert parts.at + 2.5 <= landing.t < parts.at + 3.0 + SOON_S
        assert robot.off() <= process.ended < parts.at + 3.0 + 2.5
    else:
        assert robot.phases[-1].reason == "finished"
    for answer in flight.answers:
        assert answer.code == 1
        assert "NOT known to have stopped: C (1 of 2 robots" in answer.output
    assert (flight.code, flight.violations) == (1, [])


# end of the split, start of the second process, its clock [s]; who keeps the name, and more faults
OWNERS = {
    "second process": (5.5, 1.0, 0.0, ()),
    "second process with a late clock": (5.5, 1.0, -100.0, ()),
    "shortly": (3.3, 0.6, 0.0, ()),
    "hangs": (5.5, 1.0, 0.0, [Fault(5.4, "hang", "second A", 4.0)]),
}


@pytest.mark.parametrize("name", OWNERS)
def test_of_two_owners_the_later_one_ends(name):
    healed, started, clock, more = OWNERS[name]
    twice = Fault(started, "twice", "A", clock)
    flight = split(Fault(0.5, "split", "router2 second", lasts=healed - 0.5), twice, *more, settings=["duration_s=11"])
    robot, first, (second,) = flight.robots["A"], flight.of("default-A")[0], flight.of("second A")
    drivers = {
        pid: [t for t, each in (*robot.commands, *robot.poses) if each == pid] for pid in (first.pid, second.pid)
    }
    later, earlier = (second, first) if clock == 0.0 else (first, second)
    assert max(drivers[later.pid]) < healed + MEET_S
    assert later.code == 2
    assert "had it before on another side of a split network" in later.output
    assert max(drivers[earlier.pid]) > 11.0
    assert flight.violations == []


@pytest.mark.parametrize(("at", "lasts"), [(3.0, 3.0), (5.0, 0.9)], ids=["long", "shorter than its lease"])
def test_owner_that_was_away_does_not_object(at, lasts):
    """The owner is suspended while the network heals: the other process has the name since."""
    parts, away = Fault(0.5, "split", "router2 second", lasts=5.0), Fault(at, "pause", "A", lasts=lasts)
    flight = split(parts, Fault(1.0, "twice", "A"), away, settings=["duration_s=11"])
    first, (second,) = flight.of("default-A")[0], flight.of("second A")
    assert first.code == 2
    assert [t for t, pid in flight.robots["A"].commands if pid == first.pid and t > at + TICK_S] == []
    assert max(t for t, pid in flight.robots["A"].commands if pid == second.pid) > 11.0
    assert flight.violations == []
