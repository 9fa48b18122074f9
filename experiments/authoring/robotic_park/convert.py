"""`./zenpark import FILE.yaml`: experiment files of Robotic Park's authors become experiment files of zenpark.

What they say is carried over as far as zenpark has the same thing; the rest is listed, in the new file and on
standard output. `docs/import.md` says what becomes of what.
"""

from __future__ import annotations

import re
import textwrap
from collections import Counter
from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from agents.body.kinds import KINDS
from agents.errors import join_names
from experiments.authoring.robotic_park import file as park_files
from experiments.authoring.robotic_park.file import PLACES, SURFACES, ParkExperiment, ParkRobot, Task
from experiments.authoring.robotic_park.heights import Heights, find_heights, origin_of
from experiments.catalogue import index
from experiments.check.analysis import sampled_loop
from experiments.check.realisation import targets_of_law
from experiments.check.theory import OSCILLATING_GAIN, UNSTABLE_GAIN
from experiments.file import catalogue as entries
from experiments.file import document
from experiments.file.consistency.whole import divisor
from experiments.file.problems import DocumentError
from experiments.file.reference import written

V = TypeVar("V", bound=Hashable)
RATE_HZ: Final = 100.0  # rate of bodies: their position controllers run at that
ROOM: Final = 0.6  # [m] room around starts and shape
PARK: Final = (4.0, 4.0, 2.5)  # [m] the arena, if there is room in it
WIDTH: Final = 110
CALM: Final = 0.98  # share of the largest calm gain that is written: gains are rounded
SAME: Final = 1e-6  # [m] two ends of a link mean the same
LEVEL: Final = 0.02  # [m] heights that differ by less are the same
LAWS: Final = {"distance": "distance", "pose": "displacement"}  # law for each of their kinds of tasks
RADIO: Final = re.compile(r"radio://(\d+)/\d+/(?:250K|1M|2M)/[0-9A-Fa-f]{10}")


def convert(
    file: str, target: str | None, duration_s: float, poses: str | None = None, *, calm: bool = False
) -> tuple[Path, list[str]]:
    """Write the experiment file of one of theirs; return its path and what was not carried over.

    `calm`: As `convert_text`.

    Raises:
        DocumentError: If the file cannot be read, is no experiment of theirs, or the new one cannot be written.
    """
    text = park_files.text_of(file, "name an experiment file of Robotic Park's authors (.yaml)")
    made, notes = convert_text(text, file, duration_s, poses, calm=calm)
    path = entries.write_new(made, Path(target or f"{Path(file).stem}.toml"))
    document.read(path)
    return path, notes


def convert_text(
    text: str, label: str, duration_s: float, poses: str | None = None, *, calm: bool = False
) -> tuple[str, list[str]]:
    """The text of the experiment file, and what was not carried over.

    Args:
        label: Its name; the files that an index names are looked for beside it.
        poses: A file with starts, see `starts_from`; they go before those of theirs.
        calm: Gains that ring with the twins are lowered, all by one factor, until they do not.

    Raises:
        DocumentError: With the errors in theirs, by the path of the key.
    """
    notes: list[str] = []
    park = park_files.read(label, text, {} if poses is None else park_files.starts_from(poses), notes)
    notes += _notes_on_robots(park)
    pose_hz = _rate("local_pose.T", "poses", [1e-3 * robot.local_pose.T for robot in park.robots], notes)
    periods = [park.period(robot) for robot, _ in park.tasks] or [0.1]
    coordination_hz = _rate("task.controller.period", "decisions", periods, notes)
    trigger: dict[str, Any] = {"kind": "periodic", "period_s": 1.0 / pose_hz}
    if sent := _commonest("communication", [robot.communication.event for robot in park.robots], notes):
        trigger = {"kind": "send-on-delta", "threshold": sent[0]}
        if sent[1]:
            notes.append(f"communication.threshold.ai = {sent[1]:g}: the part of the threshold that grows")
    found = find_heights(park, notes)
    formation, links, anchors = _formation(park, found, notes)
    if update := _commonest("task.controller", [task.controller.event for _, task in park.tasks] or [None], notes):
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
            **({"positioning": "vicon-twin"} if any(map(_captured, park.robots)) else {}),
        },
        "arena": {"size": _arena(found)},
        "rates": {"body_hz": RATE_HZ, "pose_hz": pose_hz, "coordination_hz": coordination_hz},
        "formation": formation,
        "robots": {robot.name: _robot(robot, found, row) for row, robot in enumerate(park.robots)},
        "formation.links": links,
        "formation.anchors": anchors,
    }
    made_up = {robot.name for robot in park.robots if robot.start is None}
    if (gain := _loop_gain(_text(tables, made_up), found)) > OSCILLATING_GAIN:
        notes.insert(0, _calm(tables, gain, lower=calm))
    lines = [f"#:schema ./{index.SCHEMA}", f"# Imported from {_plain(name.name)}."]
    lines += ["# Not carried over, or not as it was:"] if notes else []
    for note in notes:
        lines += textwrap.wrap(_plain(note), WIDTH, initial_indent="# - ", subsequent_indent="#   ")
    return "\n".join([*lines, _text(tables, made_up)]), notes


