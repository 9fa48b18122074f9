"""Pymunk engine: planar rigid bodies in layers by height, with contacts between robots, obstacles and walls."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Final

import msgspec
import numpy as np
import pymunk
import pymunk.batch
from msgspec import Meta

from agents.arrays import Array, Index, Mask, Share, clamp, every, norm, some, span
from twins.engines.engine import Stage, Touch
from twins.engines.point_mass import Models
from twins.engines.pymunk_contacts import Contacts, Layers
from twins.engines.pymunk_space import Place, Surfaces
from twins.models.onboard_flight import TOUCHDOWN
from twins.models.quadrotor import GRAVITY

FIELDS: Final = (
    pymunk.batch.BodyFields.POSITION
    | pymunk.batch.BodyFields.ANGLE
    | pymunk.batch.BodyFields.VELOCITY
    | pymunk.batch.BodyFields.ANGULAR_VELOCITY
    | pymunk.batch.BodyFields.FORCE
)
PLACE, YAW, MOVE, TURN, PUSH = slice(0, 2), 2, slice(3, 5), 5, slice(6, 8)  # columns of a batch with these fields
WIDTH: Final = 8
POSE: Final = slice(0, 3)
RATE: Final = slice(3, 6)
AWAY: Final = 1e6  # [m] position of absent mirrored robots
UNFELT: Final = 1e-12  # [m/s] smaller changes of speed are rounding
LEAP: Final = 10.0  # [m/s] faster motion of a plan is a jump

Friction = Annotated[float, Meta(ge=0, le=10)]


class Planar(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
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

    contacts: ClassVar[bool] = True

    def build(self, stage: Stage) -> PlanarEngine:
        return PlanarEngine(stage, self)


class PlanarEngine(Models):
    """Implements `twins.engines.engine.Engine`.

    The motion models compute the velocity of each row after this tick; forces within the grip of the wheels, or the
    thrust of a tilted quadrotor, change the velocity to that, and pymunk's solver adds the contacts. Without contact a
    tick equals that of the point-mass engine. Pymunk moves bodies at the beginning of a step and computes velocities at
    its end; positions here are therefore one step ahead of pymunk's: those at the beginning of the next step.

    Each copy of the scene has its own space: otherwise the order in which contacts are solved, and so the last digits
    of a crowd, would depend on other copies.
    """

    attitude = None

    def __init__(self, stage: Stage, choice: Planar) -> None:
        """Raises BodyError for a kind without a twin."""
        super().__init__(stage)
        self._dt, self._steps = stage.dt, max(1, math.ceil(stage.dt / choice.step_s - 1e-9))
        self._step = stage.dt / self._steps
        self._ticks = 0
        self._fastest = GRAVITY * math.tan(choice.tilt) * stage.dt  # change of speed in a tick [m/s]
        self._found: list[Touch] = []
        rows = len(stage.kinds)
        self._layers = _build_layers(stage)
        self._tall = np.array([stage.kinds[row].height for row in self.in_air])
        mass = np.array([stage.kinds[row].mass for row in self.in_air])
        self._force = (mass / self._step)[:, None]  # changes the speed by 1 m/s in one step
        self._build_copies(stage, choice)
        self._wobble = np.zeros((rows, 2))
        self._scene = stage.scene
        self._pose = stage.scene.pose.copy()
        self.obstacles = np.tile(stage.scene.pose, (len(self._copies), 1, 1))
        self.place(np.arange(rows), self.position, self.yaw, self.flying)
        self.position[self._mirrored] = np.nan

    def _build_copies(self, stage: Stage, choice: Planar) -> None:
        """Build the copies, and record the index of each body in the state."""
        skin = 0.5 * choice.approach * self._step
        surfaces = Surfaces(choice.friction, choice.wall_friction, choice.traction, skin)
        self._copies: list[_Copy] = []
        bodies, wheels = np.zeros(len(stage.kinds), dtype=np.intp), np.zeros(len(stage.kinds), dtype=np.intp)
        movable: list[int] = []
        things: list[list[int]] = []
        feet: dict[int, tuple[pymunk.PivotJoint, float]] = {}
        begin = 0
        for number in range(int(stage.copy.max(initial=0)) + 1):
            place = Place(surfaces, -1 - len(stage.scene.names))
            for row in np.flatnonzero(stage.copy == number).tolist():
                place.add_robot(row, stage.kinds[row], mirrored=bool(stage.mirrored[row]))
            place.furnish(stage.scene)
            contacts = Contacts(
                place.numbers, self._layers, self._step, skin, choice.restitution, choice.slide, self._found
            )
            copy = _Copy(place.space, contacts, choice.iterations, begin)
            for row, body in place.rows.items():
                bodies[row] = copy.slot(body)
            for row, body in place.wheels.items():
                wheels[row] = copy.slot(body)
            movable = list(place.obstacles)  # the same in every copy
            things.append([copy.slot(body) for body in place.obstacles.values()])
            feet |= place.feet
            self._copies.append(copy)
            begin = copy.block.stop
        # one copy's state is pymunk's own memory: nothing needs to be copied
        alone = len(self._copies) == 1
        self._state = self._copies[0].state if alone else np.concatenate([copy.state for copy in self._copies])
        self._bodies = span(bodies)
        self._bodies_in_air = span(bodies[self.in_air])
        self._wheels = span(wheels[self.on_floor])
        self._movable = np.array(movable, dtype=np.intp)
        self._things = np.array(things, dtype=np.intp).reshape(len(self._copies), -1)
        planned = np.isin(self._movable, stage.scene.moving)
        self._planned, self._carried = self._movable[planned], self._things[:, planned]
        self._slots = bodies
        self._feet = [feet[row] for row in sorted(feet)]
        self._footed = np.searchsorted(self.in_air, sorted(feet))
        self._stands = np.ones(len(feet), dtype=bool)

    def advance(self, t: float, wobble: Array) -> None:
        state, step, dt = self._state, self._step, self._dt
        if len(self.on_floor):
            drive, wheels = self.differential, self._wheels
            drive.advance()
            state[wheels, MOVE] = drive.velocity[:, :2]
            state[wheels, TURN] = (drive.yaw - self.yaw[self.floor]) / dt
        if len(self.in_air):
            target, drift = self._push_flying(wobble)
        if len(self._mirrored):
            self._update_mirrors()
        if len(self._planned):
            self._move_planned(t)
        for copy in self._copies:
            copy.advance(state, self._ticks * dt, step, self._steps)
        self._ticks += 1
        bodies = self._bodies
        position, velocity = np.zeros_like(self.position), np.zeros_like(self.velocity)
        moves = state[bodies, MOVE]
        position[:, :2], velocity[:, :2] = state[bodies, PLACE] + step * moves, moves
        yaw = state[bodies, YAW] + step * state[bodies, TURN]
        if len(self.on_floor):
            floor = self.floor
            drive.position[:, :2], drive.yaw[:] = position[floor, :2], yaw[floor]
            position[floor, 2] = drive.position[:, 2]
        if len(self.in_air):
            air, flight = self.air, self.quadrotor
            blow = velocity[air, :2] - (target + drift)
            felt = np.abs(blow) > UNFELT
            if some(felt):
                # a contact first stops the hover jitter, which the robot does not know
                known = blow - clamp(blow, np.minimum(-drift, 0.0), np.maximum(-drift, 0.0))
                target += np.where(felt, known, 0.0)
            flight.velocity[:, :2] = target
            flight.position[:, :2] = position[air, :2] - wobble[air]
            position[air, 2], velocity[air], yaw[air] = flight.position[:, 2], flight.velocity, flight.yaw
            self.flying[air] = flight.flying
            self._wobble[air] = wobble[air]
        if len(self._mirrored):
            rows = self._mirrored
            position[rows], velocity[rows], yaw[rows] = self._mirrored_state
        self.position, self.velocity, self.yaw = position, velocity, yaw
        if len(self._movable):
            self.obstacles = self.obstacles.copy()
            self.obstacles[:, self._movable] = state[self._things, POSE] + step * state[self._things, RATE]

    def place(self, rows: Index, position: Array, yaw: Array, flying: Mask) -> None:
        super().place(rows, position, yaw, flying)
        slots = self._slots[rows]
        self._state[slots, PLACE], self._state[slots, YAW] = position[:, :2], yaw
        self._state[slots, RATE] = 0.0
        self._wobble[rows] = 0.0
        for copy in self._copies:
            copy.contacts.reset_rows(rows.tolist())

    def touches(self) -> list[Touch]:
        found = sorted(self._found, key=lambda touch: (touch.time, touch.first, touch.second))
        self._found.clear()
        return found

    def _push_flying(self, wobble: Array) -> tuple[Array, Array]:
        """Apply forces to flying rows; returns the velocities (n_air, 2) of controllers and jitter [m/s]."""
        flight, air = self.quadrotor, self.air
        before = flight.velocity[:, :2].copy()
        flight.advance()
        change = flight.velocity[:, :2] - before
        size = norm(change)
        if some(size > self._fastest):
            change *= (self._fastest / np.maximum(size, self._fastest))[:, None]
        aloft = every(flight.flying)
        if not aloft:
            change *= flight.flying[:, None]
        drift = (wobble[air] - self._wobble[air]) / self._dt
        target, height = before + change, flight.position[:, 2]
        # all in the first step of the tick: then the tick equals one of the point-mass engine, whose steps are ticks
        bodies = self._bodies_in_air
        self._state[bodies, PUSH] = (target + drift - self._state[bodies, MOVE]) * self._force
        self._layers.bottom[air], self._layers.top[air] = height, height + self._tall
        if not aloft or some(self._stands):
            self._set_floor_grip(~flight.flying & (height <= TOUCHDOWN) & (drift == 0.0).all(axis=1))
        return target, drift

    def _set_floor_grip(self, stands: Mask) -> None:
        """Switch the floor's friction on for flying rows (n_air,) that stand on the floor, and off for others."""
        stands = stands[self._footed]
        for k in np.flatnonzero(stands != self._stands).tolist():
            joint, force = self._feet[k]
            joint.max_force = force if stands[k] else 0.0
        self._stands = stands

    def _update_mirrors(self) -> None:
        """Set mirrored rows to their received poses; the solver sees their motion from there."""
        position, velocity, yaw = self._mirrored_state
        here = np.isfinite(position[:, :2]).all(axis=1)
        moves = np.where(here[:, None], np.nan_to_num(velocity[:, :2]), 0.0)
        slots, state = self._slots[self._mirrored], self._state
        state[slots, MOVE], state[slots, TURN] = moves, 0.0
        state[slots, PLACE] = np.where(here[:, None], position[:, :2], AWAY) - self._step * moves
        state[slots, YAW] = np.nan_to_num(yaw)
        aloft = np.isin(self._mirrored, self.in_air)
        rows, height = self._mirrored[aloft], position[aloft, 2]
        tall = self._tall[np.searchsorted(self.in_air, rows)]
        self._layers.bottom[rows], self._layers.top[rows] = height, height + tall

    def _move_planned(self, t: float) -> None:
        """Move obstacles by their plans, with the velocity that reaches the planned pose in this tick."""
        pose = self._scene.at(t)
        before, now = self._pose[self._planned], pose[self._planned]
        rate = now - before
        rate[:, 2] = np.remainder(rate[:, 2] + math.pi, 2.0 * math.pi) - math.pi
        rate /= self._dt
        jumps = norm(rate[:, :2]) > LEAP
        before[jumps], rate[jumps] = now[jumps], 0.0
        self._state[self._carried, POSE] = before - self._step * rate
        self._state[self._carried, RATE] = rate
        self._pose = pose


