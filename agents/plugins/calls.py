"""Errors of plug-ins, in words that name them.

Ticks call plug-ins directly. One `try` stands around the tick of a robot; `explain` finds the plug-in to blame for what
it catches. `supervised` stands around a command: a plug-in in it neither ends the process nor keeps it for ever.
"""

from __future__ import annotations

import linecache
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from math import isnan
from traceback import walk_stack, walk_tb
from types import FrameType
from typing import Any, Final, NoReturn

from agents.errors import join_names
from agents.formation.link import Link
from agents.plugins.files import plain
from agents.plugins.law import Law, NeighbourView, View
from agents.plugins.registry import FAILURES, PluginError, owner_of

LONGEST: Final = 60  # characters of a result that is shown
LIMIT_S: Final = 5.0  # [s] longest call of a plug-in; it is noticed after twice that at the latest
PREPARING: Final = {"<module>", "begin", "build", "analyse", "of"}  # calls that may load libraries or read a whole run
PATIENCE: Final = 12  # times `LIMIT_S` that such calls may take


def explain(error: BaseException, plugins: Iterable[tuple[str, object]]) -> BaseException:
    """Error that names the one of `plugins` that is to blame for an exception of a tick; else the exception itself.

    Each plug-in comes with its sort, a law for example. A plug-in is to blame if its method was running, or if the
    calling line could not use its result.
    """
    if isinstance(error, PluginError):
        return error
    frames = list(walk_tb(error.__traceback__))
    known = list(plugins)
    for frame, _ in reversed(frames):
        for what, plugin in known:
            method = getattr(type(plugin), frame.f_code.co_name, None)
            if getattr(method, "__code__", None) is frame.f_code:
                return failure(what, plugin, error)
    if frames and isinstance(error, TypeError | ValueError):
        frame, number = frames[-1]
        called = re.findall(r"\.(\w+)\(", linecache.getline(frame.f_code.co_filename, number))
        for what, plugin in known:
            for method in called:
                if callable(getattr(plugin, method, None)):
                    return _unusable(what, plugin, method, error)
    return error


def failure(what: str, plugin: object, error: BaseException) -> PluginError:
    """Error that names a plug-in which failed, with the last line of its file that was at work."""
    file = _file(plugin)
    at = [(frame, line) for frame, line in walk_tb(error.__traceback__) if frame.f_code.co_filename == file]
    place, hint = file, ""
    if at:
        frame, line = at[-1]
        place, memory = f"{file}:{line}", frame.f_locals.get("memory", {})
        if isinstance(error, KeyError) and "memory[" in linecache.getline(file, line) and error.args[0] not in memory:
            hint = f"; `begin` gave no {error.args[0]!r}, only {join_names([*memory]) or 'an empty memory'}"
    return PluginError(
        f"the {what} {type(plugin).__name__} failed: {type(error).__name__}: {error}{hint} ({plain(place)})"
    )


def wrong(what: str, plugin: object, method: str, result: object, wanted: str) -> PluginError:
    """Error that names a plug-in with a `method` that gave a `result` other than the `wanted` one, in words."""
    got = "nothing: is a `return` missing?" if result is None else repr(result)[:LONGEST]
    name, file = type(plugin).__name__, _file(plugin)
    return PluginError(f"`{method}` of the {what} {name} must give {wanted}, not {got} ({plain(file)})")


def _calls_of_plugins(frame: FrameType | None) -> list[tuple[FrameType, int]]:
    """Frames of plug-ins of others below a frame, the innermost first, with their lines."""
    return [(each, line) for each, line in walk_stack(frame) if owner_of(each) is not None]


def _place(frame: FrameType, line: int) -> str:
    return plain(f"{frame.f_code.co_filename}:{line}")


class _Alarm:
    """Handler of the alarm that rings every `LIMIT_S`; raises PluginError in a call that it meets too often."""

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._call: FrameType | None = None  # outermost call of a plug-in when it rang last
        self._rung = 0  # times that it rang in that call, without the first

    def __call__(self, _signal: int, frame: FrameType | None) -> None:
        calls = _calls_of_plugins(frame)
        call = calls[-1][0] if calls else None
        self._rung = self._rung + 1 if call is not None and call is self._call else 0
        self._call = call
        if call is None or self._rung < (PATIENCE if call.f_code.co_name in PREPARING else 1):
            return
        name, place = call.f_code.co_name, _place(*calls[0])
        what = "the import" if name == "<module>" else f"`{name}`"
        raise PluginError(
            f"{what} of the {owner_of(call)} took more than {self._rung * self._limit_s:g} s ({place}); does a loop "
            "there never end?"
        )


