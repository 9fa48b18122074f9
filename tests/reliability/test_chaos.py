"""The fault laboratory: scripts that rounds can do, cables, and checks that are shown a run that is not well."""

import os
import re
import signal
import socket
import threading
from collections import Counter
from contextlib import suppress
from types import SimpleNamespace

import numpy as np
import pytest

from agents.network.endpoints import free_endpoint
from agents.network.messages import Command, Event, Incident
from experiments.definition.plan import Plan
from experiments.file.document import load
from tests.cases import for_each
from tests.commands import ROOT, started
from tests.reliability.chaos import ALWAYS, AVOIDANCE, defaults
from tests.reliability.faults import FAULT_KINDS, FAULTS, ActiveFault, Fault, next_fault, script
from tests.reliability.observer import Invariants
from tests.waiting import until

ROBOTS = ("TB01", "KH01", "CF01", "CF02")


@for_each("count", [1, 23, 200])
def test_seed_draws_kinds_equally_often(count):
    drawn = script(ROBOTS, count, 1)
    assert drawn == script(ROBOTS, count, 1) != script(ROBOTS, count, 2)
    often = Counter(fault.kind for fault in drawn)
    assert often.total() == count
    assert max(often.values()) - min(often[kind] for kind in FAULTS) <= 1
    for fault in drawn:
        kind = fault.properties
        assert fault.victim in (ROBOTS if kind.victim else ("",))
        assert fault.after_s > 0.0
        assert kind.size[0] <= abs(fault.size) <= kind.size[1]
        assert fault.size >= 0.0 or kind.signed


def flown(waiting, duration_s=90.0):
    """Faults of a round, each of which takes as long as it usually does."""
    stage, t, begun = waiting[0].properties.stage, 15.0, Counter()
    while (fault := next_fault(waiting, stage, begun, duration_s - t)) is not None:
        waiting.remove(fault)
        begun[fault.kind] += 1
        t += fault.after_s + fault.properties.lasts_s + fault.properties.heals_s
        yield fault
        if fault.kind == "conductor":
            return


def test_rounds_can_be_flown():
    drawn = script(ROBOTS, 300, 3)
    waiting, rounds = list(drawn), []
    while waiting:
        rounds.append((waiting[0].properties.stage, list(flown(waiting))))
    assert Counter(map(repr, drawn)) == Counter(repr(fault) for _, faults in rounds for fault in faults)
    assert max(len(faults) for _, faults in rounds) > 4
    assert len(rounds) < 60, "the launcher dies in the last seconds of a round, not in one of its own"
    for stage, faults in rounds:
        kinds = [fault.kind for fault in faults]
        assert kinds
        assert all(kinds.count(kind) <= FAULT_KINDS[kind].most for kind in kinds)
        assert {FAULT_KINDS[kind].stage for kind in kinds} <= {"plain", stage}
        assert not (stage == "two routers" and "router" in kinds)


def test_last_faults_disband_or_end_the_round():
    waiting = script(ROBOTS, 14, 1)
    assert next_fault(waiting, "plain", {}, 3.9) is None, "none begins that could not heal"
    assert next_fault(waiting, "plain", {}, 10.0).kind == "conductor"
    assert next_fault(waiting, "plain", {}, 60.0).kind != "conductor"
    asked = script(ROBOTS, 6, 1, ["refused-landing", "sleep"])
    assert [fault.kind for fault in flown(asked)] == ["sleep", "sleep", "refused-landing"]


def test_every_kind_is_defined_in_the_docs():
    rows = re.findall(r"^\| `([\w-]+)` \|", (ROOT / "docs" / "chaos.md").read_text(), re.MULTILINE)
    assert sorted(rows) == sorted(FAULTS)


def test_defaults_keep_robots_apart_and_fit_files_rates():
    assert AVOIDANCE in defaults(load("robotic-park").plan)
    assert "rates.body_hz=50" in defaults(load("robotic-park").plan)
    avoiding = load("robotic-park", 'avoidance.kind="potential"', "rates.pose_hz=100").experiment
    assert defaults(Plan(avoiding)) == list(ALWAYS)


