"""Obedience of bodies: rows that are told to move and do not, and rows that move and are not told to. Row-wise.

The told motion is that of the setpoint: the speed at which a body closes a position error, a velocity, or a twist along
the nose, added up on every tick, as one that follows slow decisions is large after each and small before the next. Told
and measured motion are compared over pieces of half a second, so that neither the rate of the measured positions nor
their resolution matters.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from agents.arrays import Array, Mask, every, norm, some, span
from agents.body.kinds import Kind

SAMPLE_S: Final = 0.1  # in which the setpoints of all ticks are added up
PIECE: Final = 5  # samples of which told and measured motion are compared
SLOW_FLIES, SLOW_WHEELS = 0.25, 0.1  # shares of a kind's speed: slower setpoints are not told to move
MOVES: Final = 0.2  # share of the told way that a robot moves at least
WITHOUT_S: Final = 1.5  # at a kind's top speed: so much way told and not moved is disobedience,
LEAST_WITHOUT_S: Final = 2.0  # and at least so long
FORGET_S: Final = 5.0  # after which motion that was not told is forgotten
RUSH_S: Final = 0.5  # at a kind's top speed, and its size, is what it may move without being told
ROUNDING_S: Final = 1e-6
TURN: Final = 1.5  # [rad] what it may turn without being told, on wheels


class Obedience:
    """Told and measured motion of N rows."""

    def __init__(self, kinds: Sequence[Kind]) -> None:
        takes = np.array([kind.takes for kind in kinds])
        self._turns = takes == "twist"
        twist, position = np.flatnonzero(self._turns), np.flatnonzero(takes == "position")
        self._twist, self._position = span(twist), span(position)
        self._any_twist, self._any_position = len(twist), len(position)
        self._flies = np.array([kind.flies for kind in kinds])
        self._speed = np.array([kind.speed for kind in kinds])
        self._response = np.array([[kind.response] for kind in kinds if kind.takes == "position"])
        self._top = self._speed[position]
        self._rim = np.where(self._flies, 0.0, [kind.radius for kind in kinds])  # [m] turning moves wheels by it
        self._slow = np.where(self._flies, SLOW_FLIES, SLOW_WHEELS) * self._speed
        self._without = WITHOUT_S * self._speed * np.where(self._flies, 1.0, 0.5)
        self._free = RUSH_S * self._speed + np.array([kind.radius for kind in kinds])
        self._due = self._last = -np.inf  # next sample, last tick [s]
        rows = len(kinds)
        # (N,) rows that are told to move and do not, and rows that move and are not told to
        self.still, self.strays = np.zeros((2, rows), dtype=bool)
        # (N,) way that a row was told and has not moved [m], and that it moved and was not told
        self.told, self.strayed = np.zeros((2, rows))
        self._samples = 0
        self._sample = np.zeros((rows, 4))  # told in this sample [m], [rad]
        # told in this piece and in the one before, for a body is late: it moves when it is told no more
        self._way, self._way_before, self._drift = np.zeros((3, rows, 3))
        self._turn, self._turn_before, self._spin = np.zeros((3, rows))
        self._begin, self._anchor = np.full((2, rows, 4), np.nan)  # positions [m] and yaw [rad]
        self._told_s, self._vain_turn = np.zeros((2, rows))
        self._vain = np.zeros((rows, 3))

    def update(self, t: float, setpoint: Array, position: Array, yaw: Array, watched: Mask) -> None:
        """Add up what was told, and compare at the end of each sample; call it on every tick, at `t` [s].

        `setpoint` (N, 4) is that of the tick before, NaN without one; `position` (N, 3) [m] and `yaw` (N,) [rad] are
        measured; `watched` rows (N,) follow their setpoints and have a valid pose.
        """
        since, self._last = t - self._last, t
        missed = since >= 2.0 * SAMPLE_S  # too many ticks, or it is the first one
        if not missed:
            told = self._told_motion(setpoint, position, yaw)
            told *= since
            np.copyto(told, 0.0, where=~np.isfinite(told))  # no setpoint, or no pose
            self._sample += told
            if t < self._due:
                return
        self._due = t + SAMPLE_S - ROUNDING_S
        way, turn = self._sample[:, :3], self._sample[:, 3]
        self._sample = np.zeros_like(self._sample)
        here = np.concatenate([position, yaw[:, None]], axis=1)
        watched = watched & np.isfinite(setpoint).all(axis=1) & np.isfinite(here).all(axis=1)
        anew = np.isnan(self._begin[:, 0]) | ~watched
        if missed or every(anew):
            self._forget(np.ones(len(watched), dtype=bool), here)
            return
        if some(anew):
            self._forget(anew, here)
        self._way += way
        self._turn += turn
        self._count_still(here, way, turn, watched)
        self._samples += 1
        if self._samples >= PIECE:
            self._samples = 0
            self._count_strays(here, watched)

    def _told_motion(self, setpoint: Array, position: Array, yaw: Array) -> Array:
        """Told velocity and, on wheels, yaw rate (N, 4) [m/s], [rad/s]; NaN without a setpoint or a pose."""
        told = setpoint.copy()
        if self._any_position:
            rows = self._position
            toward = self._response * (setpoint[rows, :3] - position[rows])
            told[rows, :3] = toward * np.minimum(1.0, self._top / np.maximum(norm(toward), 1e-9))[:, None]
        told[self._flies, 3] = 0.0
        if self._any_twist:
            rows = self._twist
            v, turn = setpoint[rows, 0], setpoint[rows, 1]
            told[rows, 0], told[rows, 1], told[rows, 2] = np.cos(yaw[rows]) * v, np.sin(yaw[rows]) * v, 0.0
            told[rows, 3] = turn
        return told

    def _count_still(self, here: Array, way: Array, turn: Array, watched: Mask) -> None:
        """Add the `way` (N, 3) [m] and `turn` (N,) [rad] of rows that are told to move; moved rows count anew."""
        told = norm(way) + self._rim * np.abs(turn) >= self._slow * SAMPLE_S
        self._vain += np.where(told[:, None], way, 0.0)
        self._vain_turn += np.where(told, turn, 0.0)
        self._told_s += np.where(told, SAMPLE_S, -SAMPLE_S)  # a pause that was as long lets it be forgotten
        # to and fro is no way
        self.told = norm(self._vain) + self._rim * np.abs(self._vain_turn)
        moved = norm(here[:, :3] - self._anchor[:, :3]) + self._rim * np.abs(_wrapped(here[:, 3] - self._anchor[:, 3]))
        again = (moved > MOVES * np.maximum(self.told, self._without)) | (self._told_s < 0.0) | ~watched
        if some(again):
            for each in (self.told, self._told_s, self._vain, self._vain_turn):
                each[again] = 0.0
            self._anchor[again] = here[again]
        self.still = (self.told >= self._without) & (self._told_s >= LEAST_WITHOUT_S)

    def _count_strays(self, here: Array, watched: Mask) -> None:
        """Add what rows moved beyond the told way, against it, or aside of it, in the piece that ends."""
        piece_s = PIECE * SAMPLE_S
        moved, told, told_turn = (
            here[:, :3] - self._begin[:, :3],
            self._way + self._way_before,
            self._turn + self._turn_before,
        )
        length = norm(told)
        toward = told / np.maximum(length, 1e-9)[:, None]
        obeyed = np.clip(np.vecdot(moved, toward), 0.0, length)
        turned = _wrapped(here[:, 3] - self._begin[:, 3])
        turned_free = turned - np.clip(turned, np.minimum(told_turn, 0.0), np.maximum(told_turn, 0.0))
        # no robot is so fast: it was moved in the world, or its position comes from something else now
        jumped = (norm(moved) > 4.0 * self._speed * piece_s) | ~watched
        keep = 1.0 - piece_s / FORGET_S
        self._drift = np.where(jumped[:, None], 0.0, keep * self._drift + moved - obeyed[:, None] * toward)
        self._spin = np.where(jumped | ~self._turns, 0.0, keep * self._spin + turned_free)
        self.strayed = norm(self._drift)
        self.strays = (self.strayed > self._free) | (np.abs(self._spin) > TURN)
        self._way_before, self._turn_before = self._way, self._turn
        self._way, self._turn = np.zeros_like(self._way), np.zeros_like(self._turn)
        self._begin = here

    def _forget(self, rows: Mask, here: Array) -> None:
        """Rows begin anew where they are."""
        self.still, self.strays = self.still & ~rows, self.strays & ~rows
        for each in (
            self.told, self._told_s, self._vain, self._vain_turn,
            self.strayed, self._drift, self._spin, self._way, self._way_before, self._turn, self._turn_before,
        ):  # fmt: skip
            each[rows] = 0.0
        self._begin, self._anchor = self._begin.copy(), self._anchor.copy()
        self._begin[rows], self._anchor[rows] = here[rows], here[rows]


def _wrapped(angle: Array) -> Array:
    return np.asarray(np.mod(angle + np.pi, 2.0 * np.pi) - np.pi)