def _text(tables: Mapping[str, Mapping[str, Any]], made_up: Collection[str]) -> str:
    """Tables of an experiment file as text, with a remark at robots with an invented start."""
    lines = []
    for header, table in tables.items():
        lines += [f"[{header}]"] if header and table else []
        for key, value in table.items():
            remark = "  # start made up" if header == "robots" and key in made_up else ""
            lines.append(f"{written(key) if ' ' in key else key} = {written(value)}{remark}")
        lines += [""] if table else []
    return "\n".join(lines)


def _loop_gain(text: str, found: Heights) -> float:
    """Gain of the sampled loop of an experiment at its shape, as `check` states it; 0 without a shape or links."""
    try:
        plan = document.loads(text).plan
    except DocumentError:
        return 0.0  # the written file is read again, and refused
    if not found.met or not (len(plan.links) or plan.anchors_by_row):
        return 0.0
    return sampled_loop(plan, targets_of_law(plan.law, plan.links), found.shape).gain


def _calm(tables: Mapping[str, dict[str, Any]], gain: float, *, lower: bool) -> str:
    """Note on gains that ring; `lower` multiplies them all by the largest factor with which they do not."""
    share, formation = CALM * OSCILLATING_GAIN / gain, tables["formation"]
    owners = [formation, *tables["formation.links"].values(), *tables["formation.anchors"].values()]
    key = "gain" if "gain" in formation else "stiffness"
    written, most = formation[key], _rounded(share * formation[key])
    rings = "swings for ever" if gain >= UNSTABLE_GAIN else "oscillates before it settles"
    loop = f"with zenpark's twins the sampled loop {rings} (gain {gain:.2g}, limit {UNSTABLE_GAIN:g})"
    if not lower:
        return (
            f"{key} {written:g}: {loop}. At most {most:g} is calm: `--gain stable` writes it, and lowers all gains so"
        )
    for owner in owners:
        for name in ("gain", "stiffness"):
            if isinstance(owner, dict) and name in owner:
                owner[name] = _rounded(share * owner[name])
    return f"{key} {written:g} of theirs is {most:g}, and all others are lowered as much: with theirs, {loop}"


def _rounded(gain: float) -> float:
    """A gain with three digits."""
    return float(f"{gain:.3g}")


def _plain(text: str) -> str:
    """Text that may stand in a comment and in quotes."""
    return "".join(letter if letter.isprintable() and letter not in '"\\' else "?" for letter in text)


def _arena(found: Heights) -> list[float]:
    """Size of the authors' park, or of the space that starts and shape need, to the next half metre [m]."""
    places = np.concatenate([found.start, found.shape])
    reach = 2.0 * (np.abs(places[:, :2]).max(axis=0) + ROOM)
    needed = [*reach, found.hover.max(initial=0.0) + ROOM]
    return [max(size, float(np.ceil(2.0 * need) / 2.0)) for size, need in zip(PARK, needed, strict=True)]


def _robot(robot: ParkRobot, found: Heights, row: int) -> dict[str, Any]:
    start, flies = found.start[row, :2].tolist(), KINDS[robot.kind].flies
    if not flies and robot.start is not None and robot.start[2]:
        start.append(robot.start[2])
    return {
        "kind": robot.kind,
        "start": start,
        **({"hover": float(found.hover[row])} if flies else {}),
        **_body(robot),
        **({"position": "external"} if _captured(robot) else {}),
        **({"shadow": {}} if robot.type == "digital_twin" else {}),
    }


def _body(robot: ParkRobot) -> dict[str, str]:
    """Address of a real robot and its process; nothing for twins, and where there is no address."""
    radio = RADIO.fullmatch(robot.uri)
    bodies = KINDS[robot.kind].bodies if robot.type != "virtual" else ()
    if "radio" in bodies and radio:
        return {"body": robot.uri, "process": f"radio{radio[1]}"}
    if robot.kind in bodies and re.fullmatch(r"[\w.-]+(:\d+)?", robot.host):
        return {"body": f"{robot.kind}://{robot.host}"}
    return {}


