"""What the firmware does that no client wants: the twin does it, too (seen on the real one, run in the loop)."""

import math
import struct
from dataclasses import replace

import numpy as np
import pytest

from agents.protocols.crtp import HighLevel, Location, LogStatus, Port, Setpoint
from tests.requests import request
from tests.twins.crazyflie_wire import DT, Wire
from twins.devices.crazyflie.supervisor import SupervisorState
from twins.devices.crazyflie.vehicle import Vehicle
from twins.devices.device import Faults


@pytest.mark.slow
def test_older_commands_are_flown():
    up, down, fast = HighLevel.TAKEOFF_VELOCITY, HighLevel.LAND_VELOCITY, "f?f?f"
    for takeoff, land in (
        ((HighLevel.OLD_TAKEOFF, "ff", 0.5, 1.5), (HighLevel.OLD_LAND, "ff", 0.0, 1.5)),
        ((up, fast, 0.5, False, 0.0, True, 0.5), (down, fast, 0.0, False, 0.0, True, 0.5)),
        ((up, fast, 0.5, True, 0.0, True, 0.0), (down, fast, 0.5, True, 0.0, True, 0.0)),
    ):
        wire = Wire()
        assert wire.plan(*takeoff) == LogStatus.OK
        assert wire.after(3.5).position == pytest.approx([0.0, 0.0, 0.5375], abs=0.01)  # it overshoots
        assert wire.plan(HighLevel.OLD_GO_TO, "?fffff", False, 0.3, -0.2, 0.6, 0.0, 2.0) == LogStatus.OK
        assert wire.after(12.0).position == pytest.approx([0.3, -0.2, 0.6], abs=0.01)
        assert wire.plan(*land) == LogStatus.OK
        assert not wire.after(4.0).motors
        assert wire.position[2] == 0.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "values", "sense"),
    [
        (Setpoint.OLD_VELOCITY, (0.0, 0.0, 0.0, 30.0), -1.0),
        (Setpoint.OLD_HOVER, (0.0, 0.0, 30.0, 1.0), -1.0),
        (Setpoint.OLD_HEIGHT, (0.0, 0.0, 30.0, 1.0), -1.0),
        (Setpoint.HOVER, (0.0, 0.0, 30.0, 1.0), 1.0),
        (Setpoint.HEIGHT, (0.0, 0.0, 30.0, 1.0), 1.0),
    ],
)
def test_older_setpoints_turn_the_other_way(kind, values, sense):
    wire = Wire().hovering()
    wire.wait(1.0, lambda: wire.setpoint(kind, *values))
    assert wire.position[2] == pytest.approx(1.0, abs=0.01)
    assert wire.yaw == pytest.approx(sense * math.radians(30.0), rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "lean", "axis"), [(Setpoint.HEIGHT, (10.0, 0.0), 1), (Setpoint.OLD_HEIGHT, (0.0, 10.0), 0)]
)
def test_roll_and_pitch_are_flown(kind, lean, axis):
    """To the right, and backwards with the nose up: 1.7 m/s² at 10°, reached with the lag of tilting, 0.2 s."""
    wire = Wire().hovering()
    velocity = wire.after(0.3, lambda: wire.setpoint(kind, *lean, 0.0, 1.0)).velocity
    lasted_s = 0.3 - 0.2 * (1.0 - math.exp(-0.3 / 0.2))
    assert velocity[axis] == pytest.approx(-lasted_s * 9.81 * math.tan(math.radians(10.0)), rel=0.05)
    assert velocity[1 - axis] == pytest.approx(0.0, abs=1e-9)


def test_what_is_no_setpoint_cuts_or_locks():
    wire = Wire().hovering()
    wire.setpoint(99, 0.0, 0.0, 0.0, 1.0)
    assert not wire.after(0.3).motors
    assert wire.position[2] < 0.7
    wire = Wire().hovering()
    wire.go_to(math.nan, 0.0, 1.0, 0.0, 1.0)
    assert wire.after(0.1).state == SupervisorState.LOCKED
    assert not wire.motors


def test_thrust_needs_a_zero_first():
    wire = Wire()
    assert not wire.after(1.0, lambda: wire.thrust(45000)).motors
    wire.zero()
    assert wire.after(1.0, lambda: wire.thrust(45000)).motors
    assert wire.position[2] > 0.1
    wire = Wire()
    wire.zero()
    assert wire.after(1.0, lambda: wire.thrust(20000)).motors
    assert wire.position.tolist() == [0.0, 0.0, 0.0]  # too little to carry it


@pytest.mark.slow
def test_a_flat_fall_is_a_landing():
    wire = Wire().hovering(0.8)
    wire.plan(HighLevel.STOP)
    assert not wire.after(0.1).motors
    assert wire.after(6.0).position[2] == 0.0
    assert wire.state == SupervisorState.READY
    assert wire.takeoff(0.5, 1.0) == LogStatus.OK


