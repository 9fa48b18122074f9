"""`./zenpark import FILE.yaml`: experiment files of Robotic Park's authors become experiment files of zenpark.

What they say is carried over as far as zenpark has the same thing; the rest is listed, in the new file and on
standard output. `docs/import.md` says what becomes of what.
"""

from __future__ import annotations

import re
import textwrap
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from agents.body.kinds import KINDS
from experiments.authoring.robotic_park.file import PLACES, SURFACES, Park, Relation, Robot, Task, read, starts_from
from experiments.authoring.robotic_park.heights import Heights, find_heights, origin_of
from experiments.catalogue import index
from experiments.check.findings import join_names
from experiments.file import catalogue as entries
from experiments.file import document
from experiments.file.consistency import divisor
from experiments.file.problems import refusal
from experiments.file.reference import written
from experiments.file.text import content

V = TypeVar("V", bound=Hashable)
RATE_HZ: Final = 100.0  # of bodies: their position controllers run at that
ROOM: Final = 0.6  # [m] around starts and shape
PARK: Final = (4.0, 4.0, 2.5)  # [m] the arena, if there is room in it
WIDTH: Final = 110
SAME: Final = 1e-6  # [m] two ends of a link mean the same
LEVEL: Final = 0.02  # [m] heights that differ by less are the same
KNOWN: Final = ("gradient", "pid")
TASKS: Final = {"distance": "distance", "pose": "displacement"}  # their kinds of tasks, and the law of each
RADIO: Final = re.compile(r"radio://(\d+)/\d+/(?:250K|1M|2M)/[0-9A-Fa-f]{10}")


def convert(file: str, target: str | None, duration_s: float, poses: str | None = None) -> tuple[Path, list[str]]:
    """Write the experiment file of one of theirs; return its path and what was not carried over.

    Raises:
        DocumentError: If the file cannot be read, is no experiment of theirs, or the new one cannot be written.
    """
    source = Path(file)
    try:
        text = content(source, file)
    except FileNotFoundError:
        hint = "name an experiment file of Robotic Park's authors (.yaml)"
        raise refusal(file, "there is no such file", hint) from None
    made, notes = convert_text(text, file, duration_s, poses)
    path = entries.write_new(made, Path(target) if target else Path(f"{source.stem}.toml"))
    document.read(path)
    return path, notes


def convert_text(text: str, label: str, duration_s: float, poses: str | None = None) -> tuple[str, list[str]]:
    """The text of the experiment file, and what was not carried over.

    Args:
        label: Its name; the files that an index names are looked for beside it.
        poses: A file with starts, see `starts_from`; they go before those of theirs.

    Raises:
        DocumentError: With the errors in theirs, by the path of the key.
    """
    notes: list[str] = []
    park = read(label, text, {} if poses is None else starts_from(poses), notes)
    _note_robots(park, notes)
    pose_hz = _rate("local_pose.T", "poses", [robot.pose_s for robot in park.robots], notes)
    coordination_hz = _rate(
        "task.controller.period", "decisions", [task.period for _, task in park.tasks] or [0.1], notes
    )
    trigger: dict[str, Any] = {"kind": "periodic", "period_s": 1.0 / pose_hz}
    chosen = _commonest("communication", [robot.communication for robot in park.robots], notes)
    if chosen is not None:
        trigger = {"kind": "send-on-delta", "threshold": chosen[0]}
        if chosen[1]:
            notes.append(f"communication.threshold.ai = {chosen[1]:g}: the part of the threshold that grows")
    found = find_heights(park, notes)
    formation, links, anchors = _formation_table(park, found, notes)
    update = _commonest("task.controller", [task.update for _, task in park.tasks] or [None], notes)
    if update is not None:
        formation["update"] = {"kind": "relative-control", "floor": update[0], "share": update[1]}
    notes = list(dict.fromkeys(notes))
    name = Path(label)
    tables: dict[str, dict[str, Any]] = {
        "": {
            "title": _plain(f"{name.stem}: {len(park.robots)} robots, {park.mode}"),
            "source": f"an experiment file of Robotic-Park-Lab, {_plain(name.name)}",
            "duration_s": duration_s,
            **({"architecture": "centralised"} if park.central else {}),
            "trigger": trigger,
            **({"positioning": "vicon-twin"} if any(robot.external for robot in park.robots) else {}),
        },
        "arena": {"size": _arena(found)},
        "rates": {"body_hz": RATE_HZ, "pose_hz": pose_hz, "coordination_hz": coordination_hz},
        "formation": formation,
        "robots": {robot.name: _robot(robot, found, row) for row, robot in enumerate(park.robots)},
        "formation.links": links,
        "formation.anchors": anchors,
    }
    lines = [f"#:schema ./{index.SCHEMA}", f"# Imported from {_plain(name.name)}."]
    lines += ["# Not carried over, or not as it was:"] if notes else []
    for note in notes:
        lines += textwrap.wrap(_plain(note), WIDTH, initial_indent="# - ", subsequent_indent="#   ")
    made_up = {robot.name for robot in park.robots if robot.pose is None}
    for header, table in tables.items():
        lines += [f"[{header}]"] if header and table else []
        for key, value in table.items():
            remark = "  # start made up" if header == "robots" and key in made_up else ""
            lines.append(f"{written(key) if ' ' in key else key} = {written(value)}{remark}")
        lines += [""] if table else []
    return "\n".join(lines), notes


