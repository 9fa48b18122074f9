"""Experiment files of Robotic Park's authors (organisation Robotic-Park-Lab), as typed records.

What their launcher and drivers have read of them since December 2023: sections Operation, Architecture and Robots; for
each robot its pose, address, communication and task. Periods named T are milliseconds, the others seconds.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

from agents.plugins.registry import did_you_mean
from experiments.authoring.robotic_park.yaml_reader import Item, Tree

KINDS: Final = (  # their launcher knows robots by their names as well
    ("dron", "crazyflie"),
    ("crazyflie", "crazyflie"),
    ("khepera", "khepera4"),
    ("turtlebot", "turtlebot3"),
    ("burger", "turtlebot3"),
    ("tello", "tello"),
)
PLACES: Final = ("physical", "virtual", "digital_twin")
MODES: Final = ("physical", "virtual", "hybrid")
CENTRAL: Final = "centralized"
CENTRES: Final = ("origin", "sphere")
NOTHING: Final = ("none", "null")  # a relationship with nobody
SURFACES: Final = ("cone", "ellipsoid")
NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
Pose: TypeAlias = tuple[float, float, float]
FORM: Final = "write name_d, name_x_y_z or origin_R, separated by commas"


@dataclass(frozen=True)
class Threshold:
    """When something is sent or computed: always (`event` false), or beyond c0 + a·|·|."""

    event: bool
    constant: float
    relative: float
    kind: str


@dataclass(frozen=True)
class Relation:
    """What a robot keeps to another, or to a place.

    Attributes:
        name: Of the other robot; origin, line, or a surface.
        values: Its numbers.
        centre: Of an origin that is told where it is.
    """

    name: str
    values: tuple[float, ...]
    centre: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Task:
    """What a robot does in the formation.

    Attributes:
        kind: distance or pose.
        relations: To whom.
        law: gradient, pid, or what else they have.
        gain: Of the law, per decision.
        clamp: Largest step of a decision [m].
        period: Of it [s].
        update: When it is computed.
        role: Of the robot.
    """

    kind: str
    relations: tuple[Relation, ...]
    law: str
    gain: float
    clamp: float
    period: float
    update: Threshold
    role: str


@dataclass(frozen=True)
class Robot:
    """One of their robots.

    Attributes:
        name: As they call it.
        kind: As zenpark calls it.
        place: physical, virtual or digital_twin.
        pose: x, y [m] and z [m]; of robots on wheels the yaw [rad] instead of z. None: the file does not say.
        uri: Of a Crazyflie.
        host: Of a robot on Wi-Fi, with its port if there is one.
        external: Whether its position is measured from outside.
        speaks: When it sends its pose.
        pose_s: How often it looks at its pose [s].
        control: Of its own position controller.
        task: None if it has none, or one that is switched off.
        idle: Relations of a task that is switched off.
    """

    name: str
    kind: str
    place: str
    pose: Pose | None
    uri: str
    host: str
    external: bool
    speaks: Threshold
    pose_s: float
    control: Threshold
    task: Task | None
    idle: int = 0


@dataclass(frozen=True)
class Park:
    """One of their experiments.

    Attributes:
        mode: physical, virtual or hybrid.
        tool: Of the simulation, with its world.
        kind: Of the experience.
        architecture: centralized, distributed_ros2 or distributed.
        robots: In the order of the file.
        others: Sections that are switched on and are about their own tools.
        recent: Written for the drivers of 2024 on, which read `mars_data`.
        remarks: What the reader found out about the file itself, for its user.
    """

    mode: str
    tool: str
    kind: str
    architecture: str
    robots: tuple[Robot, ...]
    others: tuple[str, ...] = ()
    recent: bool = False
    remarks: tuple[str, ...] = ()


def read(tree: Tree) -> Park:
    """The file with sections, the format since December 2023.

    Raises:
        DocumentError: With everything that is wrong with it, each with its place.
    """
    root = tree.root()
    robots = tree.need(root, "Robots", "an experiment of Robotic Park lists them as Robot01, Robot02, ...")
    operation = tree.get(root, "Operation")
    architecture = tree.words(tree.get(tree.get(root, "Architecture"), "mode"), "distributed")
    central = architecture.lower() == CENTRAL
    entries = list(tree.entries(robots))
    listed = tuple(_robot(tree, each, central=central) for each in entries)
    if robots.there and not listed:
        tree.fault(robots, "'Robots' has none", "list them as Robot01, Robot02, ...")
    check_names(tree, entries, listed)
    others, remarks = _others(tree, root)
    if central and architecture != CENTRAL:
        remarks.append(f"Architecture: {architecture}; their launcher starts a centre for '{CENTRAL}' alone, and for"
                       " this spelling nobody moves there; taken as centralized")  # fmt: skip
    park = Park(
        mode=tree.one_of(tree.get(operation, "mode"), MODES, "virtual"),
        tool=" ".join(tree.words(tree.get(operation, key)) for key in ("tool", "world")).strip(),
        kind=tree.words(tree.get(tree.get(root, "Experience"), "type"), "formation"),
        architecture=CENTRAL if central else architecture,
        robots=listed,
        others=tuple(others),
        recent=any(tree.get(entry, "mars_data").there for entry in entries),
        remarks=tuple(remarks),
    )
    tree.refuse()
    return park


def _others(tree: Tree, root: Item) -> tuple[list[str], list[str]]:
    """Sections about their own tools that are switched on, and remarks on those that change the experiment."""
    sections = ("CPU_Monitoring", "Interface", "Data_Logging", "Supervisor")
    found = [name for name in sections if tree.truth(tree.get(tree.get(root, name), "enable"), False)]
    remarks = []
    others = tree.get(root, "Other")
    for each in tree.entries(others) if others.there else ():
        if not tree.truth(tree.get(each, "enable"), False):
            continue
        if each.path[-1] == "Reconfiguration":
            remarks.append("Other.Reconfiguration: the shape changes in flight there, by a program of theirs; the first"
                           " shape is imported, and [[formation.changes]] can tell the others")  # fmt: skip
        else:
            found.append(f"Other.{each.path[-1]}")
    return found, remarks


def check_names(tree: Tree, entries: Sequence[Item], listed: Sequence[Robot]) -> None:
    """Reports names that are given twice, and relations to robots that are not there."""
    names = [robot.name for robot in listed]
    for entry, robot in zip(entries, listed, strict=True):
        if names.count(robot.name) > 1:
            tree.fault(tree.get(entry, "name"), f"two robots are called '{robot.name}'", "rename one of them")
        relationship = tree.get(tree.get(entry, "task"), "relationship")
        for relation in robot.task.relations if robot.task else ():
            if relation.name == robot.name:
                tree.fault(relationship, f"'{robot.name}' cannot keep a distance to itself", "name another robot")
            elif relation.name not in (*names, *CENTRES, *SURFACES, "line"):
                hint = did_you_mean(relation.name, [*names, "origin"])
                tree.fault(relationship, f"no robot is called '{relation.name}'", hint)


def _robot(tree: Tree, item: Item, *, central: bool) -> Robot:
    named = tree.need(item, "name", "such as dron01")
    name, kind = name_and_kind(tree, named, tree.words(named))
    speaks, control, task = (tree.get(item, key) for key in ("communication", "controller", "task"))
    # their central controller reads the relations of all robots, whatever `enable` says
    on = tree.truth(tree.get(task, "enable"), True) or (central and bool(parts(tree, task)))
    return Robot(
        name=name,
        kind=kind,
        place=tree.one_of(tree.need(item, "type", "one of: " + ", ".join(PLACES)), PLACES, "virtual"),
        pose=pose_of(tree, tree.need(item, "pose", "such as pose: 1.2, -0.5, 0.7")),
        uri=tree.words(tree.get(item, "uri")),
        host=host_of(tree, item),
        external=tree.one_of(tree.get(item, "positioning"), ("Intern", "Extern"), "Intern") == "Extern",
        speaks=_threshold(tree, speaks, tree.get(speaks, "type")),
        pose_s=1e-3 * positive(tree, tree.get(tree.get(item, "local_pose"), "T"), 20.0),
        control=_threshold(tree, control, tree.get(control, "protocol")),
        task=_task(tree, task) if on else None,
        idle=0 if on else len(parts(tree, task)),
    )


def kind_of(name: str) -> str:
    """The kind of a robot as zenpark calls it, which theirs tell by their names; empty if a name tells none."""
    return next((kind for part, kind in KINDS if part in name.lower()), "")


def name_and_kind(tree: Tree, item: Item, name: str) -> tuple[str, str]:
    """The name of a robot, checked, and its kind; `item` is where the name stands."""
    kind = kind_of(name)
    if name and not kind:
        known = ", ".join(dict.fromkeys(part for part, _ in KINDS))
        tree.fault(item, f"what kind of robot is '{name}'?", f"a name holds one of: {known}")
    if name and not NAME.fullmatch(name):
        hint = "use letters, digits and _, beginning with a letter"
        tree.fault(item, f"{name!r} cannot be the name of a robot", hint)
    return name, kind


def pose_of(tree: Tree, item: Item) -> Pose:
    """The numbers of a pose; those that are left out are 0."""
    pose = tree.numbers(item)
    if pose and len(pose) not in (2, 3):
        tree.fault(item, f"'pose' has {len(pose)} numbers", "give x, y and, if wanted, z or the yaw")
    x, y, z = (*pose, 0.0, 0.0, 0.0)[:3]
    return x, y, z


def host_of(tree: Tree, item: Item) -> str:
    """The network address of a robot on Wi-Fi, with its port if one is given; empty if there is none."""
    host = next((found for key in ("agent_ip", "ip") if (found := tree.words(tree.get(item, key)))), "")
    port = tree.words(tree.get(item, "port_number"))
    return f"{host}:{port}" if host and port else host


def parts(tree: Tree, task: Item) -> list[str]:
    """The relations of a task, as they are written."""
    written = (part.strip() for part in tree.words(tree.get(task, "relationship")).split(","))
    return [part for part in written if part and part.lower() not in NOTHING]


def relations(tree: Tree, task: Item, kind: str) -> tuple[Relation, ...]:
    """The relations of a task of a kind, distance or pose."""
    item = tree.get(task, "relationship")
    found = (_relation(tree, item, part, kind) for part in parts(tree, task))
    return tuple(each for each in found if each is not None)


def _threshold(tree: Tree, item: Item, how: Item) -> Threshold:
    table = tree.get(item, "threshold")
    event = tree.one_of(how, ("Continuous", "EventBased"), "Continuous") == "EventBased"
    constant = tree.number(tree.get(table, "co"), 0.01)
    if event and constant <= 0.0:
        tree.fault(tree.get(table, "co"), "a threshold of 0 or less is crossed always", "give metres, such as 0.01")
    return Threshold(
        event, constant, tree.number(tree.get(table, "ai"), 0.0), tree.words(tree.get(table, "type"), "Constant")
    )


def _task(tree: Tree, item: Item) -> Task | None:
    if not item.there:
        return None
    kind = tree.one_of(tree.need(item, "type", "distance or pose"), ("distance", "pose"), "distance")
    law = tree.get(item, "controller")
    name, _, signal = tree.words(tree.get(law, "type"), "gradient").partition("_")
    period = positive(tree, tree.get(law, "period"), 0.1)
    step = period if signal == "v" else 1.0  # their laws named _v give a velocity, the others a step
    high, low = tree.number(tree.get(law, "upperLimit"), 0.1), tree.number(tree.get(law, "lowerLimit"), -0.1)
    clamp = min(high, -low)
    if clamp <= 0.0:
        tree.fault(
            tree.get(law, "upperLimit"), "no step lies between lowerLimit and upperLimit", "such as -0.1 and 0.1"
        )
    tree.need(item, "relationship", FORM)
    return Task(
        kind=kind,
        relations=relations(tree, item, kind),
        law=name,
        gain=step * positive(tree, tree.get(law, "gain"), 0.1),
        clamp=step * clamp,
        period=period,
        update=_threshold(tree, law, tree.get(law, "protocol")),
        role=tree.words(tree.get(item, "role"), "consensus"),
    )


def _relation(tree: Tree, item: Item, part: str, kind: str) -> Relation | None:
    name, *rest = part.split("_")
    try:
        if name in CENTRES and len(rest) == 1 and re.fullmatch(r"[\d.]+(-[\d.]+){3}", rest[0]):
            radius, x, y, z = (float(each) for each in rest[0].split("-"))
            return Relation("origin", (radius,), (x, y, z))
        if name in SURFACES:
            return Relation(name, ())
        values = tuple(float(each) for each in rest)
    except ValueError:
        values = (math.nan,)
    name = "origin" if name in CENTRES else "line" if name.startswith("line") else name
    counts = {"origin": (1, 3), "line": (6,)}.get(name, (3,) if kind == "pose" else (1,))
    if len(values) not in counts or not all(map(math.isfinite, values)):
        tree.fault(item, f"'{part}' is no relation of a {kind} task", FORM)
        return None
    if len(values) == 1 and values[0] <= 0.0:
        tree.fault(item, f"'{part}' asks for a distance that is not positive", "give metres, such as 0.8")
        return None
    return Relation(name, values)


def positive(tree: Tree, item: Item, default: float) -> float:
    """A number above 0."""
    found = tree.number(item, default)
    if found <= 0.0:
        tree.fault(item, f"'{item.name}' must be more than 0, not {found:g}")
        return default
    return found