@pytest.mark.slow
@pytest.mark.parametrize(("thrust", "least", "most"), [(20000, 5.0, 30.0), (5000, 0.0, 0.0)])
def test_it_skates_with_the_least_thrust(thrust, least, most):
    wire = Wire(external=True)
    wire.set("posCtlPid.thrustMin", "H", thrust)
    assert wire.after(1.0, wire.locate).takeoff(0.5, 1.5) == LogStatus.OK
    wire.after(2.0, wire.locate).go_to(0.0, 0.0, -1.0, 0.0, 4.0)
    assert wire.after(4.0).position[2] == 0.0
    begin = wire.position.copy()
    assert wire.after(15.0).motors
    assert wire.position[2] == 0.0
    assert least <= math.dist(begin, wire.position) <= most


def test_frozen_positions_shoot_it_up():
    """The same position again and again holds the estimate, and its velocity: it climbs, faster and faster."""
    wire = Wire(external=True)

    def located():
        wire.locate([0.0, 0.0, 0.0])

    assert wire.after(1.0, located).takeoff(0.2, 1.5) == LogStatus.OK
    assert wire.after(1.5, located).estimate[2] < 0.1
    assert wire.velocity[2] > 0.4
    assert wire.after(2.5, located).position[2] > 2.0


@pytest.mark.slow
@pytest.mark.parametrize(("wrong", "least", "most"), [(20.0, 0.0, 0.05), (100.0, 1.0, math.inf)])
def test_a_wrong_yaw_leads_astray(wrong, least, most):
    wire = Wire(yaw=math.radians(-wrong))
    wire.vehicle.estimator.turn = math.radians(wrong)
    wire.hovering(0.5)
    assert wire.vehicle.pose[3] == pytest.approx(0.0)
    wire.go_to(0.5, 0.0, 0.5, 0.0, 2.0)
    assert least < math.dist(wire.after(8.0).position[:2], [0.5, 0.0]) < most


def test_an_external_attitude_corrects_the_yaw():
    wire = Wire(external=True, yaw=1.0)
    wire.vehicle.estimator.turn = 0.7
    wire.put(Port.LOCATION, 1, Location.POSE, struct.pack("<7f", 0, 0, 0, 0, 0, math.sin(0.5), math.cos(0.5)))
    assert wire.vehicle.yaw == pytest.approx(1.0)


def heights(wire, seconds, each=None):
    return np.array([wire.after(DT, each).position[2] for _ in range(round(seconds / DT))])


def advance(vehicles, t):
    for vehicle in vehicles:
        vehicle.advance(t)
    return [vehicle.model.held[2] for vehicle in vehicles]


@pytest.mark.slow
def test_take_off_overshoots_and_returns():
    """By 7 to 11 %, for 10 to 15 s: the integral of the height was charged on the floor and on the way."""
    climbs = [(0.5, 1.5), (0.8, 2.0), (1.0, 2.5), (1.0, 2.0), (2.0, 5.0)]
    asked = request("crazyflie", ["x"] * 2 * len(climbs))
    platforms = ({"platform": platform} for platform in ("crazyflie", "brushless") for _ in climbs)
    asked = replace(asked, device=tuple(platforms))
    vehicles = [Vehicle(asked, Faults(), row) for row in range(2 * len(climbs))]
    assert all(vehicle.arm(on=True) for vehicle in vehicles[len(climbs) :])
    begin, at = 0.6, np.zeros(4)  # the motors of those that are armed spin up
    for t in np.arange(DT, begin + DT / 2, DT):
        advance(vehicles, t)
    for vehicle, (height, span) in zip(vehicles, climbs * 2, strict=True):
        vehicle.planner.climb(vehicle.t, at, height=height, yaw=0.0, span=span, landing=False)
    reached = [advance(vehicles, t) for t in begin + np.arange(DT, 20.0, DT)]
    share = np.array(reached) / [height for height, _ in climbs * 2] - 1.0
    for row in share.T:
        assert 0.07 < row.max() < 0.11
        assert 10.0 < DT * np.flatnonzero(np.abs(row) > 0.01)[-1] < 15.0  # until it settles


@pytest.mark.slow
@pytest.mark.parametrize("wait", [1.0, 3.3])
def test_landing_from_the_overshoot_ends_on_the_floor(wait):
    wire = Wire()
    wire.takeoff(1.0, 2.5)
    wire.after(wait).land(1.1 / 0.22)
    lowest = []
    while wire.motors:
        lowest.append(wire.position[2])
        wire.wait(DT)
    assert lowest[-1] < 0.005
    assert np.diff(lowest).min() / DT > -0.5


@pytest.mark.parametrize("waited_s", [0.2, 3.0])
def test_raw_thrust_has_no_memory(waited_s):
    wire = Wire()
    wire.zero()
    wire.after(waited_s, lambda: wire.thrust(20000))
    assert wire.motors
    rise = wire.after(1.0, lambda: wire.thrust(45000)).position[2]
    spun_up_s = 0.03 * np.log((45000 - 20000) / (45000 - 39300))
    assert rise == pytest.approx(0.5 * 9.81 * (45000 / 39300 - 1.0) * (0.97 - spun_up_s) ** 2, rel=0.03)
    wire.after(1.0, lambda: wire.thrust(39300))
    height = wire.position[2] + 0.1 * wire.velocity[2]
    assert heights(wire, 6.0, lambda: wire.goal(0.0, 0.0, height))[-1] == pytest.approx(height, abs=0.05)
