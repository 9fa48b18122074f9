"""Observations of learned policies: the same numbers in training and in flight, from the view of a robot."""

from __future__ import annotations

from collections.abc import Mapping, MutableSequence, Sequence
from dataclasses import dataclass
from math import cos, isfinite, pi, sin, tau
from typing import ClassVar, Final

from zenpark import NeighbourView, PluginError, View

SCAN: Final = "scan"  # nearness of what the range sensors see; `scan:8` has 8 sectors
MOST_SECTORS: Final = 360
# parts of the robot itself, and parts of each neighbour, each with its count of numbers
OWN: Final[Mapping[str, int]] = {
    "position": 2, "velocity": 2, "height": 1, "yaw": 2, "target": 2, "deviation": 1, "time": 1,
}  # fmt: skip
EACH: Final[Mapping[str, int]] = {"place": 2, "wanted": 2, "distance": 1, "moves": 2, "age": 1}


@dataclass(frozen=True)
class Observation:
    """Parts of an observation, in their order: those of the robot, then those of each of `places` neighbours."""

    own: tuple[str, ...] = ("position", "velocity")
    each: tuple[str, ...] = ("place", "wanted")
    places: int = 0

    FIXED: ClassVar = ("own", "each")

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
        return sum(EACH[part] for part in self.each)

    @property
    def size(self) -> int:
        """Count of all numbers."""
        return sum(_sectors(part) or OWN[part] for part in self.own) + self.width * self.places

    def of(self, view: View) -> list[float]:
        """Observation of the first neighbours; what is unknown, or not there, is 0."""
        found = [0.0] * self.size
        self.write(view, found, 0)
        return found

    def write(self, view: View, numbers: MutableSequence[float], k: int) -> None:
        """The same into `numbers`, all of them 0, from place `k` on; quiet without a scan."""
        for part in self.own:
            for value in of_robot(part, view):
                numbers[k] = value if isfinite(value) else 0.0
                k += 1
        place = 0
        for other in view.neighbours:
            if place < self.places:
                for part in self.each:
                    for value in of_neighbour(part, view, other):
                        numbers[k] = value if isfinite(value) else 0.0
                        k += 1
            place += 1  # noqa: SIM113 - quiet


def of_robot(part: str, view: View) -> Sequence[float]:  # noqa: PLR0911 - one for each part
    """Numbers of a part of the robot itself; quiet, except for scans."""
    x, y, z = view.position
    if part == "position":
        return x, y  # [m]
    if part == "velocity":
        return view.velocity[0], view.velocity[1]  # [m/s]
    if part == "height":
        return (z,)  # [m]
    if part == "yaw":
        return (cos(view.yaw), sin(view.yaw)) if isfinite(view.yaw) else (0.0, 0.0)
    if part == "target":
        return view.target[0] - x, view.target[1] - y  # place of its plan, seen from the robot [m]
    if part == "deviation":
        return (view.deviation,)  # error of what the neighbours believe [m]
    if part == "time":
        return (view.time,)  # time since the common start [s]
    return nearness(view, _sectors(part))


def of_neighbour(part: str, view: View, other: NeighbourView) -> tuple[float, ...]:
    """Numbers of a part of a neighbour; quiet."""
    x, y, _ = other.position
    if part == "place":
        return x - view.position[0], y - view.position[1]  # its believed place, seen from the robot [m]
    if part == "wanted":
        return -other.link.relative[0], -other.link.relative[1]  # likewise, by the target of the link
    if part == "distance":
        return (other.link.distance,)  # wanted [m]
    if part == "moves":
        return other.velocity[0], other.velocity[1]  # velocity in its last pose [m/s]
    return (other.age,)  # age of its last pose [s]


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
