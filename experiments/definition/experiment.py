"""Structs of the experiment file, typed and frozen. SI units; a name tells where a unit is another.

`experiments.file.document` reads the file into these and reports each error with its place.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

from agents.body.coordinates import Coordinates
from agents.body.interface import Disturbance
from agents.body.limits import Safety
from agents.network.channel_model import AtLeastOne, Delay, LinkEffects
from agents.vectors import NotNegative, Positive, Share
from twins.scene import Obstacle, Planar

WALL: Final = "wall"  # name of the border of the arena in contacts
WORLD: Final = "world"  # the body of a robot that lives in the twin service
VICON_TWIN: Final = "vicon-twin"  # simulated motion capture, where the file names none
TWIN: Final = "-twin"  # ends the name of motion capture that is simulated as well
TARGETS: Final = ("distance", "offset", "bearing")  # fields of the target of a link, of which it has one
NO_TARGET: Final = "nothing"  # stands in place of a field: a link alone


def doc(description: str, **limits: Any) -> Meta:  # noqa: ANN401 - as Meta takes them
    """Description of a field and limits of its value, for the reader, the schema and the reference."""
    return Meta(description=description, **limits)


Rate = Annotated[float, Meta(gt=0, le=2000)]
LONGEST_NAME: Final = 32  # letters: names are parts of files, keys and columns
Name = Annotated[str, Meta(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=LONGEST_NAME)]
Vector = Annotated[list[float], Meta(min_length=2, max_length=3)]
Spatial = tuple[Positive, Positive, Positive]
Choice = str | dict[str, Any]  # a plug-in by name, or a table with its `kind` and its parameters


class FileTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A table of the experiment file."""


class StartBox(FileTable, frozen=True):
    """Part of the floor where robots may start."""

    at: Annotated[Planar, doc("centre x, y [m]")]
    size: Annotated[tuple[Positive, Positive], doc("width along x and y [m]")]


class Shadow(FileTable, frozen=True):
    """Shadow twin: runs beside a robot with the same setpoints, to measure how far they agree."""

    restart_s: Annotated[Positive | None, doc("period of its resets to the robot [s]; left out: once, at start")] = 5.0


class Arena(FileTable, frozen=True):
    """Box that the robots must not leave: centred on the origin, floor at z = 0."""

    size: Annotated[Spatial, doc("size along x, y, z [m]")] = (4.0, 4.0, 2.5)
    file: Annotated[str | None, doc("arena file beside the experiment file; its [arena] is the base of this")] = None
    walls: Annotated[bool, doc("whether its border is a wall that robots touch and range sensors see")] = True
    obstacles: Annotated[dict[Name, Obstacle], doc("obstacles by name")] = {}
    starts: Annotated[dict[Name, StartBox], doc("areas where robots may be put before a run; none: anywhere")] = {}


class Rates(FileTable, frozen=True):
    """Rates [Hz]; pose_hz, coordination_hz and state_hz divide body_hz."""

    body_hz: Annotated[Rate, doc("position control and body [1/s]")] = 100.0
    pose_hz: Annotated[Rate, doc("rate of questions to the trigger [1/s]")] = 50.0
    coordination_hz: Annotated[Rate, doc("rate of decisions on a new goal [1/s]")] = 10.0
    state_hz: Annotated[Rate, doc("telemetry for recorder and viewers [1/s]")] = 50.0