def _plain(text: str) -> str:
    """Text that may stand in a comment and in quotes."""
    return "".join(letter if letter.isprintable() and letter not in '"\\' else "?" for letter in text)


def _arena(found: Heights) -> list[float]:
    """Their park, or as much as starts and shape need, to the next half metre [m]."""
    places = np.concatenate([found.start, found.shape])
    reach = 2.0 * (np.abs(places[:, :2]).max(axis=0) + ROOM)
    needed = [*reach.tolist(), float(found.hover.max(initial=0.0)) + ROOM]
    return [max(size, float(np.ceil(2.0 * need) / 2.0)) for size, need in zip(PARK, needed, strict=True)]


def _robot(robot: Robot, found: Heights, row: int) -> dict[str, Any]:
    start, flies = found.start[row, :2].tolist(), KINDS[robot.kind].flies
    if not flies and robot.pose is not None and robot.pose[2]:
        start.append(robot.pose[2])
    made: dict[str, Any] = {"kind": robot.kind, "start": start}
    if flies:
        made["hover"] = float(found.hover[row])
    made |= _body(robot)
    if robot.external:
        made["position"] = "external"
    if robot.place == "digital_twin":
        made["shadow"] = {}
    return made


def _body(robot: Robot) -> dict[str, str]:
    """Address of a real robot and its process; nothing for twins, and where there is no address."""
    if robot.place == "virtual":
        return {}
    radio = RADIO.fullmatch(robot.uri)
    if robot.kind == "crazyflie" and radio:
        return {"body": robot.uri, "process": f"radio{radio[1]}"}
    if robot.kind in ("khepera4", "tello") and re.fullmatch(r"[\w.-]+(:\d+)?", robot.host):
        return {"body": f"{robot.kind}://{robot.host}"}
    return {}


def _note_robots(park: Park, notes: list[str]) -> None:
    """Notes on settings of the authors' robots that zenpark does not have."""

    def those(what: Callable[[Robot], object], note: str) -> None:
        if names := [robot.name for robot in park.robots if what(robot)]:
            notes.append(note.format(join_names(names), "is" if len(names) == 1 else "are"))

    those(
        lambda robot: robot.place != "virtual" and not _body(robot),
        "{} {} real, but without an address of a known kind: twins instead",
    )
    those(_body, "real robots ({}) keep their addresses; try the file with --virtual or --bodies twin first")
    those(
        lambda robot: robot.external,
        "positioning Extern ({}): the motion capture's address is not in their file; positioning is a twin of it",
    )
    those(
        lambda robot: robot.gated,
        "{}: position controllers that act on events; zenpark's run at every tick",
    )
    if roles := dict.fromkeys(task.role for _, task in park.tasks if task.role != "consensus"):
        notes.append(f"task.role: {', '.join(roles)}; leaders are the robots without neighbours")
    count = sum(robot.idle for robot in park.robots)
    those(
        lambda robot: robot.idle,
        f"task.enable is False for {{}}: {count} relations are left out, and these robots have no neighbours",
    )


def _rate(key: str, what: str, periods: Sequence[float], notes: list[str]) -> float:
    """The rate [Hz] nearest to the commonest period [s] that divides the rate of bodies."""
    hz = 1.0 / _commonest(f"{key} [s]", periods, notes)
    nearest = divisor(RATE_HZ, hz)
    if abs(nearest - hz) > 1e-6 * hz:
        notes.append(f"{what} at {hz:g} Hz become {nearest:g} Hz, which divides the {RATE_HZ:g} Hz of bodies")
    return nearest


def _formation_table(
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
                f"gain of {join_names(scaled)}: their driver divides by the distance, so its pull is zenpark's near"
                " the distance that is wanted and weaker beyond"
            )
    if "pose" in usual:
        table["stiffness"] = _rounded(usual["pose"])
        if any(task.kind == "pose" and task.law != "pid" for _, task in jobs):
            notes.append("pose tasks by gradient: theirs knows no sides and acts on x and y apart; here it is linear")
    table["clamp"] = _commonest("task.controller.upperLimit [m]", [task.clamp for _, task in jobs], notes)
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


def _commonest(what: str, given: Sequence[V], notes: list[str]) -> V:
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
