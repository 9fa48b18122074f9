"""The Crazyflie bridge over the real cflib, against protocol twins: what it does is read off the twins' own state."""

import math
import struct
import time
from pathlib import Path

import numpy as np
import pytest

from agents.body.interface import BodyError
from agents.protocols.crtp import MemoryKind
from bridges.crazyflie.body import CrazyflieBody
from tests.bridges.crazyflie_flight import Process, flown, supervised, truth
from tests.requests import request
from twins.devices.crazyflie.supervisor import SupervisorState

pytestmark = pytest.mark.system

STATION = """
    origin: [{x}, 0.5, 2.0]
    rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
"""
SWEEP = "{phase: 0.1, tilt: 0.02, curve: 0.0, gibmag: 0.0, gibphase: 1.0, ogeemag: 0.0, ogeephase: 1.5}"


def lighthouse_file(folder: Path, *numbers: int) -> str:
    lines = ["type: lighthouse_system_configuration", "version: '1'", "systemType: 2", "geos:"]
    lines += [f"  {number}:" + STATION.format(x=number + 0.25) for number in numbers]
    lines.append("calibs:")
    for number in numbers:
        lines += [f"  {number}:", f"    sweeps: [{SWEEP}, {SWEEP}]", f"    uid: {1000 + number}"]
    path = folder / "stations.yaml"
    path.write_text("\n".join(lines))
    return str(path)


def test_flight_and_next_session():
    """Take-off, a goal by streamed positions, landing; and again by another client, which the first must not hinder."""
    begin = time.monotonic()
    with flown() as (twin, process):
        print(f"connected, all parameters read: {time.monotonic() - begin:.2f} s")
        assert time.monotonic() - begin < 5.0
        process.until(lambda: process.body.inspect(0).firmware == "twin", "version of the firmware")
        assert 3.0 < process.body.inspect(0).volts < 4.3
        assert process.body.inspect(0).capacity_hz is None  # no radio carries it
        process.takeoff()
        process.setpoint = [(0.4, 0.3, 0.6, 0.5)]
        process.until(lambda: np.abs(truth(twin) - [0.4, 0.3, 0.6]).max() < 0.02, "goal")
        process.until(lambda: twin.truth()[1][0] == pytest.approx(0.5, abs=0.05), "yaw")
        assert process.state.position[0] == pytest.approx(truth(twin), abs=0.05)
        assert process.state.yaw[0] == pytest.approx(0.5, abs=0.06)
        assert process.t - process.state.time[0] < 0.5
        assert supervised(twin) == SupervisorState.FLYING
        process.land()
        assert truth(twin)[2] == 0.0
        assert not twin.device.flock.quadrotor.flying[0]
        process.body.stop([0])
        process.close()
        assert supervised(twin) != SupervisorState.LOCKED  # an emergency stop of one that stands would lock it
        again = Process(CrazyflieBody(request("crazyflie", twin.addresses)))
        try:
            again.takeoff()
            assert truth(twin)[2] == pytest.approx(0.5, abs=0.06)
        finally:
            again.close()  # in the air: it lands first
        assert truth(twin)[2] == 0.0
        assert supervised(twin) != SupervisorState.LOCKED


def test_a_goal_with_a_yaw():
    """Sent as polynomials, of which only the parts that change are written; the drone turns, and flies on at yaw 0."""
    with flown() as (twin, process):
        process.takeoff(0.3)
        for goal in ((0.3, -0.2, 0.5, 1.2), (0.2, -0.2, 0.4, -2.0), (0.2, 0.0, 0.4, 0.0)):
            process.setpoint = [goal]
            process.until(lambda: np.abs(truth(twin) - goal[:3]).max() < 0.03, "place")  # noqa: B023
            process.until(lambda: math.cos(twin.truth()[1][0] - goal[3]) > 0.999, "yaw")  # noqa: B023
        process.cut()


@pytest.mark.mechanism("Crazyflie bridge: emergency stop")
def test_emergency_stop():
    """Motors off in mid-air; the twin is locked, says so, and refuses to fly again."""
    with flown() as (twin, process):
        process.takeoff()
        process.body.stop([0])
        process.until(lambda: supervised(twin) == SupervisorState.LOCKED, "locked")
        process.until(lambda: truth(twin)[2] == 0.0, "down")
        process.until(lambda: not process.state.flying[0] and "locked" in process.state.note[0], "said so")
        process.until(lambda: process.state.refusal == ("locked: switch it off and on",), "refuses to take off")
        process.body.takeoff([0], [0.5])
        process.until(lambda: "switch it off and on" in process.state.note[0] and not process.state.flying[0], "no")
        assert truth(twin)[2] == 0.0


