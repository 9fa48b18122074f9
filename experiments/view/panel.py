"""Side panel of the view: phase and clock, a table of the robots, moving plots, events. Shows, and decides nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from agents.network.messages import Event, Status
from experiments.file.document import UNNAMED
from experiments.scene.condition import CONDITIONS, RINGED, Condition, RobotRow, robot_row
from experiments.scene.stage import (
    BAD,
    CHASSIS,
    FAIR,
    FAIR_M,
    GOOD,
    GOOD_M,
    PLACES,
    UNKNOWN,
    Moment,
    SceneModel,
    link_colours,
    touched,
)
from twins.arrays import Array

if TYPE_CHECKING:
    import viser

HISTORY_S: Final = 30.0
PLOT_S: Final = 0.25
CURVES: Final = 12  # curves of more robots: the largest, the median and the smallest value are plotted
TABLE: Final = 20  # rows; of more robots, those that need attention first, then the worst
MEASURES: Final = 3  # measures of a law, in the table
EVENTS: Final = 12
LINKS: Final = 30  # rows
FEW_MISSED: Final = 0.01  # share of ticks; more are shown in red
NONE: Final = "–"  # error of a robot that receives on no link
QUIET: Final = ("output",)  # kinds of events that are not shown
# the panel of a narrow page, which viser makes 20 em wide
WHOLE_WIDTH: Final = "<style>@media(max-width:36em){[style*='width: 20em']{width:100%!important}}</style>"


def known(value: float) -> float | None:
    """A number for a row; None for NaN."""
    return None if np.isnan(value) else float(value)


def robot_rows(
    names: Sequence[str], moment: Moment, statuses: Sequence[Status | None], error: Array, rate: Sequence[float],
    *, delay: Sequence[float | None] = (), ticks: bool = True,
) -> list[RobotRow]:  # fmt: skip
    """The rows of all robots at a moment; errors (N,) [m], rates [1/s], and largest delays [s] if known."""
    return [
        robot_row(
            name, Condition(int(moment.condition[k])), status, known(error[k]), rate[k], ticks=ticks,
            delay=delay[k] if delay else None, touches=touched(name, moment.overlaps),
            measures=moment.measures[k] if moment.measures else {},
        )
        for k, (name, status) in enumerate(zip(names, statuses, strict=True))
    ]  # fmt: skip


class History:
    """Errors and rates of N robots over the last 30 s."""

    def __init__(self, rows: int) -> None:
        self._rows = rows
        self.time: list[float] = []  # [s]
        self.error: list[Array] = []  # (N,) [m] each
        self.rate: list[Array] = []  # (N,) [1/s] each

    def add(self, t: float, error: Array, rate: Array) -> None:
        """Values (N,) at `t` [s], which goes on."""
        self.time.append(t)
        self.error.append(np.nan_to_num(error))
        self.rate.append(np.nan_to_num(rate))
        while self.time and self.time[0] < t - HISTORY_S:
            for column in (self.time, self.error, self.rate):
                column.pop(0)

    def curves(self, values: Sequence[Array], rows: Sequence[int] | None = None) -> tuple[Array, ...]:
        """Time before now [s], then one curve for each of `rows`, all if None.

        Of many robots these are the largest, the median and the smallest.
        """
        time = np.array(self.time) - (self.time[-1] if self.time else 0.0)
        table = np.nan_to_num(np.array(values).reshape(len(time), self._rows))
        table = table if rows is None else table[:, list(rows)]
        if table.shape[1] > CURVES:
            return time, table.max(axis=1), np.median(table, axis=1), table.min(axis=1)
        return (time, *table.T)


class Panel:
    """The panel of one page."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._gui = server.gui
        self._head = self._gui.add_html("", order=1.0)
        self._bar: Any = self._gui.add_progress_bar(0.0, color=(90, 130, 180), order=2.0)
        with self._gui.add_folder("Robots", order=10.0):
            self._table = self._gui.add_html("")
        self._plot_folder = self._gui.add_folder("Last 30 s", order=20.0)
        self._error: Any = None
        self._rate: Any = None
        self._followers: Sequence[int] = ()  # rows of the robots that receive on a link, with plotted errors
        with self._gui.add_folder("Links", order=25.0, expand_by_default=False):
            self._links = self._gui.add_html("")
        with self._gui.add_folder("Events", order=30.0):
            self._list = self._gui.add_html("")
        with self._gui.add_folder("Legend", order=60.0, expand_by_default=False):
            self._gui.add_html(legend())
        self.stage = SceneModel.of_robots(())
        self.history = History(0)

    def set_stage(self, stage: SceneModel) -> None:
        """Another case: its robots, and empty plots."""
        self.stage, self.history = stage, History(len(stage.names))
        for plot in (self._error, self._rate):
            if plot is not None:
                plot.remove()
        self._error = self._rate = None
        if not stage.names:
            return
        every = range(len(stage.names))
        self._followers = sorted(set(stage.links.receiver.tolist())) or list(every)
        with self._plot_folder:
            self._error = self._plot("error of each robot's links [m]", self._followers)
            self._rate = self._plot("transmissions [1/s]", every)

    def _plot(self, title: str, rows: Sequence[int]) -> Any:  # noqa: ANN401 - viser's own type
        many = len(rows) > CURVES
        names = ("largest", "median", "smallest") if many else [self.stage.names[row] for row in rows]
        colours = [(213, 94, 0), (0, 114, 178), (0, 158, 115)] if many else self.stage.colours[list(rows)].tolist()
        lines: Any = [{"label": name, "stroke": css(c), "width": 1.5} for name, c in zip(names, colours, strict=True)]
        return self._gui.add_uplot(
            (np.zeros(1), *(np.zeros(1) for _ in lines)), ({"label": "s"}, *lines),
            title=title, height=170, padding=(8, 12, 0, 0), legend={"show": False},
            scales={"x": {"time": False, "range": (-HISTORY_S, 0.0)}},
            axes=({"label": "time before now [s]", "labelSize": 20, "size": 50}, {}),
        )  # fmt: skip

    def show_head(self, case: str, phase: str, elapsed: float | None, duration: float, where: str) -> None:
        """Title, case, phase, clock [s], and which run it is."""
        named = f"{case}: {phase}" if case not in ("", UNNAMED) else phase
        clock = "" if elapsed is None else f"{elapsed:.1f} s of {duration:g} s" if duration else f"{elapsed:.1f} s"
        title = escape(self.stage.title or "robots")
        text = (
            f'{WHOLE_WIDTH}<div style="padding:0 1.4em 0 1em;font-size:0.85em"><b>{title}</b><br>'
            f"<span>{escape(named)}</span> <span style='float:right'>{clock}</span>"
            f"<div style='opacity:0.6;overflow-wrap:anywhere'>{escape(where)}</div></div>"
        )
        _set(self._head, text)
        share = 0.0 if elapsed is None or not duration else min(100.0, max(0.0, 100.0 * elapsed / duration))
        if abs(self._bar.value - share) >= 0.5:
            self._bar.value = share

    def show_tables(
        self, rows: Sequence[RobotRow], error: Array, events: Sequence[Event], start: float | None,
        delay: Sequence[float | None] = (),
    ) -> None:  # fmt: skip
        """Robots, links with errors (E,) [m] and delays of the last poses (E,) [s] if known, and the last events.

        Times of events are since the common start [s, UTC] if that is known.
        """
        _set(self._table, table(rows, self.stage))
        _set(self._links, link_table(self.stage, error, delay))
        _set(self._list, event_list(events, start))

    def show_plots(self) -> None:
        if self._error is None or len(self.history.time) < 2:
            return
        self._error.data = self.history.curves(self.history.error, self._followers)
        self._rate.data = self.history.curves(self.history.rate)


