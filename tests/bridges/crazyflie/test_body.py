"""The Crazyflie bridge over the real cflib and its driver, against twins: what it does is read off the twins."""

import socket
import struct
import sys
import threading
import time

import numpy as np
import pytest
import yaml
from cflib.drivers import crazyradio

from agents.body.interface import BodyError
from bridges.crazyflie import link
from bridges.crazyflie.protocol.addresses import CrazyflieSettings, Outside, capacity, overload
from bridges.crazyflie.protocol.crtp import MemoryKind
from bridges.crazyflie.twin.device import CrazyflieTwin
from bridges.crazyflie.twin.supervisor import SupervisorState
from tests.bridges.crazyflie.flights import connected, connected_twins, motors, supervised, truth
from tests.requests import request
from tests.twins.loopback import Served
from tests.waiting import until
from twins.device import Faults

RADIO = "radio://0/80/2M/E7E7E7E701"
DONGLE = {"link": "radio"}
HEIGHT = 0.35
LIGHTHOUSE = {"system": "lighthouse"}
SWEEP = {"phase": 0.1, "tilt": 0.02, "curve": 0.0, "gibmag": 0.0, "gibphase": 1.0, "ogeemag": 0.0, "ogeephase": 1.5}
TURN = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


@pytest.mark.system
def test_flight_and_next_session():
    """Take-off, a goal by streamed positions, landing; and again by another client, which the first must not hinder."""
    with connected_twins() as (twin, process):
        process.until(lambda: process.body.inspect(0).firmware == "twin", "version of the firmware")
        assert 3.0 < process.body.inspect(0).volts < 4.3
        assert process.body.inspect(0).capacity_hz is None  # no radio carries it
        process.takeoff()
        process.lead((0.4, 0.3, 0.6, 0.5))
        process.until(lambda: np.abs(truth(twin) - [0.4, 0.3, 0.6]).max() < 0.02, "goal")
        process.until(lambda: twin.truth()[1][0] == pytest.approx(0.5, abs=0.05), "yaw")
        assert process.state.position[0] == pytest.approx(truth(twin), abs=0.05)
        assert process.state.yaw[0] == pytest.approx(0.5, abs=0.06)
        assert process.t - process.state.time[0] < 0.5
        assert supervised(twin) == SupervisorState.FLYING
        process.land()
        assert (truth(twin)[2], motors(twin)) == (0.0, False)
        process.body.stop([0])
        process.close()
        assert supervised(twin) != SupervisorState.LOCKED  # an emergency stop of one that stands would lock it
        with connected(twin.addresses) as again:
            again.takeoff()
            assert truth(twin)[2] == pytest.approx(0.5, abs=0.06)  # closed in the air: it lands first
        assert truth(twin)[2] == 0.0
        assert supervised(twin) != SupervisorState.LOCKED


@pytest.mark.mechanism("Crazyflie bridge: emergency stop")
@pytest.mark.system
def test_emergency_stop():
    """Motors off in mid-air; the twin is locked, says so, and refuses to fly again."""
    with connected_twins() as (twin, process):
        process.takeoff()
        process.body.stop([0])
        process.until(lambda: supervised(twin) == SupervisorState.LOCKED, "locked")
        process.until(lambda: truth(twin)[2] == 0.0, "down")
        process.until(lambda: not process.state.flying[0] and "locked" in process.state.note[0], "said so")
        process.until(lambda: process.state.refusal == ("locked: switch it off and on",), "refuses to take off")
        process.body.takeoff([0], [0.5])
        process.until(lambda: "switch it off and on" in process.state.note[0] and not process.state.flying[0], "no")
        assert truth(twin)[2] == 0.0


