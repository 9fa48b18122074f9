"""Gaps, other clients and orders at the worst moments: no Crazyflie falls. On a simulated clock, with twins."""

import struct

import pytest

from agents.protocols.crtp import HighLevel, Port, Setpoint
from bridges.crazyflie.flight import DESCENT, FlightControl, FlightPhase
from tests.bridges.crazyflie_clock import HEIGHT, Fleet
from twins.devices.crazyflie.supervisor import SupervisorState

HZ = 500.0  # [1/s] exchanges of the radio
NIGHTLY = pytest.mark.nightly
SINKS, TOUCHES = 0.55, 0.4  # [m/s] a landing is slower, in the air and at the floor


@pytest.fixture
def fleet(monkeypatch):
    with Fleet(monkeypatch, 1, HZ) as flown:
        yield flown


def landed(fleet):
    """Fly on until the motors are off; returns the height at which they stopped [m]."""
    flock = fleet.twin.flock
    while flock.quadrotor.flying[0]:
        fleet.run(0.02)
    return float(flock.place[0, 2])


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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hover", "gap", "begin", "speed"),
    [
        (2.0, 2.0, 0.43, 0.3),
        pytest.param(2.0, 2.0, 0.43, 0.0, marks=NIGHTLY),
        pytest.param(2.0, 2.5, 1.0, 0.0, marks=NIGHTLY),
        pytest.param(2.0, 2.5, 1.0, 0.3, marks=NIGHTLY),
        (1.2, 2.5, 0.3, 0.0),
        pytest.param(1.2, 2.5, 0.3, 0.3, marks=NIGHTLY),
        (0.8, 1.0, 0.03, 0.3),
        pytest.param(0.8, 1.0, 0.03, 0.0, marks=NIGHTLY),
    ],
)
def test_gap_in_the_climb(fleet, hover, gap, begin, speed):
    """The climb goes on, and the landing begins at its end; also when setpoints have begun, and were not received."""
    fleet.climb(hover, begin)
    fleet.twin.lines[0].silence(gap)
    fleet.run(gap, speed=speed)
    assert landed(fleet) < 0.02
    assert fleet.fastest < SINKS
    assert fleet.touch < TOUCHES
    assert fleet.twin.flock.supervisor.state[0] != SupervisorState.CRASHED


@pytest.mark.slow
@pytest.mark.parametrize("stays_s", [0.0, pytest.param(2.0, marks=NIGHTLY), 5.0])
def test_flight_by_another_client_is_landed(fleet, stays_s):
    """It leaves at once, or when it has ended the landing again and again."""
    client = Client(fleet, 0.8)
    while fleet.phases != {FlightPhase.LANDING}:
        fleet.run(0.02)
    fleet.run(stays_s)
    client.leave()
    fleet.run(0.8 / DESCENT + 5.0)
    assert fleet.phases == {FlightPhase.GROUND}
    assert fleet.fastest < SINKS
    assert fleet.touch < TOUCHES
    assert fleet.troubles == {"landed: it flew without an order"}
    assert fleet.twin.flock.supervisor.state[0] != SupervisorState.LOCKED


@pytest.mark.slow
def test_another_client_in_flight_is_ended(fleet):
    """Its setpoint mutes the planner: 2 s later the drone would lock. It flies on."""
    fleet.climb(0.5, 0.45)
    fleet.run(1.0, speed=0.3)
    client = Client(fleet, 0.5)
    fleet.run(0.02, speed=0.3)
    client.leave()
    fleet.run(4.0, speed=0.3)
    assert fleet.phases == {FlightPhase.FLYING}
    assert fleet.twin.flock.supervisor.state[0] == SupervisorState.FLYING
    assert fleet.heights[0] > 0.3


@pytest.mark.slow
def test_another_client_cuts_the_motors(fleet):
    """By a setpoint of zero thrust, as its library sends when it closes a link; or by ending the plan. It flies on."""
    fleet.climb(0.5, 0.45)
    fleet.run(3.0, speed=0.3)
    zero = bytes((Port.COMMANDER << 4,)) + struct.pack("<fffH", 0.0, 0.0, 0.0, 0)
    for packet in (zero, bytes((Port.HIGH_LEVEL << 4, HighLevel.STOP, 0))):
        fleet.twin.deliver(0, packet)
        lowest = min(fleet.run(0.05, speed=0.3).heights[0] for _ in range(60))
        assert lowest > HEIGHT - 0.2
        assert fleet.heights[0] == pytest.approx(HEIGHT, abs=0.03)
    assert fleet.twin.flock.supervisor.state[0] == SupervisorState.FLYING


@pytest.mark.slow
@pytest.mark.parametrize("how", [pytest.param("refused", marks=NIGHTLY), "unanswered"])
def test_memory_that_takes_no_setpoint(fleet, how):
    """The drone descends by itself, and would stand with its motors on: it is landed. The radio is not flooded."""
    fleet.climb(0.5, 0.45)
    fleet.run(1.0, speed=0.3)
    drone, written = fleet.twin.drones[0], []
    send, write = drone.send, drone.memories.write
    if how == "refused":
        drone.memories.write = lambda *_: False
    drone.send = lambda port, *rest: None if port == Port.MEMORY and how == "unanswered" else send(port, *rest)
    deliver = fleet.twin.deliver
    fleet.twin.deliver = lambda row, packet: (written.append(packet[0] >> 4 == Port.MEMORY), deliver(row, packet))
    fleet.run(1.0, speed=0.3)
    assert sum(written) < 10
    assert landed(fleet) < 0.02
    assert fleet.troubles == {"landed: its setpoints are not confirmed"}
    assert fleet.fastest < SINKS
    assert fleet.touch < TOUCHES
    fleet.run(4.0)
    assert fleet.phases == {FlightPhase.GROUND}
    drone.memories.write = write


@pytest.mark.slow
def test_short_gaps_one_after_the_other(fleet):
    """Each is flown through, with a moment between them that is enough for one setpoint."""
    fleet.climb(0.5, 0.45)
    fleet.run(1.0, speed=0.3)
    for gap, between in ((0.7, 0.1), (0.5, 0.05), (0.3, 0.02)):
        for _ in range(5):
            fleet.twin.lines[0].silence(gap)
            assert fleet.run(gap + between, speed=0.3).heights[0] > HEIGHT - 0.1
    assert fleet.phases == {FlightPhase.FLYING}


@pytest.mark.nightly
def test_landing_from_eight_metres(fleet):
    fleet.climb(8.0, 7.5)
    fleet.run(3.0)
    fleet.order(FlightControl.land)
    assert landed(fleet) < 0.02
    assert fleet.fastest < SINKS
    assert fleet.touch < TOUCHES


@pytest.mark.slow
def test_setpoint_lost_at_the_begin_of_a_gap(fleet):
    """A lower one that was sent, and not received: the drone is still where the last received one has led it."""
    fleet.climb(2.0, 0.3)
    drone = fleet.drones[0]
    fleet.twin.lines[0].silence(2.0)
    drone.flight.set_target(fleet.now, (0.0, 0.0, 0.5, 0.0))
    drone.flight.stream(fleet.now)
    fleet.run(2.0)
    assert landed(fleet) < 0.02
    assert fleet.fastest < SINKS
    assert fleet.touch < TOUCHES
