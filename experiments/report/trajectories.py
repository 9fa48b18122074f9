"""Pictures of space: the ways of the robots from above and in perspective, in the arena and what stands there."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np
from matplotlib.artist import Artist
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D  # type: ignore[import-untyped]
from mpl_toolkits.mplot3d.art3d import Line3DCollection  # type: ignore[import-untyped]

from agents.arrays import Array
from experiments.check.analysis import Analysis
from experiments.metrics.signals import phase_starts
from experiments.recording.trace import Trace
from experiments.report import scenery
from experiments.report.style import (
    INK,
    KINDS,
    MAGENTA,
    MANY,
    PAPER,
    ROBOTS,
    WIDTH,
    edges,
    last_known,
    panel_height,
    plain,
    robot_legend,
    robot_lines,
    styled,
    thinned,
)

FLAT: Final = 0.15  # of its width is how high a picture of robots on the floor is, where tall things stand there


@styled
def formation_before(traces: Sequence[Trace]) -> Figure:
    """The way from the start into the formation, before the first leg of the timeline (paper, figure 13)."""
    return _spatial(traces, before)


@styled
def formation_after(traces: Sequence[Trace]) -> Figure:
    """The way from the first leg of the timeline to the end (paper, figure 14); the whole run if there is no leg."""
    return _spatial(traces, after)


@styled
def plan_view(traces: Sequence[Trace]) -> Figure:
    """The trajectories from above, in the arena as it is; start hollow, end full, links of the end grey."""
    columns = min(2, len(traces))
    rows = math.ceil(len(traces) / columns)
    x, y, _ = traces[0].experiment.arena.size
    side = (WIDTH - 0.5) / columns
    panel = min(side * y / x, 3.2) + 0.25
    things = scenery.legend([trace.experiment for trace in traces])
    figure = Figure(figsize=(WIDTH, panel * rows + 0.7 + 0.17 * bool(things[1])), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes, trace in zip(grid.flat, traces, strict=False):
        x, y, _ = trace.experiment.arena.size
        scenery.from_above(axes, trace.experiment)
        few, net = thinned(trace, len(traces)), trace.plan.links
        place, last = trace.true_position, last_known(trace)
        for i, j in edges(net.receiver, net.sender):
            axes.plot(*last[[i, j], :2].T, color="#8a8a8a", linewidth=0.5, zorder=1)
        small = 3.0 if len(trace.robots) <= MANY else 2.0
        for i, line in enumerate(robot_lines(trace)):
            axes.plot(place[few, i, 0], place[few, i, 1], **{**line, "linewidth": 0.8})
            axes.plot(*place[0, i, :2], "o", ms=small, mec=line["color"], mfc="none", mew=0.7)
            axes.plot(*last[i, :2], "o", ms=small + 0.5, mec="none", color=line["color"])
        axes.set_aspect("equal")
        axes.set_xlim(-0.53 * x, 0.53 * x)
        axes.set_ylim(-0.53 * y, 0.53 * y)
        axes.set_title(plain(trace.case), pad=3.0)
        axes.spines[["left", "bottom"]].set_visible(False)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.yaxis.set_major_locator(MaxNLocator(5))
    for axes in list(grid.flat)[len(traces) :]:
        axes.set_visible(False)
    figure.supxlabel("$x$ [m]", fontsize=8)
    figure.supylabel("$y$ [m]", fontsize=8)
    robot_legend(figure, traces, things)
    return figure


@styled
def expected_motion(analyses: Mapping[str, Analysis]) -> Figure:
    """The formation of each case as `check` expects it, from above: starts hollow, expected ways, target shape with its
    links (dashed where the shape misses their targets by more than the tolerance).
    """
    cases = list(analyses.items())
    x, y, _ = cases[0][1].experiment.arena.size
    columns = min(2, len(cases))
    rows = math.ceil(len(cases) / columns)
    panel = min((WIDTH - 0.5) / columns * y / x, 3.2) + 0.25
    figure = Figure(figsize=(WIDTH, panel * rows + 0.4), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes, (name, known) in zip(grid.flat, cases, strict=False):
        experiment, motion = known.experiment, known.prediction.position
        scenery.from_above(axes, experiment)
        target = motion[-1] if known.shape is None else _laid_upon(known.shape.position, motion[-1])
        error = np.zeros(len(known.asked)) if known.shape is None else known.shape.error
        for link, (i, j) in enumerate(zip(known.asked.receiver, known.asked.sender, strict=True)):
            style = "-" if error[link] <= experiment.tolerance else (0, (2, 2))
            axes.plot(*target[[i, j], :2].T, color=MAGENTA, linewidth=0.8, linestyle=style, zorder=1)
        for row, robot in enumerate(known.names):
            colour = ROBOTS[row % len(ROBOTS)] if len(known.names) <= MANY else KINDS[experiment.robots[robot].kind]
            axes.plot(motion[:, row, 0], motion[:, row, 1], color=colour, linewidth=0.6)
            axes.plot(*known.start[row, :2], "o", ms=3.0, mec=colour, mfc="none", mew=0.7)
            axes.plot(*target[row, :2], "o", ms=3.5, mec="none", color=colour, zorder=3)
            axes.annotate(robot, target[row, :2], (3, 3), textcoords="offset points", fontsize=5, color=colour)
        axes.set_aspect("equal")
        axes.set_xlim(-0.53 * x, 0.53 * x)
        axes.set_ylim(-0.53 * y, 0.53 * y)
        axes.set_title(plain(name), pad=3.0)
    for axes in list(grid.flat)[len(cases) :]:
        axes.set_visible(False)
    figure.supxlabel("$x$ [m]", fontsize=8)
    figure.supylabel("$y$ [m]", fontsize=8)
    return figure


def _laid_upon(shape: Array, place: Array) -> Array:
    """A shape (N, 3), turned or mirrored in the plane and moved to fit places (N, 3) in the least squares (Kabsch)."""
    middle, at = shape[:, :2].mean(axis=0), place[:, :2].mean(axis=0)
    left, _, right = np.linalg.svd((shape[:, :2] - middle).T @ (place[:, :2] - at))
    return np.column_stack([(shape[:, :2] - middle) @ left @ right + at, shape[:, 2]])


def before(trace: Trace) -> slice:
    """Rows until the first leg of the timeline; all if there is none."""
    starts = phase_starts(trace)
    return slice(0, _row(trace, starts[1]) if len(starts) > 1 else len(trace.time))


def after(trace: Trace) -> slice:
    """Rows from the first leg of the timeline on; all if there is none."""
    starts = phase_starts(trace)
    return slice(_row(trace, starts[1]) if len(starts) > 1 else 0, len(trace.time))


def _row(trace: Trace, at: float) -> int:
    return int(np.searchsorted(trace.time, at - 1e-9))


def has_positions(trace: Trace, rows: slice = slice(None)) -> bool:
    """Whether the position of any robot is known there."""
    return bool(np.isfinite(trace.true_position[rows]).all(axis=2).any())


def _spatial(traces: Sequence[Trace], rows_of: Callable[[Trace], slice]) -> Figure:
    """Trajectories in space over a span of time, one panel per case, with the links at its start and its end."""
    columns = 1 if len(traces) <= 2 else 2
    rows = math.ceil(len(traces) / columns)
    height = panel_height(rows, 2.6 / columns)
    things = scenery.legend([trace.experiment for trace in traces], space=True)
    above = 0.3 + 0.16 * math.ceil(len(things[1]) / 4)
    whole = height * rows + above
    figure = Figure(figsize=(WIDTH, whole))
    for k, trace in enumerate(traces):
        row, column = divmod(k, columns)
        box = ((column - 0.02) / columns, 1.0 - (above + height * (row + 1)) / whole, 1.0 / columns, height / whole)
        axes = figure.add_axes(box, projection="3d", computed_zorder=False)
        assert isinstance(axes, Axes3D)
        if has_positions(trace, rows_of(trace)):
            _draw_spatial(axes, trace, trace.true_position[rows_of(trace)], columns)
        else:
            axes.set_axis_off()
            axes.text2D(0.5, 0.5, "nothing is known", transform=axes.transAxes, fontsize=7, ha="center")
        if len(traces) > 1:
            axes.text2D(0.06, 0.93, plain(trace.case), transform=axes.transAxes, fontsize=8)
    black, magenta = to_rgb(INK), to_rgb(MAGENTA)
    handles: list[Artist] = [
        Line2D([], [], color=black, linewidth=0.7),
        Line2D([], [], color=magenta, linewidth=0.9),
        Line2D(
            [], [], color=black, marker="*", linestyle="", markersize=5, markerfacecolor="none", markeredgewidth=0.6
        ),
        Line2D([], [], color=black, marker="*", linestyle="", markersize=5.5),
    ]
    labels = ["links, start", "links, end", "start", "end"]
    figure.legend([*handles, *things[0]], [*labels, *things[1]], loc="upper center", ncols=4, bbox_to_anchor=(0.5, 1.0))
    return figure


def _draw_spatial(axes: Axes3D, trace: Trace, place: Array, columns: int) -> None:
    known = np.asarray(np.isfinite(place).all(axis=2))
    ends = place[len(place) - 1 - known[::-1].argmax(axis=0), np.arange(place.shape[1])]
    starts = place[known.argmax(axis=0), np.arange(place.shape[1])]
    net = trace.plan.links
    pairs = edges(net.receiver, net.sender)
    thin = (1.0 if len(trace.robots) <= MANY else 0.5) / math.sqrt(columns)
    for where, colour, width, order in ((starts, INK, 0.6, 1), (ends, MAGENTA, 0.9, 4)) if pairs else ():
        lines = [where[[i, j]] for i, j in pairs]
        axes.add_collection3d(Line3DCollection(lines, colors=colour, linewidths=width * thin, alpha=0.8, zorder=order))
    few = slice(None, None, max(1, len(place) // 400))
    for i, line in enumerate(robot_lines(trace)):
        axes.plot(*place[few, i].T, **{**line, "zorder": 3})
        axes.plot(*starts[i, :, None], "*", ms=5 * thin, mfc="none", mec=line["color"], mew=0.6, zorder=5)
        axes.plot(*ends[i, :, None], "*", ms=6 * thin, color=line["color"], mec="none", zorder=6)
        if len(trace.robots) <= MANY and columns == 1:
            halo = [withStroke(linewidth=1.5, foreground=PAPER)]
            axes.text(*(ends[i] + [0.0, 0.0, 0.05]), trace.robots[i], fontsize=6, zorder=7, path_effects=halo)
    low, high = place[known].min(axis=0), place[known].max(axis=0)
    low[:2], high[:2] = scenery.around(trace.experiment, low[:2], high[:2])
    low[2] = min(0.0, low[2])
    size = np.maximum(high - low, 0.4)
    middle = 0.5 * (low + high)
    ground = bool(low[2] > -0.1)
    low, high = middle - 0.54 * size, middle + 0.54 * size
    if ground:
        low[2], high[2] = 0.0, max(high[2], scenery.tall(trace.experiment, FLAT * float((high - low)[:2].max())))
    scenery.in_space(axes, trace.experiment, low, high)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    x, y, z = (high - low) / math.dist(high, low)
    wide, tall = 0.87 * x + 0.5 * y, 0.44 * (0.5 * x + 0.87 * y) + 0.9 * z  # from 26° above and 60° aside
    axes.set_box_aspect((x, y, z), zoom=min(0.94 / wide, 0.82 / tall))
    axes.view_init(26, -60)
    size_pt, pad = (8, -8 if z > FLAT else -5) if columns == 1 else (6.5, -11)
    axes.set_xlabel("$x$ [m]", labelpad=pad, fontsize=size_pt)
    axes.set_ylabel("$y$ [m]", labelpad=pad, fontsize=size_pt)
    axes.set_zlabel("$z$ [m]", labelpad=pad - 1, fontsize=size_pt)
    for axis, length in zip((axes.xaxis, axes.yaxis, axes.zaxis), (x, y, z), strict=True):
        axis.set_major_locator(MaxNLocator(max(1, round((5 if columns == 1 else 3) * min(1.0, 2.5 * length)))))
        axis.pane.fill = False
        axis.pane.set_edgecolor("#9a9a9a")
        axis.pane.set_linewidth(0.4)
        axis._axinfo["grid"].update(linewidth=0.3, color="#c0c0c0")
    axes.tick_params(pad=-3.5 if columns == 1 else -4.5, labelsize=6.5 if columns == 1 else 5.5)
