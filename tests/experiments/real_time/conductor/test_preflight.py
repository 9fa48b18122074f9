"""Checks before the first flight: what each finds, when it is red, and that an interrupt moves nothing."""

import math
from datetime import date
from types import SimpleNamespace

import pytest

from agents.body.limits import Safety
from agents.body.measured_positions import FROZEN
from agents.clock import Clock
from agents.network.messages import Inspection, Reply, State, Status
from agents.safety.preflight import FRAME
from bridges.tello.kind import TELLO
from experiments.definition.experiment import RobotTable
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.real_time.conductor import preflight_checks as checks
from experiments.real_time.conductor.preflight import Inspector, Trials, alone
from experiments.real_time.conductor.preflight_checks import Check, Observed, Tried
from experiments.real_time.conductor.run_view import RobotView
from tests.experiments.recordings import status
from tests.small import changed, small

RADIO = "radio://0/80/2M/E7E7E7E70"
LIGHTHOUSE = {"positioning": {"system": "lighthouse"}}
DRONE = RobotTable(kind="crazyflie", start=[0.0, 0.5, 0.0], hover=0.2, body=f"{RADIO}1", device=LIGHTHOUSE)
OTHER = RobotTable(kind="crazyflie", start=[0.0, -0.5, 0.0], hover=0.8, body=f"{RADIO}2", device=LIGHTHOUSE)
WHEELS = RobotTable(kind="khepera4", start=[1.0, 0.0], body="khepera4://192.0.2.1")
TELLO_TABLE = RobotTable(kind="tello", start=[0.0, 0.0], hover=0.8)


def states(*places, yaw=0.0):
    return [State("CF01", k, 0.02 * k, "idle", place, yaw=yaw) for k, place in enumerate(places)]


def observed_still(robot=DRONE, *, place=(0.0, 0.5, 0.0), noise=0.0, yaw=0.0, said=None, behind_s=0.001, **inspected):
    """A robot at rest: what its process says, and what its device has told."""
    x, y, z = place
    known = {"firmware": "2025.02", "volts": 4.1, "age_s": 0.02, **inspected}
    said = Status(**{"robot": "CF01", "stamp": 0.0, "phase": "ready", "reason": "", "battery": 0.9, **(said or {})})
    seen = states((x - noise, y, z), (x + noise, y, z), yaw=yaw)
    return Observed(robot, said, "", seen, [Inspection(**known)], behind_s)


def checked(each, **others):
    """Findings on CF01, by check."""
    found = checks.at_rest({"CF01": each, **others}, Safety(), date(2026, 3, 1))["CF01"]
    return {one.check: one for one in found}


def test_a_robot_that_is_in_order_is_green():
    made = checked(observed_still(packets_hz=180.0, capacity_hz=250.0))
    assert [*made] == ["address", "firmware", "battery", "position", "start pose", "radio", "clock", "ready"]
    assert {(each.verdict, each.remedy) for each in made.values()} == {("ok", "")}


LEANS = "it is not level: it leans 40°"


@pytest.mark.parametrize(
    ("changed", "check", "verdict", "text"),
    [
        ({"firmware": "2023.11"}, "firmware", "warn", "2023.11, 28 months old"),
        ({"firmware": "twin"}, "firmware", "ok", "twin"),
        ({"firmware": None}, "firmware", "unknown", "not known by a crazyflie at radio://0/80/2M/E7E7E7E701"),
        ({"age_s": 0.3}, "position", "bad", "spread 0.0 mm, at most 300 ms old"),
        ({"age_s": None}, "position", "unknown", "spread 0.0 mm, of unknown age"),
        ({"noise": 0.001}, "position", "ok", "spread 1.0 mm, at most 20 ms old"),
        ({"noise": 0.03}, "position", "warn", "spread 30.0 mm, at most 20 ms old"),
        ({"noise": 0.2}, "position", "bad", "spread 200.0 mm, at most 20 ms old"),
        ({"packets_hz": 480.0, "capacity_hz": 250.0}, "radio", "bad", "480 of 250 packets/s"),
        ({}, "radio", "unknown", "no shared radio"),
        ({"ahead_s": 2.3}, "clock", "bad", "positions of CF01 are stamped 2.3 s ahead"),
        ({"behind_s": -1.5}, "clock", "bad", "its computer's is +1.50 s off"),
        ({"place": (0.5, 0.5, 0.0)}, "start pose", "bad", "0.50 m from `start`, turned by 0°"),
        ({"yaw": 1.0}, "start pose", "bad", "0.00 m from `start`, turned by 57°"),
        ({"yaw": None}, "start pose", "ok", "0.00 m from `start`"),
        ({"said": {"battery": 0.1}}, "battery", "bad", "10%, 4.10 V, less than 20%"),
        ({"said": {"phase": "idle", "reason": LEANS}}, "ready", "bad", LEANS),
        ({"said": {"body": "3 positions refused"}}, "address", "warn", "answers; 3 positions refused"),
    ],
)
def test_what_is_measured_at_rest(changed, check, verdict, text):
    made = checked(observed_still(**changed))[check]
    assert (made.verdict, bool(made.remedy), made.found) == (verdict, verdict in ("warn", "bad"), text)


