"""Interface between the decision for a robot and its body: hardware or a twin, chosen by one word.

A body may have several robots: a bridge that serves three Crazyflies on one radio is one body of three rows.
The runtime finds bodies by the entry-point group `zenpark.bodies`: the word before `://` (or the whole word) names one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import nan
from typing import Annotated, Any, Final, TypeVar

import msgspec
from msgspec import Meta

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
    rate_hz: float  # [1/s] of readings and commands
    seeds: tuple[int, ...]
    disturbance: tuple[Disturbance, ...]
    external: tuple[bool, ...]  # rows with a position from outside, through `Body.locate`
    device: tuple[Mapping[str, Any], ...]  # settings of the hardware in the experiment file; the body checks them
    endpoints: tuple[str, ...]  # for bodies on the network
    keys: Keys
    clock: Clock = field(default_factory=Clock)  # of stamps on the network

    def select(self, rows: Sequence[int]) -> BodyRequest:
        per_row = ("names", "kinds", "addresses", "start", "yaw", "seeds", "disturbance", "external", "device")
        columns: dict[str, Any] = {name: tuple(getattr(self, name)[row] for row in rows) for name in per_row}
        return replace(self, **columns)


class RangeScan(msgspec.Struct, frozen=True):
    """Sweep of a robot's range sensors; all sequences have an entry for each ray."""

    time: float  # [s] of the measurement, on the clock of `Body.read`
    bearing: Sequence[float]  # from the robot's nose, to the left [rad]
    elevation: Sequence[float]  # up [rad]
    distance: Sequence[float]  # from the robot's centre [m]; NaN where nothing is in reach


@dataclass(eq=False, slots=True)
class BodyState:
    """State of the body of one robot; unknown numbers are NaN."""

    time: float = nan  # when the pose was measured, on the clock of `Body.read` [s]
    position: Vector = UNKNOWN  # measured [m]
    velocity: Vector = UNKNOWN  # measured or estimated [m/s]
    yaw: float = nan  # measured [rad]
    true_position: Vector = UNKNOWN  # the truth of a twin [m]
    true_yaw: float = nan  # the truth of a twin [rad]
    battery: float = nan  # charge, 0 to 1
    flying: bool = False  # motors on, off the ground or about to be
    attitude: Attitude = NO_ATTITUDE  # of bodies that measure more than yaw
    shadow_position: Vector = UNKNOWN  # of the twin that runs beside the robot [m] (`agents.body.shadow_twin`)
    shadow_yaw: float = nan  # of that twin [rad]
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


SettingsT = TypeVar("SettingsT", bound=msgspec.Struct)


def settings(kind: type[SettingsT], robot: str, device: Mapping[str, Any]) -> SettingsT:
    """The settings of a robot's device; raises BodyError if a field is unknown or wrong, with the known fields."""
    try:
        return msgspec.convert(dict(device), kind)
    except msgspec.ValidationError as error:
        known = ", ".join(kind.__struct_fields__)
        raise BodyError(f"{robot}: device: {error}; its fields are {known}") from error
