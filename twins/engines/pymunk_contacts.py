"""Contacts of one pymunk space: which bodies may touch, restitution, and detection of new contacts."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from math import inf
from typing import Any, Final

import pymunk

from twins.engines.engine import Touch

APART_S: Final = 0.1  # a shorter separation does not end a contact
CORRECTION: Final = 0.2  # share of an overlap that one step removes
SLOP: Final = 1e-4  # [m] overlap that is not corrected, so that resting bodies keep contact
AT_REST: Final = 1e-9  # [m/s], [N s] smaller values count as zero


@dataclass
class Layers:
    """Vertical extents of n robots and M obstacles, by number: rows, and −1 − k as in `Touch.second`."""

    bottom: list[float]  # (n + M + 1) [m]; negative numbers count from the end
    top: list[float]  # (n + M + 1) [m]


@dataclass
class Contacts:
    """Contact handling of one space.

    Pymunk detects a contact only when bodies overlap already: at 0.5 m/s and steps of 5 ms that is 2.5 mm too late. Its
    shapes therefore have a skin, in which a contact is detected without force. Bodies that would overlap at the end of
    a step bounce in the skin; bodies that keep pushing approach until they just touch.
    """

    numbers: dict[pymunk.Shape, int]  # row of each shape, or negative number of an obstacle
    layers: Layers  # only bodies that overlap in height touch; updated by the engine
    step: float  # [s]
    skin: float  # skin of each shape [m]
    restitution: float  # factor of an impact; bodies that keep pushing do not bounce
    slide: float  # speed at which bodies that overlapped from above separate [m/s]
    found: list[Touch]  # new contacts; the engine's own list
    time: float = 0.0  # time of the step, since the engine was built [s]; set by the engine
    _last: dict[tuple[int, int], float] = field(default_factory=dict)  # time of each pair's last contact
    _fresh: dict[tuple[int, int], float] = field(default_factory=dict)  # overlaps of pairs that may begin to touch

    def attach(self, space: pymunk.Space) -> None:
        """Install the callbacks in a space."""
        space.collision_slop = 2.0 * self.skin + SLOP
        space.collision_bias = (1.0 - CORRECTION) ** (1.0 / self.step)
        space.on_collision(pre_solve=self._pre_solve, post_solve=self._post_solve)

    def reset_rows(self, rows: Iterable[int]) -> None:
        """Forget earlier contacts of rows that were moved to another place."""
        gone = set(rows)
        for pair in [pair for pair in self._last if not gone.isdisjoint(pair)]:
            del self._last[pair]

    def _pre_solve(self, arbiter: pymunk.Arbiter, _space: pymunk.Space, _data: Any) -> None:  # noqa: ANN401 - pymunk's
        one, other = arbiter.shapes
        a, b = self.numbers[one], self.numbers[other]
        bottom, top = self.layers.bottom, self.layers.top
        apart = top[a] <= bottom[b] or top[b] <= bottom[a]
        arbiter.process_collision = not apart
        if apart or (a < 0 and b < 0):
            return
        contacts = arbiter.contact_point_set
        point = contacts.points[0]  # the only point, because one shape is a disc
        gap = point.distance + 2.0 * self.skin
        nx, ny = contacts.normal
        (ux, uy), (vx, vy) = _velocity(one, point.point_a), _velocity(other, point.point_b)
        closing = (ux - vx) * nx + (uy - vy) * ny
        touching = gap <= SLOP
        if not touching and abs(closing) < AT_REST:
            arbiter.process_collision = False
            return
        meets = closing * self.step > gap
        pair = _pair(a, b)
        new = self.time - self._last.get(pair, -inf) > APART_S
        if new:
            self._fresh[pair] = max(-gap, 0.0)
        elif meets or touching:
            self._last[pair] = self.time
        if touching:
            self._limit_depth(arbiter, contacts, gap)
        if new and meets:
            arbiter.restitution = self.restitution
        elif touching:
            arbiter.restitution = 0.0
        else:
            # a negative restitution leaves just the speed that closes the gap by the end of the step
            arbiter.restitution = -gap / (self.step * closing)

    def _limit_depth(self, arbiter: pymunk.Arbiter, contacts: pymunk.ContactPointSet, gap: float) -> None:
        """Limit the depth of an overlap, so that bodies separate at the speed `slide` instead of being thrown apart."""
        deepest = SLOP + self.slide * self.step / CORRECTION
        if -gap > deepest:
            point = contacts.points[0]
            point.point_a = point.point_b + contacts.normal * (deepest + 2.0 * self.skin)
            arbiter.contact_point_set = contacts

    def _post_solve(self, arbiter: pymunk.Arbiter, _space: pymunk.Space, _data: Any) -> None:  # noqa: ANN401 - likewise
        if not self._fresh:
            return
        one, other = arbiter.shapes
        pair = _pair(self.numbers[one], self.numbers[other])
        overlap = self._fresh.pop(pair, None)
        if overlap is None:
            return
        impulse = arbiter.total_impulse.length
        if impulse > AT_REST or overlap > 0.0:
            self._last[pair] = self.time
            self.found.append(Touch(self.time, *pair, impulse, overlap))


def _pair(a: int, b: int) -> tuple[int, int]:
    """Pair with sorted rows, a row before an obstacle."""
    return (b, a) if a < 0 or 0 <= b < a else (a, b)


def _velocity(shape: pymunk.Shape, point: tuple[float, float]) -> tuple[float, float]:
    """Velocity of a point of a shape's body; a disc's rotation is ignored, because it closes no gap."""
    body = shape.body
    if body is None:
        return 0.0, 0.0
    if isinstance(shape, pymunk.Circle):
        return body.velocity
    return body.velocity_at_world_point(point)
