"""The kinds of robots: size, limits, the setpoint that they take, and all that the project knows of one kind alone.

A kind is a `Kind`, found by the entry-point group `zenpark.kinds`; those without a device live in `agents.kinds`, the
others with their devices in `bridges`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from math import inf, isfinite, nan
from typing import Final, Literal, get_args

import msgspec

from agents.plugins import registry
from agents.plugins.registry import PluginError, UnknownPlugin
from agents.vectors import Vector

Takes = Literal["position", "velocity", "twist"]


@dataclass(frozen=True)
class Wheels:
    """Two driven wheels."""

    base: float  # distance between the wheels [m]
    speed: float  # largest rim speed [m/s]
    acceleration: float  # largest, of the rim [m/s²]


@dataclass(frozen=True)
class Flight:
    """Closed loop of a quadrotor on board, for x, y and z."""

    position: Vector  # gains [1/s]
    velocity: Vector  # gains [1/s]
    speed: Vector  # limits [m/s]
    # rate at which the acceleration follows, because the quadrotor must tilt first [1/s]; inf: at once
    tilt: Vector


@dataclass(frozen=True)
class Holonomic:
    """Wheels that drive in any direction, such as Mecanum ones; velocities follow with the `lag` of the kind."""

    acceleration: float = inf  # largest [m/s²]


@dataclass(frozen=True)
class Steered:
    """Two axles, of which the front one is steered; the position is that of the middle of the rear one."""

    base: float  # distance between the axles [m]
    angle: float  # largest steering angle [rad]
    angle_rate: float  # largest steering speed [rad/s]
    acceleration: float  # largest, along the heading [m/s²]


Motion = Wheels | Flight | Holonomic | Steered


@dataclass(frozen=True)
class Airframe:
    """Rigid quadrotor with motors at 45° to its nose."""

    mass: float  # [kg]
    inertia: tuple[float, float, float]  # moments about its own x, y, z [kg m²]
    arm: float  # distance of a motor from the centre [m]
    thrust: float  # force of a motor at full command [N]
    torque: float  # moment of a motor about its axis, per thrust [m]
    size: tuple[float, float, float]  # sides of the collision box [m]


@dataclass(frozen=True)
class ProtocolTwin:
    """Protocol twin of a kind, for `--bodies protocol`."""

    body: str  # name in the group `zenpark.devices`
    process: str | None = None  # name of the process that the robots of a kind share, if one link carries several
    # source of its position; "external": simulated motion capture, and what the robot counts itself is not used
    position: Literal["body", "external"] = "external"
    device: Mapping[str, object] = field(default_factory=dict, hash=False)  # settings on top of those of the file


@dataclass(frozen=True)
class Trial:
    """Trial of a kind in `./zenpark preflight`, before its other flights."""

    name: str  # name of the check, and of the option that asks for it
    device: Mapping[str, object] = field(hash=False)  # settings on top of those of the file
    hold_s: float  # duration after the take-off [s]
    # a `module:function` of the recorded states, the failure in words and the device settings; it gives what was found
    # and the remedy, empty if all is well
    judge: str


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Range sensor; ranges are measured from the sensor itself."""

    name: str
    bearing: tuple[float, ...]  # (m) of the rays from the robot's nose, to the left [rad]
    elevation: tuple[float, ...] = ()  # (m) 0 or ±π/2 [rad]; empty: all 0
    mount: float = 0.0  # distance from the robot's centre to the sensor, along each ray [m]
    height: float  # height above the robot's position, which is the lowest point of its body [m]
    nearest: float = 0.0  # closer objects are not reported [m]; with 0, an object that touches the sensor is at 0
    farthest: float  # farther objects are not reported [m]
    rate_hz: float
    sigma: float  # standard deviation of a reading [m]
    relative: float = 0.0  # standard deviation as a share of the range, from `relative_from` on
    relative_from: float = inf  # [m]
    dropout: float = 0.0  # probability that a ray reports nothing
    resolution: float = 0.0  # step of the readings [m]; 0: none


class Agility(msgspec.Struct, frozen=True):
    """Rates and limits of a kind, as `Kind` has them."""

    response: float  # K [1/s]
    turn_response: float  # K_α [1/s]
    speed: float  # limit [m/s]
    turn_rate: float  # limit [rad/s]


