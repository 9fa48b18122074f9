"""Links and anchors of an experiment file from the relations of Robotic Park's robots."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from experiments.authoring.robotic_park.file import CENTRAL, PLACES, SURFACES, Park, Relation, Robot, Task
from experiments.authoring.robotic_park.heights import Heights, origin_of

SAME: Final = 1e-6  # [m] two ends of a link mean the same
LEVEL: Final = 0.02  # [m] heights that differ by less are the same
KNOWN: Final = ("gradient", "pid")
TASKS: Final = {"distance": "distance", "pose": "displacement"}  # their kinds of tasks, and the law of each


@dataclass
class FormationLines:
    """The formation, in lines of the file: `[formation]` itself, its links and its anchors."""

    settings: list[str] = field(default_factory=list)
    links: list[str] = field(default_factory=list)
    anchors: list[str] = field(default_factory=list)


def formation_lines(park: Park, found: Heights, notes: list[str]) -> FormationLines:
    """Links, anchors, law and gains.

    The gradient law of their drivers is u = k (d² − ‖x‖²) x for each neighbour with x = p_i − p_j, which is zenpark's
    with μ = 2k. Some of their drivers (`_divides`) divide by ‖x‖: near d that is zenpark's with μ = 2k/d. Their PID
    controller, u = k (d − ‖x‖) x/‖x‖, is zenpark's near d with μ = k/d². One μ serves all links, that at the mean
    distance: only links of robots with another μ than most get one of their own.
    """
    jobs = park.tasks
    made = FormationLines()
    if not jobs:
        made.settings.append('law = "distance"')
        return made
    laws = Counter(task.law for _, task in jobs)
    if unknown := [law for law in laws if law not in KNOWN]:
        notes.append(f"task.controller.type: {', '.join(unknown)}; taken as gradient")
    kinds = {task.kind for _, task in jobs}
    law = TASKS[kinds.pop()] if len(kinds) == 1 else "mixed"
    distances = [
        relation.values[0]
        for _, task in jobs
        for relation in task.relations
        if task.kind == "distance" and _is_robot(relation)
    ]
    mean = float(np.mean(distances)) if distances else 1.0
    gains = {robot.name: _gain(park, robot, task, mean) for robot, task in jobs}
    usual = {
        kind: _most_common_gain([gains[robot.name] for robot, task in jobs if task.kind == kind]) for kind in TASKS
    }
    clamps = Counter(task.clamp for _, task in jobs)
    if len(clamps) > 1:
        notes.append("task.controller.upperLimit: several; all get the commonest")
    made.settings.append(f'law = "{law}"')
    if usual["distance"] is not None:
        made.settings.append(f"gain = {usual['distance']:.4g}")
        scaled = [robot.name for robot, task in jobs if task.law == "pid" or _divides(park, robot)]
        if scaled:
            notes.append(
                f"gain of {shorten_names(scaled)}: their driver divides by the distance, so its pull is zenpark's near"
                " the distance that is wanted and weaker beyond"
            )
    if usual["pose"] is not None:
        made.settings.append(f"stiffness = {usual['pose']:.4g}")
        if any(task.kind == "pose" and task.law != "pid" for _, task in jobs):
            notes.append("pose tasks by gradient: theirs knows no sides and acts on x and y apart; here it is linear")
    made.settings.append(f"clamp = {clamps.most_common(1)[0][0]:g}")
    own = {robot.name: gains[robot.name] for robot, task in jobs if gains[robot.name] != usual[task.kind]}
    made.links += _links(park, found, own, notes)
    made.anchors += _anchors(park, found, gains, notes)
    return made


def _is_robot(relation: Relation) -> bool:
    return relation.name not in PLACES


def _divides(park: Park, robot: Robot) -> bool:
    """Whether the driver of a robot divides the pull of a neighbour by its distance.

    The driver on real Kheperas does, and so do the Webots drivers of the files that `recent` tells; those before, the
    driver of real Crazyflies and the central controller do not.
    """
    if park.architecture == CENTRAL:
        return False
    return park.recent if robot.place == "virtual" else robot.kind == "khepera4"


def _weight(park: Park, robot: Robot) -> float:
    """Gain of the origin relative to a neighbour, as in the same drivers."""
    if park.architecture == CENTRAL or robot.place != "virtual":
        return 2.0
    return 1.0 if park.recent else 4.0


def _gain(park: Park, robot: Robot, task: Task, distance: float) -> float:
    """The gain of zenpark's law at a distance [m]: μ [1/m²] for distances, the stiffness for poses."""
    if task.kind == "pose":
        return task.gain if task.law == "pid" else 2.0 * task.gain
    if task.law == "pid":
        return task.gain / distance**2
    return 2.0 * task.gain / (distance if _divides(park, robot) else 1.0)


