"""Obedience of bodies: rows that are told to move and do not, that move and are not told to, or that jump. Row-wise.

The told motion is that of the setpoint: the speed at which a body closes a position error, a velocity, or a twist along
the nose. Told and measured motion are compared over pieces of half a second, so that neither the rate of the measured
positions nor their resolution matters.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from agents.arrays import Array, Mask, every, norm, some
from agents.body.kinds import Kind

SAMPLE_S: Final = 0.1  # between two samples of the setpoint
PIECE: Final = 5  # samples of which told and measured motion are compared
SLOW_FLIES, SLOW_WHEELS = 0.25, 0.1  # shares of a kind's speed: slower setpoints are not told to move
MOVES: Final = 0.2  # share of the told way that a robot moves at least
WITHOUT_S: Final = 1.5  # at a kind's top speed: so much way told and not moved is disobedience,
LEAST_WITHOUT_S: Final = 2.0  # and at least so long
FORGET_S: Final = 5.0  # after which motion that was not told is forgotten
RUSH_S: Final = 0.5  # at a kind's top speed, and its size, is what it may move without being told
JUMP_M: Final = 0.5  # [m] beyond what a robot can move between two measurements: it is not where its position says
GAP_S: Final = 0.5  # longest time that counts between them; after a longer one it stood, or was landed
REACH: Final = 1.5  # share of a kind's speed: what it can move
TURN: Final = 1.5  # [rad] what it may turn without being told, on wheels


class Continuity:
    """Jumps of the measured positions of N rows.

    A robot does not jump: its position comes from something else now (swapped markers, another origin), or it was put
    somewhere by hand. A row has jumped until its position is back, or until it is forgotten: an outlier lasts a sample.
    """

    def __init__(self, kinds: Sequence[Kind]) -> None:
        self._fastest = REACH * np.array([kind.speed for kind in kinds])
        self._place, self._time = np.full((len(kinds), 3), np.nan), np.zeros(len(kinds))  # last plausible ones
        self._out: Mask = np.zeros(len(kinds), dtype=bool)

    def jumps(self, time: Array, position: Array, watched: Mask) -> Array | None:
        """Lengths (N,) [m] of the jumps of rows, NaN of those that have not; None if no row has.

        The `position` (N, 3) [m] was measured at `time` (N,) [s]. Rows that are not `watched` (N,), not in motion, may
        be carried, and begin anew unless they have jumped.
        """
        moved = position - self._place
        squared = np.vecdot(moved, moved)
        if every(watched) and every(squared < JUMP_M**2):
            self._place, self._time = position.copy(), time.copy()
            if some(self._out):
                self._out = np.zeros(len(time), dtype=bool)
            return None
        watched = watched | self._out
        gap, unknown = np.sqrt(squared), watched & np.isnan(position).any(axis=1)
        plausible = JUMP_M + np.where(self._out, 0.0, self._fastest * np.clip(time - self._time, 0.0, GAP_S))
        self._out = watched & ((gap > plausible) | (unknown & self._out))
        kept = self._out | unknown
        self._place = np.where(kept[:, None], self._place, np.where(watched[:, None], position, np.nan))
        self._time = np.where(watched & ~kept, time, self._time)
        return np.where(self._out, gap, np.nan) if some(self._out) else None

    def forget(self, row: int) -> None:
        """A row is where its position says, wherever that is."""
        self._place, self._out = self._place.copy(), self._out.copy()
        self._place[row], self._out[row] = np.nan, False


class Obedience:
    """Told and measured motion of N rows."""

    def __init__(self, kinds: Sequence[Kind]) -> None:
        takes = np.array([kind.takes for kind in kinds])
        self._twist, self._position = takes == "twist", takes == "position"
        self._flies = np.array([kind.flies for kind in kinds])
        self._speed = np.array([kind.speed for kind in kinds])
        self._response = np.array([kind.response for kind in kinds])
        self._rim = np.where(self._flies, 0.0, [kind.radius for kind in kinds])  # [m] turning moves wheels by it
        self._slow = np.where(self._flies, SLOW_FLIES, SLOW_WHEELS) * self._speed
        self._without = WITHOUT_S * self._speed * np.where(self._flies, 1.0, 0.5)
        self._free = RUSH_S * self._speed + np.array([kind.radius for kind in kinds])
        self._due = -np.inf
        rows = len(kinds)
        # (N,) rows that are told to move and do not, and rows that move and are not told to
        self.still, self.strays = np.zeros((2, rows), dtype=bool)
        # (N,) way that a row was told and has not moved [m], and that it moved and was not told
        self.told, self.strayed = np.zeros((2, rows))
        self._samples = 0
        # told in this piece and in the one before, for a body is late: it moves when it is told no more
        self._way, self._way_before, self._drift = np.zeros((3, rows, 3))
        self._turn, self._turn_before, self._spin = np.zeros((3, rows))
        self._begin, self._anchor = np.full((2, rows, 4), np.nan)  # positions [m] and yaw [rad]
        self._told_s, self._vain_turn = np.zeros((2, rows))
        self._vain = np.zeros((rows, 3))

    def due(self, t: float) -> bool:
        """Whether `update` has something to do at `t` [s]; ask on every tick."""
        return t >= self._due

    def update(self, t: float, setpoint: Array, position: Array, yaw: Array, watched: Mask) -> None:
        """Compare at `t` [s]; before the next sample is due nothing happens.

        `setpoint` (N, 4) is that of the tick before, NaN without one; `position` (N, 3) [m] and `yaw` (N,) [rad] are
        measured; `watched` rows (N,) follow their setpoints and have a valid pose.
        """
        if not self.due(t):
            return
        missed = t - self._due >= SAMPLE_S  # ticks were missed, or it is the first one
        self._due = t + SAMPLE_S
        here = np.concatenate([position, yaw[:, None]], axis=1)
        watched = watched & np.isfinite(setpoint).all(axis=1) & np.isfinite(here).all(axis=1)
        anew = np.isnan(self._begin[:, 0]) | ~watched
        if missed or every(anew):
            self._forget(np.ones(len(watched), dtype=bool), here)
            return
        if some(anew):
            self._forget(anew, here)
        velocity, turn = self._told_motion(setpoint, position, yaw)
        self._way += velocity * SAMPLE_S
        self._turn += turn * SAMPLE_S
        self._count_still(here, velocity, turn, watched)
        self._samples += 1
        if self._samples >= PIECE:
            self._samples = 0
            self._count_strays(here, watched)

    def _told_motion(self, setpoint: Array, position: Array, yaw: Array) -> tuple[Array, Array]:
        """Told velocity (N, 3) [m/s] and yaw rate on wheels (N,) [rad/s]."""
        ahead = np.zeros((len(yaw), 3))  # `stack` takes three times as long
        ahead[:, 0], ahead[:, 1] = np.cos(yaw) * setpoint[:, 0], np.sin(yaw) * setpoint[:, 0]
        toward = self._response[:, None] * (setpoint[:, :3] - position)
        toward *= np.minimum(1.0, self._speed / np.maximum(norm(toward), 1e-9))[:, None]
        velocity = np.where(self._twist[:, None], ahead, np.where(self._position[:, None], toward, setpoint[:, :3]))
        return velocity, np.where(self._twist, setpoint[:, 1], 0.0)

    def _count_still(self, here: Array, velocity: Array, turn: Array, watched: Mask) -> None:
        """Add the told way of rows that are told to move; moved rows count anew."""
        told = norm(velocity) + self._rim * np.abs(turn) >= self._slow
        self._vain += np.where(told[:, None], velocity, 0.0) * SAMPLE_S
        self._vain_turn += np.where(told, turn, 0.0) * SAMPLE_S
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
        self._spin = np.where(jumped | ~self._twist, 0.0, keep * self._spin + turned_free)
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
