"""Errors of plug-ins, in words that name them.

Ticks call plug-ins directly. One `try` stands around the tick of a robot; `explain` finds the plug-in to blame for what
it catches.
"""

from __future__ import annotations

import linecache
import re
import sys
from collections.abc import Callable, Iterable
from math import isnan
from traceback import extract_tb, walk_tb
from typing import Any, Final

from agents.formation.link import Link
from agents.plugins.files import plain
from agents.plugins.law import Law, NeighbourView, View
from agents.plugins.registry import FAILURES, PluginError

LONGEST: Final = 60  # characters of a result that is shown


def explain(error: Exception, plugins: Iterable[tuple[str, object]]) -> Exception:
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


def failure(what: str, plugin: object, error: Exception) -> PluginError:
    """Error that names a plug-in which failed, with the last line of its file that was at work."""
    file = _file(plugin)
    lines = [frame.lineno for frame in extract_tb(error.__traceback__) if frame.filename == file]
    place = f"{file}:{lines[-1]}" if lines else file
    return PluginError(f"the {what} {type(plugin).__name__} failed: {type(error).__name__}: {error} ({plain(place)})")


def wrong(what: str, plugin: object, method: str, result: object, wanted: str) -> PluginError:
    """Error that names a plug-in with a `method` that gave a `result` other than the `wanted` one, in words."""
    got = "nothing: is a `return` missing?" if result is None else repr(result)[:LONGEST]
    name, file = type(plugin).__name__, _file(plugin)
    return PluginError(f"`{method}` of the {what} {name} must give {wanted}, not {got} ({plain(file)})")


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
