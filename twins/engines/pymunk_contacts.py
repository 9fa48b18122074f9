"""Which bodies of one pymunk space may touch, how gently, and what touched what."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from typing import Any, Final

import pymunk

from agents.arrays import Array
from twins.engines.engine import Touch

APART_S: Final = 0.1  # a pair that is apart for a shorter time has not ended its contact
CORRECTION: Final = 0.2  # share of an overlap that one step removes
SLOP: Final = 1e-4  # [m] overlap that is left alone, so that what rests against something keeps contact
AT_REST: Final = 1e-9  # [m/s], [N s] slower or weaker than this is nothing


@dataclass
class Layers:
    """Vertical extents of everything that can touch, by number: rows, and −1 − k as in `Touch.second`.

    Attributes:
        bottom: (n + M + 1,) [m]; negative numbers count from its end.
        top: (n + M + 1,) [m]
    """

    bottom: Array
    top: Array


@dataclass
class Contacts:
    """The contacts of one space.

    Pymunk finds a contact when bodies overlap already: at 0.5 m/s and steps of 5 ms that is 2.5 mm too late. Its
    shapes therefore carry a skin, in which a contact is known but not yet felt: bodies that would overlap at the end
    of a step bounce in it, and bodies that keep pushing are let come just so near that they touch.

    Attributes:
        numbers: Row (or negative number of an obstacle) of each shape.
        layers: Only bodies at one height touch; kept up to date by the engine.
        step: [s]
        skin: Of each shape [m].
        restitution: Of a blow; what keeps pushing does not bounce.
        slide: How fast bodies that got into one another from above slide apart [m/s].
        found: Contacts that began; the engine's own list.
        time: Of the step, since the engine was built [s]; set by the engine.
    """

    numbers: dict[pymunk.Shape, int]
    layers: Layers
    step: float
    skin: float
    restitution: float
    slide: float
    found: list[Touch]
    time: float = 0.0
    _last: dict[tuple[int, int], float] = field(default_factory=dict)  # when each pair touched last
    _fresh: dict[tuple[int, int], float] = field(default_factory=dict)  # overlaps of pairs that may begin to touch

    def watch(self, space: pymunk.Space) -> None:
        """Takes charge of the contacts of a space."""
        space.collision_slop = 2.0 * self.skin + SLOP
        space.collision_bias = (1.0 - CORRECTION) ** (1.0 / self.step)
        space.on_collision(pre_solve=self._before, post_solve=self._after)

    def forget(self, rows: list[int]) -> None:
        """Rows that were taken elsewhere begin their contacts anew."""
        gone = set(rows)
        for pair in [pair for pair in self._last if not gone.isdisjoint(pair)]:
            del self._last[pair]

    def _before(self, arbiter: pymunk.Arbiter, _space: pymunk.Space, _data: Any) -> None:  # noqa: ANN401 - pymunk's
        one, other = arbiter.shapes
        a, b = self.numbers[one], self.numbers[other]
        bottom, top = self.layers.bottom, self.layers.top
        apart = bool(top[a] <= bottom[b] or top[b] <= bottom[a])
        arbiter.process_collision = not apart
        if apart or (a < 0 and b < 0):
            return
        contacts = arbiter.contact_point_set
        point = contacts.points[0]  # one of the two is a disc: there is no second point
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
            self._hold_back(arbiter, contacts, gap)
        if new and meets:
            arbiter.restitution = self.restitution
        elif touching:
            arbiter.restitution = 0.0
        else:
            # a negative restitution leaves just the speed that closes the gap by the end of the step
            arbiter.restitution = -gap / (self.step * closing)

    def _hold_back(self, arbiter: pymunk.Arbiter, contacts: pymunk.ContactPointSet, gap: float) -> None:
        """Lets what is deep in something else come out as if it slid off a roof, not as from a spring."""
        deepest = SLOP + self.slide * self.step / CORRECTION
        if -gap > deepest:
            point = contacts.points[0]
            point.point_a = point.point_b + contacts.normal * (deepest + 2.0 * self.skin)
            arbiter.contact_point_set = contacts

    def _after(self, arbiter: pymunk.Arbiter, _space: pymunk.Space, _data: Any) -> None:  # noqa: ANN401 - likewise
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
    """The rows of a pair in their order, a row before an obstacle."""
    return (b, a) if a < 0 or 0 <= b < a else (a, b)


def _velocity(shape: pymunk.Shape, point: tuple[float, float]) -> tuple[float, float]:
    """Of a point of a shape's body; a disc's turning does not bring it nearer to anything."""
    body = shape.body
    if body is None:
        return 0.0, 0.0
    if isinstance(shape, pymunk.Circle):
        return body.velocity
    return body.velocity_at_world_point(point)
