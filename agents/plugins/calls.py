"""Errors of plug-ins, in words that name them.

Ticks call plug-ins directly. One `try` stands around the tick of a robot; `explain` finds the plug-in to blame for what
it catches.
"""

from __future__ import annotations

import linecache
import re
import sys
from collections.abc import Iterable
from traceback import extract_tb, walk_tb
from typing import Final

from agents.plugins.files import plain
from agents.plugins.registry import PluginError

LONGEST: Final = 60  # characters of a result that is shown


def explain(error: Exception, plugins: Iterable[tuple[str, object]]) -> Exception:
    """Error that names the one of `plugins` that is to blame for an exception of a tick; else the exception itself.

    A plug-in, which comes with what it is, a law for example, is to blame if its method was at work, or if the line
    that called it could not use its result.
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
    """Error that names a plug-in whose `method` gave a `result` other than what is `wanted`, in words."""
    got = "nothing: is a `return` missing?" if result is None else repr(result)[:LONGEST]
    name, file = type(plugin).__name__, _file(plugin)
    return PluginError(f"`{method}` of the {what} {name} must give {wanted}, not {got} ({plain(file)})")


def _unusable(what: str, plugin: object, method: str, error: Exception) -> PluginError:
    hint = ": is a `return` missing?" if "NoneType" in str(error) else ""
    name, file = type(plugin).__name__, _file(plugin)
    return PluginError(f"`{method}` of the {what} {name} gives what cannot be used: {error}{hint} ({plain(file)})")


def _file(plugin: object) -> str:
    module = type(plugin).__module__
    return getattr(sys.modules.get(module), "__file__", None) or module