class RobotTable(FileTable, frozen=True):
    """Robot: kind, start, body and settings."""

    kind: Annotated[str, doc("kind of robot, which sets size, speed and setpoint: `./zenpark explain crazyflie`")]
    start: Annotated[list[float], doc("start x, y [m] and, if wanted, yaw [rad]", min_length=2, max_length=3)]
    body: Annotated[str, doc("twin (its own process), world (the twin service), or address of the real one")] = "twin"
    hover: Annotated[Positive | None, doc("height that a flying robot holds [m]")] = None
    position: Annotated[Literal["body", "external"], doc("source of its position: itself, or key `position`")] = "body"
    device: Annotated[dict[str, Any], doc("settings of its hardware, defined by the body")] = {}
    process: Annotated[Name | None, doc("name of its process; robots with the same name share one")] = None
    sensors: Annotated[list[str] | None, doc("range sensors of its twin; left out: those that its kind has")] = None
    ranges: Annotated[Literal["body", "world"], doc("source of its ranges: its own sensors, or the world")] = "body"
    shadow: Annotated[Shadow | None, doc("shadow twin beside the robot")] = None
    avoids: Annotated[bool, doc("whether it keeps clear of others if the experiment has an avoidance")] = True
    lands_at_s: Annotated[
        Positive | None,
        doc("when it lands in mid-run, silent and lost to the others, as after a fault [s]; left out: never"),
    ] = None
    standby: Annotated[bool, doc("whether it stays out of the run until `./zenpark robot add` lets it join")] = False


class TargetTable(FileTable, frozen=True):
    """Target of a link, one of three: distance, offset or bearing."""

    distance: Annotated[Positive | None, doc("distance to keep [m]")] = None
    offset: Annotated[Vector | None, doc("x, y (, z) of the second relative to the first [m]; no z: by heights")] = None
    bearing: Annotated[Vector | None, doc("direction x, y (, z) from the first to the second; no z: from above")] = None

    def __post_init__(self) -> None:
        given = [name for name in TARGETS if getattr(self, name) is not None]
        if len(given) != 1:
            words = " and ".join(given) or "none of them"
            raise ValueError(f"a link asks for distance, offset or bearing, not for {words}; give one of the three")
        if self.bearing is not None and not any(self.bearing):
            raise ValueError("a bearing of zeros has no direction; give x, y, such as [1.0, 0.0]")

    @property
    def kind(self) -> str:
        """Field that gives the target; `NO_TARGET` if none does, as in links for laws that need none."""
        return next((name for name in TARGETS if getattr(self, name) is not None), NO_TARGET)


class LinkTable(TargetTable, frozen=True):
    """Link with a target other than a distance or without one, a gain of its own, or a limited time."""

    gain: Annotated[
        Positive | None, doc("gain [1/(m²·decision)] of a distance, else [1/decision]; left out: that of the formation")
    ] = None
    from_s: Annotated[NotNegative, doc("start of the link [s]")] = 0.0
    until_s: Annotated[Positive | None, doc("end of the link [s]; left out: end of the run")] = None

    def __post_init__(self) -> None:
        if self.kind != NO_TARGET:
            TargetTable.__post_init__(self)
        if self.until_s is not None and self.until_s <= self.from_s:
            raise ValueError("`until_s` must be later than `from_s`; or leave it out")


class AnchorTable(FileTable, frozen=True):
    """Distance of a robot to a point, to a line through it, or to a plane through it."""

    distance: Annotated[NotNegative, doc("distance to keep [m]; 0: on it")] = 0.0
    to: Annotated[Vector | None, doc("point x, y (, z) [m]; left out: the origin")] = None
    along: Annotated[Vector | None, doc("direction x, y (, z) of a line through that point, any length")] = None
    across: Annotated[Vector | None, doc("direction x, y (, z) across a plane through that point, any length")] = None
    gain: Annotated[
        Positive | None,
        doc("gain [1/(m²·decision)]; left out: twice that of the formation, or its stiffness if distance is 0"),
    ] = None

    def __post_init__(self) -> None:
        if self.along is not None and self.across is not None:
            raise ValueError("`along` means a line and `across` a plane; give one of them")
        for name in ("along", "across"):
            direction = getattr(self, name)
            if direction is not None and not any(direction):
                raise ValueError(f"`{name}` has no direction; give x, y, such as [1.0, 0.0]")


class ChangeTable(FileTable, frozen=True):
    """Smooth transition of the formation to another shape, from `at_s` on."""

    at_s: Annotated[NotNegative, doc("start of the transition, after the common start [s]")]
    over_s: Annotated[NotNegative, doc("duration [s]; 0: at once")] = 5.0
    links: Annotated[dict[str, Positive | TargetTable], doc("links that get another target")] = {}
    shape: Annotated[dict[Name, Vector], doc("new places, x, y (, z) [m], of links that get targets by a shape")] = {}
    scale: Annotated[Positive, doc("size of the shape from above, as a multiple of that before; heights stay")] = 1.0
    rotate: Annotated[float, doc("rotation to the left [rad]; not for distances, which have no direction")] = 0.0


