"""Experiment files of Robotic Park's authors from 2023, the paper's own among them, as the same typed records.

Two formats: *flat*, whose keys are robots, each with its communication and task; and an *index*, whose keys are robots
with a start and the flat file (`config_path`) of that one robot. Periods are milliseconds. Gain and limit of the law
stand in the programs of that time: 0.25 and 0.08 m (0.32 m, divided by 4) per decision.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from experiments.authoring.robotic_park.file import (
    CENTRES,
    NOTHING,
    PLACES,
    SURFACES,
    Park,
    Pose,
    Robot,
    Task,
    Threshold,
    check_names,
    host_of,
    kind_of,
    name_and_kind,
    parts,
    pose_of,
    positive,
    relations,
)
from experiments.authoring.robotic_park.yaml_reader import Item, Tree
from experiments.file.problems import DocumentError, Problem, refusal
from experiments.file.text import content

KNOWN: Final = ("config_path", "communication", "task", "agent_ip", "control_mode")  # a table with one is a robot
GAIN: Final = 0.25
CLAMP: Final = 0.08  # [m]
EVENTS: Final = ("EventBased", "EvenBased")  # both are written
POSITIONING: Final = ("Intern", "Extern", "MoCap")
TYPES: Final = {"distance": "distance", "relative_pose": "pose", "pose": "pose"}
PLACES_KEPT: Final = {*CENTRES, *SURFACES, "line"}
WORD: Final = re.compile(r'"[^"]*"|#[^\n]*|[{}\[\]]|[^\s{}\[\]"#]+')


@dataclass(frozen=True)
class Listed:
    """A robot in an older file: its entry there, and its settings, which an index keeps in a file of their own."""

    tree: Tree
    entry: Item
    own: Tree
    settings: Item


def is_older(tree: Tree, root: Item) -> bool:
    """Whether the keys of a file are robots."""
    return not tree.get(root, "Robots").there and any(_robots(tree, root))


def read_older(tree: Tree, folder: Path, poses: Mapping[str, Pose]) -> Park:
    """The file.

    Args:
        tree: Of the file.
        folder: Where it lies: `config_path` is meant from there.
        poses: Of robots by name, from elsewhere.

    Raises:
        DocumentError: With everything that is wrong with it or the files that it names, each with its place.
    """
    listed = [_listed(tree, entry, folder) for entry in _robots(tree, tree.root())]
    index = any(each.own is not each.tree for each in listed)
    marks = _markers(listed)
    listed = [each for each in listed if each.entry.path[-1] not in marks]
    robots = tuple(_robot(each, poses) for each in listed)
    strangers = {other.name for other in robots[0].task.relations} - PLACES_KEPT if robots and robots[0].task else set()
    if len(robots) == 1 and strangers:
        hint = "import the file that lists the robots of the experiment: an index names this one as config_path"
        tree.fault(listed[0].entry, f"'{robots[0].name}' is one robot of an experiment", hint)
    else:
        check_names(tree, [each.entry for each in listed], robots)
    for each in listed:
        if each.own is not tree:
            tree.problems += each.own.problems
    tree.refuse()
    remarks = [
        "law: gain and limit are not in files of 2023; 0.25 and 0.08 m per decision, as in the programs of that time"
    ]
    if marks:
        remarks.append(f"{', '.join(marks)}: the marker of a robot that stands in the file already")
    if not index and (addresses := [f"{robot.name} {robot.host}" for robot in robots if robot.host]):
        remarks.append(
            "the file does not say which robots are real: all are twins here; addresses in it: " + ", ".join(addresses)
        )
    kinds = {robot.place for robot in robots}
    mode = kinds.pop() if len(kinds) == 1 else "hybrid"
    return Park(mode=mode, tool="", kind="formation", architecture="distributed", robots=robots, remarks=tuple(remarks))


def _robots(tree: Tree, root: Item) -> Iterator[Item]:
    """Entries of a file whose keys are robots."""
    for entry in tree.tables(root):
        if any(tree.get(entry, key).there for key in KNOWN):
            yield entry


def _listed(tree: Tree, entry: Item, folder: Path) -> Listed:
    where = tree.get(entry, "config_path")
    if not where.there:
        return Listed(tree, entry, tree, entry)
    name = tree.words(where)
    file = folder / name
    try:
        own = Tree(str(file), content(file, str(file)))
    except OSError:
        tree.fault(where, f"there is no file '{name}' beside this one", "put the files of its robots beside the index")
        return Listed(tree, entry, tree, entry)
    root = own.root()
    entries = list(own.tables(root))
    named = [each for each in entries if each.path[-1] == entry.path[-1]] or entries[:1]
    if not named:
        own.fault(root, "has no robot", f"write its settings under '{entry.path[-1]}:'")
    return Listed(tree, entry, own, named[0] if named else root)


def _markers(listed: list[Listed]) -> list[str]:
    """Entries that only let the drones' driver publish where another robot of the file is."""
    keys = {each.entry.path[-1] for each in listed}
    found = []
    for each in listed:
        name, key = each.own.words(each.own.get(each.settings, "name")), each.entry.path[-1]
        if name != key and name in keys and not _task_on(each):
            found.append(key)
    return found


