"""What rows that a centre guides were told: goals, how old they are, and whether the centre is there at all."""

from __future__ import annotations

import numpy as np

from agents.rows import Array, Index, Mask, some


class Guidance:
    """Goals from the centre, for some of N rows.

    Attributes:
        guided: (N,) which rows it decides for.
        goal: (N, 3) told last [m].
        toward: (N,) yaw wanted there [rad], NaN for any.
        stamp: (N,) when it was decided [s]; minus infinity before the first.
        fresh: (N,) goals that nobody has acted on yet.
        gone: Since when the centre is known to be dead [s]; infinity while it lives.
    """

    def __init__(self, guided: Mask, flies: Mask, silence_s: float) -> None:
        """Before anything was told.

        Args:
            guided: (N,) which rows.
            flies: (N,) rows that do; the others' goals are on the floor.
            silence_s: A goal that is older is none [s].
        """
        rows = len(guided)
        self.guided, self._flies, self._silence_s = guided, flies, silence_s
        self.goal, self.toward = np.full((rows, 3), np.nan), np.full(rows, np.nan)
        self.stamp, self.gone = np.full(rows, -np.inf), np.inf
        self.fresh: Mask = np.zeros(rows, dtype=bool)

    def hear(self, rows: Index, goal: Array, toward: Array, stamp: Array) -> Mask:
        """Goals (H, 3) of `rows` (H,), each once, that arrived: decided at `stamp` (H,) [s]. Which were news."""
        newer = np.asarray((stamp > self.stamp[rows]) & self.guided[rows] & np.isfinite(goal).all(axis=1))
        rows = rows[newer]
        self.goal[rows], self.toward[rows], self.stamp[rows] = goal[newer], toward[newer], stamp[newer]
        self.goal[rows, 2] = np.where(self._flies[rows], self.goal[rows, 2], 0.0)
        self.fresh[rows] = True
        if self.gone < np.inf and some(self.stamp[rows] > self.gone):  # decided after that: there is another
            self.gone = np.inf
        return newer

    def lose(self, t: float) -> None:
        """The centre is gone since `t` [s]; a goal that was decided later is of another one."""
        self.gone = min(self.gone, t)

    def find(self) -> None:
        """The centre is back, though it may have nothing to say yet."""
        self.gone = np.inf

    def unheard(self) -> Mask:
        """Guided rows (N,) that were never told anything."""
        return np.asarray(self.guided & (self.stamp == -np.inf))

    def lacking(self, t: float) -> Mask:
        """Guided rows (N,) that nobody guides at `t` [s]: the centre is dead, or their goal is old, or not there."""
        if self.gone < np.inf:
            return self.guided
        return np.asarray(self.guided & ~(t - self.stamp <= self._silence_s))