class Proximity(FileTable, frozen=True):
    """Links that exist while two robots are near each other."""

    range: Annotated[Positive, doc("distance below which robots become neighbours [m]")]
    release: Annotated[Positive | None, doc("distance above which they cease to be so [m]; left out: 1.1 range")] = None
    distance: Annotated[
        Positive | None,
        doc("distance to keep by neighbours without a link in the file [m]; left out: only links of the file act"),
    ] = None

    def __post_init__(self) -> None:
        if self.release is not None and self.release < self.range:
            raise ValueError("`release` must not be nearer than `range`; or leave it out")


class GraphTable(FileTable, frozen=True):
    """Graph in a file: GraphML, an edge list or an adjacency matrix as CSV."""

    file: Annotated[str, doc("file beside the experiment file: its name")]
    target: Annotated[
        Positive | Literal["shape", "link"] | None,
        doc(
            'target of edges without a distance: a distance [m], "shape": as in [formation.shape], or "link": none; '
            "left out: by the shape, if there is one"
        ),
    ] = None
    weight: Annotated[
        Literal["gain", "distance", "nothing"],
        doc("meaning of a weight: gain of the link, its distance [m], or nothing"),
    ] = "gain"
    directed: Annotated[bool, doc("whether a line `A B` of an edge list is A > B; else A - B")] = False
    rows: Annotated[
        Literal["receivers", "senders"] | None,
        doc("what the rows of a matrix that is not symmetric do: receive from their columns, or send to them"),
    ] = None


class Formation(FileTable, frozen=True):
    """Formation: links with their targets, anchors, and the law."""

    law: Annotated[Choice, doc("a registered law")] = "distance"
    update: Annotated[Choice | None, doc("trigger of a recomputation of the law; left out: every decision")] = None
    gain: Annotated[
        Positive,
        doc(
            "μ of links with a distance as target [1/(m²·decision)] (paper, eq. (6)); left out: 3, less where "
            "long links would make the loop ring"
        ),
    ] = 3.0
    stiffness: Annotated[
        Positive, doc("k of links with an offset or a bearing as their target, or of all for some laws [1/decision]")
    ] = 0.5
    clamp: Annotated[Positive, doc("largest step of the goal per axis and decision [m]")] = 0.1
    tracking_gain: Annotated[NotNegative, doc("k of followers of a leader [1/(m²·decision)] (paper, eq. (7))")] = 3.0
    leader: Annotated[Name | None, doc("robot that leads; left out: every robot without neighbours")] = None
    links: Annotated[
        dict[str, Positive | LinkTable],
        doc(
            '"A > B": B receives from A; "A - B": both receive; distance [m], a table with another target, '
            '"shape": as in [formation.shape], or "link": none, for laws that need no target'
        ),
    ] = {}
    graph: Annotated[
        str | GraphTable | None,
        doc("file with more links, beside the experiment file: GraphML, edge list or adjacency CSV; those above win"),
    ] = None
    anchors: Annotated[dict[Name, Positive | AnchorTable], doc("by robot: distance to the origin [m], or a place")] = {}
    shape: Annotated[
        dict[Name, Vector],
        doc(
            'places of robots, x, y (, z) [m], about any origin: a link `"A > B" = "shape"` gets its distance, offset '
            "or bearing from there, as the law needs; z left out: by their heights"
        ),
    ] = {}
    changes: Annotated[list[ChangeTable], doc("other shapes, in order of time")] = []
    proximity: Annotated[Proximity | None, doc("links by range; left out: links are permanent")] = None

    @property
    def link_tables(self) -> dict[str, LinkTable]:
        """The links in their long form."""
        return {text: to if isinstance(to, LinkTable) else LinkTable(distance=to) for text, to in self.links.items()}


