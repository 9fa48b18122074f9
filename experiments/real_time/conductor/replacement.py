"""Replacement of a robot under its name: by a spare of the experiment file, or by another body."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import msgspec

from agents.body.kinds import KINDS
from agents.errors import Refusal
from agents.network import messages
from agents.plugins import registry
from agents.plugins.registry import did_you_mean
from experiments.definition.experiment import WORLD, RobotTable
from experiments.definition.plan import Plan
from experiments.real_time.conductor.run_view import RobotView

TWIN: Final = "twin"  # a body that is there as long as its process
OF_BODY: Final = ("body", "start", "hover", "position", "device", "sensors", "ranges")  # fields of a spare


class Spares:
    """Spares of an experiment."""

    used: dict[str, str]  # names that they have taken over, by spare

    def __init__(self, plan: Plan) -> None:
        self._spares, self._arena = plan.experiment.spares, plan.experiment.arena
        self.used = {}

    def successor(self, name: str, robot: RobotTable, order: messages.RunOrder) -> tuple[RobotTable, str | None]:
        """The robot with the name `name` from now on, and the name of the spare, if it is one."""
        spare = order.spare
        if spare is None and order.body is None:
            spare = self._first_spare(name, robot.kind)
        if spare is not None and order.body is not None:
            raise Refusal("a spare has a body of its own: leave --body or --with out")
        made = self._of_spare(spare, name, robot) if spare is not None else self._of_body(order.body or "", robot)
        if WORLD in (robot.body, made.body) and robot.body != made.body:
            raise Refusal("a robot cannot go into the world, or out of it, in mid-run")
        if order.at is not None:
            made = self._put(made, order.at, order.yaw)
        return made, spare

    def _first_spare(self, name: str, kind: str) -> str:
        for spare, robot in self._spares.items():
            if robot.kind == kind and spare not in self.used:
                return spare
        raise Refusal(
            f"the file has no spare {kind} left for {name}: say which body takes over, --body URI, or add [spares.NAME]"
        )

    def _of_spare(self, spare: str, name: str, robot: RobotTable) -> RobotTable:
        spares = self._spares
        if spare not in spares:
            there = did_you_mean(spare[:50], spares) if spares else "the file has none"
            raise Refusal(f"no spare '{spare[:50]}'; {there}")
        if spare in self.used:
            raise Refusal(f"{spare} has taken over {self.used[spare]} already")
        if spares[spare].kind != robot.kind:
            raise Refusal(f"{spare} is a {spares[spare].kind} and cannot be {name}, a {robot.kind}")
        brought = {field: getattr(spares[spare], field) for field in OF_BODY}
        return msgspec.structs.replace(robot, **brought, process=None, shadow=None)

    @staticmethod
    def _of_body(body: str, robot: RobotTable) -> RobotTable:
        word, known = registry.body_name(body), registry.names(registry.BODIES)
        if word in registry.names(registry.DEVICES):
            raise Refusal(f"{word} needs a simulated device, which is started before the run only")
        if word not in known:
            raise Refusal(f"no {word[:50]!r} among the bodies; {did_you_mean(word[:50], known)}")
        device = robot.device if word == registry.body_name(robot.body) else {}
        return msgspec.structs.replace(robot, body=body, device=device, process=None, shadow=None)

    def _put(self, robot: RobotTable, at: tuple[float, float], yaw: float) -> RobotTable:
        if robot.body != TWIN:
            raise Refusal("only a twin can be put somewhere: put the robot there yourself, and leave --at out")
        half = [size / 2 for size in self._arena.size[:2]]
        if not math.isfinite(yaw) or not all(abs(x) <= limit for x, limit in zip(at, half, strict=True)):
            raise Refusal(f"--at lies outside of the arena, ±{half[0]:g} by ±{half[1]:g} m")
        return msgspec.structs.replace(robot, start=[*at, yaw])


MARGIN_M: Final = 0.1  # free space around a robot that begins to move


def in_the_way(
    name: str,
    place: Sequence[float],
    robots: Mapping[str, RobotTable],
    views: Mapping[str, RobotView],
    *,
    body_stays: bool,
) -> str:
    """Refusal of `place`, x, y [m], for the robot `name` to begin there, whatever its height; empty if it is free.

    `body_stays`: the body that had this name lies in the way as any other.
    """
    radius = KINDS[robots[name].kind].radius
    for other, known in views.items():
        vanished = robots[other].body == TWIN and not known.alive  # it was a part of its process
        if known.place is None or vanished or (other == name and (known.alive or not body_stays)):
            continue
        gap = math.dist(known.place[:2], place[:2]) - radius - KINDS[robots[other].kind].radius
        if gap < MARGIN_M:
            x, y = place[:2]
            return (
                f"{name} would begin at ({x:.2f}, {y:.2f}) m, {max(gap, 0.0):.2f} m from {other}: it needs "
                f"{MARGIN_M:g} m around it; move one of them, or wait"
            )
    return ""
