"""Drawing of an arena, from above and in space: border, obstacles, start boxes. All pictures use it.

Only greys are used, since colours are for robots. A grey obstacle is at rest, a hatched one can be pushed (both at
their places at the start). A dashed outline is the end of a moving one, with its path dotted.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Final

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon, Rectangle
from matplotlib.patheffects import withStroke
from mpl_toolkits.mplot3d import Axes3D  # type: ignore[import-untyped]
from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]

from experiments.definition.plan import Plan
from experiments.report.style import INK, PAPER
from experiments.scene.models import circle
from twins import scene as outlines
from twins.arrays import Array
from twins.scene import Scene

BODY: Final = "#d2d2d2"
EDGE: Final = "#4a4a4a"
FLOOR: Final = "#f1f1f1"  # colour of a start box
NAMED: Final = 6  # obstacles that have their names in the picture; more would hide it
ROUND: Final = 40  # corners of a circle
WHOLE: Final = 2.0  # an arena is shown whole in space if it is not larger than this, seen from what is in it

_OUTLINE: Final[dict[str, Any]] = {"edgecolor": EDGE, "linewidth": 0.6}
_STANDS: Final[dict[str, Any]] = {**_OUTLINE, "facecolor": BODY}
_PUSHED: Final[dict[str, Any]] = {**_OUTLINE, "facecolor": "none", "hatch": "//////"}
_HANGS: Final[dict[str, Any]] = {**_OUTLINE, "facecolor": "none", "linestyle": ":"}
_ENDS: Final[dict[str, Any]] = {**_OUTLINE, "facecolor": "none", "linestyle": (0, (3, 2))}
_SOLID: Final[dict[str, Any]] = {"facecolors": BODY, "edgecolors": EDGE, "linewidths": 0.3, "alpha": 0.4}
_PALE: Final[dict[str, Any]] = {**_SOLID, "linestyles": ":", "alpha": 0.15}
_PATH: Final[dict[str, Any]] = {"color": EDGE, "linewidth": 0.9, "linestyle": (0, (1, 1.5))}
_WALL: Final[dict[str, Any]] = {"color": EDGE, "linewidth": 1.6, "solid_capstyle": "butt"}
_BOX: Final[dict[str, Any]] = {"facecolor": FLOOR, "edgecolor": "#8a8a8a", "linewidth": 0.5, "linestyle": (0, (4, 2))}


def from_above(axes: Axes, plan: Plan) -> None:
    """Draws an arena into a plan view, below everything else."""
    arena, scene = plan.experiment.arena, plan.scene
    for box in arena.starts.values():
        corner = box.at[0] - box.size[0] / 2, box.at[1] - box.size[1] / 2
        axes.add_patch(Rectangle(corner, *box.size, zorder=0.1, **_BOX))
    x, y, _ = arena.size
    border: dict[str, Any] = {"linewidth": 1.0} if arena.walls else {"linewidth": 0.6, "linestyle": (0, (6, 3))}
    axes.add_patch(Rectangle((-x / 2, -y / 2), x, y, fill=False, edgecolor=INK, zorder=0.6, **border))
    way = _obstacle_paths(plan)
    for k, name in enumerate(scene.names):
        outline = scene.outline[k]
        if outline is not None and not scene.closed[k]:
            axes.plot(*outlines.corners(outline, scene.pose[k]).T, zorder=0.5, **_WALL)
        else:
            axes.add_patch(Polygon(_ring(scene, k, scene.pose[k]), zorder=0.4, **_style(scene, k)))
        if scene.plans[k] is not None:
            axes.plot(*way[:, k, :2].T, zorder=0.5, **_PATH)
            axes.add_patch(Polygon(_ring(scene, k, way[-1, k]), zorder=0.4, **_ENDS))
        if len(scene.names) <= NAMED:
            halo = [withStroke(linewidth=1.2, foreground=PAPER)]
            x, y = _ring(scene, k, scene.pose[k]).mean(axis=0)
            axes.text(x, y, name, fontsize=5, color=EDGE, ha="center", va="center", zorder=0.7, path_effects=halo)


def in_space(axes: Axes3D, plan: Plan, low: Array, high: Array) -> None:
    """Draws an arena into a picture of space that shows what is from `low` to `high` (3,) [m], below everything else.

    Nothing is cut off at the edges of such a picture, so the border is left out where it does not lie inside.
    """
    arena, scene = plan.experiment.arena, plan.scene
    for box in arena.starts.values():
        half = 0.5 * np.array(box.size)
        _loop(axes, np.array(box.at) + half * _SQUARE, color="#8a8a8a", linewidth=0.5, linestyle=(0, (4, 2)))
    style: dict[str, Any] = {"linewidth": 0.8} if arena.walls else {"linewidth": 0.5, "linestyle": (0, (6, 3))}
    if (scene.low[:2] >= low[:2]).all() and (scene.high[:2] <= high[:2]).all():
        _loop(axes, 0.5 * np.array(arena.size[:2]) * _SQUARE, color=EDGE, **style)
    way = _obstacle_paths(plan)
    for k in range(len(scene.names)):
        bottom, top = float(scene.bottom[k]), float(min(scene.top[k], high[2]))
        if bottom >= top:
            continue
        ring = _ring(scene, k, scene.pose[k])
        style = _PALE if np.isfinite(scene.mass[k]) else _SOLID
        plain = {**style, "linewidths": 0.0} if scene.outline[k] is None else style  # a cylinder has no edges
        axes.add_collection3d(Poly3DCollection(_sides(scene, k, ring, bottom, top), zorder=0.5, **plain))
        if scene.closed[k]:
            ends = [np.column_stack([ring, np.full(len(ring), z)]) for z in (bottom, top)]
            axes.add_collection3d(Poly3DCollection(ends, zorder=0.5, **style))
        if scene.plans[k] is not None:
            axes.plot(*way[:, k, :2].T, np.full(len(way), bottom), zorder=0.6, **_PATH)
            _loop(axes, _ring(scene, k, way[-1, k]), bottom, color=EDGE, linewidth=0.5, linestyle=(0, (3, 2)))


def around(plan: Plan, low: Array, high: Array) -> tuple[Array, Array]:
    """Limits of a picture along x and y, with robots from `low` to `high` (2,) [m].

    All obstacles as far as they stand in the arena, all start boxes, and the arena itself if it is not much larger.
    """
    arena, scene = plan.experiment.arena, plan.scene
    rings = [_ring(scene, k, scene.pose[k]) for k in range(len(scene.names))]
    rings += [_ring(scene, k, pose) for k in scene.moving for pose in _obstacle_paths(plan)[[-1], k]]
    rings += [np.array(box.at) + 0.5 * np.array(box.size) * _SQUARE for box in arena.starts.values()]
    if rings:
        points = np.clip(np.concatenate(rings), scene.low[:2], scene.high[:2])
        low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
    if (scene.high[:2] - scene.low[:2] <= WHOLE * (high - low)).all():
        low, high = np.minimum(low, scene.low[:2]), np.maximum(high, scene.high[:2])
    return low, high


def legend(plans: Sequence[Plan], *, space: bool = False) -> dict[str, Artist]:
    """Artists of the obstacles in arenas, by their labels, from above or in space."""
    found: dict[str, Artist] = {}
    for arena in (plan.experiment.arena for plan in plans):
        for obstacle in arena.obstacles.values():
            if obstacle.wall is not None:
                found["wall"] = Line2D([], [], **_WALL)
            elif obstacle.mass is not None:
                found["can be pushed"] = Patch(**({**_STANDS, "alpha": 0.3, "linestyle": ":"} if space else _PUSHED))
            elif obstacle.bottom > 0.0 and not space:
                found["above the floor"] = Patch(**_HANGS)
            else:
                found["obstacle"] = Patch(**_STANDS)
            if obstacle.plan is not None:
                found["obstacle's path"] = Line2D([], [], **_PATH)
        if arena.starts:
            found["start box"] = Patch(**_BOX)
    return found


_SQUARE: Final = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def _style(scene: Scene, k: int) -> dict[str, Any]:
    if np.isfinite(scene.mass[k]):
        return _PUSHED
    return _HANGS if scene.bottom[k] > 0.0 else _STANDS


def _obstacle_paths(plan: Plan) -> Array:
    """Poses (T, M, 3) of obstacles over the run, as finely as a picture shows them."""
    return plan.scene.along(np.linspace(0.0, plan.experiment.duration_s, 400))


def _ring(scene: Scene, k: int, pose: Array) -> Array:
    """Corners (n, 2) of an obstacle in the room [m]; of a cylinder, a polygon that looks round."""
    outline = scene.outline[k]
    if outline is not None:
        return outlines.corners(outline, pose)
    return np.asarray(pose[:2] + circle(float(scene.radius[k]), ROUND))


def _loop(axes: Axes3D, ring: Array, z: float = 0.0, **style: object) -> None:
    closed = np.concatenate([ring, ring[:1]])
    axes.plot(closed[:, 0], closed[:, 1], np.full(len(closed), z), zorder=0.3, **style)


def _sides(scene: Scene, k: int, ring: Array, low: float, high: float) -> list[Array]:
    """The upright faces (4, 3) of an obstacle."""
    around = [*ring, ring[0]] if scene.closed[k] else list(ring)
    return [np.array([[*a, low], [*b, low], [*b, high], [*a, high]]) for a, b in pairwise(around)]