class LegTable(FileTable, frozen=True):
    """Plan that a robot follows from `at_s` on."""

    at_s: Annotated[NotNegative, doc("start of the plan, after the common start [s]")]
    robot: Annotated[Name, doc("name of the robot")]
    plan: Annotated[Choice, doc("a registered planner")]


class LinkChannelTable(FileTable, frozen=True):
    """Effects on one link; a field left out is that of the channel."""

    delay_s: Delay | None = None
    jitter_s: Delay | None = None
    loss: Share | None = None
    burst: AtLeastOne | None = None
    bandwidth: Positive | None = None


class Outage(FileTable, frozen=True):
    """Time in which nothing passes on some links."""

    from_s: Annotated[NotNegative, doc("start of the outage, after the common start [s]")]
    until_s: Annotated[Positive | None, doc("end of the outage [s]; left out: end of the run")] = None
    links: Annotated[list[str], doc('links; "A > B": from A to B; "A - B": both ways; left out with robots: all')] = []
    robots: Annotated[list[Name], doc("robots with all their links")] = []

    def __post_init__(self) -> None:
        if self.until_s is not None and self.until_s <= self.from_s:
            raise ValueError("`until_s` must be later than `from_s`; or leave it out")


class ChannelTable(LinkEffects, FileTable, frozen=True):
    """Effects of the network on poses between robots: modelled in virtual time, added at the receiver in real time."""

    outages: Annotated[list[Outage], doc("times in which nothing passes")] = []
    links: Annotated[dict[str, LinkChannelTable], doc('by link; "A > B": poses from A to B; "A - B": both ways')] = {}


class NetworkTable(FileTable, frozen=True):
    """Network of a run in real time."""

    realm: Annotated[Name, doc("first chunk of every key")] = "park"
    connect: Annotated[list[str] | None, doc("endpoints of routers that run already; left out: one is started")] = None
    listen: Annotated[
        list[str] | None,
        doc(
            "endpoints of the router that is started; left out: on loopback, and hosts reach it through their ssh "
            "connection; of several routers, each has one in turn"
        ),
    ] = None
    topology: Annotated[
        Literal["routers", "mesh"],
        doc("connections: all at routers; or, without routers, each robot with exactly its neighbours"),
    ] = "routers"
    addresses: Annotated[dict[Name, str], doc("endpoints of robots in a mesh; left out: free ports on loopback")] = {}
    routers: Annotated[int, doc("number of routers, each a process; who loses one goes on at the next", ge=1, le=8)] = 1
    address: Annotated[str | None, doc("name of this machine for hosts, with `listen`; none: as ssh found it")] = None
    encoding: Annotated[Literal["json", "msgpack"], doc("of the payloads")] = "json"
    lab: Annotated[str | None, doc("certificates (`./zenpark lab init`): folder beside this; none: loopback")] = None


class Host(FileTable, frozen=True):
    """Other machine, which runs some of the robots."""

    address: Annotated[
        str | None,
        doc(
            "address for ssh: a name of its configuration, user@machine, ssh://user@machine:port; left out: its robots "
            "are started there by hand or at boot, and join"
        ),
    ] = None
    zenpark: Annotated[str, doc("command of zenpark there; a path counts from the home folder")] = "zenpark/zenpark"
    lab: Annotated[str, doc("folder of its robots' certificates, in a lab; from the home folder")] = "zenpark-lab"
    robots: Annotated[list[Name], doc("robots there; those that no host names run here")] = []
    tags: Annotated[list[Name], doc("labels by which `./zenpark hosts` chooses among hosts")] = []


class WorldTable(FileTable, frozen=True):
    """World that all twins share in virtual time, and those with `body = "world"` in real time."""

    engine: Annotated[Choice, doc("a registered engine")] = "point-mass"
    sensor_noise: Annotated[NotNegative, doc("noise of range sensors, as a multiple of that of real ones")] = 1.0
    wheel_watchdog_s: Annotated[
        Positive | None,
        doc(
            "time without a command after which robots on wheels stop, like by a watchdog [s]; left out: they drive "
            "on, as Khepera IV and TurtleBot3 do, unless `watchdog_s` is in their `device` table"
        ),
    ] = None
    patience_s: Annotated[Positive, doc("time for which a robot without its world holds before it lands [s]")] = 30.0


