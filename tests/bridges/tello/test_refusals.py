"""Tellos that do not do what they are told, and datagrams that are none of theirs."""

import socket
import time
from importlib.util import find_spec

import numpy as np
import pytest

from bridges.tello import pilot
from bridges.tello.body import TelloBody
from bridges.tello.library import TelloLibrary
from bridges.tello.pilot import Duty
from tests.bridges.tello.cockpit import Cockpit
from tests.twins.loopback import request


class Climber(Cockpit):
    """Rises to 0.8 m in 4 s and answers `land` with "error" meanwhile; then obeys."""

    def __init__(self):
        super().__init__()
        self.up_at = self.landed_at = np.inf
        note = self.drone.send_command_without_return

        def obey(command):
            note(command)
            if command == "takeoff":
                self.up_at = min(self.up_at, self.now)
            elif command == "land" and self.now - self.up_at < 4.0:
                self.drone.responses.append(b"error")
            elif command == "land":
                self.landed_at = min(self.landed_at, self.now)

        self.drone.send_command_without_return = obey

    def fly_on(self, seconds):
        for _ in range(round(seconds / 0.05)):
            aloft = self.up_at < self.now < self.landed_at
            risen = max(0.0, min(80.0, 30.0 * (self.now - self.up_at - 1.0))) if aloft else 0.0
            ran = max(0.0, min(self.now, self.landed_at) - self.up_at)
            self.pass_(0.05, h=10 * int(risen / 10.0), time=int(ran))
        return self


def test_refused_landing_is_repeated_until_down():
    climber = Climber()
    climber.take_off(0.8, rested_s=5.0)
    climber.fly_on(0.7)
    climber.pilot.land(climber.now, "told to land")
    climber.fly_on(0.3)
    assert (climber.pilot.duty, climber.report["h"]) == (Duty.LAND, 0)
    climber.fly_on(4.0)
    assert climber.drone.said.count("land") == 5
    assert climber.landed_at < climber.now
    climber.fly_on(4.0)
    assert not climber.pilot.flying


def test_landing_before_the_motors_start_is_repeated():
    """A drone that rested for long and has just been told to take off is not on the ground for that."""
    cockpit = Cockpit()
    cockpit.take_off(0.8, rested_s=10.0)
    cockpit.pass_(0.1)
    cockpit.pilot.land(cockpit.now)
    cockpit.drone.responses.append(b"ok")  # of anything but a landing: no drone is down again so soon
    cockpit.pass_(1.1)
    assert cockpit.pilot.duty is Duty.LAND
    assert cockpit.drone.said[-2:] == ["land", "land"]


def test_drone_that_flies_unordered_is_landed():
    cockpit = Cockpit()
    cockpit.pass_(5.0)
    for second in range(1, 4):
        cockpit.pass_(1.0, time=second)
    assert (cockpit.pilot.duty, cockpit.pilot.flying) == (Duty.REST, False)  # low: carried, or on the floor
    cockpit.pass_(0.1, h=80)
    assert cockpit.drone.said[-1] == "land"
    assert cockpit.pilot.flying
    assert cockpit.pilot.note(cockpit.now) == "landing: it flew without an order"


def test_drone_that_does_not_land_rests_its_sticks():
    """It keeps the last sticks that it was told."""
    cockpit = Cockpit().fly()
    cockpit.aim((0.5, 0.0, 0.0, 0.0))
    cockpit.pass_(0.1)
    assert cockpit.drone.sticks[-1] == (0, 50, 0, 0)
    cockpit.pilot.land(cockpit.now)
    assert cockpit.drone.sticks[-1] == (0, 0, 0, 0)
    count = len(cockpit.drone.sticks)
    cockpit.pass_(1.0)
    assert len(cockpit.drone.sticks) == count  # a landing that is obeyed is left alone
    cockpit.drone.responses.append(b"error")
    cockpit.pass_(0.05)
    assert len(cockpit.drone.sticks) == count + 1