def test_cut_cable_holds_everything_back_and_loses_nothing():
    near, ends, data = int(free_endpoint(0).rpartition(":")[2]), [], bytes(range(256)) * 4096

    def reached():
        with suppress(ConnectionRefusedError):
            ends.append(socket.create_connection(("127.0.0.1", near), timeout=30.0))
        return ends

    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        started("-m", "tests.reliability.cable", near, server.getsockname()[1]) as cable,
    ):
        until(reached, "it listens")
        far, _ = server.accept()
        with ends[0] as end, far, far.makefile("rb") as arrived:
            sender = threading.Thread(target=end.sendall, args=(data,))
            sender.start()
            assert arrived.read(len(data)) == data
            sender.join()
            far.sendall(b"back")
            assert end.recv(10) == b"back"
            os.kill(cable.pid, signal.SIGSTOP)
            os.waitid(os.P_PID, cable.pid, os.WSTOPPED)
            end.sendall(b"late")
            far.settimeout(0.3)
            with pytest.raises(TimeoutError):
                far.recv(10)
            os.kill(cable.pid, signal.SIGCONT)
            far.settimeout(30.0)
            assert far.recv(10) == b"late"
            end.shutdown(socket.SHUT_WR)
            assert far.recv(10) == b"", "the end of a connection passes"
        cable.stdin.close()
        assert cable.wait(100.0) == 0, "it ends with its standard input"


def status(phase="running", *, missing=(), incidents=()):
    new = [Incident(1, stamp, text) for stamp, text in incidents]
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
    assert it.reported("router") == ""
    assert it.reported("recorder") == "the end of the recorder is not reported"
    again = ActiveFault(it.fault, "", it.run, it.observer, set())
    assert again.reported("router") == "the end of the router is not reported", "the one before does not count"


def test_a_loss_is_noticed_by_all_who_receive(it):
    it.observer.alive.add("CF01")
    assert "its token still stands" in it.loss_noticed()
    it.observer.alive.clear()
    it.observer.status["KH01"] = status(missing=["CF01"])
    assert it.loss_noticed() == "KH02: not noticed that CF01 is lost"
    it.observer.status["KH02"] = status(missing=["CF01"])
    assert it.loss_noticed() == ""


def test_a_victim_is_back_or_down(it):
    assert (it.back(), it.landed()) == ("CF01 is not back", "CF01 does not land")
    it.observer.invariants.place("CF01", (0.0, 0.0, 0.5))
    it.observer.status["CF01"] = status("landing")
    assert it.back() == it.landed() == "CF01 has not come down yet"
    it.observer.status |= {"KH01": status("done"), "KH02": status("landing")}
    assert it.all_landed() == "in the air ['CF01'], not done ['CF01', 'KH02']"
    it.observer.invariants.place("CF01", (0.0, 0.0, 0.0))
    assert it.back() == it.landed() == ""
    it.observer.status_at["CF01"] = -1.0
    assert it.back() == "no status of CF01 yet"


def test_all_hold_for_a_silent_router_in_time(it):
    limit, text = it.run.experiment.safety.neighbour_timeout_s, "hold: no connection to a router"
    it.observer.status["KH01"] = status(incidents=[(it.utc + limit, text)])
    assert it.all_held() == "KH02: never held while the router was frozen"
    assert it.violations == []
    it.observer.status["KH02"] = status(incidents=[(it.utc + limit + 9, text)])
    assert it.all_held() == ""
    assert it.violations == [f"KH02 held only {limit + 9:.1f} s after the router had frozen"]


