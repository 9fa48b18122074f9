"""How a Crazyflie twin flies and when it refuses to, as the firmware does (seen on the real one, run in the loop)."""

import math
import struct

import numpy as np
import pytest
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
from tests.twins.crazyflie_wire import Wire, brushless
from twins.devices.crazyflie.planner import OnboardPlanner, evaluate, polynomial
from twins.devices.crazyflie.supervisor import SupervisorState

pytestmark = pytest.mark.slow  # seconds of firmware, in steps of milliseconds


@pytest.mark.parametrize("span", [0.2, 1.0, 5.0])
def test_polynomial_meets_both_ends(span):
    begin, end = np.random.default_rng(1).uniform(-3.0, 3.0, (2, 3, 1))
    path = Polynomial(polynomial(span, tuple(begin), tuple(end))[0])
    for t, wanted in ((0.0, begin), (span, end)):
        values = [path.deriv(order)(t) for order in range(4)]
        assert values == pytest.approx([*wanted[:, 0], 0.0], abs=1e-6 * max(1.0, span**-3))
    values = [float(value[0]) for value in evaluate(path.coef[None], 0.3)]
    assert values == pytest.approx([path.deriv(order)(0.3) for order in range(3)])


def test_chained_plans_are_smooth():
    planner = OnboardPlanner()
    planner.climb(0.0, np.zeros(4), height=1.0, yaw=0.0, span=2.0, landing=False)
    for t, goal in ((1.0, [1.0, 0.5, 1.2, 1.0]), (1.7, [-0.5, 0.2, 0.8, -2.9]), (2.1, [0.0, 0.0, 1.0, 2.9])):
        before = np.array([planner.goal(t - h) for h in (2e-4, 1e-4)])
        planner.go_to(t, np.zeros(4), np.zeros(3), goal=np.array(goal), span=1.5, relative=False, linear=False)
        after = np.array([planner.goal(t + h) for h in (0.0, 1e-4)])
        assert (after[1] == planner.state(t + 1e-4)[0]).all(), "to the last bit"
        assert after[0] == pytest.approx(before[1], abs=1e-3)
        assert (after[1] - after[0]) / 1e-4 == pytest.approx((before[1] - before[0]) / 1e-4, abs=2e-2)
    end = planner.goal(10.0)
    assert end[:3] == pytest.approx([0.0, 0.0, 1.0])
    assert math.cos(end[3] - 2.9) == pytest.approx(1.0)
    goal = np.array([1.0, 0.0, 0.0, 0.0])
    planner.go_to(10.0, np.zeros(4), np.zeros(3), goal=goal, span=2.0, relative=True, linear=True)
    assert planner.goal(10.5)[:3] == pytest.approx([0.25, 0.0, 1.0])
    assert planner.goal(13.0)[:3] == pytest.approx([1.0, 0.0, 1.0])


def test_takeoff_go_to_land():
    wire = Wire()
    assert wire.takeoff(1.0, 2.0) == LogStatus.OK
    assert wire.takeoff(1.0, 2.0) == LogStatus.REFUSED
    assert wire.after(4.0).position == pytest.approx([0.0, 0.0, 1.07], abs=0.01)  # it overshoots
    assert wire.go_to(1.0, 0.5, 1.2, 1.0, 2.0) == LogStatus.OK
    assert wire.after(15.0).position == pytest.approx([1.0, 0.5, 1.2], abs=0.01)
    assert wire.yaw == pytest.approx(1.0, abs=0.01)
    assert wire.land(2.0) == LogStatus.OK
    assert wire.land(2.0) == LogStatus.REFUSED
    assert wire.after(3.0).position == pytest.approx([1.0, 0.5, 0.0], abs=0.01)
    assert Info.FLYING in wire.info  # for two seconds after its motors turned
    assert Info.FLYING not in wire.after(1.5).info
    assert wire.plan(77) == LogStatus.NO_COMMAND


def test_groups():
    wire = Wire()
    assert wire.takeoff(1.0, 1.0, group=2) == LogStatus.OK
    assert wire.after(2.0).position[2] == 0.0
    wire.put(Port.HIGH_LEVEL, 0, HighLevel.GROUP, 2)
    assert wire.takeoff(1.0, 1.0, group=2) == LogStatus.OK
    assert wire.after(2.0).position[2] > 0.8


def test_plans_begin_at_the_last_setpoint():
    wire = Wire().hovering()
    wire.go_to(1.0, 0.0, 1.0, 0.0, 3.0)
    planned = wire.after(1.5).planned
    assert planned[0] - wire.position[0] > 0.2
    wire.land(2.0)
    assert wire.planned == pytest.approx(planned)
    assert wire.after(3.0).position[0] == pytest.approx(planned[0], abs=0.02)


