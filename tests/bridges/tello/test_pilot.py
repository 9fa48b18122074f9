"""The pilot of a Tello against a drone made of lists and a clock made of numbers; several pilots; their library."""

import socket
import time
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.body.interface import UNANSWERED, BodyError
from bridges.tello import pilot, protocol
from bridges.tello.body import TelloBody
from bridges.tello.kind import TELLO
from bridges.tello.library import TelloLibrary, filters_answers
from bridges.tello.pilot import Duty, TelloPilot
from bridges.tello.protocol import TelloPlace
from tests.requests import request

SPEED = st.floats(-1.0, 1.0)
NOTHING_COMES = SimpleNamespace(receive=lambda: None)


class Cockpit:
    """A pilot, its clock, and its drone, which notes commands and reports what the test lets it report."""

    def __init__(self, **chosen):
        self.said, self.sticks, self.state, self.responses = [], [], {}, []
        self.now, self.stall_s = 100.0, 0.0  # a stall is a standstill of the process in the middle of a step
        self.pilot = TelloPilot(self, TELLO, protocol.TelloSettings(**chosen), lambda: self.now + self.stall_s)
        self.report = {"bat": 80, "yaw": 20, "h": 0, "time": 0}
        self.speaks = self.attended = True
        self.broken = False

    def send_command_without_return(self, command):
        if self.broken:
            raise OSError(101, "Network is unreachable")
        word, *numbers = command.split()
        if word == "rc":
            self.sticks.append(tuple(map(int, numbers)))
        else:
            self.said.append(command)

    def get_current_state(self):
        return self.state

    def get_own_udp_object(self):
        return {"responses": self.responses}

    def end(self):
        self.said.append("(end)")

    @property
    def duty(self):
        return self.pilot.duty

    @property
    def flying(self):
        return self.pilot.flying

    @property
    def note(self):
        return self.pilot.note(self.now)

    def pass_(self, seconds, **report):
        """Step for some seconds, with a changed report from now on."""
        self.report.update(report)
        for _ in range(round(seconds / 0.05)):
            self.now = round(self.now + 0.05, 6)
            if self.speaks and round(self.now * 20) % 2 == 0:
                self.state = dict(self.report)
            self.pilot.step(self.now, self.now if self.attended else 100.0)
        return self

    def answer(self, *texts, **report):
        """Hand answers of the drone to its pilot."""
        self.responses += texts
        return self.pass_(0.1, **report)

    def forget(self):
        """Forget what was commanded so far."""
        self.said.clear()
        self.sticks.clear()
        return self

    def take_off(self, height, *, at=(0.0, 0.0, 0.0), rested_s=0.2):
        """Order a take-off to `height` [m] at a position, after a rest on the ground."""
        self.pass_(rested_s).forget()
        self.pilot.position = at
        self.pilot.take_off(height, self.now)
        return self

    def land(self):
        self.pilot.land(self.now)
        return self

    def cut(self):
        self.pilot.cut(self.now)
        return self

    def aim(self, *setpoint):
        """Give the pilot in flight a setpoint."""
        self.pilot.duty, self.pilot.setpoint, self.pilot.setpoint_time = Duty.FLY, setpoint, self.now

    def fly(self):
        """In the air, at its place, its motors' clock running."""
        self.take_off(0.6, at=(1.0, 2.0, 0.0)).pass_(3.0, h=80, time=3).answer(b"ok")
        assert self.duty is Duty.HOLD
        return self.forget()


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


def test_addresses():
    for address in ("tello", "tello://", "tello://192.168.10.1"):
        assert protocol.endpoint("T", address) == ("192.168.10.1", 8889, "")
    assert protocol.endpoint("T", "tello://127.0.0.2:18889") == ("127.0.0.2", 18889, "")
    assert protocol.endpoint("T", "tello://10.0.0.2%Wlan1:9") == ("10.0.0.2", 9, "Wlan1")


def test_take_off_is_sent_once_and_answered_aloft(grounded):
    grounded.pass_(0.2).responses.append(b"ok")  # of something that was said before
    grounded.take_off(0.6, rested_s=0.0).pass_(0.5)
    assert (grounded.flying, grounded.duty) == (True, Duty.RISE)
    grounded.answer(b"ok").pass_(2.9)  # too early: no drone is up by then
    assert grounded.duty is Duty.RISE
    grounded.answer(b"ok\r\n")
    assert grounded.duty is Duty.HOLD
    assert grounded.said == ["takeoff"]


def test_a_drone_that_refuses_says_so(grounded):
    grounded.take_off(0.6).answer(b"unknown command: takeoff")
    assert grounded.duty is Duty.REST
    assert "refuses to take off" in grounded.note
    grounded.take_off(0.6).pass_(2.0, h=80).answer(b"error")
    assert grounded.duty is Duty.HOLD, "a second order that is refused means that it flies"


