"""How a Crazyflie twin flies and when it refuses to, as the firmware does (seen on the real one, run in the loop)."""

import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from agents.protocols.crtp import (
    HighLevel,
    Info,
    Location,
    LogStatus,
    Platform,
    Port,
    Power,
    Setpoint,
    SupervisorCommand,
    yaw_of,
)
from tests.twins.crazyflie_wire import Wire
from twins.devices.crazyflie.planner import OnboardPlanners, evaluate, polynomial
from twins.devices.crazyflie.supervisor import SupervisorState

pytestmark = pytest.mark.slow  # seconds of firmware, in steps of milliseconds

numbers = st.floats(-3.0, 3.0)
axis = st.tuples(numbers, numbers, numbers)


# ---------------------------------------------------------------------- the planner


@given(axis, axis, st.floats(0.2, 5.0))
def test_polynomial_meets_both_ends(begin, end, span):
    """Position, velocity and acceleration as asked, no jerk, at both ends; checked by numpy's own polynomials."""
    coefficients = polynomial(span, tuple(np.array([v]) for v in begin), tuple(np.array([v]) for v in end))[0]
    path = Polynomial(coefficients)
    scale = 1.0 + np.abs(coefficients * span ** np.arange(8)).max()
    for t, wanted in ((0.0, begin), (span, end)):
        for order, value in enumerate((*wanted, 0.0)):
            got = path.deriv(order)(t) if order else path(t)
            assert abs(got - value) < 1e-9 * scale * max(1.0, span**-order) * 1e3
    value, first, second = evaluate(coefficients, np.array(0.3 * span))
    assert value == pytest.approx(path(0.3 * span))
    assert first == pytest.approx(path.deriv(1)(0.3 * span))
    assert second == pytest.approx(path.deriv(2)(0.3 * span))


def test_chained_plans_are_smooth():
    """A new goal in the middle of a plan: position and velocity do not jump."""
    planner = OnboardPlanners(1)
    planner.climb(0, 0.0, np.zeros(4), height=1.0, yaw=0.0, span=2.0, landing=False)
    for t, goal in ((1.0, [1.0, 0.5, 1.2, 1.0]), (1.7, [-0.5, 0.2, 0.8, -2.9]), (2.1, [0.0, 0.0, 1.0, 2.9])):
        before = [planner.goal(t - h)[0] for h in (2e-4, 1e-4)]
        planner.go_to(0, t, np.zeros(4), np.zeros(3), goal=np.array(goal), span=1.5, relative=False, linear=False)
        after = [planner.goal(t + h)[0] for h in (0.0, 1e-4)]
        assert after[0] == pytest.approx(before[1], abs=1e-3)
        assert (after[1] - after[0]) / 1e-4 == pytest.approx((before[1] - before[0]) / 1e-4, abs=2e-2)
    end = planner.goal(10.0)[0]
    assert end[:3] == pytest.approx([0.0, 0.0, 1.0])
    assert math.cos(end[3] - 2.9) == pytest.approx(1.0)
    assert planner.finished(10.0)[0]


def test_relative_and_linear_plans():
    planner = OnboardPlanners(2)
    for row in range(2):
        planner.climb(row, 0.0, np.zeros(4), height=1.0, yaw=0.0, span=1.0, landing=False)
    goal, at = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(4)
    planner.go_to(0, 2.0, at, np.zeros(3), goal=goal, span=2.0, relative=True, linear=True)
    assert planner.goal(2.5)[0] == pytest.approx([0.25, 0.0, 1.0, 0.0])
    assert planner.goal(5.0)[0] == pytest.approx([1.0, 0.0, 1.0, 0.0])
    assert planner.goal(5.0)[1] == pytest.approx([0.0, 0.0, 1.0, 0.0])  # each row for itself


# ---------------------------------------------------------------------- high level


