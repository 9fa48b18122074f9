"""The figures of a run, ready for print: one column of 3.5 in, 8 pt, colours that colour-blind readers tell apart.

They follow figures 12 to 16 of the paper. Functions that draw numbers take `CaseMetrics`, so that nothing is measured
twice; those that draw motions take traces, of one seed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, Literal

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from experiments.metrics.metric import ERRORS, FORMULA, known_metrics, measures_of
from experiments.metrics.results import CaseMetrics
from experiments.metrics.shadow import differences, in_heading
from experiments.metrics.signals import Measurement, largest
from experiments.metrics.statistics import Spread, by_case, first_seed, ratios, spread
from experiments.recording.trace import Trace
from experiments.report import style
from experiments.report.metrics_files import BANDS, Band, read_bands, write_bands
from experiments.report.trajectories import LOW, formation, has_positions, plan_view
from twins.arrays import Array

BAND: Final = "#009E73"  # the tolerance
LEAST_ERROR: Final = 1e-5  # [m] least end of an error axis
WIDE: Final = 8.0  # rates farther apart are drawn on a logarithmic axis
SHORT: Final = 10  # letters of a name that stands behind other words on an axis
LONGEST: Final = 20  # letters of a name on an axis
LONGEST_TITLE: Final = 50  # letters of a name above a panel
MOST_VALUES: Final = 12  # cases that have their values above their bars
MOST_PANELS: Final = 16  # cases of a page, each with a panel
MOST_SEEDS: Final = 50  # seeds of a case, for the range of its errors
MOST_MEASURES: Final = 6  # measures of a law, each with a panel
SOLID: Final = 0.95  # share of the time that marks cover where there is nothing to see between them


def all_figures(
    cases: Sequence[CaseMetrics],
    traces: Sequence[Trace],
    width: float = style.WIDTH,
    bands: Mapping[str, Band] | None = None,
) -> dict[str, Figure]:
    """All figures of a run by name; motions of the first seed, `errors` of all seeds.

    Figures without content are left out: all without a trace; ratios of a single case; errors of links without
    targets. Pictures of space need known positions, and in perspective robots above the floor.

    Args:
        cases, traces: The run; several seeds of a case have one name.
        bands: Of `errors`, where traces of most seeds are not known.
    """
    known = [trace for trace in traces if len(trace.time)]
    first = first_seed(known)
    figures: dict[str, Figure] = {}
    if any(has_positions(trace) for trace in first):
        figures["plan_view"] = plan_view(first, width)
        if any((trace.true_position[..., 2] > LOW).any() for trace in first):
            figures["formation"] = formation(first, width)
    judged = [trace for trace in known if Measurement.of(trace).has_errors]
    if judged:
        figures["errors"] = errors(judged, cases, width, bands)
    if any(trace.measures for trace in first):
        figures["measures"] = measures(first, width)
    if (len(by_case(cases)) - 1) * len(_bar_metrics(cases)) > 1:  # a single bar says no more than its number
        figures["global_bars"] = global_bars(cases, width)
    if cases:
        figures["robot_bars"] = robot_bars(cases, width)
    if first:
        figures["events"], figures["intervals"] = events(first, width), intervals(first, width)
    if any(map(_rows, first)):
        figures["shadows"] = shadows(first, width)
    return figures


def known_bands(traces: Sequence[Trace], seeds: int, folder: Path) -> dict[str, Band]:
    """`error_bands` of all seeds; where most are not recorded, as their run has left them in its folder of figures."""
    recorded = len({trace.seed for trace in traces}) == seeds
    return ({} if recorded else read_bands(folder / BANDS)) or error_bands(traces)


def draw(
    folder: Path,
    cases: Sequence[CaseMetrics],
    traces: Sequence[Trace],
    bands: Mapping[str, Band],
    width: float,
    *,
    pdf: bool,
) -> dict[str, str]:
    """Draws all figures into a folder, and returns the SVG of each; bands over several seeds stand there as a table."""
    over_seeds = max(band.seeds for band in bands.values()) > 1
    of_one = len({case.seed for case in cases}) > 1 and not over_seeds  # a file that is there already is of all seeds
    found = {
        name: style.svg(figure) if of_one and name == "errors" else style.save(figure, folder, name, pdf=pdf)
        for name, figure in all_figures(cases, traces, width, bands).items()
    }
    if over_seeds:
        write_bands(folder / BANDS, bands)
    return found


@style.styled
def global_bars(cases: Sequence[CaseMetrics], width: float = style.WIDTH) -> Figure:
    """Mean transmission rate, and in an axis of their own mean errors, over those of the first case (paper, figure 12).

    Cases of one name and several seeds become one bar, the mean of the ratios, with its 95 % confidence interval; the
    first case is the line at 1.
    """
    grouped = by_case(cases)
    (reference, first), *others = grouped.items()
    figure = style.Drawing(figsize=(width, 1.9 if len(others) <= 4 else 2.3), layout="constrained")
    bars = _bar_metrics(cases)
    parts = [part for part in (bars[:1], bars[1:]) if part]
    panels = figure.subplots(1, len(parts), width_ratios=[len(part) for part in parts], squeeze=False)[0]
    share = min(0.8 / max(1, len(others)), 0.5)
    text: style.Line = {"textcoords": "offset points", "fontsize": 6.0 if len(others) <= 3 else 5.0}
    text["rotation"] = 0 if len(others) <= 2 else 90
    for axes, indices in zip(panels, parts, strict=True):
        tops = [0.0]
        for k, (name, runs) in enumerate(others):
            found = [spread(ratios(runs, first, index)) for index, _, _ in indices]
            x = np.arange(len(indices)) + (k - 0.5 * (len(others) - 1)) * share
            height, error = _bars(axes, x, found, width=share, k=k + 1, label=style.plain(name))
            for at, top, more in zip(x, height, error, strict=True):
                if math.isfinite(top):
                    tops.append(top + more)
                if math.isfinite(top) and len(others) <= MOST_VALUES:
                    axes.annotate(f"{top:.3f}", (at, tops[-1]), (0, 1.5), ha="center", va="bottom", **text)
        axes.set_xticks(np.arange(len(indices)), [label for _, label, _ in indices])
        axes.set_xlim(-0.5, len(indices) - 0.5)
        axes.tick_params(axis="x", length=0)
        axes.set_ylim(0.0, (1.14 if len(others) <= 2 else 1.3) * (max(tops) or 1.0))
        if axes.get_ylim()[1] > 1.0:
            axes.axhline(1.0, color=style.INK, linewidth=0.6, linestyle=(0, (4, 3)), zorder=0.5)
        axes.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]))
        axes.grid(axis="y")
    between = "\n" if len(reference) > SHORT else " "
    panels[0].set_ylabel(f"relative to{between}{style.shortened(reference, LONGEST)}")
    style.legend_above(figure, style.labelled(panels[-1]), columns=3)
    return figure


def _bar_metrics(cases: Sequence[CaseMetrics]) -> list[tuple[str, str, str]]:
    """Metrics drawn as bars: name, label and unit as matplotlib writes them; errors only of links with targets."""
    judged = any(case.has_errors for case in cases)
    found = []
    for name, metric in known_metrics(cases).items():
        if metric.figure and (judged or name not in ERRORS):
            label = f"${metric.label}$" if len(metric.label) == 1 else style.plain(metric.label)
            found.append((name, label, metric.unit.translate(FORMULA)))
    return found


@style.styled
def robot_bars(cases: Sequence[CaseMetrics], width: float = style.WIDTH) -> Figure:
    """Transmission rate and errors of each robot (paper, figure 15); those that the means leave out in brackets."""
    grouped = by_case(cases)
    names = list(dict.fromkeys(robot.robot for case in cases for robot in case.robots))
    out = {name for case in cases for name in (*case.leaders, *case.died)}
    bars = [each for each in _bar_metrics(cases) if known_metrics(cases)[each[0]].per == "robot"]
    figure = style.Drawing(figsize=(width, min(1.075 * len(bars), style.TALLEST)), layout="constrained")
    panels = figure.subplots(len(bars), 1, sharex=True, squeeze=False)[:, 0]
    share = 0.8 / max(1, len(grouped))
    for axes, (index, label, unit) in zip(panels, bars, strict=True):
        known = [value for case in cases for robot in case.robots if (value := robot.value(index))]
        wide = index == "f_hz" and bool(known) and max(known) > WIDE * min(known)
        for k, (name, runs) in enumerate(grouped.items()):
            robots = [robot for run in runs for robot in run.robots]
            found = [spread([each.value(index) for each in robots if each.robot == name]) for name in names]
            x = np.arange(len(names)) + (k - 0.5 * (len(grouped) - 1)) * share
            if wide:
                _points(axes, x, found, k=k)
            else:
                _bars(axes, x, found, width=share, k=k, label=style.plain(name))
        axes.set_ylabel(f"{label} [{unit}]" if unit else label)
        axes.tick_params(axis="x", length=0)
        if wide:  # beside fifty messages a second two are seen on a logarithmic axis alone, which has no zero for bars
            axes.set_yscale("log")
            axes.set_ylim(0.5 * min(known), 1.3 * max(known))
            axes.yaxis.set_major_locator(LogLocator(10.0, (1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter(style.in_full())
            axes.yaxis.set_minor_formatter(NullFormatter())
        else:
            axes.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
        axes.grid(axis="y")
    words = [f"({name})" if name in out else name for name in names]
    crowd = len(names) / style.MAX_COLOURED_ROBOTS
    upright, size = 90 if crowd > 1.0 else 0, 6.5 if crowd <= 2.0 else 5.0
    panels[-1].set_xticks(range(len(names)), words, rotation=upright, fontsize=size)
    panels[-1].set_xlim(-0.6, len(names) - 0.4)
    figure.align_ylabels(list(panels))
    style.legend_above(figure, style.labelled(panels[-1]), columns=3)
    return figure


@style.styled
def errors(
    traces: Sequence[Trace],
    cases: Sequence[CaseMetrics] = (),
    width: float = style.WIDTH,
    bands: Mapping[str, Band] | None = None,
) -> Figure:
    """Worst link of the formation and of each robot over time, as acquisition is judged, on a logarithmic axis.

    All cases in one axis; the tolerance is a band, the acquisition by all followers a marker; legs of the timeline are
    dashed (paper, figure 16, there Σ over the links on a linear axis). Of several seeds the median and the range.

    Args:
        cases: Where acquisitions are taken from; no markers if left out.
        bands: Medians and ranges; `error_bands` of the traces if left out.
    """
    figure = style.Drawing(figsize=(width, min(0.5 * width + 0.75, 3.2)), layout="constrained")
    axes = figure.subplots()
    first = {trace.case: trace for trace in first_seed(traces)}
    handles: dict[str, Artist] = {}
    lowest, highest = np.inf, 0.0
    tolerance = traces[0].plan.experiment.tolerance
    for k, (name, band) in enumerate((bands or error_bands(traces)).items()):
        line = style.case_curve(k)
        if band.seeds > 1:
            axes.fill_between(band.time, band.low, band.high, color=line["color"], alpha=0.25, linewidth=0.0)
        elif name in first:
            few = style.thinned(first[name], 1)
            for robot in Measurement.of(first[name]).worst_links[few].T:
                axes.plot(band.time, robot, color=line["color"], linewidth=0.4, alpha=0.45)
        axes.plot(band.time, band.middle, **line, linewidth=1.3, zorder=3)
        handles[style.plain(name)] = Line2D([], [], **line, linewidth=1.3)
        known = band.middle[np.isfinite(band.middle) & (band.middle > 0.0)]
        lowest = min(lowest, float(known.min(initial=np.inf)))
        highest = max(highest, float(np.nanmax(band.high, initial=0.0)))
        at = _acquisitions([case for case in cases if case.case == name])
        size = max(2.5, 7.5 - 2.5 * k)  # those of several cases at one time are seen on each other
        axes.plot(at, [tolerance] * len(at), "v", color=line["color"], ms=size, mec=style.PAPER, mew=0.5, zorder=4)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(style.in_full())
    axes.yaxis.set_minor_formatter(NullFormatter())
    bottom = 10.0 ** math.floor(math.log10(min(max(lowest, LEAST_ERROR), 0.1 * tolerance)))
    axes.set_ylim(bottom, max(1.6 * highest, 4.0 * tolerance))
    axes.axhspan(bottom, tolerance, color=BAND, alpha=0.16, linewidth=0.0, zorder=0.2)
    axes.axhline(tolerance, color=BAND, linewidth=0.6, zorder=0.3)
    handles[f"within {100.0 * tolerance:g} cm"] = Patch(color=BAND, alpha=0.3, linewidth=0.0)
    if any(value is not None for case in cases for value in case.acquired_s):
        handles["acquired by all"] = Line2D([], [], color=to_rgb(style.INK), marker="v", linestyle="", ms=4.0)
    style.mark_phases(axes, traces[0])
    axes.grid()
    style.time_axis(axes, traces)
    axes.set_ylabel("error of the worst link [m]")
    style.legend_above(figure, handles, columns=6)
    return figure


@style.styled
def measures(traces: Sequence[Trace], width: float = style.WIDTH) -> Figure:
    """Measures of laws that remember, over time: a panel each, the median of the robots thick, single ones thin."""
    names = [*dict.fromkeys(name for trace in traces for name in trace.measures)][:MOST_MEASURES]
    units = {name: each.unit for trace in traces for name, each in measures_of(trace).items()}
    height = style.panel_height(len(names), 1.3)
    figure = style.Drawing(figsize=(width, height * len(names) + 0.7), layout="constrained")
    panels = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    handles: dict[str, Artist] = {}
    for axes, name in zip(panels, names, strict=True):
        for k, trace in enumerate(traces):
            if name not in trace.measures:
                continue
            line = style.case_curve(k)
            few = style.thinned(trace, len(names) * len(traces))
            values = trace.measures[name][few]
            axes.plot(trace.time[few], values, color=line["color"], linewidth=0.4, alpha=0.45)
            known = np.isfinite(values).any(axis=1)
            axes.plot(trace.time[few][known], np.nanmedian(values[known], axis=1), **line, linewidth=1.3, zorder=3)
            handles[style.plain(trace.case)] = Line2D([], [], **line, linewidth=1.3)
        style.mark_phases(axes, traces[0])
        axes.grid()
        axes.set_ylabel(style.plain(f"{name} [{units[name]}]" if units.get(name) else name))
        axes.yaxis.set_major_locator(MaxNLocator(4))
    style.time_axis(panels[-1], traces)
    figure.align_ylabels(list(panels))
    style.legend_above(figure, handles, columns=6)
    return figure


def error_bands(traces: Sequence[Trace]) -> dict[str, Band]:
    """Median and range over the seeds of the error of the worst link of each case, thinned for print.

    Args:
        traces: Of all seeds; the first `MOST_SEEDS` of each case count.
    """
    grouped: dict[str, list[Trace]] = {}
    for trace in traces:
        grouped.setdefault(trace.case, []).append(trace)
    found = {}
    for name, runs in grouped.items():
        few = style.thinned(runs[0], 1)
        robots = [Measurement.of(trace).worst_links[few] for trace in runs[:MOST_SEEDS]]
        length = min(map(len, robots))
        worst = np.stack([largest(each[:length]) for each in robots])
        time, middle = runs[0].time[few][:length], np.median(worst, axis=0)
        found[name] = Band(len(robots), time, middle, worst.min(axis=0), worst.max(axis=0))
    return found


def _acquisitions(runs: Sequence[CaseMetrics]) -> list[float]:
    """Times of acquisition by all followers in each phase, mean over seeds that acquired [s since the common start]."""
    found = []
    longest = sorted((run.starts_s for run in runs), key=len)[-1:]
    for k, start in enumerate(longest[0] if longest else ()):
        mean = spread([run.acquired_s[k] for run in runs if k < len(run.acquired_s)]).mean
        found += [] if mean is None else [start + mean]
    return found


@style.styled
def events(traces: Sequence[Trace], width: float = style.WIDTH) -> Figure:
    """Transmissions: one row per robot, one panel per case; marks that would touch in print are one bar.

    A case in which all of them touch (a periodic one) is a line of text. Cases beyond a page are left out.
    """
    rows = max((len(trace.robots) for trace in traces), default=0)
    columns = 900 if rows * len(traces) <= 40 else 450  # a printed column shows no more
    marks = [_marks(trace, columns) for trace in traces]
    solid = [_solid(trace, each) for trace, each in zip(traces, marks, strict=True)]
    hidden = max(0, len(traces) - MOST_PANELS)
    traces, marks, solid = traces[:MOST_PANELS], marks[:MOST_PANELS], solid[:MOST_PANELS]
    drawn = [trace for trace, text in zip(traces, solid, strict=True) if not text]
    height = min(max(0.6, 0.13 * rows), style.panel_height(len(drawn), 3.34) - 0.14)
    heights = [0.02 if text else height for text in solid]
    whole = sum(0.26 if text else height + 0.14 for text in solid) + 0.5
    figure = style.Drawing(figsize=(width, max(whole, 1.1)), layout="constrained")
    grid = figure.subplots(len(traces), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    for axes, trace, mark, text in zip(grid, traces, marks, solid, strict=True):
        if text:
            axes.set_title(text, loc="left", pad=2.0)
            axes.spines[:].set_visible(False)
            axes.tick_params(left=False, bottom=False, labelleft=False, labelbottom=False)
            continue
        colours = [line["color"] for line in style.robot_lines(trace)]
        for i, (begin, end) in enumerate(mark):
            # no patch, for the limits are known: to ask each of a million boxes for its own takes as long as all else
            axes.add_artist(PathPatch(style.boxes(begin, end, i), facecolor=colours[i], linewidth=0.0))
        style.mark_phases(axes, trace)
        every = math.ceil(len(trace.robots) / max(1.0, height / 0.11))
        axes.set_yticks(range(0, len(trace.robots), every), trace.robots[::every], fontsize=6)
        axes.set_ylim(len(trace.robots) - 0.4, -0.6)
        axes.tick_params(axis="y", length=0)
        axes.set_title(style.shortened(trace.case, LONGEST_TITLE), loc="right", pad=2.0)
        axes.grid(axis="x")
    if hidden:
        figure.supxlabel(style.beyond(hidden), fontsize=7)
    if drawn:
        last = max(k for k, text in enumerate(solid) if not text)
        style.time_axis(grid[last], traces)
        grid[last].tick_params(labelbottom=True)
    return figure


def _marks(trace: Trace, columns: int) -> list[tuple[Array, Array]]:
    """Beginnings and ends [s] of the marks of each robot, in a picture of `columns` columns."""
    pixel = max(float(trace.time[-1] - trace.time[0]), style.SHORTEST_S) / columns
    pairs = [style.merged(np.sort(own), pixel) for own in trace.sent_at]
    return [(begin, end + pixel) for begin, end in pairs]


def _solid(trace: Trace, marks: Sequence[tuple[Array, Array]]) -> str:
    """Caption of a case if all its marks touch; otherwise empty."""
    span = max(float(trace.time[-1] - trace.time[0]), style.SHORTEST_S)
    if not marks or any((end - begin).sum() < SOLID * span for begin, end in marks):
        return ""
    rates = [len(own) / span for own in trace.sent_at]
    low, high = f"{min(rates):.3g}", f"{max(rates):.3g}"
    rate = low if low == high else f"{low} to {high}"
    return f"{style.shortened(trace.case, LONGEST)}: every robot throughout, {rate} Hz"


@style.styled
def intervals(traces: Sequence[Trace], width: float = style.WIDTH) -> Figure:
    """Share of inter-event times up to a length: each robot thin, all robots but the leaders thick."""
    figure = style.Drawing(figsize=(width, 2.2), layout="constrained")
    axes = figure.subplots()
    handles: dict[str, Line2D] = {}
    for k, trace in enumerate(traces):
        colour = style.CASES[k % len(style.CASES)]
        shared = Measurement.of(trace)
        named = zip(shared.gaps_between, trace.robots, strict=True)
        gaps = [wait for wait, name in named if name not in shared.leaders and len(wait)]
        for wait in gaps if len(gaps) > 1 else []:
            axes.plot(*_steps(wait), color=colour, linewidth=0.5, alpha=0.45, drawstyle="steps-post")
        if gaps:
            line: style.Line = {"color": colour, "linewidth": 1.5, "linestyle": ("-", "--", "-.", ":")[k % 4]}
            axes.plot(*_steps(np.concatenate(gaps)), drawstyle="steps-post", **line)
            handles.setdefault(style.plain(trace.case), Line2D([], [], **line))
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(style.in_full())
    axes.xaxis.set_minor_formatter(NullFormatter())
    if handles:
        low, high = (math.log10(limit) for limit in axes.dataLim.intervalx)
        axes.set_xlim(10.0 ** math.floor(low), 10.0 ** max(math.ceil(high), math.floor(low) + 1))
    axes.set_ylim(0.0, 1.02)
    axes.set_xlabel("time between transmissions [s]")
    axes.set_ylabel("share of intervals")
    axes.grid()
    style.legend_above(figure, handles, columns=3)
    return figure


def _bars(
    axes: Axes, x: NDArray[np.floating], found: Sequence[Spread], *, width: float, k: int, label: str
) -> tuple[list[float], list[float]]:
    """Bars of means with their confidence intervals; returns both."""
    height = [np.nan if each.mean is None else each.mean for each in found]
    error = [each.ci95 or 0.0 for each in found]
    colour = style.CASES[k % len(style.CASES)]
    light = tuple(0.45 + 0.55 * part for part in to_rgb(colour))  # hatches must show, also in grey print
    design: style.Line = {
        "color": colour if k == 0 else light,
        "hatch": style.HATCHES[k % len(style.HATCHES)],
        "linewidth": 0.5,
    }
    axes.bar(x, height, 0.9 * width, label=label, edgecolor=colour, **design)
    if any(error):
        axes.errorbar(x, height, error, fmt="none", ecolor=style.INK, elinewidth=0.7, capsize=1.5, capthick=0.7)
    return height, error


def _points(axes: Axes, x: NDArray[np.floating], found: Sequence[Spread], *, k: int) -> None:
    """Means as points with their confidence intervals; those of zero are written at the lower edge."""
    colour = style.CASES[k % len(style.CASES)]
    for at, each in zip(x, found, strict=True):
        if each.mean:
            design: style.Line = {
                "color": colour,
                "marker": style.MARKERS[k % len(style.MARKERS)],
                "markersize": 3.5,
                "linestyle": "",
            }
            axes.errorbar(at, each.mean, each.ci95 or 0.0, elinewidth=0.7, capsize=1.5, capthick=0.7, **design)
        elif each.mean is not None:
            edge: style.Line = {"xycoords": ("data", "axes fraction"), "ha": "center", "va": "bottom"}
            axes.annotate("0", (at, 0.02), fontsize=6, color=colour, **edge)


def _steps(gaps: Array) -> tuple[Array, Array]:
    """The empirical distribution, thinned to what a column can show."""
    x = np.sort(np.maximum(gaps, 1e-4))
    share = np.arange(1, len(x) + 1) / len(x)
    few = np.unique(np.linspace(0, len(x) - 1, 300).round().astype(int))
    return np.concatenate([x[:1], x[few]]), np.concatenate([[0.0], share[few]])


Style = Literal["-", "--", ":"]

MOST_SHADOWS: Final = 8  # robots with drawn twins: a page holds no more
PARTS: Final[tuple[tuple[str, str, Style], ...]] = (
    ("along", style.CASES[0], "-"),
    ("to the left", style.CASES[1], "--"),
    ("up", style.CASES[2], ":"),
)


@style.styled
def shadows(traces: Sequence[Trace], width: float = style.WIDTH) -> Figure:
    """Each robot with its twin: the paths from above, and the difference over time, of the first few."""
    shown = [(trace, row) for trace in traces for row in _rows(trace)][:MOST_SHADOWS]
    height = style.panel_height(len(shown), 1.15)
    figure = style.Drawing(figsize=(width, height * len(shown) + 0.8), layout="constrained")
    panels = figure.subplots(len(shown), 2, squeeze=False, width_ratios=(1.0, 1.7))
    several = len(traces) > 1
    for (above, beside), (trace, row) in zip(panels, shown, strict=True):
        name = style.plain(trace.robots[row])
        _paths(above, trace, row, len(shown))
        above.set_title(f"{name}, {style.plain(trace.case)}" if several else name, loc="left", pad=2.0)
        _differences(beside, trace, row, len(shown))
    panels[-1, 0].set_xlabel("$x$ [m]")
    panels[-1, 1].set_xlabel("$t$ [s]")
    lines = {"robot": Line2D([], [], color=style.INK), "twin": Line2D([], [], color=style.MAGENTA, linestyle="--")}
    lines |= {label: Line2D([], [], color=colour, linestyle=design) for label, colour, design in PARTS}
    style.legend_above(figure, lines, columns=5)
    return figure


def _rows(trace: Trace) -> list[int]:
    """Robots with a shadow twin of known position."""
    return np.flatnonzero(np.isfinite(differences(trace)).all(axis=2).any(axis=0)).tolist()


def _paths(axes: Axes, trace: Trace, row: int, panels: int) -> None:
    few = style.thinned(trace, panels)
    assert trace.shadow_position is not None
    axes.plot(*trace.position[few, row, :2].T, color=style.INK, linewidth=0.9)
    axes.plot(*trace.shadow_position[few, row, :2].T, color=style.MAGENTA, linewidth=0.7, linestyle="--")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_ylabel("$y$ [m]")
    axes.xaxis.set_major_locator(MaxNLocator(3))
    axes.yaxis.set_major_locator(MaxNLocator(3))


def _differences(axes: Axes, trace: Trace, row: int, panels: int) -> None:
    difference = differences(trace)
    along, across = in_heading(trace, difference)
    few = style.thinned(trace, panels)
    for values, (_, colour, design) in zip((along, across, difference[..., 2]), PARTS, strict=True):
        axes.plot(trace.time[few], 100.0 * values[few, row], color=colour, linestyle=design, linewidth=0.7)
    style.mark_phases(axes, trace)
    axes.set_ylabel("twin − robot [cm]")
    begin = float(trace.time[0])
    axes.set_xlim(begin, max(float(trace.time[-1]), begin + style.SHORTEST_S))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.grid()
