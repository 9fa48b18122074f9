"""The small interface behind which different engines move twins: the same rows, in one place or in many copies of it.

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
    """What an engine is built with; arrays over its rows (n).

    Attributes:
        kinds: Of the rows.
        start: (n, 3) [m].
        yaw: (n,) [rad].
        dt: Length of a step of `Engine.advance` [s].
        copy: (n,) which copy of the place a row is in; only rows of one copy can touch each other.
        mirrored: (n,) rows that are elsewhere in reality: they are where they are put, and nothing moves them.
        scene: What else stands there; every copy has its own.
    """

    kinds: tuple[Kind, ...]
    start: Array
    yaw: Array
    dt: float
    copy: Index
    mirrored: Mask
    scene: Scene


@dataclass(frozen=True)
class Touch:
    """The beginning of a contact.

    Attributes:
        time: Since the engine was built [s].
        first: Row.
        second: Row, or −1 − k for obstacle k of the scene, or −1 − M for a wall of the arena (M obstacles).
        impulse: [N s], of the step in which the contact began.
        overlap: [m]
    """

    time: float
    first: int
    second: int
    impulse: float
    overlap: float


class Engine(Protocol):
    """Rows of robots, and what moves them.

    Attributes:
        position: (n, 3) the truth, wobble included [m].
        velocity: (n, 3) of what the robot's own controller knows: without wobble [m/s].
        yaw: (n,) [rad].
        flying: (n,) motors on, off the ground or about to be.
        attitude: (n, 4) unit quaternion w, x, y, z from robot to room; None: upright, with `yaw`.
        obstacles: (copies, M, 3) poses of the obstacles now: x, y [m], yaw [rad].
    """

    @property
    def position(self) -> Array: ...
    @property
    def velocity(self) -> Array: ...
    @property
    def yaw(self) -> Array: ...
    @property
    def flying(self) -> Mask: ...
    @property
    def attitude(self) -> Array | None: ...
    @property
    def obstacles(self) -> Array: ...

    def command(self, setpoint: Array) -> None:
        """Setpoints (n, 4) as in `agents.body.interface.Body.command`; rows of NaN keep theirs."""
        ...

    def takeoff(self, rows: Index, height: Array) -> None:
        """Flying rows climb to `height` (len(rows),) [m]."""
        ...

    def land(self, rows: Index) -> None:
        """Flying rows descend and switch off, ground robots halt."""
        ...

    def stop(self, rows: Index) -> None:
        """Motors off, at once."""
        ...

    def advance(self, t: float, wobble: Array) -> None:
        """One step of dt, to `t` [s] after the common start (negative before).

        Args:
            t: For obstacles that move by a plan.
            wobble: (n, 2) horizontal displacement that nature adds to each row at the end of the step [m].
        """
        ...

    def place(self, rows: Index, position: Array, yaw: Array, flying: Mask) -> None:
        """Puts rows somewhere, at rest: (len(rows), 3) [m], (len(rows),) [rad]; flying rows hold that place."""
        ...

    def mirror(self, rows: Index, position: Array, yaw: Array, velocity: Array) -> None:
        """Where mirrored rows are now, and how they move: (len(rows), 3) [m], [m/s]; NaN: they are not there."""
        ...

    def touches(self) -> list[Touch]:
        """Contacts that began since this was asked last; an engine without contacts has none."""
        ...


class EngineFactory(Protocol):
    """The parameters of an engine.

    One whose engines find contacts says so by the class variable `contacts = True`: that a run has none recorded then
    means that nothing touched. Of others, what touched is worked out from the recorded positions.
    """

    def build(self, stage: Stage) -> Engine:
        """An engine with these parameters.

        Raises:
            BodyError: If it has no twin of one of the kinds, or a library is missing, with the remedy.
        """
        ...
