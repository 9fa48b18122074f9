"""Pymunk engine: planar rigid bodies in layers by height, with contacts between robots, obstacles and walls."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Annotated, ClassVar, Final

import pymunk
import pymunk.batch
from msgspec import Meta

from agents.body.kinds import Flight, Kind, Wheels
from agents.vectors import Share, Vector, clamp, is_finite
from twins.engines.engine import Engine, EngineFactory, EngineInput, Mirrored, Pose, Touch, require_carried
from twins.engines.engine import Planar as Displacement
from twins.engines.point_mass import moving_models, require_models
from twins.engines.pymunk_contacts import Contacts, Layers
from twins.engines.pymunk_space import ArenaSpace, Surfaces
from twins.models.differential import Differential
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
        self._layers = _build_layers(stage)
        self._scene = stage.scene
        self._planned_poses: list[Pose] = list(stage.scene.start)
        self._space, self._robots = self._build_space(stage, choice)
        self._planned = [k for k in self._space.obstacles if stage.scene.plans[k] is not None]
        self.obstacles: list[Pose] = list(stage.scene.start)
        for robot, motion in zip(self._robots, self.motions, strict=True):
            robot.put(motion.position, motion.yaw)

    def _build_space(self, stage: EngineInput, choice: Planar) -> tuple[_Space, list[_RobotBody]]:
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
        space, robots = _Space(place, contacts, choice.iterations), list[_RobotBody]()
        for row, kind in enumerate(stage.kinds):
            body = place.rows[row]
            wheels = place.wheels.get(row, body)
            robots.append(_RobotBody(space.cells, space.begin(body), space.begin(wheels), kind, self._step))
            if row in place.feet:
                robots[row].foot, robots[row].grip = place.feet[row]
        return space, robots

    def advance(self, t: float, wobble: Sequence[Displacement]) -> None:
        step, dt = self._step, self._dt
        for row, (robot, motion) in enumerate(zip(self._robots, self.motions, strict=True)):
            if isinstance(motion, Quadrotor):
                self._push_flying(row, robot, motion, wobble[row])
            elif isinstance(motion, Differential):
                robot.drive(motion, dt)
            elif isinstance(motion, Mirrored):
                self._show_mirrored(row, robot, motion)
        if self._planned:
            self._move_planned(t)
        self._space.advance(self._ticks * dt, step, self.steps)
        self._ticks += 1
        for robot, motion in zip(self._robots, self.motions, strict=True):
            if isinstance(motion, Quadrotor):
                robot.take_flight(motion, step)
            elif isinstance(motion, Differential):
                robot.take_drive(motion, step)
        self._space.read_obstacles(self.obstacles, step)

    def place(
        self, rows: Sequence[int], positions: Sequence[Vector], yaws: Sequence[float], flying: Sequence[bool]
    ) -> None:
        super().place(rows, positions, yaws, flying)
        for row, position, yaw in zip(rows, positions, yaws, strict=True):
            self._robots[row].put(position, yaw)
        self._space.contacts.reset_rows(rows)

    def touches(self) -> list[Touch]:
        found = sorted(self._found, key=lambda touch: (touch.time, touch.first, touch.second))
        self._found.clear()
        return found

    def _push_flying(self, row: int, robot: _RobotBody, flight: Quadrotor, wobble: Displacement) -> None:
        """Apply the force that a flying robot's model asks for."""
        height = robot.fly(flight, wobble, self._dt, self._fastest)
        self._layers.bottom[row], self._layers.top[row] = height, height + robot.tall

    def _show_mirrored(self, row: int, robot: _RobotBody, motion: Mirrored) -> None:
        """Set a mirrored robot to its received pose; the solver sees its motion from there."""
        motion.move(self._dt)
        robot.show(motion, self._step)
        if robot.flies:
            height = motion.position[2]
            self._layers.bottom[row], self._layers.top[row] = height, height + robot.tall

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


