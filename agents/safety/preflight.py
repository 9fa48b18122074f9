"""Preflight checks: conditions for take-off, with the reason for each row that fails. Pure and row-wise."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from math import degrees
from typing import Final

import numpy as np

from agents.arrays import Array, Index, Mask, some
from agents.body.interface import BodyState
from agents.decision.assignment import Assignment
from agents.safety.detection import Separation, clock_off, clock_text, tilt_angle, tilted
from agents.safety.situation import Situation

LOST_S: Final = 0.5  # a ready robot whose check failed for this long is not ready any more
FLOOR_M: Final = 0.5  # largest height of a standing drone: positioning systems differ about the floor
REST_M_S: Final = 0.3  # and largest speed
LEVEL: Final = 0.35  # [rad] and largest tilt
WALL_M: Final = 0.05  # a place measured this far outside the arena may be inside
ABOVE_M: Final = 0.1  # [m] a robot higher than this is above one that stands,
BESIDE_M: Final = 0.1  # [m] unless there is more than this between the two, seen from above

Failing = tuple[Mask, Callable[[int], str]]  # rows (N,), and the reason of one


class Preflight:
    """Checks of N rows, and the duration of each row's failure."""

    def __init__(self, assignment: Assignment) -> None:
        self._limits, self._assignment = assignment.limits, assignment
        self._flies = np.array([kind.flies for kind in assignment.kinds])
        self._separation = Separation(assignment)
        radius = np.array([kind.radius for kind in assignment.kinds])
        theirs = np.array([kind.radius for kind in assignment.robot_kinds])
        # (E,) distance of the axes, seen from above, at which a take-off does not pass the sender of a link [m]
        self._beside = (
            BESIDE_M + radius[assignment.links.receiver] + (theirs[assignment.links.sender] if len(theirs) else 0.0)
        )
        self._other_starts = _other_starts(assignment)
        self._since = np.full(len(self._flies), np.inf)
        self._covered: Mask = np.zeros(len(self._flies), dtype=bool)  # (N,) drones with a robot above them

    def check(self, now: Situation, lacking: tuple[Mask, Callable[[int], Sequence[str]]]) -> dict[int, str]:
        """Rows that must not take off, each with the first reason.

        `lacking`: (N,) rows without a pose of a neighbour, and the names of the missing ones of a row.
        """
        failing: dict[int, str] = {}
        checks = [self._situation(now, lacking), self._at_start(now.state), self._at_rest(now.state), self._below(now)]
        if self._limits.separation is not None:
            checks.append(self._too_close(now, self._limits.separation))
        for rows, reason in chain.from_iterable(checks):
            for row in np.flatnonzero(rows).tolist():
                failing.setdefault(row, reason(row))
        return failing

    def lost(self, t: float, failing: dict[int, str]) -> Index:
        """Failing rows (K,) that have failed for so long that they are not ready any more."""
        rows = np.array(list(failing), dtype=np.intp)
        since = np.full(len(self._flies), np.inf)
        since[rows] = np.where(self._covered[rows], -np.inf, np.minimum(self._since[rows], t))  # these at once
        self._since = since
        return rows[t - since[rows] >= LOST_S]

    def _situation(self, now: Situation, lacking: tuple[Mask, Callable[[int], Sequence[str]]]) -> Iterator[Failing]:
        """Own position, neighbours, router, arena."""
        state, where = now.state, now.where
        known = np.isfinite(state.position).all(axis=1) & (now.t - state.time <= self._limits.own_silence_s)
        ahead = np.zeros(len(known)) if state.ahead is None else state.ahead

        def nowhere(row: int) -> str:
            if np.isnan(state.yaw[row]) and known[row]:
                return "it does not know which way it looks"
            off = clock_off(ahead, self._limits.own_silence_s)[row]
            return "no position of its own" + (f": {clock_text(self._assignment.names, ahead, row)}" if off else "")

        yield where.invalid, nowhere
        if any(refusals := state.refusals):
            yield np.array([bool(refusal) for refusal in refusals]), lambda row: refusals[row]
        waits, missing = lacking
        yield waits, lambda row: "never heard " + ", ".join(missing(row))
        if now.health.offline_since < np.inf:
            yield np.ones(len(self._flies), dtype=bool), lambda _: "no connection to a router"
        if not where.all_valid:
            yield where.excess > WALL_M, lambda row: f"it is {where.excess[row]:.2f} m outside the arena"

    def _at_start(self, state: BodyState) -> Iterator[Failing]:
        """Body where the experiment begins: swapped addresses or markers, and a wrong origin, show here."""
        start, limit = self._assignment.start, self._assignment.start_within
        if start is not None:
            away = np.hypot(*(state.position[:, :2] - start).T)  # NaN without a position, which has failed already
            text = "it is {:.2f} m from its start ({:g}, {:g}), more than {:g} m"
            yield away > limit, lambda row: text.format(away[row], *start[row], limit)
            taken = {
                row: names[int(apart.argmin())]
                for row, (names, places) in enumerate(self._other_starts)
                if len(names) and (apart := np.hypot(*(state.position[row, :2] - places).T)).min() < away[row]
            }
            if taken:
                rows = np.isin(np.arange(len(away)), list(taken))
                yield rows, lambda row: f"it stands where {taken[row]} begins: addresses or markers are swapped"

    def _at_rest(self, state: BodyState) -> Iterator[Failing]:
        flies, height, least = self._flies, state.position[:, 2], self._limits.battery_min
        yield flies & (height > FLOOR_M), lambda row: f"it does not stand on the floor, but at z = {height[row]:.2f} m"
        fast = flies & (np.vecdot(state.velocity, state.velocity) > REST_M_S**2)
        yield fast, lambda row: f"it is not at rest: {np.linalg.norm(state.velocity[row]):.2f} m/s"
        if state.attitude is not None:
            attitude = state.attitude
            leans = flies & tilted(attitude, LEVEL)
            yield leans, lambda row: f"it is not level: it leans {degrees(tilt_angle(attitude, row)):.0f}°"
        low = state.battery < least
        yield low, lambda row: f"its battery is at {state.battery[row]:.0%}, less than {least:.0%}"

    def _below(self, now: Situation) -> Iterator[Failing]:
        """Drones with a robot above them, where it was received last: a take-off passes all heights."""
        links, place = self._assignment.links, now.neighbours.poses.position
        off = place - now.state.position[links.receiver]
        near = (off[:, 2] > ABOVE_M) & (np.vecdot(off[:, :2], off[:, :2]) < self._beside**2)
        self._covered = np.zeros(len(self._flies), dtype=bool)
        if some(near):

            def reason(row: int) -> str:
                link = int(np.flatnonzero(near & (links.receiver == row))[0])
                return f"{self._assignment.robots[links.sender[link]]} is {off[link, 2]:.2f} m above it"

            self._covered[links.receiver[near]] = True
            self._covered &= self._flies
            yield self._covered, reason

    def _too_close(self, now: Situation, limit: float) -> Iterator[Failing]:
        apart = self._separation.distances(now.t, now.state.position, now.neighbours)
        near = apart < limit
        if some(near):

            def reason(row: int) -> str:
                distance, other = self._separation.nearest_robot(row, apart)
                return f"it is {distance:.2f} m from {other}, nearer than {limit:g} m"

            rows = np.zeros(len(self._flies), dtype=bool)
            rows[self._assignment.links.receiver[near]] = True
            yield rows, reason


def _other_starts(assignment: Assignment) -> list[tuple[list[str], Array]]:
    """Other robots that begin beside each row, not at its own start, and where (K, 2) [m]; none without starts."""
    starts, names, kinds = assignment.all_starts, assignment.robots, assignment.robot_kinds
    if starts is None or assignment.start is None:
        return []
    found = []
    for row, here in enumerate(assignment.start):
        touching = [assignment.kinds[row].radius + kind.radius for kind in kinds[: len(starts)]]
        others = np.flatnonzero(np.hypot(*(starts - here).T) > touching)
        found.append(([names[other] for other in others], starts[others]))
    return found
