"""What a person sees of a run in the terminal: a live table, or a line now and then where there is no terminal."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Final, Protocol, Self

from experiments.conductor import OUTPUT
from experiments.seen import FROZEN_S, News, Progress, Seen

if TYPE_CHECKING:
    from rich.console import RenderableType

REFRESH_S: Final = 0.25
LINE_S: Final = 5.0
EVENTS: Final = 5  # the last so many are shown below the table
QUIET: Final = ("robot",)  # kinds of events that the table shows better


class Shown(Protocol):
    """A way to show progress; a context manager, because a live table takes the terminal over."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def __call__(self, progress: Progress) -> None: ...


class Lines:
    """A line for each event and every few seconds, on standard error."""

    def __init__(self) -> None:
        self._news, self._next = News(), 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def __call__(self, progress: Progress) -> None:
        """Prints what is new."""
        for event in self._news.of(progress):
            if event.kind == OUTPUT:
                print(f"{event.source}| {event.text}", file=sys.stderr)
            elif event.kind not in QUIET:
                print(f"{progress.case}: {event.kind} {event.source}: {event.text}", file=sys.stderr)
        now = time.monotonic()
        if now >= self._next and progress.elapsed is not None:
            self._next = now + LINE_S
            errors = ", ".join(
                f"{name} {'-' if seen.gone else _metres(seen.error)}" for name, seen in progress.robots.items()
            )
            what = _silence(progress) or f"error [m] {errors}"
            print(f"{progress.case}: {progress.elapsed:5.1f} s, {progress.phase}; {what}", file=sys.stderr)


class Table:
    """A live table of the robots, on standard error."""

    def __init__(self) -> None:
        from rich.console import Console  # noqa: PLC0415 - 60 ms that only a terminal needs
        from rich.live import Live  # noqa: PLC0415

        self._live = Live(console=Console(stderr=True), refresh_per_second=4, auto_refresh=False)
        self._news, self._next = News(), 0.0

    def __enter__(self) -> Self:
        self._live.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.__exit__(None, None, None)

    def __call__(self, progress: Progress) -> None:
        """Draws the table anew, four times a second at most."""
        for event in self._news.of(progress):
            if event.kind == OUTPUT:
                self._live.console.print(f"{event.source}| {event.text}", markup=False, highlight=False)
        now = time.monotonic()
        if now >= self._next or progress.phase == "done":
            self._next = now + REFRESH_S
            self._live.update(_table(progress), refresh=True)


def shown(*, quiet: bool) -> Shown:
    """A table in a terminal, lines elsewhere, and only lines when asked to be quiet."""
    return Table() if sys.stderr.isatty() and not quiet else Lines()


def _table(progress: Progress) -> RenderableType:
    from rich import box  # noqa: PLC0415
    from rich.console import Group  # noqa: PLC0415
    from rich.table import Table as Grid  # noqa: PLC0415
    from rich.text import Text  # noqa: PLC0415

    elapsed = "" if progress.elapsed is None else f"  {progress.elapsed:5.1f} / {progress.duration:g} s"
    silence = _silence(progress) and f"; {_silence(progress)}"
    grid = Grid(title=f"{progress.case}: {progress.phase}{elapsed}{silence}", box=box.SIMPLE_HEAD, title_justify="left")
    for heading in ("robot", "phase", "error, m", "sent", "1/s", "lost", "late", "CPU", "battery", ""):
        grid.add_column(heading, justify="left" if heading in ("robot", "phase", "") else "right", no_wrap=True)
    now = progress.clock.utc()
    for name, seen in progress.robots.items():
        grid.add_row(name, *_cells(seen, now))
    news = [event for event in progress.events if event.kind not in (*QUIET, OUTPUT)][-EVENTS:]
    return Group(grid, *(Text(f"  {event.kind} {event.source}: {event.text}", style="dim") for event in news))


def _silence(progress: Progress) -> str:
    """That nothing is known of the robots at the moment; empty while a router answers."""
    silent_s = time.monotonic() - progress.silent_since
    return f"no router answers for {silent_s:.1f} s" if silent_s > 0.0 else ""


def _cells(seen: Seen, now: float) -> tuple[str, ...]:
    status = seen.status
    out = f"[{'red' if seen.out == 'lost' else 'dim'}]{seen.out}[/]"
    if status is None:
        return (out if seen.gone else "starting", *[""] * 8)
    silent = now - status.stamp > FROZEN_S
    phase = out if seen.gone else ("[yellow]silent[/]" if silent else status.phase)
    note = status.hazard or status.reason or ("misses " + ", ".join(status.missing) if status.missing else "")
    if status.malformed:
        note += f" {status.malformed} malformed"
    return (
        phase,
        _metres(seen.error),
        str(status.sent),
        f"{seen.rate:.1f}",
        str(sum(status.lost.values())),
        str(status.missed),
        f"{status.cpu_s:.1f} s",
        "" if status.battery is None else f"{100 * status.battery:.0f} %",
        note,
    )


def _metres(error: float | None) -> str:
    return "–" if error is None else f"{error:.3f}"
