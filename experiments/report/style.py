"""Style of the figures and their files: one column of 3.5 in, 8 pt, colours for colour-blind readers too.

`Figure` is used without pyplot, so that nothing is global; the style is set around drawing and around saving. It begins
with matplotlib's own defaults, because a process has the style of any `matplotlibrc` in its folder or in its home.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, ParamSpec

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.path import Path as Outline
from matplotlib.patheffects import withStroke
from matplotlib.text import Annotation
from matplotlib.ticker import FuncFormatter
from matplotlib.transforms import Bbox

from agents.body.kinds import KINDS
from experiments.metrics.signals import phase_starts
from experiments.recording.trace import Trace
from twins.arrays import Array

P = ParamSpec("P")
Line = dict[str, Any]  # keyword arguments of a curve

WIDTH: Final = 3.5  # [in] one column of a page in two columns; its whole width is 7.16
TALLEST: Final = 8.8  # [in] one page
SHORTEST_S: Final = 0.1  # length of a time axis, which a single sample would not have
POINTS: Final = 1500  # points of a curve; more than a printed column can show
ALL_POINTS: Final = 40_000  # points of all curves of a figure, so that many robots do not make a file of megabytes
INK: Final = "#000000"
PAPER: Final = "#ffffff"
MAGENTA: Final = "#D6007F"
HALO: Final = [withStroke(linewidth=1.5, foreground=PAPER)]  # edge of a name upon curves
# Okabe and Ito; yellow is left out because it vanishes on white paper
CASES: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
HATCHES: Final = ("", "////", "....", "xxxx", "\\\\\\\\", "----", "++++")
# robots: Tol's muted colours, so that none of them is taken for a case
ROBOTS: Final = ("#000000", "#CC6677", "#44AA99", "#999933", "#6FB7DC", "#AA4499", "#C9A227")
CORNERS: Final = ((3.0, 3.0), (-3.0, 3.0), (3.0, -3.0), (-3.0, -3.0))  # [pt] distance of a text from its point
MAX_COLOURED_ROBOTS: Final = 8  # robots that have a colour each; more are coloured by kind
MOST_ENTRIES: Final = 16  # entries of a legend
LEGEND_LINE: Final = 0.14  # [in]
LEGEND_PT: Final = 31.0  # [pt] length of a line and its distances in a legend
LETTER_PT: Final = 3.2  # [pt] width of a letter in a legend, on average
MARKERS: Final = ("o", "s", "^", "D", "v", "P", "X", "*")  # cases, parameters, or `MAX_COLOURED_ROBOTS` robots

# neither the window system nor the places of programs are style: both stay as the process has them
_DEFAULTS: Final = {
    name: value
    for name, value in mpl.rcParamsDefault.items()
    if not name.startswith("backend") and not name.endswith("_path")
}
STYLE: Final[Mapping[Any, Any]] = _DEFAULTS | {
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
    "legend.handlelength": 2.0,  # a dashed line shows its pattern
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
    "path.simplify_threshold": 0.25,  # share of a point: half the thinnest line
    "figure.dpi": 100,
    "savefig.dpi": 300,
    "savefig.transparent": True,
    "pdf.fonttype": 42,
    "svg.fonttype": "path",
    "svg.hashsalt": "zenpark",  # the same figure gives the same bytes
}


class Drawing(Figure):
    """A figure that notebooks show: it is drawn without pyplot, by which they would find it."""

    def _repr_svg_(self) -> str:
        return svg(self)

    def savefig(self, fname: Any, *, transparent: bool | None = None, **how: Any) -> None:  # noqa: ANN401 - matplotlib's
        """Saves in the style of this project: fonts and their type in the file are chosen only now."""
        with mpl.rc_context(dict(STYLE)):
            super().savefig(fname, transparent=transparent, **how)


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Draws in the style of this project, whatever the style of the process is."""

    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with mpl.rc_context(dict(STYLE)):
            return draw(*args, **kwargs)

    return drawn


def save(figure: Figure, folder: Path, name: str, *, pdf: bool = False) -> str:
    """Writes `<name>.svg` into the folder, and `<name>.pdf` if asked for or there already; returns the SVG."""
    folder.mkdir(parents=True, exist_ok=True)
    page = folder / f"{name}.pdf"
    with _laid_out(figure):
        drawing = svg(figure)
        (folder / f"{name}.svg").write_text(drawing, encoding="utf-8")
        if pdf or page.exists():  # one of an earlier report would show something else
            figure.savefig(page, metadata={"CreationDate": None})
    return drawing


