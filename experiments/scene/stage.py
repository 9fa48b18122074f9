"""Scene model: what a case looks like at one moment, from poses, statuses, links and obstacles. Pure; needs no browser.

`SceneModel` is what stays for a whole case, `Moment` what changes; functions turn both into positions and colours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property
from math import inf
from typing import Final, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from agents.body.kinds import Kind
from agents.kinds.theory import POINT
from agents.network.messages import Ranges, State, Status, WorldState
from agents.plugins import registry
from experiments.arrays import known_rows
from experiments.definition.experiment import WORLD
from experiments.definition.formation import targeted
from experiments.definition.graph import Links, links
from experiments.definition.plan import Plan, finds_contacts
from experiments.metrics.clearance import Overlap, present_overlaps
from experiments.scene.condition import CONDITIONS, PALED, RINGED, Colour, Condition
from twins.arrays import Array, Index, Mask, norm
from twins.scene import Scene

Colours = NDArray[np.uint8]

BARE: Final = inf  # stands for the error of a link that is there and has no target: it is drawn grey
GOOD_M: Final = 0.025  # error of a link that counts as kept
FAIR_M: Final = 0.05
WAY_POINTS: Final = 40  # points of a straight way at which it is looked for bodies
TOUCH_S: Final = 1.0  # time for which a contact is shown after its end, or after a world has reported it
FLASH_S: Final = 0.12  # time for which a link is lit after its sender transmits
TRAIL: Final = 60  # points of a trail
TRAIL_S: Final = 0.2  # pause of two of them
DASH_M: Final = 0.04
TALL_M: Final = 1.2  # obstacles are drawn no higher: one up to the ceiling would hide what stands behind it
NAME_M: Final = 0.25  # height above the highest robot
NOWHERE: Final = (0.0, 0.0, -1000.0)  # place of hidden parts: far below the floor

# Okabe and Ito's colours, which the colour-blind tell apart, and two more
MANY_GOALS: Final = 24  # goals of more robots are drawn on demand
ROBOTS: Final[tuple[Colour, ...]] = (
    (0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167), (86, 180, 233), (213, 94, 0), (120, 94, 240),
    (153, 153, 51),
)  # fmt: skip
GOOD, FAIR, BAD, UNKNOWN = (0, 158, 115), (230, 159, 0), (213, 50, 30), (140, 140, 140)


class BodyLocation(IntEnum):
    """Location of the body of a robot."""

    TWIN = 0  # simulated in the robot's own process
    WORLD = 1  # simulated in a world
    REAL = 2  # hardware, or a simulator of another program


PLACES: Final = {BodyLocation.TWIN: "own twin", BodyLocation.WORLD: "in the world", BodyLocation.REAL: "real"}
CHASSIS: Final[dict[BodyLocation, Colour]] = {
    BodyLocation.TWIN: (236, 236, 232), BodyLocation.WORLD: (128, 132, 140), BodyLocation.REAL: (38, 40, 44),
}  # fmt: skip


def place_of(body: str) -> BodyLocation:
    """Kind of location of a body, by its address."""
    if body == WORLD:
        return BodyLocation.WORLD
    name = registry.body_name(body)
    return BodyLocation.TWIN if name == "twin" or name in registry.names(registry.DEVICES) else BodyLocation.REAL


T = TypeVar("T")


def _if_installed(plug_in: Callable[[], T]) -> T | None:
    """A plug-in of an experiment; None where it is not installed."""
    try:
        return plug_in()
    except (registry.PluginError, msgspec.ValidationError):
        return None


@dataclass(frozen=True)
class SceneModel:
    """Parts of a scene that stay for a whole case: N robots, E links, M obstacles."""

    title: str
    names: tuple[str, ...]
    kinds: tuple[Kind, ...]
    places: tuple[BodyLocation, ...]
    shadowed: Mask  # (N,) with a twin beside the robot
    scene: Scene
    links: Links
    leaders: tuple[str, ...]
    margin: float  # [m] distance of surfaces, kept by avoidance; 0 without any
    plan: Plan | None = field(default=None, repr=False)  # None: only the robots are known

    @classmethod
    def of_plan(cls, plan: Plan) -> SceneModel:
        experiment = plan.experiment
        avoidance = _if_installed(lambda: plan.avoidance)
        formation = _if_installed(lambda: plan.formation)
        return cls(
            title=experiment.title,
            names=plan.names,
            kinds=plan.kinds,
            places=tuple(place_of(robot.body) for robot in experiment.robots.values()),
            shadowed=np.array([robot.shadow is not None for robot in experiment.robots.values()], dtype=bool),
            scene=plan.scene,
            links=links([]) if formation is None else formation.links,
            leaders=() if formation is None else plan.leaders,
            margin=0.0 if avoidance is None else avoidance.kept_gap(),
            plan=plan,
        )

    @classmethod
    def of_robots(cls, names: tuple[str, ...]) -> SceneModel:
        """Robots of which nothing but their names is known."""
        everywhere = Scene.furnished((4.0, 4.0, 2.5), {}, {}, walled=False)
        return cls(
            "", names, (POINT,) * len(names), (BodyLocation.TWIN,) * len(names), np.zeros(len(names), dtype=bool),
            everywhere, links([]), (), 0.0,
        )  # fmt: skip

    @cached_property
    def place_variables(self) -> Mapping[str, int]:
        """Variables that robots say with a place among their numbers, and where it begins."""
        plan = self.plan
        law = None if plan is None else _if_installed(lambda: plan.law)
        said = {} if law is None else law.SAYS
        return {name: each.place for name, each in said.items() if each.place is not None}

    @cached_property
    def units(self) -> dict[str, str]:
        """Units of the measures of the law that have one."""
        plan = self.plan
        law = None if plan is None else _if_installed(lambda: plan.law)
        return {} if law is None else {name: each.unit for name, each in law.MEASURES.items() if each.unit}

    def said_places(self, memories: Sequence[Mapping[str, Sequence[float]]], position: Array) -> Array:
        """Places (N, P, 3) [m] in the memories of the robots, NaN where unknown.

        A place without z is shown at the height of the robot at `position` (N, 3) [m] that says it.
        """
        places = np.full((len(self.names), len(self.place_variables), 3), np.nan)
        for row, memory in enumerate(memories):
            for k, (name, begin) in enumerate(self.place_variables.items()):
                numbers = memory.get(name, ())[begin:]
                if len(numbers) >= 2:
                    places[row, k] = *numbers[:2], numbers[2] if len(numbers) == 3 else position[row, 2]
        return places

    @cached_property
    def colours(self) -> Colours:
        """Colour of each robot (N, 3)."""
        return np.array([ROBOTS[row % len(ROBOTS)] for row in range(len(self.names))], dtype=np.uint8).reshape(-1, 3)

    @cached_property
    def radius(self) -> Array:
        """Horizontal half-size of each robot (N,) [m]."""
        return np.array([kind.radius for kind in self.kinds])

    @cached_property
    def tops(self) -> Array:
        """Tops of the obstacles as they are drawn (M,) [m]."""
        return np.minimum(self.scene.top, self.scene.bottom + TALL_M)

    @cached_property
    def size(self) -> Array:
        """Size of what a picture shows (3,) [m]: the arena, up to the highest robot or obstacle."""
        robots = () if self.plan is None else self.plan.experiment.robots.values()
        high = max([NAME_M, *(robot.hover or 0.0 for robot in robots), *self.tops.tolist()]) + NAME_M
        return np.array([*(self.scene.high - self.scene.low)[:2], high])

    def broken_links(self, conditions: Index, statuses: Sequence[Status | None]) -> Mask:
        """Links (E,) with an end that is gone, or a receiver that misses the sender in its last status."""
        net = self.links
        missing = {(row, name) for row, last in enumerate(statuses) if last is not None for name in last.missing}
        gone = np.isin(conditions, PALED)
        named = [(i, self.names[j]) in missing for i, j in zip(net.receiver.tolist(), net.sender.tolist(), strict=True)]
        return np.asarray(gone[net.sender] | gone[net.receiver] | np.array(named, dtype=bool))

    def obstacles_at(self, t: float, world: WorldState | None) -> Array:
        """Poses (M, 3) of the obstacles at `t` [s]: as the world says; without one, where their plans put them."""
        pose = self.scene.at(t)
        for each in () if world is None else world.obstacles:
            if each.name in self.scene.names and self.scene.plans[k := self.scene.names.index(each.name)] is None:
                pose[k] = each.pose
        return pose

    def overlaps(self, position: Array, obstacles: Array, world: WorldState | None) -> list[Overlap]:
        """Bodies that overlap at `position` (N, 3) [m], among `obstacles` (M, 3), of robots of a known experiment.

        Those that a world with contacts carries are left out: it reports what they touch.
        """
        if self.plan is None or not self.names:
            return []
        carried = {*world.robots} if world is not None and finds_contacts(world.engine) else set()
        found = present_overlaps(self.names, self.kinds, position, self.scene, obstacles, watched=bool(carried))
        return [each for each in found if not carried & {each.first, each.second}]

    def in_the_way(self, moment: Moment, name: str, goal: tuple[float, float]) -> tuple[list[str], list[str]]:
        """Bodies that a robot would touch at a goal x, y [m], and on the straight way there, as all stand now.

        None of a goal outside the arena, which the robot refuses.
        """
        low, high = self.scene.low[:2], self.scene.high[:2]
        if not ((low <= goal) & (goal <= high)).all():
            return [], []
        row, place = self.names.index(name), moment.position.copy()
        found: list[list[str]] = []
        begin = place[row, :2].copy()
        for step in np.linspace(1.0, 0.0, 1 + WAY_POINTS)[:-1]:
            place[row, :2] = begin + step * (np.array(goal) - begin)
            touching = (each for each in self.overlaps(place, moment.obstacles, None) if name in each[:2])
            found.append([each.second if each.first == name else each.first for each in touching])
        blocking = found[0]
        between = dict.fromkeys(other for others in found[1:] for other in others if other not in blocking)
        return blocking, list(between)

    @cached_property
    def flies(self) -> Mask:
        """Robots that fly (N,)."""
        return np.array([kind.flies for kind in self.kinds], dtype=bool)


@dataclass
class Moment:
    """State of a case at one moment; unknown numbers are NaN."""

    position: Array  # (N, 3) [m] true if known, else measured
    yaw: Array  # (N,) [rad]
    goal: Array  # (N, 3) [m]
    condition: Index  # (N,) of `Condition`
    silent_for: Array  # (N,) [s] since the last transmission of each robot
    error: Array  # (E,) [m] of each link; NaN: unknown, or the link is not there; `BARE`: it has no target
    broken: Mask  # (E,) links with a receiver that does not get poses of its sender
    obstacles: Array  # (M, 3) x, y [m], yaw [rad]
    trail: Array  # (N, K, 3) [m] former positions, the newest first
    attitude: Array | None = None  # (N, 4) quaternions w, x, y, z; NaN: only yaw is known
    shadow: Array | None = None  # (N, 3) [m] of the twins beside the robots
    shadow_yaw: Array | None = None  # (N,) [rad]
    time: float | None = None  # [s] time since the common start; None before it
    places: Array | None = None  # (N, P, 3) [m] that the robots say, see `SceneModel.said_places`
    measures: Sequence[Mapping[str, float]] = ()  # measures of the law, by robot; none known if empty
    overlaps: Sequence[Overlap] = ()  # robots that touch one another, an obstacle or a wall


def touched(name: str, overlaps: Sequence[Overlap]) -> str:
    """Contacts of a robot in words, with their depth; empty without any."""
    return ", ".join(
        f"touches {each.second if each.first == name else each.first}, {100 * each.depth:.1f} cm deep"
        for each in overlaps
        if name in (each.first, each.second)
    )


NO_STATE: Final = State("", 0, math.nan, "")


def drawn_columns(states: Iterable[State | None]) -> dict[str, Array]:
    """Drawn fields of states as rows, by their names in `Moment`; NaN where unknown."""
    known = [NO_STATE if state is None else state for state in states]
    yaws = (each.yaw if each.true_yaw is None else each.true_yaw for each in known)
    return {
        "position": known_rows((each.true_position or each.position for each in known), 3),
        "yaw": known_rows(yaws)[:, 0],
        "goal": known_rows((each.goal for each in known), 3),
        "attitude": known_rows((each.attitude for each in known), 4),
        "shadow": known_rows((each.shadow_position for each in known), 3),
        "shadow_yaw": known_rows(each.shadow_yaw for each in known)[:, 0],
    }


class LinkTracker:
    """Errors of the links by their targets, along a motion."""

    def __init__(self, stage: SceneModel) -> None:
        self._stage = stage
        plan = stage.plan
        self._law = None if plan is None else _if_installed(lambda: plan.law)
        self._pattern = None if plan is None or self._law is None else plan.formation
        self._present: list[bool] = []
        self._counts: list[bool] = []
        if self._law is not None and self._pattern is not None:
            self._counts = targeted(self._law, self._pattern).tolist()
            self._present = self._pattern.planned_at(0.0).tolist()

    def errors(self, time: float | None, position: Array) -> Array:
        """Error of each link (E,) [m] at a time since the common start [s]; NaN if not there, `BARE` without target."""
        net, pattern = self._stage.links, self._pattern
        elapsed = 0.0 if time is None else max(time, 0.0)
        found = np.full(len(net), np.nan)
        if self._law is None or pattern is None:
            return found
        apart = (position[net.receiver] - position[net.sender]).tolist()
        for k, (link, away) in enumerate(zip(pattern.targets_at(elapsed), apart, strict=True)):
            if pattern.bounded:
                self._present[k] = pattern.exists(k, elapsed, math.hypot(*away), was=self._present[k])
            if self._present[k] or not pattern.bounded:
                found[k] = abs(self._law.error(tuple(away), link)) if self._counts[k] else BARE
        return found

    def of_robots(self, error: Array) -> Array:
        """Sum of the known errors of the links on which each robot receives (N,) [m].

        NaN where none is known, as of a leader, which receives on none.
        """
        known = np.isfinite(error)
        receives = np.bincount(self._stage.links.receiver[known], minlength=len(self._stage.names)) > 0
        return np.where(receives, sums_of_errors(self._stage, error), np.nan)


def with_bare_links(plan: Plan, time: Array, position: Array, error: Array) -> Array:
    """Errors of links (T, E) [m] as `LinkTracker` gives them, along true positions (T, N, 3) at times (T,).

    Args:
        error: As `errors_over_time` gives them.
    """
    present = plan.formation.present(time, position)
    bare = ~targeted(plan.law, plan.formation)
    return np.where(bare if present is None else present & bare, BARE, error)


def sums_of_errors(stage: SceneModel, error: Array) -> Array:
    """Sum of the known errors of the links on which each robot receives (N,) [m]."""
    known = np.isfinite(error)
    sums: Array = np.bincount(stage.links.receiver[known], error[known], minlength=len(stage.names)).astype(float)
    return sums


class Trail:
    """Former positions of N robots, the newest first."""

    def __init__(self, rows: int) -> None:
        self.points = np.full((rows, TRAIL, 3), np.nan)  # [m]
        self._last = -inf

    def add(self, t: float, position: Array) -> bool:
        """Positions (N, 3) [m] at `t` [s], which go on; returns whether they are kept as new points."""
        if 0.0 <= t - self._last < TRAIL_S - 1e-6:
            return False
        self._last = t
        self.points = np.concatenate([position[:, None], self.points[:, :-1]], axis=1)
        return True


# ---------------------------------------------------------------------- appearance


def quaternions(yaw: Array) -> Array:
    """Quaternions w, x, y, z (..., 4) of rotations about z by `yaw` (...) [rad]; of unknown ones, none."""
    half = 0.5 * np.nan_to_num(yaw)
    zero = np.zeros_like(half)
    return np.stack([np.cos(half), zero, zero, np.sin(half)], axis=-1)


def orientation(moment: Moment) -> Array:
    """Quaternion w, x, y, z of each robot (N, 4)."""
    turned = quaternions(moment.yaw)
    if moment.attitude is None:
        return turned
    known = np.isfinite(moment.attitude).all(axis=1, keepdims=True)
    return np.where(known, moment.attitude, turned)


def shown(position: Array) -> Array:
    """Positions (..., 3) [m] with unknown ones hidden below the floor."""
    return np.where(np.isfinite(position).all(axis=-1, keepdims=True), position, NOWHERE)


def link_levels(error: Array) -> Index:
    """Levels of links by their errors [m]: 0 for a good one, 1 fair, 2 bad, 3 without target, −1 unknown."""
    return np.where(np.isnan(error), -1, (error > GOOD_M).astype(int) + (error > FAIR_M) + (error == BARE))


def link_colours(error: Array) -> Colours:
    """Colours (E, 3) of links by their errors (E,) [m]."""
    return np.array([GOOD, FAIR, BAD, UNKNOWN], dtype=np.uint8)[link_levels(error)]


def segments(stage: SceneModel, position: Array) -> Array:
    """Both ends (E, 2, 3) of each link, NaN where one is unknown [m]: middles of bodies at `position` (N, 3) [m]."""
    middle = position + 0.5 * np.array([[0.0, 0.0, kind.height] for kind in stage.kinds]).reshape(-1, 3)
    return np.stack([middle[stage.links.sender], middle[stage.links.receiver]], axis=1)


def visible(ends: Array, which: Mask) -> Array:
    """Segments (E, 2, 3) with those hidden that are not chosen, or not known."""
    drawn = which & np.isfinite(ends).all(axis=(1, 2))
    return np.where(drawn[:, None, None], ends, NOWHERE)


def dashes(ends: Array) -> Array:
    """Dashes (K, 2, 3) along segments (E, 2, 3), those that are unknown left out."""
    known = ends[np.isfinite(ends).all(axis=(1, 2))]
    made = []
    for a, b in known:
        length = float(norm(b - a))
        count = max(1, round(length / (2.0 * DASH_M)))
        begin = np.arange(count) / count
        share = np.stack([begin, begin + 0.5 / count], axis=1)[..., None]
        made.append(a + share * (b - a))
    return np.concatenate(made) if made else np.zeros((0, 2, 3))


def lit(stage: SceneModel, moment: Moment) -> Mask:
    """Links (E,) with a sender that has just transmitted."""
    return np.asarray(moment.silent_for[stage.links.sender] <= FLASH_S)


def accents(stage: SceneModel, moment: Moment) -> Colours:
    """Colours (N, 3) of the coloured parts of the robots: grey for those that are silent, stopped or dead."""
    pale = np.isin(moment.condition, PALED)
    return np.where(pale[:, None], np.array([105, 105, 105], dtype=np.uint8), stage.colours)


def chassis(stage: SceneModel) -> Colours:
    """Colours (N, 3) of the other parts, by the place of the body."""
    return np.array([CHASSIS[place] for place in stage.places], dtype=np.uint8).reshape(-1, 3)


def rings(moment: Moment) -> tuple[Array, Colours]:
    """Places (N, 3) [m] and colours (N, 3) of the rings around robots that need attention; others are hidden."""
    wanted = np.isin(moment.condition, RINGED)[:, None]
    colours = np.array([CONDITIONS[Condition(int(each))][1] for each in moment.condition], dtype=np.uint8)
    return shown(np.where(wanted, moment.position, np.nan)), colours.reshape(-1, 3)


def label(stage: SceneModel, row: int, condition: int) -> str:
    """Text beside a robot: its name, the place of its body unless it is an own twin, and its condition."""
    words = [stage.names[row]]
    if stage.places[row] != BodyLocation.TWIN:
        words.append(PLACES[stage.places[row]])
    if condition in RINGED:
        words.append(CONDITIONS[Condition(condition)][0].upper())
    return " · ".join(words)


def rays(stage: SceneModel, moment: Moment, scans: Mapping[str, Ranges]) -> Array:
    """Range readings (K, 2, 3) [m] as lines from the robots to what they see; one hidden line if there are none."""
    made = []
    for row, name in enumerate(stage.names):
        scan = scans.get(name)
        if scan is None or not np.isfinite(moment.position[row]).all():
            continue
        beams = [each for each in zip(scan.distance, scan.bearing, scan.elevation, strict=False) if each[0] is not None]
        reach, bearing, up = np.array(beams, dtype=float).reshape(-1, 3).T
        bearing = bearing + np.nan_to_num(moment.yaw[row])
        way = np.stack([np.cos(up) * np.cos(bearing), np.cos(up) * np.sin(bearing), np.sin(up)], axis=1)
        begin = moment.position[row] + np.array([0.0, 0.0, 0.8 * stage.kinds[row].height])
        made.append(np.stack([np.broadcast_to(begin, way.shape), begin + reach[:, None] * way], axis=1))
    return np.concatenate(made) if made else np.array([[NOWHERE, NOWHERE]])


def trail_segments(trail: Array) -> Array:
    """Segments (N·(K−1), 2, 3) of trails (N, K, 3) [m]; hidden where a point is unknown."""
    pairs = np.stack([trail[:, :-1], trail[:, 1:]], axis=2).reshape(-1, 2, 3)
    return visible(pairs, np.ones(len(pairs), dtype=bool))


def trail_colours(stage: SceneModel, points: int, background: Colour) -> Colours:
    """Colours (N·(K−1), 2, 3) of such segments: from the robot's colour towards the background."""
    share = np.linspace(0.15, 0.8, points)[None, :, None]
    faded = (1.0 - share) * stage.colours[:, None, :] + share * np.array(background)
    return np.stack([faded[:, :-1], faded[:, 1:]], axis=2).reshape(-1, 2, 3).astype(np.uint8)
