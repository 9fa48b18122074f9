"""EpisodeStates of episodes: pickled flights, without what no flight changes."""

from __future__ import annotations

import io
import pickle
from collections.abc import Iterable, Sequence
from dataclasses import fields
from typing import Any

from agents.decision.assignment import Assignment
from experiments.definition.plan import Plan
from experiments.learning.actions import LearningError


class StatePickler(pickle.Pickler):
    """Writes a state without what all states of an environment share: its place in `shared` stands for it."""

    def __init__(self, buffer: io.BytesIO, shared: Sequence[object]) -> None:
        super().__init__(buffer, pickle.HIGHEST_PROTOCOL)
        self._places = {id(each): number for number, each in enumerate(shared)}

    def persistent_id(self, obj: object) -> int | None:
        return self._places.get(id(obj))


class StateUnpickler(pickle.Unpickler):
    """Reads a state that `Environment.save` made in this process."""

    def __init__(self, state: bytes, shared: Sequence[object]) -> None:
        super().__init__(io.BytesIO(state))
        self._shared = shared

    def persistent_load(self, pid: int) -> object:
        return self._shared[pid]


class EpisodeStates:
    """Writes and reads the states of an environment."""

    def __init__(self, plan: Plan, assignments: Iterable[Assignment]) -> None:
        """Of flights of a `plan` by these assignments: states refer to both."""
        given = [*assignments]
        parts = [getattr(each, field.name) for each in given for field in fields(each)]
        self._shared = [plan, *given, *(part for part in parts if not isinstance(part, int | float | str))]
        self._engine = plan.engine_name

    def save(self, what: object) -> bytes:
        """A state; raises LearningError where the engine keeps none."""
        buffer = io.BytesIO()
        try:
            StatePickler(buffer, self._shared).dump(what)
        except TypeError as error:  # a foreign engine
            message = f"the engine {self._engine} keeps no states ({error})"
            raise LearningError(f"{message}; leave `starts` out, or take the engine point-mass") from None
        return buffer.getvalue()

    def restore(self, state: bytes) -> Any:  # noqa: ANN401 - what was saved
        """Objects that were saved in this process."""
        return StateUnpickler(state, self._shared).load()
