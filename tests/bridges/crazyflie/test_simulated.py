"""Crazyflies and their bridge on a simulated clock, with twins: ages of poses, gaps and other clients; none falls."""

import struct

import numpy as np
import pytest

from agents.decision.lifecycle import AIRBORNE, RUNNING, Lifecycle
from agents.kinds.crazyflie import CRAZYFLIE
from agents.protocols.crazyflie import YOUNG_S, CrazyflieSettings, oldest_pose, overload
from agents.protocols.crtp import HighLevel, Port, Setpoint
from agents.safety.detection import Ascent
from agents.safety.motion_check import MotionCheck
from agents.safety.setpoint_filter import OUTSIDE_M
from bridges.crazyflie.flight import DESCENT, FlightControl, FlightPhase
from experiments.real_time.conductor.hot_changes import CLIMB_S
from tests.bridges.crazyflie_clock import HEIGHT, TICK, Fleet, flight_of
from twins.devices.crazyflie.supervisor import SupervisorState

pytestmark = pytest.mark.slow
SINKS = 0.5  # [m/s] a landing that is not disturbed is slower


def nightly(*values):
    return pytest.param(*values, marks=pytest.mark.nightly)


@pytest.fixture
def fleet(monkeypatch):
    with Fleet(monkeypatch, 1, 500.0) as flown:
        yield flown


@pytest.mark.parametrize(
    ("rows", "exchanges", "rates"),
    [
        nightly(1, 400.0, {}),
        (4, 400.0, {}),
        nightly(8, 400.0, {"stream_hz": 7.0}),
        nightly(15, 664.0, {"stream_hz": 5.0}),
        nightly(5, 250.0, {"stream_hz": 7.0}),
    ],
)
def test_rates_that_a_radio_carries_leave_poses_young(monkeypatch, rows, exchanges, rates):
    settings = [CrazyflieSettings(**rates)] * rows
    assert overload("0", settings, exchanges) == ""
    with Fleet(monkeypatch, rows, exchanges, **rates) as fleet:
        age = np.percentile(flight_of(fleet), 99)
        assert fleet.fastest < SINKS
    print(f"{rows} robots, {exchanges:g} exchanges/s: 99 % of poses are younger than {1e3 * age:.0f} ms")
    assert age < oldest_pose(settings, exchanges) <= YOUNG_S


def test_take_off_with_yaw_leaves_poses_young(monkeypatch):
    """Seventeen parts of polynomials, one at a time: in a burst their answers made poses 0.2 s old."""
    with Fleet(monkeypatch, 8, 400.0, stream_hz=4.0) as fleet:
        for vehicle in fleet.vehicles:
            vehicle.model.yaw = 0.5
        assert np.percentile(flight_of(fleet), 99) < YOUNG_S


def test_full_queue_ages_poses_and_prevents_take_off(monkeypatch):
    """More logs than polls: the drone says so by its stamps, long before a packet is lost."""
    with Fleet(monkeypatch, 1, 90.0, log_hz=100.0) as fleet:
        (line,) = fleet.twin.lines
        while len(line.queue) < 150:
            fleet.run(0.1)
        assert fleet.ages[-1][0] == pytest.approx(len(line.queue) / 100.0, rel=0.05)
        fleet.order(lambda flight: flight.takeoff(HEIGHT))
        fleet.run(0.5)
        (trouble,) = fleet.troubles
        assert "s old; is its radio too full" in trouble
        assert fleet.phases == {FlightPhase.GROUND}
        assert line.dropped == 0
        assert not fleet.vehicles[0].model.flying


def test_gaps_after_the_take_off(monkeypatch):
    """Of the file: the first is flown through, the second ends in a landing."""
    with Fleet(monkeypatch, 2, 400.0, gaps=[[4.0, 1.2], [2.0, 0.5]]) as fleet:
        fleet.run(1.0)
        fleet.order(lambda flight: flight.takeoff(HEIGHT))
        gaps = []
        for _ in range(700):
            fleet.run(0.01, speed=0.1)
            gaps.append([fleet.now - line.heard - 100.0 for line in fleet.twin.lines])
        assert np.max(gaps[:400], axis=0) == pytest.approx(0.5, abs=0.02)
        assert np.max(gaps, axis=0) == pytest.approx(1.2, abs=0.02)


