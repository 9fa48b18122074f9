"""Crazyflies on one radio, on a simulated clock: ages of poses, gaps and other clients; none falls.

Real are the flight control and telemetry of the bridge, and the twins with their queues; the driver of cflib is
replaced by what it does: it polls its drones in turn, and has room for one packet of each.
"""

import math
import random
import struct
import threading
from collections import deque
from itertools import product

import numpy as np
import pytest

from agents.decision.lifecycle import AIRBORNE, RUNNING, Lifecycle
from agents.safety.detection import Ascent
from agents.safety.motion_check import MotionCheck
from agents.safety.setpoint_filter import OUTSIDE_M
from agents.ticks import Ticks
from agents.vectors import ZERO
from bridges.crazyflie import trajectory
from bridges.crazyflie.flight import DESCENT, FALLEN, FlightControl, FlightPhase
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.crazyflie.link import BUSY_S
from bridges.crazyflie.pilot import LOGS_S, LOOP_HZ, SAFE_PARAMETERS
from bridges.crazyflie.protocol import crtp
from bridges.crazyflie.protocol.addresses import YOUNG_S, CrazyflieSettings, Outside, chosen, oldest_pose, overload
from bridges.crazyflie.protocol.crtp import HighLevel, Log, Port, Setpoint
from bridges.crazyflie.protocol.tables import LOG_CODES, PACKINGS
from bridges.crazyflie.telemetry import Telemetry
from bridges.crazyflie.twin.device import CrazyflieTwin
from bridges.crazyflie.twin.supervisor import SupervisorState
from experiments.real_time.hosts.launcher import LAND_S
from tests.bridges.crazyflie.flights import clocked
from tests.cases import nightly
from tests.requests import request
from tests.waiting import ManualClock
from twins.device import DeviceRequest, Faults

pytestmark = pytest.mark.slow
CODES = {"int16_t": "i16", "uint16_t": "u16", "uint8_t": "u8", "int8_t": "i8", "FP16": "half"}
TICK = 0.01  # [s] of the twins, and of the robots' loop
ROOM_S = 0.0005  # between two looks whether the driver has room
HEIGHT = 0.35
SINKS = 0.5  # [m/s] a landing that is not disturbed is slower


class Thread:
    """Thread that runs only while `step` waits for it; `due`: when it is to be called next [s]."""

    def __init__(self, due, body):
        self.due, self._ending = due, False
        self._go, self._back = threading.Semaphore(0), threading.Semaphore(0)
        self._thread = threading.Thread(target=self._run, args=(body,))
        self._thread.start()

    def _run(self, body):
        self._go.acquire()
        try:
            if not self._ending:
                body()
        except SystemExit:
            pass
        finally:
            self._back.release()

    def pause(self, until):
        """From within: wait until a time [s]."""
        self.due = until
        self._back.release()
        self._go.acquire()
        if self._ending:
            raise SystemExit

    def step(self):
        self._go.release()
        self._back.acquire()

    def close(self):
        self._ending = True
        self._go.release()
        self._thread.join()


