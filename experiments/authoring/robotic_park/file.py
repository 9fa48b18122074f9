"""Experiment files of Robotic Park's authors (organisation Robotic-Park-Lab), as typed records.

Three formats. *Sections* (since December 2023): Operation, Architecture and Robots; periods named T are milliseconds,
the others seconds. Two of 2023: *flat*, with robots as keys, each with its communication and task; and an *index*, with
robots as keys, each with a start and its own flat file (`config_path`). In those of 2023 the programs of that time
define gain and limit of the law: 0.25 and 0.08 m (0.32 m, divided by 4) per decision.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple, TypeAlias, TypeVar

import msgspec
import yaml
from msgspec import Meta, Struct

from agents.body.kinds import KINDS
from agents.errors import did_you_mean, join_names
from experiments.file.problems import DocumentError, Problem, at_offset, refusal
from experiments.file.text import content

T = TypeVar("T")
Pose: TypeAlias = tuple[float, float, float]
When: TypeAlias = Literal["Continuous", "EventBased", "EvenBased"]  # both spellings are theirs
Number = Annotated[float, Meta(ge=-1e12, le=1e12)]
Positive = Annotated[float, Meta(gt=0, le=1e12)]
LENGTH: Final = Meta(min_length=2, max_length=3)  # numbers of a pose
CENTRAL: Final = "centralized"
CENTRES: Final = ("origin", "sphere")
MISSING: Final = "there is no such file"
NOTHING: Final = ("none", "null")  # a relationship without another end
SURFACES: Final = ("cone", "ellipsoid")
PLACES: Final = ("origin", "line", *SURFACES)  # relations that are no robots
TASKS: Final = ("distance", "pose", "relative_pose")
NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
TOOLS: Final = ("CPU_Monitoring", "Interface", "Data_Logging", "Supervisor")
EXAMPLES: Final = {  # text of each key
    "name": "name: dron01", "type": "type: virtual", "pose": "pose: 0.5, 0.5, 0.0",
    "uri": "uri: radio://0/80/2M/E7E7E7E701", "initial_position": "initial_position: [0.0, 0.5, 0.0]",
    "initialPosition": "initialPosition: [0.0, 0.5, 0.0]", "id": "id: 1", "channel": "channel: 80",
}  # fmt: skip
OLDER: Final = {"pose", "config_path", "communication", "task", "agent_ip", "control_mode"}  # keys of a robot of 2023
OLDER_LAW: Final = {"gain": 0.25, "upperLimit": 0.08, "lowerLimit": -0.08}
WORD: Final = re.compile(r'"[^"]*"|#[^\n]*|[{}\[\]]|[^\s{}\[\]"#]+')  # word of a Webots world


class Relation(NamedTuple):
    """Link of a robot to another, or to a place: origin, line or a surface."""

    name: str
    values: tuple[float, ...]  # a distance, and of an origin that stands elsewhere its place; or a place; or a line


class _Threshold(Struct, frozen=True):
    type: str = "Constant"
    co: Number | None = None
    threshold: Number | None = None  # value for `co`, in 2023
    ai: Number | Literal["None", "none", "Null", "null"] = 0.0


class ParkTrigger(Struct, frozen=True):
    """Time at which something is done: always, or on events."""

    protocol: When = "Continuous"
    threshold: _Threshold = _Threshold()

    @property
    def event(self) -> tuple[float, float] | None:
        """c0 and a of a threshold c0 + a·|·|; None if no event is waited for."""
        if self.protocol == "Continuous":
            return None
        constant = next(each for each in (self.threshold.co, self.threshold.threshold, 0.01) if each is not None)
        if constant <= 0.0:
            raise ValueError("a threshold of 0 or less is crossed always: give metres, such as 0.01")
        return constant, 0.0 if isinstance(self.threshold.ai, str) else self.threshold.ai


class _Communication(ParkTrigger, frozen=True):
    protocol: When = msgspec.field(default="Continuous", name="type")


class _Law(ParkTrigger, frozen=True, rename="camel"):
    type: str = "gradient"
    period: Positive | None = None  # [s]
    gain: Positive = 0.1
    upper_limit: Number = 0.1
    lower_limit: Number = -0.1


class Task(Struct, frozen=True, rename={"period_ms": "T"}):
    """Part of a robot in the formation; of one that is switched off the relations are only counted."""

    enable: bool = True
    type: str = "distance"
    relationship: str = ""
    role: str = "consensus"
    controller: _Law = _Law()
    period_ms: Positive = 100.0

    def __post_init__(self) -> None:
        if not self.enable:
            return
        if self.type not in TASKS:
            raise ValueError(f"the type '{self.type}' is unknown: write {', '.join(TASKS)}")
        if self.step[1] <= 0.0:
            raise ValueError("no step lies between lowerLimit and upperLimit: give such as -0.1 and 0.1")
        _ = self.relations, self.controller.event  # what is wrong in them has the path of the task

    @property
    def written(self) -> list[str]:
        """The relations, as they are written."""
        parts = [each.strip() for each in self.relationship.split(",")]
        return [part for part in parts if part and part.lower() not in NOTHING]

    @property
    def kind(self) -> str:
        return "distance" if self.type == "distance" else "pose"

    @property
    def relations(self) -> list[Relation]:
        return [_relation(part, self.kind) for part in self.written]

    @property
    def law(self) -> str:
        """Law of the task: gradient, pid, or another of theirs."""
        return self.controller.type.partition("_")[0]

    @property
    def period(self) -> float:
        """Time between decisions [s], of all drivers but one: see `ParkExperiment.period`."""
        return self.controller.period or 1e-3 * self.period_ms

    @property
    def step(self) -> tuple[float, float]:
        """Gain, and largest step [m], of a decision: their laws named _v give a velocity, the others a step."""
        law = self.controller
        scale = self.period if law.type.partition("_")[2] == "v" else 1.0
        return scale * law.gain, scale * min(law.upper_limit, -law.lower_limit)


class _Timed(Struct, frozen=True):
    T: Positive = 20.0  # [ms]


class DriverBehaviour(NamedTuple):
    """Behaviour of the authors' driver of a kind that those in Webots and the central controller lack."""

    plans_alone: bool = False  # True with the period of the task, and an origin of its own
    divides: bool = False  # the pull of a neighbour by its distance


