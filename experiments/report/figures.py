"""The figures of a run, ready for print: one column of 3.5 in, 8 pt, colours that colour-blind readers tell apart.

They follow figures 12 to 16 of the paper. Functions that draw numbers take `CaseMetrics`, so that nothing is measured
twice; those that draw motions take traces, of one seed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Final, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch
from matplotlib.ticker import MaxNLocator, NullFormatter
from numpy.typing import NDArray

from agents.arrays import Array
from experiments.metrics.results import CaseMetrics, RobotMetrics
from experiments.metrics.shadow import differences, in_heading
from experiments.metrics.signals import formation_errors, leaders, phase_starts, transmission_gaps
from experiments.metrics.statistics import Spread, by_case, ratios, spread
from experiments.recording.trace import Trace
from experiments.report.style import (
    BARS,
    CASES,
    HATCHES,
    INK,
    MAGENTA,
    SHORTEST_S,
    WIDTH,
    Line,
    boxes,
    legend_above,
    mark_phases,
    merged,
    name_ticks,
    panel_height,
    plain,
    robot_legend,
    robot_lines,
    save,
    styled,
    svg,
    thinned,
    time_axis,
)
from experiments.report.trajectories import after, before, formation_after, formation_before, has_positions, plan_view

__all__ = ["formation_after", "formation_before", "plan_view", "save", "svg"]  # besides those of this module


def every(cases: Sequence[CaseMetrics], traces: Sequence[Trace]) -> dict[str, Figure]:
    """All figures of a run by name, in the order of the paper; motions of the first seed.

    Figures without content are left out: all without a trace; `formation_after` without a leg in the timeline, where
    it would show the same as `formation_before`; pictures of space where no position is known.
    """
    first = [trace for trace in first_seed(traces) if len(trace.time)]
    figures: dict[str, Figure] = {}
    if cases:
        figures["global_bars"] = global_bars(cases)
    if any(has_positions(trace, before(trace)) for trace in first):
        figures["formation_before"] = formation_before(first)
    if any(len(phase_starts(trace)) > 1 and has_positions(trace, after(trace)) for trace in first):
        figures["formation_after"] = formation_after(first)
    if cases:
        figures["robot_bars"] = robot_bars(cases)
    if first:
        figures["errors"], figures["events"] = errors(first), events(first)
        figures["intervals"] = intervals(first)
    if any(has_positions(trace) for trace in first):
        figures["plan_view"] = plan_view(first)
    return figures


@styled
def global_bars(cases: Sequence[CaseMetrics]) -> Figure:
    """Mean transmission rate and errors, over those of the first case (paper, figure 12).

    Cases of one name and several seeds become one bar, the mean of the ratios, with its 95 % confidence interval.
    """
    grouped = by_case(cases)
    first = next(iter(grouped.values()), [])
    figure = Figure(figsize=(WIDTH, 1.9 if len(grouped) <= 4 else 2.3), layout="constrained")
    axes = figure.subplots()
    width = 0.8 / max(1, len(grouped))
    tops = [1.0]
    for k, (name, runs) in enumerate(grouped.items()):
        found = [spread(ratios(runs, first, index)) for index, _, _ in BARS]
        x = np.arange(len(BARS)) + (k - 0.5 * (len(grouped) - 1)) * width
        height, error = _bars(axes, x, found, width=width, k=k, label=plain(name))
        for at, top, more in zip(x, height, error, strict=True):
            if math.isfinite(top):
                size = 6.0 if len(grouped) <= 3 else 5.0
                turned = 0 if len(grouped) <= 4 else 90
                axes.annotate(
                    f"{top:.2f}",
                    (at, top + more),
                    (0, 1.5),
                    textcoords="offset points",
                    ha="center",
                    va="bottom",
                    fontsize=size,
                    rotation=turned,
                )
                tops.append(top + more)
    axes.set_xticks(np.arange(len(BARS)), [label for _, label, _ in BARS])
    axes.tick_params(axis="x", length=0)
    axes.set_ylabel(f"relative to {plain(next(iter(grouped), ''))}")
    axes.set_ylim(0.0, 1.14 * max(tops))
    axes.grid(axis="y")
    legend_above(figure, axes.get_legend_handles_labels(), columns=3)
    return figure


@styled
def robot_bars(cases: Sequence[CaseMetrics]) -> Figure:
    """Transmission rate and errors of each robot (paper, figure 15); those that the means leave out in brackets."""
    grouped = by_case(cases)
    names = list(dict.fromkeys(robot.robot for case in cases for robot in case.robots))
    out = {name for case in cases for name in (*case.leaders, *case.died)}
    figure = Figure(figsize=(WIDTH, 4.3), layout="constrained")
    panels = figure.subplots(len(BARS), 1, sharex=True, squeeze=False)[:, 0]
    width = 0.8 / max(1, len(grouped))
    for axes, (index, label, unit) in zip(panels, BARS, strict=True):
        for k, (name, runs) in enumerate(grouped.items()):
            found = [spread([getattr(robot, index) for robot in _same(runs, name)]) for name in names]
            x = np.arange(len(names)) + (k - 0.5 * (len(grouped) - 1)) * width
            _bars(axes, x, found, width=width, k=k, label=plain(name))
        axes.set_ylabel(f"{label} [{unit}]")
        axes.tick_params(axis="x", length=0)
        axes.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
        axes.grid(axis="y")
    name_ticks(panels[-1], [f"({name})" if name in out else name for name in names])
    panels[-1].set_xlim(-0.6, len(names) - 0.4)
    figure.align_ylabels(list(panels))
    legend_above(figure, panels[0].get_legend_handles_labels(), columns=3)
    return figure


@styled
def errors(traces: Sequence[Trace]) -> Figure:
    """e_i(t) of each robot, one panel per case, legs of the timeline dashed (paper, figure 16)."""
    height = panel_height(len(traces), 1.35)
    figure = Figure(figsize=(WIDTH, height * len(traces) + 0.75), layout="constrained")
    panels = figure.subplots(len(traces), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for axes, trace in zip(panels, traces, strict=True):
        error, few = formation_errors(trace), thinned(trace, len(traces))
        for i, line in enumerate(robot_lines(trace)):
            axes.plot(trace.time[few], error[few, i], **line)
        mark_phases(axes, trace)
        axes.set_title(plain(trace.case), loc="right", pad=2.0)
        axes.grid()
    time_axis(panels[-1], traces)
    panels[-1].set_ylim(bottom=0.0)
    figure.supylabel("$e_i$ [m]", fontsize=8)
    robot_legend(figure, traces)
    return figure


@styled
def events(traces: Sequence[Trace]) -> Figure:
    """Transmissions: one row per robot, one panel per case; marks that would touch in print are one bar."""
    rows = max((len(trace.robots) for trace in traces), default=0)
    height = panel_height(len(traces), min(max(0.6, 0.13 * rows), 3.2))
    figure = Figure(figsize=(WIDTH, height * len(traces) + 0.5 + 0.14 * len(traces)), layout="constrained")
    panels = figure.subplots(len(traces), 1, sharex=True, squeeze=False)[:, 0]
    for axes, trace in zip(panels, traces, strict=True):
        colours = [line["color"] for line in robot_lines(trace)]
        columns = 900 if rows * len(traces) <= 40 else 450  # a printed column shows no more
        pixel = max(float(trace.time[-1] - trace.time[0]), SHORTEST_S) / columns
        for i in range(len(trace.robots)):
            begin, end = merged(np.sort(trace.sent_by(i).stamp), pixel)
            axes.add_patch(PathPatch(boxes(begin, end + pixel, i), facecolor=colours[i], linewidth=0.0))
        mark_phases(axes, trace)
        every = math.ceil(len(trace.robots) / max(1.0, height / 0.11))
        axes.set_yticks(range(0, len(trace.robots), every), trace.robots[::every], fontsize=6)
        axes.set_ylim(len(trace.robots) - 0.4, -0.6)
        axes.tick_params(axis="y", length=0)
        axes.set_title(plain(trace.case), loc="right", pad=2.0)
        axes.grid(axis="x")
    time_axis(panels[-1], traces)
    return figure


@styled
def intervals(traces: Sequence[Trace]) -> Figure:
    """Share of inter-event times up to a length: each robot thin, all robots but the leaders thick."""
    figure = Figure(figsize=(WIDTH, 2.2), layout="constrained")
    axes = figure.subplots()
    handles: dict[str, Line2D] = {}
    for k, trace in enumerate(traces):
        colour = CASES[k % len(CASES)]
        out = leaders(trace)
        waits = [
            wait
            for wait, name in zip(transmission_gaps(trace), trace.robots, strict=True)
            if name not in out and len(wait)
        ]
        for wait in waits if len(waits) > 1 else []:
            axes.plot(*_steps(wait), color=colour, linewidth=0.5, alpha=0.45, drawstyle="steps-post")
        if waits:
            line: Line = {"color": colour, "linewidth": 1.5, "linestyle": ("-", "--", "-.", ":")[k % 4]}
            axes.plot(*_steps(np.concatenate(waits)), drawstyle="steps-post", **line)
            handles.setdefault(plain(trace.case), Line2D([], [], **line))
    axes.set_xscale("log")
    axes.xaxis.set_minor_formatter(NullFormatter())
    if handles:
        low, high = (math.log10(limit) for limit in axes.dataLim.intervalx)
        axes.set_xlim(10.0 ** math.floor(low), 10.0 ** max(math.ceil(high), math.floor(low) + 1))
    axes.set_ylim(0.0, 1.02)
    axes.set_xlabel("time between transmissions [s]")
    axes.set_ylabel("share of intervals")
    axes.grid()
    legend_above(figure, (list(handles.values()), list(handles)), columns=3)
    return figure


def _same(runs: Iterable[CaseMetrics], name: str) -> list[RobotMetrics]:
    return [robot for run in runs for robot in run.robots if robot.robot == name]


def _bars(
    axes: Axes, x: NDArray[np.floating], found: Sequence[Spread], *, width: float, k: int, label: str
) -> tuple[list[float], list[float]]:
    """Bars of means with their confidence intervals; returns both."""
    height = [np.nan if each.mean is None else each.mean for each in found]
    error = [each.ci95 or 0.0 for each in found]
    colour = CASES[k % len(CASES)]
    light = tuple(0.45 + 0.55 * part for part in to_rgb(colour))  # hatches must show, also in grey print
    axes.bar(
        x,
        height,
        0.9 * width,
        label=label,
        color=colour if k == 0 else light,
        edgecolor=colour,
        hatch=HATCHES[k % len(HATCHES)],
        linewidth=0.5,
    )
    if any(error):
        axes.errorbar(x, height, error, fmt="none", ecolor=INK, elinewidth=0.7, capsize=1.5, capthick=0.7)
    return height, error


def first_seed(traces: Sequence[Trace]) -> list[Trace]:
    """The first trace of each case."""
    return list({trace.case: trace for trace in reversed(traces)}.values())[::-1]


def _steps(waits: Array) -> tuple[Array, Array]:
    """The empirical distribution, thinned to what a column can show."""
    x = np.sort(np.maximum(waits, 1e-4))
    share = np.arange(1, len(x) + 1) / len(x)
    few = np.unique(np.linspace(0, len(x) - 1, 300).round().astype(int))
    return np.concatenate([x[:1], x[few]]), np.concatenate([[0.0], share[few]])


Style = Literal["-", "--", ":"]

MOST: Final = 8  # robots whose twins are drawn: a page holds no more
PARTS: Final[tuple[tuple[str, str, Style], ...]] = (
    ("along", CASES[0], "-"),
    ("to the left", CASES[1], "--"),
    ("up", CASES[2], ":"),
)


def shadow_figures(traces: Sequence[Trace]) -> dict[str, Figure]:
    """The figures of twins beside robots by name; nothing where there are none."""
    return {"shadows": shadows(traces)} if any(map(_rows, traces)) else {}


@styled
def shadows(traces: Sequence[Trace]) -> Figure:
    """Each robot with its twin: the paths from above, and the difference over time, of the first few."""
    shown = [(trace, row) for trace in traces for row in _rows(trace)][:MOST]
    height = panel_height(len(shown), 1.15)
    figure = Figure(figsize=(WIDTH, height * len(shown) + 0.8), layout="constrained")
    panels = figure.subplots(len(shown), 2, squeeze=False, width_ratios=(1.0, 1.7))
    several = len(traces) > 1
    for (above, beside), (trace, row) in zip(panels, shown, strict=True):
        name = plain(trace.robots[row])
        _paths(above, trace, row, len(shown))
        above.set_title(f"{name}, {plain(trace.case)}" if several else name, loc="left", pad=2.0)
        _differences(beside, trace, row, len(shown))
    panels[-1, 0].set_xlabel("$x$ [m]")
    panels[-1, 1].set_xlabel("$t$ [s]")
    lines = [Line2D([], [], color=INK), Line2D([], [], color=MAGENTA, linestyle="--")]
    lines += [Line2D([], [], color=colour, linestyle=style) for _, colour, style in PARTS]
    legend_above(figure, (lines, ["robot", "twin", *(label for label, *_ in PARTS)]), columns=5)
    return figure


def _rows(trace: Trace) -> list[int]:
    """Robots with a shadow twin of known position."""
    return np.flatnonzero(np.isfinite(differences(trace)).all(axis=2).any(axis=0)).tolist()


def _paths(axes: Axes, trace: Trace, row: int, panels: int) -> None:
    few = thinned(trace, panels)
    assert trace.shadow_position is not None
    axes.plot(*trace.position[few, row, :2].T, color=INK, linewidth=0.9)
    axes.plot(*trace.shadow_position[few, row, :2].T, color=MAGENTA, linewidth=0.7, linestyle="--")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_ylabel("$y$ [m]")
    axes.xaxis.set_major_locator(MaxNLocator(3))
    axes.yaxis.set_major_locator(MaxNLocator(3))


def _differences(axes: Axes, trace: Trace, row: int, panels: int) -> None:
    difference = differences(trace)
    along, across = in_heading(trace, difference)
    few = thinned(trace, panels)
    for values, (_, colour, style) in zip((along, across, difference[..., 2]), PARTS, strict=True):
        axes.plot(trace.time[few], 100.0 * values[few, row], color=colour, linestyle=style, linewidth=0.7)
    mark_phases(axes, trace)
    axes.set_ylabel("twin − robot [cm]")
    begin = float(trace.time[0])
    axes.set_xlim(begin, max(float(trace.time[-1]), begin + SHORTEST_S))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.grid()
