"""The shape that a Robotic Park experiment asks for, and the heights at which its drones are to hold it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Final

import numpy as np

from agents.body.kinds import KINDS
from agents.formation.anchors import Anchor
from agents.formation.link import BY_DISTANCE, BY_RELATIVE
from experiments.authoring.robotic_park.file import ParkExperiment, ParkRobot, Relation
from experiments.check.motion import CLEARANCE
from experiments.check.realisation import Shape, Solids, find_shapes
from experiments.definition.formation import Anchored
from experiments.definition.graph import Links
from twins.arrays import Array, Mask, norm

BULGE: Final = 1.05  # radius of the dome, as a multiple of the farthest robot's distance from the middle
ATTEMPTS: Final = 40  # random beginnings
SPREAD: Final = (0.05, 0.1, 0.3, 0.6)  # [m] standard deviations of theirs
SHAPE_MET: Final = 0.01  # [m] a larger error is another shape
LOWEST: Final = 0.3  # [m] least height of a drone
ALOFT: Final = 0.7  # [m] height of drones with a pose without height, as in the authors' files
REAL_ORIGIN: Final = (0.0, 0.0, 0.8)  # [m] origin in the driver of real Crazyflies
MOVED: Final = 0.02  # [m] a height that is another than at the start
SPACING: Final = 0.6  # [m] distance of robots with an invented start


@dataclass(frozen=True)
class Room:
    """Places that a shape may have."""

    solids: Solids  # robots, which keep apart
    flies: Mask  # (N,)
    lowest: float  # height of a drone; minus infinity where the whole shape can be lifted [m]

    def holds(self, shape: Shape) -> bool:
        """Whether robots stand apart, and drones are in the air."""
        return not (self.too_low(shape) or len(self.solids.overlaps(shape.position)))

    def too_low(self, shape: Shape) -> bool:
        """Whether a drone is below the floor or near it."""
        return bool(shape.position[self.flies, 2].min(initial=np.inf) < self.lowest)


def find_shape(wanted: Links, anchors: Anchored, start: Array, climbs: Mask, room: Room | None = None) -> Shape:
    """Best places for what links and anchors ask for, with robots apart from one another and drones in the air.

    A formation that can be met at the heights of the starts stays there. Otherwise heights are free. Least squares then
    begin at the starts, at a dome above them and at starts that are moved at random (always the same ones). A single
    beginning ends in a local minimum for about two of three of the shapes in space that the authors fly. A shape that
    hangs below the floor is mirrored at the height of its robots on wheels or of an anchor, or its drones there alone.

    Args:
        start: (N, 3) [m].
        climbs: (N,) robots that may change their height; the others keep theirs.
        room: Limits of a shape; None: none.
    """
    moves = np.ones_like(climbs)
    solids = None if room is None else room.solids
    mirrored = start * [1.0, -1.0, 1.0] + [0.0, 2.0 * start[:, 1].mean(), 0.0]
    found = find_shapes(wanted, [start, mirrored], moves, anchors, solids=solids)
    beginnings = _guesses_in_space(start, climbs) if climbs.any() and not found[-1].good else iter(())
    mirrors = dict.fromkeys([*start[~climbs, 2].tolist(), *(each.point[2] for _, each in anchors)]) or (0.0,)
    for guess in beginnings:
        found += find_shapes(wanted, [guess], moves, anchors, climbs, solids=solids)
        if room is not None and found[-1].worst <= SHAPE_MET and not room.holds(found[-1]):
            place = found[-1].position
            parts = climbs, climbs & (place[:, 2] < room.lowest)  # the whole, and what hangs below alone
            for mirror, part in product(mirrors, parts):
                turned = place.copy()
                turned[part, 2] = 2.0 * mirror - turned[part, 2]
                found += find_shapes(wanted, [turned], moves, anchors, climbs, solids=solids)
                if found[-1].worst <= SHAPE_MET and room.holds(found[-1]):
                    break
        if found[-1].good and (room is None or room.holds(found[-1])):
            break
    if room is None:
        return min(found, key=lambda each: round(each.worst, 4))
    kept = [each for each in found if room.holds(each)]
    # where all numbers put robots into one another, at least drones stay above the floor
    return min(kept or found, key=lambda each: (each.worst > SHAPE_MET, room.too_low(each), round(each.worst, 4)))


def _guesses_in_space(start: Array, climbs: Mask) -> Iterator[Array]:
    yield start
    way = norm(start[:, :2] - start[:, :2].mean(axis=0))
    dome = start.copy()
    dome[climbs, 2] += np.sqrt(np.maximum((BULGE * way.max(initial=0.0)) ** 2 - way[climbs] ** 2, 0.0))
    yield dome
    random = np.random.default_rng(0)
    for attempt in range(ATTEMPTS):
        moved = (start, dome)[attempt % 2] + random.normal(0.0, SPREAD[attempt % len(SPREAD)], start.shape)
        moved[~climbs, 2] = start[~climbs, 2]
        yield moved


@dataclass(frozen=True)
class Heights:
    """Start and goal of N robots."""

    start: Array  # (N, 3) [m]; z is where drones were to begin
    shape: Array  # (N, 3) [m]
    hover: Array  # (N,) heights that are held [m]; 0 on the floor
    anchored: bool  # distances to the origin agree with the others, and are carried over
    centre: tuple[float, float, float]  # place of the origin [m]
    met: bool = True  # whether the shape meets the distances


def find_heights(park: ParkExperiment, notes: list[str]) -> Heights:
    """The heights, from the shape in space if links define one.

    The origin of their files is a point about which drones spread while they climb. If the shape is not flat, no robot
    stands on the floor and the origin has no place of its own, the whole is lifted: the lowest drone keeps the height
    of its start.
    """
    flies = np.array([KINDS[robot.kind].flies for robot in park.robots])
    start = _starts(park, notes)
    start[~flies, 2] = 0.0
    start[flies & (start[:, 2] < LOWEST), 2] = ALOFT
    wanted, anchors = _wanted_distances(park, start, flies)
    plain = Heights(start, start, np.round(start[:, 2], 3), len(wanted) == 0, (0.0, 0.0, 0.0))
    if not len(wanted):
        return plain
    given = any(origin_of(park, robot, relation) for robot, task in park.tasks for relation in task.relations)
    kinds = [KINDS[robot.kind] for robot in park.robots]
    solids = Solids.of(kinds, wanted, np.ones_like(flies), CLEARANCE)
    room = Room(solids, flies, -np.inf if flies.all() and not given else LOWEST)
    found, anchored = find_shape(wanted, anchors, start, flies, room), bool(anchors)
    missed = found.worst
    if anchored and (missed > SHAPE_MET or not room.holds(found)):
        given, anchored = False, False
        room = replace(room, lowest=-np.inf if flies.all() else LOWEST)
        found = find_shape(wanted, (), start, flies, room)
        if found.worst <= SHAPE_MET:
            how = f"misses by {1e3 * missed:.0f} mm" if missed > SHAPE_MET else "has robots in one place or too low"
            unmet = "no shape was found that meets them and those between robots; the best one"
            notes.append(f"distances to the origin: {unmet} {how}, so those to the origin are left out")
    if found.worst > SHAPE_MET:
        unmet = "no shape was found that meets them with robots apart from one another, even in space; the best one"
        missed_by = f"misses by {1e3 * found.worst:.0f} mm, so drones hold the heights at which they start"
        notes.append(f"the distances: {unmet} {missed_by}")
        return replace(plain, met=False)
    shape, lift = found.position, 0.0
    flat = not (np.abs(shape[:, 2] - start[:, 2])[flies] > MOVED).any()
    if flies.all() and not given and not flat:
        lift = float(start[:, 2].min() - shape[:, 2].min())
        shape = shape + np.array([0.0, 0.0, lift])
    hover = np.where(flies, np.round(shape[:, 2], 3), 0.0)
    if hover[flies].min(initial=LOWEST) < LOWEST:
        notes.append(f"the shape needs a drone at {hover[flies].min():.2f} m: drones hold the heights of their starts")
        return replace(plain, anchored=False, met=False)
    if (np.abs(hover - start[:, 2])[flies] > MOVED).any():
        notes.append(
            "their drones climb while they form the shape, zenpark's hold a height: each takes off to that which it has"
            " in the shape"
        )
    if anchored and abs(lift) > MOVED:
        notes.append(f"the origin: lifted to {lift:.2f} m, so that the lowest drone hovers where it was to start")
    return Heights(start, shape, hover, anchored, (0.0, 0.0, round(lift, 3)))


def origin_of(park: ParkExperiment, robot: ParkRobot, relation: Relation) -> tuple[float, ...] | None:
    """Place [m] of the origin that a robot keeps a distance to; None where it is that of the arena.

    The file may give one. If not, some drivers have one of their own (`REAL_ORIGIN`).
    """
    if len(relation.values) == 4:
        return relation.values[1:]
    own = robot.driver.plans_alone and not park.central
    return REAL_ORIGIN if own and relation.name == "origin" and len(relation.values) == 1 else None


def _starts(park: ParkExperiment, notes: list[str]) -> Array:
    """Starts (N, 3) [m]; robots without a start stand on a ring, in the order of the file."""
    count = len(park.robots)
    angle = 2.0 * np.pi * np.arange(count) / max(count, 1)
    radius = max(SPACING, count * SPACING / (2.0 * np.pi))
    ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)]).round(2)
    unplaced = [robot.name for robot in park.robots if robot.start is None]
    if unplaced:
        notes.append(
            f"starts: the file has none for {', '.join(unplaced)}; MADE UP here, on a ring; name a file that has them"
            " with --poses (an index of robots or a Webots world)"
        )
    return np.array([ring[row] if robot.start is None else robot.start for row, robot in enumerate(park.robots)])


def _wanted_distances(park: ParkExperiment, start: Array, flies: Mask) -> tuple[Links, Anchored]:
    """Links, and distances to points, as the tasks have them."""
    row = {robot.name: number for number, robot in enumerate(park.robots)}
    every = [(robot, task.kind, relation) for robot, task in park.tasks for relation in task.relations]
    asked = [each for each in every if each[2].name in row]
    i = np.array([row[robot.name] for robot, _, _ in asked], dtype=np.intp)
    j = np.array([row[relation.name] for _, _, relation in asked], dtype=np.intp)
    value = np.array([(*relation.values, 0.0, 0.0)[:3] for _, _, relation in asked]).reshape(-1, 3)
    value[:, 2] = np.where(flies[i] | flies[j], value[:, 2], start[i, 2] - start[j, 2])
    by_pose = np.array([kind == "pose" for _, kind, _ in asked], dtype=bool)
    wants, distance = np.where(by_pose, BY_RELATIVE, BY_DISTANCE), np.where(by_pose, np.nan, value[:, 0])
    links = Links(i, j, distance, np.ones(len(i)), value, np.full_like(value, np.nan), wants)
    rings = [(robot, each) for robot, _, each in every if each.name == "origin" and len(each.values) != 3]
    anchors = []
    for robot, each in rings:
        x, y, z = origin_of(park, robot, each) or (0.0, 0.0, 0.0)
        anchors.append((row[robot.name], Anchor((x, y, z), (0.0, 0.0, 0.0), 1.0, 0.0, each.values[0], 1.0)))
    return links, anchors
