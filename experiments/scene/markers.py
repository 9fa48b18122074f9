"""Markers of a case for the viewers of recordings: arena, obstacles, robots, links in the colours of their errors."""

from __future__ import annotations

from itertools import pairwise
from typing import Final

import numpy as np

from agents.network.messages import Vector
from experiments.definition.plan import Plan
from experiments.recording.ros2.viewers import CYLINDER, LINE_LIST, LINE_STRIP, TEXT, Draw, Marker
from experiments.scene.stage import NOWHERE, UNKNOWN, LinkTracker, SceneModel, link_colours, segments
from twins.scene import corners

EDGE: Final = (90, 94, 102)
OBSTACLE: Final = (168, 172, 180)
LINE_M: Final = 0.01


def drawing(plan: Plan) -> Draw:
    """The function that draws a case: of a time [s, UTC] and the places [m] of the robots known then."""
    stage = SceneModel.of_plan(plan)
    tracker, begun = LinkTracker(stage), [float("nan")]
    still = [*_arena(stage), *_robots(stage)]

    def draw(stamp: float, places: dict[str, Vector]) -> list[Marker]:
        if np.isnan(begun[0]):
            begun[0] = stamp
        position = np.array([places.get(name, (np.nan,) * 3) for name in stage.names]).reshape(-1, 3)
        since = stamp - begun[0]
        return [*still, *_obstacles(stage, since), *_links(stage, tracker, since, position)]

    return draw


def _arena(stage: SceneModel) -> list[Marker]:
    (x0, y0, _), (x1, y1, z1) = stage.scene.low.tolist(), stage.scene.high.tolist()
    ring = [(x0, y0, 0.0), (x1, y0, 0.0), (x1, y1, 0.0), (x0, y1, 0.0), (x0, y0, 0.0)]
    made = [Marker("arena", LINE_STRIP, (2.0 * LINE_M, 0.0, 0.0), EDGE, points=ring)]
    if np.isfinite(z1):
        posts = [each for x, y, _ in ring[:4] for each in ((x, y, 0.0), (x, y, z1))]
        made.append(Marker("arena", LINE_LIST, (0.5 * LINE_M, 0.0, 0.0), EDGE, 0.5, points=posts))
    return made


def _robots(stage: SceneModel) -> list[Marker]:
    """Bodies and names, in the frames of the robots: the transforms move them."""
    made = []
    for name, kind, colour in zip(stage.names, stage.kinds, stage.colours.tolist(), strict=True):
        wide, high = 2.0 * kind.radius, kind.height
        middle, above = (0.0, 0.0, 0.5 * high), (0.0, 0.0, high + 0.08)
        made.append(Marker("robots", CYLINDER, (wide, wide, high), tuple(colour), frame=name, position=middle))
        made.append(Marker("names", TEXT, (0.0, 0.0, 0.08), EDGE, frame=name, position=above, text=name))
    return made


def _obstacles(stage: SceneModel, since: float) -> list[Marker]:
    scene, made = stage.scene, []
    for number, pose in enumerate(scene.at(since)):
        low, high = float(scene.bottom[number]), float(stage.tops[number])
        outline = scene.outline[number]
        if outline is None:
            wide, at = 2.0 * float(scene.radius[number]), (float(pose[0]), float(pose[1]), 0.5 * (low + high))
            made.append(Marker("obstacles", CYLINDER, (wide, wide, high - low), OBSTACLE, 0.85, position=at))
            continue
        ring = corners(outline, pose).tolist()
        if scene.closed[number]:
            ring.append(ring[0])
        points = [(x, y, z) for (ax, ay), (bx, by) in pairwise(ring)
                  for x, y, z in ((ax, ay, low), (bx, by, low), (ax, ay, high), (bx, by, high), (ax, ay, low),
                                  (ax, ay, high), (bx, by, low), (bx, by, high))]  # fmt: skip
        made.append(Marker("obstacles", LINE_LIST, (LINE_M, 0.0, 0.0), OBSTACLE, points=points))
    return made


def _links(stage: SceneModel, tracker: LinkTracker, since: float, position: np.ndarray) -> list[Marker]:
    """Marker of a list of lines; those without known ends lie out of sight, so that no earlier one stays."""
    net = stage.links
    if not len(net):
        return []
    error = tracker.errors(since, position)
    ends = segments(stage, position)
    drawn = np.isfinite(ends).all(axis=(1, 2)) & (~np.isnan(error) | (stage.plan is None))
    points = [tuple(point) for pair in ends[drawn].tolist() for point in pair] or [NOWHERE, NOWHERE]
    colours = [tuple(c) for c in link_colours(error[drawn]).tolist() for _ in range(2)] or [UNKNOWN, UNKNOWN]
    return [Marker("links", LINE_LIST, (LINE_M, 0.0, 0.0), UNKNOWN, points=points, colours=colours)]
