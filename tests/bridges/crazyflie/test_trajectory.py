"""Trajectories that end on the floor, as the twin's memory and planner read them."""

import array

import numpy as np
import pytest

from agents.protocols import crtp
from agents.protocols.crazyradio import COUNTERS, NULL
from agents.protocols.crtp import HighLevel, Memory, Port
from bridges.crazyflie import trajectory as module
from bridges.crazyflie.trajectory import COMPRESSED, HOLD_S, SECOND, SINK, START_EXPIRY_S, TAKEOFF
from twins.devices.crazyflie.memory import Memories
from twins.devices.crazyflie.planner import Planner
from twins.devices.crazyflie.trajectories import Trajectories

DT = 0.01
TOUCHES = 0.5  # [m/s] faster at the floor is no landing


class Board:
    """Memory, planner and answers of a Crazyflie; `lost`: so many answers about the memory do not come."""

    def __init__(self):
        self.memories, self.planner, self.lost = Memories(), Planner(1), 0
        self.trajectories = Trajectories(self.memories)
        self.sent, self.started = [], []
        self.client = module.Trajectories(self.receive)
        self.client.define()
        self.sent.clear()

    def receive(self, port, _channel, data):
        self.sent.append(data)
        if port == Port.MEMORY:
            _, address = crtp.MEMORY.unpack_from(data)
            assert self.memories.write(Memory.TRAJECTORY, address, data[crtp.MEMORY.size :])
            self.lost -= 1
            if self.lost < 0:
                self.client.note_answer(address, 0)
        elif data[0] == HighLevel.DEFINE:
            self.trajectories.define(data[1], *crtp.DEFINE.unpack_from(data, 2))
        else:
            relative, turned, reverse, number, scale = crtp.START_2.unpack_from(data, 2)
            assert not relative
            _, pieces = self.trajectories.pieces(number, None, turned=turned, reverse=reverse, scale=scale)
            self.planner.follow(0, 0.0, pieces)
            self.started.append(number)

    def flown(self, seconds):
        """Poses (k, 4) of the plan, `DT` apart."""
        return np.array([self.planner.goal(k * DT)[0] for k in range(round(seconds / DT))])


@pytest.fixture
def board():
    return Board()


@pytest.mark.parametrize("height", [0.2, 0.8, 3.0])
@pytest.mark.parametrize("yaw", [0.0, 1.2])
def test_a_setpoint_is_held_and_then_left_for_the_floor(board, height, yaw):
    while not board.started:
        board.client.hold((1.5, -2.0, height, yaw), HOLD_S)
    poses = board.flown(30.0)
    assert poses[0] == pytest.approx([1.5, -2.0, height, yaw])
    assert poses[:, [0, 1, 3]] == pytest.approx(np.tile(poses[0, [0, 1, 3]], (len(poses), 1)))
    assert poses[round(HOLD_S / DT) - 1, 2] == pytest.approx(height)
    sinks = -np.diff(poses[:, 2]) / DT
    assert sinks.min() > -1e-9
    assert sinks.max() < TOUCHES
    assert poses[-1, 2] == pytest.approx(module.BELOW, abs=0.01)
    assert sinks[round(1.1 / DT)] == pytest.approx(SINK, rel=0.01)
    if yaw == 0.0:
        assert board.started == [COMPRESSED]
        assert len(board.sent) == 2


def test_a_climb_ends_on_the_floor_too(board):
    while not board.started:
        board.client.climb((0.1, 0.2, 0.02, 0.7), (0.8, 2.0), HOLD_S)
    assert board.started == [TAKEOFF]
    z = board.flown(12.0)[:, 2]
    assert z[0] == pytest.approx(0.02)
    assert z.max() == pytest.approx(z[round(2.0 / DT)]) == pytest.approx(0.8)
    assert z[round(3.0 / DT)] == pytest.approx(0.8)
    assert -np.diff(z).min() / DT < TOUCHES
    assert z[-1] < 0.0


def test_polynomials_are_started_when_all_of_them_is_confirmed(board):
    """Also with a setpoint that changes meanwhile; then only what differs is written, beside the one that is flown."""
    board.lost = 3
    board.client.hold((1.0, 2.0, 0.5, 0.3), HOLD_S)
    assert board.started == []
    written = len(board.sent)
    board.client.hold((1.1, 2.0, 0.5, 0.3), HOLD_S)
    assert len(board.sent) == written + 3
    board.client.hold((1.2, 2.0, 0.5, 0.3), HOLD_S)
    assert len(board.started) == 1
    assert board.flown(DT)[0] == pytest.approx([1.0, 2.0, 0.5, 0.3])
    for x in (1.2, 1.3, 1.4, 1.5, 1.6, 1.7):
        board.client.hold((x, 2.0, 0.5, 0.3), HOLD_S)
    assert board.started[:3] == [1, SECOND, 1]
    board.sent.clear()
    board.client.hold((1.8, 2.0, 0.5, 0.3), HOLD_S)
    assert len(board.sent) == 2, "x of two pieces"


def test_the_first_setpoint_is_started_when_it_is_confirmed(board):
    """The firmware may start what its memory holds before the write that came first: a place of an earlier flight."""
    board.client.hold((3.0, 3.0, 1.0, 0.0), HOLD_S)
    while board.started[-1] != TAKEOFF:
        board.client.climb((0.0, 0.0, 0.0, 0.0), (0.5, 1.5), HOLD_S)
    board.lost = 2
    for _ in range(2):
        board.client.hold((0.0, 0.0, 0.5, 0.0), HOLD_S)
    assert board.started[-1] == TAKEOFF
    for x in (0.0, 0.1):
        board.client.hold((x, 0.0, 0.5, 0.0), HOLD_S)
        assert board.flown(DT)[0] == pytest.approx([x, 0.0, 0.5, 0.0])
    assert board.started[-2:] == [COMPRESSED] * 2


def test_polynomials_of_an_earlier_flight_are_not_started(board):
    board.lost = 1
    board.client.hold((3.0, 3.0, 1.0, 0.3), HOLD_S)
    assert board.started == []
    while not board.started:
        board.client.climb((0.0, 0.0, 0.0, 0.3), (0.5, 1.5), HOLD_S)
    while len(board.started) < 2:
        board.client.hold((0.0, 0.0, 0.5, 0.3), HOLD_S)
    assert board.flown(DT)[0] == pytest.approx([0.0, 0.0, 0.5, 0.3])


def test_an_old_start_is_not_transmitted(board, monkeypatch):
    """cflib repeats a packet until it is answered, for as long as a gap takes; the counters of safelink stay."""
    transmitted = []
    radio = type("Radio", (), {"send_packet": lambda _, data: transmitted.append(bytes(data))})()
    prompt, now = module.PromptRadio(radio), module.time.monotonic()
    board.client.hold((0.0, 0.0, 0.5, 0.0), HOLD_S)
    write, start = (
        array.array("B", bytes((crtp.header(port, channel) & ~0x08,)) + data)
        for (port, channel), data in zip(((Port.MEMORY, 2), (Port.HIGH_LEVEL, 0)), board.sent, strict=True)
    )
    prompt.send_packet((0xFF, 0x05, 0x01))
    prompt.send_packet(write)
    prompt.send_packet(start)
    assert transmitted[1:] == [bytes(write), bytes(start)]
    monkeypatch.setattr(module.time, "monotonic", lambda: now + START_EXPIRY_S + 0.1)
    prompt.send_packet(write)
    prompt.send_packet(start)
    assert transmitted[3:] == [bytes(write), bytes((NULL & ~COUNTERS | 0x04,))]