class Drone:
    """Crazyflie, its telemetry and flight control, and the packets that wait for the radio."""

    def __init__(self, fleet, row):
        self._fleet, self.row = fleet, row
        self.out, self.order, self._blocks, self._replies = deque(), None, {}, {}
        self.telemetry = Telemetry(lighthouse=False)
        self.telemetry.settled = True
        self.flight = FlightControl(
            fleet.settings, self.telemetry, lambda seconds: self.thread.pause(fleet.now + seconds)
        )
        self.transmit = self._send_at_once
        self.trajectories = trajectory.TrajectoryMemory(lambda *packet: self.transmit(*packet))  # noqa: PLW0108
        self.trajectories.stops = self.flight.outside
        self.trajectories.memory = fleet.twin.drones[row].memories.kinds.index(crtp.MemoryKind.TRAJECTORY)
        self.trajectories.define()
        self.telemetry.start_logging(self, log_hz=fleet.settings.log_hz, ranges_hz=None)
        fleet.twin.lines[row].queue.clear()  # answers
        self.transmit = self._send
        self.flight.link = self
        self.error, self._received, self._gap = None, fleet.now, 0.0
        self.cf = self.commander = self.high_level_commander = self
        self.thread = Thread(fleet.now + fleet.random.random() / LOOP_HZ, self._control)

    def start_log(self, _name, rate_hz, variables, logged):
        table, number = self._fleet.twin.drones[self.row].log_table, len(self._blocks)
        kinds = [CODES[kind] for kind in variables.values()]
        codes = [LOG_CODES[kind] for kind in kinds]
        items = [crtp.ITEM.pack(code, table.number[name]) for code, name in zip(codes, variables, strict=True)]
        self._send_at_once(Port.LOG, 1, bytes((Log.CREATE, number)) + b"".join(items))
        self._send_at_once(Port.LOG, 1, bytes((Log.START, number, round(100.0 / rate_hz))))
        self._blocks[number] = list(variables), [PACKINGS[kind] for kind in kinds], logged

    @property
    def busy(self):
        return self._fleet.now - self._received > BUSY_S

    def planner_reply(self, command):
        return self._replies.get(command, (0, 0))

    def send_notify_setpoint_stop(self):
        self._send(Port.SETPOINT, 1, bytes(5))

    def land(self, height, span, **_yaw):
        self._send(Port.HIGH_LEVEL, 0, bytes((HighLevel.LAND, 0)) + crtp.CLIMB.pack(height, 0.0, True, span))

    def receive(self, packet):
        port, channel, data = packet[0] >> 4, packet[0] & 3, packet[1:]
        self._gap = max(self._gap, self._fleet.now - self._received)
        self._received = self._fleet.now
        if (port, channel) == (Port.LOG, 2):
            names, packings, logged = self._blocks[data[0]]
            values, at = {}, 4
            for name, packing in zip(names, packings, strict=True):
                (values[name],) = packing.unpack_from(data, at)
                at += packing.size
            logged(self._fleet.now, int.from_bytes(data[1:4], "little"), values)
        elif port == Port.HIGH_LEVEL:
            self._replies[data[0]] = self.planner_reply(data[0])[0] + 1, data[3]
        elif port == Port.MEMORY:
            self.trajectories.note_answer(crtp.MEMORY.unpack_from(data)[1], data[crtp.MEMORY.size])
            self.thread.due = self._fleet.now

    def _send_at_once(self, port, channel, data):
        self._fleet.twin.deliver(self.row, bytes((crtp.header(port, channel),)) + data)

    def _send(self, port, channel, data):
        while self.out:
            self.thread.pause(self._fleet.now + ROOM_S)
        self.out.append(bytes((crtp.header(port, channel),)) + data)

    def _mend_gap(self):
        gap, self._gap = self._gap, 0.0
        if gap > LOGS_S:
            self._blocks.clear()
            self.telemetry.start_logging(self, log_hz=self._fleet.settings.log_hz, ranges_hz=None)
        self.flight.land_after_gap(gap)

    def _control(self):
        """Loop of the pilot's thread."""
        fleet = self._fleet
        ticks = Ticks(max(fleet.settings.stream_hz, LOOP_HZ), clock=fleet.monotonic)
        while True:
            if fleet.now >= ticks.zero + ticks.next:
                ticks.begin()
            self._mend_gap()
            order, self.order = self.order, None
            if order is not None:
                order(self.flight)
            self.flight.update_phase(fleet.now)
            self.flight.send_due(fleet.now)
            ticks.until_next()
            self.thread.pause(ticks.zero + ticks.next)