class Steering(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Steering of a kind that takes twists and does not turn like two wheels; `twist` is quiet."""

    def twist(self, x: float, y: float, yaw: float, goal_yaw: float, agility: Agility) -> tuple[float, float]:
        """Linear [m/s] and angular speed [rad/s] toward a goal that is x, y [m] away, and there to `goal_yaw` [rad].

        `yaw` is measured [rad], `goal_yaw` NaN for any.
        """
        raise TypeError(f"{type(self).__name__} must define `twist`")


@dataclass(frozen=True)
class Kind:
    """Kind of robot."""

    name: str  # name in the experiment file and in the registry
    takes: Takes  # the setpoint that its body takes
    flies: bool  # takes off and lands
    radius: float  # horizontal half-size [m]
    height: float  # vertical size [m]; a position is that of the lowest point, so a body reaches from z to z + height
    mass: float  # ready to fly, with battery and decks [kg]
    endurance_s: float  # endurance with a full battery, maker's figure
    speed: float  # largest speed [m/s]; per axis for robots that fly
    turn_rate: float  # largest yaw rate [rad/s]
    response: float  # rate at which its position controller closes a position error [1/s]
    turn_response: float  # rate at which it closes a yaw error [1/s]
    # time constant with which its velocity follows what is commanded [s]
    lag: float = 0.1  # delay of a robot on wheels at 2 m/s², from 0.3 m/s, and a tick or two
    overshoot: float = 0.0  # largest overshoot of a take-off of the real robot, share of its height
    late_s: float = inf  # largest delay of positions from outside by which its controller on board flies well [s]
    # time from its motors to the first 5 cm of a climb to a height h by such positions, at most: a + b h + c / h [s]
    lift_s: Vector = (inf, 0.0, 0.0)
    turn_radius: float = 0.0  # smallest, of one that cannot turn on the spot [m]
    steering: Steering | None = None  # used by kinds that take twists; None: as two wheels turn
    # of its twin, or a `module:class`, see `twins.models.ground.Ground`; None: it has no twin
    motion: Motion | str | None = None
    sensors: tuple[Sensor, ...] = ()  # range sensors that each has
    decks: tuple[Sensor, ...] = ()  # those that a robot has if the file says so
    airframe: Airframe | None = None  # needed by the engine mujoco; None: that engine refuses the kind
    # how it is known
    aliases: tuple[str, ...] = ()  # parts of names by which importers know it
    prefix: str = "R"  # first letters of its robots' names in generated experiments
    colour: str = "#7a7a7a"  # colour in figures of many robots
    mesh: str = (
        ""  # its picture, a `module:function` from a kind to a `experiments.scene.models.Model`; "": by its size
    )
    # hardware
    # time from the loss of its link to standstill on the floor, at most [s]; infinity: it drives on
    alone_s: float = 1.0
    bodies: tuple[str, ...] = ()  # names in the group `zenpark.bodies` that drive this kind only
    library: str = ""  # library that those bodies need
    twin: ProtocolTwin | None = None
    # `module:function` of name, body and device settings: a robot's address in ROS 2 on routers of the experiment
    ros_address: str = ""
    # module of a program for its own computer that stops it without commands; its scripts put_watchdog.sh and
    # remove_watchdog.sh lie beside it
    watchdog: str = ""
    takeoff_height: float = nan  # height to which it climbs by itself [m]; NaN: to any
    trial: Trial | None = None
    connect: str = ""  # remedy for a robot that does not answer
    charge: str = "charge it"  # remedy for an empty battery
    locks: bool = False  # an emergency stop locks it until it is switched off and on

    @property
    def own_bodies(self) -> tuple[str, ...]:
        """Bodies that drive robots of this kind only, its protocol twin included."""
        return self.bodies if self.twin is None else (*self.bodies, self.twin.body)

    def __post_init__(self) -> None:
        """Raises ValueError for a number that no robot has, or an unknown setpoint."""
        if self.takes not in (known := get_args(Takes)):
            raise ValueError(f"takes of the kind {self.name!r} is {self.takes!r}: it must be one of {', '.join(known)}")
        positive = ("radius", "height", "mass", "endurance_s", "speed", "turn_rate", "response", "turn_response")
        for name in positive:
            if not (isfinite(value := getattr(self, name)) and value > 0.0):
                raise ValueError(f"{name} of the kind {self.name!r} is {value!r}: give a positive number")
        for name in ("lag", "turn_radius"):
            if not 0.0 <= (value := getattr(self, name)) < inf:
                raise ValueError(f"{name} of the kind {self.name!r} is {value!r}: give 0 or a positive number")
        if self.flies and self.takes == "twist":
            raise ValueError(f"the kind {self.name!r} flies: let it take positions or velocities")
        if not self.flies and self.takes == "position":
            raise ValueError(f"the kind {self.name!r} drives: let it take velocities or twists")


class RecordedKind(msgspec.Struct, frozen=True):
    """Figures of a kind, with which a recording is shown and measured where the kind is not installed."""

    name: str
    takes: Takes
    flies: bool
    radius: float
    height: float
    mass: float
    endurance_s: float
    speed: float
    turn_rate: float
    response: float
    turn_response: float
    lag: float
    turn_radius: float
    colour: str

    @classmethod
    def of(cls, kind: Kind) -> RecordedKind:
        return cls(**{name: getattr(kind, name) for name in cls.__struct_fields__})


class Kinds(Mapping[str, Kind]):
    """Kinds of robots by name; each is loaded when it is asked for."""

    loaded: dict[str, Kind]

    def __init__(self) -> None:
        self.loaded = {}

    def __getitem__(self, name: str) -> Kind:
        """Raises KeyError if it is not installed, PluginError if it cannot be used."""
        kind = self.loaded.get(name)
        if kind is None:
            try:
                kind = registry.load(registry.ROBOTS, name)
            except UnknownPlugin:
                raise KeyError(name) from None
            if not isinstance(kind, Kind) or kind.name != name:
                found = f"the kind {kind.name!r}" if isinstance(kind, Kind) else f"a {type(kind).__name__}"
                raise PluginError(f"plug-in {name!r} among the kinds is {found}: register a `Kind` under its own name")
            self.loaded[name] = kind
        return kind

    def __contains__(self, name: object) -> bool:
        """Whether it is installed; it may be broken."""
        return name in self.loaded or name in registry.names(registry.ROBOTS)

    def __iter__(self) -> Iterator[str]:
        return iter(sorted({*self.loaded, *registry.names(registry.ROBOTS)}))

    def __len__(self) -> int:
        return len(list(iter(self)))

    def remember(self, figures: RecordedKind) -> None:
        """Know a kind that is not installed by its figures, without a twin; raises ValueError for absurd ones."""
        if figures.name not in {kind.name for kind in self.usable()}:
            self.loaded[figures.name] = Kind(**msgspec.structs.asdict(figures))

    def usable(self) -> list[Kind]:
        """Kinds that can be used."""
        found = []
        for name in self:
            try:
                found.append(self[name])
            except PluginError:
                continue
        return found


KINDS: Final = Kinds()
