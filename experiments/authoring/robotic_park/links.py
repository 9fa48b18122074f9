"""Formation of an experiment file, with its links and anchors, from the relations of Robotic Park's robots."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Sequence
from typing import Any, Final, TypeVar

import numpy as np

from experiments.authoring.robotic_park.file import PLACES, SURFACES, Park, Relation, Robot, Task
from experiments.authoring.robotic_park.heights import Heights, origin_of

V = TypeVar("V", bound=Hashable)
SAME: Final = 1e-6  # [m] two ends of a link mean the same
LEVEL: Final = 0.02  # [m] heights that differ by less are the same
KNOWN: Final = ("gradient", "pid")
TASKS: Final = {"distance": "distance", "pose": "displacement"}  # their kinds of tasks, and the law of each


def formation_table(
    park: Park, found: Heights, notes: list[str]
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Law and gains, links and anchors: the tables `[formation]`, `[formation.links]` and `[formation.anchors]`.

    The gradient law of their drivers is u = k (d² − ‖x‖²) x for each neighbour with x = p_i − p_j, which is zenpark's
    with μ = 2k. Some of their drivers (`_divides`) divide by ‖x‖: near d that is zenpark's with μ = 2k/d. Their PID
    controller, u = k (d − ‖x‖) x/‖x‖, is zenpark's near d with μ = k/d². One μ serves all links, that at the mean
    distance: only links of robots with another μ than most get one of their own.
    """
    jobs = park.tasks
    if not jobs:
        return {"law": "distance"}, {}, {}
    if unknown := dict.fromkeys(task.law for _, task in jobs if task.law not in KNOWN):
        notes.append(f"task.controller.type: {', '.join(unknown)}; taken as gradient")
    distances = [
        relation.values[0]
        for _, task in jobs
        for relation in task.relations
        if task.kind == "distance" and relation.name not in PLACES
    ]
    mean = float(np.mean(distances)) if distances else 1.0
    gains = {robot.name: _gain(park, robot, task, mean) for robot, task in jobs}
    of_kind = {kind: [gains[robot.name] for robot, task in jobs if task.kind == kind] for kind in TASKS}
    usual = {kind: Counter(given).most_common(1)[0][0] for kind, given in of_kind.items() if given}
    table: dict[str, Any] = {"law": TASKS[next(iter(usual))] if len(usual) == 1 else "mixed"}
    if "distance" in usual:
        table["gain"] = _rounded(usual["distance"])
        if scaled := [robot.name for robot, task in jobs if task.law == "pid" or _divides(park, robot)]:
            notes.append(
                f"gain of {shorten_names(scaled)}: their driver divides by the distance, so its pull is zenpark's near"
                " the distance that is wanted and weaker beyond"
            )
    if "pose" in usual:
        table["stiffness"] = _rounded(usual["pose"])
        if any(task.kind == "pose" and task.law != "pid" for _, task in jobs):
            notes.append("pose tasks by gradient: theirs knows no sides and acts on x and y apart; here it is linear")
    table["clamp"] = commonest("task.controller.upperLimit", [task.clamp for _, task in jobs], notes)
    own = {robot.name: _rounded(gains[robot.name]) for robot, task in jobs if gains[robot.name] != usual[task.kind]}
    return table, _links(park, found, own, notes), _anchors(park, found, gains, notes)


def _rounded(gain: float) -> float:
    return float(f"{gain:.4g}")


def _divides(park: Park, robot: Robot) -> bool:
    """Whether the driver of a robot divides the pull of a neighbour by its distance.

    The driver on real Kheperas does, and so do the Webots drivers of the files that `recent` tells; those before, the
    driver of real Crazyflies and the central controller do not.
    """
    return not park.central and (park.recent if robot.place == "virtual" else robot.kind == "khepera4")


def _gain(park: Park, robot: Robot, task: Task, distance: float) -> float:
    """The gain of zenpark's law at a distance [m]: μ [1/m²] for distances, the stiffness for poses."""
    if task.law == "pid":
        return task.gain if task.kind == "pose" else task.gain / distance**2
    return 2.0 * task.gain / (distance if task.kind == "distance" and _divides(park, robot) else 1.0)