class Start(FileTable, frozen=True):
    """Beginning of a run."""

    deadline_s: Annotated[Positive, doc("time limit for all robots to be ready [s]")] = 20.0
    missing: Annotated[Literal["abort", "go-on"], doc("reaction to a robot that is not ready by then")] = "abort"
    scatter: Annotated[NotNegative, doc("largest offset of a twin from `start`, per axis, by the seed [m]")] = 0.0
    scatter_yaw: Annotated[NotNegative, doc("largest random yaw offset of each start, by the seed [rad]")] = 0.0


class Hybrid(FileTable, frozen=True):
    """Hybrid architecture: some robots are guided by the central controller, the others decide for themselves."""

    kind: Annotated[Literal["hybrid"], doc('"hybrid"')]
    robots: Annotated[list[Name], doc("robots that the centre guides", min_length=1)]


class Positioning(Coordinates, frozen=True):
    """Motion capture that measures the robots with `position = "external"`."""

    source: Annotated[
        str,
        doc("vicon, optitrack, qualisys or vrpn, as SYSTEM://HOST[:PORT], or cameras://FILE; simulated: SYSTEM-twin"),
    ]
    names: Annotated[
        dict[Name, Annotated[str, Meta(min_length=1)]],
        doc("bodies in the system by robot, where they have other names"),
    ] = msgspec.field(default_factory=dict)
    latency_s: Annotated[NotNegative, doc("latency that the system's stream does not say [s]")] = 0.0

    @property
    def system(self) -> str:
        """Name of the system, such as "vicon"."""
        return self.scheme.removesuffix(TWIN)

    @property
    def scheme(self) -> str:
        """Word of the source, such as "vicon" or "vicon-twin"."""
        return self.source.partition("://")[0]

    @property
    def simulated(self) -> bool:
        """Whether the system is a protocol twin."""
        return self.scheme.endswith(TWIN)

    @property
    def address(self) -> str:
        """Host or file of the system; empty for a twin without a file."""
        return self.source.partition("://")[2]


MEAN: Final = "mean"  # mean over robots
WORST: Final = "worst"  # worst robot


class Criterion(FileTable, frozen=True):
    """Limit that a run must keep to pass: of a metric, or of a measure of the law."""

    metric: Annotated[str | None, doc('metric, also in a file beside this ("way.py:Way"); or give `measure`')] = None
    measure: Annotated[str | None, doc("number that the law measures, averaged over the last second of the run")] = None
    of: Annotated[
        str, doc("mean over robots, worst (largest for `at_most`, smallest for `at_least`: one limit), or name")
    ] = MEAN
    case: Annotated[str | None, doc("judged case; left out: each case")] = None
    at_most: Annotated[float | None, doc("upper limit, in the unit of the metric")] = None
    at_least: Annotated[float | None, doc("lower limit, in the unit of the metric")] = None
    relative_to: Annotated[str | None, doc("a case: limits are multiples of the value there, seed by seed")] = None
    why: Annotated[str, doc("reason, printed if it is not met")] = ""

    def __post_init__(self) -> None:
        if (self.metric is None) == (self.measure is None):
            raise ValueError('a criterion judges one number; give metric = "iae", or measure = "..." of the law')
        if self.at_most is None and self.at_least is None:
            raise ValueError("a criterion needs a limit; add at_most = 0.5, or at_least")
        if self.at_most is not None and self.at_least is not None and self.at_least > self.at_most:
            raise ValueError("`at_least` is above `at_most`; exchange them")
        if self.of == WORST and None not in (self.at_most, self.at_least):
            raise ValueError("the worst robot has one limit, since two are of different robots; write two criteria")
        if self.relative_to is not None and self.relative_to == self.case:
            raise ValueError("`relative_to` names the case that is judged; name another one")

    def excess(self, value: float) -> float:
        """Excess of a value over the limits; 0 or less if it keeps them."""
        above = -math.inf if self.at_most is None else value - self.at_most
        return max(above, -math.inf if self.at_least is None else self.at_least - value)


