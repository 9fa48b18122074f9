"""The bodies of a process as one body: rows of several devices side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np

from agents.arrays import Array, Index
from agents.body.interface import Body, BodyRequest, BodyState, Rays, call_all, inspect
from agents.network.messages import Inspection
from agents.plugins import registry


class Fleet:
    """Bodies, each with the rows of the process that it carries; implements `agents.body.interface.Body`."""

    def __init__(self, rows: int, parts: Sequence[tuple[Index, Body]]) -> None:
        """`parts` are bodies and their rows; together they carry all `rows`."""
        self._rows = rows
        self._parts = list(parts)
        self._place = np.zeros(rows, dtype=np.intp)
        for group, _ in self._parts:
            self._place[group] = np.arange(len(group))

    def open(self) -> None:
        """Opens every body; if one fails, those already open are closed again."""
        opened: list[Body] = []
        try:
            for _, body in self._parts:
                body.open()
                opened.append(body)
        except BaseException:
            call_all(body.close for body in opened)
            raise

    def read(self, t: float) -> BodyState:
        states = [(group, body.read(t)) for group, body in self._parts]
        merged: dict[str, Any] = {}
        for field in fields(BodyState):
            merged[field.name] = self._merged(
                field.name, [(group, getattr(state, field.name)) for group, state in states]
            )
        return BodyState(**merged)

    def _merged(self, name: str, parts: Sequence[tuple[Index, Any]]) -> Any:  # noqa: ANN401 - the type of that field
        """A field of the state of all rows, from bodies of which some may lack it."""
        if name == "rays":
            return Rays.of_bodies(parts)
        if name in {"notes", "refusals"}:
            notes = [""] * self._rows
            for group, own in parts:
                for row, note in zip(group, own, strict=False):
                    notes[row] = note
            return tuple(notes) if any(notes) else ()
        first = next((value for _, value in parts if value is not None), None)
        if first is None:
            return None
        column = np.full((self._rows, *first.shape[1:]), np.nan if first.dtype == float else 0, dtype=first.dtype)
        for group, value in parts:
            if value is not None:
                column[group] = value
        return column

    def command(self, setpoint: Array) -> None:
        for group, body in self._parts:
            body.command(setpoint[group])

    def takeoff(self, rows: Index, height: Array) -> None:
        for body, which in self._split(rows):
            body.takeoff(self._place[rows[which]], height[which])

    def land(self, rows: Index) -> None:
        call_all(partial(body.land, self._place[rows[which]]) for body, which in self._split(rows))

    def stop(self, rows: Index) -> None:
        call_all(partial(body.stop, self._place[rows[which]]) for body, which in self._split(rows))

    def locate(self, row: int, t: float, position: Array, yaw: float) -> None:
        for group, body in self._parts:
            if row in group:
                body.locate(int(self._place[row]), t, position, yaw)

    def inspect(self, row: int) -> Inspection:
        body = next(body for group, body in self._parts if row in group)
        return inspect(body, int(self._place[row]))

    def close(self) -> None:
        call_all(body.close for _, body in self._parts)

    def _split(self, rows: Index) -> list[tuple[Body, Index]]:
        """Each body with its entries of `rows`."""
        found = [(body, np.flatnonzero(np.isin(rows, group))) for group, body in self._parts]
        return [(body, which) for body, which in found if len(which)]


def assemble(request: BodyRequest) -> Body:
    """The bodies for the addresses of a request; without a fleet if one body carries all rows.

    Raises registry.UnknownPlugin if a body is not installed, BodyError if one cannot carry its rows.
    """
    names = [registry.body_name(address) for address in request.addresses]
    parts = []
    for name in dict.fromkeys(names):
        group = np.array([row for row, other in enumerate(names) if other == name], dtype=np.intp)
        parts.append((group, registry.load(registry.BODIES, name)(request.select(group))))
    return Fleet(len(names), parts) if len(parts) > 1 else parts[0][1]
