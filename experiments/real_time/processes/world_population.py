"""Robots, mirrors of robots and obstacles of a world, as the rows of one twin body; without a network."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from agents.arrays import Array, Index, Mask
from agents.body.interface import BodyState
from agents.plugins import registry
from experiments.definition import bodies
from experiments.definition.experiment import Experiment
from twins import scene
from twins.body import TwinBody

WALL: Final = "wall"  # name of the walls of the arena in contacts
HOLD_S: Final = 0.5  # without a command for this long a flying robot holds its position


class Refused(ValueError):
    """An order that a world cannot carry out, with reason and remedy."""


@dataclass(frozen=True)
class Meeting:
    """Begin of a contact, by names."""

    first: str
    second: str
    impulse: float  # [N s]
    overlap: float  # [m]


class Population:
    """The rows of a world, and all that may happen to them."""

    names: tuple[str, ...]  # of the n rows: the robots of the experiment
    carried: Mask  # (n,) rows that are simulated here; the others are mirrors
    seen: Mask  # (n,) rows with simulated range sensors: carried ones, and those that ask for them
    hold_s: Array  # (n,) [s] a row is held after so long without a command; infinity: it drives on
    body: TwinBody  # of these rows
    time: float  # [s] simulated since the start
    state: BodyState  # last reading of the body

    def __init__(self, experiment: Experiment) -> None:
        """All robots at their starts."""
        self._experiment = experiment
        self.names = tuple(experiment.robots)
        robots = list(experiment.robots.values())
        self._kinds = bodies.kinds(experiment, self.names)
        self.flies = np.array([kind.flies for kind in self._kinds])
        wheels = [robot.device.get("watchdog_s") or experiment.world.wheels_stop_s or math.inf for robot in robots]
        self.hold_s = np.where(self.flies, HOLD_S, wheels)
        self.takes_position = np.array([kind.takes == "position" for kind in self._kinds])
        self.carried = np.array([robot.body == bodies.WORLD for robot in robots])
        self.seen = self.carried | np.array([robot.ranges == "world" for robot in robots])
        self._home = bodies.scattered_poses(experiment, self.names, experiment.seed)
        self._dt = 1.0 / experiment.rates.body_hz
        self._begun = math.nan
        self.time = 0.0
        self._create_body()

    # ------------------------------------------------------------------ motion

    def advance(self) -> BodyState:
        """Simulates one tick."""
        self._ticks += 1
        self.time += self._dt
        self.state = self.body.read(self._ticks * self._dt)
        return self.state

    def begin(self, at: float) -> None:
        """Sets the common start to `at` [s] of `time`: obstacles with a plan begin to move then."""
        self._begun = at
        self.body.begun_at = at - self._made_at

    def takeoff(self, row: int, height: float) -> None:
        """Lets a row climb; ground robots ignore it."""
        if self.flies[row]:
            self.body.takeoff(np.array([row]), np.array([height]))

    def holding(self, rows: Index) -> Array:
        """Setpoints (n, 4) that hold `rows` in place; NaN for the others."""
        setpoint = np.full((len(self.names), 4), np.nan)
        setpoint[rows] = 0.0
        stay = rows[self.takes_position[rows]]
        setpoint[stay, :3], setpoint[stay, 3] = self.body.engine.position[stay], self.body.engine.yaw[stay]
        return setpoint

    def put(self, name: str, position: Sequence[float], yaw: float, *, flying: bool) -> None:
        """Places a robot at rest: (3) [m], [rad]; a flying one holds that position."""
        row = self._row(name)
        place = np.array([position], dtype=float)
        if not self.flies[row]:
            place[0, 2] = 0.0
        self.body.place(np.array([row]), place, np.array([yaw]), np.array([flying and bool(self.flies[row])]))
        self.state = self.body.read(self._ticks * self._dt)

    def meetings(self) -> list[Meeting]:
        """Contacts that have begun since the last call."""
        obstacles = (*self._scene.names, WALL)
        found = []
        for touch in self.body.touches():
            second = self.names[touch.second] if touch.second >= 0 else obstacles[-1 - touch.second]
            found.append(Meeting(self.names[touch.first], second, float(touch.impulse), float(touch.overlap)))
        return found

    def obstacles(self) -> dict[str, tuple[float, float, float]]:
        """Pose of each obstacle: x, y [m], yaw [rad]."""
        pose = self.body.engine.obstacles[0].round(6).tolist()
        return {name: (x, y, yaw) for name, (x, y, yaw) in zip(self._scene.names, pose, strict=True)}

    # ------------------------------------------------------------------ back to the start

    def reset(self, name: str | None) -> None:
        """Puts a robot back to its start, or all robots and pushed obstacles; a flying robot keeps its height."""
        before = self.body.engine
        if name is None:
            rows = np.flatnonzero(self.carried).tolist()
            self._create_body()
        else:
            rows = [self._row(name)]
            if not self.carried[rows[0]]:
                raise Refused(f"{name} is only mirrored here: it is where its own process says")
            self._require_room(rows[0])
        for row in rows:
            flying = bool(before.flying[row])
            height = float(before.position[row, 2]) if flying else 0.0
            place = (*self._home[0][row, :2].tolist(), height)
            self.put(self.names[row], place, float(self._home[1][row]), flying=flying)

    def _create_body(self) -> None:
        """Makes the body, with robots and obstacles where the file has them."""
        experiment = self._experiment
        position, yaw = self._home
        request = replace(
            bodies.body_request(experiment, self.names, [experiment.seed]),
            start=position,
            yaw=yaw,
            external=(False,) * len(self.names),  # published positions are those measured from outside
        )
        world = bodies.shared_world(experiment, self.names, sensing=True)
        sensors = tuple(own if seen else () for own, seen in zip(world.sensors, self.seen.tolist(), strict=True))
        self._scene = world.scene
        self.body = TwinBody(request, replace(world, mirrored=~self.carried, sensors=sensors))
        self._ticks, self._made_at = 0, self.time
        self.body.begun_at = self._begun - self._made_at
        self.state = self.body.read(0.0)

    def _row(self, name: str) -> int:
        if name not in self.names:
            raise Refused(f"there is no '{name}' in this world; {registry.did_you_mean(name, self.names)}")
        return self.names.index(name)

    def _require_room(self, row: int) -> None:
        """Raises Refused if a robot on the floor would overlap something at its start."""
        name, own, place = self.names[row], self._kinds[row], self._home[0][row, :2]
        position = self.body.engine.position
        for other, kind in enumerate(self._kinds):
            if other != row and position[other, 2] < own.height:
                gap = math.hypot(*(position[other, :2] - place)) - own.radius - kind.radius
                if gap < 0.0:
                    raise Refused(f"{name} would overlap {self.names[other]} by {-1e3 * gap:.0f} mm: move that first")
        for k, obstacle in enumerate(self._scene.names):
            gap = float(scene.distance(self._scene, k, self.body.engine.obstacles[0, k], place)) - own.radius
            if self._scene.bottom[k] < own.height and gap < 0.0:
                raise Refused(f"{name} would overlap {obstacle} by {-1e3 * gap:.0f} mm: reset all")
