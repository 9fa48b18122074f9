"""Uploaded trajectories: pieces of polynomials in the trajectory memory, uncompressed or compressed.

Compressed ones are Bézier curves in millimetres and tenths of a degree (Bitcraze's page on trajectory formats).
"""

from __future__ import annotations

import struct
from math import comb, radians
from typing import Final

import numpy as np

from agents.vectors import wrap
from bridges.crazyflie.protocol import crtp
from bridges.crazyflie.protocol.crtp import COMPRESSED, IN_MEMORY, LogStatus, MemoryKind
from bridges.crazyflie.twin.memory import Memories
from bridges.crazyflie.twin.planner import ORDER, Piece, evaluate
from twins.arrays import Array

POINTS: Final = (0, 1, 3, 7)  # control points of a compressed element beside the one that the last piece ends with
SCALES: Final = (crtp.MM, crtp.MM, crtp.MM, radians(0.1))  # units of compressed x, y, z [m], yaw [rad]
MAX_COEFFICIENT: Final = 2.0**32  # upper bound of coefficients and times
FASTEST: Final = 0.01  # smallest time scale


class Trajectories:
    """The trajectories of one Crazyflie, by number."""

    def __init__(self, memories: Memories) -> None:
        self._memories = memories
        self._defined: dict[int, tuple[int, int, int, int]] = {}  # location, kind, address, number of pieces

    def define(self, number: int, location: int, kind: int, address: int, count: int) -> LogStatus:
        """Define a trajectory that starts at `address` of the memory."""
        if number >= crtp.TRAJECTORIES:
            return LogStatus.NO_COMMAND
        self._defined[number] = location, kind, address, count
        return LogStatus.OK

    def pieces(
        self, number: int, start: Array | None, *, turned: bool, reverse: bool, scale: float
    ) -> tuple[LogStatus, list[Piece]]:
        """Pieces of a trajectory; none if it is not defined, which the firmware answers with OK as well.

        Args:
            start: Pose (4,) to shift its start to; None: flown where it is defined.
            turned: Turned to the yaw of `start` too.
            reverse: Backwards.
            scale: Of time; above 1: slower.
        """
        location, kind, address, count = self._defined.get(number, (0, 0, 0, 0))
        memory = self._memories.read(
            MemoryKind.TRAJECTORY, address, max(0, self._memories.size(MemoryKind.TRAJECTORY) - address)
        )
        if location != IN_MEMORY or memory is None:
            return LogStatus.OK, []
        if kind == COMPRESSED:
            if scale != 1.0 or reverse:
                return LogStatus.NO_COMMAND, []
            pieces = _compressed(memory)
        else:
            pieces = [_uncompressed(memory, k, max(scale, FASTEST)) for k in range(count)]
        if reverse:
            pieces = [(span, _reversed(span, coefficients)) for span, coefficients in reversed(pieces)]
        if start is not None and pieces:
            first, _, _ = evaluate(pieces[0][1], 0.0)
            turn = wrap(start[3] - first[3]) if turned else 0.0
            cos, sin = np.cos(turn), np.sin(turn)
            rotation = np.array(
                [[cos, -sin, 0.0, 0.0], [sin, cos, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
            )
            shift = np.append(start[:3] - first[:3], turn)  # shift before the turn, as the firmware has it
            pieces = [(span, rotation @ coefficients) for span, coefficients in pieces]
            for _, coefficients in pieces:
                coefficients[:, 0] += shift
        return LogStatus.OK, pieces


def _uncompressed(memory: bytes, number: int, scale: float) -> Piece:
    *values, span = crtp.PIECE.unpack_from(memory, crtp.PIECE.size * number)
    if (np.abs(values) > MAX_COEFFICIENT).any() or not 0.0 < span <= MAX_COEFFICIENT:  # NaN: the planner gives up
        raise ValueError("no numbers of a trajectory")
    return span * scale, np.array(values).reshape(4, ORDER + 1) / scale ** np.arange(ORDER + 1)


def _compressed(memory: bytes) -> list[Piece]:
    end = np.array(struct.unpack_from("<4h", memory)) * SCALES
    at, pieces = 8, list[Piece]()
    while True:
        header, milliseconds = struct.unpack_from("<BH", memory, at)
        at += 3
        if milliseconds == 0:
            return pieces
        span, coefficients = milliseconds / crtp.SECONDS_MS, np.zeros((4, ORDER + 1))
        for axis in range(4):
            count = POINTS[header >> 2 * axis & 3]
            points = [end[axis], *(SCALES[axis] * point for point in struct.unpack_from(f"<{count}h", memory, at))]
            at += 2 * count
            for j in range(count + 1):  # step from the Bernstein basis to powers of t
                total = sum((-1) ** (i + j) * comb(j, i) * points[i] for i in range(j + 1))
                coefficients[axis, j] = comb(count, j) * total / span**j
            end[axis] = points[-1]
        pieces.append((span, coefficients))


def _reversed(span: float, coefficients: Array) -> Array:
    """Coefficients of p(span - t)."""
    powers = range(ORDER + 1)
    turned = np.array([[(-1) ** k * comb(j, k) * span ** (j - k) if j >= k else 0.0 for k in powers] for j in powers])
    return np.asarray(coefficients @ turned)
