"""Poses as functions of time: samples with straight lines between them, and pieces of polynomials."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from itertools import accumulate, pairwise
from math import hypot, isfinite, pi, remainder, tau
from typing import Final, NamedTuple

from agents.vectors import Pose, Vector, distance

AXES: Final = 4  # x, y, z, yaw
ORDER: Final = 8  # coefficients of a polynomial of Crazyswarm, from the 0th power on
PROBES: Final = 200  # speeds that are looked at in a piece
ROUNDED: Final = 1.001  # multiple of the largest of them that no speed between them exceeds

Coefficients = tuple[float, ...]


class TimedPose(NamedTuple):
    """Pose at a time, and its line in the file."""

    time: float  # seconds since the first pose
    place: Vector  # [m]; z may be NaN
    yaw: float  # [rad]; NaN: not recorded
    line: int


class Piece(NamedTuple):
    """Polynomial for a time, and its line in the file."""

    duration: float  # [s]
    axes: tuple[Coefficients, Coefficients, Coefficients, Coefficients]
    line: int


class Samples:
    """Samples with straight lines between them."""

    def __init__(self, samples: Sequence[TimedPose]) -> None:
        """`samples`: In order of time, two or more."""
        self._samples = samples
        self._times = [each.time for each in samples]
        self.duration = self._times[-1]  # [s]
        steps = pairwise(samples)
        self.speed = max(_way(a.place, b.place) / (b.time - a.time) for a, b in steps)  # largest [m/s]

    def pose(self, time: float) -> Pose:
        """Pose at a time from the beginning [s]; the last one beyond the end."""
        a, b = self._around(time)
        share = min(max((time - a.time) / (b.time - a.time), 0.0), 1.0)
        (x, y, z), (to_x, to_y, to_z) = a.place, b.place
        yaw = a.yaw + share * remainder(b.yaw - a.yaw, tau)
        return x + share * (to_x - x), y + share * (to_y - y), z + share * (to_z - z), _wrapped(yaw)

    def line(self, time: float) -> int:
        """Line of the file with the pose before a time."""
        return self._around(time)[0].line

    def _around(self, time: float) -> tuple[TimedPose, TimedPose]:
        after = min(max(bisect_right(self._times, time), 1), len(self._samples) - 1)
        return self._samples[after - 1], self._samples[after]


class Polynomials:
    """Pieces of polynomials, one after the other."""

    def __init__(self, pieces: Sequence[Piece]) -> None:
        self._pieces = pieces
        self._begins = [0.0, *accumulate(each.duration for each in pieces)]
        self.duration = self._begins[-1]  # [s]
        self.speed = (
            ROUNDED
            * max(  # largest [m/s]
                hypot(*(_rate(axis, each.duration * k / PROBES) for axis in each.axes[:3]))
                for each in pieces
                for k in range(PROBES + 1)
            )
        )
        self.jumps = [  # ends of pieces where the next one does not begin: line and distance [m]
            (after.line, distance(_place(before, before.duration), _place(after, 0.0)))
            for before, after in pairwise(pieces)
        ]

    def pose(self, time: float) -> Pose:
        """Pose at a time from the beginning [s]; the last one beyond the end."""
        piece, inside = self._at(time)
        x, y, z, yaw = (_value(axis, inside) for axis in piece.axes)
        return x, y, z, _wrapped(yaw)

    def line(self, time: float) -> int:
        """Line of the file with the piece at a time."""
        return self._at(time)[0].line

    def _at(self, time: float) -> tuple[Piece, float]:
        number = min(max(bisect_right(self._begins, time) - 1, 0), len(self._pieces) - 1)
        piece = self._pieces[number]
        return piece, min(max(time - self._begins[number], 0.0), piece.duration)


Curve = Samples | Polynomials


def _place(piece: Piece, time: float) -> Vector:
    x, y, z = (_value(axis, time) for axis in piece.axes[:3])
    return x, y, z


def _value(axis: Coefficients, time: float) -> float:
    total = 0.0
    for each in reversed(axis):
        total = total * time + each
    return total


def _rate(axis: Coefficients, time: float) -> float:
    total = 0.0
    for power in range(len(axis) - 1, 0, -1):
        total = total * time + power * axis[power]
    return total


def _way(a: Vector, b: Vector) -> float:
    """Distance, without heights where they are unknown [m]."""
    rise = b[2] - a[2]
    return hypot(b[0] - a[0], b[1] - a[1], rise if isfinite(rise) else 0.0)


def _wrapped(yaw: float) -> float:
    return remainder(yaw, tau) if abs(yaw) > pi else yaw
