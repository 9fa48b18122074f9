"""Uploaded trajectories and spirals of a Crazyflie twin, packed as cflib packs them."""

import math
import struct

import numpy as np
import pytest
from numpy.polynomial import Polynomial

from bridges.crazyflie.protocol.crtp import COMPRESSED, IN_MEMORY, UNCOMPRESSED, LogStatus, MemoryKind
from bridges.crazyflie.twin.memory import Memories
from bridges.crazyflie.twin.planner import OnboardPlanner, evaluate
from bridges.crazyflie.twin.trajectories import Trajectories

RISE = [0.0, 0.0, 0.0, 0.0, 35.0, -84.0, 70.0, -20.0]  # from 0 to 1 in 1 s, at rest at both ends


def piece(span, x=(), y=(), z=(), yaw=()):
    return struct.pack("<33f", *[c for axis in (x, y, z, yaw) for c in (*axis, *[0.0] * (8 - len(axis)))], span)


def uploaded(data, kind=UNCOMPRESSED, count=0):
    """Trajectory 3 of a memory that holds `data` at address 132."""
    memories = Memories()
    assert memories.write(MemoryKind.TRAJECTORY, 132, data)
    trajectories = Trajectories(memories)
    assert trajectories.define(3, IN_MEMORY, kind, 132, count) == LogStatus.OK
    return trajectories


def pose(pieces, t):
    """Pose (4,) on pieces at time `t` [s]."""
    for span, coefficients in pieces:
        if t <= span:
            return evaluate(coefficients, t)[0]
        t -= span
    raise AssertionError


def flown_pieces(trajectories, start=None, **options):
    options = {"turned": False, "reverse": False, "scale": 1.0} | options
    status, pieces = trajectories.pieces(3, start, **options)
    assert status == LogStatus.OK
    return pieces


@pytest.fixture
def corner():
    """A metre along x, then half a metre along y while it turns."""
    east = piece(1.0, RISE, [0.5], [1.0])
    north = piece(2.0, [1.0], [0.5, 0.25], [1.0], [0.0, 0.3])
    return uploaded(east + north, count=2)


def test_pieces_of_the_memory_and_relative_ones(corner):
    pieces = flown_pieces(corner)
    assert [span for span, _ in pieces] == [1.0, 2.0]
    assert pose(pieces, 0.5) == pytest.approx([0.5, 0.5, 1.0, 0.0])
    assert pose(pieces, 2.0) == pytest.approx([1.0, 0.75, 1.0, 0.3])
    assert pose(flown_pieces(corner, scale=2.0), 4.0) == pytest.approx([1.0, 0.75, 1.0, 0.3])  # slower
    assert pose(flown_pieces(corner, reverse=True), 1.0) == pytest.approx([1.0, 0.75, 1.0, 0.3])
    assert pose(flown_pieces(corner, reverse=True), 2.75) == pytest.approx([Polynomial(RISE)(0.25), 0.5, 1.0, 0.0])
    start = np.array([2.0, 2.0, 0.4, 0.5 * math.pi])
    assert pose(flown_pieces(corner, start), 0.0) == pytest.approx([2.0, 2.0, 0.4, 0.0])
    assert pose(flown_pieces(corner, start), 1.0) == pytest.approx([3.0, 2.0, 0.4, 0.0])
    turned = flown_pieces(uploaded(piece(1.0, RISE), count=1), start, turned=True)
    assert pose(turned, 1.0) == pytest.approx([2.0, 3.0, 0.4, 0.5 * math.pi])


def test_compressed_pieces():
    start = struct.pack("<4h", 500, -200, 1000, 900)  # mm, tenths of a degree
    first = struct.pack("<BH", 0 | 1 << 2 | 2 << 4 | 0 << 6, 1500) + struct.pack("<h3h", 300, 1000, 1400, 1200)
    high = [600, 700, 800, 900, 1000, 1100, 1250]
    second = struct.pack("<BH", 3 | 0 << 2 | 0 << 4 | 1 << 6, 1000) + struct.pack("<7hh", *high, 0)
    pieces = flown_pieces(uploaded(start + first + second + b"\0\0\0", COMPRESSED))
    assert [span for span, _ in pieces] == [1.5, 1.0]

    def bezier(points, s):
        n = len(points) - 1
        return sum(math.comb(n, i) * s**i * (1 - s) ** (n - i) * p for i, p in enumerate(points))

    for s in (0.0, 0.3, 1.0):
        wanted = [0.5, -0.2 + 0.5 * s, 1e-3 * bezier([1000, 1000, 1400, 1200], s), 0.5 * math.pi]
        assert pose(pieces, 1.5 * s) == pytest.approx(wanted)
        if s > 0.0:  # at its beginning the last piece counts
            wanted = [1e-3 * bezier([500, *high], s), 0.3, 1.2, 0.5 * math.pi * (1.0 - s)]
            assert pose(pieces, 1.5 + s) == pytest.approx(wanted)
    other = uploaded(start + first + b"\0\0\0", COMPRESSED)
    assert other.pieces(3, None, turned=False, reverse=True, scale=1.0) == (LogStatus.NO_COMMAND, [])


def test_what_is_not_there(corner):
    assert corner.pieces(4, None, turned=False, reverse=False, scale=1.0) == (LogStatus.OK, [])  # as the firmware
    assert corner.define(10, IN_MEMORY, UNCOMPRESSED, 0, 1) == LogStatus.NO_COMMAND
    for data in (piece(1.0, [1e30]), piece(math.nan), b""):
        with pytest.raises(ValueError, match="no numbers"):
            flown_pieces(uploaded(data, count=1))


@pytest.mark.parametrize("clockwise", [False, True])
@pytest.mark.parametrize("sideways", [False, True])
def test_a_spiral_goes_round_its_centre(clockwise, sideways):
    planner, yaw, angle, span = OnboardPlanner(), 0.3, 0.5 * math.pi, 4.0
    start = np.array([0.2, -0.1, 1.0, yaw])
    planner.spiral(
        0.0, start, angle=angle, radii=(0.5, 0.7), climb=0.4, span=span, sideways=sideways, clockwise=clockwise
    )
    sense = -1.0 if clockwise else 1.0
    to_centre = yaw + (0.0 if clockwise else math.pi) if sideways else yaw + sense * 0.5 * math.pi
    centre = start[:2] + 0.5 * np.array([math.cos(to_centre), math.sin(to_centre)])
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        x, y, z, heading = planner.goal(span * share)
        out = np.array([x, y]) - centre
        assert math.hypot(*out) == pytest.approx(0.5 + 0.2 * share, abs=0.01)  # one polynomial is no spiral: 1 cm
        assert z == pytest.approx(1.0 + 0.4 * share, abs=1e-9)
        assert heading == pytest.approx(yaw + sense * angle * share, abs=1e-9)
    _, speed, _ = planner.state(0.0)
    along = sense * np.array([math.sin(to_centre), -math.cos(to_centre)])
    assert along @ speed[:2] == pytest.approx(0.5 * angle / span)
