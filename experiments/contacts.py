"""Contacts and what a world said, as a run keeps them: from the common start to its end."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final, TypeVar

import msgspec

from agents import plugins
from agents.wire import Contact, WorldState

ROUNDING_S: Final = 1e-6  # UTC seconds in a float are exact to a quarter of a microsecond
WALL: Final = "wall"  # of the arena, in contacts

M = TypeVar("M", Contact, WorldState)


def finds_contacts(engine: str | Mapping[str, object]) -> bool:
    """Whether an engine says of itself that it finds contacts, see `twins.engine.EngineFactory`."""
    try:
        factory = plugins.struct(plugins.ENGINES, plugins.split(engine)[0])
    except (plugins.PluginError, msgspec.ValidationError):  # a recording is read where that engine is not installed
        return False
    return bool(getattr(factory, "contacts", False))


def within(said: Iterable[M], start: float, duration: float) -> tuple[M, ...]:
    """What was said in a run that began at `start` [s], in order of time, which then counts from there."""
    kept = [
        msgspec.structs.replace(each, stamp=max(each.stamp - start, 0.0))
        for each in said
        if -ROUNDING_S <= each.stamp - start <= duration + ROUNDING_S
    ]
    return tuple(sorted(kept, key=lambda each: each.stamp))


def looked_for(contacts: Sequence[Contact], world: Iterable[WorldState]) -> bool:
    """Whether somebody watched for contacts: there are some, or an engine that would have found them."""
    return bool(contacts) or any(finds_contacts(engine) for engine in {said.engine for said in world})
