"""The target of a link, as a robot knows it."""

from __future__ import annotations

from dataclasses import dataclass
from math import nan
from typing import Final

from agents.vectors import UNKNOWN, Vector

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