def test_takeoff_go_to_land():
    """A whole flight by the planner; every command is answered, and what cannot be is refused."""
    wire = Wire()
    assert wire.takeoff(1.0, 2.0) == LogStatus.OK
    assert wire.takeoff(1.0, 2.0) == LogStatus.REFUSED
    wire.wait(4.0)
    assert wire.position == pytest.approx([0.0, 0.0, 1.07], abs=0.01)  # it overshoots
    assert wire.go_to(1.0, 0.5, 1.2, 1.0, 2.0) == LogStatus.OK
    wire.wait(15.0)
    assert wire.position == pytest.approx([1.0, 0.5, 1.2], abs=0.01)
    assert wire.flock.quadrotor.yaw[0] == pytest.approx(1.0, abs=0.01)
    assert wire.land(2.0) == LogStatus.OK
    assert wire.land(2.0) == LogStatus.REFUSED
    wire.wait(3.0)
    assert wire.position == pytest.approx([1.0, 0.5, 0.0], abs=0.01)
    assert not wire.motors
    assert Info.FLYING in wire.flock.info(0)  # for two seconds after its motors turned
    wire.wait(1.5)
    assert Info.FLYING not in wire.flock.info(0)
    assert wire.plan(77) == LogStatus.NO_COMMAND


def test_it_lags_behind_the_planner():
    """No feed-forward of velocity, and no more than 1 m/s: half a second behind, as the firmware itself."""
    wire = Wire().hovering()
    wire.go_to(2.0, 0.0, 1.0, 0.0, 4.0)
    worst, fastest = 0.0, 0.0
    for _ in range(400):
        wire.wait(0.01)
        wanted = wire.flock.planner.goal(wire.t)[0, 0]
        worst, fastest = max(worst, wanted - wire.position[0]), max(fastest, wire.flock.quadrotor.velocity[0, 0])
    assert 0.35 < worst < 0.65  # 1.09 m/s at the peak, half a second
    assert fastest <= 1.1


def test_groups():
    """A command to a group that it is not in is answered, and not obeyed."""
    wire = Wire()
    assert wire.plan(HighLevel.TAKEOFF, struct.pack("<ff?f", 1.0, 0.0, True, 1.0), group=2) == LogStatus.OK
    wire.wait(2.0)
    assert wire.position[2] == 0.0
    wire.put(Port.HIGH_LEVEL, 0, int(HighLevel.GROUP), 2)
    assert wire.plan(HighLevel.TAKEOFF, struct.pack("<ff?f", 1.0, 0.0, True, 1.0), group=2) == LogStatus.OK
    wire.wait(2.0)
    assert wire.position[2] > 0.8


def test_plans_begin_at_the_last_setpoint():
    """While a plan runs, where it should be counts, not where it is: it lags half a second behind."""
    wire = Wire().hovering()
    wire.go_to(1.0, 0.0, 1.0, 0.0, 3.0)
    wire.wait(1.5)
    planned = wire.flock.planner.goal(wire.t)[0]
    assert planned[0] - wire.position[0] > 0.2
    wire.land(2.0)
    assert wire.flock.planner.goal(wire.t)[0] == pytest.approx(planned)
    wire.wait(3.0)
    assert wire.position[0] == pytest.approx(planned[0], abs=0.02)


# ---------------------------------------------------------------------- low level, and who is heard


def test_streamed_positions():
    """In plan, the law of the twin in the robot's own process: what virtual time predicts is what a stream gives."""
    wire = Wire().streaming()
    model = Wire().streaming().flock.quadrotor
    for _ in range(150):
        wire.wait(0.01, lambda: wire.goal(0.4, -0.3, 1.1, 30.0))
        model.command(np.array([[0.4, -0.3, 1.1, math.radians(30.0)]]))
        model.advance()
    assert wire.position[:2] == pytest.approx(model.position[0, :2], abs=1e-6)
    assert wire.flock.quadrotor.yaw[0] == pytest.approx(model.yaw[0], abs=1e-6)


@pytest.mark.parametrize(
    ("kind", "payload", "velocity"),
    [
        (Setpoint.VELOCITY, struct.pack("<ffff", 0.3, -0.2, 0.1, 0.0), (0.3, -0.2, 0.1)),
        (
            Setpoint.HOVER,
            struct.pack("<ffff", 0.3, 0.0, 0.0, 1.0),
            (0.0, 0.3, 0.0),
        ),  # along its nose, which looks to +y
        (Setpoint.HEIGHT, struct.pack("<ffff", 0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0)),
    ],
)
def test_other_setpoints(kind, payload, velocity):
    wire = Wire(yaw=math.pi / 2).hovering()
    wire.wait(3.0, lambda: wire.put(Port.SETPOINT, 0, int(kind), payload))
    assert wire.flock.quadrotor.velocity[0] == pytest.approx(velocity, abs=2e-3)


