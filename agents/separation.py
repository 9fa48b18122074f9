"""How far rows are from the robots that they hear, for `safety.separation`."""

from __future__ import annotations

import numpy as np

from agents.assignment import Assignment
from agents.hearing import Hearing
from agents.rows import Array, Index, Mask, norm


class Separation:
    """Distances on all links (E) of rows to those whom they hear, whether the law or only avoidance listens there.

    Attributes:
        touching: (E,) distance of the axes at which two upright robots side by side touch [m].
    """

    def __init__(self, assignment: Assignment) -> None:
        """Of the rows of an assignment."""
        self._assignment, links = assignment, assignment.links
        own = np.array([kind.radius for kind in assignment.kinds])
        theirs = np.array([kind.radius for kind in assignment.speaker_kinds])
        self.touching = own[links.listener] + (theirs[links.speaker] if len(theirs) else 0.0)

    def distances(self, t: float, position: Array, hearing: Hearing) -> Array:
        """From rows at `position` (N, 3) to where others are believed to be at `t` [s]: (E,) [m].

        Infinite where nothing was heard, the own position is unknown, or the other is gone for long.
        """
        assignment = self._assignment
        believed = hearing.everywhere(assignment.predictor, t)
        apart = norm(position[assignment.links.listener] - believed)
        there = np.isfinite(apart) & (t - hearing.heard.gone <= assignment.limits.link_silence_s)
        return np.where(there, apart, np.inf)

    def rows(self, which: Mask) -> Mask:
        """Rows (N,) of which a link is among `which` (E,)."""
        rows = np.zeros(len(self._assignment.names), dtype=bool)
        rows[self._assignment.links.listener[which]] = True
        return rows

    def nearest(self, row: int, distances: Array) -> tuple[float, str]:
        """How far the nearest robot is from a row [m], and its name."""
        links = self._assignment.links
        mine: Index = np.flatnonzero(links.listener == row)
        at = int(mine[distances[mine].argmin()])
        return float(distances[at]), self._assignment.speakers[links.speaker[at]]
