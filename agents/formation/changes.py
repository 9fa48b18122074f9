"""Formations that change: targets that move smoothly from one shape to another, and links that come and go.

A robot subscribes to every possible neighbour. These functions decide which are neighbours now, from the clock of the
robot and the poses that it received; all decisions stay local.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import asin, atan2, cos, inf, isnan, nan, pi, sin, sqrt, tau

import msgspec

from agents.formation.link import Link
from agents.ticks import ROUNDING_S
from agents.vectors import UNKNOWN, Vector, clamp, norm


class Change(msgspec.Struct, frozen=True):
    """Transition of all links to other targets, then scaling and turning of the whole shape."""

    at: float  # begin since the common start [s]
    over: float  # duration [s]; 0: at once
    scale: float  # scale of the shape seen from above; heights are kept
    turn: float  # turn about the vertical, to the left [rad]


class Target(msgspec.Struct, frozen=True):
    """Target of a link after a change; NaN where unchanged."""

    distance: float = nan  # [m]
    relative: Vector = UNKNOWN  # [m]
    bearing: Vector = UNKNOWN
    rise: float = 0.0  # height of the receiver above the sender [m], which no scale changes


def progress(elapsed: float, at: float, over: float) -> float:
    """Progress of a change, 0 to 1: the polynomial of minimum jerk 10τ³ − 15τ⁴ + 6τ⁵."""
    if over <= 0.0:
        return 1.0 if elapsed >= at - ROUNDING_S else 0.0
    share = min(max((elapsed - at) / over, 0.0), 1.0)
    return share * share * share * (10.0 + share * (6.0 * share - 15.0))


def change_target(
    link: Link, given: Link, changes: Sequence[Change], targets: Sequence[Target], elapsed: float
) -> bool:
    """Set the target of a `link` that began as `given` to what it is `elapsed` [s] after the common start.

    `targets` has its target after each change. Returns whether the target is another one than before.
    """
    distance, relative, bearing = given.distance, given.relative, given.bearing
    for change, to in zip(changes, targets, strict=True):
        share = progress(elapsed, change.at, change.over)
        if not share:
            continue
        grown = 1.0 + share * (change.scale - 1.0)
        distance = _scaled(_interpolated(distance, to.distance, share), grown, to.rise)
        between = _interpolated_vector(relative, to.relative, share)
        x, y, z = _turned(between, share * change.turn)
        relative = x * grown, y * grown, z
        bearing = _turned(_toward_unit(bearing, to.bearing, share), share * change.turn)
        length = norm(relative)
        if change.scale != 1.0 and length > 0.0:  # NaN: a bearing of its own is seen from above, and not scaled
            x, y, z = relative
            bearing = x / length, y / length, z / length
    changed = not (
        _same(distance, link.distance)
        and all(map(_same, relative, link.relative))
        and all(map(_same, bearing, link.bearing))
    )
    link.distance, link.relative, link.bearing = distance, relative, bearing
    return changed


def _same(old: float, new: float) -> bool:
    return old == new or (isnan(old) and isnan(new))


def _interpolated(old: float, new: float, share: float) -> float:
    if isnan(new):
        return old
    return new if share >= 1.0 else old + share * (new - old)


def _interpolated_vector(old: Vector, new: Vector, share: float) -> Vector:
    x, y, z = (_interpolated(a, b, share) for a, b in zip(old, new, strict=True))
    return x, y, z


def _toward_unit(old: Vector, new: Vector, share: float) -> Vector:
    """Direction at an even rate between old and new; opposite ones turn through the vertical plane between them."""
    if isnan(new[0]):
        return old
    angle_old, angle_new = atan2(old[1], old[0]), atan2(new[1], new[0])
    angle = angle_old + share * ((angle_new - angle_old + pi) % tau) - share * pi
    rise_old, rise_new = asin(clamp(old[2], -1.0, 1.0)), asin(clamp(new[2], -1.0, 1.0))
    rise = rise_old + share * (rise_new - rise_old)
    level = 1.0 if isnan(rise) else cos(rise)
    return level * cos(angle), level * sin(angle), sin(rise)


def _turned(vector: Vector, angle: float) -> Vector:
    x, y, z = vector
    c, s = cos(angle), sin(angle)
    return c * x - s * y, s * x + c * y, z


def _scaled(distance: float, grown: float, rise: float) -> float:
    """Length of a link with its part in the plane scaled and its height difference kept."""
    if grown == 1.0:
        return distance
    return sqrt(max(grown * grown * (distance * distance - rise * rise), 0.0) + rise * rise)


def planned_at(since: float, until: float, reach: float, elapsed: float) -> bool:
    """Whether a link exists `elapsed` [s] after the common start whatever the distance of the robots."""
    return since <= elapsed + ROUNDING_S and until > elapsed + ROUNDING_S and reach == inf


def exists(since: float, until: float, reach: float, elapsed: float, apart: float) -> bool:
    """Whether a link between robots that are `apart` [m], NaN where unknown, exists `elapsed` [s] after the start."""
    if not since - ROUNDING_S <= elapsed < until - ROUNDING_S:
        return False
    return reach == inf or apart <= reach