def test_turning():
    wire = Wire().hovering()
    wire.wait(2.0, lambda: wire.put(Port.SETPOINT, 0, int(Setpoint.VELOCITY), struct.pack("<ffff", 0, 0, 0, 45.0)))
    assert wire.flock.quadrotor.yaw[0] == pytest.approx(math.pi / 2, abs=0.01)


@given(st.floats(-3.1, 3.1))
def test_attitude_in_32_bits(yaw):
    """Packed as the protocol says, by other means; unpacked to a third of a degree."""
    q = np.array([0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)])
    largest = int(np.argmax(np.abs(q)))
    packed = largest
    for i in range(4):
        if i != largest:
            flipped = (q[i] < 0) != (q[largest] < 0)
            packed = packed << 10 | flipped << 9 | round(0x1FF * abs(q[i]) * math.sqrt(2.0))
    assert math.cos(yaw_of(packed) - yaw) > math.cos(math.radians(0.34))


def test_full_state():
    wire = Wire().hovering()
    state = struct.pack("<9hI3h", 300, -200, 1100, *[0] * 6, 3 << 30, 0, 0, 0)
    wire.wait(4.0, lambda: wire.put(Port.SETPOINT, 0, int(Setpoint.FULL_STATE), state))
    assert wire.position == pytest.approx([0.3, -0.2, 1.1], abs=0.01)


def test_silence_levels_out_and_then_locks():
    """Half a second without a setpoint: it drifts on; two seconds: motors off, for ever."""
    wire = Wire().streaming()
    wire.wait(1.0, lambda: wire.goal(5.0, 0.0, 1.0))
    wire.wait(0.49)
    assert wire.state == SupervisorState.FLYING
    wire.wait(0.04)
    assert wire.state == SupervisorState.LEVEL
    drift = wire.flock.quadrotor.velocity[0, 0]
    wire.wait(1.4)
    assert wire.flock.quadrotor.velocity[0, 0] == pytest.approx(drift, abs=0.01)
    assert wire.position[2] == pytest.approx(1.0, abs=0.01)
    assert wire.motors
    wire.wait(0.1)
    assert wire.state == SupervisorState.LOCKED
    wire.wait(1.0)
    assert wire.position[2] == 0.0
    assert wire.takeoff(1.0, 2.0) == LogStatus.BUSY


def test_a_setpoint_in_time_is_followed_again():
    wire = Wire().streaming()
    wire.wait(1.5)
    assert wire.state == SupervisorState.LEVEL
    wire.wait(3.0, lambda: wire.goal(0.0, 0.0, 1.2))
    assert wire.state == SupervisorState.FLYING
    assert wire.position[2] == pytest.approx(1.2, abs=0.015)  # a step in height takes 10 s to settle


def test_the_order_of_command_and_release_matters():
    """Released first, the planner has nothing to follow, and it falls; commanded first, it does not."""
    wire = Wire().streaming()
    wire.release()
    wire.wait(0.2)
    assert not wire.motors
    assert wire.position[2] < 0.95
    wire = Wire().streaming()
    assert wire.go_to(0.0, 0.0, 1.0, 0.0, 1.0) == LogStatus.OK
    wire.release()
    wire.wait(2.0)
    assert wire.motors
    assert wire.position[2] == pytest.approx(1.0, abs=0.01)


def test_after_a_setpoint_the_planner_is_not_heard():
    """As after cflib has closed a link on the ground: take-off is answered, and nothing happens, until the release."""
    wire = Wire()
    wire.zero()
    assert wire.takeoff(0.5, 1.0) == LogStatus.OK
    wire.wait(2.0)
    assert wire.position[2] == 0.0
    wire.release()
    wire.wait(2.0)
    assert wire.position[2] == pytest.approx(0.5, abs=0.05)


def test_closing_a_link_just_after_landing_locks():
    """The zero setpoint within two seconds after the motors stopped: it levels out, and locks."""
    wire = Wire().hovering(0.5)
    wire.land(1.0)
    wire.wait(1.6)
    wire.zero()
    wire.wait(2.5)
    assert wire.state == SupervisorState.LOCKED
    wire = Wire().hovering(0.5)
    wire.land(1.0)
    wire.wait(5.5)
    wire.zero()
    wire.wait(4.0)
    assert wire.state == SupervisorState.READY


# ---------------------------------------------------------------------- the supervisor


