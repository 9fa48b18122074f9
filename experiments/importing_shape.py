"""The shape that a Robotic Park experiment asks for, and the heights at which its drones are to hold it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from agents.kinds import KINDS
from agents.rows import Array, Mask
from experiments.placing import Wanted, placed
from experiments.robotic_park import Park, Robot, Task

MET: Final = 0.01  # [m] what is missed by more is another shape
LOWEST: Final = 0.3  # [m] of a drone
ALOFT: Final = 0.7  # [m] where drones hover whose pose has no height, as in the authors' files
MOVED: Final = 0.02  # [m] a height that is another than at the start
SPACING: Final = 0.6  # [m] between robots whose start is made up


@dataclass
class Notes:
    """What could not be carried over, each once."""

    said: list[str] = field(default_factory=list)

    def say(self, note: str) -> None:
        """Adds a note."""
        if note not in self.said:
            self.said.append(note)


@dataclass(frozen=True)
class Heights:
    """Where N robots start and are to be.

    Attributes:
        start: (N, 3) [m]; z is where drones were to begin.
        shape: (N, 3) [m].
        hover: (N,) heights that are held [m]; 0 on the floor.
        anchored: Whether distances to the origin agree with the others, and are carried over.
        centre: What becomes of the origin [m].
    """

    start: Array
    shape: Array
    hover: Array
    anchored: bool
    centre: tuple[float, float, float]


def tasks(park: Park) -> Iterator[tuple[Robot, Task]]:
    """Robots that have one."""
    for robot in park.robots:
        if robot.task is not None:
            yield robot, robot.task


def heights_of(park: Park, notes: Notes) -> Heights:
    """The heights, from the shape in space if links tell one.

    The origin of their files is a point about which drones spread while they climb: where the shape is not flat, no
    robot stands on the floor and the origin is not told otherwise, the whole is lifted so that the lowest drone keeps
    the height at which it starts.
    """
    flies = np.array([KINDS[robot.kind].flies for robot in park.robots])
    start = _starts(park, notes)
    start[~flies, 2] = 0.0
    start[flies & (start[:, 2] < LOWEST), 2] = ALOFT
    wanted = _wanted(park, start, flies)
    plain = Heights(start, start, np.round(start[:, 2], 3), len(wanted.pairs) == 0, (0.0, 0.0, 0.0))
    if not len(wanted.pairs):
        return plain
    told = any(relation.centre is not None for _, task in tasks(park) for relation in task.relations)
    found, anchored = placed(wanted, start, flies), len(wanted.row) > 0
    off = found.worst
    if anchored and off > MET:
        found, anchored = placed(wanted.without_points(), start, flies), False
        if found.links <= MET:
            notes.say(
                "distances to the origin: no shape was found that meets them and those between robots; the best one"
                f" misses by {1e3 * off:.0f} mm, so those to the origin are left out"
            )
    if found.links > MET:
        notes.say(
            f"the distances: no shape was found that meets them, even in space; the best one misses by"
            f" {1e3 * found.links:.0f} mm, so drones hold the heights at which they start"
        )
        return plain
    shape, lift = found.position, 0.0
    flat = not (np.abs(shape[:, 2] - start[:, 2])[flies] > MOVED).any()
    if flies.all() and not told and not flat:
        lift = float(start[:, 2].min() - shape[:, 2].min())
        shape = shape + np.array([0.0, 0.0, lift])
    hover = np.where(flies, np.round(shape[:, 2], 3), 0.0)
    if hover[flies].min(initial=LOWEST) < LOWEST:
        notes.say(f"the shape needs a drone at {hover[flies].min():.2f} m: drones hold the heights of their starts")
        return replace(plain, anchored=False)
    if (np.abs(hover - start[:, 2])[flies] > MOVED).any():
        notes.say(
            "their drones climb while they form the shape, zenpark's hold a height: each takes off to that which it has"
            " in the shape"
        )
    if anchored and abs(lift) > MOVED:
        notes.say(f"the origin: lifted to {lift:.2f} m, so that the lowest drone hovers where it was to start")
    return Heights(start, shape, hover, anchored, (0.0, 0.0, round(lift, 3)))


def _starts(park: Park, notes: Notes) -> Array:
    """Starts (N, 3) [m]; robots whose start is not told stand on a ring, in the order of the file."""
    count = len(park.robots)
    angle = 2.0 * np.pi * np.arange(count) / max(count, 1)
    radius = max(SPACING, count * SPACING / (2.0 * np.pi))
    ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)]).round(2)
    lost = [robot.name for robot in park.robots if robot.pose is None]
    if lost:
        notes.say(
            f"starts: the file has none for {', '.join(lost)}; MADE UP here, on a ring; name a file that has them with"
            " --poses (an index of robots, a Webots world or a table)"
        )
    return np.array([ring[row] if robot.pose is None else robot.pose for row, robot in enumerate(park.robots)])


def _wanted(park: Park, start: Array, flies: Mask) -> Wanted:
    row = {robot.name: number for number, robot in enumerate(park.robots)}
    pairs, distance, relative = [], [], []
    anchored, point, radius = [], [], []
    for robot, task in tasks(park):
        i = row[robot.name]
        for relation in task.relations:
            if relation.name in row:
                j = row[relation.name]
                pairs.append((i, j))
                distance.append(relation.values[0] if task.kind == "distance" else np.nan)
                x, y, z = (*relation.values, 0.0, 0.0)[:3]
                level = start[i, 2] - start[j, 2]
                relative.append((x, y, z if flies[i] or flies[j] else level))
            elif relation.name == "origin" and len(relation.values) == 1:
                anchored.append(i)
                point.append(relation.centre or (0.0, 0.0, 0.0))
                radius.append(relation.values[0])
    return Wanted(
        np.array(pairs, dtype=np.intp).reshape(-1, 2),
        np.array(distance, dtype=float),
        np.array(relative, dtype=float).reshape(-1, 3),
        np.array(anchored, dtype=np.intp),
        np.array(point, dtype=float).reshape(-1, 3),
        np.array(radius, dtype=float),
    )
