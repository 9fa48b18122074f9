"""The pilot of a Tello against a drone made of lists and a clock made of numbers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.body.interface import UNANSWERED
from agents.protocols import tello as protocol
from bridges.tello.pilot import Duty
from tests.bridges.tello.cockpit import Cockpit

SPEED = st.floats(-1.0, 1.0)


@pytest.fixture
def grounded():
    return Cockpit()


@pytest.fixture
def airborne():
    return Cockpit().fly()


@given(SPEED, SPEED, SPEED, st.floats(-1.7, 1.7), st.floats(-10.0, 10.0))
def test_sticks_say_the_velocity_in_the_world(x, y, z, turn, yaw):
    rc = protocol.sticks((x, y, z), turn, yaw)
    assert all(isinstance(stick, int) and abs(stick) <= 100 for stick in rc)
    if abs(np.cos(yaw) * x + np.sin(yaw) * y) <= 1.0 and abs(np.cos(yaw) * y - np.sin(yaw) * x) <= 1.0:
        assert protocol.motion(rc, yaw) == pytest.approx((x, y, z, turn), abs=0.01)


def test_sticks_by_hand():
    assert protocol.sticks((0.5, 0.0, 0.0), 0.0, 0.0) == (0, 50, 0, 0)
    assert protocol.sticks((0.0, 0.5, 0.2), np.radians(30.0), 0.0) == (-50, 0, 20, -30)
    assert protocol.sticks((0.0, 0.5, 0.0), 0.0, np.pi / 2) == (0, 50, 0, 0)
    assert protocol.sticks((9.0, 0.0, -9.0), 9.0, 0.0) == (0, 100, -100, -100)


# ---------------------------------------------------------------------- take-off


def test_take_off_is_sent_once_and_answered_aloft(grounded):
    grounded.pass_(0.2).responses.append(b"ok")  # of something that was said before
    grounded.take_off(0.6, rested_s=0.0).pass_(0.5)
    assert (grounded.flying, grounded.duty) == (True, Duty.RISE)
    grounded.answer(b"ok").pass_(2.9)  # too early: no drone is up by then
    assert grounded.duty is Duty.RISE
    grounded.answer(b"ok\r\n")
    assert grounded.duty is Duty.HOLD
    assert grounded.said == ["takeoff"]


@pytest.mark.parametrize("answer", [b"error", b"out of range", b"unknown command: takeoff"])
def test_a_drone_that_refuses_says_so(grounded, answer):
    grounded.take_off(0.6).answer(answer)
    assert grounded.duty is Duty.REST
    assert "refuses to take off" in grounded.note


def test_refused_second_take_off_means_it_flies(grounded):
    grounded.take_off(0.6).pass_(2.0, h=80).answer(b"error")
    assert grounded.duty is Duty.HOLD


def test_lost_answers_and_lost_commands(grounded):
    grounded.take_off(0.6).pass_(6.5)  # nothing happens: the command was lost
    assert grounded.said == ["takeoff", "takeoff"]
    grounded.pass_(6.5, h=80, time=6)  # it is up: the answer was lost
    assert grounded.duty is Duty.HOLD
    grounded.land()
    grounded.pass_(2.2)
    assert grounded.said[2:] == ["land", "land", "land"]
    grounded.pass_(3.3, h=10)  # it is down, its motors' clock stands
    assert (grounded.duty, grounded.flying) == (Duty.REST, False)


def test_a_drone_that_never_gets_up_is_landed(grounded):
    grounded.take_off(0.6).pass_(20.2)
    assert grounded.said[-1] == "land"
    grounded.pass_(1.2)  # it may have obeyed the last of the orders to take off, 3 s ago
    assert not grounded.flying
    assert "did not take off in 20 s" in grounded.note


# ---------------------------------------------------------------------- flight


def test_tello_climbs_and_holds_until_setpoints_come(airborne):
    airborne.pilot.position, airborne.pilot.yaw = (0.9, 2.0, 0.8), 0.0
    assert airborne.pass_(0.05).sticks[-1] == (0, 10, -20, 0)
    airborne.pilot.position = (np.nan,) * 3
    assert airborne.pass_(0.05).sticks[-1] == (0, 0, 0, 0)
    airborne.aim(0.0, 0.3, 0.0, 0.0)
    assert airborne.pass_(0.5).sticks[-1] == (-30, 0, 0, 0)
    assert airborne.pass_(0.1).sticks[-1] == (0, 0, 0, 0), "a setpoint of half a second ago is none"
    assert len(airborne.forget().pass_(10.0).sticks) == 200, "the sticks keep it alive"


def test_sticks_of_another_scale():
    """A drone that flies 0.5 m/s at full deflection gets twice the sticks of one that flies 1 m/s."""
    cockpit = Cockpit(stick_speed=0.5).fly()
    cockpit.pilot.position, cockpit.pilot.yaw = (0.9, 2.0, 0.6), 0.0
    assert cockpit.pass_(0.05).sticks[-1] == (0, 20, 0, 0)
    cockpit.aim(0.0, 0.2, 0.0, 0.0)
    assert cockpit.pass_(0.05).sticks[-1] == (-40, 0, 0, 0)


def test_the_stick_test_closes_no_loop():
    """Forward for 2 s, back for 2 s, whatever setpoints say; with the position lost the sticks rest."""
    cockpit, given = Cockpit(stick_test=True).fly(), []
    for _ in range(70):
        cockpit.aim(0.5, 0.5, 0.5, 0.5)
        given.append(cockpit.pass_(0.1).sticks[-1])
    forward = [sticks[1] for sticks in given]
    assert {sticks[:1] + sticks[2:] for sticks in given[:68]} == {(0, 0, 0)}
    assert (forward.count(20), forward.count(-20)) == (20, 20)
    assert forward.index(20) == pytest.approx(9, abs=1)
    assert given[-1] == (-50, 50, 50, -29)  # it is over
    lost = Cockpit(stick_test=True).fly()
    lost.pilot.position = (np.nan,) * 3
    assert lost.pass_(2.0).sticks[-1] == (0, 0, 0, 0)


def test_a_climb_with_markers_on_the_floor_ends(airborne):
    airborne.pilot.position = (1.0, 2.0, 0.02)
    assert airborne.pass_(1.0, h=150, time=5).duty is Duty.HOLD
    assert airborne.pass_(0.2, h=170).duty is Duty.LAND
    assert airborne.said[-1] == "land"
    assert airborne.pilot.trouble == "landing: it is 1.7 m high, and its positions do not rise with it"


def test_process_woken_from_suspension_sends_nothing_stale(airborne):
    """Suspended in the middle of a step, which is a stick of before; then it lands, as it does in a take-off."""
    airborne.aim(0.0, 0.3, 0.0, 0.0)
    read, airborne.stall_s = airborne.now, 3.0
    airborne.pilot.step(airborne.now, read)
    assert airborne.sticks == []
    airborne.now, airborne.stall_s = airborne.now + 3.0, 0.0
    airborne.pilot.step(airborne.now, read)
    assert (airborne.duty, airborne.sticks, airborne.said) == (Duty.LAND, [(0, 0, 0, 0)], ["land"])
    rising = Cockpit().take_off(0.6).forget()
    rising.pilot.step(rising.now + 8.0, rising.now)
    assert rising.said == ["land"]


@pytest.mark.parametrize(
    ("attended", "seconds", "report", "duty", "note"),
    [
        (False, 0.1, {}, Duty.LAND, "landing: its process did nothing for 2 s"),
        (True, 0.2, {"bat": 19}, Duty.LAND, "landing: battery at 19%"),
        (True, 3.5, {"h": 0}, Duty.REST, "landed by itself, battery at 80%"),
    ],
)
def test_what_ends_a_flight_is_said(attended, seconds, report, duty, note):
    cockpit = Cockpit(low_battery=0.2).fly()
    cockpit.attended = attended
    assert (cockpit.pass_(seconds, **report).duty, cockpit.note) == (duty, note)
    assert cockpit.pilot.battery == cockpit.report["bat"] / 100.0


def test_drone_that_flies_unordered_is_landed(grounded):
    grounded.pass_(5.0).pass_(5.0, h=120)
    assert not grounded.flying, "carried: its motors stand"
    grounded.report["h"] = 0
    for second in range(1, 4):
        grounded.pass_(1.0, time=second)
    assert (grounded.duty, grounded.flying) == (Duty.REST, False)  # low: carried, or on the floor
    grounded.pass_(0.1, h=80)
    assert (grounded.said[-1], grounded.flying) == ("land", True)
    assert grounded.note == "landing: it flew without an order"


def test_refused_sticks_are_counted(airborne):
    assert airborne.answer(b"error", b"error Not joystick").note == ""
    assert airborne.answer(b"error Not joystick").note == "refuses the sticks, 3 times: 'error Not joystick'"
    assert airborne.pass_(1.1).note == ""


def test_a_network_that_is_down_is_named(airborne):
    airborne.broken = True
    airborne.pass_(0.05)
    airborne.land()
    airborne.cut()
    assert "cannot send: Network is unreachable" in airborne.note
    airborne.broken = False
    assert airborne.pass_(0.2).note == ""


def test_yaw_counts_from_where_it_was_opened(grounded):
    assert grounded.pass_(0.2).pilot.turned == 0.0
    assert grounded.pass_(0.2, yaw=-70).pilot.turned == pytest.approx(np.pi / 2), "clockwise is positive to the drone"
    grounded.pass_(0.2, yaw="garbled", bat=None, h="", time=1.5)
    assert grounded.pilot.turned == pytest.approx(np.pi / 2)
    assert grounded.pilot.battery == 0.8


# ---------------------------------------------------------------------- landing


def test_landing_ends_when_answered_and_low(airborne):
    airborne.land()
    assert airborne.answer(b"ok").duty is Duty.LAND  # of the sticks: some firmware answers them
    assert airborne.pass_(0.5, h=0).answer(b"ok").duty is Duty.REST


class Climber(Cockpit):
    """Rises to 0.8 m in 4 s and answers `land` with "error" meanwhile; then obeys."""

    up_at = landed_at = np.inf

    def send_command_without_return(self, command):
        super().send_command_without_return(command)
        if command == "takeoff":
            self.up_at = min(self.up_at, self.now)
        elif command == "land" and self.now - self.up_at < 4.0:
            self.responses.append(b"error")
        elif command == "land":
            self.landed_at = min(self.landed_at, self.now)

    def fly_on(self, seconds):
        for _ in range(round(seconds / 0.05)):
            aloft = self.up_at < self.now < self.landed_at
            risen = max(0.0, min(80.0, 30.0 * (self.now - self.up_at - 1.0))) if aloft else 0.0
            ran = max(0.0, min(self.now, self.landed_at) - self.up_at)
            self.pass_(0.05, h=10 * int(risen / 10.0), time=int(ran))


def test_refused_landing_is_repeated_until_down():
    climber = Climber().take_off(0.8, rested_s=5.0)
    climber.fly_on(0.7)
    climber.land()
    climber.fly_on(0.3)
    assert (climber.duty, climber.report["h"]) == (Duty.LAND, 0)
    climber.fly_on(4.0)
    assert climber.said.count("land") == 5
    assert climber.landed_at < climber.now
    climber.fly_on(4.0)
    assert not climber.flying


def test_landing_before_the_motors_start_is_repeated(grounded):
    """A drone that rested for long and has just been told to take off is not on the ground for that."""
    grounded.take_off(0.8, rested_s=10.0).pass_(0.1)
    grounded.land()
    grounded.answer(b"ok").pass_(1.0)  # of anything but a landing: no drone is down again so soon
    assert grounded.duty is Duty.LAND
    assert grounded.said[-2:] == ["land", "land"]


def test_drone_that_does_not_land_rests_its_sticks(airborne):
    """The drone keeps the last sticks that it received."""
    airborne.aim(0.5, 0.0, 0.0, 0.0)
    assert airborne.pass_(0.1).sticks[-1] == (0, 50, 0, 0)
    airborne.forget().land()
    assert airborne.pass_(1.0).sticks == [(0, 0, 0, 0)], "a landing that is obeyed is left alone"
    assert airborne.answer(b"error").sticks == [(0, 0, 0, 0)] * 2


def test_height_of_motion_capture_counts_in_the_air(grounded):
    """A drone without a counter of motor seconds whose own height stays at zero."""
    del grounded.report["time"]
    grounded.take_off(1.0, at=(0.0, 0.0, 0.05)).pass_(3.0)
    grounded.responses.append(b"ok")
    grounded.pilot.position = (0.0, 0.0, 1.0)
    assert grounded.pass_(5.0).duty is Duty.HOLD
    grounded.land()
    assert grounded.answer(b"ok").duty is Duty.LAND
    grounded.pilot.position = (0.0, 0.0, 0.05)
    assert grounded.pass_(3.2).duty is Duty.REST


def test_silent_drone_is_landed_until_surely_down(airborne):
    airborne.speaks = False
    airborne.pass_(1.2)
    assert airborne.pilot.silent(airborne.now)
    assert airborne.note.startswith("silent for 1 s")
    airborne.land()
    assert airborne.forget().pass_(5.05).said == ["land"] * 5
    assert airborne.flying
    assert not airborne.pass_(15.0).flying
    assert "landed by itself" in airborne.note
    assert airborne.forget().pass_(1.0).said == ["command"] * 2  # once on again, it must be put into SDK mode
    airborne.speaks = True
    assert not airborne.pass_(0.2).pilot.silent(airborne.now)


def test_drone_left_aloft_lands_when_process_ends(airborne):
    airborne.pilot.leave()
    assert airborne.said == ["land"] * 5 + ["(end)"]


# ---------------------------------------------------------------------- emergency stop


def test_emergency_stop_is_repeated_until_motors_stand(airborne):
    airborne.cut()
    assert airborne.said == ["emergency"]
    airborne.cut()  # the loop's own stop, after that of the thread that receives
    for second in range(4, 9):  # all are lost: the clock of its motors runs on
        assert airborne.pass_(1.0, time=second).said == ["emergency"] * (2 + 20 * (second - 3))
        assert airborne.flying
        assert (UNANSWERED in airborne.note) == (second > 5)
    assert airborne.pass_(0.4, h=0).flying  # one is heard
    assert airborne.pass_(0.3).duty is Duty.REST
    assert airborne.note == ""
    assert airborne.forget().pass_(1.0).said == []


def test_silent_drone_is_stopped_until_surely_landed(airborne):
    airborne.speaks = False
    airborne.cut()
    assert airborne.forget().pass_(19.0).said == ["emergency"] * 380
    assert UNANSWERED in airborne.note
    assert airborne.pass_(1.2).duty is Duty.REST
    assert "landed by itself" in airborne.note


def test_standing_drone_answers_a_stop_at_once(grounded):
    grounded.pass_(2.0).cut()
    assert grounded.said[-1] == "emergency"
    assert not grounded.pass_(0.05).flying


def test_stopped_take_off_counts_as_flying_until_standing(grounded):
    grounded.take_off(0.6, rested_s=5.0).pass_(0.1).cut()  # its motors' clock has not moved yet
    assert grounded.pass_(1.4).flying
    assert not grounded.pass_(0.5).flying
