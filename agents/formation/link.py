"""The target of a link, as a robot knows it, and the error that is left of it."""

from __future__ import annotations

from dataclasses import dataclass
from math import nan
from typing import Final

from agents.vectors import UNKNOWN, Vector, difference, norm

BY_DISTANCE: Final = 0  # what a link wants
BY_RELATIVE: Final = 1
BY_BEARING: Final = 2
BY_NOTHING: Final = 3  # a link alone


@dataclass(eq=False, slots=True)
class Link:
    """Target of one link from a sender j to the robot i: a distance, a relative position or a direction.

    It is stored in each form that follows from it. Formations that change write to it.
    """

    distance: float = nan  # d_ij [m]; NaN where only a direction is wanted
    gain: float = 1.0  # factor of the law
    relative: Vector = UNKNOWN  # wanted p_i − p_j [m]; NaN for distances and directions
    bearing: Vector = UNKNOWN  # unit vector along the wanted p_i − p_j, NaN where none; z alone NaN: seen from above
    wants: int = BY_DISTANCE  # one of BY_DISTANCE, BY_RELATIVE, BY_BEARING, BY_NOTHING


def target_error(apart: Vector, link: Link, wants: int) -> float:
    """Error [m] of a link with `apart` = p_i − p_j [m], for a kind of target; NaN without a target.

    |d − ‖x‖| for distances, ‖x − d‖ for relative positions, and the distance from the ray for directions.
    """
    if wants == BY_DISTANCE:
        return abs(link.distance - norm(apart))
    if wants == BY_RELATIVE:
        return norm(difference(apart, link.relative))
    return norm(from_ray(apart, link.bearing)) if wants == BY_BEARING else nan


def from_ray(apart: Vector, bearing: Vector) -> Vector:
    """Vector from the nearest point of the ray along the bearing to x; seen from above where the bearing is."""
    (x, y, z), (gx, gy, gz) = apart, bearing
    if gz != gz and gx == gx:  # noqa: PLR0124 - NaN
        z = gz = 0.0
    along = x * gx + y * gy + z * gz
    along = max(along, 0.0)
    return x - along * gx, y - along * gy, z - along * gz
