"""The bodies of a process as one body: rows of several devices side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, Final

import numpy as np

from agents import plugins
from agents.body import Body, BodyRequest, BodyState
from agents.rows import Array, Index

PER_ROW: Final[dict[str, object]] = {"notes": "", "ranges": None}  # fields that are tuples, and what stands for none


class Fleet:
    """Bodies, each with the rows of the process that it carries; implements `agents.body.Body`."""

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
            for body in opened:
                body.close()
            raise

    def read(self, t: float) -> BodyState:
        """See `Body.read`."""
        if len(self._parts) == 1:
            return self._parts[0][1].read(t)
        states = [(group, body.read(t)) for group, body in self._parts]
        merged: dict[str, Any] = {}
        for field in fields(BodyState):
            if field.name in PER_ROW:
                merged[field.name] = self._gathered(field.name, states)
                continue
            first = getattr(states[0][1], field.name)
            column = np.empty((self._rows, *first.shape[1:]), dtype=first.dtype)
            for group, state in states:
                column[group] = getattr(state, field.name)
            merged[field.name] = column
        return BodyState(**merged)

    def _gathered(self, name: str, states: Sequence[tuple[Index, BodyState]]) -> tuple[object, ...]:
        """A tuple with an entry per row from bodies of which some give none."""
        if not any(getattr(state, name) for _, state in states):
            return ()
        found: list[object] = [PER_ROW[name]] * self._rows
        for group, state in states:
            for row, value in zip(group, getattr(state, name), strict=False):
                found[row] = value
        return tuple(found)

    def command(self, setpoint: Array) -> None:
        """See `Body.command`."""
        for group, body in self._parts:
            body.command(setpoint[group])

    def takeoff(self, rows: Index, height: Array) -> None:
        """See `Body.takeoff`."""
        for body, which in self._split(rows):
            body.takeoff(self._place[rows[which]], height[which])

    def land(self, rows: Index) -> None:
        """See `Body.land`."""
        for body, which in self._split(rows):
            body.land(self._place[rows[which]])

    def stop(self, rows: Index) -> None:
        """See `Body.stop`."""
        for body, which in self._split(rows):
            body.stop(self._place[rows[which]])

    def locate(self, row: int, t: float, position: Array, yaw: float) -> None:
        """See `Body.locate`."""
        for group, body in self._parts:
            if row in group:
                body.locate(int(self._place[row]), t, position, yaw)

    def close(self) -> None:
        """Closes every body."""
        for _, body in self._parts:
            body.close()

    def _split(self, rows: Index) -> list[tuple[Body, Index]]:
        """Each body with those entries of `rows` that it carries."""
        found = [(body, np.flatnonzero(np.isin(rows, group))) for group, body in self._parts]
        return [(body, which) for body, which in found if len(which)]


def assemble(request: BodyRequest) -> Fleet:
    """The bodies that the addresses of a request ask for.

    Raises:
        plugins.UnknownPlugin: If no body of that name is installed.
        BodyError: If a body cannot carry these rows.
    """
    names = [plugins.body_name(address) for address in request.addresses]
    parts = []
    for name in dict.fromkeys(names):
        group = np.array([row for row, other in enumerate(names) if other == name], dtype=np.intp)
        parts.append((group, plugins.load(plugins.BODIES, name)(request.of(group))))
    return Fleet(len(names), parts)
