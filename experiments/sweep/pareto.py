"""Messages against error for the parameters of each trigger, and the Pareto front."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogLocator, NullFormatter

from experiments.metrics.metric import Metric, swept_metrics
from experiments.report.style import (
    CASES,
    CORNERS,
    INK,
    MARKERS,
    PAPER,
    WIDTH,
    Drawing,
    in_full,
    labelled,
    legend_above,
    plain,
    shortened,
    spread_texts,
    styled,
)
from experiments.sweep.table import UNKNOWN, CellRow, short, words_of
from twins.arrays import Array

MOST_CURVES: Final = 7  # colours of cases, and markers; more could not be distinguished, and are drawn as clouds
LONGEST: Final = 24  # letters of a name on an axis
GREY: Final = "#7a7a7a"
THIN: Final[dict[str, Any]] = {"linewidth": 0.8, "markersize": 3.6, "markeredgewidth": 0.8, "zorder": 3}
NAMED: Final = 12  # points of a curve that all have their value beside them, if it is the first one
SPAN: Final = 8.0  # a wider range of messages is drawn on a logarithmic axis


@styled
def pareto(
    rows: Sequence[CellRow],
    index: str = "iae",
    *,
    metrics: Mapping[str, Metric] | None = None,
    joined: bool = True,
    width: float = WIDTH,
) -> Figure:
    """Messages against an error, both over the reference with the same seeds; one curve for each trigger.

    Of several parameters the first runs along the curves, markers show the others. Full markers: no other cell of the
    same environment has fewer messages and no more error; these are joined by a grey line for each environment.
    Hollow: another one is better, or runs failed. Whiskers are 95 % confidence intervals. The reference is the cross
    at (1, 1).

    Args:
        rows: The cells; those without known ratios are left out.
        index: Of the error: `iae`, or another metric that has a ratio.
        metrics: Those of the sweep; left out: those of all sweeps.
        joined: Whether cells of a case are joined along a parameter, if these curves are few; else they are a cloud.
    """
    metrics = swept_metrics() if metrics is None else metrics
    known = [row for row in rows if not row.reference and _point_of(row, index) is not None]
    fronts = [front(rows, index, metrics) for rows in by_environment(known).values()]
    best = {id(row) for rows in fronts for row in rows}
    figure = Drawing(figsize=(width, min(2.9, 0.83 * width)), layout="constrained")
    axes = figure.subplots()
    for k, of_one in enumerate(fronts):
        _draw_front(axes, of_one, index, named=k == 0)
    cases = list(dict.fromkeys(row.case for row in known))
    found = curves(known)
    marks = list(dict.fromkeys(other for _, other in found))
    joined = joined and max(len(cases), len(marks)) <= MOST_CURVES
    if not joined:
        found = {(case, ""): [row for row in known if row.case == case] for case in cases}
    several = joined and len(marks) > 1  # markers then tell the other parameters apart, colours the cases
    for (case, other), curve in found.items():
        k = cases.index(case)
        style = {
            "color": CASES[k % len(CASES)],
            "marker": MARKERS[(marks.index(other) if several else k) % len(MARKERS)],
        }
        style |= {} if joined else {"linestyle": ""}
        full = [id(row) in best for row in curve]
        _draw_curve(axes, curve, index, full, style, named=other == next(o for c, o in found if c == case))
    for k, case in enumerate(cases):
        marker = {"marker": "" if several else MARKERS[k % len(MARKERS)], "linestyle": "-" if joined else ""}
        axes.plot([], [], color=CASES[k % len(CASES)], label=plain(case), **{**THIN, **marker})
    for k, other in enumerate(marks if several else ()):
        if other:
            marker = {"marker": MARKERS[k % len(MARKERS)], "linestyle": ""}
            axes.plot([], [], color=GREY, label=plain(other), **{**THIN, **marker})
    cross: dict[str, Any] = {"color": INK, "markersize": 7, "markeredgewidth": 1.0, "zorder": 4}
    axes.plot(1.0, 1.0, "+", label=f"{_reference(rows)} (reference)", **cross)
    axes.set_xlabel(f"messages relative to {_reference(rows)}")
    axes.set_ylabel(f"{plain(metrics[index].label)} relative to {_reference(rows)}")
    low = min((row.ratio["messages"].mean or 1.0 for row in known), default=1.0)
    if low < 1.0 / SPAN:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(10.0, (1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(in_full())
        axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid()
    legend_above(figure, labelled(axes), columns=4, room=1)
    spread_texts(axes)
    return figure


def front(rows: Sequence[CellRow], index: str = "iae", metrics: Mapping[str, Metric] | None = None) -> list[CellRow]:
    """Cells than which none has fewer messages and no more error, or less error and no more messages.

    Of a metric of which more is better, less counts as more error.
    Cells are those of one environment. A cell with failed runs is not among them: those that failed are not counted in
    its figures.
    """
    found: list[CellRow] = []
    last = (math.inf, math.inf)
    sign = -1.0 if (swept_metrics() if metrics is None else metrics)[index].better == "more" else 1.0
    points = [
        ((at[0], sign * at[1]), row) for row in rows if not row.failed and (at := _point_of(row, index)) is not None
    ]
    for at, row in sorted(points, key=lambda point: point[0]):
        if at[1] < last[1] or at == last:
            found.append(row)
            last = at
    return found


def by_environment(rows: Sequence[CellRow]) -> dict[str, list[CellRow]]:
    """Cells that can be compared with each other, by their environment in words."""
    found: dict[str, list[CellRow]] = {}
    for row in rows:
        found.setdefault(row.surroundings, []).append(row)
    return found


def curves(rows: Sequence[CellRow]) -> dict[tuple[str, str], list[CellRow]]:
    """Cells that differ only in the first parameter in which their case varies, by case and the other parameters."""
    found: dict[tuple[str, str], list[CellRow]] = {}
    for row in rows:
        along = _varied_parameter(rows, row.case)
        others = [path for path in row.parameters if path != along and _varies(rows, row.case, path)]
        fixed = ", ".join(f"{short(path)} = {row.value_of(path)}" for path in others)
        found.setdefault((row.case, fixed), []).append(row)
    return found


def _varied_parameter(rows: Sequence[CellRow], case: str) -> str | None:
    paths = dict.fromkeys(path for row in rows if row.case == case for path in row.parameters)
    return next((path for path in paths if _varies(rows, case, path)), None)


def _varies(rows: Sequence[CellRow], case: str, path: str) -> bool:
    return len({str(row.parameters.get(path)) for row in rows if row.case == case}) > 1


def _point_of(row: CellRow, index: str) -> tuple[float, float] | None:
    messages, error = row.ratio.get("messages", UNKNOWN).mean, row.ratio.get(index, UNKNOWN).mean
    return None if messages is None or error is None else (messages, error)


def _reference(rows: Sequence[CellRow]) -> str:
    return shortened(next((row.case for row in rows if row.reference), "the reference"), LONGEST)


def _points(rows: Sequence[CellRow], index: str) -> Array:
    """Messages, error, and the half-widths of their intervals (n, 4)."""
    pairs = [(row.ratio["messages"], row.ratio[index]) for row in rows]
    found = [(m.mean, e.mean, m.ci95 or 0.0, e.ci95 or 0.0) for m, e in pairs]
    return np.array(found, dtype=float).reshape(-1, 4)


def _draw_front(axes: Axes, rows: Sequence[CellRow], index: str, *, named: bool) -> None:
    points = _points(rows, index)
    x, y = points[points[:, 0].argsort(), :2].T
    line: dict[str, Any] = {"color": "#9a9a9a", "linewidth": 2.2, "alpha": 0.5}
    axes.plot(x, y, drawstyle="steps-post", label="front (full markers)" if named else "", zorder=1, **line)


def _draw_curve(
    axes: Axes, rows: Sequence[CellRow], index: str, best: Sequence[bool], style: dict[str, Any], *, named: bool
) -> None:
    points = _points(rows, index)
    x, y, dx, dy = points.T
    marker = {**THIN, **style}
    joined = "linestyle" not in style
    axes.errorbar(
        x, y, dy, dx, color=style["color"], linewidth=0.8 if joined else 0.0, elinewidth=0.7 if joined else 0.4,
        capsize=1.2, capthick=0.6, zorder=2, alpha=1.0 if joined else 0.4,
    )  # fmt: skip
    for full, face in ((True, style["color"]), (False, PAPER)):
        some = np.array(best) == full
        axes.plot(x[some], y[some], **{**marker, "linestyle": "", "markerfacecolor": face, "zorder": 3 + full})
    along = _varied_parameter(rows, rows[0].case) if joined and named else None
    if along is not None:
        _name_points(axes, rows, along, points[:, :2], style["color"])


def _name_points(axes: Axes, rows: Sequence[CellRow], along: str, points: Array, colour: str) -> None:
    """Name and value of a parameter at the first point of a curve, then its values; at all points if they are few."""
    few = len(axes.texts) == 0 and len(rows) <= NAMED
    for k, (row, at) in enumerate(zip(rows, points, strict=True)):
        if k in {0, len(rows) - 1} or few:
            first = f"{short(along)} = {row.value_of(along)}"
            words = (first if k == 0 else words_of(row.parameters[along])).replace("-", "\N{MINUS SIGN}")
            halo = [withStroke(linewidth=1.2, foreground=PAPER)]
            style: dict[str, Any] = {"textcoords": "offset points", "fontsize": 6, "color": colour}
            axes.annotate(plain(words), tuple(at), CORNERS[0], path_effects=halo, **style)
