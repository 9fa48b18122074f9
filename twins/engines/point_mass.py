"""Point-mass engine: every robot moves by its own model, without contacts; for thousands of robots."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Final

from agents.body.interface import BodyError
from agents.body.kinds import Flight, Holonomic, Kind, Steered, Wheels
from agents.plugins import registry
from agents.vectors import Vector
from twins.engines.engine import Engine, EngineFactory, EngineInput, Mirrored, Planar
from twins.models.differential import Differential
from twins.models.ground import Bicycle, Omni
from twins.models.motion import Motion
from twins.models.quadrotor import Quadrotor

if TYPE_CHECKING:  # a process of one robot needs no scene, which needs numpy
    from twins.scene import Scene


class PointMass(EngineFactory, frozen=True):
    """The point-mass engine has no parameters."""

    def build(self, stage: EngineInput) -> PointMassEngine:
        return PointMassEngine(moving_models(stage), stage.dt, stage.scene)


TWINLESS: Final = "give the kind a `motion` (docs/plugins.md), or name another body"  # remedy without a model


MODELS: Final[dict[type, Callable[[Kind, Vector, float], Motion]]] = {
    Flight: Quadrotor, Wheels: Differential, Holonomic: Omni, Steered: Bicycle,
}  # fmt: skip
SETPOINTS: Final = {Flight: ("position", "velocity"), Wheels: "twist", Holonomic: "velocity", Steered: "twist"}


def has_model(kind: Kind) -> bool:
    """Whether a model moves as the kind, by the setpoints that it takes."""
    motion = kind.motion
    if motion is None or isinstance(motion, str):
        return motion is not None
    return kind.flies == isinstance(motion, Flight) and kind.takes in SETPOINTS[type(motion)]


def require_models(kinds: Iterable[Kind]) -> None:
    """Raises BodyError for a kind without a model."""
    if modelless := sorted({kind.name for kind in kinds if not has_model(kind)}):
        raise BodyError(f"no twin of {', '.join(map(repr, modelless))}; {TWINLESS}")


def model(kind: Kind, start: Vector, yaw: float) -> Motion:
    """Motion model of a robot at rest at `start` [m], `yaw` [rad]; raises PluginError if its kind names none."""
    motion = kind.motion
    assert motion is not None
    if isinstance(motion, str):
        made: Motion = registry.find(motion, f"motion of the kind {kind.name!r}")(kind, start, yaw)
        return made
    return MODELS[type(motion)](kind, start, yaw)


def moving_models(stage: EngineInput) -> list[Motion]:
    """Motion models of all robots; raises BodyError for a kind without one."""
    require_models(stage.kinds)
    return [
        Mirrored(yaw) if mirrored else model(kind, start, yaw)
        for kind, start, yaw, mirrored in zip(stage.kinds, stage.start, stage.yaw, stage.mirrored, strict=True)
    ]


class PointMassEngine(Engine):
    """Engine of robots that may as well be moved one by one, see `twins.body.Twin`."""

    def __init__(self, motions: list[Motion], dt: float, scene: Scene | None = None) -> None:
        self.motions = motions
        self._dt, self._scene = dt, scene
        self.moves_obstacles = scene is not None and any(scene.plans)
        self.obstacles = [] if scene is None else scene.start

    def advance(self, t: float, wobble: Sequence[Planar]) -> None:
        dt = self._dt
        for motion, displacement in zip(self.motions, wobble, strict=True):
            motion.wobble = displacement
            motion.move(dt)
        if self.moves_obstacles:
            self.move_obstacles(t)

    def move_obstacles(self, t: float) -> None:
        """Move obstacles with a plan to where they are at `t` [s] after the common start."""
        if self._scene is not None:
            self.obstacles = self._scene.poses(t)
