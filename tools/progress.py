"""Progress of a run in the terminal: a live table, or a line now and then where there is no terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final, Self

from experiments.real_time.conductor.run_view import OUTPUT, EventFeed, Progress, ProgressDisplay
from tools.live_table import Trends, drawn, heading, metres
from tools.terminal import printable, say

if TYPE_CHECKING:
    from rich.console import Console, Group

REFRESH_S: Final = 0.25
LINE_S: Final = 5.0
QUIET: Final = ("robot", "left")  # kinds of events that the table shows better
ORDERED: Final = ("landing: ordered to ", "done: ordered to stop")  # texts by an operator
LANDING: Final = ("landing", "stopped", "done")  # phases in which the conductor gives these orders


class Lines:
    """A line for each event and every few seconds, on standard error."""

    def __init__(self) -> None:
        self._news, self._next = EventFeed(), 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def __call__(self, progress: Progress) -> None:
        """Print what is new; what happens to several robots at once on one line."""
        together: dict[tuple[str, str], list[str]] = {}
        for event in self._news.new_events(progress):
            if event.kind == OUTPUT:
                say(f"{event.source}| {event.text}", to=sys.stderr)
            elif event.kind not in QUIET or (event.text.startswith(ORDERED) and progress.phase not in LANDING):
                when = ""
                if event.kind in {"hazard", "lost"} and progress.start is not None:
                    when = f" (at {event.stamp - progress.start:.1f} s)"
                together.setdefault((event.kind, f"{event.text}{when}"), []).append(event.source)
        for (kind, text), sources in together.items():
            say(f"{progress.case}: {kind} {', '.join(dict.fromkeys(sources))}: {text}", to=sys.stderr)
        now = time.monotonic()
        if now >= self._next and progress.elapsed is not None:
            self._next = now + LINE_S
            errors = ", ".join(
                f"{name} {'-' if view.gone else metres(view.error)}" for name, view in progress.robots.items()
            )
            what = _silence(progress) or f"error [m] {errors}"  # – of robots that have no link, or no goal of their own
            print(f"{progress.case}: {progress.elapsed:5.1f} s, {progress.phase}; {what}", file=sys.stderr)


class ProgressTable:
    """A live table of the robots, on standard error."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        self._live = Live(console=Console(stderr=True), refresh_per_second=4, auto_refresh=False)
        self._news, self._next = EventFeed(), 0.0
        self._trends = Trends()

    def __enter__(self) -> Self:
        self._live.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.__exit__(None, None, None)

    def __call__(self, progress: Progress) -> None:
        """Redraw the table, four times a second at most."""
        for event in self._news.new_events(progress):
            if event.kind == OUTPUT:
                self._live.console.print(printable(f"{event.source}| {event.text}"), markup=False, highlight=False)
        now = time.monotonic()
        if now >= self._next or progress.phase == "done":
            self._next = now + REFRESH_S
            self._live.update(_table(progress, self._trends, self._live.console), refresh=True)


def shown(*, quiet: bool) -> ProgressDisplay:
    """A table in a terminal, lines elsewhere, and only lines when asked to be quiet."""
    return ProgressTable() if sys.stderr.isatty() and not quiet else Lines()


def _table(progress: Progress, trends: Trends, console: Console) -> Group:
    silence = _silence(progress) and f"; {_silence(progress)}"
    title = heading(f"{progress.case}: {progress.phase}{silence}", progress.elapsed, progress.duration)
    now = progress.clock.utc()
    rows = [
        trends.row(name, view.condition(now), view.status, view.error, now=now, left=view.left_because)
        for name, view in progress.robots.items()
    ]
    news = [event for event in progress.events if event.kind not in (*QUIET, OUTPUT)]
    return drawn(title, rows, news, console.width, console.height - 1)


def _silence(progress: Progress) -> str:
    """The outage of the network in words; empty while a router answers."""
    silent_s = time.monotonic() - progress.silent_since
    return f"no router answers for {silent_s:.1f} s" if silent_s > 0.0 else ""


BAR_LINE_S: Final = 5.0  # period of a line where there is no terminal
SHORT_S: Final = 2.0  # what is over sooner needs no passing bar
BAR_REFRESH_S: Final = 0.1


class Bar:
    """A bar in a terminal; elsewhere a line every few seconds."""

    def __init__(self, *, passing: bool = False) -> None:
        """A passing bar leaves nothing behind: it is for terminals only, and for what takes longer than `SHORT_S`."""
        self._passing = passing
        self._terminal = sys.stderr.isatty()
        self._bar: Any = None
        self._task: Any = None
        self._what = ""
        self._began = time.monotonic()
        self._next = self._began + SHORT_S * passing

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def show(self, what: str, done: int, of: int) -> None:
        """Show `done` of `of`; cheap enough to be called a thousand times a second."""
        now = time.monotonic()
        if what != self._what:
            self._what, self._began = what, now
        over = done >= of and (self._bar is not None or not self._passing)
        if now < self._next and not over:
            return
        if self._terminal:
            self._next = now + BAR_REFRESH_S
            self._draw(what, done, of)
        elif not self._passing:
            self._next = now + BAR_LINE_S
            print(f"{what} {done} of {of}", file=sys.stderr)

    def _draw(self, what: str, done: int, of: int) -> None:
        if self._bar is None:
            from rich import progress as rich
            from rich.console import Console

            columns = (rich.TextColumn("{task.description}"), rich.BarColumn(), rich.MofNCompleteColumn())
            self._bar = rich.Progress(
                *columns,
                rich.TimeElapsedColumn(),
                rich.TimeRemainingColumn(),
                console=Console(stderr=True),
                transient=self._passing,
                get_time=time.monotonic,
            )
            self._bar.start()
        if self._task is None or self._bar.tasks[-1].description != what:
            self._task = self._bar.add_task(what, total=of, completed=done)
            self._bar.tasks[-1].start_time = self._began  # it may have gone on for a while before it is shown
        self._bar.update(self._task, completed=done)


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table, its columns as wide as they must be."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
