"""Robots, mirrors of robots and obstacles of a world, in one body of twins; without a network."""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from agents.body.interface import BodyState
from agents.errors import Refusal, did_you_mean
from agents.network import messages
from agents.vectors import NO_SETPOINT, Setpoint
from experiments.definition import bodies
from experiments.definition.experiment import WALL, WORLD
from experiments.definition.plan import Plan
from twins import scene
from twins.body import TwinBody

HOLD_S: Final = 0.5  # time without a command after which a flying robot holds its position


class WorldBodies:
    """The robots of a world by their rows, and all that may happen to them."""

    names: tuple[str, ...]  # names of the n rows: the robots of the experiment
    carried: tuple[bool, ...]  # rows that are simulated here; the others are mirrors
    seen: tuple[bool, ...]  # rows with simulated range sensors: carried ones, and those that ask for them
    hold_s: tuple[float, ...]  # [s] time without a command after which a row is held; infinity: it drives on
    body: TwinBody  # body of these rows
    time: float  # [s] simulated since the start
    states: Sequence[BodyState]  # last reading of the body

    def __init__(self, plan: Plan) -> None:
        """All robots at their starts."""
        self._plan = plan
        self.names, experiment = plan.names, plan.experiment
        robots = list(experiment.robots.values())
        self._kinds = plan.kinds
        self.flies = tuple(kind.flies for kind in self._kinds)
        wheels = [robot.device.get("watchdog_s") or experiment.world.wheel_watchdog_s or math.inf for robot in robots]
        self.hold_s = tuple(HOLD_S if flies else wait for flies, wait in zip(self.flies, wheels, strict=True))
        self.carried = tuple(robot.body == WORLD for robot in robots)
        self.seen = tuple(robot.ranges == "world" or robot.body == WORLD for robot in robots)
        position, yaw = bodies.scattered_poses(plan, self.names, experiment.seed)
        self._home = list(zip(position, yaw, strict=True))
        self._dt = 1.0 / experiment.rates.body_hz
        self._begun = math.nan
        self.time = 0.0
        self._create_body()

    def advance(self) -> None:
        self._ticks += 1
        self.time += self._dt
        self.states = self.body.read(self._ticks * self._dt)

    def begin(self, at: float) -> None:
        """Sets the common start to `at` [s] of `time`: obstacles with a plan begin to move then."""
        self._begun = at
        self.body.begun_at = at - self._made_at

    def takeoff(self, row: int, height: float) -> None:
        """Lets a row climb; ground robots ignore it."""
        self.body.takeoff([row], [height])

    def holding(self, rows: Container[int]) -> list[Setpoint]:
        """Setpoints that hold `rows` in place; NaN for the others."""
        setpoints = [NO_SETPOINT] * len(self.names)
        for row, (kind, motion) in enumerate(zip(self._kinds, self.body.engine.motions, strict=True)):
            if row in rows:
                stays = kind.takes == "position"
                setpoints[row] = (*motion.position, motion.yaw) if stays else (0.0, 0.0, 0.0, 0.0)
        return setpoints

    def put(self, name: str, position: Sequence[float], yaw: float, *, flying: bool) -> None:
        """Places a robot at rest: (3) [m], [rad]; a flying one holds that position."""
        row = self._row(name)
        x, y, z = position
        flies = self.flies[row]
        self.body.place([row], [(x, y, z if flies else 0.0)], [yaw], [flying and flies])
        self.states = self.body.read(self._ticks * self._dt)

    def meetings(self, stamp: float) -> list[messages.Contact]:
        """Contacts that have begun since the last call, with a stamp."""
        obstacles = (*self._scene.names, WALL)
        found = []
        for touch in self.body.touches():
            second = self.names[touch.second] if touch.second >= 0 else obstacles[-1 - touch.second]
            found.append(messages.Contact(stamp, self.names[touch.first], second, touch.impulse, touch.overlap))
        return found

    def obstacles(self) -> dict[str, tuple[float, float, float]]:
        """Pose of each obstacle: x, y [m], yaw [rad]."""
        poses = zip(self._scene.names, self.body.engine.obstacles, strict=True)
        return {name: (round(x, 6), round(y, 6), round(yaw, 6)) for name, (x, y, yaw) in poses}

    def reset(self, name: str | None) -> None:
        """Puts a robot back to its start, or all robots and pushed obstacles; a flying robot keeps its height."""
        before = self.body.engine.motions
        if name is None:
            rows = [row for row, carried in enumerate(self.carried) if carried]
            self._create_body()
        else:
            rows = [self._row(name)]
            if not self.carried[rows[0]]:
                raise Refusal(f"{name} is only mirrored here: it is where its own process says")
            self._require_room(rows[0])
        for row in rows:
            flying = before[row].flying
            (x, y, _), yaw = self._home[row]
            self.put(self.names[row], (x, y, before[row].position[2] if flying else 0.0), yaw, flying=flying)

    def _create_body(self) -> None:
        """Makes the body, with robots and obstacles where the file has them."""
        plan = self._plan
        asked = bodies.body_request(plan, self.names, plan.experiment.seed)
        # published positions are those measured from outside
        request = replace(asked, external=(False,) * len(self.names))
        world = bodies.shared_world(plan, self.names, sensing=True)
        sensors = tuple(own if seen else () for own, seen in zip(world.sensors, self.seen, strict=True))
        mirrored = tuple(not carried for carried in self.carried)
        self._scene = world.scene
        self.body = TwinBody(request, replace(world, mirrored=mirrored, sensors=sensors))
        self._ticks, self._made_at = 0, self.time
        self.body.begun_at = self._begun - self._made_at
        self.states = self.body.read(0.0)

    def _row(self, name: str) -> int:
        if name not in self.names:
            raise Refusal(f"there is no '{name}' in this world; {did_you_mean(name, self.names)}")
        return self.names.index(name)

    def _require_room(self, row: int) -> None:
        """Raises Refusal if a robot on the floor would overlap something at its start."""
        name, own = self.names[row], self._kinds[row]
        x, y, _ = self._home[row][0]
        for other, (kind, motion) in enumerate(zip(self._kinds, self.body.engine.motions, strict=True)):
            if other != row and motion.position[2] < own.height:
                apart = math.hypot(motion.position[0] - x, motion.position[1] - y)
                gap = apart - own.radius - kind.radius
                if gap < 0.0:
                    raise Refusal(f"{name} would overlap {self.names[other]} by {-1e3 * gap:.0f} mm: move that first")
        poses = np.array(self.body.engine.obstacles).reshape(-1, 3)
        for k, obstacle in enumerate(self._scene.names):
            gap = float(scene.distance(self._scene, k, poses[k], np.array([x, y]))) - own.radius
            if self._scene.bottom[k] < own.height and gap < 0.0:
                raise Refusal(f"{name} would overlap {obstacle} by {-1e3 * gap:.0f} mm: reset all")