class Fleet(ManualClock):
    """Crazyflies on a radio with `hz` exchanges per second; closed at the end of a `with` statement.

    Those with `external` positions get them, as far as the radio carries and motion capture `sees` them.
    """

    def __init__(self, monkeypatch, rows, hz, *, external=False, accelerometer_mg=0.0, **device):
        super().__init__(100.0)
        self.hz, self.random = hz, random.Random(rows)
        clocked(monkeypatch, self)
        asked = request("crazyflie", ["crazyflie-twin"] * rows, device={"link": "radio"} | device, external=external)
        self.settings, self.sees = chosen("", device, external=external), external
        faults = Faults(accelerometer_mg=accelerometer_mg)
        self.twin = CrazyflieTwin(DeviceRequest(body=asked, faults=faults))
        self.vehicles = [drone.vehicle for drone in self.twin.drones]
        for vehicle in self.vehicles:
            vehicle.estimator.reset(ZERO, 0.0)  # set up
            vehicle.vertical.least = SAFE_PARAMETERS["posCtlPid.thrustMin"]
        self.drones = [Drone(self, row) for row in range(rows)]
        self.ages = []  # (k, rows) ages of poses [s]
        self.fastest = self.touch = 0.0  # fastest descent, and fastest near the floor [m/s]
        self._begin = self._next_tick = self._next_exchange = self.now
        for line in self.twin.lines:
            line.heard = 0.0
        self._exchanges = 0
        self.client = lambda: None  # another client; called before each tick of the twins

    def __enter__(self):
        return self

    def __exit__(self, *_error):
        for drone in self.drones:
            drone.thread.close()
        self.twin.close()

    def run(self, seconds, *, speed=0.0):
        """Fly for some seconds; with a `speed` [m/s] each drone is led around a circle of 0.3 m."""
        end = self.now + seconds
        while self.now < end:
            thread = min((drone.thread for drone in self.drones), key=lambda each: each.due)
            self.now = max(self.now, min(self._next_tick, self._next_exchange, thread.due))
            if self.now >= self._next_tick:
                self._next_tick += TICK
                self._advance(speed)
            elif self.now >= self._next_exchange:
                self._next_exchange += 1.0 / self.hz
                self._exchange(self._exchanges % len(self.drones))
                self._exchanges += 1
            else:
                thread.due = math.inf
                thread.step()
        return self

    def order(self, what):
        """Give an order, a function of a `FlightControl`, to all."""
        for drone in self.drones:
            drone.order = what

    def climb(self, height, above=0.0):
        """Take off to a height [m], and fly until all are above another."""
        self.run(1.0)
        self.order(lambda flight: flight.takeoff(height))
        while self.heights.min() < above:
            self.run(0.02)
        return self

    @property
    def heights(self):
        return self.twin.truth()[0][:, 2]

    @property
    def phases(self):
        return {drone.flight.phase for drone in self.drones}

    @property
    def troubles(self):
        return {drone.flight.trouble for drone in self.drones} - {""}

    @property
    def supervised(self):
        """State of the first drone's supervisor."""
        return self.vehicles[0].supervisor.state

    def landed(self):
        """Fly on until the motors of the first drone are off: whether it was on the floor then, and never fast."""
        while self.vehicles[0].model.flying:
            self.run(0.02)
        return self.heights[0] < 0.02 and self.soft

    @property
    def soft(self):
        """Whether no descent was a fall."""
        return self.fastest < 0.55 and self.touch < 0.4

    def _advance(self, speed):
        """Step of the twins; then the robots' loop reads and commands."""
        self.client()
        self.twin.advance(self.now - self._begin)
        if self.sees:
            self._locate()
        self.ages.append(self.now - np.array([drone.telemetry.pose_time for drone in self.drones]))
        sinks = -np.array([vehicle.model.velocity[2] for vehicle in self.vehicles])
        self.fastest = max(self.fastest, sinks.max())
        self.touch = max(self.touch, sinks[self.heights < 0.05].max(initial=0.0))
        for row, drone in enumerate(self.drones):
            angle = speed / 0.3 * self.now + row
            target = (0.3 * math.cos(angle), row + 0.3 * math.sin(angle), HEIGHT, 0.0)
            drone.flight.set_target(self.now, target if speed > 0.0 else None)

    def _locate(self):
        """Motion capture, 20 times a second."""
        for line, vehicle, drone in zip(self.twin.lines, self.vehicles, self.drones, strict=True):
            drone.flight.note_external(vehicle.place[2], math.nan, 0.0)
            if not line.silent(line.t) and round(vehicle.t / TICK) % 5 == 0:
                vehicle.locate(vehicle.place, Outside().position_sigma)

    def _exchange(self, row):
        line, drone = self.twin.lines[row], self.drones[row]
        line.t = self.now - self._begin
        _, answer, packet = line.exchange(drone.out[0] if drone.out else b"\xff", 3)
        if not answer:
            return  # the driver repeats the packet
        if drone.out:
            drone.out.popleft()
        if packet is not None:
            self.twin.deliver(row, packet)
        drone.receive(answer)