DRIVERS: Final = {"crazyflie": DriverBehaviour(plans_alone=True), "khepera4": DriverBehaviour(divides=True)}


class ParkRobot(Struct, frozen=True):
    """Robot of theirs."""

    name: str
    type: Literal["physical", "virtual", "digital_twin"]
    pose: Annotated[list[Number], LENGTH] | Annotated[dict[str, Number], LENGTH] | None
    uri: str = ""  # address of a Crazyflie
    agent_ip: str = ""
    ip: str = ""
    port_number: str | int = ""
    positioning: Literal["Intern", "Extern", "MoCap"] = "Intern"
    communication: _Communication = _Communication()
    local_pose: _Timed = _Timed()
    controller: ParkTrigger = ParkTrigger()  # trigger of the position
    controller_type: str = ""
    init_theta: Number = 0.0  # [rad] heading of Kheperas of 2023, with a pose of two numbers
    task: Task = Task(enable=False)
    config_path: str = ""  # path in an index

    def __post_init__(self) -> None:
        if not self.kind:
            known = ", ".join(part for kind in KINDS.usable() for part in kind.aliases)
            hint = f"use letters, digits and _, and in it one of {known}"
            raise ValueError(f"no kind of robot is in the name '{self.name}': {hint}")
        _ = self.communication.event

    @property
    def kind(self) -> str:
        return kind_of(self.name)

    @property
    def driver(self) -> DriverBehaviour:
        """Of a real robot; in Webots drivers have nothing of their own."""
        return DriverBehaviour() if self.type == "virtual" else DRIVERS.get(self.kind, DriverBehaviour())

    @property
    def start(self) -> Pose | None:
        """x, y [m], and z [m] or, on wheels, the yaw [rad]; None: not in the file."""
        if self.pose is None:
            return None
        pose = [self.pose.get(axis, 0.0) for axis in "xyz"] if isinstance(self.pose, dict) else self.pose
        x, y, z = (*pose, 0.0)[:3]
        return x, y, z or self.init_theta

    @property
    def host(self) -> str:
        """Address of a robot on Wi-Fi, with its port if there is one."""
        host = self.agent_ip or self.ip
        return f"{host}:{self.port_number}" if host and self.port_number else host


