"""Landing places of flying robots: not on a robot known to be below. Pure and row-wise.

A body lands straight down. A row that must land above another robot first moves aside at its height to the nearest free
place; then it lands.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from agents.arrays import Array, Index, Mask, norm, some
from agents.body.interface import BodyState
from agents.decision.assignment import Assignment
from agents.decision.lifecycle import LANDING, BodyCommands
from agents.safety.situation import Situation

NEAR: Final = 0.05  # [m] between surfaces, seen from above: with less a row does not land in place
ROOM: Final = 0.12  # [m] the same at the place aside
LOW: Final = 0.2  # [m] above the floor: from lower it lands in place
BESIDE: Final = 0.1  # [m] robots whose heights differ by less are in each other's way
SLOW: Final = 0.15  # [m/s] a row that moved aside lands when slower
PATIENCE_S: Final = 3.0  # [s] longest time to move aside
ROUNDING: Final = 1e-9
RINGS: Final = np.arange(0.05, 1.51, 0.05)  # [m] distances of tried places
WAYS: Final = np.arange(16) * (2.0 * np.pi / 16)  # [rad] and their directions


class Landing:
    """Rows on their way to a place where they can land."""

    def __init__(self, assignment: Assignment) -> None:
        """Of the rows of an assignment; the senders on their links, for the law or for avoidance, are considered."""
        rows, links = len(assignment.names), assignment.links
        self._assignment, self._receiver = assignment, links.receiver
        kinds = assignment.robot_kinds
        senders = [kinds[sender] for sender in links.sender.tolist()] if kinds else ()
        self._radius = np.array([kind.radius for kind in assignment.kinds])
        self._height = np.array([kind.height for kind in assignment.kinds])
        self._their_radius = np.array([kind.radius for kind in senders])
        self._their_height = np.array([kind.height for kind in senders])
        self._flies = np.array([kind.flies for kind in assignment.kinds])
        self._no_row: Mask = np.zeros(rows, dtype=bool)
        self.aside, self.any_aside = self._no_row, False  # (N,) rows that must land and are not at their place yet
        self.place: Array = np.full((rows, 3), np.nan)  # (N, 3) their landing place [m]
        self._until = np.full(rows, -np.inf)
        self._apart = np.full(len(links), np.inf)

    def filter_commands(self, now: Situation, commands: BodyCommands | None, phase: Index) -> BodyCommands | None:
        """Commands of the lifecycle without the landings that must wait, and with those that need not any more.

        A row whose `phase` (N,) is not landing any more stops moving aside. A row without a valid pose, or of a control
        loop that misses its ticks, lands in place.
        """
        t, state, where, neighbours = now.t, now.state, now.where, now.neighbours
        ordered = commands is not None and len(commands.land) > 0
        if not (ordered or self.any_aside):
            return commands
        self.place[~self.aside] = np.nan
        due = self.aside & (phase == LANDING)
        if commands is not None and ordered:
            due[commands.land] = True
            self._until[commands.land] = t + PATIENCE_S
        lost = neighbours.poses.silent
        place = neighbours.extrapolate_all(self._assignment.predictor, t)
        able = due & self._flies & state.flying & ~where.invalid & ~where.outside_wall & (t <= self._until)
        able &= (state.position[:, 2] > LOW) & (not now.health.loop_failing)
        self.aside = able & self._must_wait(state, place, lost)
        self.any_aside = some(self.aside)
        for row in np.flatnonzero(self.aside).tolist():
            self._choose(row, state.position[row], place, lost)
        lands = np.flatnonzero(due & ~self.aside)
        if commands is None:
            no_row = lands[:0]
            return BodyCommands(no_row, lands, no_row) if len(lands) else None
        return replace(commands, land=lands)

    def land_in_place(self) -> None:
        """Rows on their way aside land in place."""
        self.aside, self.any_aside = self._no_row, False

    def robot_below(self, row: int) -> str:
        """Robot below a row that moves aside, in words."""
        links = self._assignment.links
        mine: Index = np.flatnonzero(self._receiver == row)
        nearest = int(mine[self._apart[mine].argmin()])
        return f"{self._assignment.robots[links.sender[nearest]]}; it goes aside first"

    def _must_wait(self, state: BodyState, place: Array, lost: Mask) -> Mask:
        """Rows (N,) that would land on a robot, or still move."""
        row = self._receiver
        gap = norm(state.position[row, :2] - place[:, :2]) - self._radius[row] - self._their_radius
        under = (place[:, 2] <= state.position[row, 2] + self._height[row]) | lost  # lost ones may have come down
        self._apart = np.where(under & np.isfinite(gap), gap, np.inf)
        moving = self.aside & (norm(state.velocity) > SLOW)
        # a row on its way aside goes on until it has more room than would have sent it
        occupied = np.zeros(len(moving), dtype=bool)
        occupied[row[self._apart < np.where(self.aside[row], 0.5 * (NEAR + ROOM), NEAR)]] = True
        return np.asarray(occupied | moving)

    def _choose(self, row: int, here: Array, place: Array, lost: Mask) -> None:
        """Choose a place for a row, or keep its place while it is free."""
        mine = (self._receiver == row) & np.isfinite(place).all(axis=1)
        touching = self._radius[row] + self._their_radius[mine]
        others = place[mine]
        # it may fly over lower robots; those at its height are in the way, and higher ones may be landing
        lower = (others[:, 2] + self._their_height[mine] + BESIDE < here[2]) | lost[mine]
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
        if not len(free):  # no free place: land here
            self.place[row], self._until[row] = here, -np.inf
            return
        ring = free // len(WAYS)
        nearest = free[ring == ring[0]]
        self.place[row] = *tried[nearest[there[nearest].argmax()]], here[2]


def _passing(here: Array, there: Array, place: Array) -> Array:
    """Distances (C, K) of places (K, 2) from the straight ways from `here` (2,) to each of `there` (C, 2) [m]."""
    way = there - here
    off = place - here
    along = np.clip(way @ off.T / np.vecdot(way, way)[:, None], 0.0, 1.0)
    return norm(off[None] - along[..., None] * way[:, None])
