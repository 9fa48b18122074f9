"""Interface between the decision for a robot and its body: hardware or a twin, chosen by one word.

A body has rows as everything has: a bridge that serves three Crazyflies on one radio is one body of three rows.
The runtime finds bodies by the entry-point group `zenpark.bodies`: the word before `://` (or the whole word) names one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Final, Protocol, TypeVar, runtime_checkable

import msgspec
import numpy as np
from msgspec import Meta

from agents.arrays import Array, Columns, Index, Mask
from agents.body.kinds import Kind
from agents.clock import Clock
from agents.errors import ExplainedError
from agents.network.keys import Keys
from agents.network.messages import Inspection


class Jitter(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Drift of a hovering robot: an Ornstein-Uhlenbeck process on each horizontal axis."""

    sigma: Annotated[float, Meta(description="standard deviation on each axis [m]", ge=0, lt=1)]
    correlation_s: Annotated[float, Meta(description="correlation time [s]", gt=0, lt=1000)] = 0.5


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

    def without_noise(self) -> Disturbance:
        """Disturbance without its random parts: the latency."""
        return Disturbance(latency_s=self.latency_s)


@dataclass(frozen=True)
class BodyRequest:
    """Request for a body; every sequence has one entry per row."""

    names: tuple[str, ...]
    kinds: tuple[Kind, ...]
    addresses: tuple[str, ...]  # the `body` of the experiment file: "twin", "radio://0/80/2M/E7E7E7E701", ...
    start: Array  # (n, 3) [m]
    yaw: Array  # (n,) [rad]
    rate_hz: float  # [1/s] of readings and commands
    seeds: tuple[int, ...]
    disturbance: tuple[Disturbance, ...]
    external: tuple[bool, ...]  # rows with a position from outside, through `Body.locate`
    device: tuple[Mapping[str, Any], ...]  # settings of the hardware in the experiment file; the body checks them
    endpoints: tuple[str, ...]  # for bodies on the network
    keys: Keys
    clock: Clock = field(default_factory=Clock)  # of stamps on the network

    def select(self, rows: Index) -> BodyRequest:
        per_row = ("names", "kinds", "addresses", "seeds", "disturbance", "external", "device")
        columns: dict[str, Any] = {name: tuple(getattr(self, name)[row] for row in rows) for name in per_row}
        return replace(self, start=self.start[rows], yaw=self.yaw[rows], **columns)


@dataclass(frozen=True)
class RangeScan:
    """Sweep of a robot's range sensors."""

    time: float  # [s] of the measurement, on the clock of `Body.read`
    bearing: Array  # (m,) from the robot's nose, to the left [rad]
    elevation: Array  # (m,) up [rad]
    distance: Array  # (m,) from the robot's centre [m]; NaN where nothing is in reach


class Rays(Columns, frozen=True):
    """The newest readings of the range sensors of any rows, one entry per ray (R)."""

    row: Index  # (R,) whose ray it is; rays of one row follow one another
    time: Array  # (R,) when it was measured, on the clock of `Body.read` [s]
    bearing: Array  # (R,) from the robot's nose, to the left [rad]
    elevation: Array  # (R,) up [rad]
    distance: Array  # (R,) from the robot's centre [m]; NaN where nothing is in reach

    @classmethod
    def gather(cls, scans: Sequence[RangeScan | None]) -> Rays | None:
        there = [(row, scan) for row, scan in enumerate(scans) if scan is not None]
        if not there:
            return None
        counts = [len(scan.distance) for _, scan in there]
        return cls(
            np.repeat(np.array([row for row, _ in there], dtype=np.intp), counts),
            np.repeat(np.array([scan.time for _, scan in there]), counts),
            np.concatenate([scan.bearing for _, scan in there]),
            np.concatenate([scan.elevation for _, scan in there]),
            np.concatenate([scan.distance for _, scan in there]),
        )

    @classmethod
    def of_bodies(cls, parts: Sequence[tuple[Index, Rays | None]]) -> Rays | None:
        """The rays of several bodies, whose rows are rows `group` of the whole; None without any."""
        there = [msgspec.structs.replace(rays, row=group[rays.row]) for group, rays in parts if rays is not None]
        return cls.joined(there) if there else None

    def scan_of(self, row: int) -> RangeScan | None:
        mine = self.row == row
        if not mine.any():
            return None
        time = float(self.time[mine].max())
        return RangeScan(time, self.bearing[mine], self.elevation[mine], self.distance[mine])