@pytest.mark.parametrize(
    "how", [(Port.SUPERVISOR, 1, int(SupervisorCommand.STOP)), (Port.LOCATION, 1, int(Location.STOP))]
)
def test_emergency_stop(how):
    wire = Wire().hovering()
    wire.put(*how)
    wire.wait(0.01)
    assert wire.state == SupervisorState.LOCKED
    assert not wire.motors
    wire.wait(1.0)
    assert wire.position[2] == 0.0


def test_emergency_watchdog():
    wire = Wire().hovering()
    for _ in range(5):
        wire.put(Port.SUPERVISOR, 1, int(SupervisorCommand.WATCHDOG))
        wire.wait(0.9)
    assert wire.state == SupervisorState.FLYING
    wire.wait(0.2)
    assert wire.state == SupervisorState.LOCKED


def test_arming():
    """One that must be armed: not before, and not for longer than it says."""
    wire = Wire(device={"platform": "brushless"})
    assert wire.takeoff(0.5, 1.0) == LogStatus.BUSY
    assert wire.arm() == bytes((0x81, 1, 1))
    assert Info.ARMED in wire.flock.info(0)
    assert Info.CAN_FLY not in wire.flock.info(0)  # its motors spin up
    assert wire.takeoff(0.5, 1.0) == LogStatus.BUSY
    wire.wait(0.6)
    assert Info.CAN_FLY in wire.flock.info(0)
    wire.wait(30.1)
    assert Info.ARMED not in wire.flock.info(0)
    assert Info.CAN_BE_ARMED in wire.flock.info(0)
    assert wire.put(Port.PLATFORM, 0, int(Platform.ARM), 1) == [(Port.PLATFORM, 0, b"\1\1\1")]  # before version 12
    wire.wait(0.6)
    wire.hovering(0.5)
    wire.land(1.0)
    wire.wait(1.2 + 2.0 + 2.5)
    assert Info.ARMED in wire.flock.info(0)
    wire.wait(1.5)
    assert Info.ARMED not in wire.flock.info(0)


def test_refused_arming():
    wire = Wire(refuse_arming=True)
    assert wire.arm() == bytes((0x81, 0, 0))
    assert wire.takeoff(0.5, 1.0) == LogStatus.BUSY


def test_battery():
    """It empties in flight only, as fast as told; empty, the motors stop."""
    wire = Wire(battery=0.5, drain=10.0)
    wire.wait(5.0)
    assert wire.flock.batteries.charge[0] == 0.5
    wire.takeoff(1.0, 2.0)
    wire.wait(4.0)
    used = 0.5 - wire.flock.batteries.charge[0]
    assert used == pytest.approx(4.0 * 10.0 / 420.0, rel=0.01)
    wire.wait(0.4 * 42.0 + 1.0)
    assert wire.flock.batteries.charge[0] == 0.0
    assert wire.position[2] == 0.0


def test_battery_level_is_that_of_the_firmware():
    """10 % from 3.00 to 3.78 V; 90 % is the most that it says; under load the voltage sags."""
    flock = Wire().flock
    levels = {1.0: 90, 0.95: 90, 0.85: 90, 0.55: 60, 0.15: 20, 0.09: 10, 0.01: 10, 0.0: 0}
    for charge, level in levels.items():
        flock.batteries.charge[0] = charge
        assert flock.batteries.level(0) == level
    flock.batteries.charge[0] = 0.6
    assert flock.batteries.volts[0] == pytest.approx(3.96)
    flock.quadrotor.flying[0] = True
    assert flock.batteries.volts[0] == pytest.approx(3.66)
    assert flock.batteries.level(0) == 10


def test_an_empty_battery_is_reported_after_five_seconds():
    wire = Wire(battery=0.05)
    wire.takeoff(0.5, 2.0)
    wire.wait(4.0)
    assert wire.flock.batteries.volts[0] < 3.2
    assert wire.flock.batteries.power(0) == Power.BATTERY
    wire.wait(1.5)
    assert wire.flock.batteries.power(0) == Power.LOW


# ---------------------------------------------------------------------- the floor, and crashes


def test_the_floor():
    """Motors that do not carry it leave it where it stands."""
    wire = Wire()
    wire.zero()
    wire.wait(1.0, lambda: wire.put(Port.COMMANDER, 0, struct.pack("<fffH", 0.0, 0.0, 0.0, 20000)))
    assert wire.motors
    assert wire.position.tolist() == [0.0, 0.0, 0.0]


