"""The Crazyflie bridge over the unmodified radio driver of cflib: gaps, losses, lost answers, full queues."""

import threading
import time

import numpy as np
import pytest
from cflib.drivers import crazyradio

from agents.protocols.crtp import Port
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


def watching(process, notice):
    """Call something with each state that a process reads."""
    tick = process.tick

    def ticked():
        state = tick()
        notice(state)
        return state

    process.tick = ticked


class Descent:
    """Fastest descent of each row [m/s], by the twin's own velocities; read at every tick of a process."""

    def __init__(self, twin, process):
        self.fastest, self._drones = np.zeros(len(twin.addresses)), twin.device.drones
        watching(process, self._notice)

    def _notice(self, _state):
        self.fastest = np.maximum(self.fastest, [-drone.vehicle.model.velocity[2] for drone in self._drones])

    def soft(self):
        return self.fastest.max() < SINKS


def hovering(process, rows=1, x=0.0):
    return process.lead(*[(x, float(row), HEIGHT, 0.0) for row in range(rows)])


@pytest.mark.parametrize("loss", [0.0, 0.2, 0.4])
def test_flight_over_the_radio(loss):
    """Taken off, led to a goal and landed, without a fall at the end: the planner keeps the order to land."""
    with connected_twins(device=RADIO, loss=loss) as (twin, process):
        descent = Descent(twin, process)
        assert twin.device.lines[0].safelink
        process.takeoff(HEIGHT)
        hovering(process, x=0.2)
        process.until(lambda: abs(truth(twin)[0] - 0.2) < 0.03, "goal")
        assert loss or np.abs(process.state.position - twin.truth()[0]).max() < 0.05
        process.land()
        assert descent.soft()
        assert supervised(twin) != SupervisorState.LOCKED
        assert not any(word in process.state.note[0] for word in ("refused", "link lost", "landed"))


@pytest.mark.mechanism("Crazyflie bridge: radio gap")
def test_a_long_gap_lands_that_drone_alone():
    with connected_twins(rows=3, device=RADIO) as (twin, process):
        process.takeoff(HEIGHT)
        descent = Descent(twin, process)
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
        assert descent.soft()
        process.cut()


@pytest.mark.parametrize("begins", ["setpoints", "hold", "take-off", "landing"])
def test_nothing_is_received_any_more(begins):
    """Gaps of 2.5 s, 5 s and for ever: down within what lies on board, never a fall, never a hover without command.

    Once the radio is back the motors are stopped, and no packet of before the gap lifts the drone again.
    """
    gaps = (2.5, 5.0, 1e6)
    with connected_twins(rows=3, device=RADIO, exchanges_hz=1000.0) as (twin, process):
        descent = Descent(twin, process)
        if begins == "take-off":
            process.body.takeoff(range(3), [HEIGHT] * 3)
            process.until(lambda: twin.truth()[0][:, 2].min() > 0.3 * HEIGHT, "climbing")
        else:
            process.takeoff(HEIGHT)
            if begins == "setpoints":
                hovering(process, rows=3, x=0.3)
            process.run(0.5)
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
        assert descent.soft()
        assert not any(supervised(twin, row) == SupervisorState.LOCKED for row in range(3))
        assert not any(motors(twin, row) for row in range(2))
        assert process.state.flying[2], "nothing is seen of its motors"
        twin.device.lines[2].silence(0.0)
        process.until(lambda: not process.state.flying[2], "in reach again")
        assert not motors(twin, 2)
        assert "connected again" not in process.state.note[2]


def test_radio_gap_with_motion_capture_ends_in_landing():
    """The estimator is blind, and drifts: it is down before it is far away, and stays there with its motors on."""
    with connected_twins(device=RADIO, external=True) as (twin, process):
        process.truth = twin.truth
        process.until(lambda: np.isfinite(process.state.position).all(), "settled")
        process.takeoff(0.6)
        process.lead((0.0, 0.0, 0.6, 0.0)).run(1.0)
        descent = Descent(twin, process)
        twin.device.lines[0].silence(1e6)
        process.until(lambda: truth(twin)[2] == 0.0, "down")
        process.run(2.0)
        assert np.abs(truth(twin)[:2]).max() < 0.3
        assert motors(twin)
        assert process.state.flying[0], "its motors may be on"
        assert descent.soft()


def test_setpoints_go_on_beside_external_positions():
    """Two packets in each period, and room for one in the queue of the driver: neither starves the other."""
    with connected_twins(rows=2, device=RADIO, external=True) as (twin, process):
        process.truth, ages = twin.truth, []
        vehicles = [drone.vehicle for drone in twin.device.drones]
        process.until(lambda: np.isfinite(process.state.position).all(), "settled")
        process.takeoff(HEIGHT)
        hovering(process, rows=2).run(0.5)
        received = [vehicle.estimator.received for vehicle in vehicles]
        watching(process, lambda _: ages.extend(vehicle.t - vehicle.commander.received for vehicle in vehicles))
        process.run(4.0)
        assert np.max(ages) < 0.4, "the firmware levels out after 0.5 s"
        assert min(np.subtract([vehicle.estimator.received for vehicle in vehicles], received)) > 30
        process.land()


def test_queue_filling_in_the_air_ends_in_landing():
    """Twenty times as many logs as asked for, more than there are polls: answers and the status wait behind them."""
    with connected_twins(device=RADIO, exchanges_hz=300.0) as (twin, process):
        process.takeoff(HEIGHT)
        descent = Descent(twin, process)
        line = twin.device.lines[0]
        send, queue = line.send, line.queue
        line.send = lambda port, channel, data: [
            send(port, channel, data) for _ in range(20 if (port, channel) == (Port.LOG, 2) and len(queue) < 160 else 1)
        ]
        hovering(process)
        process.until(lambda: process.t - process.state.time[0] > 0.5, "old poses")
        assert process.state.flying[0]
        process.land()  # as the robot's loop does then
        process.until(lambda: supervised(twin) in {SupervisorState.LANDED, SupervisorState.READY}, "landed")
        assert descent.soft()


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


@pytest.mark.timeout(120)
def test_a_fleet_on_one_radio(monkeypatch, tmp_path):
    """Connected from a cold cache, taken off, led and landed; no command is refused. `test_simulated` has the ages."""
    monkeypatch.setenv("ZENPARK_CACHE_DIR", str(tmp_path))
    link.KNOWN_TABLES.clear()
    rows = 8
    with connected_twins(rows=rows, device=RADIO | {"stream_hz": 5.0}) as (twin, process):
        assert process.body.exchanges(list(range(rows))) < 60 * 250, "a minute of a slow radio"
        descent, notes = Descent(twin, process), set()
        watching(process, lambda state: notes.update(state.note))
        process.takeoff(HEIGHT)
        hovering(process, rows, x=0.2).run(4.0)
        assert np.abs(twin.truth()[0][:, 0] - 0.2).max() < 0.05
        process.land()
        assert not any("refused" in note or "landed" in note for note in notes), notes
        assert descent.soft()


def test_a_radio_that_carries_too_little_is_refused():
    device = RADIO | {"log_hz": 50.0, "stream_hz": 100.0, "positioning": {"system": "external", "rate_hz": 100.0}}
    with (
        pytest.raises(RuntimeError, match=r"radio 0: 2 robots ask for 700 packets/s.*write log_hz = .*stream_hz"),
        connected_twins(rows=2, device=device, external=True, exchanges_hz=300.0, measuring_s=0.5),
    ):
        pass