def test_several_at_a_hundred_hertz():
    """Several Crazyflies, one process, every one logged at 100 Hz."""
    with flown(rows=4, device={"log_hz": 100.0}) as (_, process):
        process.run(0.5)
        last, gaps, stamps = process.state.time.copy(), np.zeros(4), set()
        end = process.t + 1.5
        while process.t < end:
            state = process.tick()
            gaps = np.maximum(gaps, state.time - last)
            last = state.time.copy()
            stamps.add(float(state.time[0]))
        print(f"4 at 100 Hz: {len(stamps) / 1.5:.0f} new poses/s read, worst gap {1e3 * gaps.max():.0f} ms")
        assert len(stamps) > 40
        assert gaps.max() < 3.0


def test_parameters_are_set():
    with flown(device={"parameters": {"hlCommander.vtoff": 0.7, "stabilizer.controller": 2}}) as (twin, _):
        assert twin.device.drones[0].value("posCtlPid.thrustMin") == 5000
        assert twin.device.drones[0].value("hlCommander.vtoff") == pytest.approx(0.7)
        assert twin.device.drones[0].value("stabilizer.controller") == 2


@pytest.mark.parametrize(
    ("device", "said"),
    [
        ({"parameters": {"no.such": 1.0}}, "no parameter no.such"),
        ({"parameters": {"deck.bcLoco": 1.0}}, "read-only"),
        ({"parameters": {"senseless": 1.0}}, "senseless"),
        ({"positioning": {"system": "loco"}}, "no anchor knows its position"),
        (
            {"positioning": {"system": "lighthouse"}, "converge_s": 1.2},
            r"not settled after 1.2 s: misses geometry or calibration",
        ),
        ({"positioning": {"system": "lighthouse", "file": "/nowhere.yaml"}}, "/nowhere.yaml: No such file"),
    ],
)
def test_what_cannot_be_set_up(device, said):
    with pytest.raises(BodyError, match=said), flown(device=device):
        pass


def test_missing_deck():
    with (
        pytest.raises(BodyError, match="no Loco positioning deck"),
        flown(device={"positioning": {"system": "loco"}}, serve={"parameters": {}}),
    ):
        pass


def test_missing_multiranger():
    """Without the deck all ranges are 0: an obstacle everywhere."""
    with (
        pytest.raises(BodyError, match="no Multi-ranger deck"),
        flown(device={"multiranger": True}, serve={"multiranger": False}),
    ):
        pass


def test_lighthouse(tmp_path):
    """Geometry and calibration arrive, are stored, and only then does the estimate settle."""
    device = {"positioning": {"system": "lighthouse", "file": lighthouse_file(tmp_path, 0, 1)}}
    with flown(device=device) as (twin, process):
        memories = twin.device.flock.decks.memories[0]
        assert (memories.geometries, memories.calibrations) == (0b11, 0b11)
        assert memories.stored == (0b1111, 0b1111)
        assert struct.unpack("<fff", memories.read(MemoryKind.LIGHTHOUSE, 0x100, 12)) == pytest.approx((1.25, 0.5, 2.0))
        assert twin.device.drones[0].value("stabilizer.estimator") == 2
        assert twin.device.flock.estimator.variance[0] < 1e-2
        process.until(lambda: process.state.note[0] == "", "nothing to say")
        process.close()
        memories.stored = (0, 0)
        again = Process(CrazyflieBody(request("crazyflie", twin.addresses, device=device)))
        again.close()
        assert memories.stored == (0, 0), "the same geometry is not written again: that wears the flash memory"
        other = device["positioning"] | {"file": lighthouse_file(tmp_path, 0, 1, 2)}
        again = Process(CrazyflieBody(request("crazyflie", twin.addresses, device={"positioning": other})))
        again.close()
        assert memories.stored == (0b1111, 0b1111)


def test_flow_deck_begins_at_the_start():
    """Without positioning from outside the estimator is told where the robot stands, and is not left at (0, 0)."""
    start = [[0.7, -0.4, 0.0]]
    with flown(start=start) as (twin, process):
        assert [twin.device.drones[0].value(f"kalman.initial{axis}") for axis in "XYZ"] == pytest.approx(start[0])
        process.until(lambda: np.abs(process.state.position - start).max() < 0.05, "there")


