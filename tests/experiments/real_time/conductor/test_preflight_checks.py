"""Checks before the first flight: what each finds, when it is red, and which remedy it names."""

from __future__ import annotations

import math
from datetime import date

import msgspec
import pytest

from agents.body.limits import Safety
from agents.body.measured_positions import FROZEN
from agents.kinds.tello import TELLO
from agents.network.messages import Inspection, State, Status
from experiments.definition.experiment import Experiment, RobotTable
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.real_time.conductor import preflight_checks as checks
from experiments.real_time.conductor.preflight import alone
from experiments.real_time.conductor.preflight_checks import Check, Observed, Tried

TODAY = date(2026, 3, 1)
RADIO = "radio://0/80/2M/E7E7E7E70"
LIGHTHOUSE = {"positioning": {"system": "lighthouse"}}
DRONE = RobotTable(kind="crazyflie", start=[0.0, 0.5, 0.0], hover=0.2, body=f"{RADIO}1", device=LIGHTHOUSE)
OTHER = RobotTable(kind="crazyflie", start=[0.0, -0.5, 0.0], hover=0.8, body=f"{RADIO}2", device=LIGHTHOUSE)
WHEELS = RobotTable(kind="khepera4", start=[1.0, 0.0], body="khepera4://192.0.2.1")


def states(*places, yaw: float | None = 0.0) -> list[State]:
    return [State("CF01", k, 0.02 * k, "idle", place, yaw=yaw) for k, place in enumerate(places)]


def observed_still(
    robot=DRONE, *, place=(0.0, 0.5, 0.0), noise=0.0, yaw: float | None = 0.0, said=None, **inspected
) -> Observed:
    """A robot at rest: what its process says, and what its device has told."""
    x, y, z = place
    known = {"firmware": "2025.02", "volts": 4.1, "age_s": 0.02, **inspected}
    status = Status(**{"robot": "CF01", "stamp": 0.0, "phase": "ready", "reason": "", "battery": 0.9, **(said or {})})
    seen = states((x - noise, y, z), (x + noise, y, z), yaw=yaw)
    return Observed(robot, status, "", seen, [Inspection(**known)], 0.001)


def checked(each: Observed, **others: Observed):
    return checks.at_rest({"CF01": each, **others}, Safety(), TODAY)["CF01"]


def found(each: Observed, check: str, **others: Observed):
    return next(one for one in checked(each, **others) if one.check == check)


def test_a_robot_that_is_in_order_is_green():
    made = checked(observed_still(packets_hz=180.0, capacity_hz=250.0))
    assert {each.check: each.verdict for each in made} == dict.fromkeys(
        ["address", "firmware", "battery", "position", "start pose", "radio", "clock", "ready"], "ok"
    )
    assert not any(each.remedy for each in made)


LEANS = "it is not level: it leans 40°"
LOCKED = "locked: switch it off and on"


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
        ({"place": (0.5, 0.5, 0.0)}, "start pose", "bad", "0.50 m from `start`, turned by 0°"),
        ({"yaw": 1.0}, "start pose", "bad", "0.00 m from `start`, turned by 57°"),
        ({"yaw": None}, "start pose", "ok", "0.00 m from `start`"),
        ({"said": {"battery": 0.1}}, "battery", "bad", "10%, 4.10 V, less than 20%"),
        ({"said": {"phase": "idle", "reason": LEANS}}, "ready", "bad", LEANS),
        ({"said": {"phase": "idle", "reason": LOCKED}}, "ready", "bad", LOCKED),
        ({"said": {"body": "3 positions refused"}}, "address", "warn", "answers; 3 positions refused"),
    ],
)
def test_what_is_measured_at_rest(changed, check, verdict, text):
    made = found(observed_still(**changed), check)
    assert (made.verdict, bool(made.remedy), made.found) == (verdict, verdict in ("warn", "bad"), text)


def test_clock_of_another_computer_is_compared():
    each = observed_still()
    each.behind_s = -1.5
    assert found(each, "clock").found == "its computer's is +1.50 s off"