@dataclass
class BodyState:
    """State of a body. Unknown numbers are NaN."""

    time: Array  # (n,) when the pose was measured, on the clock of `read` [s]
    position: Array  # (n, 3) measured [m]
    velocity: Array  # (n, 3) measured or estimated [m/s]
    yaw: Array  # (n,) measured [rad]
    true_position: Array  # (n, 3) the truth of a twin [m]
    true_yaw: Array  # (n,) the truth of a twin [rad]
    battery: Array  # (n,) charge, 0 to 1
    flying: Mask  # (n,) motors on, off the ground or about to be
    # report of the hardware of each row (supervisor, link), for people; empty if none
    notes: tuple[str, ...] = ()
    rays: Rays | None = None  # readings of range sensors; None without sensors
    # (n, 4) unit quaternion w, x, y, z from the robot to the room, of bodies that measure more than yaw
    attitude: Array | None = None
    # (n, 3) of the twin that runs beside each row [m], NaN for rows without one; None if there is none at all (see
    # `agents.body.shadow_twin`)
    shadow_position: Array | None = None
    shadow_yaw: Array | None = None  # (n,) of that twin [rad]
    # (n,) [s] stamp of the last external position less the time of its arrival; None without external positions
    ahead: Array | None = None
    # why the device of each row would refuse to take off now; empty if it would not, or does not tell
    refusals: tuple[str, ...] = ()
    # (n,) when the device was heard last, on the clock of `read` [s]; NaN, or None, for bodies without a device
    heard: Array | None = None


class Body(Protocol):
    """Hardware or a twin of n robots. The `takes` of the kind of a row tells how its row of `command` is read.

    Calls come from one thread, but for `land` and `stop`: these come from others too, more than once, and while another
    call runs or hangs (`agents.runtime.watchdog`, emergency stops). They must neither block nor need the loop to go on.
    A body of several rows commands all of them, even if one of them fails (`call_all`).
    """

    def open(self) -> None:
        """Connects, and returns when poses arrive; raises BodyError, with the remedy, if that fails."""
        ...

    def read(self, t: float) -> BodyState:
        """The newest state at time `t` [s] of the process's clock. Never blocks; a twin advances itself to `t`."""
        ...

    def command(self, setpoint: Array) -> None:
        """Command setpoints (n, 4): x y z yaw, v_x v_y v_z yaw-rate, or v ω 0 0; rows of NaN are left alone."""
        ...

    def takeoff(self, rows: Index, height: Array) -> None:
        """Flying rows climb to `height` (len(rows),) [m] by themselves."""
        ...

    def land(self, rows: Index) -> None:
        """Flying rows descend and switch their motors off, ground robots halt, by themselves."""
        ...

    def stop(self, rows: Index) -> None:
        """Motors off, at once, wherever the rows are: the emergency stop.

        The order is repeated until the device confirms that its motors are off, or counts as gone; until then `flying`
        stays set for a flying row, and its note is `UNANSWERED`.
        """
        ...

    def locate(self, row: int, t: float, position: Array, yaw: float) -> None:
        """An externally measured pose of a row: (3,) [m], yaw [rad] or NaN, taken at `t` on the clock of `read`."""
        ...

    def close(self) -> None:
        """Releases the device. Flying rows must have landed before."""
        ...


@runtime_checkable
class Inspectable(Protocol):
    """A body that knows more of its devices than their state; the method is optional for bodies."""

    def inspect(self, row: int) -> Inspection:
        """Facts about the device of a row: firmware, volts, load of its radio. Never blocks, moves nothing."""
        ...


def inspect(body: Body, row: int) -> Inspection:
    """Facts about the device of a row; none for a body that cannot be inspected."""
    return body.inspect(row) if isinstance(body, Inspectable) else Inspection()


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
