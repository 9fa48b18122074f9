"""How a Crazyflie twin flies and when it refuses to, as the firmware does (seen on the real one, run in the loop).

From `test_older_commands_are_flown` on: what no client wants.
"""

import math
import struct
from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial import Polynomial

from bridges.crazyflie.protocol import crtp
from bridges.crazyflie.protocol.crtp import (
    HighLevel,
    Info,
    Location,
    LogStatus,
    MemoryKind,
    Port,
    Setpoint,
    SupervisorCommand,
)
from bridges.crazyflie.twin.planner import OnboardPlanner, evaluate, polynomial
from bridges.crazyflie.twin.supervisor import SupervisorState
from bridges.crazyflie.twin.vehicle import Vehicle
from tests.bridges.crazyflie.wire import DT, Wire, brushless
from tests.requests import request
from twins.device import Faults


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


@pytest.mark.slow
def test_takeoff_go_to_land():
    wire = Wire()
    assert [wire.takeoff(1.0, 2.0), wire.takeoff(1.0, 2.0)] == [LogStatus.OK, LogStatus.REFUSED]
    assert wire.after(4.0).position == pytest.approx([0.0, 0.0, 1.07], abs=0.01)  # it overshoots
    assert wire.go_to(1.0, 0.5, 1.2, 1.0, 2.0) == LogStatus.OK
    assert [*wire.after(15.0).position, wire.yaw] == pytest.approx([1.0, 0.5, 1.2, 1.0], abs=0.01)
    assert [wire.land(2.0), wire.land(2.0)] == [LogStatus.OK, LogStatus.REFUSED]
    assert wire.after(3.0).position == pytest.approx([1.0, 0.5, 0.0], abs=0.01)
    assert Info.FLYING in wire.info  # for two seconds after its motors turned
    assert Info.FLYING not in wire.after(1.5).info
    assert wire.plan(77) == LogStatus.NO_COMMAND
    for group, begun in ((2, False), (2, True)):  # before it belongs to the group, and behind
        assert wire.takeoff(1.0, 1.0, group=2) == LogStatus.OK
        assert (wire.after(2.0).position[2] > 0.8) == begun
        wire.put(Port.HIGH_LEVEL, 0, HighLevel.GROUP, group)


@pytest.mark.slow
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


@pytest.mark.slow
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
        assert math.cos(crtp.yaw_of(packed) - yaw) > math.cos(math.radians(0.34))


def test_silence_levels_out_and_then_locks():
    wire = Wire().streaming()
    assert wire.after(1.5).state == SupervisorState.LEVEL
    assert wire.after(3.0, lambda: wire.goal(0.0, 0.0, 1.0)).state == SupervisorState.FLYING
    wire.wait(1.0, lambda: wire.goal(5.0, 0.0, 1.0))
    assert [wire.after(seconds).state for seconds in (0.49, 0.04)] == [SupervisorState.FLYING, SupervisorState.LEVEL]
    drift = wire.velocity[0]
    assert wire.after(1.4).velocity[0] == pytest.approx(drift, abs=0.01)
    assert (wire.position[2], wire.motors) == (pytest.approx(1.0, abs=0.01), True)
    assert wire.after(0.1).state == SupervisorState.LOCKED
    assert (wire.after(1.0).position[2], wire.takeoff(1.0, 2.0)) == (0.0, LogStatus.BUSY)


def test_the_order_of_command_and_release_matters():
    wire = Wire().streaming()
    wire.release()
    assert (wire.after(0.2).motors, wire.position[2] < 0.95) == (False, True)
    wire = Wire().streaming()
    assert wire.go_to(0.0, 0.0, 1.0, 0.0, 1.0) == LogStatus.OK
    wire.release()
    assert (wire.after(2.0).motors, wire.position[2]) == (True, pytest.approx(1.0, abs=0.01))


@pytest.mark.slow
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
        assert (wire.after(0.01).state, wire.motors) == (SupervisorState.LOCKED, False)
        assert wire.after(1.0).position[2] == 0.0
    wire = Wire().hovering()
    for _ in range(5):
        wire.put(Port.SUPERVISOR, 1, SupervisorCommand.WATCHDOG)
        assert wire.after(0.9).state == SupervisorState.FLYING
    assert wire.after(0.2).state == SupervisorState.LOCKED