def _captured(robot: ParkRobot) -> bool:
    """Whether motion capture measures a robot, which does not see twins in their own processes."""
    return robot.positioning != "Intern" and bool(_body(robot))


def _notes_on_robots(park: ParkExperiment) -> Iterator[str]:
    """Notes on settings of the authors' robots that zenpark does not have."""
    robots = park.robots
    idle = [robot for robot in robots if robot.task.written and not robot.task.enable]
    homeless = [robot for robot in robots if robot.type != "virtual" and not _body(robot)]
    outside = [robot for robot in robots if robot.positioning != "Intern"]
    captured = [*filter(_captured, robots)]
    by_events = [robot for robot in robots if "EventBased" in robot.controller.protocol + robot.controller_type]
    left = sum(len(robot.task.written) for robot in idle)
    rows = {
        "{}: real, but without an address of a known kind; twins instead": homeless,
        "real robots ({}) keep their addresses; try the file with --virtual or --bodies twin first": [
            *filter(_body, robots)
        ],
        "positioning Extern ({}): the motion capture's address is not in their file; its twin is taken": captured,
        "positioning Extern of twins ({}): no motion capture sees them; they know their poses": [
            robot for robot in outside if robot not in captured
        ],
        "{}: position controllers that act on events; zenpark's run at every tick": by_events,
        f"task.enable is False for {{}}: {left} relations are left out, and these robots have no neighbours": idle,
    }
    yield from (note.format(join_names([robot.name for robot in group])) for note, group in rows.items() if group)
    triggers = [robot.communication for robot in robots] + [task.controller for _, task in park.tasks]
    if types := sorted({each.threshold.type for each in triggers if each.event} - {"Constant"}):
        yield f"threshold.type: {', '.join(types)}; taken as a constant one with what ai adds"
    if roles := dict.fromkeys(task.role for _, task in park.tasks if task.role != "consensus"):
        yield f"task.role: {', '.join(roles)}; leaders are the robots without neighbours"


def _rate(key: str, what: str, periods: Sequence[float], notes: list[str]) -> float:
    """The rate [Hz] nearest to the commonest period [s] that divides the rate of bodies."""
    hz = 1.0 / _commonest(f"{key} [s]", periods, notes)
    nearest = divisor(RATE_HZ, hz)
    if abs(nearest - hz) > 1e-6 * hz:
        notes.append(f"{what} at {hz:g} Hz become {nearest:g} Hz, which divides the {RATE_HZ:g} Hz of bodies")
    return nearest


def _commonest(what: str, given: Sequence[V], notes: list[str]) -> V:
    """The value that most robots have."""
    (value, _), *others = Counter(given).most_common()
    if others:
        words = ", ".join(_words(other) for other, _ in others)
        notes.append(f"{what}: {words} of some robots; all get the commonest, {_words(value)}")
    return value


def _words(value: object) -> str:
    if isinstance(value, tuple):
        return "threshold {:g} + {:g}·|·|".format(*value)
    return "no threshold" if value is None else f"{value:g}"