@contextmanager
def supervised(limit_s: float = LIMIT_S) -> Iterator[None]:
    """Block in which a plug-in of others that does not return, or that ends the process, raises PluginError.

    A call is interrupted between two lines of Python in the main thread alone; a library that never returns is not.
    Of the ways that end a process without an exception, `os._exit` is caught.
    """
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "setitimer"):
        yield
        return
    if isinstance(signal.getsignal(signal.SIGALRM), _Alarm):  # the block of a caller
        yield
        return
    end = os._exit

    def refused(status: int) -> NoReturn:
        frame = sys._getframe(1)
        if (owner := owner_of(frame)) is None:
            end(status)
        raise PluginError(f"the {owner} ends the process: os._exit({status}) ({_place(frame, frame.f_lineno)})")

    former, begun = signal.signal(signal.SIGALRM, _Alarm(limit_s)), time.monotonic()
    left, period = signal.setitimer(signal.ITIMER_REAL, limit_s, limit_s)
    os._exit = refused
    try:
        yield
    finally:
        os._exit = end
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, former)
        if left:  # rest of a timer that a caller has set
            signal.setitimer(signal.ITIMER_REAL, max(left - (time.monotonic() - begun), 1e-3), period)


class Watched:
    """Stand-in for a link or a view, which notes the unknown values that a law reads of it."""

    def __init__(self, seen: Any, notes: dict[str, None]) -> None:  # noqa: ANN401 - a link, a neighbour or a view
        self._seen, self._notes = seen, notes

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - likewise
        seen, notes = self._seen, self._notes
        value = getattr(seen, name)
        if isinstance(value, Link):
            return Watched(value, notes)
        if name == "known":
            return lambda *names: [Watched(each, notes) for each in value(*names)]
        if name == "neighbours":
            return [Watched(each, notes) for each in value]
        if name == "said" and isinstance(seen, NeighbourView):
            return _Words(value, notes)
        place = {Link: "link", View: "view"}.get(type(seen))
        if place and _is_unknown(value):
            notes[f"{place}.{name}"] = None
        return value


class _Words(dict[str, Any]):
    """Variables of a neighbour, which note those that are read and were not said yet."""

    def __init__(self, said: Any, notes: dict[str, None]) -> None:  # noqa: ANN401 - likewise
        super().__init__(said)
        self._notes = notes

    def __getitem__(self, name: str) -> Any:  # noqa: ANN401 - likewise
        if _is_unknown(value := super().__getitem__(name)):
            self._notes[f"said[{name!r}]"] = None
        return value


def _is_unknown(value: object) -> bool:
    """Whether a number, or the first one of a tuple, is NaN."""
    first = value[0] if isinstance(value, tuple) and value else value
    return isinstance(first, float) and isnan(first)


def unknown_reads(law: Law, ask: Callable[[Callable[[Any], Any]], object]) -> str:
    """Words on what a law reads although it is unknown, with the remedy; empty if it reads nothing of the kind.

    `ask` calls the law, and passes what the law shall see through the function that it gets.
    """
    notes: dict[str, None] = {}
    try:
        ask(lambda seen: Watched(seen, notes))
    except FAILURES:  # it can do nothing with a stand-in
        return ""
    remedies = []
    for read in notes:
        field = read.removeprefix("link.")
        if field in {"distance", "relative", "bearing"}:
            remedies.append(f'{read}, unknown with NEEDS = "{law.NEEDS}": give the law NEEDS = "{field}"')
        elif read.startswith("said"):
            remedies.append(f"{read} of neighbours that have not said it yet: ask view.known for them")
        elif read.startswith("view.target"):
            remedies.append(f"{read} of a robot without a plan: ask math.isfinite before")
    return f": {type(law).__name__} reads {'; '.join(remedies)}" if remedies else ""


def _unusable(what: str, plugin: object, method: str, error: Exception) -> PluginError:
    hint = ": is a `return` missing?" if "NoneType" in str(error) else ""
    name, file = type(plugin).__name__, _file(plugin)
    return PluginError(f"`{method}` of the {what} {name} gives what cannot be used: {error}{hint} ({plain(file)})")


def _file(plugin: object) -> str:
    module = type(plugin).__module__
    return getattr(sys.modules.get(module), "__file__", None) or module
