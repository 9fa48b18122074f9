"""Formations that change: targets that move smoothly from one shape to another, and links that come and go.

A robot subscribes to every possible neighbour; these functions decide which are neighbours now, from the robot's own
clock and the poses that it received, so that all decisions stay its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from agents.arrays import Array, Columns, Mask, norm
from agents.formation.graph import Links

ROUNDING_S = 1e-6  # decisions are multiples of a period that binary fractions miss by less than this


class NewTargets(Columns, frozen=True):
    """Targets of links (E) after a change; NaN where unchanged."""

    distance: Array  # (E,) [m]
    relative: Array  # (E, 3) [m]
    bearing: Array  # (E, 3)
    rise: Array  # (E,) height of the receiver above the sender [m], which no scale changes

    @classmethod
    def unchanged(cls, links: int) -> NewTargets:
        blank = np.full((links, 3), np.nan)
        return cls(blank[:, 0], blank, blank, np.zeros(links))


@dataclass(frozen=True)
class Change:
    """Transition of links to other targets, then scaling and turning of the whole shape."""

    at: float  # begin since the common start [s]
    over: float  # duration [s]; 0: at once
    to: NewTargets
    scale: float  # of the shape seen from above; heights are kept
    turn: float  # about the vertical, to the left [rad]


def progress(elapsed: Array, at: float, over: float) -> Array:
    """Progress of a change, 0 to 1: the polynomial of minimum jerk 10τ³ − 15τ⁴ + 6τ⁵."""
    if over <= 0.0:
        return np.asarray((elapsed >= at - ROUNDING_S).astype(float))
    share = np.minimum(np.maximum((elapsed - at) / over, 0.0), 1.0)
    return np.asarray(share**3 * (10.0 + share * (6.0 * share - 15.0)))


def changed_targets(links: Links, changes: Sequence[Change], elapsed: Array) -> Links:
    """Links with their targets `elapsed` (E,) [s] after the common start."""
    distance, relative, bearing = links.distance, links.relative, links.bearing
    for change in changes:
        share = progress(elapsed, change.at, change.over)
        if not share.any():
            continue
        grown = 1.0 + share * (change.scale - 1.0)
        distance = _scaled(_interpolated(distance, change.to.distance, share), grown, change.to.rise)
        if relative is not None:
            relative = _turned(_interpolated(relative, change.to.relative, share[:, None]), share * change.turn)
            relative = relative * np.stack([grown, grown, np.ones_like(grown)], axis=1)
        if bearing is not None:
            bearing = _turned(_toward_unit(bearing, change.to.bearing, share), share * change.turn)
            if relative is not None and change.scale != 1.0:
                length = norm(relative)
                follows = length > 0.0  # false for NaN: a bearing of its own is seen from above, and not scaled
                bearing = np.where(follows[:, None], relative / np.where(follows, length, 1.0)[:, None], bearing)
    return msgspec.structs.replace(links, distance=distance, relative=relative, bearing=bearing)


def _interpolated(old: Array, new: Array, share: Array) -> Array:
    return np.where(np.isnan(new), old, np.where(share >= 1.0, new, old + share * (new - old)))


def _toward_unit(old: Array, new: Array, share: Array) -> Array:
    """Directions at an even rate between old and new; opposite ones turn through the vertical plane between them."""
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
    """Lengths of links whose part in the plane is scaled and whose height difference is kept."""
    if (grown == 1.0).all():
        return distance
    return np.where(grown == 1.0, distance, np.sqrt(np.maximum(grown**2 * (distance**2 - rise**2), 0.0) + rise**2))


class Presence(Columns, frozen=True):
    """Times and distances at which links (E) exist."""

    since: Array  # (E,) begin since the common start [s]
    until: Array  # (E,) end [s]; infinity: never
    reach: Array  # (E,) distance below which a link begins [m]; infinity: any
    release: Array  # (E,) distance above which it ends [m]; the gap to `reach` prevents flicker

    def padded(self, more: int) -> Presence:
        """Presence with `more` links behind these, which always exist."""
        ever = np.full(more, np.inf)
        return Presence.joined([self, Presence(-ever, ever, ever, ever)])

    def planned_at(self, elapsed: float) -> Mask:
        """Links (E,) that exist at a time [s] whatever the distance of the robots."""
        return (self.since <= elapsed + ROUNDING_S) & (self.until > elapsed + ROUNDING_S) & np.isinf(self.reach)

    def present_now(self, elapsed: Array, apart: Array, were: Mask) -> Mask:
        """Links (E,) that exist now, of which some `were` (E,) at the last decision.

        `elapsed` (E,) [s] since the start by each receiver's clock; `apart` (E,) [m] are the robots, NaN where unknown.
        """
        planned = (elapsed >= self.since - ROUNDING_S) & (elapsed < self.until - ROUNDING_S)
        near = np.isinf(self.reach) | (apart <= np.where(were, self.release, self.reach))
        return np.asarray(planned & near)


class Reshaping:
    """Current links and targets of a formation that changes."""

    def __init__(self, links: Links, changes: Sequence[Change], presence: Presence | None) -> None:
        """Start from `links` (E) with the targets of the beginning."""
        self._given, self._changes, self._presence = links, tuple(changes), presence
        self.links = links
        self.present: Mask = np.ones(len(links), dtype=bool) if presence is None else presence.planned_at(0.0)

    def advance(self, since_start: Array, position: Array, sender_position: Array) -> None:
        """Advance to now: `since_start` (N,) [s], `position` (N, 3) of the rows and of the senders (E, 3) [m]."""
        elapsed = np.maximum(since_start[self._given.receiver], 0.0)
        if self._changes:
            self.links = changed_targets(self._given, self._changes, elapsed)
        if self._presence is not None:
            apart = norm(position[self._given.receiver] - sender_position)
            self.present = self._presence.present_now(elapsed, apart, self.present)