@pytest.mark.parametrize(
    ("height", "soon"), [(0.5, 3.0), (2.0, 9.0), nightly(0.8, 3.5), nightly(1.0, 4.5), nightly(4.0, CLIMB_S - 1.0)]
)
def test_ready_at_height_in_spite_of_the_overshoot(fleet, height, soon):
    """Followed by lifecycle and detectors as in a robot's process, for 12 s at its height."""
    lifecycle, setpoint = Lifecycle(CRAZYFLIE, height, 100.0), (0.0, 0.0, height, 0.0)
    ascent, motion_check = Ascent(CRAZYFLIE, height), MotionCheck(CRAZYFLIE)
    (vehicle,) = fleet.vehicles

    def advance(t, *, ready=False):
        position, velocity = vehicle.place, vehicle.velocity
        flying, yaw = vehicle.model.flying, vehicle.model.yaw
        lifecycle.advance(t, position, velocity, flying=flying, ready=ready)
        ascent.update(t, lifecycle.climbing, flying, position)
        motion_check.update(t, setpoint, position, yaw, not lifecycle.climbing)

    advance(0.0, ready=True)
    assert lifecycle.takeoff() == ""
    lifecycle.takeoff_due = False
    fleet.climb(height)
    begin, since, highest = fleet.now, None, 0.0
    while since is None or fleet.now < since + 12.0:
        fleet.run(TICK)
        t = fleet.now - begin
        advance(t)
        if since is None and lifecycle.phase == AIRBORNE:
            assert lifecycle.start(t + 1.0) == ""
            since = fleet.now
        assert not any((ascent.carried, ascent.stalled, motion_check.unresponsive, motion_check.uncommanded))
        assert t < soon or since is not None
        highest = max(highest, float(fleet.heights[0]))
    assert lifecycle.phase == RUNNING
    assert not fleet.troubles
    assert height < highest < (1.0 + CRAZYFLIE.overshoot) * height
    assert highest < height + OUTSIDE_M  # it does not count as having left an arena that ends above its height


# ---------------------------------------------------------------------- the worst moments


class Client:
    """Another client of the drone: streams a height, see `Setpoint.POSITION`."""

    def __init__(self, fleet, height):
        self._fleet, self.height = fleet, height
        fleet.client = self

    def __call__(self):
        if self.height is not None:
            setpoint = struct.pack("<4f", 0.0, 0.0, self.height, 0.0)
            self._fleet.twin.deliver(0, bytes((Port.SETPOINT << 4, Setpoint.POSITION)) + setpoint)

    def leave(self):
        self.height = None


@pytest.mark.parametrize(
    ("hover", "gap", "begin", "speed"),
    [
        (2.0, 2.0, 0.43, 0.3),
        nightly(2.0, 2.0, 0.43, 0.0),
        nightly(2.0, 2.5, 1.0, 0.0),
        nightly(2.0, 2.5, 1.0, 0.3),
        (1.2, 2.5, 0.3, 0.0),
        nightly(1.2, 2.5, 0.3, 0.3),
        (0.8, 1.0, 0.03, 0.3),
        nightly(0.8, 1.0, 0.03, 0.0),
    ],
)
def test_gap_in_the_climb(fleet, hover, gap, begin, speed):
    """The climb goes on, and the landing begins at its end; also when setpoints have begun, and were not received."""
    fleet.climb(hover, begin)
    fleet.twin.lines[0].silence(gap)
    fleet.run(gap, speed=speed)
    assert fleet.landed()
    assert fleet.supervised != SupervisorState.CRASHED


