"""Shadow twin: a twin beside a robot that gets the same commands; its deviation measures the quality of the model.

The twin is put onto the robot, with its measured pose and velocity, when the robot is first driven (a flying one: when
it is in the air and gets its first setpoint), and again every `restart_s`. In between it runs by itself. Right after
a restart the difference is nothing; what it grows to is the error of predicting the robot for as long. Over a whole
run the difference is that prediction's, averaged over horizons from nothing to `restart_s`. A twin that is never
restarted shows the error of simulating the whole run: the drift of speed and yaw adds up.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace
from typing import Final, Protocol

import numpy as np

from agents.arrays import Array, Index, Mask
from agents.body.interface import Body, BodyRequest, BodyState, Disturbance, inspect
from agents.network.messages import Inspection
from agents.plugins import registry

TWIN: Final = "twin"
FRESH_S: Final = 0.25  # a pose older than this is not where the robot is


class Placeable(Body, Protocol):
    """A body whose rows can be placed, such as a twin."""

    def place(self, rows: Index, position: Array, yaw: Array, flying: Mask, velocity: Array | None = None) -> None:
        """Puts rows at (len(rows), 3) [m] with yaw (len(rows),) [rad], in the air or not, moving or at rest."""
        ...


class Shadowed:
    """A body with twins beside some of its rows; implements `agents.body.interface.Body`, without effect on the robots.

    A twin that fails is left alone from then on, and the notes of its rows say so.
    """

    def __init__(self, body: Body, twin: Placeable, rows: Index, restart_s: Array) -> None:
        """`twin` has a row for each of `rows` of the body; `restart_s` (len(rows),) [s] is infinite for once."""
        self._body, self._rows, self._restart = body, rows, restart_s
        self._twin: Placeable | None = twin
        self._trouble = ""
        count = len(rows)
        self._placed, self._driven = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        self._due = np.full(count, -np.inf)

    def open(self) -> None:
        self._body.open()
        self._try(lambda twin: twin.open())

    def read(self, t: float) -> BodyState:
        state = self._body.read(t)
        position, yaw = np.full_like(state.position, np.nan), np.full_like(state.yaw, np.nan)
        self._try(lambda twin: self._follow(twin, t, state, position, yaw))
        notes = list(state.notes) or [""] * len(state.time)
        if self._trouble:
            for row in self._rows.tolist():
                notes[row] = "; ".join(part for part in (notes[row], self._trouble) if part)
        shown = tuple(notes) if any(notes) else ()
        return replace(state, shadow_position=position, shadow_yaw=yaw, notes=shown)

    def command(self, setpoint: Array) -> None:
        self._body.command(setpoint)
        mine = setpoint[self._rows]
        self._driven |= np.isfinite(mine).all(axis=1) & (mine != 0.0).any(axis=1)
        self._try(lambda twin: twin.command(mine))

    def takeoff(self, rows: Index, height: Array) -> None:
        self._body.takeoff(rows, height)
        mine, which = self._twin_rows(rows)
        self._try(lambda twin: twin.takeoff(mine, height[which]))

    def land(self, rows: Index) -> None:
        self._body.land(rows)
        mine, _ = self._twin_rows(rows)
        self._try(lambda twin: twin.land(mine))

    def stop(self, rows: Index) -> None:
        self._body.stop(rows)
        mine, _ = self._twin_rows(rows)
        self._try(lambda twin: twin.stop(mine))

    def locate(self, row: int, t: float, position: Array, yaw: float) -> None:
        """See `Body.locate`; the twin needs no external pose."""
        self._body.locate(row, t, position, yaw)

    def inspect(self, row: int) -> Inspection:
        """See `Inspectable.inspect`: of the robot, not of the twin."""
        return inspect(self._body, row)

    def close(self) -> None:
        try:
            self._body.close()
        finally:
            self._try(lambda twin: twin.close())

    def _follow(self, twin: Placeable, t: float, state: BodyState, position: Array, yaw: Array) -> None:
        """Simulates the twin, restarts rows at the pose of their robot when due, and stores its pose in the state."""
        shadow = twin.read(t)
        rows = self._rows
        known = np.isfinite(state.position[rows]).all(axis=1) & np.isfinite(state.yaw[rows])
        known &= t - state.time[rows] <= FRESH_S
        due = np.flatnonzero(known & (~self._placed | (self._driven & (t >= self._due - 1e-9))))
        if len(due):
            at = rows[due]
            velocity = np.nan_to_num(state.velocity[at], nan=0.0)
            twin.place(due, state.position[at].copy(), state.yaw[at].copy(), state.flying[at].copy(), velocity)
            self._placed[due] = True
            begun = due[self._driven[due]]
            self._due[begun] = t + self._restart[begun]
            shadow = twin.read(t)
        shown = np.flatnonzero(self._placed)
        position[rows[shown]], yaw[rows[shown]] = shadow.position[shown], shadow.yaw[shown]

    def _twin_rows(self, rows: Index) -> tuple[Index, Index]:
        """The twin's rows among those of the body, whose motors come on or go off; and where they stand in `rows`."""
        which = np.flatnonzero(np.isin(rows, self._rows))
        mine = np.searchsorted(self._rows, rows[which])
        self._driven[mine], self._due[mine] = False, -np.inf
        return mine, which

    def _try(self, act: Callable[[Placeable], None]) -> None:
        twin = self._twin
        if twin is None:
            return
        try:
            act(twin)
        except Exception as error:  # noqa: BLE001 - of any kind: without effect on the robot
            self._twin = None
            self._trouble = f"its shadow failed: {type(error).__name__}: {error}"
            with contextlib.suppress(Exception):
                twin.close()


def shadowed(body: Body, request: BodyRequest, restart_s: Array) -> Body:
    """The body, made for `request`, with undisturbed twins beside it; the body itself without any.

    `restart_s` (n,) is the period with which the twin is put onto its robot [s]: infinite for once, NaN for robots
    without a twin. Raises registry.PluginError if no twin is installed, BodyError if there is none of a robot's kind.
    """
    rows = np.flatnonzero(~np.isnan(restart_s))
    if not len(rows):
        return body
    count = len(rows)
    ideal = replace(
        request.select(rows),
        addresses=(TWIN,) * count,
        disturbance=(Disturbance(),) * count,
        external=(False,) * count,
        device=({},) * count,
    )
    return Shadowed(body, registry.load(registry.BODIES, TWIN)(ideal), rows, restart_s[rows])
