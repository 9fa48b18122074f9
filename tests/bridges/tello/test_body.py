"""The Tello bridge: settings, several pilots, and the real djitellopy with twins in a process of its own."""

import fcntl
import json
import socket
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from agents.protocols import tello as protocol
from bridges.tello import pilot
from bridges.tello.body import TelloBody
from bridges.tello.library import TelloLibrary
from bridges.tello.pilot import Duty
from tests.bridges.tello.cockpit import Cockpit
from tests.conftest import ROOT
from tests.requests import request

NOTHING_COMES = SimpleNamespace(receive=lambda: None)


@pytest.mark.parametrize(
    ("address", "place"),
    [
        ("tello://192.168.10.1", ("192.168.10.1", 8889)),
        ("tello://127.0.0.2:18889", ("127.0.0.2", 18889)),
        ("tello", ("192.168.10.1", 8889)),
        ("tello://", ("192.168.10.1", 8889)),
    ],
)
def test_addresses(address, place):
    assert protocol.endpoint("T", address) == place


# ---------------------------------------------------------------------- pilots without a network


def body_of(*cockpits):
    """A body with these pilots, never opened, whose drones answer on whatever clock."""
    body = TelloBody(request("tello", [f"tello://10.0.0.{row}" for row in range(len(cockpits))], external=True))
    body.pilots = [cockpit.pilot for cockpit in cockpits]
    for each in body.pilots:
        each.state_received = each.aloft = np.inf
    body.read(0.0)
    return body


@pytest.fixture
def airborne():
    return Cockpit().fly()


@pytest.fixture
def other():
    return Cockpit().fly()


@pytest.mark.parametrize("kind", [AssertionError, MemoryError, StopIteration, KeyError])
def test_failing_pilot_lands_and_others_fly(airborne, other, kind):
    def fail():
        raise kind("broken")

    airborne.get_own_udp_object = fail
    body = body_of(airborne, other)
    for _ in range(3):
        body.step(NOTHING_COMES)
    assert len(other.sticks) == 3
    assert set(airborne.said) == {"land"}
    assert airborne.pilot.trouble == f"cannot be driven: {kind.__name__}: {kind('broken')}"


def test_undrivable_drone_keeps_no_other_from_stopping(airborne, other):
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
    drone = library.drone("127.0.0.2", 18889)
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


# ---------------------------------------------------------------------- djitellopy and twins


def report_of(scenario):
    """Report of a scenario; the ports of djitellopy are the host's, so they take turns."""
    command = [sys.executable, "-m", "tests.bridges.tello.scenarios", scenario]
    with (Path(tempfile.gettempdir()) / "zenpark-tello.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60.0, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    return json.loads(done.stdout)


@pytest.mark.system
def test_the_unmodified_library_flies_two_twins():
    told = report_of("vendor")
    assert (told["sdk"], told["battery"], told["serial"]) == ("20", 100, "0TQTWIN0001")
    assert (told["grounded"], told["unknown"]) == ("error Motor stop", "unknown command: dance")
    assert told["height"] == pytest.approx([0.8, 0.8], abs=0.05)
    assert told["go"] == pytest.approx([0.5, 0.4, 0.8], abs=0.06)
    assert told["yaw"] == pytest.approx(-np.pi / 2, abs=0.03)
    assert "out of range" in told["refused"]
    assert 8 <= told["states"] <= 12
    assert told["keys"] == 21
    assert told["reported"] == [pytest.approx(90, abs=2), pytest.approx(75, abs=5), pytest.approx(79, abs=2)]
    assert max(told["end"]) < 0.5


@pytest.mark.system
def test_the_bridge_flies_two_twins():
    told = report_of("formation")
    assert told["height"] == 0.0
    assert told["error"] < 0.02
    assert told["velocity"] < 0.2
    assert told["yaw"] == pytest.approx([0.0, 0.0], abs=0.02)
    assert all(0.9 < charge <= 1.0 for charge in told["battery"])
    assert told["notes"] == ["", ""]


@pytest.mark.mechanism("Tello bridge: one of several fails")
@pytest.mark.system
def test_fault_of_one_drone_leaves_others_flying():
    told = report_of("faults")
    assert told["opened"] > 1.0
    assert told["flying"] == [True, True, True, True, False, False]
    assert (told["absent"], told["absent takeoff"], told["blind"]) == ("no answer", "no answer", True)
    assert told["empty"] == "no take-off: battery at 8%"
    assert told["killed"].startswith("silent for")
    assert told["silent"].startswith("silent for")
    assert told["silence"][0] < 0.5 < told["silence"][1]
    assert told["weak"] == "landing: battery at 9%"
    assert told["weak_height"] < 0.05


@pytest.mark.system
def test_what_does_not_take_off_says_why():
    told = report_of("refusals")
    assert told["seconds"] < 5.0
    assert told["absent"].startswith("R0 at 127.0.0.77:18889: no answer (switch it on, join its Wi-Fi")
    assert told["nowhere"].startswith("no take-off: no fresh external position")
    assert told["hung"] == "landing: its process did nothing for 2 s"
    assert told["second"].startswith("UDP port 8889 of this computer is taken")
    assert not told["flying"]