def _set(handle: Any, text: str) -> None:  # noqa: ANN401
    if handle.content != text:
        handle.content = text


def css(colour: Sequence[int]) -> str:
    red, green, blue = colour
    return f"rgb({red},{green},{blue})"


HEADS: Final = ("error", "f [Hz]", "battery", "missed", "delay")


def _cells(row: RobotRow) -> tuple[str, ...]:
    """Row of a robot in the table, below `HEADS`."""
    error = row.error
    return (
        "" if error is None else _coloured_error(error),
        "" if row.rate is None else f"{row.rate:.1f}",
        "" if row.battery is None else f"{100 * row.battery:.0f} %",
        "" if row.late is None else _coloured_missed(row.late, row.late_share),
        "" if row.delay is None else _milliseconds(row.delay),
    )


def _coloured_error(error: float) -> str:
    return f"<span style='color:{css(link_colours(np.array(error)).tolist())}'>{100 * error:.1f} cm</span>"


def _coloured_missed(missed: int, share: float) -> str:
    """Share of missed ticks in its colour; in none without any."""
    text = f"{100 * share:.1f} %"
    return f"<span style='color:{css(FAIR if share <= FEW_MISSED else BAD)}'>{text}</span>" if missed else text


def _milliseconds(seconds: float) -> str:
    return f"{round(1e3 * seconds, 1) + 0.0:.1f} ms"  # a sum, for it has no negative zero