@contextmanager
def _laid_out(figure: Figure) -> Iterator[None]:
    """In the style of this project, with a layout that is computed once: matplotlib does so twice for every file."""
    engine = figure.get_layout_engine()
    with mpl.rc_context(dict(STYLE)):
        if engine is not None:
            engine.execute(figure)
            figure.set_layout_engine(None)
        try:
            yield
        finally:
            if engine is not None:
                figure.set_layout_engine(engine)


def svg(figure: Figure) -> str:
    """The figure as SVG, without metadata, so that it holds no date and no address; paths to a hundredth of a point."""
    text = io.StringIO()
    with _laid_out(figure):
        figure.savefig(text, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    return re.sub(r' d="[^"]*"', lambda path: re.sub(r"(?<=\.\d\d)\d+", "", path[0]), text.getvalue())


def panel_height(panels: int, wanted: float) -> float:
    """Height of one of several stacked panels [in] that together fit a page."""
    return min(wanted, (TALLEST - 1.0) / max(1, panels))


def plain(name: str) -> str:
    """A name that matplotlib shows as it is: a dollar sign would begin a formula."""
    return name.replace("$", r"\$")


def thinned(trace: Trace, panels: int) -> slice:
    """Step between the drawn samples of a trace, by the number of panels."""
    points = min(POINTS, ALL_POINTS // max(1, panels * len(trace.robots)))
    return slice(None, None, max(1, math.ceil(len(trace.time) / max(points, 100))))


def robot_lines(trace: Trace) -> list[Line]:
    """Style of each robot's curve: a colour of its own if there are few robots, else the colour of its kind."""
    if len(trace.robots) <= MAX_COLOURED_ROBOTS:
        styles = ["-"] * len(ROBOTS) + ["--"] * len(ROBOTS)
        return [{"color": ROBOTS[i % len(ROBOTS)], "linestyle": styles[i]} for i in range(len(trace.robots))]
    kinds = [trace.plan.experiment.robots[name].kind for name in trace.robots]
    return [{"color": KINDS[kind].colour, "linewidth": 0.6, "alpha": 0.7} for kind in kinds]


def case_curve(k: int) -> Line:
    """Style of the curve of a case over time."""
    return {"color": CASES[k % len(CASES)], "linestyle": ("-", (0, (5, 1.5)), "-.", ":")[k % 4]}


def case_line(k: int) -> Line:
    """Style of the path of a case upon others: the first one broad and pale, so that the next ones are seen on it."""
    if k == 0:
        return {"color": CASES[0], "linewidth": 2.6, "alpha": 0.4, "solid_capstyle": "butt"}
    return {
        "color": CASES[k % len(CASES)],
        "linewidth": 0.8,
        "linestyle": ("-", (0, (4, 1.5)), (0, (1, 1)))[(k - 1) % 3],
    }


def robot_legend(figure: Figure, traces: Sequence[Trace], more: Mapping[str, Artist] = MappingProxyType({})) -> None:
    """Legend of the lines of robots, or of kinds of robots, and of `more`."""
    trace = max(traces, key=lambda each: len(each.robots))
    label = trace.robots
    if len(label) > MAX_COLOURED_ROBOTS:
        label = tuple(trace.plan.experiment.robots[name].kind for name in trace.robots)
    lines = {name: Line2D([], [], **line) for name, line in zip(label, robot_lines(trace), strict=True)}
    shown: dict[str, Artist] = {**lines, **more}
    legend_above(figure, shown, columns={4: 4, 6: 3, 7: 4, 8: 4}.get(len(shown), 5))


def spread_texts(axes: Axes) -> None:
    """Move texts that lie on others to another corner of their points, and leave out those that find none."""
    figure = axes.get_figure(root=True)
    assert figure is not None
    figure.draw_without_rendering()
    taken: list[Bbox] = []
    inside = axes.get_window_extent()
    for text in list(axes.texts):
        assert isinstance(text, Annotation)
        for x, y in CORNERS:
            text.xyann = (x, y)
            text.set(ha="left" if x > 0 else "right", va="bottom" if y > 0 else "top")
            box = text.get_window_extent()
            whole = inside.x0 <= box.x0 and box.x1 <= inside.x1 + 1.0
            if whole and not any(box.overlaps(other) for other in taken):
                taken.append(box)
                break
        else:
            text.remove()


def in_full() -> FuncFormatter:
    """Numbers of a logarithmic axis in full: an exponent would be too small for print."""
    return FuncFormatter(lambda value, _: np.format_float_positional(value, trim="-"))


def cut(name: str, most: int) -> str:
    """A name without its middle if it has more than `most` letters."""
    kept = most - 1
    return name if len(name) <= most else f"{name[: kept - kept // 2]}…{name[len(name) - kept // 2 :]}"


def shortened(name: str, most: int) -> str:
    """A name that is cut, as matplotlib shows it."""
    return plain(cut(name, most))


def fewer(entries: Mapping[str, Any]) -> dict[str, Any]:
    """Entries of a legend; of many the first and the last two, with the number of the others between them."""
    names = [*entries]
    hidden = len(names) - MOST_ENTRIES
    if hidden <= 0:
        return dict(entries)
    first, last = names[: MOST_ENTRIES - 3], names[-2:]
    return {
        **{name: entries[name] for name in first},
        f"and {hidden + 1} more": Line2D([], [], linestyle=""),
        **{name: entries[name] for name in last},
    }


def beyond(hidden: int) -> str:
    """Line that says how many cases a figure leaves out; empty if it shows all."""
    return f"and {hidden} more cases" if hidden else ""


def labelled(axes: Axes) -> dict[str, Any]:
    """Labelled artists of a panel, for its legend."""
    handles, labels = axes.get_legend_handles_labels()
    return dict(zip(labels, handles, strict=True))


def legend_above(figure: Figure, entries: Mapping[str, Any], columns: int, room: int = 3) -> None:
    """A legend above all panels, with as many columns as fit between the edges; none without entries.

    More lines than the figure has room for make it higher. Of very many entries some are left out.
    """
    shown = fewer(entries)
    if shown:
        width = figure.get_figwidth()
        labels = [cut(label, math.floor((72.0 * width - LEGEND_PT) / LETTER_PT)) for label in shown]
        fits = fitting(width, labels, columns)
        lines = math.ceil(len(labels) / fits)
        figure.set_figheight(figure.get_figheight() + LEGEND_LINE * max(0, lines - room))
        figure.legend([*shown.values()], labels, loc="outside upper center", ncols=fits)


def fitting(width: float, labels: Collection[str], columns: int) -> int:
    """Columns of a legend, at most `columns`, that fit into a width [in]; labels fill one column after the other."""
    wide = [LEGEND_PT + LETTER_PT * len(label) for label in labels]  # [pt]
    for count in range(min(columns, len(labels)), 1, -1):
        rows = [len(part) for part in np.array_split(np.arange(len(labels)), count)]
        ends = np.cumsum(rows)
        if sum(max(wide[end - n : end]) for end, n in zip(ends, rows, strict=True)) <= 72.0 * width:
            return math.ceil(len(labels) / max(rows))  # number of full ones
    return 1


def time_axis(axes: Axes, traces: Sequence[Trace]) -> None:
    """The x axis as time, as long as the longest trace."""
    begin, end = min(float(trace.time[0]) for trace in traces), max(float(trace.time[-1]) for trace in traces)
    axes.set_xlim(begin, max(end, begin + SHORTEST_S))
    axes.set_xlabel("$t$ [s]")


def mark_phases(axes: Axes, trace: Trace) -> None:
    """A dashed line at each leg of the timeline."""
    for start in phase_starts(trace)[1:]:
        axes.axvline(start, color=INK, linewidth=0.6, linestyle=(0, (4, 3)), zorder=0.5)


def merged(times: Array, pixel: float) -> tuple[Array, Array]:
    """First and last of each run of times that lie closer together than a pixel."""
    cut = np.flatnonzero(np.diff(times) > pixel)
    at = np.arange(len(times))
    return times[np.concatenate([at[:1], cut + 1])], times[np.concatenate([cut, at[-1:]])]


def boxes(begin: Array, end: Array, row: int) -> Outline:
    """Outline of many boxes in one path: a collection would repeat its style for each of them."""
    low, high = np.full_like(begin, row - 0.36), np.full_like(begin, row + 0.36)
    corners = np.array([[begin, low], [end, low], [end, high], [begin, high], [begin, low]])
    codes = np.tile([Outline.MOVETO, *[Outline.LINETO] * 3, Outline.CLOSEPOLY], len(begin))
    return Outline(corners.transpose(2, 0, 1).reshape(-1, 2), codes)