@pytest.mark.system
@pytest.mark.parametrize(
    ("device", "serve", "said"),
    [
        ({"parameters": {"no.such": 1.0}}, None, "no parameter no.such"),
        ({"parameters": {"deck.bcLoco": 1.0}}, None, "read-only"),
        ({"parameters": {"senseless": 1.0}}, None, "senseless"),
        ({"positioning": {"system": "loco"}}, None, "no anchor knows its position"),
        ({"positioning": {"system": "loco"}}, {"parameters": {}}, "no Loco positioning deck"),
        ({"positioning": LIGHTHOUSE, "converge_s": 1.2}, None, "not settled after 1.2 s: misses geometry or calibrat"),
        ({"positioning": LIGHTHOUSE | {"file": "/nowhere.yaml"}}, None, "/nowhere.yaml: No such file"),
        # without the deck all ranges are 0: an obstacle everywhere
        ({"multiranger": True}, {"multiranger": False}, "no Multi-ranger deck"),
    ],
)
def test_what_cannot_be_set_up(device, serve, said):
    with pytest.raises(BodyError, match=said), connected_twins(device=device, serve=serve):
        pass


@pytest.mark.system
def test_settings_arrive():
    """Without positioning from outside the estimator is told where the robot stands, and is not left at (0, 0)."""
    parameters = {"hlCommander.vtoff": 0.7, "stabilizer.controller": 2, "supervisor.tmblChckEn": 0}
    device = {"parameters": parameters, "unprotected": ["supervisor.tmblChckEn"], "multiranger": True}
    with connected_twins(device=device, start=[[0.5, 0.0, 0.0]]) as (twin, process):
        value = twin.device.drones[0].value
        assert (value("posCtlPid.thrustMin"), value("stabilizer.controller")) == (5000, 2)
        assert value("supervisor.tmblChckEn") == 0
        assert value("hlCommander.vtoff") == pytest.approx(0.7)
        assert [value(f"kalman.initial{axis}") for axis in "XYZ"] == [0.5, 0.0, 0.0]
        process.until(lambda: np.abs(process.state.position - [0.5, 0.0, 0.0]).max() < 0.05, "there")
        process.until(lambda: process.state.scan[0] is not None, "scan")
        scan = process.state.scan[0]
        assert scan.distance == pytest.approx([1.5, 2.5, 2.0, 2.0, 2.5], abs=2e-3)  # of the twin's room
        assert scan.bearing == pytest.approx(np.radians([0.0, 180.0, 90.0, -90.0, 0.0]))
        assert scan.elevation[4] == pytest.approx(np.pi / 2)


@pytest.mark.system
def test_lighthouse(tmp_path):
    """Geometry and calibration arrive, are stored, and only then does the estimate settle."""

    def device(*numbers):
        stations = {number: {"origin": [number + 0.25, 0.5, 2.0], "rotation": TURN} for number in numbers}
        calibrations = {number: {"sweeps": [SWEEP, SWEEP], "uid": 1000 + number} for number in numbers}
        kind = {"type": "lighthouse_system_configuration", "version": "1", "systemType": 2}
        path = tmp_path / "stations.yaml"
        path.write_text(yaml.safe_dump(kind | {"geos": stations, "calibs": calibrations}))
        return {"positioning": LIGHTHOUSE | {"file": str(path)}}

    with connected_twins(device=device(0, 1)) as (twin, process):
        memories = twin.device.drones[0].vehicle.decks.memories
        assert (memories.geometries, memories.calibrations) == (0b11, 0b11)
        assert memories.stored == (0b1111, 0b1111)
        assert struct.unpack("<fff", memories.read(MemoryKind.LIGHTHOUSE, 0x100, 12)) == pytest.approx((1.25, 0.5, 2.0))
        assert twin.device.drones[0].value("stabilizer.estimator") == 2
        assert twin.device.drones[0].vehicle.estimator.variance < 1e-2
        process.until(lambda: process.state.note[0] == "", "nothing to say")
        process.close()
        memories.stored = (0, 0)
        connected(twin.addresses, device=device(0, 1)).close()
        assert memories.stored == (0, 0), "the same geometry is not written again: that wears the flash memory"
        with connected(twin.addresses, device=device(0, 1, 2)) as again:
            assert memories.stored == (0b1111, 0b1111)
            memories.clear_stations()
            again.until(lambda: again.t - again.state.time[0] > 0.6, "a pose that is not measured is old")
            assert again.t - again.state.received[0] < 0.5


