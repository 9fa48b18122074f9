"""A bar on standard error that shows how far long work is."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Any, Final, Self

LINE_S: Final = 5.0  # where there is no terminal, progress is a line now and then
SHORT_S: Final = 2.0  # what is over sooner needs no passing bar
REFRESH_S: Final = 0.1


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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def show(self, what: str, done: int, of: int) -> None:
        """So much of so much is done; cheap enough to be called a thousand times a second."""
        now = time.monotonic()
        if what != self._what:
            self._what, self._began = what, now
        over = done >= of and (self._bar is not None or not self._passing)
        if now < self._next and not over:
            return
        if self._terminal:
            self._next = now + REFRESH_S
            self._draw(what, done, of)
        elif not self._passing:
            self._next = now + LINE_S
            print(f"{what} {done} of {of}", file=sys.stderr)

    def _draw(self, what: str, done: int, of: int) -> None:
        if self._bar is None:
            self._bar = _bar(transient=self._passing)
            self._bar.start()
        if self._task is None or self._bar.tasks[-1].description != what:
            self._task = self._bar.add_task(what, total=of, completed=done)
            self._bar.tasks[-1].start_time = self._began  # it may have gone on for a while before it is shown
        self._bar.update(self._task, completed=done)


def _bar(*, transient: bool) -> Any:  # noqa: ANN401 - rich is imported only here
    from rich.console import Console  # noqa: PLC0415 - 60 ms that only a terminal needs
    from rich.progress import (  # noqa: PLC0415
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    console = Console(stderr=True)
    return Progress(*columns, TimeRemainingColumn(), console=console, transient=transient, get_time=time.monotonic)
