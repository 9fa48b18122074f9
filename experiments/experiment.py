"""An experiment: what its file says, as typed, frozen structs. SI units; the name says where a unit is another.

`experiments.document` reads the file into these and says where it is wrong.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from agents.body import Disturbance

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Share = Annotated[float, Meta(ge=0, le=1)]
Name = Annotated[str, Meta(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
Planar = tuple[float, float]
Spatial = tuple[Positive, Positive, Positive]
Choice = str | dict[str, Any]  # a plug-in by name, or a table with its `kind` and its parameters


class Part(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A table of the experiment file."""


class Arena(Part, frozen=True):
    """The box that the robots must not leave: centred on the origin, floor at z = 0."""

    size: Annotated[Spatial, Meta(description="x, y, z [m]")] = (4.0, 4.0, 2.5)


class Rates(Part, frozen=True):
    """How often things happen; pose_hz, coordination_hz and state_hz divide body_hz."""

    body_hz: Annotated[Positive, Meta(description="position control and body")] = 100.0
    pose_hz: Annotated[Positive, Meta(description="how often the trigger is asked")] = 50.0
    coordination_hz: Annotated[Positive, Meta(description="how often a new goal is decided")] = 10.0
    state_hz: Annotated[Positive, Meta(description="telemetry for recorder and viewers")] = 50.0


class Robot(Part, frozen=True):
    """One robot."""

    kind: Annotated[str, Meta(description="crazyflie, tello, khepera4 or turtlebot3")]
    start: Annotated[list[float], Meta(min_length=2, max_length=3, description="x, y [m] and, if wanted, yaw [rad]")]
    body: Annotated[str, Meta(description="twin, or the address of the real one")] = "twin"
    hover: Annotated[Positive | None, Meta(description="height that a flying robot holds [m]")] = None
    position: Annotated[
        Literal["body", "external"], Meta(description="its own estimate, or what is published on its key `position`")
    ] = "body"
    device: Annotated[dict[str, Any], Meta(description="settings of its hardware; the body knows them")] = {}
    process: Annotated[Name | None, Meta(description="robots of one name share one process")] = None


class Link(Part, frozen=True):
    """A link with a gain of its own."""

    distance: Annotated[Positive, Meta(description="[m]")]
    gain: Annotated[Positive | None, Meta(description="the formation's if left out")] = None


class Formation(Part, frozen=True):
    """Which shape, by which law."""

    law: Annotated[Choice, Meta(description="a registered law")] = "distance"
    gain: Annotated[Positive, Meta(description="μ [1/(m²·decision)] (paper, eq. (6))")] = 3.0
    clamp: Annotated[Positive, Meta(description="largest step of the goal per axis and decision [m]")] = 0.1
    tracking_gain: Annotated[NotNegative, Meta(description="k [1/(m²·decision)] (paper, eq. (7))")] = 3.0
    leader: Annotated[Name | None, Meta(description="left out: every robot that listens to nobody")] = None
    links: Annotated[
        dict[str, Positive | Link], Meta(description='"A > B": B listens to A; "A - B": both listen; distance [m]')
    ] = {}


class Leg(Part, frozen=True):
    """From `at_s` on, a robot follows a plan."""

    at_s: Annotated[NotNegative, Meta(description="[s] after the common start")]
    robot: Name
    plan: Annotated[Choice, Meta(description="a registered planner")]


class Channel(Part, frozen=True):
    """The network of a run in virtual time."""

    delay_s: Annotated[NotNegative, Meta(description="from sender to listener [s]")] = 0.001
    jitter_s: Annotated[NotNegative, Meta(description="mean of an exponential addition [s]")] = 0.0
    loss: Annotated[Share, Meta(description="share of samples that never arrive")] = 0.0


class Network(Part, frozen=True):
    """The network of a run in real time."""

    realm: Annotated[Name, Meta(description="first chunk of every key")] = "park"
    connect: Annotated[
        list[str] | None, Meta(description="endpoints of routers that run already; left out: one is started")
    ] = None
    encoding: Annotated[Literal["json", "msgpack"], Meta(description="of the payloads")] = "json"


class Safety(Part, frozen=True):
    """The last word before a body."""

    speed: Annotated[Positive | None, Meta(description="[m/s], if lower than the kind's own")] = None
    goal_step: Annotated[Positive, Meta(description="farthest goal from where the robot is [m]")] = 0.5
    margin: Annotated[NotNegative, Meta(description="how far inside the walls goals stay [m]")] = 0.05
    own_silence_s: Annotated[Positive, Meta(description="own position older than this: stop or land [s]")] = 0.5
    link_silence_s: Annotated[Positive, Meta(description="a neighbour gone for this long is left out [s]")] = 1.0


class Start(Part, frozen=True):
    """How a run begins."""

    deadline_s: Annotated[Positive, Meta(description="how long to wait for all robots to be ready [s]")] = 20.0
    missing: Annotated[Literal["abort", "go-on"], Meta(description="when one is not ready by then")] = "abort"


class Experiment(Part, frozen=True):
    """One experiment, or one case of it after `document.cases`."""

    title: str
    robots: Annotated[dict[Name, Robot], Meta(min_length=1)]
    duration_s: Annotated[Positive, Meta(description="from the common start [s]", le=86400)]
    source: Annotated[str, Meta(description="where it was published")] = ""
    seed: Annotated[int, Meta(ge=0, le=2**32 - 1)] = 1
    tolerance: Annotated[Positive, Meta(description="a link is acquired when its error stays below [m]")] = 0.05
    arena: Arena = Arena()
    rates: Rates = Rates()
    formation: Formation = Formation()
    timeline: list[Leg] = []
    trigger: Annotated[Choice, Meta(description="a registered trigger")] = "periodic"
    positioning: Annotated[
        str | None, Meta(description='who measures `position = "external"`: vicon://HOST[:PORT], or vicon-twin')
    ] = None
    disturbance: Annotated[
        dict[str, Disturbance], Meta(description='by kind or by robot; "all" for every one; the narrower wins')
    ] = {}
    channel: Channel = Channel()
    network: Network = Network()
    safety: Safety = Safety()
    start: Start = Start()
    cases: Annotated[
        dict[Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")], dict[str, Any]],
        Meta(description="each may override any field; the first is the reference of every ratio"),
    ] = {}