@pytest.mark.slow
def test_arming():
    wire = Wire({"platform": "brushless"})
    assert (wire.takeoff(0.5, 1.0), wire.arm()) == (LogStatus.BUSY, bytes((0x81, 1, 1)))
    assert wire.info & (Info.ARMED | Info.CAN_FLY) == Info.ARMED  # its motors spin up
    assert wire.takeoff(0.5, 1.0) == LogStatus.BUSY
    assert Info.CAN_FLY in wire.after(0.6).info
    assert wire.after(30.1).info & (Info.ARMED | Info.CAN_BE_ARMED) == Info.CAN_BE_ARMED
    assert wire.ask(Port.PLATFORM, 0, crtp.Platform.ARM, 1) == b"\1\1\1"  # before version 12
    wire.after(0.6).hovering(0.5).land(1.0)
    assert [Info.ARMED in wire.after(seconds).info for seconds in (5.7, 1.5)] == [True, False]
    wire = brushless().hovering(0.5)
    wire.arm(on=False)
    assert wire.after(0.1).state == SupervisorState.LOCKED
    assert Wire(refuse_arming=True).arm() == bytes((0x81, 0, 0))


@pytest.mark.slow
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

    def level(charge):
        vehicle.battery.charge = charge
        return vehicle.battery.level

    assert [*map(level, (1.0, 0.95, 0.85, 0.55, 0.15, 0.09, 0.01, 0.0))] == [90, 90, 90, 60, 20, 10, 10, 0]
    assert (level(0.6), vehicle.battery.volts) == (60, pytest.approx(3.96))
    vehicle.model.flying = True
    assert (level(0.6), vehicle.battery.volts) == (10, pytest.approx(3.66))
    wire = Wire(battery=0.05)
    wire.takeoff(0.5, 2.0)
    powers = [wire.after(seconds).vehicle.battery.power for seconds in (4.0, 1.5)]
    assert powers == [crtp.Power.BATTERY, crtp.Power.LOW]


@pytest.mark.slow
def test_a_fall_ends_upside_down():
    wire = Wire().hovering(1.2)
    wire.plan(HighLevel.STOP)
    assert (wire.after(1.0).state, wire.position[2]) == (SupervisorState.CRASHED, 0.0)
    assert Info.CRASHED | Info.TUMBLED in wire.info
    assert wire.ask(Port.SUPERVISOR, 1, SupervisorCommand.RECOVER) == b"\x82\0\0"
    wire.vehicle.supervisor.tumbled = False
    assert wire.takeoff(0.5, 1.0) == LogStatus.BUSY
    assert wire.ask(Port.PLATFORM, 0, crtp.Platform.RECOVER) == b"\2\1\1"  # before version 12
    assert wire.after(0.1).hovering(0.5).state == SupervisorState.FLYING
    wire = Wire(tumbled_from_s=19.0, tumbled_for_s=3.0).hovering().after(4.5)  # a collision
    assert (wire.state, Info.TUMBLED in wire.info) == (SupervisorState.CRASHED, False)
    assert wire.ask(Port.SUPERVISOR, 1, SupervisorCommand.RECOVER) == b"\x82\1\1"


@pytest.mark.slow
def test_flow_deck_does_not_measure_where_it_is():
    wire = Wire(start=[[0.5, 0.2, 0.0]]).hovering()
    assert wire.estimate == pytest.approx([0.0, 0.0, 1.0], abs=0.01)
    wire.go_to(0.3, 0.0, 1.0, 0.0, 2.0)
    assert wire.after(5.0).position == pytest.approx([0.8, 0.2, 1.0], abs=0.01)
    for axis, value in zip("XYZ", wire.position, strict=True):
        wire.set(f"kalman.initial{axis}", "f", value)
    wire.set("kalman.resetEstimation", "B", 1)
    assert wire.after(0.1).estimate == pytest.approx(wire.position, abs=0.01)


@pytest.mark.slow
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


OLD_LEVEL = (0.0, 0.0, 30.0, 1.0)


@pytest.mark.parametrize(
    ("kind", "values", "sense"),
    [
        (Setpoint.OLD_VELOCITY, (0.0, 0.0, 0.0, 30.0), -1.0),
        (Setpoint.OLD_HOVER, OLD_LEVEL, -1.0),
        (Setpoint.OLD_HEIGHT, OLD_LEVEL, -1.0),
        (Setpoint.HOVER, OLD_LEVEL, 1.0),
        (Setpoint.HEIGHT, OLD_LEVEL, 1.0),
    ],
)
def test_older_setpoints_turn_the_other_way(kind, values, sense):
    wire = Wire().hovering()
    wire.wait(1.0, lambda: wire.setpoint(kind, *values))
    assert wire.position[2] == pytest.approx(1.0, abs=0.01)
    assert wire.yaw == pytest.approx(sense * math.radians(30.0), rel=0.05)


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
    assert (wire.after(0.3).motors, wire.position[2] < 0.7) == (False, True)
    wire = Wire().hovering()
    wire.go_to(math.nan, 0.0, 1.0, 0.0, 1.0)
    assert (wire.after(0.1).state, wire.motors) == (SupervisorState.LOCKED, False)