@pytest.mark.parametrize(("other_y", "here_y", "there_y"), [(-0.5, -0.5, 0.5), (0.3, 0.38, 0.42)])
def test_swapped_robots_are_named(other_y, here_y, there_y):
    other = msgspec.structs.replace(OTHER, start=[0.0, other_y, 0.0])
    there = observed_still(other, place=(0.0, there_y, 0.0))
    assert found(observed_still(place=(0.0, here_y, 0.0)), "start pose", CF02=there).remedy == (
        "it stands where CF02 begins: addresses, markers or robots are swapped"
    )
    assert found(observed_still(place=(0.0, 0.41, 0.0)), "start pose", CF02=there).verdict == "ok"


@pytest.mark.parametrize(
    ("robot", "verdict"),
    [
        (msgspec.structs.replace(DRONE, device={}), "unknown"),
        (msgspec.structs.replace(DRONE, device={}, body="crazyflie-twin"), "unknown"),
        (msgspec.structs.replace(DRONE, device={}, position="external"), "ok"),
        (WHEELS, "unknown"),
        (msgspec.structs.replace(WHEELS, position="external"), "ok"),
        (msgspec.structs.replace(WHEELS, body="world"), "ok"),
    ],
)
def test_robots_that_count_from_start_are_unknown(robot, verdict):
    x, y = robot.start[:2]
    assert found(observed_still(robot, place=(x, y, 0.0), noise=0.0005), "start pose").verdict == verdict
    assert found(observed_still(robot, place=(5.0, 5.0, 0.0)), "start pose").verdict == "bad"


@pytest.mark.parametrize(
    ("body", "position", "verdict"),
    [(DRONE.body, "external", "bad"), ("world", "external", "ok"), (DRONE.body, "body", "ok")],
)
def test_captured_positions_that_never_change_are_red(body, position, verdict):
    robot = msgspec.structs.replace(DRONE, body=body, position=position)
    assert found(observed_still(robot), "position").verdict == verdict
    if position == "external":
        each = observed_still(robot, said={"body": f"{FROZEN}; connected"})
        each.states = []
        assert (found(each, "position").verdict, found(each, "position").found) == ("bad", FROZEN)


def test_a_stop_at_rest_tries_no_crazyflie():
    tried = Tried(stopped_s=0.1)
    assert checks.stop_at_rest(DRONE, tried) == Check("stop, motors off", "unknown", "not tried: --stop tries it")
    for robot in (WHEELS, msgspec.structs.replace(DRONE, body="twin")):
        assert checks.stop_at_rest(robot, tried).verdict == "ok"
    assert checks.stop_at_rest(DRONE, Tried(failure="refused: no answer")).verdict == "bad"


def test_robots_of_a_kind_have_the_same_firmware():
    made = found(observed_still(), "firmware", CF02=observed_still(OTHER, firmware="2025.09"))
    assert (made.verdict, made.remedy) == ("warn", "CF02 has 2025.09: flash the same to all of a kind")


@pytest.mark.parametrize(
    ("body", "remedy"),
    [(DRONE.body, "switch it on"), ("quad://127.0.0.1:6001", "is it switched on, and its address right?")],
)
def test_unresponsive_robot_has_one_red_line(body, remedy):
    (made,) = checked(Observed(msgspec.structs.replace(DRONE, body=body), ended="no answer"))
    assert (made.check, made.verdict, made.found) == ("address", "bad", "no answer")
    assert made.remedy.startswith(remedy)


def test_one_drone_of_a_process_that_never_answered():
    said = {
        "battery": None,
        "phase": "idle",
        "reason": "no position of its own",
        "body": "no answer at radio://0/80/...",
    }
    each = observed_still(said=said)
    each.states, each.inspections = states(None), [Inspection()]
    assert found(each, "address").verdict == found(each, "ready").verdict == "bad"


def test_robot_without_position_is_not_placed_anywhere():
    each = observed_still()
    each.states = []
    assert [found(each, check).verdict for check in ("position", "start pose")] == ["bad", "unknown"]