def test_streamed_positions():
    """In plan, the law of the twin in the robot's own process: what virtual time predicts is what a stream gives."""
    wire = Wire().streaming()
    model = Wire().streaming().vehicle.model
    for _ in range(150):
        wire.wait(0.01, lambda: wire.goal(0.4, -0.3, 1.1, 30.0))
        model.command((0.4, -0.3, 1.1, math.radians(30.0)))
        model.move(0.01)
    assert wire.position[:2] == pytest.approx(model.held[:2], abs=1e-6)
    assert wire.yaw == pytest.approx(model.yaw, abs=1e-6)


def test_other_setpoints():
    for kind, values, velocity, turned in (
        (Setpoint.VELOCITY, (0.3, -0.2, 0.1, 30.0), (0.3, -0.2, 0.1), math.pi / 2),
        (Setpoint.HOVER, (0.3, 0.0, 0.0, 1.0), (0.0, 0.3, 0.0), 0.0),  # along its nose, which looks to +y
        (Setpoint.HEIGHT, (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 0.0),
    ):
        wire = Wire(yaw=math.pi / 2).hovering()
        for _ in range(300):
            wire.setpoint(kind, *values)
            wire.wait(0.01)
        assert wire.velocity == pytest.approx(velocity, abs=2e-3)
        assert math.remainder(wire.yaw - math.pi / 2 - turned, math.tau) == pytest.approx(0.0, abs=0.01)
    state = struct.pack("<9hI3h", 300, -200, 1100, *[0] * 6, 3 << 30, 0, 0, 0)
    wire.wait(6.0, lambda: wire.put(Port.SETPOINT, 0, Setpoint.FULL_STATE, state))
    assert wire.position == pytest.approx([0.3, -0.2, 1.1], abs=0.01)


def test_attitude_in_32_bits():
    for yaw, largest in ((0.5, 3), (-0.5, 3), (2.0, 2), (-3.0, 2)):
        small = math.sin(yaw / 2) if largest == 3 else math.cos(yaw / 2)
        flipped = (small < 0.0) != (largest == 2 and yaw < 0.0)
        packed = largest << 30 | flipped << 9 | round(0x1FF * abs(small) * math.sqrt(2.0))
        assert math.cos(yaw_of(packed) - yaw) > math.cos(math.radians(0.34))


def test_silence_levels_out_and_then_locks():
    wire = Wire().streaming()
    assert wire.after(1.5).state == SupervisorState.LEVEL
    assert wire.after(3.0, lambda: wire.goal(0.0, 0.0, 1.0)).state == SupervisorState.FLYING
    wire.wait(1.0, lambda: wire.goal(5.0, 0.0, 1.0))
    assert wire.after(0.49).state == SupervisorState.FLYING
    assert wire.after(0.04).state == SupervisorState.LEVEL
    drift = wire.velocity[0]
    assert wire.after(1.4).velocity[0] == pytest.approx(drift, abs=0.01)
    assert wire.position[2] == pytest.approx(1.0, abs=0.01)
    assert wire.motors
    assert wire.after(0.1).state == SupervisorState.LOCKED
    assert wire.after(1.0).position[2] == 0.0
    assert wire.takeoff(1.0, 2.0) == LogStatus.BUSY


def test_the_order_of_command_and_release_matters():
    wire = Wire().streaming()
    wire.release()
    assert not wire.after(0.2).motors
    assert wire.position[2] < 0.95
    wire = Wire().streaming()
    assert wire.go_to(0.0, 0.0, 1.0, 0.0, 1.0) == LogStatus.OK
    wire.release()
    assert wire.after(2.0).motors
    assert wire.position[2] == pytest.approx(1.0, abs=0.01)


def test_closing_a_link_silences_the_planner_or_locks():
    wire = Wire()
    wire.zero()  # as cflib does it on the ground
    assert wire.takeoff(0.5, 1.0) == LogStatus.OK
    assert wire.after(2.0).position[2] == 0.0
    wire.release()
    assert wire.after(2.0).position[2] == pytest.approx(0.5, abs=0.05)
    for pause, state in ((1.6, SupervisorState.LOCKED), (5.5, SupervisorState.READY)):
        wire = Wire().hovering(0.5)
        wire.land(1.0)
        wire.wait(pause)
        wire.zero()  # within two seconds after the motors stopped it levels out, and locks
        assert wire.after(4.0).state == state


def test_emergency_stop_and_watchdog():
    for how in ((Port.SUPERVISOR, 1, SupervisorCommand.STOP), (Port.LOCATION, 1, Location.STOP)):
        wire = Wire().hovering()
        wire.put(*how)
        assert wire.after(0.01).state == SupervisorState.LOCKED
        assert not wire.motors
        assert wire.after(1.0).position[2] == 0.0
    wire = Wire().hovering()
    for _ in range(5):
        wire.put(Port.SUPERVISOR, 1, SupervisorCommand.WATCHDOG)
        assert wire.after(0.9).state == SupervisorState.FLYING
    assert wire.after(0.2).state == SupervisorState.LOCKED


def test_arming():
    wire = Wire({"platform": "brushless"})
    assert wire.takeoff(0.5, 1.0) == LogStatus.BUSY
    assert wire.arm() == bytes((0x81, 1, 1))
    assert Info.ARMED in wire.info
    assert Info.CAN_FLY not in wire.info  # its motors spin up
    assert wire.takeoff(0.5, 1.0) == LogStatus.BUSY
    assert Info.CAN_FLY in wire.after(0.6).info
    assert Info.ARMED not in wire.after(30.1).info
    assert Info.CAN_BE_ARMED in wire.info
    assert wire.ask(Port.PLATFORM, 0, Platform.ARM, 1) == b"\1\1\1"  # before version 12
    wire.after(0.6).hovering(0.5).land(1.0)
    assert Info.ARMED in wire.after(5.7).info
    assert Info.ARMED not in wire.after(1.5).info
    wire = brushless().hovering(0.5)
    wire.arm(on=False)
    assert wire.after(0.1).state == SupervisorState.LOCKED
    assert Wire(refuse_arming=True).arm() == bytes((0x81, 0, 0))


def test_battery_empties_in_flight_and_stops_the_motors():
    wire = Wire(battery=0.5, drain=10.0)
    battery = wire.after(5.0).vehicle.battery
    assert battery.charge == 0.5
    wire.takeoff(1.0, 2.0)
    wire.wait(4.0)
    assert 0.5 - battery.charge == pytest.approx(4.0 * 10.0 / 420.0, rel=0.01)
    assert wire.after(0.4 * 42.0 + 1.0).position[2] == 0.0


def test_battery_level_is_that_of_the_firmware():
    vehicle = Wire().vehicle
    levels = {1.0: 90, 0.95: 90, 0.85: 90, 0.55: 60, 0.15: 20, 0.09: 10, 0.01: 10, 0.0: 0}
    for charge, level in levels.items():
        vehicle.battery.charge = charge
        assert vehicle.battery.level == level
    vehicle.battery.charge = 0.6
    assert vehicle.battery.volts == pytest.approx(3.96)
    vehicle.model.flying = True
    assert vehicle.battery.volts == pytest.approx(3.66)
    assert vehicle.battery.level == 10
    wire = Wire(battery=0.05)
    wire.takeoff(0.5, 2.0)
    assert wire.after(4.0).vehicle.battery.power == Power.BATTERY
    assert wire.after(1.5).vehicle.battery.power == Power.LOW


def test_a_fall_ends_upside_down():
    wire = Wire().hovering(1.2)
    wire.plan(HighLevel.STOP)
    assert wire.after(1.0).state == SupervisorState.CRASHED
    assert wire.position[2] == 0.0
    assert Info.CRASHED | Info.TUMBLED in wire.info
    assert wire.ask(Port.SUPERVISOR, 1, SupervisorCommand.RECOVER) == b"\x82\0\0"
    wire.vehicle.supervisor.tumbled = False
    assert wire.takeoff(0.5, 1.0) == LogStatus.BUSY
    assert wire.ask(Port.PLATFORM, 0, Platform.RECOVER) == b"\2\1\1"  # before version 12
    assert wire.after(0.1).hovering(0.5).state == SupervisorState.FLYING


def test_a_collision():
    wire = Wire(tumbled_from_s=19.0, tumbled_for_s=3.0).hovering()
    assert wire.after(4.5).state == SupervisorState.CRASHED
    assert Info.TUMBLED not in wire.info
    assert wire.ask(Port.SUPERVISOR, 1, SupervisorCommand.RECOVER) == b"\x82\1\1"


def test_flow_deck_does_not_measure_where_it_is():
    wire = Wire(start=[[0.5, 0.2, 0.0]]).hovering()
    assert wire.estimate == pytest.approx([0.0, 0.0, 1.0], abs=0.01)
    wire.go_to(0.3, 0.0, 1.0, 0.0, 2.0)
    assert wire.after(5.0).position == pytest.approx([0.8, 0.2, 1.0], abs=0.01)
    for axis, value in zip("XYZ", wire.position, strict=True):
        wire.set(f"kalman.initial{axis}", "f", value)
    wire.set("kalman.resetEstimation", "B", 1)
    assert wire.after(0.1).estimate == pytest.approx(wire.position, abs=0.01)


def test_position_from_outside():
    wire = Wire(external=True, start=[[0.5, 0.2, 0.0]])
    assert wire.estimate == pytest.approx([0.0, 0.0, 0.0])
    assert wire.after(1.0).vehicle.estimator.variance >= 100.0

    def locate():  # the cameras are not where they believe to be
        wire.locate(np.add(wire.position, [0.1, 0.0, 0.0]))

    assert wire.after(3.0, locate).estimate == pytest.approx([0.6, 0.2, 0.0], abs=1e-3)
    assert wire.vehicle.estimator.variance < 1e-4
    assert wire.takeoff(0.5, 1.0) == LogStatus.OK
    wire.after(2.0, locate).go_to(0.0, 0.0, 0.5, 0.0, 2.0)
    assert wire.after(12.0, locate).position == pytest.approx([-0.1, 0.0, 0.5], abs=0.01)
    assert wire.after(1.5).vehicle.estimator.variance > 0.5  # nobody tells it any more
