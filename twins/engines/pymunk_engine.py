"""Pymunk engine: planar rigid bodies in layers by height, with contacts between robots, obstacles and walls."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from math import isfinite, sqrt
from typing import Annotated, ClassVar, Final

import pymunk
import pymunk.batch
from msgspec import Meta

from agents.body.kinds import Flight, Wheels
from agents.vectors import Share, Vector, clamp, is_finite
from twins.engines.engine import Engine, EngineFactory, EngineInput, Pose, Touch, require_carried
from twins.engines.engine import Planar as Displacement
from twins.engines.point_mass import moving_models, require_models
from twins.engines.pymunk_contacts import Contacts, Layers
from twins.engines.pymunk_space import ArenaSpace, Surfaces
from twins.models.motion import Motion
from twins.models.onboard_flight import TOUCHDOWN
from twins.models.quadrotor import GRAVITY, Quadrotor

FIELDS: Final = (
    pymunk.batch.BodyFields.POSITION
    | pymunk.batch.BodyFields.ANGLE
    | pymunk.batch.BodyFields.VELOCITY
    | pymunk.batch.BodyFields.ANGULAR_VELOCITY
    | pymunk.batch.BodyFields.FORCE
)
X, Y, YAW, V_X, V_Y, TURN, PUSH_X, PUSH_Y = range(8)  # numbers of a body in a batch with these fields
WIDTH: Final = 8
AWAY: Final = 1e6  # [m] position of absent mirrored robots
UNFELT: Final = 1e-12  # [m/s] smaller changes of speed are rounding
LEAP: Final = 10.0  # [m/s] faster motion of a plan is a jump

Friction = Annotated[float, Meta(ge=0, le=10)]


class Planar(EngineFactory, frozen=True):
    """Parameters of the pymunk engine; all are chosen for plastic hulls and rubber wheels."""

    step_s: Annotated[float, Meta(gt=0, le=0.05, description="longest internal step [s]")] = 0.005
    friction: Annotated[Friction, Meta(description="coefficient between robots")] = 0.3
    wall_friction: Annotated[Friction, Meta(description="coefficient between robots and walls or obstacles")] = 0.3
    restitution: Annotated[Share, Meta(description="speed after a blow, as a share of the speed before")] = 0.1
    traction: Annotated[Friction, Meta(description="coefficient of wheels, and of landed robots, on the floor")] = 0.7
    tilt: Annotated[float, Meta(gt=0, le=1.2, description="largest tilt of flying robots [rad]")] = math.radians(20.0)
    slide: Annotated[float, Meta(gt=0, le=2, description="speed at which what came from above slides aside [m/s]")] = (
        0.5
    )
    approach: Annotated[float, Meta(gt=0, le=20, description="closing speed up to which nothing overlaps [m/s]")] = 3.0
    iterations: Annotated[int, Meta(ge=1, le=200, description="of the contact solver in each step")] = 10

    CONTACTS: ClassVar[bool] = True
    CARRIES: ClassVar[tuple[type, ...]] = (Wheels, Flight)

    def build(self, stage: EngineInput) -> PlanarEngine:
        return PlanarEngine(stage, self)


class PlanarEngine(Engine):
    """Engine with contacts.

    The motion models compute the velocity of each robot after this tick. Forces within the grip of the wheels, or the
    thrust of a tilted quadrotor, bring the body to that velocity; pymunk's solver adds the contacts. Without contact a
    tick equals that of the point-mass engine. Pymunk moves bodies at the beginning of a step and computes velocities at
    its end. Positions here are therefore one step ahead of pymunk's: those at the beginning of the next step.
    """

    def __init__(self, stage: EngineInput, choice: Planar) -> None:
        """Raises BodyError for a kind without a twin, or with a motion that is not carried."""
        require_models(stage.kinds)
        require_carried(choice, itertools.compress(stage.kinds, (not each for each in stage.mirrored)))
        self.motions = moving_models(stage)
        self._dt, self.steps = stage.dt, max(1, math.ceil(stage.dt / choice.step_s - 1e-9))
        self._step = stage.dt / self.steps
        self._ticks = 0
        self._fastest = GRAVITY * math.tan(choice.tilt) * stage.dt  # change of speed in a tick [m/s]
        self._found: list[Touch] = []
        self._layers, self._tall = _build_layers(stage), [kind.height for kind in stage.kinds]
        self._scene = stage.scene
        self._planned_poses: list[Pose] = list(stage.scene.start)
        self._feet: list[tuple[_Flown, pymunk.PivotJoint, float]] = []  # friction of a landed robot, its force [N]
        self._space, self.carriers = self._build_space(stage, choice)
        self._high = [(row, each) for row, each in enumerate(self.carriers) if stage.kinds[row].flies]
        self.watched = [each for _, each in self._high]
        self._planned = [k for k in self._space.obstacles if stage.scene.plans[k] is not None]
        self.obstacles: list[Pose] = list(stage.scene.start)
        for robot, motion in zip(self.carriers, self.motions, strict=True):
            robot.put(motion.position, motion.yaw)

    def _build_space(self, stage: EngineInput, choice: Planar) -> tuple[_Space, list[_Carrier]]:
        """Build the scene with its robots, and find the numbers of each body in it."""
        skin = 0.5 * choice.approach * self._step
        surfaces = Surfaces(choice.friction, choice.wall_friction, choice.traction, skin)
        place = ArenaSpace(surfaces, -1 - len(stage.scene.names))
        for row, kind in enumerate(stage.kinds):
            place.add_robot(row, kind, mirrored=stage.mirrored[row])
        place.furnish(stage.scene)
        contacts = Contacts(
            place.numbers, self._layers, self._step, skin, choice.restitution, choice.slide, self._found
        )
        space, robots = _Space(place, contacts, choice.iterations), list[_Carrier]()
        for row, kind in enumerate(stage.kinds):
            at, times = space.begin(place.rows[row]), (self._dt, self._step)
            if stage.mirrored[row]:
                robots.append(_Shown(space.cells, at, *times))
            elif row in place.feet:
                robots.append(flown := _Flown(space.cells, at, times, kind.mass, self._fastest))
                self._feet.append((flown, *place.feet[row]))
            else:
                robots.append(_Driven(space.cells, at, *times, space.begin(place.wheels[row])))
        return space, robots

    def advance(self, t: float, wobble: Sequence[Displacement]) -> None:
        for robot, motion, each in zip(self.carriers, self.motions, wobble, strict=True):
            motion.wobble = each
            robot.push(motion)
        self.solve(t)
        for robot, motion in zip(self.carriers, self.motions, strict=True):
            robot.take(motion)

    def solve(self, t: float) -> None:
        for row, robot in self._high:
            self._layers.bottom[row], self._layers.top[row] = robot.height, robot.height + self._tall[row]
        for flown, foot, grip in self._feet:
            if foot.max_force != (force := grip if flown.stands else 0.0):
                foot.max_force = force
        if self._planned:
            self._move_planned(t)
        self._space.advance(self._ticks * self._dt, self._step, self.steps)
        self._ticks += 1
        self._space.read_obstacles(self.obstacles, self._step)

    def place(
        self, rows: Sequence[int], positions: Sequence[Vector], yaws: Sequence[float], flying: Sequence[bool]
    ) -> None:
        super().place(rows, positions, yaws, flying)
        for row, position, yaw in zip(rows, positions, yaws, strict=True):
            self.carriers[row].put(position, yaw)
        self._space.contacts.reset_rows(rows)

    def touches(self) -> list[Touch]:
        found = sorted(self._found, key=lambda touch: (touch.time, touch.first, touch.second))
        self._found.clear()
        return found

    def _move_planned(self, t: float) -> None:
        """Move obstacles by their plans, with the velocity that reaches the planned pose in this tick."""
        poses = self._scene.poses(t)
        for k in self._planned:
            (x, y, yaw), (to_x, to_y, to_yaw) = self._planned_poses[k], poses[k]
            turn = ((to_yaw - yaw + math.pi) % (2.0 * math.pi) - math.pi) / self._dt
            v_x, v_y = (to_x - x) / self._dt, (to_y - y) / self._dt
            if math.sqrt(v_x * v_x + v_y * v_y) > LEAP:
                x, y, yaw = to_x, to_y, to_yaw
                v_x, v_y, turn = 0.0, 0.0, 0.0
            cells, at = self._space.cells, self._space.obstacles[k]
            cells[at + X], cells[at + Y] = x - self._step * v_x, y - self._step * v_y
            cells[at + YAW] = yaw - self._step * turn
            cells[at + V_X], cells[at + V_Y], cells[at + TURN] = v_x, v_y, turn
        self._planned_poses = poses


class _Carrier:
    """A robot's body in the numbers of a space, from number `at` on."""

    __slots__ = ("_at", "_cells", "_dt", "_step", "height")

    def __init__(self, cells: memoryview[float], at: int, dt: float, step: float) -> None:
        self._cells, self._at = cells, at
        self._dt, self._step = dt, step  # [s] length of a tick, and of a step of the space
        self.height = 0.0  # [m]

    def put(self, position: Vector, yaw: float) -> None:
        """Place the body at rest."""
        cells, at = self._cells, self._at
        cells[at + X], cells[at + Y] = position[0], position[1]
        cells[at + YAW] = yaw
        cells[at + V_X] = cells[at + V_Y] = cells[at + TURN] = 0.0


