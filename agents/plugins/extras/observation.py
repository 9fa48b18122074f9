"""Observations of learned policies: the same numbers in training and in flight, from the view of a robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import cos, isfinite, pi, sin, tau
from typing import Final

from zenpark import NeighbourView, PluginError, View

Numbers = tuple[float, ...]

SCAN: Final = "scan"  # nearness of what the range sensors see; `scan:8` has 8 sectors
MOST_SECTORS: Final = 360
# parts of the robot itself: count of numbers, and where they come from
OWN: Final[Mapping[str, tuple[int, Callable[[View], Numbers]]]] = {
    "position": (2, lambda view: view.position[:2]),  # [m]
    "velocity": (2, lambda view: view.velocity[:2]),  # [m/s]
    "height": (1, lambda view: view.position[2:]),  # [m]
    "yaw": (2, lambda view: (cos(view.yaw), sin(view.yaw)) if isfinite(view.yaw) else (0.0, 0.0)),
    # place of its plan, seen from the robot [m]
    "target": (2, lambda view: (view.target[0] - view.position[0], view.target[1] - view.position[1])),
    "deviation": (1, lambda view: (view.deviation,)),  # error of what the neighbours believe [m]
    "time": (1, lambda view: (view.time,)),  # time since the common start [s]
}
# parts of each neighbour
EACH: Final[Mapping[str, tuple[int, Callable[[View, NeighbourView], Numbers]]]] = {
    # where the robot believes it, seen from the robot [m]
    "place": (2, lambda view, of: (of.position[0] - view.position[0], of.position[1] - view.position[1])),
    "wanted": (2, lambda _, of: (-of.link.relative[0], -of.link.relative[1])),  # likewise, by the target of the link
    "distance": (1, lambda _, of: (of.link.distance,)),  # wanted [m]
    "moves": (2, lambda _, of: of.velocity[:2]),  # velocity in its last pose [m/s]
    "age": (1, lambda _, of: (of.age,)),  # age of its last pose [s]
}


@dataclass(frozen=True)
class Observation:
    """Parts of an observation, in their order: those of the robot, then those of each of `places` neighbours."""

    own: tuple[str, ...] = ("position", "velocity")
    each: tuple[str, ...] = ("place", "wanted")
    places: int = 0

    def __post_init__(self) -> None:
        for parts, known in ((self.own, (*OWN, f"{SCAN}:8")), (self.each, (*EACH,))):
            for part in parts:
                if part not in known and not _sectors(part):
                    raise PluginError(f"a policy cannot observe {part!r}; known: {', '.join(known)}")

    @classmethod
    def sized(cls, own: str, each: str, size: int) -> Observation:
        """Observation of `size` numbers with parts that are named in texts; raises PluginError if it has another size.

        For example `position velocity`, `place wanted`; empty for none.
        """
        found = cls(tuple(own.split()), tuple(each.split()))
        rest, width = size - found.size, found.width
        if rest < 0 or (rest % width if width else rest):
            raise PluginError(
                f"a policy that observes {own or 'nothing of itself'} ({found.size} numbers) and of each neighbour "
                f"{each or 'nothing'} ({width}) needs a model of {found.size} + {width}n inputs; this has {size}"
            )
        return cls(found.own, found.each, rest // width if width else 0)

    @property
    def width(self) -> int:
        """Count of numbers of a neighbour."""
        return sum(EACH[part][0] for part in self.each)

    @property
    def size(self) -> int:
        """Count of all numbers."""
        return sum(_sectors(part) or OWN[part][0] for part in self.own) + self.width * self.places

    def of(self, view: View) -> list[float]:
        """Observation of the first neighbours; what is unknown, or not there, is 0."""
        found: list[float] = []
        for part in self.own:
            sectors = _sectors(part)
            found += nearness(view, sectors) if sectors else OWN[part][1](view)
        for other in view.neighbours[: self.places]:
            for part in self.each:
                found += EACH[part][1](view, other)
        found += [0.0] * (self.size - len(found))
        return [each if isfinite(each) else 0.0 for each in found]


def nearness(view: View, sectors: int) -> list[float]:
    """1/distance of the nearest thing in each sector, from the nose to the left [1/m]; 0 where nothing is in reach."""
    found, scan = [0.0] * sectors, view.scan
    if scan is not None:
        for bearing, distance in zip(scan.bearing, scan.distance, strict=True):
            if isfinite(distance) and distance > 0.0:
                sector = int((bearing % tau + pi / sectors) % tau * sectors / tau) % sectors
                found[sector] = max(found[sector], 1.0 / distance)
    return found


def _sectors(part: str) -> int:
    """Count of sectors of the part `scan:COUNT`; 0 for another part, or for a count that cannot be."""
    name, _, count = part.partition(":")
    sectors = int(count) if name == SCAN and count.isdecimal() and len(count) < 4 else 0
    return sectors if sectors <= MOST_SECTORS else 0
