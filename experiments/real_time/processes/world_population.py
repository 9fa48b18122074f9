"""Robots, mirrors of robots and obstacles of a world, as the rows of one twin body; without a network.

A change of the rows makes the body anew and restores the poses.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import msgspec
import numpy as np

from agents.arrays import Array, Index, Mask
from agents.body.interface import BodyState
from agents.body.kinds import KINDS, Kind
from agents.plugins import registry
from experiments.definition import bodies
from experiments.definition.experiment import Experiment, Robot
from experiments.file import structure
from twins import scene
from twins.body import TwinBody
from twins.scene import Obstacle, Scene

WALL: Final = "wall"  # name of the walls of the arena in contacts
TAKEN: Final = (WALL, "world", "all", "run", "estop", *KINDS)  # words of keys and of the experiment file
NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
ROUNDING: Final = 1e-9  # [m]
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

    names: tuple[str, ...]  # of the n rows, those of the experiment first
    carried: Mask  # (n,) rows that are simulated here; the others are mirrors
    seen: Mask  # (n,) rows with simulated range sensors: carried ones, and those that ask for them
    hold_s: Array  # (n,) [s] a row is held after so long without a command; infinity: it drives on
    body: TwinBody  # of these rows
    time: float  # [s] simulated since the start
    state: BodyState  # last reading of the body

    def __init__(self, experiment: Experiment) -> None:
        """All robots at their starts.

        Raises:
            BodyError, plugins.PluginError: If the engine cannot be had.
        """
        self._experiment = experiment
        self._obstacles = dict(experiment.arena.obstacles)  # as in the experiment
        everyone = tuple(experiment.robots)
        position, yaw = bodies.scattered_poses(experiment, everyone, experiment.seed)
        self._home = {name: (position[row], float(yaw[row])) for row, name in enumerate(everyone)}
        self._under_way: dict[str, float | None] = {}  # height of those that climb [m]; None of those that land
        self._dt = 1.0 / experiment.rates.body_hz
        self._begun = math.nan
        self.time = 0.0
        self._make(everyone)

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
            self._under_way[self.names[row]] = height
            self.body.takeoff(np.array([row]), np.array([height]))

    def land(self, rows: Index) -> None:
        """Lands rows."""
        self._under_way.update({self.names[row]: None for row in rows.tolist() if self.flies[row]})
        self.body.land(rows)

    def stop(self, rows: Index) -> None:
        """Cuts the motors of rows."""
        for row in rows.tolist():
            self._under_way.pop(self.names[row], None)
        self.body.stop(rows)

    def drive(self, setpoint: Array, rows: Index) -> None:
        """Commands setpoints (n, 4), NaN but for `rows`."""
        if self._under_way:
            for row in rows.tolist():
                if self._under_way.get(self.names[row]) is not None:  # a setpoint does not end a landing
                    del self._under_way[self.names[row]]
        self.body.command(setpoint)

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
        self._under_way.pop(name, None)
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

    # ------------------------------------------------------------------ adding and removing

    def reset(self, name: str | None) -> None:
        """Puts a robot back to its start, or all robots and pushed obstacles; a flying robot keeps its height.

        Raises:
            Refused: If there is no such robot, or something else stands at its start.
        """
        if name is not None:
            rows = [self._row(name)]
            if not self.carried[rows[0]]:
                raise Refused(f"{name} is only mirrored here: it is where its own process says")
            place, _ = self._home[name]
            self._require_room(name, place[:2], self._experiment.robots[name].kind)
        else:
            rows = np.flatnonzero(self.carried).tolist()
            self._change(obstacles={key: self._obstacles[key] for key in self._scene.names})
        for row in rows:
            place, yaw = self._home[self.names[row]]
            height = float(self.body.engine.position[row, 2])
            flying = bool(self.body.engine.flying[row])
            self.put(self.names[row], (*place[:2], height if flying else 0.0), yaw, flying=flying)

    def remove(self, name: str) -> None:
        """Removes a robot or an obstacle.

        Raises:
            Refused: If there is none of that name, or it is the last robot.
        """
        if name in self._scene.names:
            self._change(obstacles={key: value for key, value in self._standing().items() if key != name})
            return
        self._row(name)
        if len(self.names) == 1:
            raise Refused(f"{name} is the last robot of this world: end the world instead")
        self._under_way.pop(name, None)
        self._change(names=[other for other in self.names if other != name])

    def spawn_robot(self, name: str, kind: str | None, at: tuple[float, float] | None, yaw: float) -> None:
        """Adds a robot: one of the file that is absent, by default at its start, or a new one.

        Raises:
            Refused: If it is there already, its kind is not known, or there is no room.
        """
        if name in self.names:
            raise Refused(f"{name} is in this world already; remove it first, or reset it")
        known = self._experiment.robots.get(name)
        if known is None:
            self._require_name(name)
            if kind is None or at is None:
                raise Refused(f"{name} is not in the experiment: a new robot needs its kind and a place (kind, at)")
        elif kind not in (None, known.kind):
            raise Refused(f"{name} is a {known.kind} in the experiment; leave the kind out, or choose another name")
        kind = known.kind if known is not None else kind
        if kind not in KINDS:
            raise Refused(f"there is no kind of robot '{kind}'; {registry.did_you_mean(kind or '', KINDS)}")
        if at is not None:
            _require_numbers(*at, yaw)
            home = np.array([*at, 0.0]), yaw
        else:
            home = self._home[name]
        self._require_room(name, home[0][:2], kind)
        if known is None:
            x, y = float(home[0][0]), float(home[0][1])
            robots = {**self._experiment.robots, name: Robot(kind=kind, start=[x, y, yaw], body=bodies.WORLD)}
            self._experiment = msgspec.structs.replace(self._experiment, robots=robots)
        self._home[name] = home
        self._change(names=[*self.names, name])

    def spawn_obstacle(self, name: str, given: Mapping[str, object]) -> None:
        """Adds an obstacle, given as in the experiment file.

        Raises:
            Refused: If the name is taken, it is no obstacle, a robot stands there, or it reaches out of the arena.
        """
        if name in self._scene.names or name in self.names:
            raise Refused(f"there is something called {name} already; choose another name, or remove it first")
        self._require_name(name)
        for fault in structure.faults(given, Obstacle, ("arena", "obstacles", name)):
            raise Refused(f"{name} is no obstacle: {fault.message}" + (f"; {fault.hint}" if fault.hint else ""))
        obstacle = msgspec.convert(dict(given), Obstacle)
        plan = {} if obstacle.plan is None else {name: registry.build(registry.PLANNERS, obstacle.plan)}
        alone = Scene.furnished(self._experiment.arena.size, {name: obstacle}, plan, walled=False)
        numbers = [alone.pose, alone.radius, alone.bottom, alone.top, *(o for o in alone.outline if o is not None)]
        if not all(np.isfinite(value).all() for value in numbers):
            raise Refused(f"{name} is no obstacle: a number is not finite")
        low, high = scene.reach(alone, 0)
        if (low < alone.low[:2] - ROUNDING).any() or (high > alone.high[:2] + ROUNDING).any():
            x, y = 2.0 * alone.high[:2]
            raise Refused(f"{name} would reach out of the arena, which is {x:g} by {y:g} m around the origin")
        position = self.body.engine.position
        for row, kind in enumerate(self._kinds):
            z = position[row, 2]
            level = alone.bottom[0] < z + kind.height and z < alone.top[0]
            if level and scene.distance(alone, 0, alone.pose[0], position[row, :2]) < kind.radius:
                raise Refused(f"{name} would overlap {self.names[row]}; put it elsewhere, or remove that first")
        self._obstacles[name] = obstacle
        self._change(obstacles={**self._standing(), name: obstacle})

    # ------------------------------------------------------------------ the rows

    def _make(self, names: Sequence[str]) -> None:
        experiment = self._experiment
        self.names = tuple(names)
        robots = [experiment.robots[name] for name in self.names]
        self._kinds = bodies.kinds(experiment, self.names)
        self.flies = np.array([kind.flies for kind in self._kinds])
        wheels = [robot.device.get("watchdog_s") or experiment.world.wheels_stop_s or math.inf for robot in robots]
        self.hold_s = np.where(self.flies, HOLD_S, wheels)
        self.takes_position = np.array([kind.takes == "position" for kind in self._kinds])
        self.carried = np.array([robot.body == bodies.WORLD for robot in robots])
        self.seen = self.carried | np.array([robot.ranges == "world" for robot in robots])
        home = [self._home[name] for name in self.names]
        request = replace(
            bodies.body_request(experiment, self.names, [experiment.seed]),
            start=np.array([position for position, _ in home]),
            yaw=np.array([yaw for _, yaw in home]),
            external=(False,) * len(self.names),  # published positions are those measured from outside
        )
        world = bodies.shared_world(experiment, self.names, sensing=True)
        sensors = tuple(own if seen else () for own, seen in zip(world.sensors, self.seen.tolist(), strict=True))
        self._scene = world.scene
        self.body = TwinBody(request, replace(world, mirrored=~self.carried, sensors=sensors))
        self._ticks, self._made_at = 0, self.time
        self.body.begun_at = self._begun - self._made_at
        self.state = self.body.read(0.0)

    def _change(self, *, names: Sequence[str] | None = None, obstacles: Mapping[str, Obstacle] | None = None) -> None:
        """Changes the rows, or the obstacles; all others keep their poses and go on."""
        before, old = self.body.engine, {name: row for row, name in enumerate(self.names)}
        standing = self._standing() if obstacles is None else dict(obstacles)
        arena = msgspec.structs.replace(self._experiment.arena, obstacles=standing)
        self._experiment = msgspec.structs.replace(self._experiment, arena=arena)
        self._make(self.names if names is None else names)
        kept = [row for row, name in enumerate(self.names) if name in old and self.carried[row]]
        if kept:
            rows, was = np.array(kept), np.array([old[self.names[row]] for row in kept])
            self.body.place(rows, before.position[was], before.yaw[was], before.flying[was], before.velocity[was])
        for name, height in list(self._under_way.items()):
            row = self._row(name)
            if not self.body.engine.flying[row]:
                del self._under_way[name]
            elif height is not None:
                self.body.takeoff(np.array([row]), np.array([height]))
            else:
                self.body.land(np.array([row]))
        self.state = self.body.read(0.0)

    def _standing(self) -> dict[str, Obstacle]:
        """The obstacles, pushed ones at their present poses."""
        found = dict(self._experiment.arena.obstacles)
        for name, (x, y, yaw) in self.obstacles().items():
            if found[name].mass is not None:
                found[name] = msgspec.structs.replace(found[name], at=(x, y), yaw=yaw)
        return found

    def _row(self, name: str) -> int:
        if name not in self.names:
            hint = registry.did_you_mean(name, [*self.names, *self._scene.names])
            raise Refused(f"there is no '{name}' in this world; {hint}")
        return self.names.index(name)

    def _require_name(self, name: str) -> None:
        if name in TAKEN or not NAME.fullmatch(name):
            raise Refused(
                f"'{name}' cannot be a name: letters, digits and _, a letter first, and none of the keys' words"
            )

    def _require_room(self, name: str, place: Array, kind: str) -> None:
        """Raises Refused if a robot on the floor there would overlap something or stick out of the arena."""
        own: Kind = KINDS[kind]
        half = self._scene.high[:2]
        if (np.abs(place) > half - own.radius + ROUNDING).any():
            x, y = 2.0 * half
            raise Refused(f"{name} would stand outside the arena, which is {x:g} by {y:g} m around the origin")
        position = self.body.engine.position
        for row, kind_of in enumerate(self._kinds):
            if self.names[row] != name and position[row, 2] < own.height:
                gap = math.hypot(*(position[row, :2] - place)) - own.radius - kind_of.radius
                if gap < 0.0:
                    raise Refused(
                        f"{name} would overlap {self.names[row]} by {-1e3 * gap:.0f} mm; choose another place"
                    )
        for k, obstacle in enumerate(self._scene.names):
            gap = float(scene.distance(self._scene, k, self.body.engine.obstacles[0, k], place)) - own.radius
            if self._scene.bottom[k] < own.height and gap < 0.0:
                raise Refused(f"{name} would overlap {obstacle} by {-1e3 * gap:.0f} mm; choose another place")


def _require_numbers(*values: float) -> None:
    if not all(math.isfinite(value) for value in values):
        raise Refused("a place needs finite numbers [m, rad]")
