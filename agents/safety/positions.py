"""Belief in measured positions: a robot does not jump. Row-wise.

A position that jumps comes from something else now (swapped markers, another origin), or the robot was put somewhere by
hand. One that is not believed reaches neither the decision nor, where it is measured from outside, the robot itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite, nan, pi, remainder, tau
from typing import Final

import numpy as np

from agents.arrays import Array, Mask, every, some
from agents.body.kinds import Kind

JUMP_M: Final = 0.5  # [m] beyond what a robot can move between two measurements: it is not where its position says
GAP_S: Final = 0.5  # longest time that counts between them; after a longer one it stood, or was landed
REACH: Final = 1.5  # share of a kind's speed: what it can move
FLIP: Final = 0.5  # [rad] beyond what a robot can turn between two measurements: its markers are mistaken
MOST_TURNED: Final = 1.2  # [rad] between two measurements, however long the time between them


class Continuity:
    """Jumps of the measured positions of N rows, and, on wheels, of their yaw, by which they drive.

    A row has jumped until its position is back, or until it is forgotten: an outlier lasts a sample.
    """

    def __init__(self, kinds: Sequence[Kind], jump_m: Array | float = JUMP_M) -> None:
        """A jump is longer than `jump_m`, one number or one for each row [m]."""
        self._fastest, self._jump = REACH * np.array([kind.speed for kind in kinds]), jump_m
        self._place, self._time = np.full((len(kinds), 3), np.nan), np.zeros(len(kinds))  # last plausible ones
        self._wheels: Mask = np.array([kind.takes == "twist" for kind in kinds], dtype=bool)
        self._any_wheels = some(self._wheels)
        self._turn_rate = REACH * np.array([kind.turn_rate for kind in kinds])
        self._yaw, self._none = np.full(len(kinds), np.nan), np.zeros(len(kinds))  # last plausible ones, no turns
        self._out: Mask = np.zeros(len(kinds), dtype=bool)
        self.turned: Array | None = None  # (N,) [rad] of rows whose yaw jumped, NaN of others; None: of no row

    def jumps(self, time: Array, position: Array, watched: Mask, yaw: Array | None = None) -> Array | None:
        """Lengths (N,) [m] of the jumps of rows, NaN of those that have not; None if no row has.

        The `position` (N, 3) [m] and `yaw` (N,) [rad] were measured at `time` (N,) [s]. A row whose yaw jumped is one
        of them; `turned` tells by how much. Rows that are not `watched` (N,), not in motion, may be carried, and begin
        anew unless they have jumped.
        """
        moved = position - self._place
        squared = np.vecdot(moved, moved)
        yaw = yaw if self._any_wheels else None
        turns = self._none if yaw is None else self._turns(yaw)
        if every(watched) and every(squared < self._jump**2) and every(turns < FLIP):
            self._place, self._time, self.turned = position.copy(), time.copy(), None
            if yaw is not None:
                self._yaw = np.where(np.isfinite(yaw), yaw, self._yaw)
            if some(self._out):
                self._out = np.zeros(len(time), dtype=bool)
            return None
        watched = watched | self._out
        gap, unknown = np.sqrt(squared), watched & np.isnan(position).any(axis=1)
        known = np.isfinite(time) & np.isfinite(self._time)
        since = np.clip(np.subtract(time, self._time, out=np.zeros_like(time), where=known), 0.0, GAP_S)
        plausible = self._jump + np.where(self._out, 0.0, self._fastest * since)
        turned = watched & (turns > FLIP + np.where(self._out, 0.0, self._turn_rate * since))
        self.turned = np.where(turned, turns, np.nan) if some(turned) else None
        self._out = (watched & ((gap > plausible) | (unknown & self._out))) | turned
        if yaw is not None:
            self._yaw = np.where(self._out | (watched & ~np.isfinite(yaw)), self._yaw, yaw)
        kept = self._out | unknown
        self._place = np.where(kept[:, None], self._place, position)
        self._time = np.where(kept, self._time, time)
        return np.where(self._out, gap, np.nan) if some(self._out) else None

    def _turns(self, yaw: Array) -> Array:
        """Angles (N,) [rad] from the last plausible `yaw` (N,); 0 of rows without wheels, or without a yaw."""
        known = self._wheels & np.isfinite(yaw) & np.isfinite(self._yaw)
        angle = np.subtract(yaw, self._yaw, out=np.zeros_like(yaw), where=known)
        return np.asarray(np.abs(np.mod(angle + pi, tau) - pi))

    def forget(self, row: int) -> None:
        """A row is where its position says, wherever that is, and its yaw is right."""
        self._place, self._yaw, self._out = self._place.copy(), self._yaw.copy(), self._out.copy()
        self._place[row], self._yaw[row], self._out[row] = np.nan, np.nan, False


class ExternalPositions:
    """Belief in positions that are measured from outside, sample by sample, of N rows.

    In motion a row has jumped if it moved by more than its own size beyond what it can: two robots that are mistaken
    for each other are at least that far apart. Smaller errors show as disobedience.
    """

    def __init__(self, kinds: Sequence[Kind]) -> None:
        self._rows = [Continuity([kind], 2.0 * kind.radius) for kind in kinds]
        self._time = np.full(len(kinds), -np.inf)
        self.jump: Array = np.full(len(kinds), np.nan)  # (N,) lengths of the jumps of rows [m], NaN of other rows
        self.deceived: Mask = np.zeros(len(kinds), dtype=bool)  # (N,) rows whose positions are wrong for good
        self._turn_rate = [REACH * kind.turn_rate for kind in kinds]
        # (N,) last measured yaw [rad], its time [s], and the sum of its jumps [rad]
        self._yaw, self._yaw_time = np.full((2, len(kinds)), np.nan)
        self._flipped = np.zeros(len(kinds))
        self.doubted = False  # whether a row has a position that is not believed

    def believes(self, row: int, time: float, position: Array, *, watched: bool) -> bool:
        """Whether a row is at `position` (3,) [m], measured at `time` [s]; older ones than before are left out.

        `watched`: the row is in motion. At rest it may be carried.
        """
        if time <= self._time[row]:
            return False
        self._time[row] = time
        if not watched:
            self.deceived[row] = False
            self._rows[row].forget(0)
        jump = self._rows[row].jumps(np.array([time]), position[None], np.array([watched]))
        self._note(row, np.nan if jump is None else float(jump[0]))
        return jump is None and not self.deceived[row]

    def believed_yaw(self, row: int, time: float, yaw: float, *, watched: bool) -> float:
        """The `yaw` [rad] of a row that is measured at `time` [s]; NaN while it is known to be wrong.

        Markers that look the same when turned make it flip; it is wrong until it has flipped back.
        """
        if not isfinite(yaw):
            return nan
        jump, since = remainder(yaw - self._yaw[row], tau), time - self._yaw_time[row]
        if not watched:
            self._flipped[row] = 0.0
        elif abs(jump) > min(FLIP + self._turn_rate[row] * since, MOST_TURNED):  # not of the first one, which is NaN
            self._flipped[row] = remainder(self._flipped[row] + jump, tau)
        self._yaw[row], self._yaw_time[row] = yaw, time
        return yaw if abs(self._flipped[row]) < FLIP else nan

    def disbelieve(self, row: int) -> None:
        """Reject external positions of a row while it is in motion."""
        if self._time[row] > -np.inf:
            self.deceived[row] = self.doubted = True

    def forget(self, row: int) -> None:
        """A row is where its position says, wherever that is."""
        self._rows[row].forget(0)
        self._note(row, np.nan)

    def _note(self, row: int, jump: float) -> None:
        self.jump[row] = jump
        self.doubted = some(self.deceived) or not every(np.isnan(self.jump))
