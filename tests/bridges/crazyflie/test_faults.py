"""Faults between a Crazyflie bridge and its robot: the robot ends on the ground, the others go on."""

import os
import signal
import socket
import sys
import time

import numpy as np
import pytest

from agents.body.interface import BodyError
from agents.protocols.crazyflie import CrazyflieSettings, Outside, capacity, overload
from bridges.crazyflie import link
from tests.bridges.crazyflie_flight import connected, connected_twins, motors, supervised, truth
from tests.commands import started
from tests.requests import request
from tests.twins.loopback import Served
from tests.waiting import until
from twins.devices.crazyflie.device import CrazyflieTwin
from twins.devices.crazyflie.supervisor import SupervisorState
from twins.devices.device import Faults

RADIO = "radio://0/80/2M/E7E7E7E701"


@pytest.mark.system
def test_faulty_drones_fail_differently_while_others_fly_on():
    """In one process: one is well, one loses 5 % of all packets; one falls silent for good, one for a moment, one's
    battery runs empty, and one is killed. Those in reach end on the ground with their motors off; the others count
    as flying, because nothing is seen of their motors.
    """
    well, lossy, mute, blinking, empty, killed = range(6)
    places = [(0.0, float(row), 0.3, 0.0) for row in range(6)]
    with (
        Served(CrazyflieTwin, request("crazyflie", ["crazyflie-twin"] * 5)) as twin,
        Served(CrazyflieTwin, request("crazyflie", ["crazyflie-twin"], start=[[0.0, 5.0, 0.0]])) as other,
        connected([*twin.addresses, *other.addresses]) as process,
    ):
        lines, battery = twin.device.lines, twin.device.drones[empty].vehicle.battery
        process.until(lambda: np.isfinite(process.state.position).all(), "all are connected")
        lines[lossy].faults = Faults(loss=0.05)  # not before: 402 parameters take long without repetitions
        process.takeoff(0.3)
        process.lead(*places).run(0.3)
        lines[mute].faults = Faults(silent_from_s=0.0)
        lines[blinking].faults = Faults(silent_from_s=lines[blinking].t, silent_for_s=1.2)
        battery.charge = 0.05
        other.kill()
        process.lead(*[(0.3, *place[1:]) for place in places[:2]], *places[2:])
        said = [set() for _ in range(6)]

        def settled():
            for row, note in enumerate(process.state.note):
                said[row].add(note)
            unseen = all("motors may be on" in process.state.note[row] for row in (mute, killed))
            return unseen and not process.state.flying[[blinking, empty]].any()

        process.until(settled, "those that fail are down")
        assert not any(supervised(twin, row) == SupervisorState.LOCKED for row in range(5))
        assert not any(motors(twin, row) for row in (blinking, empty))
        assert process.state.flying[[mute, killed]].all()
        assert truth(twin, mute)[2] == truth(twin, blinking)[2] == truth(twin, empty)[2] == 0.0
        expected = {mute: "no pose for", blinking: "link lost", empty: "landed: battery low", killed: "link lost"}
        for row, text in expected.items():
            assert any(text in note for note in said[row]), (row, said[row])
        assert process.t - process.state.time[mute] > 0.5  # the robot's loop sees how old its position is,
        assert process.t - process.state.received[mute] > 0.5  # and that its device is silent
        process.until(lambda: process.t - process.state.received[well] < 0.5, "the one that is well is heard")
        assert not any("landed" in note or "link lost" in note for note in said[well])
        assert process.state.flying[: lossy + 1].all(), said[lossy]
        process.until(lambda: np.abs(twin.truth()[0][:2, 0] - 0.3).max() < 0.03, "goals")
        assert process.t - process.state.time[well] < 0.5
        battery.charge = 0.02  # without load its voltage has recovered
        process.until(lambda: process.state.note[empty].endswith("; battery low"), "empty battery")
        process.body.takeoff([empty], [0.5])
        process.noted("no take-off: battery low", row=empty)
        process.body.stop(range(6))
        process.until(lambda: not process.state.flying[[well, lossy, blinking, empty]].any(), "motors off")