class Experiment(FileTable, frozen=True):
    """Experiment, or a case of it after `document.cases`."""

    title: Annotated[str, doc("subject of the experiment, for people")]
    robots: Annotated[dict[Name, RobotTable], doc("robots by name", min_length=1)]
    duration_s: Annotated[Positive, doc("duration from the common start [s]", le=86400)]
    spares: Annotated[dict[Name, RobotTable], doc("robots that wait to take over the name of one of their kind")] = {}
    on_loss: Annotated[
        Literal["none", "restart", "replace"],
        doc("reaction to a robot lost in mid-run: continue without it, restart it, or let a spare take over"),
    ] = "none"
    source: Annotated[str, doc("publication that it reproduces")] = ""
    seed: Annotated[int, doc("seed of all random numbers: noise, starts, network", ge=0, le=2**32 - 1)] = 1
    tolerance: Annotated[Positive, doc("error below which a link must stay to count as acquired [m]")] = 0.05
    arena: Annotated[Arena, doc("size, obstacles and start boxes")] = Arena()
    rates: Annotated[Rates, doc("rates of body, poses, decisions and telemetry [Hz]")] = Rates()
    formation: Annotated[Formation, doc("links with their targets, anchors, and the law")] = Formation()
    timeline: Annotated[list[LegTable], doc("plans of robots, for each robot in order of time")] = []
    architecture: Annotated[
        Literal["distributed", "centralised"] | Hybrid,
        doc("distributed: each robot decides for itself; centralised: one process for all; hybrid: for some"),
    ] = "distributed"
    trigger: Annotated[Choice, doc("registered trigger that decides when a robot transmits")] = "periodic"
    prediction: Annotated[Choice | None, doc("estimated place between messages; left out: as the trigger needs")] = None
    positioning: Annotated[
        str | Positioning | None,
        doc('source of `position = "external"`: SYSTEM://HOST[:PORT] or SYSTEM-twin, or a table'),
    ] = None
    disturbance: Annotated[dict[str, Disturbance], doc('by kind or robot; "all" for every one; the narrower wins')] = {}
    avoidance: Annotated[Choice | None, doc("how robots avoid obstacles and each other; left out: they do not")] = None
    world: Annotated[WorldTable, doc("simulated world of the twins")] = WorldTable()
    channel: Annotated[ChannelTable, doc("modelled delays and losses of poses")] = ChannelTable()
    network: Annotated[NetworkTable, doc("routers and certificates of a run in real time")] = NetworkTable()
    hosts: Annotated[dict[Name, Host], doc("other machines, and which robots run there")] = {}
    safety: Annotated[Safety, doc("limits at which robots hold, land or stop")] = Safety()
    start: Annotated[Start, doc("start of a run: its deadline and the scatter of the robots")] = Start()
    criteria: Annotated[list[Criterion], doc("limits that a run must keep to pass; `run` says which it does not")] = []
    metrics: Annotated[
        list[str], doc('metrics that are measured without a limit: files beside this, "way.py:Way"')
    ] = []
    cases: Annotated[
        dict[Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")], dict[str, Any]],
        doc("each may override any field; the first is the reference of every ratio"),
    ] = {}

    @property
    def capture(self) -> Positioning | None:
        """Motion capture, also where the file names its source alone."""
        given = self.positioning
        return Positioning(source=given) if isinstance(given, str) else given

    @property
    def processes(self) -> dict[str, list[str]]:
        """Robots of each process, by its name."""
        groups: dict[str, list[str]] = {}
        for name, robot in self.robots.items():
            groups.setdefault(robot.process or name, []).append(name)
        return groups

    @property
    def phases(self) -> list[tuple[float, str]]:
        """Phases of a run: their beginnings since the common start [s], and their names."""
        legs = sorted(self.timeline, key=lambda leg: leg.at_s)
        return [(0.0, "formation"), *((leg.at_s, f"{leg.robot} under way") for leg in legs)]