def test_wrong_or_lost_positions_are_noticed(it):
    assert it.unaware(["CF01", "KH01"], "position") == "KH01: not noticed that its position is wrong"
    lost = "its own position is lost"
    it.observer.status["KH01"] = status(incidents=[(0.0, f"over: {lost}"), (0.0, f"hold: {lost}")])
    assert it.unaware(["CF01", "KH01"], "position") == ""
    assert (it.positions_kept(), it.positions_kept()) == ("", "")
    it.begun -= 2.0
    it.observer.moved = lambda _, before: 0.3
    it.check_held()
    assert it.violations == [f"KH01: hold: {lost}", "CF01 moved although no process steered it"]


def test_sleeper_must_hear_its_senders(it):
    it.observer.receivers = {"KH01": {"CF01"}, "KH02": {"KH01"}, "CF01": {"KH01"}}
    it.observer.received_at, it.lifted = {("CF01", "KH01"): 5.0}, 6.0
    it.observer.sent_at = {"KH01": 7.0}
    assert it.deaf_to() == []  # that may have been sent before
    it.observer.sent_at["KH01"] = 8.0
    assert it.awake() == "CF01 is not back"
    it.live.add("CF01")
    assert it.awake() == "CF01 receives no pose of KH01"
    it.observer.received_at["CF01", "KH01"] = 6.5
    assert it.deaf_to() == []


TRIANGLE = {"KH01": (-0.3, 0.0, 0.0), "KH02": (0.3, 0.0, 0.0), "CF01": (0.0, 0.4359, 0.6)}


@pytest.fixture
def seen():
    invariants = Invariants(load("triangle").cases()["event"])
    for name, place in TRIANGLE.items():
        invariants.place(name, place)
    return invariants


@for_each(
    "name, place, wrong",
    [
        *(("CF01", out, "CF01 is outside the arena") for out in [(1.02, 0.0, 0.0), (0.0, 0.8, 2.2), (0.0, 0.8, -0.2)]),
        ("KH02", (-0.2, 0.05, 0.0), "KH01 and KH02 overlap"),
        ("CF01", (-0.3, 0.0, 0.01), "KH01 and CF01 overlap"),
        ("CF01", (-0.3, 0.0, 0.6), ""),  # above is not in the way
        ("KH02", (np.nan, 0.0, 0.0), ""),  # nobody knows where it is
    ],
)
def test_robots_outside_and_overlaps_are_violations(seen, name, place, wrong):
    for _ in range(2):
        seen.place(name, place)
        assert seen.violations() == [wrong] * bool(wrong)
        assert seen.violations() == [], "said once for as long as it lasts"
        seen.place(name, TRIANGLE[name])
        assert seen.violations() == []


def test_a_deformed_formation(seen):
    assert seen.violations() == []
    assert seen.nearest == pytest.approx(0.6 - 2 * 0.0704, abs=0.02)
    assert seen.formation_error(set(TRIANGLE), 1.0) < 0.001
    seen.place("KH02", (0.5, 0.0, 0.0))
    assert seen.formation_error(set(TRIANGLE), 1.0) == pytest.approx(0.2, abs=0.01)
    assert seen.formation_error({"KH01", "CF01"}, 1.0) < 0.001, "links of those that are gone do not count"
    seen.place("KH02", (np.nan, 0.0, 0.0))
    assert seen.formation_error(set(TRIANGLE), 1.0) == np.inf


@for_each(
    "robot, setpoint, sane",
    [
        ("CF01", (0.0, 0.4, 0.6, 0.0), True),
        ("CF01", (3.0, 0.4, 0.6, 0.0), False),
        ("CF01", (np.nan, 0.4, 0.6, 0.0), False),
        ("KH01", (0.1, 1.0, 0.0, 0.0), True),
        ("KH01", (5.0, 1.0, 0.0, 0.0), False),
    ],
)
def test_absurd_setpoints_are_violations(seen, robot, setpoint, sane):
    assert (seen.invalid_command(Command(robot, 1, 0.0, "drive", setpoint)) == "") == sane
    assert seen.invalid_command(Command(robot, 1, 0.0, "land")) == ""