def test_loco():
    """Anchors are told where they are, and say so; the mode is set; the estimate settles."""
    anchors = [[-2.0, -2.0, 0.0], [2.0, -2.0, 2.5], [2.0, 2.0, 0.0], [-2.0, 2.0, 2.5]]
    device = {"positioning": {"system": "loco", "mode": "tdoa3", "anchors": anchors}}
    with flown(device=device) as (twin, _):
        known = twin.device.flock.decks.memories[0].anchors()
        assert {number: list(place) for number, place in known.items()} == dict(enumerate(anchors))
        assert twin.device.drones[0].value("loco.mode") == 3
        assert twin.device.drones[0].value("stabilizer.estimator") == 2
        assert twin.device.flock.estimator.variance[0] < 1e-2


def test_external_position():
    """It does not fly before it was told where it is, and knows it; then it flies the estimate that comes of that."""
    device = {"positioning": {"system": "external", "position_sigma": 0.02}}
    with flown(device=device, external=True, start=[[0.5, 0.2, 0.0]]) as (twin, process):
        process.run(0.2)
        assert np.isnan(process.state.position[0]).all()
        assert "no position from outside" in process.state.note[0]
        process.body.takeoff([0], [0.5])
        process.until(lambda: "position estimate has not settled" in process.state.note[0], "refusal")
        assert not process.state.flying[0]
        process.located_as = twin
        process.until(lambda: np.isfinite(process.state.position[0]).all(), "settled")
        assert twin.device.drones[0].value("locSrv.extPosStdDev") == pytest.approx(0.02)
        assert twin.device.flock.estimator.received[0] > 10
        process.takeoff(0.3)
        process.setpoint = [(0.3, 0.1, 0.4, 0.0)]
        process.until(lambda: np.abs(truth(twin) - [0.3, 0.1, 0.4]).max() < 0.03, "goal")
        process.cut()


def test_arming():
    """A platform that must be armed is."""
    with flown(device={"platform": "brushless"}) as (twin, process):
        assert supervised(twin) == SupervisorState.DISARMED
        process.takeoff(0.2)
        assert supervised(twin) == SupervisorState.FLYING
        process.cut()


def test_end_during_arming():
    """A process that ends while a take-off is prepared leaves nothing armed."""
    with flown(device={"platform": "brushless"}) as (twin, process):
        process.tick()
        process.body.takeoff([0], [0.5])
        process.until(lambda: supervised(twin) == SupervisorState.ARMING, "arming")
        process.close()
        assert supervised(twin) == SupervisorState.DISARMED
        assert truth(twin)[2] == 0.0


@pytest.mark.parametrize(("order", "after_s"), [("stop", 0.3), ("land", 0.1)])
def test_order_during_arming(order, after_s):
    """It replaces the take-off: the motors stay off, and nothing stays armed."""
    with flown(device={"platform": "brushless"}) as (twin, process):
        row = [0]
        process.tick()
        process.body.takeoff(row, [0.5])
        process.until(lambda: supervised(twin) == SupervisorState.ARMING, "arming")
        process.run(after_s)
        getattr(process.body, order)(row)
        process.until(lambda: supervised(twin) == SupervisorState.DISARMED, "disarmed")
        process.run(1.0)
        assert supervised(twin) == SupervisorState.DISARMED
        assert truth(twin)[2] == 0.0
        process.takeoff(0.2)
        process.cut()


def test_another_session_finds_it_in_the_air():
    """A process that was killed has left it there: it is landed, then set up, and nothing says that it flies."""
    with flown() as (twin, process):
        process.takeoff(0.4)
        process.setpoint = [(0.0, 0.0, 0.4, 0.0)]
        process.run(0.2)
        pilot = process.body.pilots[0]
        pilot._end_by = 0.0  # it ends without a landing
        pilot._ending.set()
        pilot._thread.join()
        process.body._claims.release()
        again = Process(CrazyflieBody(request("crazyflie", twin.addresses)))
        try:
            assert again.tick().note == ("",)
            assert not again.state.flying[0]
            assert truth(twin)[2] == 0.0
            assert supervised(twin) != SupervisorState.LOCKED
            assert twin.device.drones[0].value("posCtlPid.thrustMin") == 5000
        finally:
            again.close()


def test_ranges():
    """Distances to the walls of the twin's room, as a scan."""
    device = {"multiranger": True, "ranges_hz": 20.0}
    with flown(device=device, start=[[0.5, 0.0, 0.0]]) as (_, process):
        process.until(lambda: process.state.scan[0] is not None, "scan")
        scan = process.state.scan[0]
        assert scan.distance == pytest.approx([1.5, 2.5, 2.0, 2.0, 2.5], abs=2e-3)
        assert scan.bearing == pytest.approx(np.radians([0.0, 180.0, 90.0, -90.0, 0.0]))
        assert scan.elevation[4] == pytest.approx(np.pi / 2)
