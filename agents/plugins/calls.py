"""Calls of plug-ins, with errors that name them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from agents.arrays import Array
from agents.plugins.registry import FAILURES, PluginError


def call(what: str, method: Callable[..., Array], *inputs: object, shape: tuple[int, ...], each: str) -> Array:
    """Result of a method of a plug-in, a law for example, that has this `shape`: `each` in words.

    Raises PluginError, which names the plug-in, if it fails or gives something else.
    """
    try:
        given = method(*inputs)
    except FAILURES as error:
        raise PluginError(f"the {what} {_name(method)} failed: {type(error).__name__}: {error}") from error
    if np.shape(given) != shape:
        wrong = f"`{method.__name__}` of the {what} {_name(method)} must give {each}"
        raise PluginError(f"{wrong}, {shape}, not {np.shape(given)}")
    return given


def _name(method: Callable[..., Array]) -> str:
    return type(getattr(method, "__self__", None)).__name__
