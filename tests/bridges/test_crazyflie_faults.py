"""What goes wrong between a Crazyflie bridge and its robot: the robot ends on the ground, the others go on."""

import socket
import threading
import time

import numpy as np
import pytest

from agents.body import BodyError
from bridges.crazyflie import open_crazyflie
from tests.bridges.crazyflie_flight import Process, flown, supervised, truth
from tests.twins.loopback import Served, request
from twins.crazyflie import open_device
from twins.crazyflie.supervisor import State

RADIO = "radio://0/80/2M/E7E7E7E70{}"


@pytest.fixture(autouse=True)
def toc_cache(monkeypatch, tmp_path_factory):
    """cflib's cache, kept from one test to the next and away from the user's."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


@pytest.mark.system
def test_five_percent_loss():
    """In both directions: it connects, flies, lands."""
    with flown(loss=0.05) as (twin, process):
        process.takeoff(0.3)
        process.setpoint = [(0.3, 0.0, 0.4, 0.0)]
        process.until(lambda: np.abs(truth(twin) - [0.3, 0.0, 0.4]).max() < 0.03, "goal")
        process.land()
        assert supervised(twin) != State.LOCKED


@pytest.mark.system
def test_silence_for_good():
    """Nothing gets through any more: the firmware cuts the motors by itself, the bridge says that the link is lost."""
    with flown(silent_from_s=3.0) as (twin, process):
        process.takeoff(0.3)
        process.setpoint = [(0.0, 0.0, 0.3, 0.0)]
        process.until(lambda: "no pose for" in process.state.notes[0], "silence noticed")
        process.until(lambda: supervised(twin) == State.LOCKED, "motors cut")
        process.until(lambda: not process.state.flying[0], "given up")
        assert truth(twin)[2] == 0.0
        assert process.t - process.state.time[0] > 0.5  # the robot's loop sees how old its position is


@pytest.mark.system
def test_silence_that_ends():
    """On the ground: a fresh connection, and nothing to say any more."""
    with flown(silent_from_s=0.7, silent_for_s=1.5) as (_, process):
        process.until(lambda: "link lost" in process.state.notes[0], "lost")
        process.until(lambda: process.state.notes[0] == "" and process.t - process.state.time[0] < 0.3, "back")


@pytest.mark.system
def test_silence_in_the_air():
    """Shorter than the firmware's patience: connected again, it is landed."""
    with flown(silent_from_s=3.0, silent_for_s=1.3) as (twin, process):
        process.takeoff(0.3)
        process.setpoint = [(0.0, 0.0, 0.3, 0.0)]
        process.until(lambda: "link lost" in process.state.notes[0], "lost")
        process.until(lambda: not process.state.flying[0], "landed")
        assert truth(twin)[2] == 0.0
        assert not twin.device.flock.quadrotor.flying[0]


@pytest.mark.system
def test_one_is_killed_the_other_flies_on():
    first = Served(open_device, request("crazyflie", ["crazyflie-twin"]))
    second = Served(open_device, request("crazyflie", ["crazyflie-twin"], start=[[0.0, 1.0, 0.0]]))
    process = Process(open_crazyflie(request("crazyflie", [first.addresses[0], second.addresses[0]])))
    try:
        process.takeoff(0.3)
        process.setpoint = [(0.0, 0.0, 0.3, 0.0), (0.0, 1.0, 0.3, 0.0)]
        process.run(0.2)
        first.kill()
        process.until(lambda: process.state.notes[0] != "", "said so")
        process.setpoint = [(np.nan,) * 4, (0.3, 1.0, 0.3, 0.0)]
        process.until(lambda: not process.state.flying[0], "given up")
        process.until(lambda: abs(truth(second)[0] - 0.3) < 0.02, "goal")
        assert process.state.flying[1]
        assert process.state.notes[1] == ""
        process.cut()
    finally:
        process.close()
        first.kill()
        second.kill()


@pytest.mark.system
def test_loop_that_stops_commanding():
    """A robot whose loop hangs is landed by its own thread."""
    with flown() as (twin, process):
        process.takeoff(0.3)
        process.setpoint = [(0.0, 0.0, 0.3, 0.0)]
        process.run(0.2)
        pause, deadline = threading.Event(), time.monotonic() + 8.0
        while truth(twin)[2] > 0.0:
            assert time.monotonic() < deadline, "it was not landed"
            pause.wait(0.02)
        assert supervised(twin) != State.LOCKED
        assert "nobody commanded" in process.tick().notes[0]


