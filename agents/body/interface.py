"""Interface between the decision for a robot and its body: hardware or a twin, chosen by one word.

A body may have several robots: a bridge that serves three Crazyflies on one radio is one body of three rows.
The runtime finds bodies by the entry-point group `zenpark.bodies`: the word before `://` (or the whole word) names one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import nan
from typing import Annotated, Any, ClassVar, Final, Literal, TypeVar

import msgspec
from msgspec import Meta

from agents.body.device_address import DeviceAddress, plain_device
from agents.body.kinds import Kind
from agents.clock import Clock
from agents.errors import ExplainedError
from agents.network.keys import Keys
from agents.network.messages import Inspection
from agents.vectors import UNKNOWN, Setpoint, Vector

Attitude = tuple[float, float, float, float]  # unit quaternion w, x, y, z from the robot to the room
NO_ATTITUDE: Final[Attitude] = (nan, nan, nan, nan)


class Jitter(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Drift of a hovering robot: an Ornstein-Uhlenbeck process on each horizontal axis."""

    sigma: Annotated[float, Meta(description="standard deviation on each axis [m]", ge=0, lt=1)]
    correlation_s: Annotated[float, Meta(description="correlation time [s]", gt=0, lt=1000)] = 0.5


Push = Annotated[float, Meta(ge=-5, le=5)]  # [m/s²]