def shorten_names(names: Sequence[str]) -> str:
    """Names for a sentence, the first ones of many."""
    return ", ".join(names) if len(names) <= 3 else f"{', '.join(names[:2])} and {len(names) - 2} more"


def _most_common_gain(gains: Sequence[float]) -> float | None:
    return Counter(gains).most_common(1)[0][0] if gains else None


def _links(park: Park, found: Heights, own: dict[str, float], notes: list[str]) -> list[str]:
    """Lines of the file: one for each link that both ends ask for alike, else one for each end."""
    row = {robot.name: number for number, robot in enumerate(park.robots)}
    asked: dict[tuple[str, str], tuple[Relation, Task]] = {}
    for robot, task in park.tasks:
        for relation in task.relations:
            if not _is_robot(relation):
                continue
            if (robot.name, relation.name) in asked:
                notes.append(f"{robot.name}: the second relation to {relation.name}")
                continue
            asked[robot.name, relation.name] = relation, task
    lines, done = [], set()
    for (name, other), (relation, task) in asked.items():
        if (name, other) in done:
            continue
        back = asked.get((other, name))
        alike = back is not None and back[1].kind == task.kind and own.get(name) == own.get(other)
        mirrored = back is not None and _mirrored(relation, back[0], task.kind)
        if back is not None and back[1].kind == task.kind and not mirrored:
            notes.append(f"{name} and {other} ask for different things of their link: each keeps to its own")
        both = alike and mirrored
        if both:
            done.add((other, name))
        lines.append(_line(name, other, relation, task, own.get(name), both=both))
        if task.kind == "pose":
            rise = float(found.hover[row[name]] - found.hover[row[other]])
            if abs(relation.values[2] - rise) > LEVEL:
                notes.append(f"{name}: {relation.values[2]:g} m above {other}; they hold heights {rise:.2f} m apart")
    return lines


def _mirrored(one: Relation, other: Relation, kind: str) -> bool:
    sign = 1.0 if kind == "distance" else -1.0
    return all(abs(a - sign * b) < SAME for a, b in zip(one.values, other.values, strict=True))


def _line(name: str, other: str, relation: Relation, task: Task, gain: float | None, *, both: bool) -> str:
    """Line of a link: `relation` is p_name − p_other, and a link has its second robot relative to the first."""
    link = f'"{other} {"-" if both else ">"} {name}"'
    if task.kind == "distance" and gain is None:
        return f"{link} = {relation.values[0]:g}"
    x, y = (*relation.values, 0.0)[:2]
    what = f"distance = {x:g}" if task.kind == "distance" else f"offset = [{x:g}, {y:g}]"
    return f"{link} = {{ {what}{'' if gain is None else f', gain = {gain:.4g}'} }}"


def _anchors(park: Park, found: Heights, gains: dict[str, float], notes: list[str]) -> list[str]:
    lines = []
    for robot, task in park.tasks:
        places = [relation for relation in task.relations if not _is_robot(relation)]
        if surfaces := [relation.name for relation in places if relation.name in SURFACES]:
            notes.append(f"{robot.name}: {', '.join(surfaces)}; zenpark has points, lines and planes")
        there = [relation for relation in places if relation.name not in SURFACES]
        if len(there) > 1:
            notes.append(f"{robot.name}: {len(there)} places to keep a distance to; only the first is kept")
        for relation in there[:1]:
            if relation.name == "origin" and len(relation.values) == 1 and not found.anchored:
                continue
            lines.append(f"{robot.name} = {{ {_anchor(park, robot, relation, found, gains[robot.name])} }}")
    return lines


def _anchor(park: Park, robot: Robot, relation: Relation, found: Heights, gain: float) -> str:
    values = relation.values
    if relation.name == "line":
        point, along = (", ".join(f"{each:g}" for each in part) for part in (values[:3], values[3:]))
        return f"to = [{point}], along = [{along}]"
    if len(values) == 3:
        return f"to = [{values[0]:g}, {values[1]:g}, {found.hover[park.robots.index(robot)]:g}], gain = {gain:.4g}"
    x, y, z = origin_of(park, robot, relation) or found.centre
    assert robot.task is not None
    own = _weight(park, robot) * _gain(park, robot, robot.task, values[0])
    return f"distance = {values[0]:g}, to = [{x:g}, {y:g}, {z:g}], gain = {own:.4g}"
