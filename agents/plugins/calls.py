"""Calls of plug-ins, with errors that name them."""

from __future__ import annotations

import sys
from traceback import extract_tb

import numpy as np

from agents.arrays import Array
from agents.plugins.registry import FAILURES, PluginError


def call(what: str, plugin: object, method: str, *inputs: object, shape: tuple[int, ...], each: str) -> Array:
    """Result, as numbers, of a `method` of a plug-in, a law for example, that has this `shape`: `each` in words.

    Raises PluginError, which names the plug-in, if it fails or gives something else.
    """
    try:
        result = getattr(plugin, method)(*inputs)
        given = np.asarray(result, dtype=float)
    except FAILURES as error:
        raise failure(what, plugin, error) from error
    if result is None or given.shape != shape:
        got = "nothing: is a `return` missing?" if result is None else str(given.shape)
        name, file = type(plugin).__name__, _file(plugin)
        raise PluginError(f"`{method}` of the {what} {name} must give {each}, {shape}, not {got} ({file})")
    return given


def failure(what: str, plugin: object, error: Exception) -> PluginError:
    """Error that names a plug-in which failed, with the last line of its file that was at work."""
    file = _file(plugin)
    lines = [frame.lineno for frame in extract_tb(error.__traceback__) if frame.filename == file]
    place = f"{file}:{lines[-1]}" if lines else file
    return PluginError(f"the {what} {type(plugin).__name__} failed: {type(error).__name__}: {error} ({place})")


def _file(plugin: object) -> str:
    module = type(plugin).__module__
    return getattr(sys.modules.get(module), "__file__", None) or module
