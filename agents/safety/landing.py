"""Where flying robots come down: not on whoever they know to be below them. Pure and row-wise.

A body lands straight down. A row that must land, and knows another robot to be below it, first goes aside at the height
that it has, to the nearest place where nobody is; then it lands.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from agents.arrays import Array, Index, Mask, norm, some
from agents.body.interface import BodyState
from agents.decision.assignment import Assignment
from agents.decision.lifecycle import LANDING, BodyCommands
from agents.decision.neighbours import NeighbourStates
from agents.safety.setpoint_filter import PoseValidity

NEAR: Final = 0.05  # [m] between surfaces, seen from above: with less a row does not come down where it is,
ROOM: Final = 0.12  # and the place that it goes to has this much
LOW: Final = 0.2  # [m] from less than this above the floor it comes down where it is
BESIDE: Final = 0.1  # [m] robots whose heights differ by less are in each other's way
SLOW: Final = 0.15  # [m/s] a row that went aside comes down when it is slower than this
PATIENCE_S: Final = 3.0  # [s] for longer no row looks for a place
ROUNDING: Final = 1e-9
RINGS: Final = np.arange(0.05, 1.51, 0.05)  # [m] how far away places are tried,
WAYS: Final = np.arange(16) * (2.0 * np.pi / 16)  # [rad] and in which directions


class Landing:
    """Rows on their way to a place where they can come down.

    Attributes:
        aside: (N,) rows that must land and are not there yet.
        any_aside: Whether there are any.
        place: (N, 3) where they go [m].
    """

    def __init__(self, assignment: Assignment) -> None:
        """Of the rows of an assignment; whom they hear, for the law or to keep clear, they know of."""
        rows, links = len(assignment.names), assignment.links
        self._assignment, self._listener = assignment, links.receiver
        kinds = assignment.robot_kinds
        speaks = [kinds[speaker] for speaker in links.sender.tolist()] if kinds else ()
        self._radius = np.array([kind.radius for kind in assignment.kinds])
        self._height = np.array([kind.height for kind in assignment.kinds])
        self._their_radius = np.array([kind.radius for kind in speaks])
        self._their_height = np.array([kind.height for kind in speaks])
        self._flies = np.array([kind.flies for kind in assignment.kinds])
        self._nobody: Mask = np.zeros(rows, dtype=bool)
        self.aside, self.any_aside = self._nobody, False
        self.place = np.full((rows, 3), np.nan)
        self._until = np.full(rows, -np.inf)
        self._apart = np.full(len(links), np.inf)

    def filter_commands(
        self,
        t: float,
        duties: BodyCommands | None,
        state: BodyState,
        where: PoseValidity,
        *,
        hearing: NeighbourStates,
        late: bool,
        phase: Index,
    ) -> BodyCommands | None:
        """The duties of this tick, without the landings that have to wait, and with those that need not any more.

        Args:
            t: Now [s].
            duties: Of the phases.
            state: Of the bodies.
            where: What their poses are worth: a row that does not know where it is lands where it is.
            hearing: Who is where.
            late: Whether control loops miss so many ticks that nobody should go anywhere.
            phase: (N,) of the rows; one that does not land any more goes nowhere.
        """
        told = duties is not None and len(duties.land) > 0
        if not (told or self.any_aside):
            return duties
        self.place[~self.aside] = np.nan
        due = self.aside & (phase == LANDING)
        if duties is not None and told:
            due[duties.land] = True
            self._until[duties.land] = t + PATIENCE_S
        gone = hearing.poses.lost_since < np.inf
        place = hearing.extrapolate_all(self._assignment.predictor, t)
        able = due & self._flies & state.flying & ~where.invalid & ~where.outside_wall & (t <= self._until)
        able &= (state.position[:, 2] > LOW) & (not late)
        self.aside = able & self._must_wait(state, place, gone)
        self.any_aside = some(self.aside)
        for row in np.flatnonzero(self.aside).tolist():
            self._choose(row, state.position[row], place, gone)
        lands = np.flatnonzero(due & ~self.aside)
        if duties is None:
            nobody = lands[:0]
            return BodyCommands(nobody, lands, nobody) if len(lands) else None
        return replace(duties, land=lands)

    def land_in_place(self) -> None:
        """Whoever is on its way aside has been told to land where it is."""
        self.aside, self.any_aside = self._nobody, False

    def robot_below(self, row: int) -> str:
        """Who is below a row that goes aside, in words."""
        links = self._assignment.links
        mine: Index = np.flatnonzero(self._listener == row)
        nearest = int(mine[self._apart[mine].argmin()])
        return f"{self._assignment.robots[links.sender[nearest]]}; it goes aside first"

    def _under(self, row: Index | int, state_z: Array | float, place: Array, gone: Mask) -> Mask:
        """Of places (E, 3), which are those of robots under rows, or beside them: who is gone may have come down."""
        return np.asarray((place[:, 2] <= state_z + self._height[row]) | gone)

    def _must_wait(self, state: BodyState, place: Array, gone: Mask) -> Mask:
        """Rows (N,) that would come down on somebody, or still move."""
        row = self._listener
        gap = norm(state.position[row, :2] - place[:, :2]) - self._radius[row] - self._their_radius
        under = self._under(row, state.position[row, 2], place, gone)
        self._apart = np.where(under & np.isfinite(gap), gap, np.inf)
        moving = self.aside & (norm(state.velocity) > SLOW)
        # who is on its way goes on until there is more room than would have made it go
        occupied = np.zeros(len(moving), dtype=bool)
        occupied[row[self._apart < np.where(self.aside[row], 0.5 * (NEAR + ROOM), NEAR)]] = True
        return np.asarray(occupied | moving)

    def _choose(self, row: int, here: Array, place: Array, gone: Mask) -> None:
        """Gives a row a place, or keeps the one that it has while it is free."""
        mine = (self._listener == row) & np.isfinite(place).all(axis=1)
        touching = self._radius[row] + self._their_radius[mine]
        others = place[mine]
        # over those that are lower it may fly; who is as high is in the way, and who is higher may be coming down
        lower = (others[:, 2] + self._their_height[mine] + BESIDE < here[2]) | gone[mine]
        gap = norm(others[:, :2] - here[:2]) - touching

        def room(tried: Array) -> Array:
            """Of places (C, 2): the least gap there (C,) [m], none where the way there is barred."""
            passing = _passing(here[:2], tried, others[~lower, :2]) - touching[~lower]
            open_way = (passing >= np.minimum(gap[~lower], NEAR) - ROUNDING).all(axis=1)
            apart = (norm(tried[:, None] - others[None, :, :2]) - touching).min(axis=1, initial=np.inf)
            return np.where(open_way, apart, -np.inf)

        if np.isfinite(self.place[row]).all() and room(self.place[row : row + 1, :2])[0] > NEAR:
            return
        ways = RINGS[:, None, None] * np.stack([np.cos(WAYS), np.sin(WAYS)], axis=1)
        tried = here[:2] + ways.reshape(-1, 2)
        limits = self._assignment.limits
        wall = limits.margin + self._radius[row]
        inside = ((tried > limits.low[:2] + wall) & (tried < limits.high[:2] - wall)).all(axis=1)
        there = np.where(inside, room(tried), -np.inf)
        free = np.flatnonzero(there > ROOM)
        if not len(free):  # nowhere: down
            self.place[row], self._until[row] = here, -np.inf
            return
        ring = free // len(WAYS)
        nearest = free[ring == ring[0]]
        self.place[row] = *tried[nearest[there[nearest].argmax()]], here[2]


def _passing(here: Array, there: Array, place: Array) -> Array:
    """How near (C, K) the straight ways from `here` (2,) to each of `there` (C, 2) come to places (K, 2) [m]."""
    way = there - here
    off = place - here
    along = np.clip(way @ off.T / np.vecdot(way, way)[:, None], 0.0, 1.0)
    return norm(off[None] - along[..., None] * way[:, None])
