"""Calls of plug-ins, with errors that name them."""

from __future__ import annotations

import numpy as np

from agents.arrays import Array
from agents.plugins.registry import FAILURES, PluginError


def call(what: str, plugin: object, method: str, *inputs: object, shape: tuple[int, ...], each: str) -> Array:
    """Result, as numbers, of a `method` of a plug-in, a law for example, that has this `shape`: `each` in words.

    Raises PluginError, which names the plug-in, if it fails or gives something else.
    """
    name = type(plugin).__name__
    try:
        given = np.asarray(getattr(plugin, method)(*inputs), dtype=float)
    except FAILURES as error:
        raise PluginError(f"the {what} {name} failed: {type(error).__name__}: {error}") from error
    if given.shape != shape:
        raise PluginError(f"`{method}` of the {what} {name} must give {each}, {shape}, not {given.shape}")
    return given