def test_lost_answers_and_lost_commands(grounded):
    grounded.take_off(0.6).pass_(6.5)  # nothing happens: the command was lost
    assert grounded.said == ["takeoff", "takeoff"]
    grounded.pass_(6.5, h=80, time=6)  # it is up: the answer was lost
    assert grounded.duty is Duty.HOLD
    grounded.land()
    grounded.pass_(2.2, h=70)
    assert grounded.said[2:] == ["land", "land", "land"]
    grounded.pass_(3.3, h=10)  # it is down, its motors' clock stands
    assert (grounded.duty, grounded.flying) == (Duty.REST, False)


def test_a_drone_that_never_gets_up_is_landed(grounded):
    grounded.take_off(0.6).pass_(20.2)
    assert grounded.said[-1] == "land"
    grounded.pass_(1.2)  # it may have obeyed the last of the orders to take off, 3 s ago
    assert not grounded.flying
    assert "did not take off in 20 s" in grounded.note


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


def test_sticks_of_a_killed_process_are_centred_first(grounded):
    """The drone keeps them, and sends its state to whoever comes."""
    grounded.state = {**grounded.report, "h": 80}
    grounded.pass_(0.05)
    assert (grounded.said, grounded.sticks) == (["command"], [(0, 0, 0, 0)])


def test_refused_sticks_are_counted(airborne):
    assert airborne.answer(b"error", b"error Not joystick").note == ""
    assert airborne.answer(b"error Not joystick").note == "refuses the sticks, 3 times: 'error Not joystick'"
    assert airborne.pass_(1.1).note == ""
    airborne.broken = True
    airborne.pass_(0.05).land().cut()
    assert "cannot send: Network is unreachable" in airborne.note
    airborne.broken = False
    assert airborne.pass_(0.2).note == ""


def test_yaw_counts_from_where_it_was_opened(grounded):
    assert grounded.pass_(0.2).pilot.turned == 0.0
    assert grounded.pass_(0.2, yaw=-70).pilot.turned == pytest.approx(np.pi / 2), "clockwise is positive to the drone"
    grounded.pass_(0.2, yaw="garbled", bat=None, h="", time=1.5)
    assert (grounded.pilot.turned, grounded.pilot.battery) == (pytest.approx(np.pi / 2), 0.8)


def test_landing_ends_when_answered_and_low(airborne):
    airborne.land()
    assert airborne.answer(b"ok").duty is Duty.LAND  # of the sticks: some firmware answers them
    assert airborne.pass_(0.5, h=0).answer(b"ok").duty is Duty.REST


def test_refused_landing_is_repeated_until_down(grounded):
    """A drone that answers `land` with "error" while it rises."""
    grounded.take_off(0.8, rested_s=5.0).pass_(0.7).land()
    for second in range(1, 5):
        grounded.answer(b"error", time=second, h=20 * (second - 1)).pass_(0.9)
        assert grounded.duty is Duty.LAND
    assert grounded.said.count("land") == 8, "every 0.2 s at first"
    grounded.answer(b"ok", h=0).pass_(4.0)
    assert not grounded.flying


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
    assert airborne.pass_(1.0, h=70).sticks == [(0, 0, 0, 0)], "a landing that is obeyed is left alone"
    assert airborne.answer(b"error").sticks == [(0, 0, 0, 0)] * 2


def test_lost_order_to_land_comes_again_soon(airborne):
    """The drone went on by its last sticks for a second."""
    airborne.land()
    assert airborne.pass_(0.5).said == ["land"] * 3
    assert airborne.sticks == [(0, 0, 0, 0)] * 3
    assert airborne.pass_(0.4, h=70).said == ["land"] * 3


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
    assert airborne.forget().pass_(5.05).said == ["land"] * 8
    assert airborne.flying
    assert not airborne.pass_(15.0).flying
    assert "landed by itself" in airborne.note
    assert airborne.forget().pass_(1.0).said == ["command"] * 2  # once on again, it must be put into SDK mode
    airborne.speaks = True
    assert not airborne.pass_(0.2).pilot.silent(airborne.now)


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


def test_stopped_take_off_counts_as_flying_until_standing(grounded):
    grounded.take_off(0.6, rested_s=5.0).pass_(0.1).cut()  # its motors' clock has not moved yet
    assert grounded.pass_(1.4).flying
    assert not grounded.pass_(0.5).flying
    assert grounded.pass_(2.0).forget().cut().said == ["emergency"]
    assert not grounded.pass_(0.05).flying, "one that stands answers at once"


def body_of(*cockpits):
    """A body with these pilots, never opened, whose drones answer on whatever clock."""
    body = TelloBody(request("tello", [f"tello://10.0.0.{row}" for row in range(len(cockpits))], external=True))
    body.pilots = [cockpit.pilot for cockpit in cockpits]
    for each in body.pilots:
        each.state_received = each.aloft = np.inf
    body.read(0.0)
    return body