@pytest.mark.parametrize(("other_y", "here_y", "there_y"), [(-0.5, -0.5, 0.5), (0.3, 0.38, 0.42)])
def test_swapped_robots_are_named(other_y, here_y, there_y):
    there = observed_still(changed(OTHER, start=[0.0, other_y, 0.0]), place=(0.0, there_y, 0.0))
    here, near = (checked(observed_still(place=(0.0, y, 0.0)), CF02=there)["start pose"] for y in (here_y, 0.41))
    assert here.remedy == "it stands where CF02 begins: addresses, markers or robots are swapped"
    assert near.verdict == "ok"


@pytest.mark.parametrize(
    ("robot", "verdict"),
    [
        (changed(DRONE, device={}, body="crazyflie-twin"), "unknown"),
        (changed(DRONE, device={}, position="external"), "ok"),
        (WHEELS, "unknown"),
        (changed(WHEELS, position="external"), "ok"),
        (changed(WHEELS, body="world"), "ok"),
    ],
)
def test_robots_that_count_from_start_are_unknown(robot, verdict):
    there = observed_still(robot, place=(*robot.start[:2], 0.0), noise=0.0005)
    away = observed_still(robot, place=(5.0, 5.0, 0.0))
    assert [checked(each)["start pose"].verdict for each in (there, away)] == [verdict, "bad"]


@pytest.mark.parametrize(
    ("body", "position", "verdict"),
    [(DRONE.body, "external", "bad"), ("world", "external", "ok"), (DRONE.body, "body", "ok")],
)
def test_captured_positions_that_never_change_are_red(body, position, verdict):
    robot = changed(DRONE, body=body, position=position)
    assert checked(observed_still(robot))["position"].verdict == verdict
    each = observed_still(robot, said={"body": f"{FROZEN}; connected"})
    each.states = []
    made = checked(each)["position"]
    assert (made.verdict, made.found) == ("bad", FROZEN)


def test_late_or_turned_positions_name_what_to_mend():
    robot = changed(DRONE, position="external", device={})
    for ahead_s, verdict in ((-0.09, "ok"), (-0.12, "bad")):
        made = checked(observed_still(robot, noise=0.0005, ahead_s=ahead_s))["position"]
        assert made.verdict == verdict
        assert ("120 ms late" in made.found, "is slow" in made.remedy) == (verdict == "bad",) * 2
    turned = checked(observed_still(robot, noise=0.0005, yaw=1.05))["start pose"]
    assert turned.remedy == f"if its nose is right, {FRAME}; else turn it to 0 rad, or correct `start`"
    assert "object" not in checked(observed_still(yaw=1.05))["start pose"].remedy


def test_robots_of_a_kind_have_the_same_firmware():
    made = checked(observed_still(), CF02=observed_still(OTHER, firmware="2025.09"))["firmware"]
    assert (made.verdict, made.remedy) == ("warn", "CF02 has 2025.09: flash the same to all of a kind")


def test_unresponsive_robot_has_one_red_line():
    for body, remedy in ((DRONE.body, "switch it on"), ("quad://127.0.0.1:6001", "is it switched on, and its")):
        (made,) = checked(Observed(changed(DRONE, body=body), ended="no answer")).values()
        assert (made.check, made.verdict, made.found) == ("address", "bad", "no answer")
        assert made.remedy.startswith(remedy)
    each = observed_still(said={"battery": None, "phase": "idle", "body": "no answer at radio://0/80/..."})
    each.states, each.inspections = states(None), [Inspection()]  # one drone of a process with several
    made = checked(each)
    verdicts = [made[check].verdict for check in ("address", "ready", "position", "start pose")]
    assert verdicts == ["bad", "bad", "bad", "unknown"]


TRIED = Tried(stopped_s=0.1)
ROLLED = states((0.0, 0.0, 0.0), (0.1, 0.0, 0.0))


def test_a_stop_at_rest_tries_no_crazyflie():
    unknown, *known = (checks.stop_at_rest(each, TRIED) for each in (DRONE, WHEELS, changed(DRONE, body="twin")))
    assert unknown == Check("stop, motors off", "unknown", "not tried: --stop tries it")
    assert [each.verdict for each in known] == ["ok", "ok"]
    assert checks.stop_at_rest(DRONE, Tried(failure="refused: no answer")).verdict == "bad"


