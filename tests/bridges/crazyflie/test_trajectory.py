"""Trajectories that end on the floor, as the twin's memory and planner read them."""

import array

import numpy as np
import pytest

from bridges.crazyflie import trajectory as module
from bridges.crazyflie.protocol import crtp
from bridges.crazyflie.protocol.crazyradio import COUNTERS, NULL
from bridges.crazyflie.protocol.crtp import HighLevel, MemoryKind, Port
from bridges.crazyflie.trajectory import COMPRESSED, HOLD_S, POLYNOMIALS, REPEAT_S, SINK, START_EXPIRY_S, TAKEOFFS
from bridges.crazyflie.twin.memory import Memories
from bridges.crazyflie.twin.planner import OnboardPlanner, evaluate, polynomial
from bridges.crazyflie.twin.trajectories import Trajectories
from tests.bridges.crazyflie.flights import clocked
from tests.waiting import ManualClock

DT = 0.01
TOUCHES = 0.5  # [m/s] faster at the floor is no landing


class Board(ManualClock):
    """Clock, memory, planner and answers of a Crazyflie; `lost`: so many answers about the memory do not come."""

    def __init__(self, monkeypatch):
        super().__init__(100.0)
        self.memories, self.planner, self.lost = Memories(), OnboardPlanner(), 0
        clocked(monkeypatch, self)
        self.trajectories = Trajectories(self.memories)
        self.sent, self.started = [], []
        self.client = module.TrajectoryMemory(self.receive)
        self.client.define()
        self.sent.clear()

    def receive(self, port, _channel, data):
        self.sent.append(data)
        if port == Port.MEMORY:
            _, address = crtp.MEMORY.unpack_from(data)
            assert self.memories.write(MemoryKind.TRAJECTORY, address, data[crtp.MEMORY.size :])
            self.lost -= 1
            if self.lost < 0:
                self.client.note_answer(address, 0)
        elif data[0] == HighLevel.DEFINE:
            self.trajectories.define(data[1], *crtp.DEFINE.unpack_from(data, 2))
        else:
            relative, turned, reverse, number, scale = crtp.START_2.unpack_from(data, 2)
            assert not relative
            _, pieces = self.trajectories.pieces(number, None, turned=turned, reverse=reverse, scale=scale)
            self.planner.follow(0.0, pieces)
            self.started.append(number)

    def sampled(self, seconds):
        """Poses (k, 4) of the plan, `DT` apart."""
        return np.array([self.planner.goal(k * DT) for k in range(round(seconds / DT))])

    def hold(self, x, yaw=0.0):
        """Called again and again until the setpoint is started; returns the packets that were sent."""
        self.sent.clear()
        while not self.client.hold((x, 2.0, 0.5, yaw), HOLD_S):
            self.now += 0.05
        return len(self.sent)

    def climb(self, place, climb):
        while (number := self.client.write_climb(place, climb, HOLD_S)) is None:
            assert self.started == []
            self.now += 0.05
        self.client.start(number)


@pytest.fixture
def board(monkeypatch):
    return Board(monkeypatch)


@pytest.mark.parametrize(("height", "yaw"), [(0.2, 0.0), (3.0, 1.2)])
def test_setpoint_is_held_and_then_left_downwards(board, height, yaw):
    while not board.started:
        board.client.hold((1.5, -2.0, height, yaw), HOLD_S)
    poses = board.sampled(30.0)
    assert poses[0] == pytest.approx([1.5, -2.0, height, yaw])
    assert poses[:, [0, 1, 3]] == pytest.approx(np.tile(poses[0, [0, 1, 3]], (len(poses), 1)))
    assert poses[round(HOLD_S / DT) - 1, 2] == pytest.approx(height)
    sinks = -np.diff(poses[:, 2]) / DT
    assert sinks.min() > -1e-9
    assert sinks.max() < TOUCHES
    assert poses[-1, 2] == pytest.approx(module.BELOW, abs=0.01)
    assert sinks[round(1.1 / DT)] == pytest.approx(SINK, rel=0.01)
    assert board.started == [COMPRESSED[0] if yaw == 0.0 else POLYNOMIALS[0]]


def test_descent_that_ends_in_a_stop(board):
    """Without holding, quicker and quicker, until the planner gives up."""
    board.client.stops = True
    board.climb((0.1, 0.2, 0.02, 0.0), (0.8, 2.0))
    poses = board.sampled(2.0 + module.stop_descent_s(0.8, 2.0) + 1.0)
    flown = np.count_nonzero(~np.isnan(poses).any(axis=1))
    assert flown * DT == pytest.approx(2.0 + module.stop_descent_s(0.8, 2.0), abs=2 * DT)
    assert poses[:200, 2].max() == pytest.approx(0.8, abs=1e-3)
    assert np.diff(poses[200:flown, 2], 2) / DT**2 == pytest.approx(-module.STOP_SINK)
    assert poses[flown - 1, 2] < module.BELOW
    for k in range(4):
        packets = board.hold(0.1 * k)
    assert (packets, board.started[-1]) == (2, POLYNOMIALS[1])