class _Driven(_Carrier):
    """Robot on wheels, of which the numbers begin at `wheels`."""

    __slots__ = ("_wheels",)

    def __init__(self, cells: memoryview[float], at: int, dt: float, step: float, wheels: int) -> None:
        super().__init__(cells, at, dt, step)
        self._wheels = wheels

    def push(self, motion: Motion) -> None:
        """Turn the wheels as their model does."""
        before = motion.yaw
        motion.move(self._dt)
        cells, at = self._cells, self._wheels
        cells[at + V_X], cells[at + V_Y] = motion.velocity[0], motion.velocity[1]
        cells[at + TURN] = (motion.yaw - before) / self._dt

    def take(self, motion: Motion) -> None:
        cells, at, step = self._cells, self._at, self._step
        v_x, v_y = cells[at + V_X], cells[at + V_Y]
        motion.position = (cells[at + X] + step * v_x, cells[at + Y] + step * v_y, motion.position[2])
        motion.velocity, motion.yaw = (v_x, v_y, 0.0), cells[at + YAW] + step * cells[at + TURN]


class _Flown(_Carrier):
    """Flying robot of which the speed changes by `fastest` [m/s] in a tick at most."""

    __slots__ = ("_drift", "_fastest", "_force", "_target", "_wobble", "stands")

    def __init__(
        self, cells: memoryview[float], at: int, times: tuple[float, float], mass: float, fastest: float
    ) -> None:
        super().__init__(cells, at, *times)
        self._force, self._fastest = mass / self._step, fastest  # changes the speed by 1 m/s in one step
        self._wobble = self._drift = self._target = (0.0, 0.0)  # state of the last tick [m], [m/s], [m/s]
        self.stands = True  # True on the floor, which holds it

    def put(self, position: Vector, yaw: float) -> None:
        super().put(position, yaw)
        self._wobble = (0.0, 0.0)

    def push(self, motion: Quadrotor) -> None:
        """Push the body to the velocity of its model and of the hover jitter."""
        wobble, dt = motion.wobble, self._dt
        before_x, before_y, _ = motion.velocity
        motion.move(dt)
        v_x, v_y, _ = motion.velocity
        d_x, d_y = v_x - before_x, v_y - before_y
        size = sqrt(d_x * d_x + d_y * d_y)
        if size > self._fastest:
            d_x, d_y = d_x * (self._fastest / size), d_y * (self._fastest / size)
        if not motion.flying:
            d_x = d_y = 0.0
        drift_x, drift_y = (wobble[0] - self._wobble[0]) / dt, (wobble[1] - self._wobble[1]) / dt
        target_x, target_y = before_x + d_x, before_y + d_y
        # all in the first step of the tick: then the tick equals one of the point-mass engine, where a step is a tick
        cells, at = self._cells, self._at
        cells[at + PUSH_X] = (target_x + drift_x - cells[at + V_X]) * self._force
        cells[at + PUSH_Y] = (target_y + drift_y - cells[at + V_Y]) * self._force
        self._target, self._drift = (target_x, target_y), (drift_x, drift_y)
        self.height = motion.held[2]
        self.stands = not motion.flying and self.height <= TOUCHDOWN and drift_x == 0.0 and drift_y == 0.0

    def take(self, motion: Quadrotor) -> None:
        cells, at, step = self._cells, self._at, self._step
        v_x, v_y = cells[at + V_X], cells[at + V_Y]
        x, y = cells[at + X] + step * v_x, cells[at + Y] + step * v_y
        target_x = self._target[0] + _felt(v_x - (self._target[0] + self._drift[0]), self._drift[0])
        target_y = self._target[1] + _felt(v_y - (self._target[1] + self._drift[1]), self._drift[1])
        _, _, z = motion.held
        motion.velocity = (target_x, target_y, motion.velocity[2])
        motion.held = (x - motion.wobble[0], y - motion.wobble[1], z)
        motion.position = (x, y, z)
        self._wobble = motion.wobble