@pytest.mark.parametrize(
    ("robot", "tried", "verdict"),
    [
        (DRONE, TRIED, "ok"),
        (DRONE, Tried(stopped_s=1.5), "bad"),
        (DRONE, Tried(stopped_s=math.nan, note="the emergency stop is not answered"), "bad"),
        (DRONE, Tried(failure="refused: no answer"), "bad"),
        (WHEELS, Tried(stopped_s=0.5), "ok"),
        (WHEELS, Tried(stopped_s=0.5, states=ROLLED), "bad"),
    ],
)
def test_stops(robot, tried, verdict):
    made = checks.stop_in_motion(observed_still(robot), tried)
    assert (made.verdict, "locked" in made.found) == (verdict, verdict == "ok" and robot is DRONE)
    assert tried.states or checks.stop("stop, motors off", tried).verdict == verdict


@pytest.mark.parametrize(
    ("robot", "end", "verdict", "remedy"),
    [
        (DRONE, (0.02, 0.5, 0.21), "ok", ""),
        (DRONE, (0.0, 0.5, 0.05), "bad", "does not keep its height"),
        (DRONE, (0.09, 0.5, 0.2), "ok", ""),
        (DRONE, (0.11, 0.5, 0.2), "bad", "yaw of its positions against its nose"),
        (WHEELS, (0.1, 0.5, 0.0), "ok", ""),
        (WHEELS, (0.0, 0.5, 0.0), "bad", "does not drive although commanded to"),
        (WHEELS, (0.2, 0.5, 0.0), "bad", "its speed is not the commanded one"),
    ],
)
def test_hops_and_drives(robot, end, verdict, remedy):
    tried = Tried(states=states((0.0, 0.5, 0.0), end, end), volts=3.7, charge=0.6)
    made = checks.hop(observed_still(robot), tried, Safety())
    assert (made.verdict, made.remedy.startswith(remedy)) == (verdict, True)
    assert made.found.endswith("; battery 60%, 3.70 V under load")
    assert checks.hop(observed_still(robot), Tried(states=tried.states, charge=0.05), Safety()).verdict == "bad"


@pytest.mark.parametrize(
    ("tried", "verdict", "found"),
    [
        ({}, "ok", "to the side, delay of positions unknown"),
        ({"delay_s": 0.03}, "ok", "to the side, positions 30 ms late"),
        ({"delay_s": 0.12}, "bad", "to the side, positions 120 ms late"),
        ({"delay_s": 0.3, "failure": "came down by itself"}, "bad", "came down by itself, positions 300 ms late"),
    ],
)
def test_a_hop_tells_late_positions(tried, verdict, found):
    robot, end = changed(DRONE, position="external", device={}), (0.0, 0.5, 0.2)
    way = states((0.0, 0.5, 0.0), end, end)
    made = checks.hop(observed_still(robot), Tried(states=way, **tried), Safety())
    assert (made.verdict, made.remedy) == (verdict, checks.SLOW_BEFORE if verdict == "bad" else "")
    assert made.found.endswith(found)


def test_robots_are_checked_without_formation_and_low():
    plan = alone(next(iter(document.load("robotic-park").cases().values())))
    case = plan.experiment
    assert len(plan.links) == 0
    assert {case.robots[leg.robot].kind for leg in case.timeline} == {"khepera4", "turtlebot3"}
    assert {robot.hover for robot in case.robots.values()} == {None, checks.HOP_M}
    robots = {"T1": TELLO_TABLE, "CF01": OTHER}
    case = alone(Plan(small(robots))).experiment
    assert {name: robot.hover for name, robot in case.robots.items()} == {"T1": 0.8, "CF01": checks.HOP_M}


def pushed(forward, back, yaw=0.5):
    """States of a drone that flies forward from 1 to 3 s and back from 4 to 6 s [m/s], with a lag."""
    along = speed = 0.0
    flown = []
    for k in range(350):
        t = 0.02 * k
        wanted = forward if 1.0 <= t < 3.0 else -back if 4.0 <= t < 6.0 else 0.0
        speed += 0.02 / 0.3 * (wanted - speed)
        along += 0.02 * speed
        flown.append(State("T1", k, t, "airborne", (along * math.cos(yaw), along * math.sin(yaw), 0.8), yaw=yaw))
    return flown


def tried_sticks(believed=1.0, **tried):
    each = Observed(changed(TELLO_TABLE, device={"stick_speed": believed}))
    return checks.trial(TELLO.trial, each, Tried(**tried))