@pytest.fixture
def fleet(monkeypatch):
    with Fleet(monkeypatch, 1, 500.0) as flown:
        yield flown


@pytest.fixture
def circling(fleet):
    """In the air, on a circle."""
    fleet.climb(0.5, 0.45)
    return fleet.run(1.0, speed=0.3)


@pytest.mark.parametrize(
    ("rows", "exchanges", "rates", "yaw"),
    [
        nightly(1, 400.0, {}, 0.0),
        (4, 400.0, {}, 0.0),
        nightly(8, 400.0, {"stream_hz": 7.0}, 0.0),
        nightly(15, 664.0, {"stream_hz": 5.0}, 0.0),
        nightly(5, 250.0, {"stream_hz": 7.0}, 0.0),
        nightly(8, 400.0, {"stream_hz": 4.0}, 0.5),  # seventeen parts of polynomials for a take-off, one at a time
    ],
)
def test_rates_that_a_radio_carries_leave_poses_young(monkeypatch, rows, exchanges, rates, yaw):
    """Take off, follow a circle at 0.3 m/s, land."""
    settings = [CrazyflieSettings(**rates)] * rows
    assert overload("0", settings, exchanges) == ""
    with Fleet(monkeypatch, rows, exchanges, **rates) as fleet:
        for vehicle in fleet.vehicles:
            vehicle.model.yaw = yaw
        fleet.run(1.0)
        fleet.ages.clear()
        fleet.order(lambda flight: flight.takeoff(HEIGHT))
        fleet.run(3.0)
        assert fleet.phases == {FlightPhase.CLIMBING}, fleet.troubles
        fleet.run(4.0, speed=0.3)
        assert fleet.phases == {FlightPhase.FLYING}, fleet.troubles
        fleet.order(FlightControl.land)
        fleet.run(6.0)
        assert fleet.phases == {FlightPhase.GROUND}
        assert not fleet.troubles
        assert fleet.fastest < SINKS
    age = np.percentile(fleet.ages, 99)
    print(f"{rows} robots, {exchanges:g} exchanges/s: 99 % of poses are younger than {1e3 * age:.0f} ms")
    assert age < oldest_pose(settings, exchanges) <= YOUNG_S


def test_gaps_after_the_take_off(monkeypatch):
    """Of the file: the first is flown through, the second ends in a landing."""
    with Fleet(monkeypatch, 2, 400.0, gaps=[[4.0, 1.2], [2.0, 0.5]]) as fleet:
        fleet.climb(HEIGHT)
        gaps = []
        for _ in range(700):
            fleet.run(0.01, speed=0.1)
            gaps.append([fleet.now - line.heard - 100.0 for line in fleet.twin.lines])
        assert np.max(gaps[:400], axis=0) == pytest.approx(0.5, abs=0.02)
        assert np.max(gaps, axis=0) == pytest.approx(1.2, abs=0.02)


