"""Checks of obstacles: collisions on the predicted paths, contacts, sensors, and worlds."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from experiments.check.analysis import Analysis
from experiments.check.findings import FORGIVEN, Finding, join_names
from experiments.definition.bodies import sensors_of
from experiments.definition.experiment import WORLD
from twins import scene as outlines
from twins.arrays import Array, Index, Mask
from twins.scene import Obstacle

TWINS: Final = ("twin", WORLD)  # bodies that are simulated without the wire of a real one
AVOID: Final = 'or let robots avoid it: [avoidance] with kind = "barrier"'


def describe_obstacle(obstacle: Obstacle) -> str:
    """Description of an obstacle in a few words."""
    if obstacle.box is not None:
        what = f"box {obstacle.box[0]:g} × {obstacle.box[1]:g} m"
    else:
        what = "wall" if obstacle.radius is None else f"cylinder of radius {obstacle.radius:g} m"
    above = f", {obstacle.bottom:g} m above the floor" if obstacle.bottom else ""
    return what + above + (f", {obstacle.mass:g} kg" if obstacle.mass else "") + (", moves" if obstacle.plan else "")


def obstacles(analysis: Analysis) -> Iterator[Finding]:
    """Check that no predicted path meets an obstacle; with avoidance, note that it will act."""
    scene, prediction = analysis.plan.scene, analysis.prediction
    if not scene.names:
        return
    radius = np.array([kind.radius for kind in analysis.plan.kinds])
    low, high = _heights(analysis, prediction.position[..., 2])
    poses = scene.along(prediction.time)
    robots = analysis.plan.experiment.robots.values()
    avoids = np.array([robot.avoids for robot in robots]) & (analysis.plan.experiment.avoidance is not None)
    met = []
    for number in range(len(scene.names)):
        gap = outlines.distance(scene, number, poses[:, None, number], prediction.position[..., :2]) - radius
        near = (gap < -FORGIVEN) & outlines.at_height(scene, number, low, high)
        for keeps in (True, False):
            rows = np.flatnonzero(near.any(axis=0) & (avoids == keeps))
            if len(rows):
                met.append(_met(analysis, number, rows, near[:, rows], keeps=keeps))
    yield from met
    if not met:
        yield Finding("note", "obstacles", "the expected paths keep clear of all obstacles")
    for number, (name, plan) in enumerate(zip(scene.names, scene.plans, strict=True)):
        beyond = np.maximum(poses[:, number, :2] - scene.high[:2], scene.low[:2] - poses[:, number, :2]).max(axis=1)
        if plan is not None and beyond.max() > FORGIVEN:
            when = prediction.time[(beyond > FORGIVEN).argmax()]
            message = f"the middle of '{name}' leaves the arena at {when:.1f} s"
            remedy = "shorten its plan, or start it elsewhere"
            yield Finding("warning", "obstacle-leaves", message, remedy, ("arena", "obstacles", name, "plan"))


def _met(analysis: Analysis, number: int, rows: Index, near: Mask, *, keeps: bool) -> Finding:
    """Finding that `rows` (K,) meet an obstacle at the times `near` (T, K); `keeps`: avoidance is on."""
    scene, prediction = analysis.plan.scene, analysis.prediction
    names = analysis.plan.names
    name, path = scene.names[number], ("arena", "obstacles", scene.names[number])
    which = int(near.argmax(axis=0).argmin())
    first, at = int(rows[which]), int(near[:, which].argmax())
    x, y = prediction.position[at, first, :2]
    subject = join_names([names[row] for row in rows])
    when = f"at {prediction.time[at]:.1f} s, around ({x:.2f}, {y:.2f})"
    when = f", {names[first]} first {when}" if len(rows) > 1 else f" {when}"
    if keeps:
        message = f"the path of {subject} crosses '{name}'{when}: avoidance will have to act"
        return Finding("note", "avoidance-acts", message, "", path)
    if np.isfinite(scene.mass[number]):
        return Finding("note", "pushes", f"{subject} would push '{name}'{when}", "", path)
    remedy = f"lead the formation around it, {AVOID}"
    return Finding("warning", "hits-obstacle", f"{subject} would run into '{name}'{when}", remedy, path)


def contacts(analysis: Analysis) -> Iterator[Finding]:
    """Check that the engine computes the contacts for which the arena is made."""
    experiment, scene = analysis.plan.experiment, analysis.plan.scene
    touching = analysis.plan.finds_contacts
    for name, obstacle in experiment.arena.obstacles.items():
        if obstacle.mass is not None and not touching:
            engine = analysis.plan.engine_name
            message = f"'{name}' has a mass, but in the engine '{engine}' nothing is pushed: it stands fast"
            remedy = 'choose another: engine = "pymunk" in [world], or leave mass out'
            yield Finding("warning", "not-pushed", message, remedy, ("arena", "obstacles", name, "mass"))
    if touching and scene.walled:
        start = analysis.start[:, :2]
        gap = np.minimum(start - scene.low[:2], scene.high[:2] - start).min(axis=1)
        for row in np.flatnonzero(gap < [kind.radius - FORGIVEN for kind in analysis.plan.kinds]):
            name, needed = analysis.plan.names[row], analysis.plan.kinds[row].radius
            message = f"{name} starts in a wall of the arena: {max(gap[row], 0.0):.2f} m off, but needs {needed:.2f} m"
            remedy = "start it farther inside, or leave the walls out: walls = false in [arena]"
            yield Finding("error", "start-overlap", message, remedy, ("robots", name, "start"))


def perception(analysis: Analysis) -> Iterator[Finding]:
    """Check that robots with avoidance have sensors or neighbours to avoid by."""
    experiment, scene = analysis.plan.experiment, analysis.plan.scene
    avoidance = analysis.plan.avoidance
    if avoidance is None:
        return
    isolated = set() if avoidance.hears == "all" else {analysis.plan.names[row] for row in analysis.without_neighbours}
    height = analysis.height
    low, high = _heights(analysis, height)
    for row, name in enumerate(analysis.plan.names):
        if sensors_of(experiment.robots[name]) or not experiment.robots[name].avoids:
            continue
        in_height = [k for k in range(len(scene.names)) if outlines.at_height(scene, k, low[row], high[row])]
        there = [f"'{scene.names[k]}'" for k in in_height]
        flies = analysis.plan.kinds[row].flies
        remedy = f'give it some: sensors = ["{"multiranger" if flies else "lds01"}"] in [robots.{name}]'
        if there:
            message = f"{name} has no range sensors: it cannot avoid {join_names(there)}"
            yield Finding("warning", "sees-nothing", message, remedy, ("robots", name))
        elif name in isolated:
            message = f"{name} has neither neighbours nor range sensors: it avoids nothing"
            remedy += ', or hears = "all" in [avoidance]'
            yield Finding("warning", "sees-nothing", message, remedy, ("robots", name))


def reality(analysis: Analysis) -> Iterator[Finding]:
    """Check worlds, range sensors and shadows against the bodies of the robots."""
    experiment, robots = analysis.plan.experiment, analysis.plan.experiment.robots
    peopled = any(robot.body == WORLD for robot in robots.values())
    bare = not (peopled or experiment.arena.obstacles or experiment.arena.walls)
    for name, robot in robots.items():
        served, path = robot.ranges == "world", ("robots", name, "ranges")
        if served and robot.body == WORLD:
            message = f'{name} lives in the world and has its range sensors anyway: ranges = "world" adds nothing'
            yield Finding("warning", "ranges-twice", message, "leave ranges out", path)
        elif served and not sensors_of(robot):
            message = f"{name} has no range sensors that the world could serve"
            yield Finding("warning", "ranges-of-nothing", message, 'say which: sensors = ["multiranger"]', path)
        elif served and bare:
            message = f"{name} takes its ranges from a world without obstacles and robots"
            yield Finding("warning", "ranges-of-nothing", message, "add [arena.obstacles], or leave ranges out", path)
        if robot.shadow is not None and robot.body in TWINS:
            message = f"{name} is a twin, so its shadow only compares one twin with another"
            yield Finding("warning", "shadow-of-twin", message, "leave shadow out", ("robots", name, "shadow"))
    alone = [name for name, robot in robots.items() if robot.body == "twin" and robot.ranges != "world"]
    if alone and (experiment.arena.obstacles or experiment.avoidance is not None):
        subject = f"{join_names(alone)} {'is' if len(alone) == 1 else 'are'}"
        message = f'in real time {subject} in no common place and without range sensors, unless body = "world"'
        yield Finding("note", "alone", message, "", ("robots", alone[0]))


def _heights(analysis: Analysis, z: Array) -> tuple[Array, Array]:
    """Lower and upper end (..., N) of robots at positions `z` (..., N) [m]."""
    kinds = analysis.plan.kinds
    height = np.array([kind.height for kind in kinds])
    low = np.where([kind.flies for kind in kinds], z - 0.5 * height, 0.0)
    return low, low + height