@pytest.mark.parametrize(
    ("forward", "back", "believed", "verdict", "text"),
    [
        (0.2, 0.2, 1.0, "ok", "0.99 m/s at full deflection (0.99 forward, 0.99 back)"),
        (0.2, 0.22, 0.5, "ok", "0.52 m/s"),  # twice the deflection
        (0.3, 0.3, 1.0, "bad", "1.49 m/s"),
        (0.2, 0.08, 1.0, "bad", "0.40 back"),
        (0.0, 0.0, 1.0, "bad", "0.00 m/s"),
    ],
)
def test_the_speed_of_sticks(forward, back, believed, verdict, text):
    made = tried_sticks(believed, states=pushed(forward, back))
    assert made.verdict == verdict, made
    assert text in made.found
    assert ("stick_speed = 1.49" in made.remedy) == (forward == back == 0.3)


def test_sticks_that_could_not_be_measured():
    assert tried_sticks(failure="not ready: no position").verdict == "bad"
    fast = tried_sticks(failure="came down by itself: it moves", states=pushed(0.5, 0.0)[:200])
    assert "double stick_speed" in fast.remedy
    assert tried_sticks(states=pushed(0.2, 0.2)[:20]).verdict == "bad"


class Trying(Inspector):
    """Checks of one robot on wheels, which obeys at once; the user interrupts when it is in the phase `at`."""

    def __init__(self, at):
        self._experiment, self._trials, self._clock = document.read("triangle").experiment, Trials(hop=True), Clock()
        self._robots, self._ended, self._states = {"KH01": RobotView()}, {}, {}
        self._context = SimpleNamespace(ended=lambda: self._robots["KH01"].phase == at, emergency=None)
        self._processes = SimpleNamespace(adopted=(), start=lambda *_: None, end_robots=lambda: None)
        self._view = SimpleNamespace(order=self._obey)
        self.given = []

    def _update(self):
        if self._robots["KH01"].status is None:
            self._enter("ready")

    def _obey(self, _names, order):
        self.given.append(order.order)
        self._enter({"takeoff": "airborne", "start": "done"}.get(order.order, self._robots["KH01"].phase))
        return {"KH01": Reply("KH01", ok=True, phase="")}

    def _enter(self, phase):
        self._robots["KH01"].status = changed(status("KH01"), phase=phase)

    def tried(self):
        return self._move("KH01", self._experiment.robots["KH01"])


@pytest.mark.parametrize(("at", "given"), [("ready", []), ("airborne", ["takeoff"]), ("never", ["takeoff", "start"])])
def test_interrupt_before_a_trial_moves_nothing(at, given):
    trying = Trying(at)
    assert bool(trying.tried().failure) == (at != "never")
    assert [order for order in trying.given if order != "inspect"] == given


@pytest.mark.parametrize(
    ("at", "verdict", "found"),
    [
        ("airborne", "unknown", "interrupted; look at it: it is landing"),
        ("never", "bad", "its position was not known"),
    ],
)
def test_end_behind_a_trial_hides_no_bad_verdict(at, verdict, found):
    """The user interrupts in the middle of a drive, or while its robot is ended."""
    trying = Trying(at)
    trying._context.ended = lambda: trying._robots["KH01"].phase in (at, "landing")
    trying._processes = SimpleNamespace(
        adopted=(), start=lambda *_: None, robot=lambda _: WHEELS, end_robots=lambda: trying._enter("landing")
    )
    trying._progress, trying._show = SimpleNamespace(phase=""), lambda _: None
    trying._view.report = lambda *_: None
    made = next(iter(trying._try("KH01", observed_still(WHEELS), red=False)))
    assert (made.verdict, made.found) == (verdict, found)


class Hopping(Trying):
    """Checks of a drone that goes aside in its hop, at x [m]."""

    def __init__(self, robot, x):
        super().__init__("never")
        self._robot, self._x, self._ticks = robot, x, 0
        self._experiment = small({"KH01": robot})
        self._progress = SimpleNamespace(states=[])

    def _update(self):
        super()._update()
        self._ticks += 1
        x = self._x if self._ticks > 5 else 0.0
        self._states.get("KH01", []).append(State("KH01", self._ticks, 0.02 * self._ticks, "", (x, 0.0, 0.2)))

    def _obey(self, names, order):
        if order.order in ("stop", "land"):
            self._enter("done")
        return super()._obey(names, order) if order.order != "takeoff" else {"KH01": Reply("KH01", ok=True, phase="")}


@pytest.mark.parametrize(
    ("robot", "x", "end"),
    [
        (changed(DRONE, position="external", device={}), 0.12, "stop"),
        (DRONE, 0.12, "land"),
        (changed(TELLO_TABLE, body="tello://192.168.10.1"), 0.25, "land"),
    ],
)
def test_hop_that_goes_aside_ends_there(robot, x, end):
    trying = Hopping(robot, x)
    tried = trying.tried()
    assert tried.failure.startswith(f"{x:.2f} m to the side (limit ")
    assert [order for order in trying.given if order != "inspect"][-1] == end
    assert "yaw of its positions" in checks.hop(observed_still(robot), tried, Safety()).remedy
