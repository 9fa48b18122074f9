"""The target of a link, as a robot knows it."""

from __future__ import annotations

from math import nan
from typing import Final

from agents.vectors import UNKNOWN, Vector

BY_DISTANCE: Final = 0  # what a link wants
BY_RELATIVE: Final = 1
BY_BEARING: Final = 2
BY_NOTHING: Final = 3  # a link alone


class Link:
    """Target of one link from a sender j to the robot i: a distance, a relative position or a direction.

    It is stored in each form that follows from it. Formations that change write to it.
    """

    __slots__ = ("bearing", "distance", "gain", "relative", "wants")

    distance: float  # d_ij [m]; NaN where only a direction is wanted
    gain: float  # of the law
    relative: Vector  # wanted p_i − p_j [m]; NaN for distances and directions
    bearing: Vector  # unit vector along the wanted p_i − p_j, NaN where none; z alone NaN: seen from above
    wants: int  # BY_DISTANCE, BY_RELATIVE, BY_BEARING or BY_NOTHING

    def __init__(
        self,
        distance: float = nan,
        gain: float = 1.0,
        relative: Vector = UNKNOWN,
        bearing: Vector = UNKNOWN,
        wants: int = BY_DISTANCE,
    ) -> None:
        self.distance, self.gain, self.relative, self.bearing, self.wants = distance, gain, relative, bearing, wants