@pytest.mark.parametrize(("height", "soon"), [(0.5, 3.0), (2.0, 9.0), nightly(4.0, LAND_S - 1.0)])
def test_ready_at_height_in_spite_of_the_overshoot(fleet, height, soon):
    """Followed by lifecycle and detectors as in a robot's process, for 12 s at its height."""
    lifecycle, setpoint = Lifecycle(CRAZYFLIE, height, 100.0), (0.0, 0.0, height, 0.0)
    ascent, motion_check = Ascent(CRAZYFLIE, height, outside=False), MotionCheck(CRAZYFLIE)
    (vehicle,) = fleet.vehicles

    def advance(t, *, ready=False):
        position, velocity = vehicle.place, vehicle.velocity
        flying, yaw = vehicle.model.flying, vehicle.model.yaw
        lifecycle.advance(t, position, velocity, flying=flying, ready=ready)
        ascent.update(t, lifecycle.climbing, flying, position)
        motion_check.update(t, setpoint, position, yaw, not lifecycle.climbing)
        assert not any((ascent.carried, ascent.stalled, motion_check.unresponsive, motion_check.uncommanded))
        return t

    advance(0.0, ready=True)
    assert lifecycle.takeoff() == ""
    lifecycle.takeoff_due = False
    fleet.climb(height)
    begin, highest, t = fleet.now, 0.0, 0.0
    while lifecycle.phase != AIRBORNE:
        t = advance(fleet.run(TICK).now - begin)
        assert t < soon
    assert lifecycle.start(t + 1.0) == ""
    while fleet.now - begin < t + 12.0:
        advance(fleet.run(TICK).now - begin)
        highest = max(highest, float(fleet.heights[0]))
    assert lifecycle.phase == RUNNING
    assert not fleet.troubles
    assert height < highest < (1.0 + CRAZYFLIE.overshoot) * height
    assert highest < height + OUTSIDE_M  # it does not count as having left an arena that ends above its height


@pytest.mark.parametrize(
    ("hover", "gap", "begin", "speed"),
    [(2.0, 2.0, 0.43, 0.3), nightly(2.0, 2.5, 1.0, 0.3), (1.2, 2.5, 0.3, 0.0), (0.8, 1.0, 0.03, 0.3)],
)
def test_gap_in_the_climb(fleet, hover, gap, begin, speed):
    """The climb goes on, and the landing begins at its end; also when setpoints have begun, and were not received."""
    fleet.climb(hover, begin)
    fleet.twin.lines[0].silence(gap)
    fleet.run(gap, speed=speed)
    assert fleet.landed()
    assert fleet.supervised != SupervisorState.CRASHED


def streamed(height):
    """A setpoint of another client, see `Setpoint.POSITION`."""
    return bytes((Port.SETPOINT << 4, Setpoint.POSITION)) + struct.pack("<4f", 0.0, 0.0, height, 0.0)


@pytest.mark.parametrize("stays_s", [0.0, 5.0])
def test_flight_by_another_client_is_landed(fleet, stays_s):
    """The process leaves at once, or after it has ended the landing repeatedly."""
    fleet.client = lambda: fleet.twin.deliver(0, streamed(0.8))
    while fleet.phases != {FlightPhase.LANDING}:
        fleet.run(0.02)
    fleet.run(stays_s)
    assert ("another client" in fleet.drones[0].flight.muted) == (stays_s > 0.0)
    fleet.client = lambda: None
    fleet.run(0.8 / DESCENT + 5.0)
    assert fleet.phases == {FlightPhase.GROUND}
    assert fleet.soft
    assert (fleet.troubles, fleet.drones[0].flight.muted) == ({"landed: it flew without an order"}, "")
    assert fleet.supervised != SupervisorState.LOCKED


ZERO_THRUST = bytes((Port.COMMANDER << 4,)) + struct.pack("<fffH", 0.0, 0.0, 0.0, 0)  # as its library closes a link
END_OF_PLAN = bytes((Port.HIGH_LEVEL << 4, HighLevel.STOP, 0))


@pytest.mark.parametrize("packet", [streamed(0.5), ZERO_THRUST, END_OF_PLAN])
def test_another_client_in_flight_is_ended(circling, packet):
    """A client's setpoint mutes the planner, and the drone would lock 2 s later; or it cuts the motors. It flies on."""
    circling.run(2.0, speed=0.3)
    circling.twin.deliver(0, packet)
    assert min(circling.run(0.05, speed=0.3).heights[0] for _ in range(80)) > HEIGHT - 0.2
    assert (circling.heights[0], circling.phases) == (pytest.approx(HEIGHT, abs=0.03), {FlightPhase.FLYING})
    assert circling.supervised == SupervisorState.FLYING