@pytest.mark.system
def test_loco():
    """Anchors are told where they are, and say so; the mode is set; the estimate settles."""
    anchors = [[-2.0, -2.0, 0.0], [2.0, -2.0, 2.5], [2.0, 2.0, 0.0], [-2.0, 2.0, 2.5]]
    device = {"positioning": {"system": "loco", "mode": "tdoa3", "anchors": anchors}}
    with connected_twins(device=device) as (twin, _):
        known = twin.device.drones[0].vehicle.decks.memories.anchors()
        assert {number: list(place) for number, place in known.items()} == dict(enumerate(anchors))
        value = twin.device.drones[0].value
        assert (value("loco.mode"), value("stabilizer.estimator")) == (3, 2)
        assert twin.device.drones[0].vehicle.estimator.variance < 1e-2


@pytest.mark.system
def test_external_position():
    """A drone takes off only when its estimator has taken over an external position; then it flies that estimate."""
    device = {"positioning": {"system": "external", "position_sigma": 0.02}}
    with connected_twins(device=device, external=True, start=[[0.5, 0.2, 0.0]]) as (twin, process):
        process.run(0.2)
        assert np.isnan(process.state.position[0]).all()
        assert "no position from outside" in process.state.note[0]
        process.body.takeoff([0], [0.5])
        process.noted("position estimate has not settled")
        assert not process.state.flying[0]
        process.truth = twin.truth
        process.until(lambda: np.isfinite(process.state.position[0]).all(), "settled")
        assert twin.device.drones[0].value("locSrv.extPosStdDev") == pytest.approx(0.02)
        assert twin.device.drones[0].vehicle.estimator.received > 10
        process.takeoff(0.3)
        process.lead((0.3, 0.1, 0.4, 0.0))
        process.until(lambda: np.abs(truth(twin) - [0.3, 0.1, 0.4]).max() < 0.03, "goal")
        process.cut()


@pytest.mark.system
def test_closing_during_arming_disarms():
    """Motors stay off; `test_order_while_arming_disarms` has the other orders."""
    with connected_twins(device={"platform": "brushless"}) as (twin, process):
        process.tick()
        assert supervised(twin) == SupervisorState.DISARMED
        process.body.takeoff([0], [0.5])
        process.until(lambda: supervised(twin) == SupervisorState.ARMING, "arming")
        process.close()
        assert (supervised(twin), truth(twin)[2]) == (SupervisorState.DISARMED, 0.0)


@pytest.mark.system
def test_faulty_drones_fail_differently_while_others_fly_on():
    """In one process: one is well, one loses 5 % of all packets; one falls silent for good, one for a moment, one's
    battery runs empty, and one is killed. Those in reach end on the ground with their motors off; the others count
    as flying, because nothing is seen of their motors.
    """
    well, lossy, mute, blinking, empty, killed = range(6)
    with (
        Served(CrazyflieTwin, request("crazyflie", ["crazyflie-twin"] * 5)) as twin,
        Served(CrazyflieTwin, request("crazyflie", ["crazyflie-twin"], start=[[0.0, 5.0, 0.0]])) as other,
        connected([*twin.addresses, *other.addresses]) as process,
    ):
        lines, battery = twin.device.lines, twin.device.drones[empty].vehicle.battery
        process.until(lambda: np.isfinite(process.state.position).all(), "all are connected")
        lines[lossy].faults = Faults(loss=0.05)  # not before: 402 parameters take long without repetitions
        process.takeoff(0.3)
        process.lead(*[(0.3, float(row), 0.3, 0.0) for row in range(6)]).run(0.3)
        lines[mute].faults = Faults(silent_from_s=0.0)
        lines[blinking].faults = Faults(silent_from_s=lines[blinking].t, silent_for_s=1.2)
        battery.charge = 0.05
        other.kill()
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
        assert process.t - process.state.received[mute] > 0.5  # the robot's loop sees that its device is silent
        assert not any("landed" in note or "link lost" in note for note in said[well])
        assert process.state.flying[: lossy + 1].all(), said[lossy]
        process.until(lambda: np.abs(twin.truth()[0][:2, 0] - 0.3).max() < 0.03, "goals")
        process.until(lambda: process.t - process.state.time[well] < 0.5, "the one that is well is heard")
        battery.charge = 0.02  # without load its voltage has recovered
        process.until(lambda: process.state.note[empty].endswith("; battery low"), "empty battery")
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
        drone.vehicle.restart()
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


