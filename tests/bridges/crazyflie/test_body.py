"""The Crazyflie bridge over the real cflib, against protocol twins: what it does is read off the twins' own state."""

import math
import struct
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from agents.body.interface import BodyError
from agents.protocols.crtp import MemoryKind
from tests.bridges.crazyflie_flight import connected, connected_twins, motors, supervised, truth
from twins.devices.crazyflie.supervisor import SupervisorState

pytestmark = pytest.mark.system

SWEEP = {"phase": 0.1, "tilt": 0.02, "curve": 0.0, "gibmag": 0.0, "gibphase": 1.0, "ogeemag": 0.0, "ogeephase": 1.5}
TURN = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
BRUSHLESS = {"platform": "brushless"}


def lighthouse_file(folder: Path, *numbers: int) -> str:
    stations = {number: {"origin": [number + 0.25, 0.5, 2.0], "rotation": TURN} for number in numbers}
    calibrations = {number: {"sweeps": [SWEEP, SWEEP], "uid": 1000 + number} for number in numbers}
    kind = {"type": "lighthouse_system_configuration", "version": "1", "systemType": 2}
    path = folder / "stations.yaml"
    path.write_text(yaml.safe_dump(kind | {"geos": stations, "calibs": calibrations}))
    return str(path)


def test_flight_and_next_session():
    """Take-off, a goal by streamed positions, landing; and again by another client, which the first must not hinder."""
    begin = time.monotonic()
    with connected_twins() as (twin, process):
        assert time.monotonic() - begin < 5.0
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


def test_a_goal_with_a_yaw():
    """Sent as polynomials, of which only the parts that change are written; the drone turns, and flies on at yaw 0."""
    with connected_twins() as (twin, process):
        process.takeoff(0.3)
        for goal in ((0.3, -0.2, 0.5, 1.2), (0.2, -0.2, 0.4, -2.0), (0.2, 0.0, 0.4, 0.0)):
            process.lead(goal)
            process.until(lambda: np.abs(truth(twin) - goal[:3]).max() < 0.03, "place")  # noqa: B023
            process.until(lambda: math.cos(twin.truth()[1][0] - goal[3]) > 0.999, "yaw")  # noqa: B023
        process.cut()


@pytest.mark.mechanism("Crazyflie bridge: emergency stop")
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


def test_parameters_are_set():
    with connected_twins(device={"parameters": {"hlCommander.vtoff": 0.7, "stabilizer.controller": 2}}) as (twin, _):
        value = twin.device.drones[0].value
        assert (value("posCtlPid.thrustMin"), value("stabilizer.controller")) == (5000, 2)
        assert value("hlCommander.vtoff") == pytest.approx(0.7)


LIGHTHOUSE = {"system": "lighthouse"}


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


def test_lighthouse(tmp_path):
    """Geometry and calibration arrive, are stored, and only then does the estimate settle."""

    def device(*stations):
        return {"positioning": LIGHTHOUSE | {"file": lighthouse_file(tmp_path, *stations)}}

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
        connected(twin.addresses, device=device(0, 1, 2)).close()
        assert memories.stored == (0b1111, 0b1111)


def test_flow_deck_begins_at_the_start():
    """Without positioning from outside the estimator is told where the robot stands, and is not left at (0, 0)."""
    start = [[0.7, -0.4, 0.0]]
    with connected_twins(start=start) as (twin, process):
        assert [twin.device.drones[0].value(f"kalman.initial{axis}") for axis in "XYZ"] == pytest.approx(start[0])
        process.until(lambda: np.abs(process.state.position - start).max() < 0.05, "there")


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


@pytest.mark.parametrize(("order", "after_s"), [("stop", 0.3), ("land", 0.1), ("close", 0.0)])
def test_order_during_arming(order, after_s):
    """The order replaces the take-off: motors stay off and disarmed; afterwards the drone arms and flies."""
    with connected_twins(device=BRUSHLESS) as (twin, process):
        process.tick()
        assert supervised(twin) == SupervisorState.DISARMED
        process.body.takeoff([0], [0.5])
        process.until(lambda: supervised(twin) == SupervisorState.ARMING, "arming")
        if order == "close":
            process.close()
        else:
            process.run(after_s)
            getattr(process.body, order)([0])
            process.until(lambda: supervised(twin) == SupervisorState.DISARMED, "disarmed")
            process.run(1.0)
        assert (supervised(twin), truth(twin)[2]) == (SupervisorState.DISARMED, 0.0)
        if order != "close":
            process.takeoff(0.2)
            assert supervised(twin) == SupervisorState.FLYING
            process.cut()


def test_another_session_finds_it_in_the_air():
    """A process that was killed has left it there: it is landed, then set up, and nothing says that it flies."""
    with connected_twins() as (twin, process):
        process.takeoff(0.4)
        process.lead((0.0, 0.0, 0.4, 0.0)).run(0.2)
        process.body.close(land=False)
        with connected(twin.addresses) as again:
            assert again.tick().note == ("",)
            assert not again.state.flying[0]
            assert truth(twin)[2] == 0.0
            assert supervised(twin) != SupervisorState.LOCKED
            assert twin.device.drones[0].value("posCtlPid.thrustMin") == 5000


def test_ranges():
    """Distances to the walls of the twin's room, as a scan."""
    with connected_twins(device={"multiranger": True, "ranges_hz": 20.0}, start=[[0.5, 0.0, 0.0]]) as (_, process):
        process.until(lambda: process.state.scan[0] is not None, "scan")
        scan = process.state.scan[0]
        assert scan.distance == pytest.approx([1.5, 2.5, 2.0, 2.0, 2.5], abs=2e-3)
        assert scan.bearing == pytest.approx(np.radians([0.0, 180.0, 90.0, -90.0, 0.0]))
        assert scan.elevation[4] == pytest.approx(np.pi / 2)