class Disturbance(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Disturbances of a simulated body; a field left out adds none."""

    hover_jitter: Annotated[Jitter | None, Meta(description="drift of a hovering robot")] = None
    position_sigma: Annotated[
        float | None, Meta(description="white noise of the measured position, per axis; planar for ground robots [m]")
    ] = None
    yaw_sigma: Annotated[float | None, Meta(description="white noise of the measured yaw [rad]")] = None
    latency_s: Annotated[Annotated[float, Meta(ge=0, le=10)] | None, Meta(description="from command to effect [s]")] = (
        None
    )
    odometry_drift: Annotated[
        float | None, Meta(description="random walk of the measured position with the way [m per square root of m]")
    ] = None
    wind: Annotated[
        tuple[Push, Push] | None,
        Meta(description="push of a steady wind on a flying robot, as an acceleration x, y [m/s²]"),
    ] = None

    def without_noise(self) -> Disturbance:
        """Disturbance without its random parts: latency and wind."""
        return Disturbance(latency_s=self.latency_s, wind=self.wind)


@dataclass(frozen=True)
class BodyRequest:
    """Request for a body; every sequence has one entry per row."""

    names: tuple[str, ...]
    kinds: tuple[Kind, ...]
    addresses: tuple[str, ...]  # the `body` of the experiment file: "twin", "radio://0/80/2M/E7E7E7E701", ...
    start: tuple[Vector, ...]  # [m]
    yaw: tuple[float, ...]  # [rad]
    rate_hz: float  # [1/s] rate of readings and commands
    seeds: tuple[int, ...]
    disturbance: tuple[Disturbance, ...]
    external: tuple[bool, ...]  # rows with a position from outside, through `Body.locate`
    device: tuple[Mapping[str, Any], ...]  # settings of the hardware in the experiment file; the body checks them
    endpoints: tuple[str, ...]  # used by bodies on the network
    keys: Keys
    clock: Clock = field(default_factory=Clock)  # clock of the stamps on the network

    def select(self, rows: Sequence[int]) -> BodyRequest:
        per_row = ("names", "kinds", "addresses", "start", "yaw", "seeds", "disturbance", "external", "device")
        columns: dict[str, Any] = {name: tuple(getattr(self, name)[row] for row in rows) for name in per_row}
        return replace(self, **columns)

    def entries(self) -> list[BodyEntry]:
        """Robots of the rows, as the classes of their bodies judge them."""
        rows = zip(self.names, self.kinds, self.addresses, self.device, self.external, strict=True)
        return [BodyEntry(*row, process=self.names[0]) for row in rows]


@dataclass(frozen=True)
class BodyEntry:
    """Robot of an experiment file, as the class of its body judges it."""

    name: str
    kind: Kind
    address: str  # the `body` of the file
    device: Mapping[str, Any]  # right by the `SETTINGS` of the body
    external: bool  # position from outside
    process: str  # name of its process; that of the robot where it is alone
    host: str = ""  # its machine, as [hosts] names it; empty: this one


@dataclass(frozen=True)
class BodyFault:
    """Fault that the class of a body finds in a file; `severity` and remedy as of a finding of `./zenpark check`."""

    robot: str
    key: tuple[str | int, ...]  # place below the robot's table: ("body",), ("device", "positioning", "file")
    message: str
    remedy: str = ""
    severity: Literal["error", "warning", "note"] = "error"
    here: bool = False  # an error on this machine, where a file is missing for example: twins run all the same

    def __str__(self) -> str:
        return f"{self.robot}: {self.message}" + (f"; {self.remedy}" if self.remedy else "")


class RangeScan(msgspec.Struct, frozen=True):
    """Sweep of a robot's range sensors; all sequences have an entry for each ray."""

    time: float  # [s] time of the measurement, on the clock of `Body.read`
    bearing: Sequence[float]  # angles from the robot's nose, to the left [rad]
    elevation: Sequence[float]  # up [rad]
    distance: Sequence[float]  # distances from the robot's centre [m]; NaN where nothing is in reach


@dataclass(eq=False, slots=True)
class BodyState:
    """State of the body of one robot; unknown numbers are NaN."""

    FIXED: ClassVar = ("refusal",)
    RARE: ClassVar = ("scan",)

    time: float = nan  # time at which the pose was measured, on the clock of `Body.read` [s]
    position: Vector = UNKNOWN  # measured [m]
    velocity: Vector = UNKNOWN  # measured or estimated [m/s]
    yaw: float = nan  # measured [rad]
    true_position: Vector = UNKNOWN  # the truth of a twin [m]
    true_yaw: float = nan  # the truth of a twin [rad]
    battery: float = nan  # charge, 0 to 1
    flying: bool = False  # motors on, off the ground or about to be
    spinning: bool = True  # the motors of a flying robot turn, as far as its device tells: one that arms waits first
    attitude: Attitude = NO_ATTITUDE  # known if the body measures more than yaw
    shadow_position: Vector = UNKNOWN  # place of the twin that runs beside the robot [m] (`agents.body.shadow_twin`)
    shadow_yaw: float = nan  # yaw of that twin [rad]
    ahead: float = nan  # stamp of the last external position less the time of its arrival [s]
    received: float = nan  # newest answer of the device, on the clock of `Body.read` [s]
    note: str = ""  # report of the hardware (supervisor, link), for people
    refusal: str = ""  # why the device would refuse to take off now; empty if it would not, or does not tell
    scan: RangeScan | None = None  # the newest sweep of its range sensors


class Body(ABC):
    """Base of all bodies: hardware or a twin of n robots.

    The `takes` of the kind of a row tells how its row of `command` is read.
    All calls come from one thread, except `land` and `stop`: other threads call these too, more than once, and while
    another call runs or hangs (`agents.runtime.watchdog`, emergency stops). They must neither block nor need the loop
    to go on. A body of several rows commands all of them, even if one of them fails (`call_all`).
    """

    SETTINGS: ClassVar[type[msgspec.Struct] | None] = None  # struct of the `device` table; None: any table is right
    APART: ClassVar[str] = "give each its own address"  # remedy for two robots with one device

    @classmethod
    def faults(cls, robots: Sequence[BodyEntry]) -> Iterator[BodyFault]:
        """Faults of all robots of a file that have this body: of their addresses and tables, and of one beside another.

        Asked when a file is read, and again before the body is made; its library may be missing, and nothing is sent.
        Two robots with one device are found without it.
        """
        yield from ()

    @classmethod
    def device_of(cls, robot: BodyEntry, endpoints: Sequence[str] = ()) -> DeviceAddress | None:
        """Device that the address of a robot names, which one process of a computer drives; None for none.

        Needed by bodies with addresses of another form than those of `plain_device`. Asked as `faults`, and with the
        `endpoints` of a `BodyRequest` when the body is opened; raises BodyError for a wrong address.
        """
        return plain_device(robot.address)

    @abstractmethod
    def open(self) -> None:
        """Connects, and returns when poses arrive; raises BodyError, with the remedy, if that fails."""

    @abstractmethod
    def read(self, t: float) -> Sequence[BodyState]:
        """The newest state of each robot at time `t` [s] of the process's clock. Never blocks; a twin advances to `t`.

        The states may be the same objects at every call, and others write to them: the body sets `velocity` and `note`
        each time.
        """

    @abstractmethod
    def command(self, setpoints: Sequence[Setpoint]) -> None:
        """Command a setpoint for each robot: x y z yaw, v_x v_y v_z yaw-rate, or v ω 0 0; NaN leaves it alone."""

    @abstractmethod
    def takeoff(self, rows: Sequence[int], heights: Sequence[float]) -> None:
        """Flying robots climb to `heights` [m] by themselves."""

    @abstractmethod
    def land(self, rows: Sequence[int]) -> None:
        """Flying rows descend and switch their motors off, ground robots halt, by themselves."""

    @abstractmethod
    def stop(self, rows: Sequence[int]) -> None:
        """Motors off, at once, wherever the rows are: the emergency stop.

        The order is repeated until the device confirms that its motors are off, or counts as gone. Until then `flying`
        stays set for a flying row, with the note `UNANSWERED`.
        """

    @abstractmethod
    def locate(self, row: int, t: float, position: Vector, yaw: float) -> None:
        """An externally measured pose of a robot: [m], yaw [rad] or NaN, taken at `t` on the clock of `read`."""

    @abstractmethod
    def close(self) -> None:
        """Releases the device. Flying rows must have landed before."""

    def inspect(self, row: int) -> Inspection:
        """Facts about the device of a row: firmware, volts, load of its radio. Never blocks, moves nothing."""
        return Inspection()


class BodyError(ExplainedError, RuntimeError):
    """A body that cannot be opened or driven, with the remedy."""


FRESH_S: Final = 0.5  # an older setpoint is dropped: wheels stop, sticks are at rest

UNANSWERED_S: Final = 2.5  # [s] longest time from a stop to the robot known to stand, before the note
UNANSWERED: Final = "the emergency stop is not answered"  # note of a robot that was stopped and still moves


def call_all(calls: Iterable[Callable[[], object]]) -> None:
    """Makes every call in the given order, even if others raise; the last error is raised afterwards.

    Used to stop robots: a body that fails must not keep the next one from being stopped.
    """
    left = iter(calls)
    for call in left:
        try:
            call()
        finally:
            call_all(left)


def shared_devices(robots: Iterable[tuple[BodyEntry, type[Body]]]) -> Iterator[BodyFault]:
    """The faults of robots with one device on one machine, as far as no name server is asked."""
    # robot by machine and key of its device, and if it is its own
    owners: dict[tuple[str, str], tuple[BodyEntry, bool]] = {}
    for each, body in robots:
        try:
            device = body.device_of(each)
        except BodyError:
            continue  # `faults` says so
        keys = [] if device is None else [((each.host, key), own) for key, own in device.lock_keys()]
        known = [(owners[key], own) for key, own in keys if key in owners]
        if owner := next((entry for (entry, whole), own in known if whole or own), None):
            other = "" if owner.address == each.address else f", there {owner.address}"
            message = f"{owner.name} has the same body, {each.address}{other}: one device gets the setpoints of both"
            yield BodyFault(each.name, ("body",), message, body.APART)
            continue
        owners.update({key: (each, own) for key, own in keys})


def judged(robot: BodyEntry, key: tuple[str | int, ...], parse: Callable[[], object]) -> Iterator[BodyFault]:
    """The fault of a robot's `key` if `parse` raises BodyError; the remedy stands behind the first `; `."""
    try:
        parse()
    except BodyError as error:
        message, _, remedy = str(error).removeprefix(f"{robot.name}: ").partition("; ")
        yield BodyFault(robot.name, key, message, remedy)


def refuse(body: type[Body], request: BodyRequest) -> None:
    """Raises BodyError for errors of the rows of a body, before it is made."""
    entries = request.entries()
    faults = [*body.faults(entries), *shared_devices((each, body) for each in entries)]
    if errors := [str(fault) for fault in faults if fault.severity == "error"]:
        raise BodyError("; ".join(errors))


SettingsT = TypeVar("SettingsT", bound=msgspec.Struct)


def settings(kind: type[SettingsT], robot: str, device: Mapping[str, Any]) -> SettingsT:
    """The settings of a robot's device; raises BodyError if a field is unknown or wrong, with the known fields."""
    try:
        return msgspec.convert(dict(device), kind)
    except msgspec.ValidationError as error:
        known = ", ".join(kind.__struct_fields__)
        raise BodyError(f"{robot}: device: {error}; its fields are {known}") from error