@pytest.mark.parametrize("ordered", [False, True])
def test_piece_that_is_no_number_ends_the_plan(ordered):
    """The planner gives up; 2 s after its last setpoint the motors stop, unless it is ordered to land before."""
    wire, nothing = Wire().hovering(0.5), [math.nan] * 32
    hold = [0.0] * 16 + [0.5] + [0.0] * 15
    for k, values in enumerate((hold, nothing)):
        data = crtp.PIECE.pack(*values, 1.0)
        assert wire.drone.memories.write(MemoryKind.TRAJECTORY, k * len(data), data)
    wire.drone.trajectories.define(0, crtp.IN_MEMORY, crtp.UNCOMPRESSED, 0, 2)
    assert wire.plan(HighLevel.START_2, "BBBBf", 0, 0, 0, 0, 1.0) == LogStatus.OK
    assert wire.after(1.0 + 0.4).state == SupervisorState.FLYING
    assert wire.after(0.3).state == SupervisorState.LEVEL
    if ordered:
        assert wire.land(2.0) == LogStatus.OK
    assert wire.after(1.2).motors
    assert wire.after(2.0).state == (SupervisorState.FLYING if ordered else SupervisorState.LOCKED)
    assert not wire.motors
    assert wire.position[2] == 0.0


def test_thrust_needs_a_zero_first():
    for zeroed, thrust in ((False, 45000), (True, 45000), (True, 20000)):  # the last is too little to carry it
        wire = Wire()
        if zeroed:
            wire.zero()
        assert wire.after(1.0, lambda wire=wire, thrust=thrust: wire.thrust(thrust)).motors == zeroed
        assert (wire.position[2] > 0.1) == (zeroed and thrust == 45000)
    assert wire.position.tolist() == [0.0, 0.0, 0.0]


@pytest.mark.slow
def test_a_flat_fall_is_a_landing():
    wire = Wire().hovering(0.8)
    wire.plan(HighLevel.STOP)
    assert not wire.after(0.1).motors
    assert (wire.after(6.0).position[2], wire.state) == (0.0, SupervisorState.READY)
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
    assert (wire.after(1.5, located).estimate[2] < 0.1, wire.velocity[2] > 0.4) == (True, True)
    assert wire.after(2.5, located).position[2] > 2.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("late", "sigma", "sways"),
    [(0.1, 0.01, (0.0, 0.05)), (0.2, 0.01, (1.0, 2.0)), (0.3, 0.01, (1.5, 3.0)), (0.3, 0.1, (0.0, 0.05))],
)
def test_late_positions_make_it_sway(late, sigma, sways):
    """As measured on the firmware: hover at 0.8 m, a step of 0.6 m; the largest sway of the last 3 s."""
    wire, places = Wire(external=True), []

    def located():
        places.append(wire.position)
        if wire.ticks % 5 == 0:
            wire.locate(places[max(-len(places), -1 - round(late / DT))])

    wire.set("locSrv.extPosStdDev", "f", sigma)
    assert wire.after(1.0, located).takeoff(0.8, 2.0) == LogStatus.OK
    wire.after(6.0, located).go_to(0.6, 0.0, 0.8, 0.0, 0.01)
    wire.wait(10.0, located)
    least, most = sways
    assert least <= np.ptp(places[-300:], axis=0).max() <= most


@pytest.mark.slow
def test_blind_drone_rises_by_its_accelerometer():
    """By half the error times the square of the time, up to the next position, which throws a far estimate."""
    wire = Wire(external=True, accelerometer_mg=-4.0)
    assert wire.after(1.0, wire.locate).takeoff(0.8, 2.0) == LogStatus.OK
    assert wire.after(15.0, wire.locate).position[2] == pytest.approx(0.8, abs=0.02)
    assert wire.after(4.0).position[2] - 0.8 == pytest.approx(0.5 * 4e-3 * 9.81 * 4.0**2, rel=0.3)
    assert wire.estimate[2] == pytest.approx(0.8, abs=0.1)
    wire.after(0.1, wire.locate)
    assert wire.state == SupervisorState.FLYING
    assert wire.after(10.0).position[2] > 2.0
    wire.after(0.1, wire.locate)
    assert (wire.state, wire.motors) == (SupervisorState.CRASHED, False)
    assert abs(wire.yaw - wire.vehicle.pose[3]) > 1.0


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
    assert wire.after(6.0, lambda: wire.goal(0.0, 0.0, height)).position[2] == pytest.approx(height, abs=0.05)