def test_height_of_motion_capture_counts_in_the_air():
    """A drone without a counter of motor seconds whose own height stays at zero."""
    cockpit = Cockpit()
    del cockpit.report["time"]
    cockpit.take_off(1.0, at=(0.0, 0.0, 0.05))
    cockpit.pass_(3.0)
    cockpit.drone.responses.append(b"ok")
    cockpit.pilot.position = (0.0, 0.0, 1.0)
    cockpit.pass_(5.0)
    assert cockpit.pilot.duty is Duty.HOLD
    cockpit.pilot.land(cockpit.now)
    cockpit.drone.responses.append(b"ok")
    cockpit.pass_(0.05)
    assert cockpit.pilot.duty is Duty.LAND
    cockpit.pilot.position = (0.0, 0.0, 0.05)
    cockpit.pass_(3.2)
    assert cockpit.pilot.duty is Duty.REST


def test_stop_counts_while_the_body_closes(monkeypatch):
    body, cockpit = TelloBody(request("tello", ["tello://10.0.0.2"], external=True)), Cockpit().fly()
    body.pilots = [cockpit.pilot]
    cockpit.drone.said.clear()
    monkeypatch.setattr(pilot.time, "sleep", lambda _: body.stop([0]))
    body.close()
    assert cockpit.drone.said[:2] == ["land", "emergency"]
    assert set(cockpit.drone.said[1:-1]) == {"emergency"}
    body.stop([0])  # nobody is left
    assert cockpit.drone.said[-1] == "(end)"


def test_carried_drone_is_left_alone():
    cockpit = Cockpit()
    cockpit.pass_(5.0)
    cockpit.pass_(5.0, h=120)
    assert not cockpit.pilot.flying


def test_refused_sticks_are_counted():
    cockpit = Cockpit().fly()
    cockpit.drone.responses += [b"error", b"error Not joystick"]
    cockpit.pass_(0.05)
    assert cockpit.pilot.note(cockpit.now) == ""
    cockpit.drone.responses.append(b"error Not joystick")
    cockpit.pass_(0.05)
    assert cockpit.pilot.note(cockpit.now) == "refuses the sticks, 3 times: 'error Not joystick'"
    cockpit.pass_(1.1)
    assert cockpit.pilot.note(cockpit.now) == ""


class Rounds:
    """An event that ends a thread after so many rounds."""

    def __init__(self, count):
        self.left = count

    def wait(self, _):
        self.left -= 1
        return self.left < 0


class Post:
    def receive(self):
        """Nothing comes."""


@pytest.mark.parametrize("kind", [AssertionError, MemoryError, StopIteration, KeyError])
def test_failing_pilot_lands_and_others_fly(kind):
    body = TelloBody(request("tello", ["tello://10.0.0.2", "tello://10.0.0.3"], external=True))
    broken, good = Cockpit().fly(), Cockpit().fly()

    def fail():
        raise kind("broken")

    broken.drone.get_own_udp_object = fail
    for cockpit in (broken, good):
        cockpit.pilot.state_received = cockpit.pilot.aloft = np.inf  # on whatever clock
        cockpit.drone.said.clear()
        cockpit.drone.sticks.clear()
    body.pilots, body._ending, body._last_read = [broken.pilot, good.pilot], Rounds(3), np.inf
    body._run(Post())
    assert len(good.drone.sticks) == 3
    assert set(broken.drone.said) == {"land"}
    assert broken.pilot.trouble == f"cannot be driven: {kind.__name__}: {kind('broken')}"


def test_sleep_of_the_machine_ends_its_flight(monkeypatch):
    """The machine's monotonic clock stands still meanwhile; its uptime goes on."""
    body, cockpit = TelloBody(request("tello", ["tello://10.0.0.2"], external=True)), Cockpit().fly()
    pilot = cockpit.pilot
    pilot.state_received = pilot.aloft = np.inf
    body.pilots, body._ending = [pilot], Rounds(1)
    body.read(0.0)
    body.command([(0.5, 0.0, 0.0, 0.0)])
    cockpit.drone.sticks.clear()
    gettime = time.clock_gettime
    monkeypatch.setattr(time, "clock_gettime", lambda which: gettime(which) + 3.0)
    body._run(Post())
    assert pilot.duty is Duty.LAND
    assert cockpit.drone.sticks == [(0, 0, 0, 0)]


@pytest.mark.skipif(find_spec("djitellopy") is None, reason="needs djitellopy")
def test_telemetry_outlives_bytes_of_nonsense():
    library = TelloLibrary(control_port=0, state_port=0)
    drone = library.drone("127.0.0.2", 18889)
    states, answers = (wire.getsockname()[1] for wire in (library._states, library._answers))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender, socket.socket(type=socket.SOCK_DGRAM) as stranger:
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