@pytest.mark.system
def test_battery_runs_empty():
    """It lands by itself, and does not take off again."""
    with flown(battery=0.18, drain=5.0) as (twin, process):
        process.takeoff(0.3)
        process.setpoint = [(0.0, 0.0, 0.3, 0.0)]
        process.until(lambda: not process.state.flying[0], "landed")
        assert truth(twin)[2] == 0.0
        assert supervised(twin) != State.LOCKED
        assert process.state.battery[0] < 0.17
        process.body.takeoff(np.array([0]), np.array([0.5]))
        process.until(lambda: "does not take off: battery low" in process.state.notes[0], "refusal")
        assert not process.state.flying[0]


@pytest.mark.system
def test_refused_arming():
    with flown(refuse_arming=True) as (twin, process):
        process.tick()
        process.body.takeoff(np.array([0]), np.array([0.5]))
        process.until(lambda: "refuses to be armed" in process.state.notes[0], "refusal")
        process.until(lambda: not process.state.flying[0], "not flying")
        assert truth(twin)[2] == 0.0


@pytest.mark.system
def test_absent():
    """Somebody who never answers, or nobody at the address: said within five seconds, with the remedy."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mute:
        mute.bind(("127.0.0.1", 0))
        address = f"udp://127.0.0.1:{mute.getsockname()[1]}"
        begin = time.monotonic()
        with pytest.raises(BodyError, match=f"R0: nobody answers at {address}: is the simulation running there"):
            open_crazyflie(request("crazyflie", [address])).open()
        assert time.monotonic() - begin < 6.0
    begin = time.monotonic()
    with pytest.raises(BodyError, match="is the simulation running there"):
        open_crazyflie(request("crazyflie", [address])).open()
    assert time.monotonic() - begin < 6.0


@pytest.mark.system
def test_one_of_two_is_absent():
    """The other one is ready; the absent one's note says what is the matter."""
    twin = Served(open_device, request("crazyflie", ["crazyflie-twin"]))
    process = Process(open_crazyflie(request("crazyflie", [twin.addresses[0], "udp://127.0.0.1:1"])))
    try:
        process.tick()
        assert process.state.notes[0] == ""
        assert "udp://127.0.0.1:1" in process.state.notes[1]
        assert np.isnan(process.state.position[1]).all()
    finally:
        process.close()
        twin.kill()


@pytest.mark.system
@pytest.mark.parametrize(("address", "said"), [(RADIO.format(1), "Crazyradio"), ("usb://0", "plugged in")])
def test_nothing_plugged_in(address, said):
    """No dongle and no robot is plugged in here; no traceback either."""
    with pytest.raises(BodyError, match=said):
        open_crazyflie(request("crazyflie", [address])).open()


@pytest.mark.parametrize(
    "address", ["radio://0/80/3M/E7", "radio://0/130/2M", "udp://127.0.0.1", "usb://", "http://somewhere", ""]
)
def test_wrong_address(address):
    with pytest.raises(BodyError, match=r"R0: .* is no Crazyflie's address; write radio://0/80/2M/E7E7E7E701"):
        open_crazyflie(request("crazyflie", [address]))


@pytest.mark.parametrize(
    ("device", "said"),
    [
        ({"contrl": "position"}, "R0: device: .*contrl"),
        ({"control": "attitude"}, "R0: device: .*control"),
        ({"log_hz": 500.0}, "R0: device: .*log_hz"),
        ({"positioning": {"system": "gps"}}, "R0: device: .*positioning"),
        ({"positioning": {"system": "external"}}, 'needs position = "external"'),
    ],
)
def test_wrong_settings(device, said):
    with pytest.raises(BodyError, match=said):
        open_crazyflie(request("crazyflie", [RADIO.format(1)], device=device))


def test_two_at_one_address():
    with pytest.raises(BodyError, match="several robots have the address"):
        open_crazyflie(request("crazyflie", [RADIO.format(1)] * 2))


def test_other_robots():
    with pytest.raises(BodyError, match="R0 is a tello"):
        open_crazyflie(request("tello", [RADIO.format(1)]))


def test_crowded_radio():
    """Nine robots at 50 + 10 packets per second are more than one radio carries; eight are not."""
    for count, said in ((8, ""), (9, "radio 0: 9 robots log 540 packets/s, it carries about 500")):
        body = open_crazyflie(request("crazyflie", [RADIO.format(row) for row in range(count)]))
        notes = body.read(0.0).notes
        assert len(notes) == count
        assert all(said in note for note in notes)
        assert ("packets/s" in notes[0]) == bool(said)