class _Copy:
    """Pymunk space of one copy; its bodies are the rows `block` of the engine's state."""

    def __init__(self, space: pymunk.Space, contacts: Contacts, iterations: int, begin: int) -> None:
        self._space, self.contacts = space, contacts
        space.iterations = iterations
        contacts.attach(space)
        identities = pymunk.batch.Buffer()
        pymunk.batch.get_space_bodies(space, pymunk.batch.BodyFields.BODY_ID, identities)
        order = np.frombuffer(identities.int_buf(), dtype=np.uintp).tolist()
        self._slots = {identity: begin + k for k, identity in enumerate(order)}
        self.block = slice(begin, begin + len(order))
        self._buffer = pymunk.batch.Buffer()
        pymunk.batch.get_space_bodies(space, FIELDS, self._buffer)
        # pymunk fills the same memory at every call, because no body is added or removed any more
        self.state: Array = np.frombuffer(self._buffer.float_buf()).reshape(-1, WIDTH)

    def slot(self, body: pymunk.Body) -> int:
        """Index of a body in the engine's state."""
        return self._slots[body.id]

    def advance(self, state: Array, begin: float, step: float, steps: int) -> None:
        """Advance the bodies from `state`, and write the result to `state`."""
        alone = state is self.state
        if not alone:
            self.state[:] = state[self.block]
        pymunk.batch.set_space_bodies(self._space, FIELDS, self._buffer)
        for k in range(steps):
            self.contacts.time = begin + k * step
            self._space.step(step)
        self._buffer.clear()
        pymunk.batch.get_space_bodies(self._space, FIELDS, self._buffer)
        if not alone:
            state[self.block] = self.state


def _build_layers(stage: Stage) -> Layers:
    scene, rows = stage.scene, len(stage.kinds)
    # negative numbers count from the end: obstacle 0 is last, and the arena's walls come before all obstacles
    bottom = np.concatenate([np.zeros(rows), [-np.inf], scene.bottom[::-1]])
    top = np.concatenate([[kind.height for kind in stage.kinds], [np.inf], scene.top[::-1]])
    return Layers(bottom, top)
