"""The bodies of a process as one body: robots of several devices side by side."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from agents.body.interface import Body, BodyRequest, BodyState, call_all, refuse
from agents.network.messages import Inspection
from agents.plugins import registry
from agents.vectors import Setpoint, Vector


class Fleet(Body):
    """Bodies, each with the rows of the process that it carries."""

    def __init__(self, parts: Sequence[tuple[Sequence[int], Body]]) -> None:
        """`parts` are bodies and their rows; together they carry all rows."""
        self._parts = list(parts)
        # the body of each row, and the row's place in it
        self._carriers = {row: (body, at) for group, body in self._parts for at, row in enumerate(group)}

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

    def read(self, t: float) -> Sequence[BodyState]:
        states: dict[int, BodyState] = {}
        for group, body in self._parts:
            states.update(zip(group, body.read(t), strict=True))
        return [states[row] for row in range(len(states))]

    def command(self, setpoints: Sequence[Setpoint]) -> None:
        for group, body in self._parts:
            body.command([setpoints[row] for row in group])

    def takeoff(self, rows: Sequence[int], heights: Sequence[float]) -> None:
        height = dict(zip(rows, heights, strict=True))
        for group, body in self._parts:
            if rising := [row for row in rows if row in group]:
                body.takeoff([self._carriers[row][1] for row in rising], [height[row] for row in rising])

    def land(self, rows: Sequence[int]) -> None:
        call_all(partial(body.land, which) for body, which in self._split(rows))

    def stop(self, rows: Sequence[int]) -> None:
        call_all(partial(body.stop, which) for body, which in self._split(rows))

    def locate(self, row: int, t: float, position: Vector, yaw: float) -> None:
        body, at = self._carriers[row]
        body.locate(at, t, position, yaw)

    def inspect(self, row: int) -> Inspection:
        body, at = self._carriers[row]
        return body.inspect(at)

    def close(self) -> None:
        call_all(body.close for _, body in self._parts)

    def _split(self, rows: Sequence[int]) -> list[tuple[Body, list[int]]]:
        """Each body that carries some of `rows`, with their places in it."""
        found = [(body, [self._carriers[row][1] for row in rows if row in group]) for group, body in self._parts]
        return [(body, which) for body, which in found if which]


def assemble(request: BodyRequest) -> Body:
    """The bodies for the addresses of a request; without a fleet if one body carries all rows.

    Raises registry.UnknownPlugin if a body is not installed, BodyError if one cannot carry its rows.
    """
    names = [registry.body_name(address) for address in request.addresses]
    parts: list[tuple[list[int], Body]] = []
    for name in dict.fromkeys(names):
        group = [row for row, other in enumerate(names) if other == name]
        body, part = registry.load(registry.BODIES, name), request.select(group)
        refuse(body, part)
        parts.append((group, body(part)))
    return Fleet(parts) if len(parts) > 1 else parts[0][1]
