"""The figures of a run, ready for print: one column of 3.5 in, 8 pt, colours that colour-blind readers tell apart.

They follow figures 12 to 16 of the paper. `Figure` is used without pyplot, so that nothing is global; the style is set
around drawing and around saving.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import wraps
from pathlib import Path
from typing import Any, Final, ParamSpec

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from agents.rows import Array
from experiments.metrics import CaseMetrics, RobotMetrics, ratio, spread
from experiments.signals import formation_errors, gaps, leaders, links_of, phase_starts
from experiments.trace import Trace

P = ParamSpec("P")

WIDTH: Final = 3.5  # [in] one column
TALLEST: Final = 8.8  # [in] one page
POINTS: Final = 1500  # of a curve; more than a printed column can show
INK: Final = "#000000"
PAPER: Final = "#ffffff"
MAGENTA: Final = "#D6007F"
# Okabe and Ito; yellow is left out because it vanishes on white paper
CASES: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
HATCHES: Final = ("", "////", "....", "xxxx", "\\\\\\\\", "----", "++++")
ROBOTS: Final = ("#000000", "#E69F00", "#56B4E9", "#009E73", "#0072B2", "#D55E00", "#CC79A7")
KINDS: Final = {"turtlebot3": "#000000", "khepera4": "#009E73", "crazyflie": "#0072B2", "tello": "#D55E00"}
MANY: Final = 8  # robots that have a colour each; more are coloured by kind
BARS: Final = (("f_hz", "$f$", "Hz"), ("iae", "IAE", "m s"), ("itae", "ITAE", "m s$^2$"), ("rmse", "RMSE", "m"))

STYLE: Final[Mapping[str, Any]] = {
    "font.family": "serif",
    "font.serif": ["STIXGeneral", "DejaVu Serif"],  # both come with matplotlib: the same picture on every machine
    "mathtext.fontset": "stix",
    "font.size": 8,
    "axes.labelsize": 8,
    "axes.titlesize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "legend.handlelength": 1.4,
    "legend.columnspacing": 1.0,
    "legend.borderaxespad": 0.2,
    "legend.handletextpad": 0.5,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.linewidth": 0.4,
    "grid.color": "#9a9a9a",
    "grid.alpha": 0.35,
    "lines.linewidth": 1.0,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "hatch.linewidth": 0.5,
    "figure.dpi": 100,
    "savefig.dpi": 300,
    "savefig.transparent": True,
    "pdf.fonttype": 42,
    "svg.fonttype": "path",
    "svg.hashsalt": "zenpark",  # the same figure gives the same bytes
}


def _styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with mpl.rc_context(dict(STYLE)):
            return draw(*args, **kwargs)

    return drawn


def save(figure: Figure, folder: Path, name: str) -> tuple[Path, Path]:
    """Writes `<name>.svg` and `<name>.pdf` into the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    drawing, page = folder / f"{name}.svg", folder / f"{name}.pdf"
    drawing.write_text(svg(figure), encoding="utf-8")
    with mpl.rc_context(dict(STYLE)):
        figure.savefig(page, metadata={"CreationDate": None})
    return drawing, page


