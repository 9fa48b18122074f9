"""The Crazyflie bridge over the unmodified radio driver of cflib: gaps, losses, lost answers, full queues."""

import threading
import time

import numpy as np
import pytest
from cflib.drivers import crazyradio

from bridges.crazyflie import link
from tests.bridges.crazyflie_flight import connected, connected_twins, motors, supervised, truth
from tests.requests import request
from tests.twins.loopback import Served
from twins.devices.crazyflie.device import CrazyflieTwin
from twins.devices.crazyflie.supervisor import SupervisorState

pytestmark = pytest.mark.system

RADIO = {"link": "radio"}
HEIGHT = 0.35
SINKS = 0.5  # [m/s] a landing is slower, a fall from this height six times as fast


@pytest.fixture(autouse=True)
def known_tables(toc_cache):
    if link.KNOWN_TABLES:
        return
    with Served(CrazyflieTwin, request("crazyflie", ["x"])) as twin:  # over UDP a thousand entries are read in no time
        link.prepare(twin.addresses)
        reader = link.CrazyflieLink(twin.addresses[0])
        reader.open(time.monotonic() + 30.0, threading.Event())
        reader.close()


def watched(process, read):
    """What something says at every tick of a process from now on."""
    tick, found = process.tick, []

    def ticked():
        state = tick()
        found.append(read())
        return state

    process.tick = ticked
    return found


def sinking(twin, process):
    """Fastest descents [m/s] from now on, by the twin's own velocities."""
    return watched(process, lambda: max(-drone.vehicle.model.velocity[2] for drone in twin.device.drones))


def hovering(process, rows=1, x=0.0):
    return process.lead(*[(x, float(row), HEIGHT, 0.0) for row in range(rows)])


@pytest.mark.parametrize("loss", [0.0, 0.4])
def test_flight_over_the_radio(loss):
    """Taken off, led to a goal and landed, without a fall at the end: the planner keeps the order to land."""
    with connected_twins(device=RADIO, loss=loss) as (twin, process):
        sinks = sinking(twin, process)
        assert twin.device.lines[0].safelink
        process.takeoff(HEIGHT)
        hovering(process, x=0.2)
        process.until(lambda: abs(truth(twin)[0] - 0.2) < 0.03, "goal")
        assert loss or np.abs(process.state.position - twin.truth()[0]).max() < 0.05
        process.land()
        assert max(sinks) < SINKS
        assert supervised(twin) != SupervisorState.LOCKED
        assert not any(word in process.state.note[0] for word in ("refused", "link lost", "landed"))


@pytest.mark.mechanism("Crazyflie bridge: radio gap")
def test_a_long_gap_lands_that_drone_alone():
    with connected_twins(rows=3, device=RADIO) as (twin, process):
        process.takeoff(HEIGHT)
        sinks = sinking(twin, process)
        hovering(process, rows=3, x=0.2).run(0.2)
        link = process.body.pilots[0].link
        twin.device.lines[0].silence(0.7)
        process.run(0.9)
        assert process.state.flying.all(), "a short gap is flown through"
        twin.device.lines[0].silence(1.2)
        process.until(lambda: not process.state.flying[0], "landed")
        assert process.body.pilots[0].link is link
        assert truth(twin)[2] == pytest.approx(0.0, abs=0.02)
        assert process.state.flying[1:].all()
        assert np.abs(twin.truth()[0][1:] - [[0.2, 1.0, HEIGHT], [0.2, 2.0, HEIGHT]]).max() < 0.05
        assert supervised(twin) != SupervisorState.LOCKED
        process.until(
            lambda: process.t - process.state.time[0] < 0.3, "logs again: the firmware has removed its blocks"
        )
        assert max(sinks) < SINKS
        process.cut()


@pytest.mark.parametrize("begins", ["setpoints", "take-off", "landing"])
def test_nothing_is_received_any_more(begins):
    """Gaps of 2.5 s, 5 s and for ever: down within what lies on board, never a fall, never a hover without command.

    Once the radio is back the motors are stopped, and no packet of before the gap lifts the drone again.
    """
    gaps = (2.5, 5.0, 1e6)
    with connected_twins(rows=3, device=RADIO, exchanges_hz=1000.0) as (twin, process):
        sinks = sinking(twin, process)
        if begins == "take-off":
            process.body.takeoff(range(3), [HEIGHT] * 3)
            process.until(lambda: twin.truth()[0][:, 2].min() > 0.3 * HEIGHT, "climbing")
        else:
            process.takeoff(HEIGHT)
            hovering(process, rows=3, x=0.3).run(0.5)
        if begins == "landing":
            process.body.land(range(3))
            process.until(lambda: twin.truth()[0][:, 2].max() < 0.8 * HEIGHT, "sinking")
        for line, gap in zip(twin.device.lines, gaps, strict=True):
            line.silence(gap)
        begin, heights = process.t, []

        def down():
            heights.append((process.t - begin, *twin.truth()[0][:, 2]))
            return process.t - begin > gaps[1] and not process.state.flying[:2].any() and heights[-1][3] == 0.0

        process.until(down, "all are down")
        t, *z = np.array(heights).T
        for row in range(3):
            assert z[row][t > 3.0].max() < HEIGHT - 0.1, "a hover without command"
            landed = t[np.flatnonzero(z[row] == 0.0)[0]]
            assert z[row][t > landed].max() < 1e-3, "lifted again"
        assert max(sinks) < SINKS
        assert not any(supervised(twin, row) == SupervisorState.LOCKED for row in range(3))
        assert not any(motors(twin, row) for row in range(2))
        assert process.state.flying[2], "nothing is seen of its motors"
        twin.device.lines[2].silence(0.0)
        process.until(lambda: not process.state.flying[2], "in reach again")
        assert not motors(twin, 2)
        assert "connected again" not in process.state.note[2]


def test_setpoints_go_on_beside_external_positions():
    """Two packets in each period, and room for one in the queue of the driver: neither starves the other."""
    with connected_twins(rows=2, device=RADIO, external=True) as (twin, process):
        process.truth = twin.truth
        vehicles = [drone.vehicle for drone in twin.device.drones]
        process.until(lambda: np.isfinite(process.state.position).all(), "settled")
        process.takeoff(HEIGHT)
        hovering(process, rows=2).run(0.5)
        received = [vehicle.estimator.received for vehicle in vehicles]
        ages = watched(process, lambda: max(vehicle.t - vehicle.commander.received for vehicle in vehicles))
        process.run(4.0)
        assert max(ages) < 0.4, "the firmware levels out after 0.5 s"
        assert min(np.subtract([vehicle.estimator.received for vehicle in vehicles], received)) > 30
        process.land()


def test_a_radio_that_becomes_slow_gets_fewer_logs():
    """Fewer exchanges than logs: their rates are halved until poses are young again, and the drone flies on.

    On the ground, over a radio that is fast again, they are restored.
    """
    with connected_twins(device=RADIO) as (twin, process):
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


def test_recovery_from_a_crash_is_asked_for():
    """In another session: safelink is still on from this one, which ends without a word, and the air is gone."""
    with connected_twins(device=RADIO) as (twin, process):
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


def test_a_radio_that_carries_too_little_is_refused():
    device = RADIO | {"log_hz": 50.0, "stream_hz": 100.0, "positioning": {"system": "external", "rate_hz": 100.0}}
    with (
        pytest.raises(RuntimeError, match=r"radio 0: 2 robots ask for 700 packets/s.*write log_hz = .*stream_hz"),
        connected_twins(rows=2, device=device, external=True, exchanges_hz=300.0, measuring_s=0.5),
    ):
        pass
