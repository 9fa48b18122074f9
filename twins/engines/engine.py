"""Interface of the engines that move twins, in one scene or in many copies of it.

Engines are found by the entry-point group `zenpark.engines`: a frozen struct of parameters with a method `build`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from agents.arrays import Array, Index, Mask
from agents.body.kinds import Kind
from twins.scene import Scene


@dataclass(frozen=True)
class Stage:
    """Input of an engine: n rows and the scene."""

    kinds: tuple[Kind, ...]  # of the rows
    start: Array  # (n, 3) [m]
    yaw: Array  # (n,) [rad]
    dt: float  # step of `Engine.advance` [s]
    copy: Index  # (n,) copy of the scene of each row; only rows of one copy can touch each other
    mirrored: Mask  # (n,) robots that really are elsewhere: moved by `Engine.mirror` only
    scene: Scene  # every copy has its own obstacles


@dataclass(frozen=True)
class Touch:
    """Beginning of a contact."""

    time: float  # since the engine was built [s]
    first: int  # row
    second: int  # row, or −1 − k for obstacle k of the scene, or −1 − M for a wall of the arena (M obstacles)
    impulse: float  # of the step in which the contact began [N s]
    overlap: float  # [m]


class Engine(Protocol):
    """Motion of n robots and of the obstacles."""

    @property
    def position(self) -> Array: ...  # (n, 3) true position, hover jitter included [m]
    @property
    def velocity(self) -> Array: ...  # (n, 3) as known by the robot's controller: without hover jitter [m/s]
    @property
    def yaw(self) -> Array: ...  # (n,) [rad]
    @property
    def flying(self) -> Mask: ...  # (n,) motors on, in the air or about to be
    @property
    def attitude(self) -> Array | None: ...  # (n, 4) unit quaternion w, x, y, z from robot to world; None: upright
    @property
    def obstacles(self) -> Array: ...  # (copies, M, 3) current poses: x, y [m], yaw [rad]

    def command(self, setpoint: Array) -> None:
        """Set setpoints (n, 4) as in `agents.body.interface.Body.command`; rows of NaN keep theirs."""
        ...

    def takeoff(self, rows: Index, height: Array) -> None:
        """Make flying rows climb to `height` (len(rows),) [m]."""
        ...

    def land(self, rows: Index) -> None:
        """Make flying rows descend and switch off, and ground robots halt."""
        ...

    def stop(self, rows: Index) -> None:
        """Switch motors off at once."""
        ...

    def advance(self, t: float, wobble: Array) -> None:
        """Advance one step of dt, to `t` [s] after the common start (negative before).

        Args:
            t: Time for obstacles with a plan.
            wobble: (n, 2) hover jitter: horizontal displacement added to each row at the end of the step [m].
        """
        ...

    def place(self, rows: Index, position: Array, yaw: Array, flying: Mask) -> None:
        """Set positions (len(rows), 3) [m] and yaws (len(rows),) [rad], at rest; flying rows hold them."""
        ...

    def mirror(self, rows: Index, position: Array, yaw: Array, velocity: Array) -> None:
        """Set state of mirrored rows: (len(rows), 3) [m], (len(rows),) [rad], (len(rows), 3) [m/s]; NaN: absent."""
        ...

    def touches(self) -> list[Touch]:
        """Contacts that began since the last call; always empty in an engine without contacts."""
        ...


class EngineFactory(Protocol):
    """Parameters of an engine.

    The class variable `contacts = True` declares that the engine detects contacts: a run without recorded contacts then
    had none. For other engines contacts are computed from the recorded positions.
    """

    def build(self, stage: Stage) -> Engine:
        """Build an engine; raises BodyError with the remedy if a kind has no twin, or a library is missing."""
        ...
