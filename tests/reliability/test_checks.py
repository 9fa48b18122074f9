"""A check that cannot fail checks nothing: each is shown a run that is not well."""

from types import SimpleNamespace

import numpy as np
import pytest

from agents.network.messages import Command, Event, Incident
from experiments.definition.plan import Plan
from experiments.file.document import load
from tests.reliability.faults import ActiveFault, Fault
from tests.reliability.observer import Invariants


def status(phase="running", *, missing=(), incidents=()):
    new = list(incidents)
    return SimpleNamespace(phase=phase, missing=list(missing), incidents=new, incidents_since=lambda _: new)


@pytest.fixture
def it():
    experiment = load("triangle").cases()["event"].experiment
    observer = SimpleNamespace(
        invariants=Invariants(Plan(experiment)), events=[], orders=[], alive=set(), connected=True,
        status={name: status() for name in experiment.robots}, status_at=dict.fromkeys(experiment.robots, 1e12),
        receivers={"CF01": {"KH01", "KH02"}}, is_down=lambda name: observer.status[name].phase in ("landing", "done"),
    )  # fmt: skip
    run = SimpleNamespace(experiment=experiment, dead={}, shifted=set())
    active = ActiveFault(Fault("kill", 1.0, victim="CF01"), "CF01", run, observer, set(experiment.robots))
    active.live = {"KH01", "KH02"}
    return active


def test_end_of_a_process_is_reported_since_fault(it):
    it.observer.events.append(Event(0.0, "router2", "", "ended with exit code 1"))
    assert it.reported("router")() == ""
    assert it.reported("recorder")() == "the end of the recorder is not reported"
    again = ActiveFault(it.fault, "", it.run, it.observer, set())
    assert again.reported("router")() == "the end of the router is not reported", "the one before does not count"


def test_a_loss_is_noticed_by_all_who_receive(it):
    it.observer.alive.add("CF01")
    assert "its token still stands" in it.loss_noticed()
    it.observer.alive.clear()
    it.observer.status["KH01"] = status(missing=["CF01"])
    assert it.loss_noticed() == "KH02: not noticed that CF01 is lost"
    it.observer.status["KH02"] = status(missing=["CF01"])
    assert it.loss_noticed() == ""


def test_a_victim_is_back_or_down(it):
    assert it.back() == "CF01 is not back"
    it.observer.invariants.place("CF01", (0.0, 0.0, 0.5))
    it.observer.status["CF01"] = status("landing")
    assert it.back() == "CF01 has not come down yet"
    it.observer.invariants.place("CF01", (0.0, 0.0, 0.0))
    assert it.back() == ""
    it.observer.status_at["CF01"] = -1.0
    assert it.back() == "no status of CF01 yet"


def test_all_hold_for_a_silent_router_in_time(it):
    limit = it.run.experiment.safety.neighbour_timeout_s
    it.observer.status["KH01"] = status(incidents=[Incident(1, it.utc + limit, "hold: no connection to a router")])
    assert it.all_held() == "KH02: never held while the router was frozen"
    assert it.violations == []
    it.observer.status["KH02"] = status(incidents=[Incident(1, it.utc + limit + 9, "hold: no connection to a router")])
    assert it.all_held() == ""
    assert it.violations == [f"KH02 held only {limit + 9:.1f} s after the router had frozen"]


def test_a_lost_position_is_a_violation_once(it):
    it.observer.status["KH01"] = status(incidents=[Incident(1, 0.0, "over: its own position is lost"),
                                                   Incident(2, 0.0, "hold: its own position is lost")])  # fmt: skip
    assert (it.positions_kept(), it.positions_kept()) == ("", "")
    assert it.violations == ["KH01: hold: its own position is lost"]


def test_all_land_without_a_conductor(it):
    it.observer.invariants.place("CF01", (0.0, 0.0, 0.5))
    it.observer.status = {name: status("done") for name in it.observer.status}
    it.observer.status["KH02"] = status("landing")
    assert it.all_landed() == "in the air ['CF01'], not done ['KH02']"


def test_a_body_that_nothing_steers_stops(it):
    it.begun -= 2.0
    it.observer.moved = lambda _, before: 0.3
    it.check_held()
    assert it.violations == ["CF01 moved although no process steered it"]