def _task_on(listed: Listed) -> bool:
    own = listed.own
    return own.truth(own.get(own.get(listed.settings, "task"), "enable"), True)


def _robot(listed: Listed, poses: Mapping[str, Pose]) -> Robot:
    tree, entry, own, settings = listed.tree, listed.entry, listed.own, listed.settings
    written = next((found for key in ("name", "id") if (found := tree.get(entry, key)).there), None)
    name, kind = name_and_kind(tree, written or entry, tree.words(written) if written else entry.path[-1])
    task = own.get(settings, "task")
    on = task.there and _task_on(listed)
    return Robot(
        name=name,
        kind=kind,
        place=tree.one_of(tree.get(entry, "type"), PLACES, "virtual"),
        pose=_pose(listed, poses.get(name)),
        uri=tree.words(tree.get(entry, "uri")),
        host=host_of(own, settings),
        external=own.one_of(own.get(settings, "positioning"), POSITIONING, "Intern") != "Intern",
        speaks=_speaks(own, own.get(settings, "communication")),
        pose_s=1e-3 * positive(own, own.get(own.get(settings, "local_pose"), "T"), 20.0),
        control=Threshold("EventBased" in own.words(own.get(settings, "controller_type")), 0.01, 0.0, "Constant"),
        task=_task(own, task) if on else None,
        idle=0 if on else len(parts(own, task)),
    )


def _pose(listed: Listed, given: Pose | None) -> Pose | None:
    """The start: from elsewhere, of the index, or of the flat file, with the yaw that Kheperas have there."""
    tree, own, settings = listed.tree, listed.own, listed.settings
    if given is not None:
        return given
    written, yaw = tree.get(listed.entry, "pose"), own.number(own.get(settings, "init_theta"), 0.0)
    if not written.there:
        return None
    if tree.is_table(written):
        x, y = (tree.number(tree.need(written, axis, "in metres"), 0.0) for axis in "xy")
        return x, y, yaw
    x, y, third = pose_of(tree, written)
    return x, y, third or yaw


def _speaks(tree: Tree, item: Item) -> Threshold:
    """When poses are sent: a word, or a table with a threshold."""
    table = tree.is_table(item)
    how = tree.one_of(tree.get(item, "type") if table else item, ("Continuous", *EVENTS), "Continuous")
    if how not in EVENTS:
        return Threshold(False, 0.01, 0.0, "Constant")
    threshold = tree.get(item, "threshold")
    found = next((each for key in ("co", "threshold") if (each := tree.get(threshold, key)).there), Item(None))
    return Threshold(True, positive(tree, found, 0.01), _number(tree, tree.get(threshold, "ai")), "Constant")


def _number(tree: Tree, item: Item) -> float:
    return 0.0 if tree.words(item).lower() in NOTHING else tree.number(item, 0.0)