@pytest.fixture
def known_tables(toc_cache):
    """Over UDP a thousand entries are read in no time."""
    if not link.KNOWN_TABLES:
        with Served(CrazyflieTwin, request("crazyflie", ["x"])) as twin:
            link.prepare(twin.addresses)
            reader = link.CrazyflieLink(twin.addresses[0])
            reader.open(time.monotonic() + 30.0, threading.Event())
            reader.close()


def hovering(process, rows=1, x=0.0):
    return process.lead(*[(x, float(row), HEIGHT, 0.0) for row in range(rows)])


@pytest.mark.mechanism("Crazyflie bridge: radio gap")
@pytest.mark.system
@pytest.mark.usefixtures("known_tables")
def test_a_long_gap_lands_that_drone_alone():
    with connected_twins(rows=3, device=DONGLE) as (twin, process):
        process.takeoff(HEIGHT)
        hovering(process, rows=3, x=0.2).run(0.2)
        before = process.body.pilots[0].link
        twin.device.lines[0].silence(0.7)
        process.run(0.9)
        assert process.state.flying.all(), "a short gap is flown through"
        twin.device.lines[0].silence(1.2)
        vehicle, sinks = twin.device.drones[0].vehicle, []
        process.until(lambda: sinks.append(-vehicle.model.velocity[2]) or not process.state.flying[0], "landed")
        assert process.body.pilots[0].link is before
        assert truth(twin)[2] == pytest.approx(0.0, abs=0.02)
        assert process.state.flying[1:].all()
        assert np.abs(twin.truth()[0][1:] - [[0.2, 1.0, HEIGHT], [0.2, 2.0, HEIGHT]]).max() < 0.05
        assert supervised(twin) != SupervisorState.LOCKED
        assert max(sinks) < 0.5  # [m/s] a fall from this height is six times as fast
        process.until(lambda: process.t - process.state.time[0] < 0.3, "logs again: the firmware removed its blocks")
        process.cut()


@pytest.mark.system
@pytest.mark.usefixtures("known_tables")
def test_radio_gap_with_motion_capture_ends_in_stop():
    """The estimator is blind, and drifts: it is down before it is far away, and its motors stop for good."""
    with connected_twins(device=DONGLE, external=True) as (twin, process):
        process.truth, sinks = twin.truth, []
        process.until(lambda: np.isfinite(process.state.position).all(), "settled")
        process.takeoff(0.6)
        process.lead((0.0, 0.0, 0.6, 0.0)).run(1.0)
        twin.device.lines[0].silence(1e6)
        vehicle = twin.device.drones[0].vehicle
        process.until(lambda: sinks.append(-vehicle.model.velocity[2]) or truth(twin)[2] == 0.0, "down")
        assert np.abs(truth(twin)).max() < 0.3
        assert max(sinks) < 0.8
        process.until(lambda: supervised(twin) == SupervisorState.LOCKED, "locked")
        process.noted("approach it only when its motors stand")
        assert (truth(twin)[2], motors(twin), process.state.flying[0]) == (0.0, False, True)