def _formation(
    park: ParkExperiment, found: Heights, notes: list[str]
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
    if foreign_laws := dict.fromkeys(task.law for _, task in jobs if task.law not in ("gradient", "pid")):
        notes.append(f"task.controller.type: {', '.join(foreign_laws)}; taken as gradient")
    kept = [relation for _, task in jobs if task.kind == "distance" for relation in task.relations]
    distances = [relation.values[0] for relation in kept if relation.name not in PLACES]
    mean = float(np.mean(distances)) if distances else 1.0
    gains = {robot.name: _gain(park, robot, task, mean) for robot, task in jobs}
    of_kind = {kind: [gains[robot.name] for robot, task in jobs if task.kind == kind] for kind in LAWS}
    usual = {kind: Counter(given).most_common(1)[0][0] for kind, given in of_kind.items() if given}
    table: dict[str, Any] = {"law": LAWS[next(iter(usual))] if len(usual) == 1 else "mixed"}
    if "distance" in usual:
        table["gain"] = usual["distance"]
        if scaled := [robot.name for robot, task in jobs if task.law == "pid" or _divides(park, robot)]:
            why = "their driver divides by the distance, so its pull is zenpark's near the distance that is wanted and"
            notes.append(f"gain of {join_names(scaled)}: {why} weaker beyond")
        if park.recent and not park.central and any(robot.type == "virtual" for robot, _ in jobs):
            notes.append(
                "gain in Webots: the file does not say for which driver it is; taken is that of February 2024 and"
                " before. A later one divides by the distance: for that, divide gains by the distance, and those of"
                " anchors by four as well"
            )
    if "pose" in usual:
        table["stiffness"] = usual["pose"]
        if any(task.kind == "pose" and task.law != "pid" for _, task in jobs):
            notes.append("pose tasks by gradient: theirs knows no sides and acts on x and y apart; here it is linear")
    table["clamp"] = _commonest("task.controller.upperLimit [m]", [task.step[1] for _, task in jobs], notes)
    own = {robot.name: gains[robot.name] for robot, task in jobs if gains[robot.name] != usual[task.kind]}
    return table, _links(park, found, own, notes), _anchors(park, found, gains, notes)


def _divides(park: ParkExperiment, robot: ParkRobot) -> bool:
    """Whether the driver of a robot divides the pull of a neighbour by its distance."""
    return robot.driver.divides and not park.central


def _gain(park: ParkExperiment, robot: ParkRobot, task: Task, distance: float, weight: float = 1.0) -> float:
    """The gain of zenpark's law at a distance [m]: μ [1/m²] for distances, the stiffness for poses."""
    divisor_of_law = 1.0
    if task.kind == "distance":
        divisor_of_law = distance**2 if task.law == "pid" else distance if _divides(park, robot) else 1.0
    gain = weight * (1.0 if task.law == "pid" else 2.0) * task.step[0] / divisor_of_law
    return float(f"{gain:.4g}")


def _links(park: ParkExperiment, found: Heights, own: dict[str, float], notes: list[str]) -> dict[str, Any]:
    """The links: one if both ends have the same target, else one for each end."""
    hover = dict(zip((robot.name for robot in park.robots), found.hover.tolist(), strict=True))
    asked: dict[tuple[str, str], tuple[str, tuple[float, ...]]] = {}
    for robot, task in park.tasks:
        for relation in task.relations:
            ends = robot.name, relation.name
            if ends in asked:
                notes.append(f"{robot.name}: the second relation to {relation.name}")
            elif relation.name not in PLACES:
                asked[ends] = task.kind, relation.values
    lines: dict[str, Any] = {}
    for (name, other), (kind, values) in asked.items():
        if f"{name} - {other}" in lines:
            continue
        of_other, back = asked.get((other, name), ("", ()))
        sign = 1.0 if kind == "distance" else -1.0
        mirrored = of_other == kind and all(abs(a - sign * b) < SAME for a, b in zip(values, back, strict=True))
        if of_other == kind and not mirrored:
            notes.append(f"{name} and {other} ask for different things of their link: each keeps to its own")
        both = mirrored and own.get(name) == own.get(other)
        # `values` are of p_name − p_other, and a link has its second robot relative to the first
        what: dict[str, Any] = {"distance": values[0]} if kind == "distance" else {"offset": list(values[:2])}
        rise = hover[name] - hover[other]
        if kind == "pose" and abs(values[2] - rise) > LEVEL:
            notes.append(f"{name}: {values[2]:g} m above {other}; they hold heights {rise:.2f} m apart")
        what |= {"gain": own[name]} if name in own else {}
        lines[f"{other} {'-' if both else '>'} {name}"] = what["distance"] if what.keys() == {"distance"} else what
    return lines


def _anchors(park: ParkExperiment, found: Heights, gains: dict[str, float], notes: list[str]) -> dict[str, Any]:
    """The anchor of each robot that keeps to a place; that of a distance only if the shape has them."""
    anchors: dict[str, Any] = {}
    for row, (robot, task) in ((park.robots.index(each[0]), each) for each in park.tasks):
        places = [relation for relation in task.relations if relation.name in PLACES]
        kept = next((relation for relation in places if relation.name not in SURFACES), None)
        if left := [relation.name for relation in places if relation is not kept]:
            notes.append(f"{robot.name}: {', '.join(left)} left out; a robot has one place, a point or a line")
        if kept is None:
            continue
        values = kept.values
        if kept.name == "line":
            anchors[robot.name] = {"to": list(values[:3]), "along": list(values[3:])}
        elif len(values) == 3:
            anchors[robot.name] = {"to": [*values[:2], float(found.hover[row])], "gain": gains[robot.name]}
        elif found.anchored:
            # the gain of the origin relative to a neighbour, as in the same drivers
            weight = 2.0 if park.central or robot.type != "virtual" else 4.0
            centre = list(origin_of(park, robot, kept) or found.centre)
            gain = _gain(park, robot, task, values[0], weight)
            anchors[robot.name] = {"distance": values[0], "to": centre, "gain": gain}
    return anchors