@pytest.mark.parametrize(("yaw", "packets"), [(0.0, 2), (0.7, 17)])
def test_a_climb_ends_on_the_floor_too(board, yaw, packets):
    board.climb((0.1, 0.2, 0.02, yaw), (0.8, 2.0))
    assert board.started == [TAKEOFFS[packets > 2]]
    assert len(board.sent) == packets + 1
    poses = board.sampled(12.0)
    assert poses[:, [0, 1, 3]] == pytest.approx(np.tile([0.1, 0.2, yaw], (len(poses), 1)))
    ways = polynomial(2.0, (np.array([0.02]), *[np.zeros(1)] * 2), (np.array([0.8]), *[np.zeros(1)] * 2))
    assert poses[:200, 2] == pytest.approx(evaluate(ways, np.arange(200) * DT)[0], abs=1e-3)
    z = poses[:, 2]
    assert z[0] == pytest.approx(0.02)
    assert z.max() == pytest.approx(z[round(2.0 / DT)]) == pytest.approx(0.8)
    assert z[round(3.0 / DT)] == pytest.approx(0.8)
    assert -np.diff(z).min() / DT < TOUCHES
    assert z[-1] < 0.0


def test_parts_are_written_singly_and_started_when_confirmed(board):
    """Also of a setpoint that changes meanwhile; an answer that does not come is waited for, then asked for again."""
    board.lost = 1
    for x in (1.0, 1.1, 1.2):
        assert board.client.hold((x, 2.0, 0.5, 0.3), HOLD_S) == 0
    assert len(board.sent) == 1
    board.now += REPEAT_S + 0.1
    assert board.hold(1.3, yaw=0.3) > 5
    assert board.started == [POLYNOMIALS[0]]
    assert board.sampled(DT)[0] == pytest.approx([1.0, 2.0, 0.5, 0.3])


@pytest.mark.parametrize(("yaw", "numbers", "least"), [(0.0, COMPRESSED, 2), (0.3, POLYNOMIALS, 3)])
def test_the_trajectory_that_is_flown_is_never_written(board, yaw, numbers, least):
    """Only what differs is written; a setpoint that does not change is one packet, its start."""
    for k in range(6):
        packets = board.hold(0.1 * k, yaw)
        assert board.started[-1] == numbers[k % 2]
        assert board.sampled(DT)[0] == pytest.approx([0.1 * k, 2.0, 0.5, yaw])
    assert packets == least, "x of each piece"
    assert board.hold(0.5, yaw) == 1
    assert board.hold(0.4, yaw) == 1, "the one before is still there"


@pytest.mark.parametrize("before", ["gap", "climb"])
def test_setpoint_from_before_a_gap_is_not_started(board, before):
    board.lost = 1
    assert board.client.hold((3.0, 3.0, 1.0, 0.0), HOLD_S) == 0
    if before == "gap":
        board.now += START_EXPIRY_S + 0.1
        board.client.note_answer(0, 0)
    else:
        board.climb((0.0, 0.0, 0.0, 0.3), (0.5, 1.5))
    board.hold(0.2)
    assert board.started == [*([] if before == "gap" else [TAKEOFFS[1]]), COMPRESSED[0]]
    assert board.sampled(DT)[0] == pytest.approx([0.2, 2.0, 0.5, 0.0])


def test_an_old_start_is_not_transmitted(board):
    """cflib repeats a packet until it is answered, for as long as a gap takes; the counters of safelink stay."""
    transmitted = []
    radio = type("Radio", (), {"send_packet": lambda _, data: transmitted.append(bytes(data))})()
    prompt = module.PromptRadio(radio)
    board.hold(0.0)
    write, start = (
        array.array("B", bytes((crtp.header(port, channel) & ~0x08,)) + data)
        for (port, channel), data in zip(((Port.MEMORY, 2), (Port.HIGH_LEVEL, 0)), board.sent, strict=True)
    )
    prompt.send_packet((0xFF, 0x05, 0x01))
    prompt.send_packet(write)
    prompt.send_packet(start)
    assert transmitted[1:] == [bytes(write), bytes(start)]
    board.now += START_EXPIRY_S + 0.1
    prompt.send_packet(write)
    prompt.send_packet(start)
    assert transmitted[3:] == [bytes(write), bytes((NULL & ~COUNTERS | 0x04,))]