def external(process, twin):
    """In the air by positions from outside."""
    process.truth = twin.truth
    process.until(lambda: np.isfinite(process.state.position).all(), "settled")
    process.takeoff(0.6)
    return process.lead((0.3, 0.0, 0.6, 0.0)).run(1.0)


@pytest.mark.system
@pytest.mark.parametrize("late", [0.2, 0.3])
def test_late_positions_are_not_used(late):
    """They would make the estimator ring: it is landed without them."""
    with connected_twins(external=True) as (twin, process):
        external(process, twin)
        process.truth, locate = twin.captured(capture="late", capture_by=late), process.body.locate
        process.body.locate = lambda row, t, *pose: locate(row, t - late, *pose)
        process.noted("landed: its positions from outside are older than 0.15 s")
        process.until(lambda: not process.state.flying[0], "landed")
        assert np.abs(truth(twin)).max() < 0.8
        assert truth(twin)[2] == 0.0
        process.until(lambda: "older than" in process.state.refusal[0], "no take-off")
        assert "it may have fallen" in process.state.note[0]


@pytest.mark.system
def test_far_estimate_is_reset_after_a_gap():
    """Before the first position, which would turn the drone over."""
    with connected_twins(external=True) as (twin, process):
        external(process, twin)
        vehicle = twin.device.drones[0].vehicle
        process.truth = None
        process.run(0.7)
        with twin.lock:
            vehicle.estimator.error = (0.0, 0.0, -2.0)
        process.run(0.2)
        process.truth = twin.truth
        process.until(lambda: abs(vehicle.estimator.error[2]) < 0.3, "reset")
        assert supervised(twin) == SupervisorState.FLYING
        process.land()
        assert supervised(twin) != SupervisorState.CRASHED


@pytest.mark.system
@pytest.mark.usefixtures("known_tables")
def test_setpoints_go_on_beside_external_positions():
    """Two packets in each period, and room for one in the queue of the driver: neither starves the other."""
    with connected_twins(rows=2, device=DONGLE, external=True) as (twin, process):
        process.truth = twin.truth
        vehicles = [drone.vehicle for drone in twin.device.drones]
        process.until(lambda: np.isfinite(process.state.position).all(), "settled")
        process.takeoff(HEIGHT)
        hovering(process, rows=2).run(0.5)
        received = [vehicle.estimator.received for vehicle in vehicles]
        ages, end = [], process.t + 4.0
        while process.t < end:
            process.tick()
            ages += [each.t - each.commander.received for each in vehicles]
        assert max(ages) < 0.4, "the firmware levels out after 0.5 s"
        assert min(np.subtract([vehicle.estimator.received for vehicle in vehicles], received)) > 30
        process.land()


@pytest.mark.system
@pytest.mark.usefixtures("known_tables")
def test_a_radio_that_becomes_slow_gets_fewer_logs():
    """Fewer exchanges than logs: their rates are halved until poses are young again, and the drone flies on.

    On the ground, over a radio that is fast again, they are restored.
    """
    with connected_twins(device=DONGLE) as (twin, process):
        process.takeoff(HEIGHT)
        hovering(process).run(0.2)
        (dongle,) = crazyradio._find_devices()
        dongle.air = dongle.air._replace(hz=22.0)
        process.noted("fewer logs")
        process.until(lambda: process.t - process.state.time[0] < 0.3, "young poses")
        dongle.air = dongle.air._replace(hz=500.0)
        assert "fewer logs" in process.state.note[0]
        process.land()
        assert supervised(twin) != SupervisorState.LOCKED
        process.until(lambda: "fewer logs" not in process.state.note[0], "the rates that were chosen")
        assert process.body.pilots[0].link.blocks["state"].period == 5


