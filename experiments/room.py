"""Is there room for a robot that begins to move while others do already."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

from agents.kinds import KINDS
from experiments.experiment import Robot
from experiments.seen import Seen
from experiments.succession import TWIN

MARGIN_M: Final = 0.1  # free space around a robot that begins to move


def in_the_way(
    name: str, place: Sequence[float], robots: Mapping[str, Robot], seen: Mapping[str, Seen], *, body_stays: bool
) -> str:
    """Who is too near to a place for a robot to begin there, however high; empty if nobody is.

    Args:
        name: Of the robot.
        place: x, y [m].
        robots: As they are now.
        seen: Where they were last.
        body_stays: Whether the body that had this name lies in the way as any other.
    """
    radius = KINDS[robots[name].kind].radius
    for other, known in seen.items():
        vanished = robots[other].body == TWIN and not known.alive  # it was but a part of its process
        if known.place is None or vanished or (other == name and (known.alive or not body_stays)):
            continue
        gap = math.dist(known.place[:2], place[:2]) - radius - KINDS[robots[other].kind].radius
        if gap < MARGIN_M:
            x, y = place[:2]
            return (
                f"{name} would begin at ({x:.2f}, {y:.2f}) m, {max(gap, 0.0):.2f} m from {other}: it needs "
                f"{MARGIN_M:g} m around it; move one of them, or wait"
            )
    return ""
