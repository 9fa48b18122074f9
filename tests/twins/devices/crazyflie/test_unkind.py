"""What the firmware does that no client wants: the twin does it, too (seen on the real one, run in the loop)."""

import math
import struct

import numpy as np
import pytest

from agents.protocols.crtp import HighLevel, Location, LogStatus, Port, Setpoint, SupervisorCommand
from tests.twins.crazyflie_wire import Wire
from twins.devices.crazyflie.supervisor import SupervisorState

LEAST = "posCtlPid.thrustMin"


def setpoint(wire, kind, *values):
    wire.put(Port.SETPOINT, 0, int(kind), struct.pack("<4f", *values))


def set_parameter(wire, name, packing, value):
    wire.put(Port.PARAM, 2, struct.pack(f"<H{packing}", wire.drone.parameters.number[name], value))


# ---------------------------------------------------------------------- commands


@pytest.mark.slow
@pytest.mark.parametrize(
    ("takeoff", "land"),
    [
        ((HighLevel.OLD_TAKEOFF, "<ff", (0.5, 1.5)), (HighLevel.OLD_LAND, "<ff", (0.0, 1.5))),
        (
            (HighLevel.TAKEOFF_VELOCITY, "<f?f?f", (0.5, False, 0.0, True, 0.5)),
            (HighLevel.LAND_VELOCITY, "<f?f?f", (0.0, False, 0.0, True, 0.5)),
        ),
        (
            (HighLevel.TAKEOFF_VELOCITY, "<f?f?f", (0.5, True, 0.0, True, 0.0)),
            (HighLevel.LAND_VELOCITY, "<f?f?f", (0.5, True, 0.0, True, 0.0)),
        ),
    ],
)
def test_older_commands_are_flown(takeoff, land):
    wire = Wire()
    assert wire.plan(takeoff[0], struct.pack(takeoff[1], *takeoff[2])) == LogStatus.OK
    wire.wait(3.5)
    assert wire.position == pytest.approx([0.0, 0.0, 0.5375], abs=0.01)  # it overshoots
    assert wire.plan(HighLevel.OLD_GO_TO, struct.pack("<?fffff", False, 0.3, -0.2, 0.6, 0.0, 2.0)) == LogStatus.OK
    wire.wait(12.0)
    assert wire.position == pytest.approx([0.3, -0.2, 0.6], abs=0.01)
    assert wire.plan(land[0], struct.pack(land[1], *land[2])) == LogStatus.OK
    wire.wait(4.0)
    assert not wire.motors
    assert wire.position[2] == 0.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new"),
    [
        (Setpoint.OLD_VELOCITY, Setpoint.VELOCITY),
        (Setpoint.OLD_HOVER, Setpoint.HOVER),
        (Setpoint.OLD_HEIGHT, Setpoint.HEIGHT),
    ],
)
def test_older_setpoints_turn_the_other_way(old, new):
    yaws = []
    for kind in (old, new):
        wire = Wire().hovering()
        values = (0.0, 0.0, 0.0, 30.0) if new == Setpoint.VELOCITY else (0.0, 0.0, 30.0, 1.0)
        wire.wait(1.0, lambda: setpoint(wire, kind, *values))  # noqa: B023
        yaws.append(wire.flock.quadrotor.yaw[0])
        assert wire.position[2] == pytest.approx(1.0, abs=0.01)
    assert yaws[0] == pytest.approx(-yaws[1])
    assert abs(yaws[1]) == pytest.approx(math.radians(30.0), rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(("lean", "axis", "sign"), [((10.0, 0.0), 1, -1.0), ((0.0, 10.0), 0, -1.0)])
@pytest.mark.parametrize("kind", [Setpoint.HEIGHT, Setpoint.OLD_HEIGHT])
def test_roll_and_pitch_are_flown(kind, lean, axis, sign):
    """To the right, and backwards with the nose up: 1.7 m/s² at 10°, reached with the lag of tilting, 0.2 s."""
    wire = Wire().hovering()
    wire.wait(0.3, lambda: setpoint(wire, kind, *lean, 0.0, 1.0))
    velocity = wire.flock.quadrotor.velocity[0]
    lasted_s = 0.3 - 0.2 * (1.0 - math.exp(-0.3 / 0.2))
    assert velocity[axis] == pytest.approx(sign * lasted_s * 9.81 * math.tan(math.radians(10.0)), rel=0.05)
    assert velocity[1 - axis] == pytest.approx(0.0, abs=1e-9)


def test_unknown_setpoint_cuts_the_motors():
    wire = Wire().hovering()
    setpoint(wire, 99, 0.0, 0.0, 0.0, 1.0)
    wire.wait(0.3)
    assert not wire.motors
    assert wire.position[2] < 0.7


def test_thrust_needs_a_zero_first():
    wire = Wire()
    wire.wait(1.0, lambda: wire.put(Port.COMMANDER, 0, struct.pack("<fffH", 0.0, 0.0, 0.0, 45000)))
    assert not wire.motors
    wire.zero()
    wire.wait(1.0, lambda: wire.put(Port.COMMANDER, 0, struct.pack("<fffH", 0.0, 0.0, 0.0, 45000)))
    assert wire.motors
    assert wire.position[2] > 0.1


@pytest.mark.slow
def test_drone_disarmed_aloft_falls_and_is_ready():
    wire = Wire().hovering(0.5)
    wire.put(Port.SUPERVISOR, 1, int(SupervisorCommand.ARM), 0)
    wire.wait(0.1)
    assert not wire.motors
    wire.wait(6.0)
    assert wire.position[2] == 0.0
    assert wire.state == SupervisorState.READY
    assert wire.takeoff(0.5, 1.0) == LogStatus.OK


def test_a_plan_that_is_no_number_locks():
    wire = Wire().hovering(0.5)
    wire.go_to(math.nan, 0.0, 0.5, 0.0, 1.0)
    wire.wait(0.1)
    assert not wire.motors
    assert wire.state == SupervisorState.LOCKED


@pytest.mark.slow
def test_a_flat_fall_is_a_landing():
    wire = Wire().hovering(0.8)
    wire.plan(HighLevel.STOP)
    wire.wait(5.0)
    assert wire.position[2] == 0.0
    assert wire.state in {SupervisorState.LANDED, SupervisorState.READY}
    assert wire.takeoff(0.5, 1.0) == LogStatus.OK


# ---------------------------------------------------------------------- the floor, motors on


def left_alone(wire, seconds):
    """Descended below the floor, with a drifting estimate; returns how far it has gone [m]."""

    def located():
        wire.put(Port.LOCATION, 0, struct.pack("<fff", *wire.position))

    wire.wait(1.0, located)
    assert wire.takeoff(0.5, 1.5) == LogStatus.OK
    wire.wait(2.0, located)
    wire.go_to(0.0, 0.0, -1.0, 0.0, 4.0)
    wire.wait(4.0)
    assert wire.position[2] == 0.0
    begin = wire.position.copy()
    wire.wait(seconds)
    assert wire.motors
    assert wire.position[2] == 0.0
    return float(np.hypot(*(wire.position - begin)[:2]))


@pytest.mark.slow
@pytest.mark.parametrize("platform", ["crazyflie", "brushless"])
def test_it_skates_with_the_least_thrust(platform):
    """By its own estimate, which drifts without motion capture; not with less than the firmware's default."""
    ways = {}
    for thrust in (20000, 5000):
        wire = Wire(device={"platform": platform}, external=True)
        if platform == "brushless":
            wire.arm()
            wire.wait(0.6)
        set_parameter(wire, LEAST, "H", thrust)
        ways[thrust] = left_alone(wire, 15.0)
        assert np.hypot(*wire.flock.quadrotor.velocity[0, :2]) <= 2.0
    assert ways[20000] > 5.0
    assert ways[5000] == 0.0


# ---------------------------------------------------------------------- what it believes


def test_frozen_positions_shoot_it_up():
    """The same position again and again holds the estimate, and its velocity: it climbs, faster and faster."""
    wire = Wire(external=True)

    def located():
        wire.put(Port.LOCATION, 0, struct.pack("<fff", 0.0, 0.0, 0.0))

    wire.wait(1.0, located)
    assert wire.takeoff(0.2, 1.5) == LogStatus.OK
    wire.wait(1.5, located)
    assert wire.flock.estimate[0, 2] < 0.1
    assert wire.flock.quadrotor.velocity[0, 2] > 0.4
    wire.wait(2.5, located)
    assert wire.position[2] > 2.0


@pytest.mark.slow
@pytest.mark.parametrize(("wrong", "far"), [(0.0, 0.02), (20.0, 0.05), (100.0, 1.0)])
def test_a_wrong_yaw_leads_astray(wrong, far):
    """A goal ahead is approached on a curve; beyond a right angle not at all."""
    wire = Wire(yaw=math.radians(-wrong))
    wire.flock.estimator.turn[0] = math.radians(wrong)
    wire.hovering(0.5)
    assert wire.flock.pose(0)[3] == pytest.approx(0.0)
    wire.go_to(0.5, 0.0, 0.5, 0.0, 2.0)
    wire.wait(8.0)
    assert wire.flock.estimated_yaw(0) == pytest.approx(0.0, abs=0.01)
    away = float(np.hypot(*(wire.position - [0.5, 0.0, 0.5])[:2]))
    assert away < far if wrong < 90.0 else away > far


def test_an_external_attitude_corrects_the_yaw():
    wire = Wire(external=True, yaw=1.0)
    wire.flock.estimator.turn[0] = 0.7
    pose = struct.pack("<7f", 0.0, 0.0, 0.0, 0.0, 0.0, math.sin(0.5), math.cos(0.5))
    wire.put(Port.LOCATION, 1, int(Location.POSE), pose)
    assert wire.flock.estimated_yaw(0) == pytest.approx(1.0)