@pytest.mark.parametrize("gap", [2.5, 5.0, math.inf])
def test_nothing_is_received_any_more(circling, gap):
    """Down within what lies on board, never a fall or a hover without command, and never lifted again."""
    circling.twin.lines[0].silence(gap)
    heights = np.array([circling.run(0.05, speed=0.3).heights[0] for _ in range(180)])
    assert heights[60:].max() < HEIGHT - 0.1
    assert heights[np.argmax(heights < 1e-3) :].max() < 0.02
    assert circling.soft
    assert circling.supervised != SupervisorState.LOCKED
    assert circling.vehicles[0].model.flying == (gap == math.inf), "nobody can stop its motors"


def test_short_gaps_one_after_the_other(circling):
    """Gaps are flown through, with a moment between two that is enough for one setpoint."""
    for gap, between in ((0.7, 0.1), (0.5, 0.05), (0.3, 0.02)):
        for _ in range(5):
            circling.twin.lines[0].silence(gap)
            assert circling.run(gap + between, speed=0.3).heights[0] > HEIGHT - 0.1
    assert circling.phases == {FlightPhase.FLYING}


def with_errors(name, one, other):
    """A value of each kind with one height [m] and wrong accelerometer [mg]; all pairs of them nightly."""
    daily = ((0.8, -4.0), one), ((1.5, 4.0), other)
    rest = [(error, value) for error in product((0.8, 1.5), (-4.0, 4.0)) for value in (one, other)]
    rows = [*daily, *(nightly(*row) for row in rest if row not in daily)]
    return pytest.mark.parametrize(("measured", name), rows, indirect=["measured"])


@pytest.fixture
def measured(request, monkeypatch):
    """On its way up to a height [m] by positions from outside, with an accelerometer that is wrong [mg]."""
    height, error = request.param
    with Fleet(monkeypatch, 1, 500.0, external=True, accelerometer_mg=error) as flown:
        yield flown.climb(height, 0.1)


def hover(fleet):
    """At the end of the climb."""
    fleet.run(6.0)
    assert fleet.phases == {FlightPhase.CLIMBING}, fleet.troubles


def came_down(fleet, seconds):
    """Fly on for some seconds: never cut above 0.3 m, on the floor below 1.3 m/s, and never up again."""
    fleet.touch, heights, cut = 0.0, [], 0.0
    for _ in range(round(seconds / 0.05)):
        heights.append(fleet.run(0.05).heights[0])
        cut = max(cut, 0.0 if fleet.vehicles[0].model.flying else heights[-1])
    down = next((k for k, height in enumerate(heights) if height < 1e-3), len(heights))
    return (cut < 0.3, fleet.touch < 1.3, max(heights[down:], default=math.inf) < 0.02) == (True, True, True)


@with_errors("climbs", False, True)
def test_blind_drone_without_radio_stops_its_motors(measured, climbs):
    """Its accelerometer would lift it again from the floor; locked, it does not."""
    if not climbs:
        hover(measured)
    measured.twin.lines[0].silence(math.inf)
    assert came_down(measured, 20.0)
    assert measured.supervised == SupervisorState.LOCKED
    measured.drones[0].flight.mark_out_of_reach()
    assert measured.troubles == {"out of reach: approach it only when its motors stand"}


@with_errors("in_landing", False, True)
def test_blind_landing_ends_on_the_floor(measured, in_landing):
    hover(measured)
    if in_landing:
        measured.order(FlightControl.land)
        measured.run(0.3)
    measured.sees = False
    measured.run(0.8)
    measured.order(FlightControl.land)
    assert came_down(measured, 12.0)
    assert measured.phases == {FlightPhase.GROUND}
    assert measured.troubles == {FALLEN}
    assert measured.supervised != SupervisorState.LOCKED


@with_errors("gap", 1.5, math.inf)
def test_measured_landing_is_led_down(measured, gap):
    """Softly; where the radio is lost on the way the descent on board goes on."""
    hover(measured)
    measured.order(FlightControl.land)
    measured.run(0.5)
    measured.twin.lines[0].silence(gap)
    assert came_down(measured, 14.0)
    assert measured.touch < (1.3 if gap == math.inf else 0.7)
    assert measured.phases == {FlightPhase.LANDING if gap == math.inf else FlightPhase.GROUND}
    assert (measured.supervised == SupervisorState.LOCKED) == (gap == math.inf)