def svg(figure: Figure) -> str:
    """The figure as SVG, without metadata, so that it holds no date and no address."""
    text = io.StringIO()
    with mpl.rc_context(dict(STYLE)):
        figure.savefig(text, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    return text.getvalue()


@_styled
def global_bars(cases: Sequence[CaseMetrics]) -> Figure:
    """Mean transmission rate and errors, over those of the first case (paper, figure 12).

    Cases of one name and several seeds become one bar, the mean of the ratios, with its 95 % confidence interval.
    """
    grouped = _by_case(cases)
    first = next(iter(grouped.values()), [])
    figure = Figure(figsize=(WIDTH, 1.9 if len(grouped) <= 4 else 2.3), layout="constrained")
    axes = figure.subplots()
    width = 0.8 / max(1, len(grouped))
    tops = [1.0]
    for k, (name, runs) in enumerate(grouped.items()):
        found = [spread(ratios(runs, first, index)) for index, _, _ in BARS]
        height = [float(each["mean"]) if each["mean"] is not None else np.nan for each in found]
        error = [float(each["ci95"]) if each["ci95"] is not None else 0.0 for each in found]
        x = np.arange(len(BARS)) + (k - 0.5 * (len(grouped) - 1)) * width
        _bars(axes, x, height, error, width, k, name)
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
    axes.set_ylabel(f"relative to {next(iter(grouped), '')}")
    axes.set_ylim(0.0, 1.14 * max(tops))
    axes.grid(axis="y")
    _legend_above(figure, axes.get_legend_handles_labels(), columns=3)
    return figure


@_styled
def robot_bars(cases: Sequence[CaseMetrics]) -> Figure:
    """Transmission rate and errors of each robot (paper, figure 15); leaders, which the means leave out, in brackets."""
    grouped = _by_case(cases)
    names = list(dict.fromkeys(robot.robot for case in cases for robot in case.robots))
    out = {name for case in cases for name in (*case.leaders, *case.died)}
    figure = Figure(figsize=(WIDTH, 4.3), layout="constrained")
    panels = figure.subplots(len(BARS), 1, sharex=True, squeeze=False)[:, 0]
    width = 0.8 / max(1, len(grouped))
    for axes, (index, label, unit) in zip(panels, BARS, strict=True):
        for k, (name, runs) in enumerate(grouped.items()):
            found = [spread([getattr(robot, index) for robot in _same(runs, who)]) for who in names]
            height = [float(each["mean"]) if each["mean"] is not None else np.nan for each in found]
            error = [float(each["ci95"]) if each["ci95"] is not None else 0.0 for each in found]
            x = np.arange(len(names)) + (k - 0.5 * (len(grouped) - 1)) * width
            _bars(axes, x, height, error, width, k, name)
        axes.set_ylabel(f"{label} [{unit}]")
        axes.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
        axes.grid(axis="y")
    _name_ticks(panels[-1], [f"({name})" if name in out else name for name in names])
    panels[-1].set_xlim(-0.6, len(names) - 0.4)
    figure.align_ylabels(list(panels))
    _legend_above(figure, panels[0].get_legend_handles_labels(), columns=3)
    return figure


@_styled
def formation_before(traces: Sequence[Trace]) -> Figure:
    """The way from the start into the formation, before the first leg of the timeline (paper, figure 13)."""
    return _spatial(traces, lambda trace: (0.0, _first_leg(trace)))


@_styled
def formation_after(traces: Sequence[Trace]) -> Figure:
    """The way from the first leg of the timeline to the end (paper, figure 14); the whole run if there is no leg."""
    return _spatial(traces, lambda trace: ((*phase_starts(trace), 0.0)[1], float(trace.time[-1])))


@_styled
def errors(traces: Sequence[Trace]) -> Figure:
    """e_i(t) of each robot, one panel per case, legs of the timeline dashed (paper, figure 16)."""
    height = _panel(len(traces), 1.35)
    figure = Figure(figsize=(WIDTH, height * len(traces) + 0.75), layout="constrained")
    panels = figure.subplots(len(traces), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for axes, trace in zip(panels, traces, strict=True):
        error, few = formation_errors(trace), _thinned(trace)
        for i, line in enumerate(_lines(trace)):
            axes.plot(trace.time[few], error[few, i], **line)
        _mark_phases(axes, trace)
        axes.set_title(trace.case, loc="right", pad=2.0)
        axes.grid()
    _time_axis(panels[-1], traces)
    panels[-1].set_ylim(bottom=0.0)
    figure.supylabel("$e_i$ [m]", fontsize=8)
    _robot_legend(figure, traces)
    return figure


@_styled
def events(traces: Sequence[Trace]) -> Figure:
    """When each robot transmitted: one row per robot, one panel per case; what would touch in print is one bar."""
    rows = max(len(trace.robots) for trace in traces)
    height = _panel(len(traces), min(max(0.6, 0.13 * rows), 3.2))
    figure = Figure(figsize=(WIDTH, height * len(traces) + 0.5 + 0.14 * len(traces)), layout="constrained")
    panels = figure.subplots(len(traces), 1, sharex=True, squeeze=False)[:, 0]
    for axes, trace in zip(panels, traces, strict=True):
        colours = [line["color"] for line in _lines(trace)]
        pixel = float(trace.time[-1] - trace.time[0]) / 1200.0  # a printed column shows no more
        for i in range(len(trace.robots)):
            begin, end = _runs(np.sort(trace.sent.time[trace.sent.robot == i]), pixel)
            spans = list(zip(begin, end - begin + pixel, strict=True))
            axes.broken_barh(spans, (i - 0.36, 0.72), facecolor=colours[i], linewidth=0.0)
        _mark_phases(axes, trace)
        every = math.ceil(len(trace.robots) / max(1.0, height / 0.11))
        axes.set_yticks(range(0, len(trace.robots), every), trace.robots[::every], fontsize=6)
        axes.set_ylim(len(trace.robots) - 0.4, -0.6)
        axes.tick_params(axis="y", length=0)
        axes.set_title(trace.case, loc="right", pad=2.0)
        axes.grid(axis="x")
    _time_axis(panels[-1], traces)
    return figure


@_styled
def intervals(traces: Sequence[Trace]) -> Figure:
    """Share of inter-event times up to a length: each robot thin, all robots but the leaders thick."""
    figure = Figure(figsize=(WIDTH, 2.2), layout="constrained")
    axes = figure.subplots()
    handles: dict[str, Line2D] = {}
    for k, trace in enumerate(traces):
        colour = CASES[k % len(CASES)]
        out = leaders(trace.experiment)
        waits = [wait for wait, name in zip(gaps(trace), trace.robots, strict=True) if name not in out and len(wait)]
        for wait in waits if len(waits) > 1 else []:
            axes.plot(*_steps(wait), color=colour, linewidth=0.5, alpha=0.45, drawstyle="steps-post")
        if waits:
            line = {"color": colour, "linewidth": 1.5, "linestyle": ("-", "--", "-.", ":")[k % 4]}
            axes.plot(*_steps(np.concatenate(waits)), drawstyle="steps-post", **line)
            handles.setdefault(trace.case, Line2D([], [], **line))
    axes.set_xscale("log")
    axes.set_ylim(0.0, 1.02)
    axes.set_xlabel("time between transmissions [s]")
    axes.set_ylabel("share of intervals")
    axes.grid()
    _legend_above(figure, (list(handles.values()), list(handles)), columns=3)
    return figure


@_styled
def plan_view(traces: Sequence[Trace]) -> Figure:
    """The trajectories from above, in the arena; start hollow, end full, links of the end grey."""
    columns = min(2, len(traces))
    rows = math.ceil(len(traces) / columns)
    x, y, _ = traces[0].experiment.arena.size
    side = (WIDTH - 0.5) / columns
    panel = min(side * y / x, 3.2) + 0.25
    figure = Figure(figsize=(WIDTH, panel * rows + 0.7), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes, trace in zip(grid.flat, traces, strict=False):
        x, y, _ = trace.experiment.arena.size
        axes.add_patch(Rectangle((-x / 2, -y / 2), x, y, fill=False, edgecolor=INK, linewidth=0.6))
        few, net = _thinned(trace), links_of(trace)
        place, last = trace.true_position, _last_known(trace)
        for i, j in _edges(net.listener, net.speaker):
            axes.plot(*last[[i, j], :2].T, color="#8a8a8a", linewidth=0.5, zorder=1)
        small = 3.0 if len(trace.robots) <= MANY else 2.0
        for i, line in enumerate(_lines(trace)):
            axes.plot(place[few, i, 0], place[few, i, 1], **{**line, "linewidth": 0.8})
            axes.plot(*place[0, i, :2], "o", ms=small, mec=line["color"], mfc="none", mew=0.7)
            axes.plot(*last[i, :2], "o", ms=small + 0.5, mec="none", color=line["color"])
        axes.set_aspect("equal")
        axes.set_xlim(-0.53 * x, 0.53 * x)
        axes.set_ylim(-0.53 * y, 0.53 * y)
        axes.set_title(trace.case, pad=3.0)
        axes.spines[["left", "bottom"]].set_visible(False)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.yaxis.set_major_locator(MaxNLocator(5))
    for axes in list(grid.flat)[len(traces) :]:
        axes.set_visible(False)
    figure.supxlabel("$x$ [m]", fontsize=8)
    figure.supylabel("$y$ [m]", fontsize=8)
    _robot_legend(figure, traces)
    return figure


def ratios(runs: Sequence[CaseMetrics], reference: Sequence[CaseMetrics], index: str) -> list[float | None]:
    """An index of each run over the reference: of the same seed if all seeds are the same, else over its mean."""
    if sorted(run.seed for run in runs) == sorted(run.seed for run in reference):
        of_seed = {run.seed: run.mean[index] for run in reference}
        return [ratio(run.mean[index], of_seed[run.seed]) for run in runs]
    mean = spread([run.mean[index] for run in reference])["mean"]
    return [ratio(run.mean[index], mean) for run in runs]


def _by_case(cases: Sequence[CaseMetrics]) -> dict[str, list[CaseMetrics]]:
    grouped: dict[str, list[CaseMetrics]] = {}
    for case in cases:
        grouped.setdefault(case.case, []).append(case)
    return grouped


def _same(runs: Iterable[CaseMetrics], name: str) -> list[RobotMetrics]:
    return [robot for run in runs for robot in run.robots if robot.robot == name]


def _bars(
    axes: Axes, x: Array, height: Sequence[float], error: Sequence[float], width: float, k: int, label: str
) -> None:
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


def _panel(panels: int, wanted: float) -> float:
    """Height of one of several stacked panels [in] that together fit a page."""
    return min(wanted, (TALLEST - 1.0) / panels)


def _thinned(trace: Trace) -> slice:
    return slice(None, None, max(1, math.ceil(len(trace.time) / POINTS)))


def _lines(trace: Trace) -> list[dict[str, Any]]:
    """How each robot's curve looks: a colour of its own if there are few robots, else the colour of its kind."""
    if len(trace.robots) <= MANY:
        styles = ["-"] * len(ROBOTS) + ["--"] * len(ROBOTS)
        return [{"color": ROBOTS[i % len(ROBOTS)], "linestyle": styles[i]} for i in range(len(trace.robots))]
    kinds = [trace.experiment.robots[name].kind for name in trace.robots]
    return [{"color": KINDS.get(kind, "#7a7a7a"), "linewidth": 0.6, "alpha": 0.7} for kind in kinds]


def _robot_legend(figure: Figure, traces: Sequence[Trace]) -> None:
    trace = max(traces, key=lambda each: len(each.robots))
    label = trace.robots
    if len(label) > MANY:
        label = tuple(trace.experiment.robots[name].kind for name in trace.robots)
    shown = {name: Line2D([], [], **line) for name, line in zip(label, _lines(trace), strict=True)}
    _legend_above(figure, (list(shown.values()), list(shown)), columns=4 if len(shown) in {4, 7, 8} else 5)


def _legend_above(figure: Figure, entries: tuple[Sequence[Any], Sequence[str]], columns: int) -> None:
    if entries[1]:
        figure.legend(*entries, loc="outside upper center", ncols=min(columns, len(entries[1])))


def _name_ticks(axes: Axes, names: Sequence[str]) -> None:
    crowded = len(names) > MANY
    axes.set_xticks(
        range(len(names)),
        names,
        rotation=90 if crowded else 0,
        fontsize=6.5 if len(names) <= 2 * MANY else 5.0,
    )
    axes.tick_params(axis="x", length=0)


def _time_axis(axes: Axes, traces: Sequence[Trace]) -> None:
    axes.set_xlim(min(float(trace.time[0]) for trace in traces), max(float(trace.time[-1]) for trace in traces))
    axes.set_xlabel("$t$ [s]")


def _mark_phases(axes: Axes, trace: Trace) -> None:
    for start in phase_starts(trace)[1:]:
        axes.axvline(start, color=INK, linewidth=0.6, linestyle=(0, (4, 3)), zorder=0.5)


def _first_leg(trace: Trace) -> float:
    starts = phase_starts(trace)
    return starts[1] if len(starts) > 1 else float(trace.time[-1])


def _runs(times: Array, pixel: float) -> tuple[Array, Array]:
    """First and last of each run of times that lie closer together than a pixel."""
    cut = np.flatnonzero(np.diff(times) > pixel)
    at = np.arange(len(times))
    return times[np.concatenate([at[:1], cut + 1])], times[np.concatenate([cut, at[-1:]])]


def _steps(waits: Array) -> tuple[Array, Array]:
    """The empirical distribution, thinned to what can be seen."""
    x = np.sort(np.maximum(waits, 1e-4))
    share = np.arange(1, len(x) + 1) / len(x)
    few = np.unique(np.linspace(0, len(x) - 1, 300).round().astype(int))
    return np.concatenate([x[:1], x[few]]), np.concatenate([[0.0], share[few]])


def _last_known(trace: Trace) -> Array:
    """Where each robot was last known to be (N, 3)."""
    alive = np.isfinite(trace.true_position).all(axis=2)
    last = len(alive) - 1 - alive[::-1].argmax(axis=0)
    return trace.true_position[last, np.arange(len(trace.robots))]


def _edges(listener: Iterable[Any], speaker: Iterable[Any]) -> list[tuple[int, int]]:
    return sorted({(min(i, j), max(i, j)) for i, j in zip(listener, speaker, strict=True)})


def _spatial(traces: Sequence[Trace], span: Callable[[Trace], tuple[float, float]]) -> Figure:
    """Trajectories in space over a span of time, one panel per case, with the links at its start and its end."""
    height = _panel(len(traces), 2.6)
    figure = Figure(figsize=(WIDTH, height * len(traces) + 0.3))
    for k, trace in enumerate(traces):
        top = 1.0 - (0.3 + height * k) / (height * len(traces) + 0.3)
        share = height / (height * len(traces) + 0.3)
        axes: Any = figure.add_axes((0.0, top - share, 1.0, share), projection="3d", computed_zorder=False)
        begin, end = np.searchsorted(trace.time, np.array(span(trace)) - 1e-9)
        _draw_spatial(axes, trace, trace.true_position[begin : max(end, begin + 2)])
        if len(traces) > 1:
            axes.text2D(0.04, 0.93, trace.case, transform=axes.transAxes, fontsize=8)
    black, magenta = to_rgb(INK), to_rgb(MAGENTA)
    handles = [
        Line2D([], [], color=black, linewidth=0.7),
        Line2D([], [], color=magenta, linewidth=0.9),
        Line2D([], [], color=black, marker="*", linestyle="", markersize=5, markerfacecolor="none", markeredgewidth=0.6),
        Line2D([], [], color=black, marker="*", linestyle="", markersize=5.5),
    ]
    figure.legend(
        handles, ["links, start", "links, end", "start", "end"], loc="upper center", ncols=4, bbox_to_anchor=(0.5, 1.0)
    )
    return figure


def _draw_spatial(axes: Any, trace: Trace, place: Array) -> None:
    known = np.isfinite(place).all(axis=2)
    ends = place[len(place) - 1 - known[::-1].argmax(axis=0), np.arange(place.shape[1])]
    starts = place[known.argmax(axis=0), np.arange(place.shape[1])]
    net = links_of(trace)
    pairs = _edges(net.listener, net.speaker)
    thin = 1.0 if len(trace.robots) <= MANY else 0.5
    for where, colour, width, order in ((starts, INK, 0.6, 1), (ends, MAGENTA, 0.9, 4)):
        lines = [where[[i, j]] for i, j in pairs]
        axes.add_collection3d(Line3DCollection(lines, colors=colour, linewidths=width * thin, alpha=0.8, zorder=order))
    few = slice(None, None, max(1, len(place) // 400))
    for i, line in enumerate(_lines(trace)):
        axes.plot(*place[few, i].T, **{**line, "zorder": 3})
        axes.plot(*starts[i, :, None], "*", ms=5 * thin, mfc="none", mec=line["color"], mew=0.6, zorder=5)
        axes.plot(*ends[i, :, None], "*", ms=6 * thin, color=line["color"], mec="none", zorder=6)
        if len(trace.robots) <= MANY:
            halo = [withStroke(linewidth=1.5, foreground=PAPER)]
            axes.text(*(ends[i] + [0.0, 0.0, 0.05]), trace.robots[i], fontsize=6, zorder=7, path_effects=halo)
    low, high = np.nanmin(place, axis=(0, 1)), np.nanmax(place, axis=(0, 1))
    low[2] = min(0.0, low[2])
    size = np.maximum(high - low, 0.4)
    middle = 0.5 * (low + high)
    low, high = middle - 0.54 * size, middle + 0.54 * size
    low[2] = 0.0 if low[2] > -0.1 else low[2]
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.12)
    axes.view_init(26, -60)
    axes.set_xlabel("$x$ [m]", labelpad=-8)
    axes.set_ylabel("$y$ [m]", labelpad=-8)
    axes.set_zlabel("$z$ [m]", labelpad=-9)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(5))
        axis.pane.fill = False
        axis.pane.set_edgecolor("#9a9a9a")
        axis.pane.set_linewidth(0.4)
        axis._axinfo["grid"].update(linewidth=0.3, color="#c0c0c0")
    axes.tick_params(pad=-3.5, labelsize=6.5)