def commonest(what: str, given: Sequence[V], notes: list[str]) -> V:
    """The value that most robots have."""
    counted = Counter(given)
    value = counted.most_common(1)[0][0]
    if len(counted) > 1:
        others = ", ".join(_words(each) for each in counted if each != value)
        notes.append(f"{what}: {others} of some robots; all get the commonest, {_words(value)}")
    return value


def _words(value: object) -> str:
    if isinstance(value, tuple):
        return "threshold {:g} + {:g}·|·|".format(*value)
    return "no threshold" if value is None else f"{value:g}"


def shorten_names(names: Sequence[str]) -> str:
    """Names for a sentence, the first ones of many."""
    return ", ".join(names) if len(names) <= 3 else f"{', '.join(names[:2])} and {len(names) - 2} more"


def _links(park: Park, found: Heights, own: dict[str, float], notes: list[str]) -> dict[str, Any]:
    """The links: one that both ends ask for alike, else one for each end."""
    row = {robot.name: number for number, robot in enumerate(park.robots)}
    asked: dict[tuple[str, str], tuple[Relation, str]] = {}
    for robot, task in park.tasks:
        for relation in task.relations:
            ends = robot.name, relation.name
            if ends in asked:
                notes.append(f"{robot.name}: the second relation to {relation.name}")
            elif relation.name not in PLACES:
                asked[ends] = relation, task.kind
    lines: dict[str, Any] = {}
    for (name, other), (relation, kind) in asked.items():
        if f"{name} - {other}" in lines:
            continue
        back, of_other = asked.get((other, name), (None, ""))
        mirrored = back is not None and of_other == kind and _mirrored(relation, back, kind)
        if of_other == kind and not mirrored:
            notes.append(f"{name} and {other} ask for different things of their link: each keeps to its own")
        both = mirrored and own.get(name) == own.get(other)
        # `relation` is p_name − p_other, and a link has its second robot relative to the first
        what: dict[str, Any] = {"distance": relation.values[0]}
        if kind == "pose":
            what = {"offset": list(relation.values[:2])}
            rise = float(found.hover[row[name]] - found.hover[row[other]])
            if abs(relation.values[2] - rise) > LEVEL:
                notes.append(f"{name}: {relation.values[2]:g} m above {other}; they hold heights {rise:.2f} m apart")
        what |= {"gain": own[name]} if name in own else {}
        lines[f"{other} {'-' if both else '>'} {name}"] = what["distance"] if what.keys() == {"distance"} else what
    return lines


def _mirrored(one: Relation, other: Relation, kind: str) -> bool:
    sign = 1.0 if kind == "distance" else -1.0
    return all(abs(a - sign * b) < SAME for a, b in zip(one.values, other.values, strict=True))


def _anchors(park: Park, found: Heights, gains: dict[str, float], notes: list[str]) -> dict[str, Any]:
    anchors = {}
    for robot, task in park.tasks:
        places = [relation for relation in task.relations if relation.name in PLACES]
        if surfaces := [relation.name for relation in places if relation.name in SURFACES]:
            notes.append(f"{robot.name}: {', '.join(surfaces)}; zenpark has points, lines and planes")
        there = [relation for relation in places if relation.name not in SURFACES]
        if len(there) > 1:
            notes.append(f"{robot.name}: {len(there)} places to keep a distance to; only the first is kept")
        for relation in there[:1]:
            anchor = _anchor(park, robot, task, relation, found, gains[robot.name])
            if found.anchored or "distance" not in anchor:
                anchors[robot.name] = anchor
    return anchors


def _anchor(  # noqa: PLR0917 - one caller
    park: Park, robot: Robot, task: Task, relation: Relation, found: Heights, gain: float
) -> dict[str, Any]:
    values = relation.values
    if relation.name == "line":
        return {"to": list(values[:3]), "along": list(values[3:])}
    if len(values) == 3:
        height = float(found.hover[park.robots.index(robot)])
        return {"to": [*values[:2], height], "gain": _rounded(gain)}
    # the gain of the origin relative to a neighbour, as in the same drivers
    weight = 2.0 if park.central or robot.place != "virtual" else 1.0 if park.recent else 4.0
    own = _rounded(weight * _gain(park, robot, task, values[0]))
    return {"distance": values[0], "to": list(origin_of(park, robot, relation) or found.centre), "gain": own}