class _RobotBody:
    """A robot's body, and its wheels, in the numbers of a space."""

    def __init__(self, cells: memoryview[float], at: int, wheels: int, kind: Kind, step: float) -> None:
        """Numbers from `at` and, of the wheels, from `wheels` on."""
        self._cells, self._at, self._wheels = cells, at, wheels
        self._force = kind.mass / step  # changes the speed by 1 m/s in one step
        self._wobble = self._drift = self._target = (0.0, 0.0)  # state of the last tick [m], [m/s], [m/s]
        self._stands = True
        self.flies, self.tall = kind.flies, kind.height  # [m]
        self.foot: pymunk.PivotJoint | None = None  # friction of a landed robot with the floor,
        self.grip = 0.0  # its force [N]

    def put(self, position: Vector, yaw: float) -> None:
        """Place the body at rest."""
        cells, at = self._cells, self._at
        cells[at + X], cells[at + Y] = position[0], position[1]
        cells[at + YAW] = yaw
        cells[at + V_X] = cells[at + V_Y] = cells[at + TURN] = 0.0
        self._wobble = (0.0, 0.0)

    def drive(self, drive: Differential, dt: float) -> None:
        """Turn the wheels as their model does."""
        before = drive.yaw
        drive.move(dt)
        cells, at = self._cells, self._wheels
        cells[at + V_X], cells[at + V_Y] = drive.velocity[0], drive.velocity[1]
        cells[at + TURN] = (drive.yaw - before) / dt

    def take_drive(self, drive: Differential, step: float) -> None:
        """Give the model the state of the body."""
        cells, at = self._cells, self._at
        v_x, v_y = cells[at + V_X], cells[at + V_Y]
        drive.position = (cells[at + X] + step * v_x, cells[at + Y] + step * v_y, drive.position[2])
        drive.velocity, drive.yaw = (v_x, v_y, 0.0), cells[at + YAW] + step * cells[at + TURN]

    def fly(self, flight: Quadrotor, wobble: Displacement, dt: float, fastest: float) -> float:
        """Push the body to the velocity of its model and of the hover jitter; returns the height [m]."""
        flight.wobble = wobble
        before_x, before_y, _ = flight.velocity
        flight.move(dt)
        v_x, v_y, _ = flight.velocity
        d_x, d_y = v_x - before_x, v_y - before_y
        size = math.sqrt(d_x * d_x + d_y * d_y)
        if size > fastest:
            d_x, d_y = d_x * (fastest / size), d_y * (fastest / size)
        if not flight.flying:
            d_x = d_y = 0.0
        drift_x, drift_y = (wobble[0] - self._wobble[0]) / dt, (wobble[1] - self._wobble[1]) / dt
        target_x, target_y = before_x + d_x, before_y + d_y
        # all in the first step of the tick: then the tick equals one of the point-mass engine, where a step is a tick
        cells, at = self._cells, self._at
        cells[at + PUSH_X] = (target_x + drift_x - cells[at + V_X]) * self._force
        cells[at + PUSH_Y] = (target_y + drift_y - cells[at + V_Y]) * self._force
        self._target, self._drift = (target_x, target_y), (drift_x, drift_y)
        height = flight.held[2]
        stands = not flight.flying and height <= TOUCHDOWN and drift_x == 0.0 and drift_y == 0.0
        if stands != self._stands and self.foot is not None:
            self.foot.max_force = self.grip if stands else 0.0
            self._stands = stands
        return height

    def take_flight(self, flight: Quadrotor, step: float) -> None:
        """Give the model the state of the body."""
        cells, at = self._cells, self._at
        v_x, v_y = cells[at + V_X], cells[at + V_Y]
        x, y = cells[at + X] + step * v_x, cells[at + Y] + step * v_y
        target_x = self._target[0] + _felt(v_x - (self._target[0] + self._drift[0]), self._drift[0])
        target_y = self._target[1] + _felt(v_y - (self._target[1] + self._drift[1]), self._drift[1])
        _, _, z = flight.held
        flight.velocity = (target_x, target_y, flight.velocity[2])
        flight.held = (x - flight.wobble[0], y - flight.wobble[1], z)
        flight.position = (x, y, z)
        self._wobble = flight.wobble

    def show(self, motion: Mirrored, step: float) -> None:
        """Place the body of a mirrored robot, far away while it is absent."""
        cells, at = self._cells, self._at
        x, y, _ = motion.position
        v_x, v_y, _ = motion.velocity if is_finite(motion.velocity) else (0.0, 0.0, 0.0)
        if not (math.isfinite(x) and math.isfinite(y)):
            x, y = AWAY, AWAY
            v_x, v_y = 0.0, 0.0
        cells[at + X], cells[at + Y] = x - step * v_x, y - step * v_y
        cells[at + YAW] = motion.yaw if math.isfinite(motion.yaw) else 0.0
        cells[at + V_X], cells[at + V_Y] = v_x, v_y
        cells[at + TURN] = 0.0


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