class _Operation(Struct, frozen=True):
    mode: Literal["physical", "virtual", "hybrid"] = "virtual"
    tool: str = ""
    world: str = ""


class _Section(Struct, frozen=True):
    type: str = "formation"  # type of the experience
    mode: str = "distributed"  # architecture
    enable: bool = False


class _Sections(Struct, frozen=True, rename="pascal"):
    operation: _Operation = _Operation()
    experience: _Section = _Section()
    architecture: _Section = _Section()
    robots: dict[str, Any] = {}
    other: dict[str, Any] = {}


@dataclass(frozen=True)
class ParkExperiment:
    """Experiment of theirs."""

    mode: str  # physical, virtual, hybrid
    robots: list[ParkRobot]
    central: bool  # decided by a central controller
    recent: bool  # True for drivers of 2024, which read `mars_data`; the first have the law of before, later ones not

    def period(self, robot: ParkRobot) -> float:
        """Time between decisions of a robot [s]."""
        own = robot.driver.plans_alone and not self.central
        return 1e-3 * robot.task.period_ms if own else robot.task.period

    @property
    def tasks(self) -> list[tuple[ParkRobot, Task]]:
        return [(robot, robot.task) for robot in self.robots if robot.task.enable]


class YamlValue(NamedTuple):
    """Value of a YAML file, with the file and the path of its key."""

    file: str
    key: str
    value: Any

    def typed(self, kind: type[T]) -> T:
        """The value as `kind`; numbers and truth values may stand in quotes.

        Raises:
            DocumentError: With the path of the key that does not fit.
        """
        try:
            return msgspec.convert(self.value, kind, strict=False)
        except msgspec.ValidationError as error:
            words, _, below = str(error).partition(" - at `$")
            key = (self.key + below.rstrip("`")).strip(".")
            if missing := re.search(r"missing required field `(\w+)`", words):
                words = f"{missing[1]} is missing: write {EXAMPLES.get(missing[1], missing[1])}"
            elif words.startswith(("Expected `array` of length", "Expected `object | array | null`")):
                words += ": give x, y and, if wanted, z or the yaw"
            message, _, hint = words.partition(": ")
            raise refusal(self.file, f"{key or 'the file'}: {message}", hint) from None

    def tables(self) -> list[YamlValue]:
        """The tables in it."""
        path, found = f"{self.key}." if self.key else "", self.value.items()
        return [YamlValue(self.file, path + key, value) for key, value in found if isinstance(value, dict)]