@pytest.mark.parametrize(
    ("tried", "verdict"),
    [
        (Tried(stopped_s=0.1), "ok"),
        (Tried(stopped_s=1.5), "bad"),
        (Tried(stopped_s=math.nan, note="the emergency stop is not answered"), "bad"),
        (Tried(failure="refused: no answer"), "bad"),
    ],
)
def test_stops(tried, verdict):
    assert checks.stop("stop, motors off", tried).verdict == verdict
    made = checks.stop_in_motion(observed_still(), tried)
    assert (made.verdict, "locked" in made.found) == (verdict, verdict == "ok")


def test_wheeled_robot_that_rolls_on_after_the_stop():
    rolled = Tried(stopped_s=0.5, states=states((0.0, 0.0, 0.0), (0.1, 0.0, 0.0)))
    assert checks.stop_in_motion(observed_still(WHEELS), rolled).verdict == "bad"
    assert checks.stop_in_motion(observed_still(WHEELS), Tried(stopped_s=0.5)).verdict == "ok"


@pytest.mark.parametrize(
    ("robot", "end", "verdict", "remedy"),
    [
        (DRONE, (0.02, 0.5, 0.21), "ok", ""),
        (DRONE, (0.0, 0.5, 0.05), "bad", "does not keep its height"),
        (DRONE, (0.3, 0.5, 0.2), "bad", "drifts"),
        (WHEELS, (0.1, 0.5, 0.0), "ok", ""),
        (WHEELS, (0.0, 0.5, 0.0), "bad", "does not drive although commanded to"),
        (WHEELS, (0.2, 0.5, 0.0), "bad", "its speed is not the commanded one"),
    ],
)
def test_hops_and_drives(robot, end, verdict, remedy):
    tried = Tried(states=states((0.0, 0.5, 0.0), end, end), volts=3.7, charge=0.6)
    made = checks.hop(observed_still(robot), tried, Safety())
    assert made.verdict == verdict
    assert made.remedy.startswith(remedy)
    assert made.found.endswith("; battery 60%, 3.70 V under load")
    assert checks.hop(observed_still(robot), Tried(states=tried.states, charge=0.05), Safety()).verdict == "bad"


def test_robots_are_checked_without_formation_and_low():
    read = document.load("robotic-park")
    plan = alone(next(iter(read.cases().values())))
    case = plan.experiment
    assert len(plan.links) == 0
    assert {case.robots[leg.robot].kind for leg in case.timeline} == {"khepera4", "turtlebot3"}
    assert {robot.hover for robot in case.robots.values()} == {None, checks.HOP_M}


def test_a_tello_takes_off_to_its_own_height():
    robots = {"T1": RobotTable(kind="tello", start=[0.0, 0.0], hover=0.8), "CF01": OTHER}
    case = alone(Plan(Experiment(title="", duration_s=1.0, robots=robots)))
    assert {name: robot.hover for name, robot in case.experiment.robots.items()} == {"T1": 0.8, "CF01": checks.HOP_M}


def pushed(forward: float, back: float, *, yaw: float = 0.5) -> list[State]:
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
    each = Observed(RobotTable(kind="tello", start=[0.0, 0.0], hover=0.8, device={"stick_speed": believed}))
    made = checks.trial(TELLO.trial, each, Tried(states=pushed(forward, back)))
    assert made.verdict == verdict, made
    assert text in made.found
    if forward == back == 0.3:
        assert "stick_speed = 1.49" in made.remedy


def test_sticks_that_could_not_be_measured():
    each = Observed(RobotTable(kind="tello", start=[0.0, 0.0], hover=0.8))
    assert checks.trial(TELLO.trial, each, Tried(failure="not ready: no position")).verdict == "bad"
    fast = checks.trial(
        TELLO.trial, each, Tried(failure="came down by itself: it moves", states=pushed(0.5, 0.0)[:200])
    )
    assert "double stick_speed" in fast.remedy
    assert checks.trial(TELLO.trial, each, Tried(states=pushed(0.2, 0.2)[:20])).verdict == "bad"
