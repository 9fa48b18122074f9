"""Landing places of flying robots: not on a robot known to be below.

A body lands straight down. A robot that must land above another one first moves aside at its height to the nearest free
place; then it lands. None of it runs on quiet ticks.
"""

from __future__ import annotations

from math import cos, hypot, inf, pi, sin
from typing import Final, NamedTuple

from agents.decision.assignment import Assignment
from agents.decision.neighbours import Neighbours
from agents.decision.situation import ProcessHealth, Situation
from agents.vectors import UNKNOWN, clamp, is_finite, norm, planar

NEAR: Final = 0.05  # [m] distance of surfaces, seen from above: with less a robot does not land in place
ROOM: Final = 0.12  # [m] the same at the place aside
LOW: Final = 0.2  # [m] height above the floor: from lower it lands in place
BESIDE: Final = 0.1  # [m] smallest difference of heights at which robots are not in each other's way
SLOW: Final = 0.15  # [m/s] a robot that moved aside lands when slower
PATIENCE_S: Final = 3.0  # [s] longest time to move aside
ROUNDING: Final = 1e-9
RINGS: Final = tuple(0.05 * k for k in range(1, 31))  # [m] distances of tried places
WAYS: Final = tuple((cos(k * pi / 8), sin(k * pi / 8)) for k in range(16))  # directions of tried places


class Occupied(NamedTuple):
    """Place of another robot."""

    x: float  # [m]
    y: float  # [m]
    touching: float  # distance of the axes at which both touch [m]
    gap: float  # distance of surfaces, seen from above [m]
    lower: bool  # it may be flown over


class Landing:
    """Robot on its way to a place where it can land."""

    def __init__(self, assignment: Assignment) -> None:
        """Of a robot; the senders on its links, for the law or for avoidance, are considered."""
        self._assignment = assignment
        self.aside = False  # it must land and is not at its place yet
        self.place = UNKNOWN  # its landing place [m], NaN: none
        self._until = -inf  # time at which it lands in place [s]
        self._nearest = ""  # robot below it

    def filter_land(
        self, now: Situation, neighbours: Neighbours, health: ProcessHealth, *, ordered: bool, landing: bool
    ) -> bool:
        """Whether the body is to land now.

        `ordered`: the lifecycle would have it land on this tick. A robot that is not `landing` any more stops moving
        aside. One without a valid pose, or of a control loop that misses its ticks, lands in place.
        """
        due = ordered or (self.aside and landing)
        if not self.aside:
            self.place = UNKNOWN
        if ordered:
            self._until = now.t + PATIENCE_S
        able = due and self._assignment.kind.flies and now.state.flying and now.t <= self._until
        able = able and now.position[2] > LOW and not (now.invalid or now.outside_wall or health.loop_failing)
        self.aside = able and self._must_wait(now, neighbours)
        if self.aside:
            self._choose(now, neighbours)
        return due and not self.aside

    def robot_below(self) -> str:
        """Robot below one that moves aside, in words."""
        return f"{self._nearest}; it goes aside first"

    def _must_wait(self, now: Situation, neighbours: Neighbours) -> bool:
        """Whether it would land on a robot, or still moves."""
        kind, least = self._assignment.kind, inf
        for sender in neighbours.all:
            place = sender.place(self._assignment.predictor, now.t)
            gap = planar(now.position, place) - kind.radius - sender.radius
            # lost ones may have come down
            if gap < least and (place[2] <= now.position[2] + kind.height or sender.silent):
                least, self._nearest = gap, sender.name
        # on its way aside it goes on until it has more room than would have sent it
        occupied = least < (0.5 * (NEAR + ROOM) if self.aside else NEAR)
        return occupied or (self.aside and norm(now.velocity) > SLOW)

    def _choose(self, now: Situation, neighbours: Neighbours) -> None:
        """Choose a place, or keep the place while it is free."""
        kind, limits = self._assignment.kind, self._assignment.limits
        x, y, z = now.position
        others = []
        for sender in neighbours.all:
            place = sender.place(self._assignment.predictor, now.t)
            if is_finite(place):
                touching = kind.radius + sender.radius
                # it may fly over lower robots; those at its height are in the way, and higher ones may be landing
                lower = place[2] + sender.height + BESIDE < z or sender.silent
                gap = hypot(place[0] - x, place[1] - y) - touching
                others.append(Occupied(place[0], place[1], touching, gap, lower))
        if is_finite(self.place) and _room(x, y, self.place[0], self.place[1], others) > NEAR:
            return
        wall = limits.margin + kind.radius
        for ring in RINGS:
            best = ROOM
            for cosine, sine in WAYS:
                there_x, there_y = x + ring * cosine, y + ring * sine
                inside = limits.low[0] + wall < there_x < limits.high[0] - wall
                if not (inside and limits.low[1] + wall < there_y < limits.high[1] - wall):
                    continue
                room = _room(x, y, there_x, there_y, others)
                if room > best:
                    best, self.place = room, (there_x, there_y, z)
            if best > ROOM:
                return
        self.place, self._until = now.position, -inf  # no free place: land here


def _room(x: float, y: float, there_x: float, there_y: float, others: list[Occupied]) -> float:
    """Least gap at a place to fly to from x, y [m]; −inf where the way there is barred."""
    least = inf
    way_x, way_y = there_x - x, there_y - y
    squared = way_x * way_x + way_y * way_y
    for other in others:
        if not other.lower:
            off_x, off_y = other.x - x, other.y - y
            along = clamp((way_x * off_x + way_y * off_y) / squared, 0.0, 1.0) if squared > 0.0 else 0.0
            passing = hypot(off_x - along * way_x, off_y - along * way_y) - other.touching
            if not passing >= min(other.gap, NEAR) - ROUNDING:
                return -inf
        least = min(least, hypot(there_x - other.x, there_y - other.y) - other.touching)
    return least