@pytest.mark.parametrize("stays_s", [0.0, nightly(2.0), 5.0])
def test_flight_by_another_client_is_landed(fleet, stays_s):
    """The process leaves at once, or after it has ended the landing repeatedly."""
    client = Client(fleet, 0.8)
    while fleet.phases != {FlightPhase.LANDING}:
        fleet.run(0.02)
    fleet.run(stays_s)
    client.leave()
    fleet.run(0.8 / DESCENT + 5.0)
    assert fleet.phases == {FlightPhase.GROUND}
    assert fleet.soft
    assert fleet.troubles == {"landed: it flew without an order"}
    assert fleet.supervised != SupervisorState.LOCKED


@pytest.fixture
def circling(fleet):
    """In the air, on a circle."""
    fleet.climb(0.5, 0.45)
    return fleet.run(1.0, speed=0.3)


def test_another_client_in_flight_is_ended(circling):
    """A client's setpoint mutes the planner, and the drone would lock 2 s later: it flies on."""
    client = Client(circling, 0.5)
    circling.run(0.02, speed=0.3)
    client.leave()
    circling.run(4.0, speed=0.3)
    assert circling.phases == {FlightPhase.FLYING}
    assert circling.supervised == SupervisorState.FLYING
    assert circling.heights[0] > 0.3


def test_another_client_cuts_the_motors(circling):
    """By a setpoint of zero thrust, as its library sends when it closes a link; or by ending the plan. It flies on."""
    circling.run(2.0, speed=0.3)
    zero = bytes((Port.COMMANDER << 4,)) + struct.pack("<fffH", 0.0, 0.0, 0.0, 0)
    for packet in (zero, bytes((Port.HIGH_LEVEL << 4, HighLevel.STOP, 0))):
        circling.twin.deliver(0, packet)
        lowest = min(circling.run(0.05, speed=0.3).heights[0] for _ in range(60))
        assert lowest > HEIGHT - 0.2
        assert circling.heights[0] == pytest.approx(HEIGHT, abs=0.03)
    assert circling.supervised == SupervisorState.FLYING


@pytest.mark.parametrize("how", [nightly("refused"), "unanswered"])
def test_memory_that_takes_no_setpoint(circling, how):
    """The drone descends by itself, and would stand with its motors on: it is landed. The radio is not flooded."""
    drone, twin, written = circling.twin.drones[0], circling.twin, []
    send, deliver = drone.send, twin.deliver
    if how == "refused":
        drone.memories.write = lambda *_: False
    else:
        drone.send = lambda port, *rest: None if port == Port.MEMORY else send(port, *rest)
    twin.deliver = lambda row, packet: (written.append(packet[0] >> 4 == Port.MEMORY), deliver(row, packet))
    circling.run(1.0, speed=0.3)
    assert sum(written) < 10
    assert circling.landed()
    assert circling.troubles == {"landed: its setpoints are not confirmed"}
    circling.run(4.0)
    assert circling.phases == {FlightPhase.GROUND}


def test_short_gaps_one_after_the_other(circling):
    """Gaps are flown through, with a moment between two that is enough for one setpoint."""
    for gap, between in ((0.7, 0.1), (0.5, 0.05), (0.3, 0.02)):
        for _ in range(5):
            circling.twin.lines[0].silence(gap)
            assert circling.run(gap + between, speed=0.3).heights[0] > HEIGHT - 0.1
    assert circling.phases == {FlightPhase.FLYING}


@pytest.mark.nightly
def test_landing_from_eight_metres(fleet):
    fleet.climb(8.0, 7.5)
    fleet.run(3.0)
    fleet.order(FlightControl.land)
    assert fleet.landed()


def test_setpoint_lost_at_the_begin_of_a_gap(fleet):
    """A lower one that was sent, and not received: the drone is still where the last received one has led it."""
    fleet.climb(2.0, 0.3)
    flight = fleet.drones[0].flight
    fleet.twin.lines[0].silence(2.0)
    flight.set_target(fleet.now, (0.0, 0.0, 0.5, 0.0))
    flight.stream(fleet.now)
    fleet.run(2.0)
    assert fleet.landed()