class _Shown(_Carrier):
    """Mirrored robot, far away while it is absent; the solver sees its motion from its received pose."""

    def push(self, motion: Motion) -> None:
        motion.move(self._dt)
        cells, at, step = self._cells, self._at, self._step
        x, y, self.height = motion.position
        v_x, v_y, _ = motion.velocity if is_finite(motion.velocity) else (0.0, 0.0, 0.0)
        if not (isfinite(x) and isfinite(y)):
            x, y = AWAY, AWAY
            v_x, v_y = 0.0, 0.0
        cells[at + X], cells[at + Y] = x - step * v_x, y - step * v_y
        cells[at + YAW] = motion.yaw if isfinite(motion.yaw) else 0.0
        cells[at + V_X], cells[at + V_Y] = v_x, v_y
        cells[at + TURN] = 0.0

    def take(self, _: Motion) -> None:
        """Nothing: the robot is where it is shown."""


def _felt(blow: float, drift: float) -> float:
    """Change of speed on an axis that the robot notices: a contact first stops the hover jitter, unknown to it."""
    if not abs(blow) > UNFELT:
        return 0.0
    return blow - clamp(blow, min(-drift, 0.0), max(-drift, 0.0))


class _Space:
    """Pymunk's space, and the numbers of its bodies."""

    cells: memoryview[float]  # state of all bodies, WIDTH each; pymunk's own memory
    obstacles: dict[int, int]  # index of the first number of each obstacle with a plan or a mass

    def __init__(self, place: ArenaSpace, contacts: Contacts, iterations: int) -> None:
        self._space, self.contacts = place.space, contacts
        self._space.iterations = iterations
        contacts.attach(self._space)
        identities = pymunk.batch.Buffer()
        pymunk.batch.get_space_bodies(self._space, pymunk.batch.BodyFields.BODY_ID, identities)
        order = memoryview(identities.int_buf()).cast("P").tolist()
        self._begin = {identity: WIDTH * k for k, identity in enumerate(order)}
        self._buffer = pymunk.batch.Buffer()
        pymunk.batch.get_space_bodies(self._space, FIELDS, self._buffer)
        # pymunk fills the same memory at every call, because no body is added or removed any more
        self.cells = memoryview(self._buffer.float_buf()).cast("d")
        self.obstacles = {k: self.begin(body) for k, body in place.obstacles.items()}

    def begin(self, body: pymunk.Body) -> int:
        """Index of the first number of a body."""
        return self._begin[body.id]

    def advance(self, begin: float, step: float, steps: int) -> None:
        """Advance the bodies from their numbers, `begin` [s] after the first tick."""
        pymunk.batch.set_space_bodies(self._space, FIELDS, self._buffer)
        for k in range(steps):
            self.contacts.time = begin + k * step
            self._space.step(step)
        self._buffer.clear()
        pymunk.batch.get_space_bodies(self._space, FIELDS, self._buffer)

    def read_obstacles(self, poses: list[Pose], step: float) -> None:
        """Update the poses of the obstacles that move."""
        cells = self.cells
        for k, at in self.obstacles.items():
            poses[k] = (
                cells[at + X] + step * cells[at + V_X],
                cells[at + Y] + step * cells[at + V_Y],
                cells[at + YAW] + step * cells[at + TURN],
            )


def _build_layers(stage: EngineInput) -> Layers:
    scene, rows = stage.scene, len(stage.kinds)
    # negative numbers count from the end: obstacle 0 is last, and the arena's walls come before all obstacles
    bottom = [*(0.0,) * rows, -math.inf, *scene.bottom[::-1].tolist()]
    top = [*(kind.height for kind in stage.kinds), math.inf, *scene.top[::-1].tolist()]
    return Layers(bottom, top)
