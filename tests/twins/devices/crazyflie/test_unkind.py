"""What the firmware does that no client wants: the twin does it, too (seen on the real one, run in the loop)."""

import math
import struct

import pytest

from agents.protocols.crtp import HighLevel, Location, LogStatus, Port, Setpoint
from tests.twins.crazyflie_wire import Wire
from twins.devices.crazyflie.supervisor import SupervisorState


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


def test_unknown_setpoint_cuts_the_motors():
    wire = Wire().hovering()
    wire.setpoint(99, 0.0, 0.0, 0.0, 1.0)
    assert not wire.after(0.3).motors
    assert wire.position[2] < 0.7


def test_thrust_needs_a_zero_first():
    wire = Wire()
    assert not wire.after(1.0, lambda: wire.thrust(45000)).motors
    wire.zero()
    assert wire.after(1.0, lambda: wire.thrust(45000)).motors
    assert wire.position[2] > 0.1


@pytest.mark.slow
def test_a_flat_fall_is_a_landing():
    wire = Wire().hovering(0.8)
    wire.plan(HighLevel.STOP)
    assert not wire.after(0.1).motors
    assert wire.after(6.0).position[2] == 0.0
    assert wire.state == SupervisorState.READY
    assert wire.takeoff(0.5, 1.0) == LogStatus.OK


def test_a_plan_that_is_no_number_locks():
    wire = Wire().hovering()
    wire.go_to(math.nan, 0.0, 1.0, 0.0, 1.0)
    assert wire.after(0.1).state == SupervisorState.LOCKED
    assert not wire.motors


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
