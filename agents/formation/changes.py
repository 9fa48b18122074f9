"""Formations that change: targets that go smoothly from one shape to another, and links that come and go.

A robot subscribes to everybody who may become its neighbour; here it is decided who is one now, from its own clock and
from what it has heard, so that all of a robot's decisions stay its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from agents.arrays import Array, Index, Mask, norm
from agents.formation.graph import Links

ROUNDING_S = 1e-6  # decisions are multiples of a period that binary fractions miss by less than this


@dataclass(frozen=True)
class Change:
    """From `at` on, within `over` seconds, links go to other targets; then the whole is scaled and turned.

    Attributes:
        at: Since the common start [s].
        over: How long it takes [s]; 0: at once.
        distance: (E,) new [m], NaN where it stays.
        relative: (E, 3) new [m], NaN where it stays.
        bearing: (E, 3) new, NaN where it stays.
        scale: Of the shape seen from above; heights are held.
        turn: About the vertical, to the left [rad].
        rise: (E,) height of the listener above the speaker [m], which no scale changes.
    """

    at: float
    over: float
    distance: Array
    relative: Array
    bearing: Array
    scale: float
    turn: float
    rise: Array

    def select(self, which: Index) -> Change:
        """Of some links."""
        return replace(
            self,
            distance=self.distance[which],
            relative=self.relative[which],
            bearing=self.bearing[which],
            rise=self.rise[which],
        )

    def padded(self, more: int) -> Change:
        """For links behind these, which stay."""
        blank = np.full((more, 3), np.nan)
        return replace(
            self,
            distance=np.concatenate([self.distance, blank[:, 0]]),
            relative=np.concatenate([self.relative, blank]),
            bearing=np.concatenate([self.bearing, blank]),
            rise=np.concatenate([self.rise, np.zeros(more)]),
        )


def progress(elapsed: Array, at: float, over: float) -> Array:
    """How far a change has come, 0 to 1: the polynomial of minimum jerk 10τ³ − 15τ⁴ + 6τ⁵."""
    if over <= 0.0:
        return np.asarray((elapsed >= at - ROUNDING_S).astype(float))
    share = np.minimum(np.maximum((elapsed - at) / over, 0.0), 1.0)
    return np.asarray(share**3 * (10.0 + share * (6.0 * share - 15.0)))


def changed_targets(links: Links, changes: Sequence[Change], elapsed: Array) -> Links:
    """The links with the targets of now, `elapsed` (E,) seconds after the common start."""
    distance, relative, bearing = links.distance, links.relative, links.bearing
    for change in changes:
        share = progress(elapsed, change.at, change.over)
        if not share.any():
            continue
        grown = 1.0 + share * (change.scale - 1.0)
        distance = _scaled(_toward(distance, change.distance, share), grown, change.rise)
        if relative is not None:
            relative = _turned(_toward(relative, change.relative, share[:, None]), share * change.turn)
            relative = relative * np.stack([grown, grown, np.ones_like(grown)], axis=1)
        if bearing is not None:
            bearing = _turned(_toward_unit(bearing, change.bearing, share), share * change.turn)
            if relative is not None and change.scale != 1.0:
                length = norm(relative)
                follows = length > 0.0  # false for NaN: a bearing of its own is seen from above, and not scaled
                bearing = np.where(follows[:, None], relative / np.where(follows, length, 1.0)[:, None], bearing)
    return replace(links, distance=distance, relative=relative, bearing=bearing)


def _toward(old: Array, new: Array, share: Array) -> Array:
    return np.where(np.isnan(new), old, np.where(share >= 1.0, new, old + share * (new - old)))


def _toward_unit(old: Array, new: Array, share: Array) -> Array:
    """Between two directions at an even rate, and over the vertical plane between them if they are opposite."""
    changed = np.isfinite(new[:, 0])
    if not changed.any():
        return old
    angle_old, angle_new = np.arctan2(old[:, 1], old[:, 0]), np.arctan2(new[:, 1], new[:, 0])
    angle = angle_old + share * np.remainder(angle_new - angle_old + np.pi, 2.0 * np.pi) - share * np.pi
    rise_old, rise_new = np.arcsin(np.clip(old[:, 2], -1, 1)), np.arcsin(np.clip(new[:, 2], -1, 1))
    rise = rise_old + share * (rise_new - rise_old)
    level = np.where(np.isnan(rise), 1.0, np.cos(rise))
    between = np.stack([level * np.cos(angle), level * np.sin(angle), np.sin(rise)], axis=1)
    return np.where(changed[:, None], between, old)


def _turned(vectors: Array, angle: Array) -> Array:
    cos, sin = np.cos(angle), np.sin(angle)
    x, y, z = vectors.T
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=1)


def _scaled(distance: Array, grown: Array, rise: Array) -> Array:
    """Lengths of links whose part in the plane grows and whose heights are held."""
    if (grown == 1.0).all():
        return distance
    return np.where(grown == 1.0, distance, np.sqrt(np.maximum(grown**2 * (distance**2 - rise**2), 0.0) + rise**2))


@dataclass(frozen=True)
class Presence:
    """When and how near two robots must be to be neighbours: links (E) that come and go.

    Attributes:
        since: (E,) from when on, since the common start [s].
        until: (E,) when no more [s]; infinity: to the end.
        reach: (E,) nearer than this they become neighbours [m]; infinity: however far.
        release: (E,) farther than this they are no more [m]; the gap to `reach` keeps a link from flickering.
    """

    since: Array
    until: Array
    reach: Array
    release: Array

    def select(self, which: Index) -> Presence:
        """Of some links."""
        return Presence(self.since[which], self.until[which], self.reach[which], self.release[which])

    def padded(self, more: int) -> Presence:
        """For links behind these, which are always there."""
        ever = np.full(more, np.inf)
        columns = ((self.since, -ever), (self.until, ever), (self.reach, ever), (self.release, ever))
        return Presence(*(np.concatenate(both) for both in columns))

    def present_at_start(self) -> Mask:
        """Which links are there before anybody knows how far the others are."""
        return self.planned_at(0.0)

    def planned_at(self, elapsed: float) -> Mask:
        """Which links are there at a time [s], however far apart the robots are."""
        return (self.since <= elapsed + ROUNDING_S) & (self.until > elapsed + ROUNDING_S) & np.isinf(self.reach)

    def present_now(self, elapsed: Array, apart: Array, were: Mask) -> Mask:
        """Which links are there (E,), `elapsed` (E,) [s] after the start, between robots that are `apart` (E,) [m].

        Args:
            elapsed: On each listener's clock.
            apart: NaN where unknown.
            were: Which were there at the last decision.
        """
        planned = (elapsed >= self.since - ROUNDING_S) & (elapsed < self.until - ROUNDING_S)
        near = np.isinf(self.reach) | (apart <= np.where(were, self.release, self.reach))
        return np.asarray(planned & near)


class Reshaping:
    """What a formation that changes asks of its links now."""

    def __init__(self, links: Links, changes: Sequence[Change], presence: Presence | None) -> None:
        """`links` (E) with the targets of the beginning."""
        self._given, self._changes, self._presence = links, tuple(changes), presence
        self.links = links
        self.present: Mask = np.ones(len(links), dtype=bool) if presence is None else presence.present_at_start()

    def advance(self, since_start: Array, position: Array, heard: Array) -> None:
        """On to now: `since_start` (N,) [s] of the rows, their `position` (N, 3), and what they `heard` (E, 3)."""
        elapsed = np.maximum(since_start[self._given.receiver], 0.0)
        if self._changes:
            self.links = changed_targets(self._given, self._changes, elapsed)
        if self._presence is not None:
            apart = norm(position[self._given.receiver] - heard)
            self.present = self._presence.present_now(elapsed, apart, self.present)