def test_a_fall_ends_upside_down():
    """Crashed, until it is put upright and recovery is asked for; then it flies again."""
    wire = Wire().hovering(1.2)
    wire.plan(HighLevel.STOP)
    wire.wait(1.0)
    assert wire.position[2] == 0.0
    assert wire.state == SupervisorState.CRASHED
    assert Info.CRASHED | Info.TUMBLED in wire.flock.info(0)
    assert wire.put(Port.SUPERVISOR, 1, int(SupervisorCommand.RECOVER)) == [(Port.SUPERVISOR, 1, b"\x82\0\0")]
    assert wire.takeoff(0.5, 1.0) == LogStatus.BUSY
    wire.flock.supervisor.tumbled[0] = False
    assert wire.takeoff(0.5, 1.0) == LogStatus.BUSY
    assert wire.put(Port.PLATFORM, 0, int(Platform.RECOVER)) == [(Port.PLATFORM, 0, b"\2\1\1")]  # before version 12
    wire.wait(0.1)
    assert wire.hovering(0.5).state == SupervisorState.FLYING


def test_a_collision():
    """It lies on its side from a time on: its motors stop, it falls; upright again it can be recovered."""
    wire = Wire(tumbled_from_s=19.0, tumbled_for_s=3.0).hovering()
    wire.wait(1.5)
    assert wire.state == SupervisorState.CRASHED
    wire.wait(3.0)
    assert Info.TUMBLED not in wire.flock.info(0)
    assert wire.state == SupervisorState.CRASHED
    assert wire.put(Port.SUPERVISOR, 1, int(SupervisorCommand.RECOVER)) == [(Port.SUPERVISOR, 1, b"\x82\1\1")]


def test_disarmed_in_the_air_it_locks():
    wire = Wire(device={"platform": "brushless"})
    wire.arm()
    wire.wait(0.6)
    wire.hovering(0.5)
    wire.arm(on=False)
    wire.wait(0.1)
    assert wire.state == SupervisorState.LOCKED


# ---------------------------------------------------------------------- where it believes to be


def test_flow_deck_does_not_measure_where_it_is():
    """It believes to be where it was switched on, in the air too, until its estimator is reset elsewhere."""
    wire = Wire(start=[[0.5, 0.2, 0.0]]).hovering()
    assert wire.flock.estimate[0] == pytest.approx([0.0, 0.0, 1.0], abs=0.01)
    wire.go_to(0.3, 0.0, 1.0, 0.0, 2.0)
    wire.wait(5.0)
    assert wire.position == pytest.approx([0.8, 0.2, 1.0], abs=0.01)
    for axis, value in zip("XYZ", wire.position, strict=True):
        wire.drone.values[wire.drone.parameters.number[f"kalman.initial{axis}"]] = value
    wire.put(Port.PARAM, 2, struct.pack("<H", wire.drone.parameters.number["kalman.resetEstimation"]), 1)
    wire.wait(0.1)
    assert wire.flock.estimate[0] == pytest.approx(wire.position, abs=0.01)


def test_position_from_outside():
    """Before the first one it believes to stand where it was told to; after that, it flies what it is told."""
    wire = Wire(external=True, start=[[0.5, 0.2, 0.0]])
    assert wire.flock.estimate[0] == pytest.approx([0.0, 0.0, 0.0])
    wire.wait(1.0)
    assert wire.flock.estimator.variance[0] >= 100.0
    shift = np.array([0.1, 0.0, 0.0])  # the cameras are not where they believe to be

    def locate():
        wire.put(Port.LOCATION, 0, struct.pack("<fff", *(wire.position + shift)))

    wire.wait(3.0, locate)
    assert wire.flock.estimate[0] == pytest.approx([0.6, 0.2, 0.0], abs=1e-3)
    assert wire.flock.estimator.variance[0] < 1e-4
    assert wire.takeoff(0.5, 1.0) == LogStatus.OK
    wire.wait(2.0, locate)
    wire.go_to(0.0, 0.0, 0.5, 0.0, 2.0)
    wire.wait(12.0, locate)
    assert wire.position == pytest.approx([-0.1, 0.0, 0.5], abs=0.01)
    wire.wait(1.5)
    assert wire.flock.estimator.variance[0] > 0.5  # nobody tells it any more