def table(rows: Sequence[RobotRow], stage: SceneModel) -> str:
    """Table of robots as HTML: of many, those that need attention first, then by error; without empty columns."""
    colours: Mapping[str, Sequence[int]] = dict(zip(stage.names, stage.colours.tolist(), strict=True))
    shown = list(rows)
    left = ""
    if len(shown) > TABLE:
        shown.sort(key=lambda row: (-row.condition, -(row.error or 0.0)))
        left = f"<div style='opacity:0.6'>and {len(rows) - TABLE} more; the worst are shown</div>"
        shown = shown[:TABLE]
    measures = [*dict.fromkeys(name for row in shown for name in row.measures)][:MEASURES]
    named = (f"{name} [{stage.units[name]}]" if name in stage.units else name for name in measures)
    every = (*HEADS, *map(escape, named))
    filled = []
    for row in shown:
        more = (f"{row.measures[name]:.3g}" if name in row.measures else "" for name in measures)
        filled.append((*_cells(row), *more))
    columns = [k for k in range(len(every)) if not filled or any(cells[k] for cells in filled)]
    leading = {*stage.names} - {stage.names[row] for row in stage.links.receiver.tolist()}
    filled = [(NONE, *cells[1:]) if row.name in leading and not cells[0] else cells
              for row, cells in zip(shown, filled, strict=True)]  # fmt: skip
    heads = "".join(f"<th style='text-align:right;font-weight:500;opacity:0.6'>{every[k]}</th>" for k in columns)
    lines = []
    for row, cells in zip(shown, filled, strict=True):
        colour = CONDITIONS[row.condition][1]
        dot = f"<span style='color:{css(colours.get(row.name, UNKNOWN))}'>&#9679;</span>"
        badge = f" <span style='color:{css(colour)};font-weight:600'>{escape(row.phase)}</span>" * (
            row.condition > Condition.ACTIVE
        )
        note = ""
        if row.note:
            noted = FAIR if row.condition == Condition.ACTIVE else colour  # a warning is never green
            style = f"style='color:{css(noted)};padding-left:1.2em'"
            note = f"<tr><td colspan='{len(every) + 1}' {style}>{escape(row.note)}</td></tr>"
        lines.append(
            f"<tr><td style='white-space:nowrap'>{dot} {escape(row.name)}{badge}</td>"
            + "".join(f"<td style='text-align:right;white-space:nowrap'>{cells[k]}</td>" for k in columns)
            + f"</tr>{note}"
        )
    return (
        "<div style='padding:0 0.75em;font-size:0.75em;font-variant-numeric:tabular-nums'>"
        "<table style='width:100%;border-spacing:0.35em 0.1em'>"
        f"<tr><th></th>{heads}</tr>{''.join(lines)}</table>{left}</div>"
    )


def link_table(stage: SceneModel, error: Array, delay: Sequence[float | None]) -> str:
    """Table of links as HTML, the largest errors first; links that are not there, or not known, are left out."""
    order = [k for k in np.argsort(-np.nan_to_num(error)).tolist() if np.isfinite(error[k])][:LINKS]
    lines = []
    for k in order:
        ends = (stage.names[int(stage.links.sender[k])], stage.names[int(stage.links.receiver[k])])
        late = "" if not delay or (seconds := delay[k]) is None else _milliseconds(seconds)
        cells = (" &rarr; ".join(map(escape, ends)), _coloured_error(float(error[k])), late)
        lines.append("<tr>" + "".join(f"<td style='text-align:right'>{cell}</td>" for cell in cells) + "</tr>")
    left = len(error) - len(order)
    more = f"<div style='opacity:0.6'>and {left} more</div>" if left else ""
    return (
        "<div style='padding:0 1em;font-size:0.75em;font-variant-numeric:tabular-nums'>"
        f"<table style='width:100%'>{''.join(lines)}</table>{more}</div>"
    )


def event_list(events: Sequence[Event], start: float | None) -> str:
    """The last events as HTML, the newest first."""
    lines = []
    for event in [event for event in events if event.kind not in QUIET][: -EVENTS - 1 : -1]:
        at = "" if start is None else f"{event.stamp - start:.1f} s"
        grave = event.kind in ("hazard", "contact", "lost", "stop", "failed", "killed")
        colour = f"color:{css(BAD)};" if grave else ""
        lines.append(
            f"<div style='{colour}overflow-wrap:anywhere'><span style='opacity:0.6'>{at}</span> "
            f"<b>{escape(event.source)}</b> {escape(event.kind)}: {escape(event.text)}</div>"
        )
    return f"<div style='padding:0 1em;font-size:0.75em'>{''.join(lines) or 'none yet'}</div>"


def legend() -> str:
    """Meaning of the colours, as HTML."""
    links = ((GOOD, f"within {100 * GOOD_M:g} cm"), (FAIR, f"within {100 * FAIR_M:g} cm"), (BAD, "beyond"))
    said = [f"<span style='color:{css(colour)}'>&#9473; {text}</span>" for colour, text in links]
    bodies = [f"<span style='background:{css(CHASSIS[place])};border:1px solid #888'>&nbsp;&nbsp;&nbsp;</span> {text}"
              for place, text in PLACES.items()]  # fmt: skip
    states = [f"<span style='color:{css(CONDITIONS[each][1])}'>&#9711; {CONDITIONS[each][0]}</span>" for each in RINGED]
    return (
        "<div style='padding:0 1em;font-size:0.75em'>"
        f"<div>links by error: {', '.join(said)}; wide when the sender transmits; dashed when broken</div>"
        f"<div>bodies: {', '.join(bodies)}; translucent: goals and shadow twins; "
        "&#9670; a place that a robot says</div>"
        f"<div>rings: {', '.join(states)}</div></div>"
    )
