"""Checks of the surroundings of the predicted paths: arena, obstacles, contacts, sensors, and worlds."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from agents.errors import join_names
from experiments.check.analysis import Analysis
from experiments.check.findings import APART, FORGIVEN, Finding
from experiments.definition.bodies import sensors_of
from experiments.definition.experiment import WORLD
from twins import scene as outlines
from twins.arrays import Array, Index, Mask, norm
from twins.scene import Obstacle

TWINS: Final = ("twin", WORLD)  # bodies that are simulated without the wire of a real one
SPREADS: Final = 1.3  # growth of the distances between robots from which on a law drives them apart
AVOID: Final = 'or let robots avoid it: [avoidance] with kind = "barrier"'


def walls(analysis: Analysis) -> Iterator[Finding]:
    """Check that no robot leaves the arena, or is held back by the margin at a wall."""
    names, limits = analysis.plan.names, analysis.limits
    track = analysis.prediction.position
    beyond = np.maximum(track - limits.high, limits.low - track)  # (T, N, 3), positive outside
    outside = beyond.max(axis=2) > FORGIVEN
    beside = beyond[..., :2].max(axis=2) + analysis.radius  # (T, N), surfaces
    if apart := _driven_apart(analysis, outside):
        yield apart
        return
    tight = beside > FORGIVEN - limits.margin
    tight &= ~tight[0]  # a start there is a finding of `starts`
    problems = [_left_arena(analysis, int(row), outside[:, row]) for row in np.flatnonzero(outside.any(axis=0))]
    for row in np.flatnonzero(tight.any(axis=0) & ~outside.any(axis=0)):
        _, when = _first_time(analysis, int(row), tight[:, row])
        message = f"{names[row]} comes within the margin of {limits.margin:g} m of a wall {when}"
        remedy = "it will be held back there: enlarge size in [arena], or lead the formation away from the wall"
        problems.append(Finding("warning", "near-wall", message, remedy, ("arena", "size")))
    yield from problems
    if not problems:
        yield Finding("note", "inside", "the expected paths stay inside the arena")


def _driven_apart(analysis: Analysis, outside: Mask) -> Finding | None:
    """Error of a law by which most robots leave the arena (T, N), farther from each other than they began."""
    follow = analysis.placed
    count = int(follow.sum())
    if count < 2 or 2 * int(outside[:, follow].any(axis=0).sum()) <= count:
        return None
    first = int(outside[:, follow].any(axis=1).argmax())
    place = analysis.prediction.position[[0, first]][:, follow]
    begun, ended = norm(place[:, :, None] - place[:, None]).sum(axis=(1, 2)) / (count * (count - 1))
    errors = analysis.error[[0, first]].mean(axis=1) if analysis.has_targets else np.array([0.0, 1.0])
    if ended < SPREADS * begun or errors[1] <= errors[0]:
        return None
    row = int(np.flatnonzero(follow)[outside[first, follow].argmax()])
    _, when = _first_time(analysis, row, outside[:, row])
    return Finding(
        "error",
        APART,
        f"the law drives the robots apart: on average {begun:.2f} m from each other at first, {ended:.2f} m when the "
        f"first, {analysis.plan.names[row]}, would leave the arena {when}",
        "is a sign turned round? A robot goes towards a neighbour along each.position - view.position",
        ("formation", "law"),
    )


def _left_arena(analysis: Analysis, row: int, outside: Mask) -> Finding:
    name, timeline = analysis.plan.names[row], analysis.plan.experiment.timeline
    time, when = _first_time(analysis, row, outside)
    begun = [k for k, robot, _ in analysis.legs if robot == name and timeline[k].at_s <= time]
    message = f"{name} would leave the arena {when}"
    if row in analysis.without_neighbours and begun:
        remedy = "shorten the plan, start it elsewhere, or enlarge size in [arena]"
        message = f"{message}, by its plan{analysis.sources(time, name)}"
        return Finding("error", "leaves-arena", message, remedy, ("timeline", begun[-1], "plan"))
    remedy = "start the formation farther inside, lead it elsewhere, or enlarge size in [arena]"
    return Finding("error", "leaves-arena", message, remedy, ("robots", name, "start"))


def _first_time(analysis: Analysis, row: int, where: Mask) -> tuple[float, str]:
    """Time at which a row is first there, and when and where that is in words."""
    at = int(where.argmax())
    time, (x, y, _) = float(analysis.prediction.time[at]), analysis.prediction.position[at, row]
    return time, f"at {time:.1f} s, at ({x:.2f}, {y:.2f})"


def ceiling(analysis: Analysis) -> Iterator[Finding]:
    """Check that the overshoot of a take-off stays below the top of the arena."""
    top = analysis.plan.experiment.arena.size[2]
    for name, kind, hover in zip(analysis.plan.names, analysis.plan.kinds, analysis.height.tolist(), strict=True):
        highest = (1.0 + kind.overshoot) * hover
        if kind.overshoot and highest > top + FORGIVEN:
            how = f"the take-off of a {kind.name} overshoots by up to {kind.overshoot:.0%}"
            message = f"{name} hovers at {hover:g} m, and {how}: to {highest:.2f} m, in an arena {top:g} m high"
            lower = math.floor(100.0 * top / (1.0 + kind.overshoot)) / 100.0
            remedy = f"hover at {lower:g} m at most, or enlarge size in [arena] if the room is higher"
            yield Finding("warning", "overshoots-arena", message, remedy, ("robots", name, "hover"))


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
    radius = analysis.radius
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
        near = [f"'{scene.names[k]}'" for k in in_height]
        flies = analysis.plan.kinds[row].flies
        remedy = f'give it some: sensors = ["{"multiranger" if flies else "lds01"}"] in [robots.{name}]'
        if near:
            message = f"{name} has no range sensors: it cannot avoid {join_names(near)}"
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