@pytest.mark.mechanism("Crazyflie bridge: no more setpoints")
@pytest.mark.system
def test_loop_that_stops_commanding():
    """A robot whose loop hangs is landed by its own thread."""
    with connected_twins() as (twin, process):
        process.takeoff(0.3)
        process.lead((0.0, 0.0, 0.3, 0.0)).run(0.2)
        until(lambda: truth(twin)[2] == 0.0, "it was landed")
        assert supervised(twin) != SupervisorState.LOCKED
        assert "no commands from" in process.tick().note[0]
        process.cut()


@pytest.mark.system
def test_reset_in_the_air():
    """A brown-out: nothing lifts it again, and all that was set up is set up again."""
    with connected_twins() as (twin, process):
        process.takeoff(0.4)
        process.lead((0.0, 0.0, 0.4, 0.0)).run(0.3)
        drone = twin.device.drones[0]
        twin.device.drones[0].vehicle.restart()
        drone.start()
        process.until(lambda: not process.state.flying[0], "seen")
        process.decide = None
        process.until(lambda: drone.value("posCtlPid.thrustMin") == 5000 and not process.state.note[0], "set up again")
        assert (truth(twin)[2], motors(twin)) == (0.0, False)
        process.takeoff(0.3)
        process.cut()


@pytest.mark.system
def test_new_link_does_not_move_a_flow_deck():
    """Where it has landed it stays, and is not told again to stand at its start; switched off and on, it is."""
    with connected_twins() as (twin, process):
        process.takeoff(0.3)
        process.lead((0.4, 0.0, 0.3, 0.0))
        process.until(lambda: abs(truth(twin)[0] - 0.4) < 0.02, "goal")
        process.land()
        pilot = process.body.pilots[0]
        link_before = pilot.link
        twin.device.lines[0].silence(1.5)
        process.until(lambda: pilot.link is not link_before and not process.state.note[0], "a new link")
        assert process.state.position[0, 0] == pytest.approx(truth(twin)[0], abs=0.02)
        assert truth(twin)[0] > 0.3
        twin.device.drones[0].vehicle.restart()
        twin.device.drones[0].start()
        process.until(lambda: abs(process.state.position[0, 0]) < 0.02 and not process.state.note[0], "at its start")


FLYING = """
import sys
from tests.bridges.crazyflie_flight import connected

process = connected(sys.argv[1:])
process.takeoff(0.4)
process.lead((0.3, 0.0, 0.4, 0.0)).run(1e9)
"""


@pytest.mark.parametrize("link", ["udp", "radio"])
@pytest.mark.system
def test_process_woken_from_suspension_lifts_no_drone(link):
    """Suspension until the drone has come down: then the loop commands as before, and the drone stays down."""
    asked = request("crazyflie", ["crazyflie-twin"], device={"link": link})
    with Served(CrazyflieTwin, asked) as twin, started("-c", FLYING, *twin.addresses, stderr=None) as child:
        until(lambda: abs(truth(twin)[0] - 0.3) < 0.05, "it follows setpoints")
        os.kill(child.pid, signal.SIGSTOP)
        until(lambda: truth(twin)[2] == 0.0, "its drone has come down")
        assert supervised(twin) == SupervisorState.FLYING
        os.kill(child.pid, signal.SIGCONT)
        heights = []

        def stands():
            heights.append(truth(twin)[2])
            return not motors(twin)

        until(stands, "its motors are stopped")
        assert max(heights) == 0.0
        assert supervised(twin) != SupervisorState.LOCKED


@pytest.mark.system
def test_refused_arming():
    with connected_twins(refuse_arming=True) as (twin, process):
        process.tick()
        process.body.takeoff([0], [0.5])
        process.noted("arming refused")
        process.until(lambda: not process.state.flying[0], "not flying")
        assert truth(twin)[2] == 0.0


