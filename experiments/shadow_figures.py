"""Figures of robots and the twins that run beside them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from experiments.drawing import (
    CASES,
    INK,
    MAGENTA,
    SHORTEST_S,
    WIDTH,
    legend_above,
    mark_phases,
    panel_height,
    plain,
    styled,
    thinned,
)
from experiments.shadows import differences, in_heading
from experiments.trace import Trace

Style = Literal["-", "--", ":"]

MOST: Final = 8  # robots whose twins are drawn: a page holds no more
PARTS: Final[tuple[tuple[str, str, Style], ...]] = (
    ("along", CASES[0], "-"),
    ("to the left", CASES[1], "--"),
    ("up", CASES[2], ":"),
)


def every(traces: Sequence[Trace]) -> dict[str, Figure]:
    """The figures of twins beside robots by name; nothing where there are none."""
    shown = [(trace, row) for trace in traces for row in _rows(trace)]
    return {"shadows": shadows(traces)} if shown else {}


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
    """Robots whose twin was ever seen."""
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
