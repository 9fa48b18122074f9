"""Consistency of an arena: obstacles and start boxes, and robots that start among them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from agents.body.kinds import KINDS
from experiments.definition.experiment import WALL, Arena, RobotTable, StartBox
from experiments.file.problems import Fault
from twins import scene as outlines
from twins.scene import Scene

_ROUNDING: Final = 1e-9  # [m]


def arena_faults(arena: Arena, robots: Mapping[str, RobotTable]) -> Iterator[Fault]:
    """Faults of an arena, by itself and with the robots that start in it; paths begin at the top of a document."""
    yield from _box_faults(arena, robots)
    scene = Scene.furnished(arena.size, arena.obstacles, {}, walled=arena.walls)
    kinds = {kind.name: kind for kind in KINDS.usable()} if robots else {}
    x, y, z = arena.size
    for number, (name, obstacle) in enumerate(arena.obstacles.items()):
        path = ("arena", "obstacles", name)
        if name == WALL:
            message = f"an obstacle cannot be called '{WALL}', which means the border of the arena"
            yield Fault(path, message, "rename it", on_key=True)
        if name in robots:
            yield Fault(path, f"'{name}' is the name of a robot already", "rename one of them", on_key=True)
        if outlines.outside(scene, number):
            message = f"'{name}' stands outside of the arena, of which the middle is 0, 0"
            hint = f"x lies between {-x / 2:g} and {x / 2:g}, y between {-y / 2:g} and {y / 2:g}; or enlarge size"
            yield Fault((*path, "at"), message, hint)
        if obstacle.bottom >= z:
            message = f"'{name}' begins at {obstacle.bottom:g} m: the arena is {z:g} m high"
            yield Fault((*path, "bottom"), message, f"give it a bottom below {z:g}, or enlarge size")
        for robot, each in robots.items():
            kind = kinds.get(each.kind)
            if kind is None or not outlines.at_height(scene, number, 0.0, kind.height):
                continue  # a flying robot stands on the floor before
            away = float(outlines.distance(scene, number, scene.pose[number], np.array(each.start[:2])))
            if kind.radius - away > _ROUNDING:
                message = f"'{robot}' starts in the obstacle '{name}'"
                missing = f"{kind.radius - away + 0.01:.2f} m or more"
                hint = f"move one of them by {missing}: all start on the floor, flying ones too"
                yield Fault(("robots", robot, "start"), message, hint)


def _box_faults(arena: Arena, robots: Mapping[str, RobotTable]) -> Iterator[Fault]:
    """Start boxes beyond the arena, and robots outside of all of them."""
    for name, box in arena.starts.items():
        for axis in (0, 1):
            beyond = abs(box.at[axis]) + box.size[axis] / 2 - arena.size[axis] / 2
            if beyond > _ROUNDING:
                message = f"the start box '{name}' reaches {beyond:.2g} m beyond the arena along {'xy'[axis]}"
                yield Fault(("arena", "starts", name, "at"), message, "move it, make it smaller, or enlarge size")
    for robot, each in robots.items() if arena.starts else ():
        if not any(_holds(box, each.start) for box in arena.starts.values()):
            where = ", ".join(f"'{name}' around ({box.at[0]:g}, {box.at[1]:g})" for name, box in arena.starts.items())
            message = f"'{robot}' starts outside of the boxes where robots may start"
            yield Fault(("robots", robot, "start"), message, f"start it in {where}; or change [arena.starts]")


def _holds(box: StartBox, start: list[float]) -> bool:
    return all(abs(start[axis] - box.at[axis]) - box.size[axis] / 2 <= _ROUNDING for axis in (0, 1))
