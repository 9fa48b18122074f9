"""Pictures of space: the ways of the robots from above and in perspective, in the arena and what stands there."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Bbox
from mpl_toolkits.mplot3d import Axes3D, proj3d  # type: ignore[import-untyped]
from mpl_toolkits.mplot3d.art3d import Line3DCollection  # type: ignore[import-untyped]

from agents.body.kinds import KINDS
from experiments.check.analysis import Analysis
from experiments.definition.graph import edges
from experiments.metrics.signals import Measurement
from experiments.recording.trace import Trace
from experiments.report import scenery, style
from experiments.scene.stage import link_colours
from twins.arrays import Array

LOW: Final = 0.2  # [m] robots below that are as well seen from above
LONGEST: Final = 22  # letters of a name above one of two panels
OVERLAID: Final = 3  # cases that can be distinguished upon each other, from above
FLAT: Final = 0.15  # share of its width: height of a picture of robots on the floor where tall things stand there


@style.styled
def plan_view(traces: Sequence[Trace], width: float = style.WIDTH) -> Figure:
    """The trajectories from above, and of the arena what is near them; start hollow, end full, links of the end.

    A few cases in the same arena are laid upon each other, with a colour each; their robots are named, and few of them
    have a marker each. More cases are side by side, and their robots have a colour each.
    """
    first, *others = (trace.plan.experiment.arena for trace in traces)
    overlaid = 1 < len(traces) <= OVERLAID and all(arena == first for arena in others)
    panels = [list(traces)] if overlaid else [[trace] for trace in traces]
    place = np.concatenate([trace.true_position.reshape(-1, 3)[:, :2] for trace in traces])
    place = place[np.isfinite(place).all(axis=1)]
    low, high = (place.min(axis=0), place.max(axis=0)) if len(place) else (np.zeros(2), np.zeros(2))
    for trace in traces:
        low, high = scenery.around(trace.plan, low, high)
    size = np.maximum(high - low, 0.4)
    low, high = 0.5 * (low + high) - 0.56 * size, 0.5 * (low + high) + 0.56 * size
    things = scenery.legend([trace.plan for trace in traces])
    tallest = min(0.62 * width, 3.6) if overlaid else 3.2
    figure, grid = _plane(len(panels), width, (low, high), tallest, 0.7 + 0.17 * bool(things))
    for axes, shown in zip(grid, panels, strict=False):
        scenery.from_above(axes, shown[0].plan)
        for k, trace in enumerate(shown):
            _draw_from_above(axes, trace, style.thinned(trace, len(traces)), style.case_line(k) if overlaid else None)
        axes.set_title("" if overlaid else style.shortened(shown[0].case, LONGEST), pad=3.0)
        axes.spines[["left", "bottom"]].set_visible(False)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.yaxis.set_major_locator(MaxNLocator(5))
    if overlaid:
        grid[0].set(xlabel="$x$ [m]", ylabel="$y$ [m]")
        style.legend_above(figure, _case_entries(traces) | _end_entries() | things, columns=6)
    else:
        _label_plane(figure, len(panels) - len(grid))
        style.robot_legend(figure, traces, things)
    return figure


def _plane(
    count: int, width: float, limits: tuple[Array, Array], tallest: float, more: float
) -> tuple[Figure, list[Axes]]:
    """A figure of views from above within `limits` [m], side by side, none higher than `tallest` and `more` around.

    There are as many views as a page has room for.
    """
    low, high = limits
    columns = min(2, count)
    rows = math.ceil(count / columns)
    shape = float((high - low)[1] / (high - low)[0])
    panel = min((width - 0.5) / columns * shape, tallest) + 0.25
    rows = min(rows, max(1, math.floor((style.TALLEST - more) / panel)))
    count = min(count, rows * columns)
    figure = style.Drawing(figsize=(width, panel * rows + more), layout="constrained")
    grid = list(figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat)
    for axes in grid[count:]:
        axes.set_visible(False)
    for axes in grid[:count]:
        axes.set(aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    return figure, grid[:count]


def _label_plane(figure: Figure, hidden: int) -> None:
    """Labels of both axes, and the number of cases that the figure leaves out."""
    figure.supxlabel(f"$x$ [m]\n{style.beyond(hidden)}".strip(), fontsize=8)
    figure.supylabel("$y$ [m]", fontsize=8)


def _draw_from_above(axes: Axes, trace: Trace, few: slice, design: style.Line | None) -> None:
    """Paths of a case from above: in one style, robots named, or with a colour for each robot."""
    place, (first, last) = trace.true_position, _ends(trace)
    ink = "#8a8a8a" if design is None else design["color"]
    for pair in edges(trace.plan.links):
        axes.plot(*last[pair, :2].T, color=ink, linewidth=0.5, alpha=1.0 if design is None else 0.6, zorder=1)
    few_robots = len(trace.robots) <= style.MAX_COLOURED_ROBOTS
    small, named = 3.0 if few_robots else 2.0, few_robots and design is not None and "alpha" in design
    for i, line in enumerate(style.robot_lines(trace)):
        colour = line["color"] if design is None else ink
        marker = style.MARKERS[i] if design is not None and few_robots else "o"
        path = {**line, "linewidth": 0.8} if design is None else design
        axes.plot(place[few, i, 0], place[few, i, 1], **path)
        axes.plot(*last[i, :2], marker, ms=small + 0.5, mec="none", color=colour)
        axes.plot(*first[i, :2], marker, ms=small, mec=colour, mfc="none", mew=0.7)
        if named and np.isfinite(last[i, :2]).all():
            _annotate(axes, trace.robots[i], last[i], (0, 4), fontsize=6, ha="center")


def _annotate(axes: Axes, name: str, place: Array, offset: tuple[float, float], **design: Any) -> None:  # noqa: ANN401
    """Writes a name `offset` [pt] from a place (x, y, ...)."""
    at = float(place[0]), float(place[1])
    axes.annotate(name, at, offset, textcoords="offset points", path_effects=style.HALO, **design)


def _case_entries(traces: Sequence[Trace]) -> dict[str, Artist]:
    return {style.plain(trace.case): Line2D([], [], **style.case_line(k)) for k, trace in enumerate(traces)}


def _end_entries() -> dict[str, Artist]:
    black = to_rgb(style.INK)
    start = Line2D([], [], color=black, marker="o", linestyle="", ms=3.0, mfc="none", mew=0.6)
    return {"start": start, "end": Line2D([], [], color=black, marker="o", linestyle="", ms=3.5)}


@style.styled
def expected_motion(analyses: Mapping[str, Analysis]) -> Figure:
    """The formation of each case as `check` expects it, from above: starts hollow, ends full, and the target shape with
    its links (dashed where the shape misses their targets by more than the tolerance), laid where the leaders are.
    """
    cases = list(analyses.items())
    half = 0.53 * np.array(cases[0][1].plan.experiment.arena.size[:2])
    figure, grid = _plane(len(cases), style.WIDTH, (-half, half), 3.2, 0.6)
    for axes, (name, known) in zip(grid, cases, strict=False):
        experiment, motion = known.plan.experiment, known.prediction.position
        scenery.from_above(axes, known.plan)
        target = motion[-1] if known.shape is None else _laid_upon(known, known.shape.position, motion[-1])
        error = np.zeros(len(known.asked)) if known.shape is None else known.shape.error
        for link, (i, j) in enumerate(zip(known.asked.receiver, known.asked.sender, strict=True)):
            design = "-" if error[link] <= experiment.tolerance else (0, (2, 2))
            axes.plot(*target[[i, j], :2].T, color=style.MAGENTA, linewidth=0.8, linestyle=design, zorder=1)
        for row, robot in enumerate(known.plan.names):
            colour = style.ROBOTS[row % len(style.ROBOTS)]
            if len(known.plan.names) > style.MAX_COLOURED_ROBOTS:
                colour = KINDS[experiment.robots[robot].kind].colour
            axes.plot(motion[:, row, 0], motion[:, row, 1], color=colour, linewidth=0.6)
            axes.plot(*known.start[row, :2], "o", ms=3.0, mec=colour, mfc="none", mew=0.7)
            axes.plot(*target[row, :2], "D", ms=4.0, mec=style.MAGENTA, mfc="none", mew=0.7, zorder=3)
            axes.plot(*motion[-1, row, :2], "o", ms=3.5, mec="none", color=colour, zorder=4)
            _annotate(axes, robot, motion[-1, row], (3, 3), fontsize=5, color=colour, zorder=5)
        axes.set_title(style.shortened(name, LONGEST), pad=3.0)
    _label_plane(figure, len(cases) - len(grid))
    entries = _end_entries()
    entries["target shape"] = Line2D(
        [], [], color=style.MAGENTA, linewidth=0.8, marker="D", ms=3.5, mfc="none", mew=0.7
    )
    style.legend_above(figure, entries, columns=3)
    return figure


def _laid_upon(known: Analysis, shape: Array, place: Array) -> Array:
    """A shape (N, 3), moved as far as its targets leave it free to fit places (N, 3) in the least squares (Kabsch).

    Leaders and anchors keep it where it is. Distances leave it free to turn and be mirrored, about a single leader.
    """
    fixed = known.without_neighbours
    if known.plan.anchors_by_row:
        return shape
    about = fixed if len(fixed) else np.arange(len(shape))
    middle, at = shape[about, :2].mean(axis=0), place[about, :2].mean(axis=0)
    turn = np.eye(2)
    if len(fixed) < 2 and known.asked.wants is None:
        left, _, right = np.linalg.svd((shape[:, :2] - middle).T @ (place[:, :2] - at))
        turn = left @ right
    return np.column_stack([(shape[:, :2] - middle) @ turn + at, shape[:, 2]])


def has_positions(trace: Trace) -> bool:
    """Whether the position of any robot is ever known."""
    return bool(np.isfinite(trace.true_position).all(axis=2).any())


@style.styled
def formation(traces: Sequence[Trace], width: float = style.WIDTH) -> Figure:
    """The trajectories of the whole run in space, all cases in one panel: start hollow, end full, links of the end.

    Cases have a colour each; the robots of a single case do (paper, figures 13 and 14).
    """
    shown = [trace for trace in traces if has_positions(trace)]
    things = scenery.legend([trace.plan for trace in traces], space=True)
    entries = (_case_entries(traces) if len(traces) > 1 else {}) | _end_entries() | things
    entries = style.fewer(entries)
    fits = style.fitting(width, entries, 6)
    above = 0.12 + 0.15 * math.ceil(len(entries) / fits)
    height = min(0.7 * width, 3.9)
    whole = height + above
    figure = style.Drawing(figsize=(width, whole))
    axes = figure.add_axes((-0.07, -0.05, 1.1, 1.1 * height / whole), projection="3d", computed_zorder=False)
    assert isinstance(axes, Axes3D)
    if not shown:
        axes.set_axis_off()
        axes.text2D(0.5, 0.5, "no position is known", transform=axes.transAxes, fontsize=7, ha="center")
        return figure
    for k, trace in enumerate(traces):
        if has_positions(trace):
            _draw_in_space(axes, trace, style.case_line(k) if len(traces) > 1 else None)
    _frame(axes, shown)
    figure.legend([*entries.values()], [*entries], loc="upper center", ncols=fits, bbox_to_anchor=(0.5, 1.0))
    _crop(figure, axes, above)
    return figure


def _crop(figure: Figure, axes: Axes3D, above: float) -> None:
    """Take off what is empty above and below a picture of space, under `above` [in] for a legend."""
    height = figure.get_figheight()
    figure.draw_without_rendering()
    parts = [*axes.lines, *axes.texts, axes.xaxis, axes.yaxis, axes.zaxis]
    boxes = [box for part in parts if (box := part.get_tightbbox()) is not None]
    box = Bbox.union([each for each in boxes if np.isfinite(each.extents).all() and each.height > 0.0])
    corners = np.array(list(itertools.product(axes.get_xlim(), axes.get_ylim(), axes.get_zlim())))
    x, y, _ = proj3d.proj_transform(*corners.T, axes.get_proj())
    height_of = axes.transData.transform(np.column_stack([x, y]))[:, 1]  # [px] corners of the grid
    bottom, top = min(box.y0, height_of.min()) / figure.dpi, max(box.y1, height_of.max()) / figure.dpi
    place = axes.get_position(original=True)
    whole = top - bottom + above + 0.08
    figure.set_figheight(whole)
    axes.set_position(
        (place.x0, (place.y0 * height - bottom + 0.04) / whole, place.width, place.height * height / whole)
    )


TRAIL_S: Final = 12.0  # motion that a frame of a film shows behind each robot


def film(traces: Sequence[Trace]) -> tuple[Figure, Callable[[float], None]]:
    """A picture of all cases side by side in space, and a function that sets it to a time [s] of the run.

    Links have the colours of their errors; few robots have their names.
    """
    shown = [trace for trace in traces if has_positions(trace)]
    with mpl.rc_context(dict(style.STYLE)):
        figure = style.Drawing(figsize=(4.0 * len(shown), 3.0))
        clock = figure.text(0.5, 0.03, "", ha="center", fontsize=9)
        parts = []
        for k, trace in enumerate(shown):
            box = ((k - 0.05) / len(shown), -0.1, 1.05 / len(shown), 1.15)
            axes = figure.add_axes(box, projection="3d", computed_zorder=False)
            assert isinstance(axes, Axes3D)
            _frame(axes, shown)
            figure.text((k + 0.5) / len(shown), 0.9, style.plain(trace.case), ha="center", fontsize=9)
            links = axes.add_collection3d(Line3DCollection([], linewidths=1.0, zorder=1), autolim=False)
            designs = style.robot_lines(trace)
            trails = [axes.plot([], [], [], **{**design, "linewidth": 0.8, "zorder": 3})[0] for design in designs]
            dots = [axes.plot([], [], [], "o", ms=5, mec="none", color=design["color"])[0] for design in designs]
            few = len(trace.robots) <= style.MAX_COLOURED_ROBOTS
            halo = {"path_effects": style.HALO, "zorder": 7}
            names = [axes.text(0, 0, 0, name, fontsize=6, ha="center", **halo) for name in trace.robots if few]
            parts.append((trace, links, trails, dots, names, Measurement.of(trace).errors.error))
        if any(len(trace.robots) > style.MAX_COLOURED_ROBOTS for trace in shown):
            style.robot_legend(figure, shown)

    def show(t: float) -> None:
        clock.set_text(f"{t:.1f} s")
        for trace, links, trails, dots, names, error in parts:
            last = max(0, int(np.searchsorted(trace.time, t + 1e-9)) - 1)
            first = int(np.searchsorted(trace.time, t - TRAIL_S))
            place, net = trace.true_position, trace.plan.links
            links.set_segments(np.stack([place[last, net.sender], place[last, net.receiver]], axis=1))
            links.set_color(link_colours(error[last]) / 255.0)
            for row, (trail, dot) in enumerate(zip(trails, dots, strict=True)):
                trail.set_data_3d(*place[first : last + 1, row].T)
                dot.set_data_3d(*place[last, row, :, None])
            for name, at in zip(names, place[last], strict=False):
                name.set_position_3d(at + np.array([0.0, 0.0, 0.05]))

    return figure, show


def _ends(trace: Trace) -> tuple[Array, Array]:
    """First and last known position of each robot (N, 3) [m]."""
    place, rows = trace.true_position, np.arange(len(trace.robots))
    known = np.asarray(np.isfinite(place).all(axis=2))
    return place[known.argmax(axis=0), rows], place[len(known) - 1 - known[::-1].argmax(axis=0), rows]


def _draw_in_space(axes: Axes3D, trace: Trace, case: style.Line | None) -> None:
    """Paths of a case in space: in its style among several, or in those of its robots; the first case names them."""
    colour = None if case is None else case["color"]
    place, (starts, ends) = trace.true_position, _ends(trace)
    few_robots = len(trace.robots) <= style.MAX_COLOURED_ROBOTS
    if len(pairs := edges(trace.plan.links)):
        lines = Line3DCollection(ends[pairs], colors=colour or "#8a8a8a", linewidths=0.5, alpha=0.7, zorder=1)
        axes.add_collection3d(lines)
    few = slice(None, None, max(1, len(place) // 400))
    size = 3.0 if few_robots else 2.0
    named = not axes.texts
    for i, line in enumerate(style.robot_lines(trace)):
        ink = colour or line["color"]
        axes.plot(*place[few, i].T, **{**(line if case is None else case), "zorder": 3})
        axes.plot(*starts[i, :, None], "o", ms=size, mfc="none", mec=ink, mew=0.6, zorder=5)
        axes.plot(
            *ends[i, :, None], "o", ms=size + 0.5 + 1.5 * (named and bool(colour)), color=ink, mec="none", zorder=6
        )
        if few_robots and named:
            above = ends[i] + [0.0, 0.0, 0.05]
            axes.text(*above, trace.robots[i], fontsize=6, ha="center", va="bottom", zorder=7, path_effects=style.HALO)


def _frame(axes: Axes3D, traces: Sequence[Trace]) -> None:
    """Limits, arena and labels of the picture of some cases."""
    place = np.concatenate([trace.true_position.reshape(-1, 3) for trace in traces])
    known = np.isfinite(place).all(axis=1)
    plan = traces[0].plan
    low, high = place[known].min(axis=0), place[known].max(axis=0)
    low[:2], high[:2] = scenery.around(plan, low[:2], high[:2])
    low[2] = min(0.0, low[2])
    size = np.maximum(high - low, 0.4)
    middle = 0.5 * (low + high)
    ground = bool(low[2] > -0.1)
    low, high = middle - 0.54 * size, middle + 0.54 * size
    if ground:
        tallest = float(plan.scene.top.max(initial=0.0))  # height of the obstacles
        low[2], high[2] = 0.0, max(high[2], min(tallest, FLAT * float((high - low)[:2].max())))
    scenery.in_space(axes, plan, low, high)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    x, y, z = (high - low) / math.dist(high, low)
    wide, tall = 0.87 * x + 0.5 * y, 0.44 * (0.5 * x + 0.87 * y) + 0.9 * z  # seen from 26° above and 60° aside
    axes.set_box_aspect((x, y, z), zoom=min(0.94 / wide, 0.82 / tall))
    axes.view_init(26, -60)
    pad = -6 if z > FLAT else -3
    axes.set_xlabel("$x$ [m]", labelpad=pad, fontsize=8)
    axes.set_ylabel("$y$ [m]", labelpad=pad, fontsize=8)
    axes.set_zlabel("$z$ [m]", labelpad=pad - 1, fontsize=8)
    for axis, length in zip((axes.xaxis, axes.yaxis, axes.zaxis), (x, y, z), strict=True):
        axis.set_major_locator(MaxNLocator(max(1, round(5 * min(1.0, 2.5 * length)))))
        axis.pane.fill = False
        axis.pane.set_edgecolor("#9a9a9a")
        axis.pane.set_linewidth(0.4)
        axis._axinfo["grid"].update(linewidth=0.3, color="#c0c0c0")
    axes.tick_params(pad=-3.5, labelsize=6.5)
