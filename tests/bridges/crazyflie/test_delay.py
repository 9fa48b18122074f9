"""Delay of positions from outside, by a hop of the twin."""

import math
import struct

import numpy as np
import pytest

from bridges.crazyflie.delay import ClimbLog, delay
from bridges.crazyflie.protocol.crtp import Port
from tests.bridges.crazyflie.wire import DT, Wire


def hop(late, rate_hz=20, noise=0.001, sigma=0.1, height=0.2, **faults):
    """Heights on board, and those that it is told `late` [s] at a rate, in a hop."""
    random, log = np.random.default_rng(1), ClimbLog()
    wire, heights = Wire(external=True, **faults), []
    wire.set("locSrv.extPosStdDev", "f", sigma)

    def each():
        heights.append(wire.position[2])
        if wire.ticks % round(1.0 / DT / rate_hz) == 0:
            told = heights[max(-len(heights), -1 - round(late / DT))] + noise * random.standard_normal()
            wire.put(Port.LOCATION, 0, struct.pack("<3f", 0.0, 0.0, told))
            log.tell(wire.t, told)
        if wire.ticks % 5 == 0:
            log.feel(wire.t, round(wire.vehicle.estimate[2], 3), round(wire.vehicle.velocity[2], 3))

    wire.after(3.0, each).takeoff(height, height / 0.4)
    wire.after(2.0, each)
    return log


@pytest.mark.parametrize("late", [0.0, 0.1, 0.2, 0.3])
@pytest.mark.parametrize(
    ("rate_hz", "noise", "given"),
    [
        (20, 0.0002, {}),
        (20, 0.002, {}),
        (100, 0.0002, {}),
        (100, 0.002, {"accelerometer_mg": -4.0}),
        (20, 0.001, {"sigma": 0.01, "accelerometer_mg": 4.0}),
    ],
)
def test_a_hop_tells_how_late_heights_are(late, rate_hz, noise, given):
    sigma = given.get("sigma", 0.1)
    assert hop(late, rate_hz, noise, **given).delay(sigma) == pytest.approx(late, abs=0.04)


def test_without_a_whole_climb_the_delay_is_unknown():
    log = hop(0.1)
    board, told = list(log._board), list(log._given)
    begin = board[0][0]
    for part in (
        ([], []),
        (board, told[:1]),
        (board, told[:55]),  # ends too early
        (board, [each for each in told if each[0] > begin + 2.5]),  # begins too late
        (board, [each for each in told if not begin + 0.5 < each[0] < begin + 2.9]),  # a gap
        (board, [(t, 0.0) for t, _ in told]),
        ([(t, 0.0, 0.0) for t, *_ in board], told),  # the drone feels nothing
    ):
        assert math.isnan(delay(*part, 0.1))