@pytest.mark.system
@pytest.mark.usefixtures("known_tables")
def test_recovery_from_a_crash_is_asked_for():
    """In another session: safelink is still on from this one, which ends without a word, and the air is gone."""
    with connected_twins(device=DONGLE) as (twin, process):
        twin.device.drones[0].vehicle.supervisor.state = SupervisorState.CRASHED
        process.noted("crashed: put it upright")
        process.body.takeoff([0], [HEIGHT])
        process.until(lambda: "no take-off: crashed" in process.state.note[0] and not process.state.flying[0], "no")
        assert supervised(twin) == SupervisorState.CRASHED
        process.close()
        assert twin.device.lines[0].safelink
        twin.device.lines[0].silence(0.5)
        with connected(twin.addresses, device={"recover": True}) as again:
            again.takeoff(HEIGHT)
            again.cut()


@pytest.mark.system
@pytest.mark.usefixtures("known_tables")
def test_a_radio_that_carries_too_little_is_refused():
    device = DONGLE | {"log_hz": 50.0, "stream_hz": 100.0, "positioning": {"system": "external", "rate_hz": 100.0}}
    with (
        pytest.raises(RuntimeError, match=r"radio 0: 2 robots ask for 700 packets/s.*write log_hz = .*stream_hz"),
        connected_twins(rows=2, device=device, external=True, exchanges_hz=300.0, measuring_s=0.5),
    ):
        pass


@pytest.mark.system
def test_absent():
    """Nobody at the address is said within five seconds, with the remedy; one of two that answers is ready."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mute,
        Served(CrazyflieTwin, request("crazyflie", ["crazyflie-twin"])) as twin,
    ):
        mute.bind(("127.0.0.1", 0))
        address = f"udp://127.0.0.1:{mute.getsockname()[1]}"
        begin = time.monotonic()
        with pytest.raises(BodyError, match=f"R0: .*{address}: .*is the simulation running there"):
            connected([address])
        assert time.monotonic() - begin < 6.0
        with connected([twin.addresses[0], "udp://127.0.0.1:1"]) as process:
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


def test_library_is_too_old(monkeypatch):
    """Process that flies a drone and cannot stop it."""
    for version in ("0.1.32", "0.1.34", "0.2", "1.0.0rc1"):
        monkeypatch.setattr(link, "version", lambda _, version=version: version)
        link.prepare([RADIO])
    for version in ("0.1.31", "0.1.20.1", "0.0.9"):
        monkeypatch.setattr(link, "version", lambda _, version=version: version)
        with pytest.raises(BodyError, match=rf"cflib {version} is too old, Crazyflies need 0\.1\.32: pip install"):
            connected([RADIO])


def test_library_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "cflib", None)
    monkeypatch.delitem(sys.modules, "cflib.crtp", raising=False)
    with pytest.raises(BodyError, match=r"pip install -e '\.\[crazyflie\]'"):
        connected([RADIO])


@pytest.mark.parametrize(
    ("robots", "exchanges", "device", "said", "rates"),
    [
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
    assert overload("0", [CrazyflieSettings()] * 6, 357.0) == ""
    text = overload("0", [CrazyflieSettings()] * 15, 400.0)
    assert text.endswith(": plug in another radio; this one carries 10, with log_hz = 20, stream_hz = 4")


@pytest.mark.system
def test_computer_that_slept_lands_its_drone(monkeypatch):
    """The drone has sunk to the floor meanwhile: the next setpoint would lift it."""
    slept, clock = [0.0], time.clock_gettime
    monkeypatch.setattr(time, "clock_gettime", lambda which: clock(which) + slept[0] * (which == time.CLOCK_BOOTTIME))
    with connected_twins(device=DONGLE) as (twin, process):
        process.takeoff(HEIGHT)
        slept[0] = 2.0
        process.noted("landed: nothing received for 2.0 s")
        process.until(lambda: not motors(twin), "motors off")
