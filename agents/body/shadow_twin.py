"""Shadow twin: a twin beside a robot that gets the same commands; its deviation measures the quality of the model.

The twin is reset to the measured pose and velocity of the robot at the robot's first setpoint (of a flying one: the
first in the air), and then every `restart_s`. In between it runs by itself. Right after a reset the difference is zero;
it grows to the error of predicting the robot for that time. Over a whole run the difference is that prediction's,
averaged over horizons from nothing to `restart_s`. A twin that is never restarted shows the error of simulating the
whole run: the drift of speed and yaw adds up.
"""

from __future__ import annotations

import contextlib
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf, isfinite, isnan, nan
from typing import Final

from agents.body.interface import Body, BodyRequest, BodyState, Disturbance
from agents.network.messages import Inspection
from agents.plugins import registry
from agents.vectors import UNKNOWN, Setpoint, Vector, is_finite

TWIN: Final = "twin"
FRESH_S: Final = 0.25  # a pose older than this is not where the robot is


class Placeable(Body):
    """A body with robots that can be placed, such as a twin."""

    @abstractmethod
    def place(
        self,
        rows: Sequence[int],
        positions: Sequence[Vector],
        yaws: Sequence[float],
        flying: Sequence[bool],
        velocities: Sequence[Vector] | None = None,
    ) -> None:
        """Puts robots at positions [m] with yaws [rad], in the air or not, moving [m/s] or at rest."""


class Shadowed(Body):
    """A body with twins beside some of its robots, without effect on them.

    A twin that fails is left alone from then on, and the notes of its robots say so.
    """

    def __init__(self, body: Body, twin: Placeable, rows: Sequence[int], restart_s: Sequence[float]) -> None:
        """`twin` has a robot for each of `rows` of the body; `restart_s` [s] of each is infinite for once."""
        self._body = body
        self._rows, self._restart = tuple(rows), tuple(restart_s)
        self._twin: Placeable | None = twin
        self._trouble = ""
        count = len(self._rows)
        self._placed, self._driven = [False] * count, [False] * count
        self._due = [-inf] * count

    def open(self) -> None:
        self._body.open()
        self._try(lambda twin: twin.open())

    def read(self, t: float) -> Sequence[BodyState]:
        states = self._body.read(t)
        for row in self._rows:
            states[row].shadow_position, states[row].shadow_yaw = UNKNOWN, nan
        self._try(lambda twin: self._follow(twin, t, states))
        for row in self._rows if self._trouble else ():
            state = states[row]
            state.note = f"{state.note}; {self._trouble}" if state.note else self._trouble
        return states

    def command(self, setpoints: Sequence[Setpoint]) -> None:
        self._body.command(setpoints)
        shadowed = [setpoints[row] for row in self._rows]
        for k, setpoint in enumerate(shadowed):
            if all(map(isfinite, setpoint)) and any(setpoint):
                self._driven[k] = True
        self._try(lambda twin: twin.command(shadowed))

    def takeoff(self, rows: Sequence[int], heights: Sequence[float]) -> None:
        self._body.takeoff(rows, heights)
        to = [height for row, height in zip(rows, heights, strict=True) if row in self._rows]
        self._try(lambda twin: twin.takeoff(self._twin_rows(rows), to))

    def land(self, rows: Sequence[int]) -> None:
        self._body.land(rows)
        self._try(lambda twin: twin.land(self._twin_rows(rows)))

    def stop(self, rows: Sequence[int]) -> None:
        self._body.stop(rows)
        self._try(lambda twin: twin.stop(self._twin_rows(rows)))

    def locate(self, row: int, t: float, position: Vector, yaw: float) -> None:
        """See `Body.locate`; the twin needs no external pose."""
        self._body.locate(row, t, position, yaw)

    def inspect(self, row: int) -> Inspection:
        """See `Body.inspect`: of the robot, not of the twin."""
        return self._body.inspect(row)

    def close(self) -> None:
        try:
            self._body.close()
        finally:
            self._try(lambda twin: twin.close())

    def _follow(self, twin: Placeable, t: float, states: Sequence[BodyState]) -> None:
        """Simulates the twin, restarts it at the poses of its robots when due, and stores its poses in the states."""
        shadows = twin.read(t)
        if due := [k for k, row in enumerate(self._rows) if self._restarts(k, t, states[row])]:
            robots = [states[self._rows[k]] for k in due]
            twin.place(
                due,
                [robot.position for robot in robots],
                [robot.yaw for robot in robots],
                [robot.flying for robot in robots],
                [_known(robot.velocity) for robot in robots],
            )
            for k in due:
                self._placed[k] = True
                if self._driven[k]:
                    self._due[k] = t + self._restart[k]
            shadows = twin.read(t)
        for k, row in enumerate(self._rows):
            if self._placed[k]:
                states[row].shadow_position, states[row].shadow_yaw = shadows[k].position, shadows[k].yaw

    def _restarts(self, k: int, t: float, state: BodyState) -> bool:
        """Whether a robot of the twin is put onto its robot now, which must know where it is."""
        if self._placed[k] and not (self._driven[k] and t >= self._due[k] - 1e-9):
            return False
        return t - state.time <= FRESH_S and is_finite(state.position) and isfinite(state.yaw)

    def _twin_rows(self, rows: Sequence[int]) -> list[int]:
        """Robots of the twin for `rows` of the body, as their motors switch on or off."""
        twin_rows = [self._rows.index(row) for row in rows if row in self._rows]
        for k in twin_rows:
            self._driven[k], self._due[k] = False, -inf
        return twin_rows

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


def _known(velocity: Vector) -> Vector:
    """A velocity with 0 in place of NaN."""
    x, y, z = velocity
    return 0.0 if isnan(x) else x, 0.0 if isnan(y) else y, 0.0 if isnan(z) else z


def shadowed(body: Body, request: BodyRequest, restart_s: Sequence[float]) -> Body:
    """The body, made for `request`, with undisturbed twins beside it; the body itself without any.

    `restart_s` is the period with which the twin of each robot is put onto it [s]: infinite for once, NaN for robots
    without a twin. Raises registry.PluginError if no twin is installed, BodyError if there is none of a robot's kind.
    """
    rows = [row for row, period in enumerate(restart_s) if not isnan(period)]
    if not rows:
        return body
    count = len(rows)
    ideal = replace(
        request.select(rows),
        addresses=(TWIN,) * count,
        disturbance=(Disturbance(),) * count,
        external=(False,) * count,
        device=({},) * count,
    )
    return Shadowed(body, registry.load(registry.BODIES, TWIN)(ideal), rows, [restart_s[row] for row in rows])
