"""Experiment files of Robotic Park's authors (organisation Robotic-Park-Lab), as typed records.

Three formats. *Sections* (since December 2023): Operation, Architecture and Robots; periods named T are milliseconds,
the others seconds. Two of 2023: *flat*, whose keys are robots, each with its communication and task; and an *index*,
whose keys are robots with a start and the flat file (`config_path`) of that one robot. In those of 2023 gain and limit
of the law stand in the programs of that time: 0.25 and 0.08 m (0.32 m, divided by 4) per decision.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeAlias, TypeVar

import msgspec
import yaml
from msgspec import Meta, Struct

from agents.plugins.registry import did_you_mean
from experiments.file.problems import DocumentError, at_offset, refusal
from experiments.file.text import content

T = TypeVar("T")
Pose: TypeAlias = tuple[float, float, float]
Threshold: TypeAlias = (
    tuple[float, float] | None
)  # c0 and a of an event trigger c0 + a·|·|; None: no event is waited for
Number = Annotated[float, Meta(ge=-1e12, le=1e12)]
Positive = Annotated[float, Meta(gt=0, le=1e12)]
KINDS: Final = {  # their launcher knows robots by parts of their names as well
    "dron": "crazyflie",
    "crazyflie": "crazyflie",
    "khepera": "khepera4",
    "turtlebot": "turtlebot3",
    "burger": "turtlebot3",
    "tello": "tello",
}
CENTRAL: Final = "centralized"
CENTRES: Final = ("origin", "sphere")
NOTHING: Final = ("none", "null")  # a relationship without another end
SURFACES: Final = ("cone", "ellipsoid")
PLACES: Final = ("origin", "line", *SURFACES)  # relations that are no robots
NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
FORM: Final = "write name_d, name_x_y_z or origin_R, separated by commas"
OLDER: Final = {"config_path", "communication", "task", "agent_ip", "control_mode"}  # a table with one is a robot
OLDER_GAIN: Final = 0.25
OLDER_CLAMP: Final = 0.08  # [m]
WORD: Final = re.compile(r'"[^"]*"|#[^\n]*|[{}\[\]]|[^\s{}\[\]"#]+')  # of a Webots world


@dataclass(frozen=True)
class Relation:
    """Link of a robot to another, or to a place: origin, line or a surface."""

    name: str
    values: tuple[float, ...]
    centre: Pose | None = None  # [m] of an origin that stands elsewhere


@dataclass(frozen=True)
class Task:
    """Part of a robot in the formation."""

    kind: str  # distance or pose
    relations: tuple[Relation, ...]
    law: str  # gradient, pid, or another of theirs
    gain: float  # per decision
    clamp: float  # largest step of a decision [m]
    period: float  # [s]
    update: Threshold
    role: str


@dataclass(frozen=True)
class Robot:
    """Robot of theirs."""

    name: str
    kind: str  # as zenpark calls it
    place: str  # physical, virtual or digital_twin
    pose: Pose | None  # x, y [m] and z [m]; on wheels the yaw [rad] instead of z; None: not in the file
    uri: str  # of a Crazyflie
    host: str  # of a robot on Wi-Fi, with its port if there is one
    external: bool  # position measured from outside
    communication: Threshold
    pose_s: float  # period of its pose [s]
    gated: bool  # its position controller acts on events
    task: Task | None  # None without one, or if it is switched off
    idle: int  # relations of a task that is switched off


@dataclass(frozen=True)
class Park:
    """Experiment of theirs."""

    mode: str  # physical, virtual or hybrid
    robots: tuple[Robot, ...]
    central: bool = False  # decided by a central controller
    recent: bool = False  # for the drivers of 2024 on, which read `mars_data`

    @property
    def tasks(self) -> list[tuple[Robot, Task]]:
        return [(robot, robot.task) for robot in self.robots if robot.task is not None]


class _Threshold(Struct, frozen=True):
    type: str = "Constant"
    co: Number | None = None
    threshold: Number | None = None  # for `co`, in 2023
    ai: Number | Literal["None", "none", "Null", "null"] = 0.0


class _Communication(Struct, frozen=True):
    type: Literal["Continuous", "EventBased", "EvenBased"] = "Continuous"  # both are written
    threshold: _Threshold = _Threshold()


class _Law(Struct, frozen=True):
    protocol: Literal["Continuous", "EventBased"] = "Continuous"
    threshold: _Threshold = _Threshold()
    type: str = "gradient"
    period: Positive = 0.1
    gain: Positive = 0.1
    upperLimit: Number = 0.1  # noqa: N815 - theirs
    lowerLimit: Number = -0.1  # noqa: N815


class _Task(Struct, frozen=True):
    type: Literal["distance", "pose", "relative_pose"] = "distance"
    relationship: str = ""
    role: str = "consensus"
    controller: _Law = _Law()
    T: Positive = 100.0


class _Switch(Struct, frozen=True):
    enable: bool = False


class _TaskHead(Struct, frozen=True):
    """Head of a task: all that is read of a task that is switched off."""

    enable: bool = True
    relationship: str = ""


class _Timed(Struct, frozen=True):
    T: Positive = 20.0


class _Protocol(Struct, frozen=True):
    protocol: Literal["Continuous", "EventBased"] = "Continuous"


class _Robot(Struct, frozen=True):
    """Settings of a robot, those of all formats."""

    name: str = ""
    id: str = ""
    type: Literal["physical", "virtual", "digital_twin"] = "virtual"
    pose: str | list[Number] | dict[str, Number] | None = None
    uri: str = ""
    agent_ip: str = ""
    ip: str = ""
    port_number: str | int = ""
    positioning: Literal["Intern", "Extern", "MoCap"] = "Intern"
    communication: _Communication | Literal["Continuous", "EventBased", "EvenBased"] = _Communication()
    local_pose: _Timed = _Timed()
    controller: _Protocol = _Protocol()
    controller_type: str = ""
    init_theta: Number = 0.0
    config_path: str = ""


class _Operation(Struct, frozen=True):
    mode: Literal["physical", "virtual", "hybrid"] = "virtual"
    tool: str = ""
    world: str = ""


class _Kind(Struct, frozen=True):
    type: str = "formation"  # of the experience
    mode: str = "distributed"  # of the architecture


@dataclass(frozen=True)
class Entry:
    """A value of a YAML file, with the file and the path of its key."""

    file: str
    key: str
    value: Any

    @property
    def name(self) -> str:
        return self.key.rpartition(".")[2]

    def has(self, key: str) -> bool:
        return isinstance(self.value, dict) and key in self.value

    def get(self, key: str) -> Entry:
        """The value of a key; an empty table if there is none."""
        path = f"{self.key}.{key}" if self.key else key
        return Entry(self.file, path, self.value[key] if self.has(key) else {})

    def tables(self) -> list[Entry]:
        return [self.get(key) for key, value in self.typed(dict[str, Any]).items() if isinstance(value, dict)]

    def refused(self, message: str, hint: str = "") -> DocumentError:
        return refusal(self.file, f"{self.key or 'the file'}: {message}", hint)

    def typed(self, kind: type[T]) -> T:
        """The value as `kind`; numbers and truth values may stand in quotes.

        Raises:
            DocumentError: With the path of the key that does not fit.
        """
        try:
            return msgspec.convert(self.value, kind, strict=False)
        except msgspec.ValidationError as error:
            message, _, below = str(error).partition(" - at `$")
            raise replace(self, key=(self.key + below.rstrip("`")).strip(".")).refused(message) from None


class _Loader(yaml.SafeLoader):  # type: ignore[misc] # PyYAML has no types
    """PyYAML's safe loader, which refuses a key that stands twice, and drops keys that hold nothing; keys are text."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:  # noqa: ANN401 - as PyYAML has it
        keys = set()
        for key, _ in node.value:
            if key.value in keys and isinstance(key, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(
                    None, None, f"'{key.value}' stands twice in its table", key.start_mark
                )
            keys.add(str(key.value))
        made = super().construct_mapping(node, deep)
        return {str(key): value for key, value in made.items() if value is not None}


def load(file: str, text: str) -> Entry:
    """The table that a YAML file holds; nothing in it is ever executed.

    Raises:
        DocumentError: If it is no YAML, or no table.
    """
    try:
        value = yaml.load(text, _Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        words = " ".join(part for part in (error.context, error.problem) if part)
        hint = "check the indentation, the colons and the quotes there"
        raise DocumentError([at_offset(file, text, mark.index if mark else 0, words, hint)]) from None
    except (yaml.YAMLError, RecursionError, ValueError, TypeError) as error:  # a character, nesting, a date, a key
        raise refusal(file, f"is no YAML: {error}", "write it out in plain tables") from None
    if not isinstance(value, dict):
        hint = "an experiment of Robotic Park has sections such as Operation and Robots"
        raise refusal(file, "is no table of sections", hint)
    return Entry(file, "", value)


def read(file: str, text: str, poses: Mapping[str, Pose], notes: list[str]) -> Park:
    """An experiment, in whichever of the formats; `notes` gets what is not carried over.

    Args:
        file: Its name: `config_path` is meant from its folder.
        poses: Of robots by name, from elsewhere; they go before those of the file.

    Raises:
        DocumentError: With all errors in it and in the files that it names, by the paths of the keys.
    """
    root = load(file, text)
    older = [] if root.has("Robots") else [each for each in root.tables() if OLDER & each.value.keys()]
    park = _older(file, older, notes) if older else _sections(root, notes)
    return replace(park, robots=tuple(replace(each, pose=poses.get(each.name, each.pose)) for each in park.robots))


def _sections(root: Entry, notes: list[str]) -> Park:
    """The format since December 2023."""
    hint = "an experiment of Robotic Park lists them as Robot01, Robot02, ..."
    if not root.has("Robots"):
        raise root.refused("'Robots' is missing", hint)
    given, entries = root.get("Operation").typed(_Operation), root.get("Robots").tables()
    if not entries:
        raise root.get("Robots").refused("has none", hint)
    if given.tool and given.mode != "physical":
        tool = f"{given.tool} {given.world}".strip()
        notes.append(f"Operation: the simulator and its world ({tool}); twins are zenpark's own, in an empty arena")
    if (kind := root.get("Experience").typed(_Kind).type) != "formation":
        notes.append(f"Experience: type {kind}; only formations are known")
    mode = root.get("Architecture").typed(_Kind).mode
    central = mode.lower() == CENTRAL
    if central and mode != CENTRAL:
        notes.append(f"Architecture: {mode}; their launcher starts a centre for '{CENTRAL}' alone, and for this"
                     " spelling no robot moves there; taken as centralized")  # fmt: skip
    elif not central and mode != "distributed":
        notes.append(f"Architecture: {mode}; every robot decides for itself here")
    tools = [root.get(name) for name in ("CPU_Monitoring", "Interface", "Data_Logging", "Supervisor")]
    on = [each.key for each in (*tools, *root.get("Other").tables()) if each.typed(_Switch).enable]
    if "Other.Reconfiguration" in on:
        on.remove("Other.Reconfiguration")
        notes.append("Other.Reconfiguration: the shape changes in flight there, by a program of theirs; the first"
                     " shape is imported, and [[formation.changes]] can tell the others")  # fmt: skip
    if on:
        notes.append(f"{', '.join(on)}: zenpark records, watches and reports by itself")
    robots = _robots(entries, lambda entry: _robot(entry, entry, notes, central=central))
    return Park(given.mode, robots, central, any(entry.has("mars_data") for entry in entries))


def _older(file: str, entries: Sequence[Entry], notes: list[str]) -> Park:
    """The flat files and the indices of 2023."""
    notes.append(
        "law: gain and limit are not in files of 2023; 0.25 and 0.08 m per decision, as in the programs of that time"
    )
    settings = {entry.key: _settings(entry, Path(file).parent) for entry in entries}
    # entries that only let the drones' driver publish where another robot of the file is
    marks = [
        key
        for key, own in settings.items()
        if own.typed(_Robot).name in settings.keys() - {key} and not own.get("task").typed(_TaskHead).enable
    ]
    if marks:
        notes.append(f"{', '.join(marks)}: the marker of a robot that stands in the file already")
    entries = [entry for entry in entries if entry.key not in marks]
    robots = _robots(entries, lambda entry: _robot(entry, settings[entry.key], notes, older=True), alone=True)
    addresses = [f"{robot.name} {robot.host}" for robot in robots if robot.host]
    if addresses and not any(entry.has("config_path") for entry in entries):
        notes.append(
            "the file does not say which robots are real: all are twins here; addresses in it: " + ", ".join(addresses)
        )
    kinds = {robot.place for robot in robots}
    return Park(kinds.pop() if len(kinds) == 1 else "hybrid", robots)


def _settings(entry: Entry, folder: Path) -> Entry:
    """The settings of a robot: its entry, or what the file that an index names for it holds."""
    name = entry.typed(_Robot).config_path
    if not name:
        return entry
    file = folder / name
    try:
        tables = load(str(file), content(file, str(file))).tables()
    except OSError:
        hint = "put the files of its robots beside the index"
        raise entry.refused(f"there is no file '{name}' beside this one", hint) from None
    if not tables:
        raise refusal(str(file), "has no robot", f"write its settings under '{entry.name}:'")
    return next((each for each in tables if each.name == entry.name), tables[0])


def _robots(entries: Sequence[Entry], made: Callable[[Entry], Robot], *, alone: bool = False) -> tuple[Robot, ...]:
    """A robot from each entry; the problems of all of them at once.

    Args:
        alone: A file can hold one robot of an experiment, which says nothing without the others.
    """
    robots, problems = list[Robot](), []
    for entry in entries:
        try:
            robots.append(made(entry))
        except DocumentError as error:
            problems += error.problems
    if problems:
        raise DocumentError(problems)
    names = [robot.name for robot in robots]
    for entry, robot in zip(entries, robots, strict=True):
        if names.count(robot.name) > 1:
            raise entry.refused(f"two robots are called '{robot.name}'", "rename one of them")
        for relation in robot.task.relations if robot.task else ():
            if relation.name == robot.name:
                raise entry.refused(f"'{robot.name}' cannot keep a distance to itself", "name another robot")
            if alone and len(robots) == 1 and relation.name not in PLACES:
                hint = "import the file that lists the robots of the experiment: an index names this one as config_path"
                raise entry.refused(f"'{robot.name}' is one robot of an experiment", hint)
            if relation.name not in (*names, *PLACES):
                hint = did_you_mean(relation.name, [*names, "origin"])
                raise entry.refused(f"no robot is called '{relation.name}'", hint)
    return tuple(robots)


def _robot(entry: Entry, own: Entry, notes: list[str], *, central: bool = False, older: bool = False) -> Robot:
    """A robot; an index of 2023 keeps what it lists (`entry`) apart from the robot's own settings."""
    for key in () if older else ("name", "type", "pose"):
        if not entry.has(key):
            raise entry.refused(f"'{key}' is missing", "such as name: dron01, type: virtual, pose: 1.2, -0.5, 0.7")
    listed, given, task = entry.typed(_Robot), own.typed(_Robot), own.get("task")
    name = listed.name or listed.id or entry.name
    kind = kind_of(name)
    if not kind:
        raise entry.refused(f"what kind of robot is '{name}'?", f"a name holds one of: {', '.join(KINDS)}")
    if not NAME.fullmatch(name):
        hint = "use letters, digits and _, beginning with a letter"
        raise entry.refused(f"{name!r} cannot be the name of a robot", hint)
    head = task.typed(_TaskHead)
    relations = _parts(head.relationship)
    # their central controller reads the relations of all robots, whatever `enable` says
    on = own.has("task") and (head.enable or (central and bool(relations)))
    if on and not older and not (task.has("type") and task.has("relationship")):
        raise task.refused("type or relationship is missing", f"write distance or pose; {FORM}")
    pose = listed.pose
    if isinstance(pose, dict):
        pose = [pose.get("x", 0.0), pose.get("y", 0.0)]
    place = None if pose is None else pose_of(entry.get("pose"), pose)
    host, speaks = given.agent_ip or given.ip, given.communication
    if not isinstance(speaks, _Communication):
        speaks = _Communication(speaks)  # a word, in 2023
    return Robot(
        name=name,
        kind=kind,
        place=listed.type,
        pose=place and (*place[:2], place[2] or given.init_theta),  # Kheperas of 2023 have their yaw apart
        uri=listed.uri,
        host=f"{host}:{given.port_number}" if host and given.port_number else host,
        external=given.positioning != "Intern",
        communication=_threshold(own.get("communication"), speaks.threshold, notes, event=speaks.type != "Continuous"),
        pose_s=1e-3 * given.local_pose.T,
        gated=given.controller.protocol == "EventBased" or "EventBased" in given.controller_type,
        task=_task(task, notes, older=older) if on else None,
        idle=0 if on else len(relations),
    )


def kind_of(name: str) -> str:
    """Kind of a robot in zenpark by its name; empty for a name without a known kind."""
    return next((kind for part, kind in KINDS.items() if part in name.lower()), "")


def pose_of(entry: Entry, pose: str | list[float]) -> Pose:
    """x, y and z or yaw of a text or a list; 0 where left out."""
    parts = [part for part in re.split(r"[,\s]+", pose) if part] if isinstance(pose, str) else pose
    values = replace(entry, value=parts).typed(list[Number])
    if len(values) not in (2, 3):
        raise entry.refused(f"has {len(values)} numbers", "give x, y and, if wanted, z or the yaw")
    x, y, z = (*values, 0.0)[:3]
    return x, y, z


def _threshold(entry: Entry, given: _Threshold, notes: list[str], *, event: bool) -> Threshold:
    if not event:
        return None
    constant = next((each for each in (given.co, given.threshold) if each is not None), 0.01)
    if constant <= 0.0:
        raise entry.refused("a threshold of 0 or less is crossed always", "give metres, such as 0.01")
    if given.type != "Constant":
        what = entry.name.replace("task", "task.controller")
        notes.append(f"{what}.threshold.type: {given.type}; taken as a constant one with what ai adds")
    return constant, 0.0 if isinstance(given.ai, str) else given.ai


def _task(entry: Entry, notes: list[str], *, older: bool) -> Task:
    given, law = entry.typed(_Task), entry.typed(_Task).controller
    kind = "distance" if given.type == "distance" else "pose"
    relations = tuple(_relation(entry, part, kind) for part in _parts(given.relationship))
    if older:
        return Task(kind, relations, "gradient", OLDER_GAIN, OLDER_CLAMP, 1e-3 * given.T, None, given.role)
    name, _, signal = law.type.partition("_")
    step = law.period if signal == "v" else 1.0  # their laws named _v give a velocity, the others a step
    clamp = min(law.upperLimit, -law.lowerLimit)
    if clamp <= 0.0:
        raise entry.refused("no step lies between lowerLimit and upperLimit", "such as -0.1 and 0.1")
    update = _threshold(entry, law.threshold, notes, event=law.protocol == "EventBased")
    return Task(kind, relations, name, step * law.gain, step * clamp, law.period, update, given.role)


def _parts(relationship: str) -> list[str]:
    """The relations of a task, as they are written."""
    return [part for each in relationship.split(",") if (part := each.strip()) and part.lower() not in NOTHING]


def _relation(entry: Entry, part: str, kind: str) -> Relation:
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
        raise entry.refused(f"'{part}' is no relation of a {kind} task", FORM)
    if len(values) == 1 and values[0] <= 0.0:
        raise entry.refused(f"'{part}' asks for a distance that is not positive", "give metres, such as 0.8")
    return Relation(name, values)


def starts_from(file: str) -> dict[str, Pose]:
    """Starts of robots by name: from an index or experiment (.yaml), or a Webots world (.wbt).

    Raises:
        DocumentError: If the file cannot be read, or tells no start.
    """
    hint = "name an index of robots (.yaml) or a Webots world (.wbt)"
    try:
        text = content(Path(file), file)
    except FileNotFoundError:
        raise refusal(file, "there is no such file", hint) from None
    found = (_world if Path(file).suffix.lower() == ".wbt" else _index)(file, text)
    if not found:
        raise refusal(file, "tells the start of no robot", hint)
    return found


def _index(file: str, text: str) -> dict[str, Pose]:
    root = load(file, text)
    listed = (root.get("Robots") if root.has("Robots") else root).tables()
    return {
        str(each.value.get("name", each.name)): pose_of(each.get("pose"), each.value["pose"])
        for each in listed
        if each.has("pose") and not isinstance(each.value["pose"], dict)
    }


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