class _Loader(yaml.SafeLoader):  # type: ignore[misc] # PyYAML has no types
    """PyYAML's safe loader that refuses keys that stand twice, drops those that hold nothing, and splits poses.

    Aliases are refused, because a few lines of them stand for more values than any machine holds.
    """

    def compose_node(self, parent: Any, index: Any) -> Any:  # noqa: ANN401 - as PyYAML has it
        if self.check_event(yaml.AliasEvent):
            alias = self.peek_event()
            words = f"the alias '*{alias.anchor}' is not read; write out what it stands for"
            raise yaml.composer.ComposerError(None, None, words, alias.start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:  # noqa: ANN401 - as PyYAML has it
        keys = set()
        for key, _ in node.value:
            if key.value in keys and isinstance(key, yaml.ScalarNode):
                words = f"'{key.value}' stands twice in its table"
                raise yaml.constructor.ConstructorError(None, None, words, key.start_mark)
            keys.add(str(key.value))
        made = {str(key): value for key, value in super().construct_mapping(node, deep).items() if value is not None}
        if isinstance(pose := made.get("pose"), str):
            made["pose"] = re.findall(r"[^,\s]+", pose)
        return made


def text_of(file: str, hint: str) -> str:
    """The text of a file that the user named; raises DocumentError, with the hint if there is none."""
    try:
        return content(Path(file), file)
    except FileNotFoundError:
        raise refusal(file, MISSING, hint) from None


def load(file: str, text: str) -> YamlValue:
    """The table that a YAML file holds; nothing in it is ever executed.

    Raises:
        DocumentError: If it is no YAML, or no table.
    """
    if Path(file).suffix.lower() in {".toml", ".json"}:
        raise refusal(file, "is no file of Robotic Park's authors, which are YAML", f"./zenpark check {file}")
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
        hint = "an experiment of Robotic Park has sections such as Operation and Robots; one of Crazyswarm2 has robots"
        raise refusal(file, "is no table of sections", hint)
    return YamlValue(file, "", value)


def read(file: str, text: str, poses: Mapping[str, Pose], notes: list[str]) -> ParkExperiment:
    """An experiment, in whichever of the formats; `notes` gets what is not carried over.

    Args:
        file: Its name: `config_path` is meant from its folder.
        poses: Of robots by name, from elsewhere; they go before those of the file.

    Raises:
        DocumentError: With the errors of all robots, by the paths of the keys, also in the files that it names.
    """
    root = load(file, text)
    given, entries = root.typed(_Sections), _entries(root)
    if not entries:
        hint = "an experiment of Robotic Park lists them as Robot01, Robot02, ...; Crazyswarm2 lists robots: by name"
        raise refusal(file, "'Robots' is missing or has none", hint)
    central = given.architecture.mode.lower() == CENTRAL
    if central:  # their central controller reads the relations of all robots, whatever `enable` says
        for task in [each for entry in entries for each in entry.tables() if each.key.endswith(".task")]:
            related = Task(enable=False, relationship=str(task.value.get("relationship", ""))).written
            task.value["enable"] = bool(related) or task.value.get("enable", True)
    robots, problems = dict[str, ParkRobot](), list[Problem]()
    for entry in entries:
        idle = entry.value.get("task")
        if isinstance(idle, dict) and str(idle.get("enable", True)).lower() == "false":
            # of a task that is switched off what is counted is read: other values in it may be anything
            entry.value["task"] = {key: idle[key] for key in ("enable", "relationship") if key in idle}
        try:
            robots[entry.key] = (entry if given.robots else _settings(entry)).typed(ParkRobot)
            task = entry.value.get("task", {}) if given.robots else {}
            if task and robots[entry.key].task.enable and not {"type", "relationship"} <= task.keys():
                hint = "write distance or pose, and name_d, name_x_y_z or none"
                raise refusal(file, f"{entry.key}.task: type or relationship is missing", hint)
        except DocumentError as error:
            problems += error.problems
    if problems:
        raise DocumentError(_counted(file, problems))
    if given.robots:
        notes += _notes_on_sections(root, given)
    else:  # entries that only let the drones' driver publish where another robot of the file is
        marks = {key for key, robot in robots.items() if robot.name in robots.keys() - {key} and not robot.task.enable}
        robots = {key: robot for key, robot in robots.items() if key not in marks}
        notes += _notes_on_older(entries, robots, marks)
    _check_names(file, robots)
    mode = given.operation.mode if given.robots else " and ".join(sorted({robot.type for robot in robots.values()}))
    placed = [
        msgspec.structs.replace(robot, pose=list(poses[robot.name]), init_theta=0.0) if robot.name in poses else robot
        for robot in robots.values()
    ]
    return ParkExperiment(mode, placed, central, any("mars_data" in entry.value for entry in entries))


def _counted(file: str, problems: list[Problem]) -> list[Problem]:
    """The problems, with all files that are missing in one."""
    missing = [each for each in problems if each.message == MISSING]
    if len(missing) < 2:
        return problems
    names = list(dict.fromkeys(Path(each.file).name for each in missing))
    message = f"names {len(names)} file{'s' * (len(names) > 1)} of robots that are not beside it: {join_names(names)}"
    return [*(each for each in problems if each not in missing), Problem(file, 0, 0, message, missing[0].hint)]


def _entries(root: YamlValue) -> list[YamlValue]:
    """The robots of a file; those of 2023 get what they need not say."""
    if "Robots" in root.value:
        return YamlValue(root.file, "Robots", root.typed(_Sections).robots).tables()
    return [
        each._replace(value={"name": each.value.get("id", each.key), "type": "virtual", "pose": None} | each.value)
        for each in root.tables()
        if OLDER & each.value.keys()
    ]


def _settings(listed: YamlValue) -> YamlValue:
    """A robot of 2023 as in sections, with what the file holds that an index names for it."""
    own = listed
    if "config_path" in listed.value:
        file = str(Path(listed.file).parent / listed.typed(ParkRobot).config_path)
        tables = load(file, text_of(file, "put the files of the robots beside the index")).tables()
        if not tables:
            raise refusal(file, "has no robot", f"write its settings under '{listed.key}:'")
        own = next((each for each in tables if each.key == listed.key), tables[0])
    table = own.value | listed.value
    if isinstance(table.get("task"), dict):
        table["task"] = table["task"] | {"controller": OLDER_LAW}
    if isinstance(table.get("communication"), str):
        table["communication"] = {"type": table["communication"]}
    return own._replace(value=table)


def _notes_on_sections(root: YamlValue, given: _Sections) -> Iterator[str]:
    operation, mode = given.operation, given.architecture.mode
    if operation.tool and operation.mode != "physical":
        tool = f"{operation.tool} {operation.world}".strip()
        yield f"Operation: the simulator and its world ({tool}); twins are zenpark's own, in an empty arena"
    if given.experience.type != "formation":
        yield f"Experience: type {given.experience.type}; only formations are known"
    if mode.lower() == CENTRAL != mode:
        yield f"Architecture: {mode}; taken as {CENTRAL}, though their launcher starts a centre for that spelling alone"
    elif mode not in (CENTRAL, "distributed"):
        yield f"Architecture: {mode}; every robot decides for itself here"
    tools = [each for each in root.tables() if each.key in TOOLS] + YamlValue(root.file, "Other", given.other).tables()
    on = [each.key for each in tools if each.typed(_Section).enable]
    if "Other.Reconfiguration" in on:
        yield "Other.Reconfiguration: the first shape is imported; the others can stand in [[formation.changes]]"
    if others := [name for name in on if name != "Other.Reconfiguration"]:
        yield f"{', '.join(others)}: zenpark records, watches and reports by itself"


def _notes_on_older(entries: list[YamlValue], robots: Mapping[str, ParkRobot], marks: set[str]) -> Iterator[str]:
    yield "law: gain and limit are not in files of 2023; 0.25 and 0.08 m per decision, as in the programs of that time"
    if marks:
        yield f"{', '.join(sorted(marks))}: the marker of a robot that stands in the file already"
    addresses = ", ".join(f"{robot.name} {robot.host}" for robot in robots.values() if robot.host)
    if addresses and not any("config_path" in entry.value for entry in entries):
        yield f"the file does not say which robots are real: all are twins here; addresses in it: {addresses}"


def _check_names(file: str, robots: Mapping[str, ParkRobot]) -> None:
    """Refuse two robots of one name, and relations to no robot."""
    names = [robot.name for robot in robots.values()]
    for key, robot in robots.items():
        if names.count(robot.name) > 1:
            raise refusal(file, f"{key}: two robots are called '{robot.name}'", "rename one of them")
        others = [*(name for name in names if name != robot.name), *PLACES]
        for relation in robot.task.relations if robot.task.enable else ():
            if relation.name not in others:
                hint = did_you_mean(relation.name, others) if names[1:] else "import the file that lists all robots"
                raise refusal(file, f"{key}: no other robot is called '{relation.name}'", hint)


def kind_of(name: str) -> str:
    """Kind of a robot in zenpark by its name; empty for a name without a known kind, or that zenpark does not allow."""
    if not NAME.fullmatch(name):
        return ""
    known = ((part, kind.name) for kind in KINDS.usable() for part in kind.aliases)
    return next((kind for part, kind in known if part in name.lower()), "")


def _relation(part: str, kind: str) -> Relation:
    """A relation as it is written, in a task by distance or pose; raises ValueError."""
    name, *rest = part.split("_")
    if name in SURFACES:
        return Relation(name, ())
    if name in CENTRES and len(rest) == 1:  # sphere_R-x-y-z
        rest = re.split(r"(?<=[\d.])-", rest[0])
    elif kind == "pose" and len(rest) == 1 and "/" in rest[0]:  # name_x/y/z
        rest = rest[0].split("/")
    name = "origin" if name in CENTRES else "line" if name.startswith("line") else name
    counts = {"origin": (1, 3, 4), "line": (6,)}.get(name, (3,) if kind == "pose" else (1,))
    try:
        values = tuple(float(each) for each in rest)
    except ValueError:
        values = ()
    if len(values) not in counts or not all(map(math.isfinite, values)):
        raise ValueError(f"'{part}' is no relation of a {kind} task: write name_d, name_x_y_z or origin_R")
    if len(values) in (1, 4) and values[0] <= 0.0:
        raise ValueError(f"'{part}' asks for a distance that is not positive: give metres, such as 0.8")
    return Relation(name, values)


def starts_from(file: str) -> dict[str, Pose]:
    """Starts of robots by name: from an index or experiment (.yaml), or a Webots world (.wbt).

    Raises:
        DocumentError: If the file cannot be read, or tells no start.
    """
    hint = "name an index of robots (.yaml) or a Webots world (.wbt)"
    text = text_of(file, hint)
    if Path(file).suffix.lower() == ".wbt":
        found = dict(_world(file, text))
    else:
        placed = [
            entry._replace(value={"name": entry.value["name"], "type": "virtual", "pose": entry.value["pose"]})
            for entry in _entries(load(file, text))
            if {"name", "pose"} <= entry.value.keys() and kind_of(str(entry.value["name"]))
        ]
        found = {robot.name: robot.start for entry in placed if (robot := entry.typed(ParkRobot)).start}
    if not found:
        raise refusal(file, "tells the start of no robot", hint)
    return found


def _world(file: str, text: str) -> Iterator[tuple[str, Pose]]:
    """Robots in a Webots world: `name` and `translation` of its nodes; the yaw where `rotation` is about z."""
    node, depth = list[str](), 0
    for word in WORD.findall(text):
        depth -= word in "}]"
        if depth < 2 and not word.startswith("#"):
            node.append(word)  # belongs to the node itself, not to those in it
        depth += word in "{["
        if depth == 0 and word == "}":
            behind = {each: node[at + 1 : at + 5] for at, each in enumerate(node)}
            node = []
            name = "".join(behind.get("name", behind.get("DEF", []))[:1]).strip('"')
            if kind_of(name):
                place = YamlValue(file, f"{name}.translation", behind.get("translation", [0.0, 0.0, 0.0])[:3])
                turn = YamlValue(file, f"{name}.rotation", behind.get("rotation", [0.0, 0.0, 1.0, 0.0]))
                x, y, z = place.typed(tuple[Number, Number, Number])
                _, _, axis, angle = turn.typed(tuple[Number, Number, Number, Number])
                yaw = math.copysign(1.0, axis) * angle if abs(axis) > 1.0 - 1e-3 else 0.0
                yield name, (x, y, z if KINDS[kind_of(name)].flies else yaw)