@pytest.mark.parametrize("kind", [AssertionError, StopIteration])
def test_failing_pilot_lands_and_others_fly(airborne, kind):
    def fail():
        raise kind("broken")

    other = Cockpit().fly()
    airborne.get_own_udp_object = fail
    body = body_of(airborne, other)
    for _ in range(3):
        body.step(NOTHING_COMES)
    assert len(other.sticks) == 3
    assert set(airborne.said) == {"land"}
    assert airborne.pilot.trouble == f"cannot be driven: {kind.__name__}: broken"


def test_undrivable_drone_keeps_no_other_from_stopping(airborne):
    other = Cockpit().fly()
    body = body_of(airborne, other)
    airborne.get_own_udp_object = dict
    for what in (body.land, body.stop):
        with pytest.raises(KeyError, match="responses"):
            what(range(2))
    assert other.said == ["land", "emergency"]


def test_sleep_of_the_machine_ends_its_flight(airborne, monkeypatch):
    """The machine's monotonic clock stands still meanwhile; its uptime goes on."""
    body = body_of(airborne)
    body.command([(0.5, 0.0, 0.0, 0.0)])
    gettime = time.clock_gettime
    monkeypatch.setattr(time, "clock_gettime", lambda which: gettime(which) + 3.0)
    body.step(NOTHING_COMES)
    assert (airborne.duty, airborne.sticks) == (Duty.LAND, [(0, 0, 0, 0)])


def test_stop_counts_while_the_body_closes(airborne, monkeypatch):
    left = Cockpit().fly()
    left.pilot.leave()
    assert left.said == ["land"] * 5 + ["(end)"]
    body = body_of(airborne)
    monkeypatch.setattr(pilot.time, "sleep", lambda _: body.stop([0]))
    body.close()
    assert airborne.said[:2] == ["land", "emergency"]
    assert set(airborne.said[1:-1]) == {"emergency"}
    body.stop([0])  # nobody is left
    assert airborne.said[-1] == "(end)"


@pytest.mark.skipif(find_spec("djitellopy") is None, reason="needs djitellopy")
def test_telemetry_outlives_bytes_of_nonsense():
    with socket.socket(type=socket.SOCK_DGRAM) as first, socket.socket(type=socket.SOCK_DGRAM) as second:
        for free in (first, second):
            free.bind(("", 0))
        answers, states = (free.getsockname()[1] for free in (first, second))
    library = TelloLibrary(answers, states)
    drone = library.drone(TelloPlace("127.0.0.2", 18889))
    with socket.socket(type=socket.SOCK_DGRAM) as sender, socket.socket(type=socket.SOCK_DGRAM) as stranger:
        sender.bind(("127.0.0.2", 0))
        for data in (b"\xff", b"", b"ok", b"h:", b"h:x;bat:9", b"x" * 5000, b"\xffh:70;bat:9;"):
            sender.sendto(data, ("127.0.0.1", states))
        stranger.sendto(b"h:50;bat:1;\r\n", ("127.0.0.1", states))
        library.receive()
        assert drone.get_current_state() == {}
        for height in range(150):  # more than are read at a time
            sender.sendto(b"h:%d;bat:80;time:3;\r\n" % height, ("127.0.0.1", states))
        sender.sendto(b"ok", ("127.0.0.1", answers))
        library.receive()
        assert drone.get_current_state()["h"] == 99
        library.receive()
    assert drone.get_current_state() == {"h": 149, "bat": 80, "time": 3}
    assert drone.get_own_udp_object()["responses"] == [b"ok"]
    library.close()


@pytest.mark.skipif(find_spec("djitellopy") is None, reason="needs djitellopy")
def test_drones_of_one_address_have_an_interface_each():
    with socket.socket(type=socket.SOCK_DGRAM) as first, socket.socket(type=socket.SOCK_DGRAM) as second:
        for free in (first, second):
            free.bind(("", 0))
        answers, states = (free.getsockname()[1] for free in (first, second))
    library = TelloLibrary(answers, states, ("", "lo"))
    with socket.socket(type=socket.SOCK_DGRAM) as far:
        far.bind(("127.0.0.2", 0))
        far.settimeout(10.0)
        places = [TelloPlace("127.0.0.2", far.getsockname()[1], interface) for interface in ("", "lo")]
        drones = [library.drone(place) for place in places]
        drones[1].send_command_without_return("command")
        command, peer = far.recvfrom(100)
        assert (command, peer[1]) == (b"command", answers)
        far.sendto(b"h:20;bat:70;\r\n", ("127.0.0.1", states))
        library.receive()
        assert [drone.get_current_state().get("bat") for drone in drones] == [None, 70]
        with pytest.raises(BodyError, match=rf"UDP port {answers} of this computer is taken"):
            TelloLibrary(answers, states)
    library.close()
    with pytest.raises(BodyError, match=r"no network interface 'wlan9', only .*lo"):
        TelloLibrary(answers, states, ("wlan9",))
    assert not filters_answers("")
    assert not filters_answers("wlan9")
