"""Interface of the engines that move the twins of one scene.

Engines are found by the entry-point group `zenpark.engines`: a frozen struct of parameters with a method `build`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import msgspec

from agents.body.interface import NO_ATTITUDE, BodyError
from agents.body.kinds import Kind
from agents.vectors import UNKNOWN, ZERO, Vector
from twins.models.motion import Motion

if TYPE_CHECKING:  # a process of one robot needs no scene, which needs numpy
    from twins.scene import Scene

Planar = tuple[float, float]  # x, y
Pose = tuple[float, float, float]  # x, y [m], yaw [rad]


@dataclass(frozen=True)
class EngineInput:
    """Input of an engine: n robots and the scene."""

    kinds: tuple[Kind, ...]  # kinds of the robots
    start: Sequence[Vector]  # [m]
    yaw: Sequence[float]  # [rad]
    dt: float  # step of `Engine.advance` [s]
    mirrored: Sequence[bool]  # robots that really are elsewhere: moved by `Engine.mirror` only
    scene: Scene


@dataclass(frozen=True)
class Touch:
    """Beginning of a contact."""

    time: float  # time since the engine was built [s]
    first: int  # row
    second: int  # row, or −1 − k for obstacle k of the scene, or −1 − M for a wall of the arena (M obstacles)
    impulse: float  # impulse of the step in which the contact began [N s]
    overlap: float  # [m]


class Mirrored(Motion):
    """Motion of a robot that really is elsewhere: as `shown`, absent (NaN) before. Orders have no effect."""

    def __init__(self, yaw: float) -> None:
        self.position = self._position = UNKNOWN
        self.velocity = self._velocity = ZERO
        self.yaw = self._yaw = yaw
        self.flying, self.attitude = False, NO_ATTITUDE
        self.wobble = (0.0, 0.0)

    def show(self, position: Vector, yaw: float, velocity: Vector) -> None:
        """Set the state from the next step on: [m], [rad], [m/s]; NaN: absent."""
        self._position, self._yaw, self._velocity = position, yaw, velocity

    def move(self, dt: float) -> None:
        self.position, self.yaw, self.velocity = self._position, self._yaw, self._velocity


class Engine(ABC):
    """Motion of n robots and of the obstacles."""

    motions: Sequence[Motion]  # motions of the robots; the same objects for ever
    obstacles: Sequence[Pose]  # current poses of the obstacles
    # holds on the robots, of engines that advance by quiet `push(motion)` of each, `solve`, and quiet `take(motion)`
    carriers: Sequence[Any] = ()
    watched: Sequence[Any] = ()  # carriers that `solve` looks at

    @abstractmethod
    def advance(self, t: float, wobble: Sequence[Planar]) -> None:
        """Advance one step of dt, to `t` [s] after the common start (negative before).

        Args:
            t: Time for obstacles with a plan.
            wobble: Hover jitter: horizontal displacement added to each flying robot at the end of the step [m].
        """

    def solve(self, t: float) -> None:  # noqa: B027 - of engines with carriers
        """Part of `advance` between its carriers'."""

    def takeoff(self, rows: Sequence[int], heights: Sequence[float]) -> None:
        """Make flying robots climb to `heights` [m]."""
        for row, height in zip(rows, heights, strict=True):
            self.motions[row].takeoff(height)

    def land(self, rows: Sequence[int]) -> None:
        """Make flying robots descend and switch off, and ground robots halt."""
        for row in rows:
            self.motions[row].land()

    def stop(self, rows: Sequence[int]) -> None:
        """Switch motors off at once."""
        for row in rows:
            self.motions[row].stop()

    def place(
        self, rows: Sequence[int], positions: Sequence[Vector], yaws: Sequence[float], flying: Sequence[bool]
    ) -> None:
        """Set positions [m] and yaws [rad], at rest; flying robots hold them."""
        for row, position, yaw, flies in zip(rows, positions, yaws, flying, strict=True):
            self.motions[row].place(position, yaw, flying=flies)

    def mirror(
        self, rows: Sequence[int], positions: Sequence[Vector], yaws: Sequence[float], velocities: Sequence[Vector]
    ) -> None:
        """Set the state of mirrored robots from the next step on: [m], [rad], [m/s]; NaN: absent."""
        for row, position, yaw, velocity in zip(rows, positions, yaws, velocities, strict=True):
            motion = self.motions[row]
            if isinstance(motion, Mirrored):
                motion.show(position, yaw, velocity)

    def touches(self) -> list[Touch]:
        """Contacts that began since the last call; always empty in an engine without contacts."""
        return []


class EngineFactory(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of all engines: their parameters."""

    CONTACTS: ClassVar[bool] = False  # detects contacts; else they are computed from the recorded positions
    CARRIES: ClassVar[tuple[type, ...]] = (object,)  # motions of `agents.body.kinds` that it moves

    def build(self, stage: EngineInput) -> Engine:
        """Build an engine; raises BodyError with the remedy if a kind has no twin, or a library is missing."""
        raise TypeError(f"{type(self).__name__} must define `build`")


@dataclass(frozen=True)
class World:
    """World shared by n twins; sequences have an entry for each."""

    scene: Scene
    engine: EngineFactory
    sensors: Sequence[tuple[str, ...]]  # range sensors, by name (`twins.sensing.range_sensors.sensors`)
    sensor_noise: float  # noise of the range sensors, as a multiple of the real noise
    mirrored: Sequence[bool]  # robots that really are elsewhere, shown here at their received poses


def require_carried(engine: EngineFactory, kinds: Iterable[Kind]) -> None:
    """Raises BodyError for kinds with a motion that an engine does not carry."""
    if refused := sorted({kind.name for kind in kinds if not isinstance(kind.motion, engine.CARRIES)}):
        known = ", ".join(motion.__name__ for motion in engine.CARRIES)
        which = ", ".join(map(repr, refused))
        raise BodyError(f"{which} does not move in this engine, which carries {known} alone: choose point-mass")