def _task(tree: Tree, item: Item) -> Task:
    kind = TYPES[tree.one_of(tree.get(item, "type"), tuple(TYPES), "distance")]
    return Task(
        kind=kind,
        relations=relations(tree, item, kind),
        law="gradient",
        gain=GAIN,
        clamp=CLAMP,
        period=1e-3 * positive(tree, tree.get(item, "T"), 100.0),
        update=Threshold(False, 0.0, 0.0, "Constant"),
        role=tree.words(tree.get(item, "role"), "consensus"),
    )


def starts_from(file: str) -> dict[str, Pose]:
    """Starts of robots by name: from an index or experiment (.yaml), a Webots world (.wbt) or a table.

    A table has a robot a line: its name, x, y [m] and, if wanted, z [m] or, of robots on wheels, the yaw [rad].

    Raises:
        DocumentError: If the file cannot be read, or tells no start.
    """
    try:
        text = content(Path(file), file)
    except FileNotFoundError:
        hint = "name an index of robots (.yaml), a Webots world (.wbt) or a table of name, x, y"
        raise refusal(file, "there is no such file", hint) from None
    kind = Path(file).suffix.lower()
    read = {".wbt": _world, ".yaml": _index, ".yml": _index}.get(kind, _table)
    found = read(file, text)
    if not found:
        raise refusal(file, "tells the start of no robot", "a line of a table: dron01 0.5 -0.2")
    return found


def _index(file: str, text: str) -> dict[str, Pose]:
    tree = Tree(file, text)
    root = tree.root()
    robots = tree.get(root, "Robots")
    found = {}
    for entry in tree.tables(robots if robots.there else root):
        pose = tree.get(entry, "pose")
        if pose.there and not tree.is_table(pose):
            found[tree.words(tree.get(entry, "name"), entry.path[-1])] = pose_of(tree, pose)
    tree.refuse()
    return found


def _table(file: str, text: str) -> dict[str, Pose]:
    found, problems = {}, []
    for number, line in enumerate(text.splitlines(), 1):
        name, *rest = [part for part in re.split(r"[,;\s]+", line.partition("#")[0]) if part] or [""]
        if not name:
            continue
        try:
            values = [float(part) for part in rest]
        except ValueError:
            values = []
        if len(values) not in (2, 3) or not all(map(math.isfinite, values)):
            problems.append(Problem(file, number, 1, "is no start", "name, x, y and, if wanted, z or the yaw"))
            continue
        x, y, z = (*values, 0.0)[:3]
        found[name] = (x, y, z)
    if problems:
        raise DocumentError(problems)
    return found


def _world(file: str, text: str) -> dict[str, Pose]:
    """Starts in a Webots world: `name` and `translation` of its nodes; the yaw where `rotation` is about z."""
    found: dict[str, Pose] = {}
    words = [word for word in WORD.findall(text) if not word.startswith("#")]
    depth, name, place, yaw = 0, "", [0.0, 0.0, 0.0], 0.0
    for at, word in enumerate(words):
        if word in "{[":
            depth += 1
            if depth == 1:
                name = words[at - 2] if at >= 3 and words[at - 3] == "DEF" else ""
                place, yaw = [0.0, 0.0, 0.0], 0.0
        elif word in "}]":
            depth -= 1
            if depth == 0 and name:
                flies = kind_of(name) in ("crazyflie", "tello")
                found[name] = (place[0], place[1], place[2] if flies else yaw)
        elif depth == 1 and word == "name":
            name = words[at + 1].strip('"') if at + 1 < len(words) else ""
        elif depth == 1 and word in ("translation", "rotation"):
            values = _numbers(file, words[at + 1 : at + (4 if word == "translation" else 5)])
            if word == "translation":
                place = values
            elif abs(values[2]) > 1.0 - 1e-3:
                yaw = math.copysign(1.0, values[2]) * values[3]
    return found


def _numbers(file: str, words: list[str]) -> list[float]:
    try:
        found = [float(word) for word in words]
    except ValueError:
        found = []
    if len(found) < 3 or not all(map(math.isfinite, found)):
        hint = "name another file with --poses"
        raise refusal(file, f"cannot be read near '{' '.join(words)}'", hint)
    return [*found, 0.0][:4]
