"""Experiment files of Robotic Park's authors (organisation Robotic-Park-Lab), as typed records.

What their launcher and drivers read of them, as of 2025: sections Operation, Architecture and Robots; for each robot
its pose, address, communication and task. Periods named T are milliseconds, the others seconds.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Final

from agents.plugins import did_you_mean
from experiments.yaml_tree import Item, Tree

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
CENTRES: Final = ("origin", "sphere")
SURFACES: Final = ("cone", "ellipsoid")
NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
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
        gain: Of it.
        clamp: Largest step [m].
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
        pose: x, y, z [m].
        uri: Of a Crazyflie.
        host: Of a robot on Wi-Fi, with its port if there is one.
        external: Whether its position is measured from outside.
        speaks: When it sends its pose.
        pose_s: How often it looks at its pose [s].
        control: Of its own position controller.
        task: None if it has none.
    """

    name: str
    kind: str
    place: str
    pose: tuple[float, float, float]
    uri: str
    host: str
    external: bool
    speaks: Threshold
    pose_s: float
    control: Threshold
    task: Task | None


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
    """

    mode: str
    tool: str
    kind: str
    architecture: str
    robots: tuple[Robot, ...]
    others: tuple[str, ...]


def read(tree: Tree) -> Park:
    """Their file.

    Raises:
        DocumentError: With everything that is wrong with it, each with its place.
    """
    root = tree.root()
    robots = tree.need(root, "Robots", "an experiment of Robotic Park lists them as Robot01, Robot02, ...")
    operation = tree.get(root, "Operation")
    listed = tuple(_robot(tree, each) for each in tree.entries(robots))
    if robots.there and not listed:
        tree.fault(robots, "'Robots' has none", "list them as Robot01, Robot02, ...")
    _names(tree, robots, listed)
    park = Park(
        mode=tree.one_of(tree.get(operation, "mode"), MODES, "virtual"),
        tool=" ".join(tree.words(tree.get(operation, key)) for key in ("tool", "world")).strip(),
        kind=tree.words(tree.get(tree.get(root, "Experience"), "type"), "formation"),
        architecture=tree.words(tree.get(tree.get(root, "Architecture"), "mode"), "distributed"),
        robots=listed,
        others=_others(tree, root),
    )
    tree.refuse()
    return park


def _others(tree: Tree, root: Item) -> tuple[str, ...]:
    sections = ("CPU_Monitoring", "Interface", "Data_Logging", "Supervisor")
    found = [name for name in sections if tree.truth(tree.get(tree.get(root, name), "enable"), False)]
    agents = tree.get(root, "Other")
    found += [f"Other.{each.path[-1]}" for each in _tables(tree, agents) if tree.get(each, "enable").there]
    return tuple(found)


def _tables(tree: Tree, item: Item) -> list[Item]:
    return list(tree.entries(item)) if item.there else []


def _names(tree: Tree, robots: Item, listed: tuple[Robot, ...]) -> None:
    """Is each name given once, and is everybody there of whom a relation speaks."""
    names = [robot.name for robot in listed]
    for entry, robot in zip(tree.entries(robots), listed, strict=False):
        if names.count(robot.name) > 1:
            tree.fault(tree.get(entry, "name"), f"two robots are called '{robot.name}'", "rename one of them")
        relationship = tree.get(tree.get(entry, "task"), "relationship")
        for relation in robot.task.relations if robot.task else ():
            if relation.name == robot.name:
                tree.fault(relationship, f"'{robot.name}' cannot keep a distance to itself", "name another robot")
            elif relation.name not in (*names, *CENTRES, *SURFACES, "line"):
                hint = did_you_mean(relation.name, [*names, "origin"])
                tree.fault(relationship, f"no robot is called '{relation.name}'", hint)


def _robot(tree: Tree, item: Item) -> Robot:
    name = tree.words(tree.need(item, "name", "such as dron01"))
    kind = next((kind for part, kind in KINDS if part in name.lower()), "")
    if name and not kind:
        known = ", ".join(dict.fromkeys(part for part, _ in KINDS))
        tree.fault(tree.get(item, "name"), f"what kind of robot is '{name}'?", f"a name holds one of: {known}")
    if name and not NAME.fullmatch(name):
        hint = "use letters, digits and _, beginning with a letter"
        tree.fault(tree.get(item, "name"), f"{name!r} cannot be the name of a robot", hint)
    pose = tree.numbers(tree.need(item, "pose", "such as pose: 1.2, -0.5, 0.7"))
    if pose and len(pose) not in (2, 3):
        tree.fault(tree.get(item, "pose"), f"'pose' has {len(pose)} numbers", "give x, y and, if wanted, z")
    port = tree.words(tree.get(item, "port_number"))
    host = tree.words(tree.get(item, "agent_ip"))
    speaks, control = tree.get(item, "communication"), tree.get(item, "controller")
    return Robot(
        name=name,
        kind=kind,
        place=tree.one_of(tree.need(item, "type", "one of: " + ", ".join(PLACES)), PLACES, "virtual"),
        pose=(*pose, 0.0, 0.0, 0.0)[:3],  # type: ignore[arg-type]
        uri=tree.words(tree.get(item, "uri")),
        host=f"{host}:{port}" if host and port else host,
        external=tree.one_of(tree.get(item, "positioning"), ("Intern", "Extern"), "Intern") == "Extern",
        speaks=_threshold(tree, speaks, tree.get(speaks, "type")),
        pose_s=1e-3 * _positive(tree, tree.get(tree.get(item, "local_pose"), "T"), 20.0),
        control=_threshold(tree, control, tree.get(control, "protocol")),
        task=_task(tree, tree.get(item, "task")),
    )


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
    if not item.there or not tree.truth(tree.get(item, "enable"), True):
        return None
    kind = tree.one_of(tree.need(item, "type", "distance or pose"), ("distance", "pose"), "distance")
    law = tree.get(item, "controller")
    high, low = tree.number(tree.get(law, "upperLimit"), 0.1), tree.number(tree.get(law, "lowerLimit"), -0.1)
    clamp = min(high, -low)
    if clamp <= 0.0:
        tree.fault(
            tree.get(law, "upperLimit"), "no step lies between lowerLimit and upperLimit", "such as -0.1 and 0.1"
        )
    relationship = tree.need(item, "relationship", FORM)
    found = [_relation(tree, relationship, part.strip(), kind) for part in tree.words(relationship).split(",")]
    return Task(
        kind=kind,
        relations=tuple(each for each in found if each is not None),
        law=tree.words(tree.get(law, "type"), "gradient"),
        gain=_positive(tree, tree.get(law, "gain"), 0.1),
        clamp=clamp,
        period=_positive(tree, tree.get(law, "period"), 0.1),
        update=_threshold(tree, law, tree.get(law, "protocol")),
        role=tree.words(tree.get(item, "role"), "consensus"),
    )


def _relation(tree: Tree, item: Item, part: str, kind: str) -> Relation | None:
    if not part:
        return None
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


def _positive(tree: Tree, item: Item, default: float) -> float:
    found = tree.number(item, default)
    if found <= 0.0:
        tree.fault(item, f"'{item.name}' must be more than 0, not {found:g}")
        return default
    return found