@pytest.mark.system
def test_absent():
    """Somebody who never answers, or nobody at the address: said within five seconds, with the remedy."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mute:
        mute.bind(("127.0.0.1", 0))
        address = f"udp://127.0.0.1:{mute.getsockname()[1]}"
        for bound in (True, False):
            if not bound:
                mute.close()
            begin = time.monotonic()
            with pytest.raises(BodyError, match=f"R0: .*{address}: .*is the simulation running there"):
                connected([address])
            assert time.monotonic() - begin < 6.0


@pytest.mark.system
def test_one_of_two_is_absent():
    """The other one is ready; the absent one's note says what is the matter."""
    with (
        Served(CrazyflieTwin, request("crazyflie", ["crazyflie-twin"])) as twin,
        connected([twin.addresses[0], "udp://127.0.0.1:1"]) as process,
    ):
        process.tick()
        assert process.state.note[0] == ""
        assert "udp://127.0.0.1:1" in process.state.note[1]
        assert np.isnan(process.state.position[1]).all()


@pytest.mark.system
@pytest.mark.parametrize(("address", "said"), [(RADIO, "Crazyradio"), ("usb://0", "plugged in")])
def test_nothing_plugged_in(address, said):
    """No dongle and no robot is plugged in here; no traceback either."""
    with pytest.raises(BodyError, match=said):
        connected([address])


# ---------------------------------------------------------------------- before anything is opened


@pytest.mark.parametrize("version", ["0.1.31", "0.1.20.1", "0.0.9"])
def test_library_is_too_old(monkeypatch, version):
    """Process that flies a drone and cannot stop it."""
    monkeypatch.setattr(link, "version", lambda _: version)
    with pytest.raises(BodyError, match=rf"cflib {version} is too old, Crazyflies need 0\.1\.32: pip install"):
        connected([RADIO])


@pytest.mark.parametrize("version", ["0.1.32", "0.1.34", "0.2", "1.0.0rc1"])
def test_library_is_new_enough(monkeypatch, version):
    monkeypatch.setattr(link, "version", lambda _: version)
    link.prepare([RADIO])


def test_library_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "cflib", None)
    monkeypatch.delitem(sys.modules, "cflib.crtp", raising=False)
    with pytest.raises(BodyError, match=r"pip install -e '\.\[crazyflie\]'"):
        connected([RADIO])


@pytest.mark.parametrize(
    ("robots", "exchanges", "device", "said", "rates"),
    [
        (6, 357.0, {}, "", {}),
        (8, 396.0, {}, "ask for 320 packets/s, up and down; it carries 277: ", {"stream_hz": 7.0}),
        (15, 664.0, {}, "ask for 600 packets/s, up and down; it carries 465: ", {"stream_hz": 5.0}),
        (6, 500.0, {"log_hz": 50.0}, "ask for 420 packets/s", {"log_hz": 33.0, "stream_hz": 9.0}),
        (5, 500.0, {"log_hz": 8.0}, "would have poses that are 0.14 s old, at 500 exchanges/s: ", {"log_hz": 12.0}),
        (
            8, 500.0, {"positioning": Outside()}, "ask for 480 packets/s",
            {"log_hz": 16.0, "stream_hz": 6.0, "positioning": Outside(rate_hz=13.0)},
        ),
    ],
)  # fmt: skip
def test_crowded_radio(robots, exchanges, device, said, rates):
    """The rates that are named fit, and leave poses young."""
    text = overload("0", [CrazyflieSettings(**device)] * robots, exchanges)
    if not said:
        assert text == ""
        return
    assert text.startswith(f"radio 0: {robots} robots {said}")
    fitting = [CrazyflieSettings(**device | rates)] * robots
    assert overload("0", fitting, exchanges) == ""
    named = f"log_hz = {fitting[0].log_hz:g}, stream_hz = {fitting[0].stream_hz:g}"
    if "positioning" in rates:
        named += f", positioning.rate_hz = {rates['positioning'].rate_hz:g}"
    assert text.endswith(f": in each device table write {named}, or plug in another radio")


def test_a_radio_with_too_many_robots():
    """Of 60 packets per second and robot, 40 come down, 20 of them nearly empty: at most 70 % of the exchanges."""
    assert [capacity([CrazyflieSettings()] * 5, hz) for hz in (100.0, 600.0)] == pytest.approx([70.0, 420.0])
    text = overload("0", [CrazyflieSettings()] * 15, 400.0)
    assert text.endswith(": plug in another radio; this one carries 10, with log_hz = 20, stream_hz = 4")