def test_wrong_positions_must_be_noticed_by_living_robots(it):
    check = it.all_unaware("position")
    it.run.measured = ["CF01", "KH01"]
    assert check() == "KH01: not noticed that its position is wrong"
    it.observer.status["KH01"] = status(incidents=[Incident(1, 0.0, "hold: its own position is lost")])
    assert check() == ""


def test_refused_landing_ends_on_the_floor(it):
    it.observer.invariants.place("CF01", (0.0, 0.0, 0.5))
    assert it.landed() == "CF01 does not land"
    it.observer.status["CF01"] = status("landing")
    assert it.landed() == "CF01 has not come down yet"
    it.observer.invariants.place("CF01", (0.0, 0.0, 0.0))
    assert it.landed() == ""


def test_sleeper_must_hear_its_senders(it):
    it.observer.receivers = {"KH01": {"CF01"}, "KH02": {"KH01"}, "CF01": {"KH01"}}
    it.observer.received_at, it.lifted = {("CF01", "KH01"): 5.0}, 6.0
    it.observer.sent_at = {"KH01": 7.0}
    assert it.deaf_to() == []  # that may have been sent before
    it.observer.sent_at["KH01"] = 8.0
    assert it.deaf_to() == ["KH01"]
    it.observer.received_at["CF01", "KH01"] = 6.5
    assert it.deaf_to() == []


# ---------------------------------------------------------------------- invariants

TRIANGLE = {"KH01": (-0.3, 0.0, 0.0), "KH02": (0.3, 0.0, 0.0), "CF01": (0.0, 0.4359, 0.6)}


@pytest.fixture
def seen():
    invariants = Invariants(load("triangle").cases()["event"])
    for name, place in TRIANGLE.items():
        invariants.place(name, place)
    return invariants


def test_all_is_well(seen):
    assert seen.violations() == []
    assert seen.formation_error(set(TRIANGLE), 1.0) < 0.001
    assert seen.nearest == pytest.approx(0.6 - 2 * 0.0704, abs=0.02)


@pytest.mark.parametrize("place", [(1.02, 0.0, 0.0), (0.0, -1.5, 0.0), (0.0, 0.8, 2.2), (0.0, 0.8, -0.2)])
def test_outside(seen, place):
    seen.place("CF01", place)
    assert seen.violations() == ["CF01 is outside the arena"]
    assert seen.violations() == [], "said once for as long as it lasts"
    seen.place("CF01", TRIANGLE["CF01"])
    assert seen.violations() == []
    seen.place("CF01", place)
    assert seen.violations() == ["CF01 is outside the arena"]


def test_overlap(seen):
    seen.place("KH02", (-0.2, 0.05, 0.0))
    assert seen.violations() == ["KH01 and KH02 overlap"]


def test_above_is_not_in_the_way(seen):
    seen.place("CF01", (-0.3, 0.0, 0.6))
    assert seen.violations() == []
    seen.place("CF01", (-0.3, 0.0, 0.01))
    assert seen.violations() == ["KH01 and CF01 overlap"]


def test_a_deformed_formation(seen):
    seen.place("KH02", (0.5, 0.0, 0.0))
    assert seen.formation_error(set(TRIANGLE), 1.0) == pytest.approx(0.2, abs=0.01)
    assert seen.formation_error({"KH01", "CF01"}, 1.0) < 0.001, "links of those that are gone do not count"


def test_nobody_knows_where_it_is(seen):
    seen.place("KH02", (np.nan, 0.0, 0.0))
    assert seen.violations() == []
    assert seen.formation_error(set(TRIANGLE), 1.0) == np.inf


@pytest.mark.parametrize(
    ("robot", "setpoint", "sane"),
    [
        ("CF01", (0.0, 0.4, 0.6, 0.0), True),
        ("CF01", (3.0, 0.4, 0.6, 0.0), False),
        ("CF01", (float("nan"), 0.4, 0.6, 0.0), False),
        ("KH01", (0.1, 1.0, 0.0, 0.0), True),
        ("KH01", (5.0, 1.0, 0.0, 0.0), False),
    ],
)
def test_commands(seen, robot, setpoint, sane):
    assert (seen.invalid_command(Command(robot, 1, 0.0, "drive", setpoint)) == "") == sane
    assert seen.invalid_command(Command(robot, 1, 0.0, "land")) == ""
