"""What rows say of themselves: whose turn it is, and the pose that is said, smoothed if the trigger asks for it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from agents.arrays import Array, Index, clamp, every
from agents.body.kinds import Kind
from agents.network.validation import MAX_SPEED
from agents.plugins.predictors import HOLD, Predictor
from agents.plugins.registry import FAILURES, PluginError
from agents.plugins.triggers import LastEvent, Trigger, View


class Transmission(msgspec.Struct, frozen=True):
    """A moment of speaking: `rows` that speak, and of all rows the position and velocity (N, 3) to be said."""

    rows: Index
    position: Array
    velocity: Array


class Transmitter:
    """Of N rows.

    Attributes:
        trigger: Who speaks when; may be replaced by one of the same kind.
        last_event: What the neighbours were told.
    """

    def __init__(
        self, trigger: Trigger, rows: int, predictor: Predictor = HOLD, *, kinds: Sequence[Kind] | None = None
    ) -> None:
        """Without `kinds` rows are smoothed as robots on wheels are."""
        self.trigger, self.last_event = trigger, LastEvent.none(rows)
        self._kinds = kinds
        self._predictor, self._state = predictor, trigger.state(rows)
        self._smoothed: LowPass | None = None

    def transmit(
        self,
        t: float,
        position: Array,
        velocity: Array,
        *,
        error: Array,
        energy: Array,
        start: Array,
        offset: Array,
        setpoint: Array | None = None,
    ) -> Transmission:
        """Who speaks at `t` [s], and what; rows that do not know where they are stay silent. See `View`.

        `setpoint` (N, 4) is what the bodies were commanded last, NaN for rows that their bodies drive by themselves; it
        counts where the trigger smooths.

        An unknown velocity is said as NaN, and counts as 0 for trigger and smoothing: what the neighbours assume then.

        Raises:
            PluginError: If the trigger fails; it is named, for it may be somebody's first.
        """
        trigger = self.trigger
        unknown: Index | None = None
        if not every(known := np.abs(velocity) <= MAX_SPEED):  # as nobody would believe it, it is not known
            unknown = np.flatnonzero(~known.all(axis=1))
            velocity = velocity.copy()
            velocity[unknown] = 0.0
        if trigger.smoothing_s > 0.0:
            if self._smoothed is None:
                self._smoothed = LowPass(len(position), self._kinds)
            position, velocity = self._smoothed.smooth(t, position, velocity, trigger.smoothing_s, setpoint)
        view = View(
            t, position, velocity, self.last_event,
            error=error, energy=energy, start=start, offset=offset, predictor=self._predictor,
        )  # fmt: skip
        rows = due_rows(trigger, view, self._state)
        if len(rows):
            seen = np.isfinite(position if len(rows) == len(position) else position[rows])
            if not every(seen):
                rows = rows[seen.all(axis=1)]
            self.last_event.record(rows, view)
        if unknown is not None:
            velocity = velocity.copy()  # what neighbours were told of stays with them
            velocity[unknown] = np.nan
        return Transmission(rows, position, velocity)


def due_rows(trigger: Trigger, view: View, state: Array) -> Index:
    """`Trigger.due`; a trigger that fails is named.

    Raises:
        PluginError: See above.
    """
    try:
        return trigger.due(view, state)
    except FAILURES as error:
        what = f"{type(error).__name__}: {error}"
        raise PluginError(f"the trigger {type(trigger).__name__} failed: {what}") from error


class LowPass:
    """Positions without their jitter: carried on by a velocity, and drawn to what is measured with a time constant.

    A bare low-pass of the position would lag by τ·v behind a robot that drives, 0.1 m at 0.15 m/s and 0.7 s. This one
    does not: ṗ_f = v + (p − p_f)/τ and v̇_f = (v − v_f)/τ, with p − p_f and v as they are at the end of a step.

    v is what a robot on wheels measures of its motion. A flying robot's measured velocity has the wobble in it, which
    would be carried into the position that is said. Its horizontal v is therefore the one that its own setpoints make:
    v̇ = (v_c − v)/T, with T the lag of its kind, v_c the velocity that it is commanded, or K (setpoint − p_f) within
    its speed if it is commanded places. Such a model of a robot on both sides of a network is the idea of L. A.
    Montestruque and P. J. Antsaklis, "On the model-based control of networked systems", Automatica 39(10), 2003. Where
    the robot does something else than its model, by Δv, p_f is off by τ·Δv.
    """

    def __init__(self, rows: int, kinds: Sequence[Kind] | None = None) -> None:
        self._t = -math.inf
        self._position, self._velocity = np.full((rows, 3), np.nan), np.full((rows, 3), np.nan)
        kinds = [] if kinds is None else kinds
        flies = np.flatnonzero([kind.flies for kind in kinds])
        self._flies, aloft = flies, [kind for kind in kinds if kind.flies]
        self._by_place = np.array([kind.takes == "position" for kind in aloft], dtype=bool)[:, None]
        self._response, self._speed, self._lag = (
            np.array([getattr(kind, name) for kind in aloft])[:, None] for name in ("response", "speed", "lag")
        )
        self._driven = np.full((len(flies), 2), np.nan)

    def smooth(
        self, t: float, position: Array, velocity: Array, constant_s: float, setpoint: Array | None = None
    ) -> tuple[Array, Array]:
        """Smoothed position [m] and velocity [m/s] (N, 3) at `t` [s], after these measured ones and this setpoint.

        Rows begin with what is measured, and begin anew once they did not know it.
        """
        step = t - self._t if math.isfinite(self._t) else 0.0
        if setpoint is not None and len(self._flies):
            velocity = velocity.copy()
            velocity[self._flies, :2] = self._drive(step, velocity[self._flies, :2], setpoint[self._flies, :2])
        share = -math.expm1(-step / constant_s)
        carried = self._position + step * velocity
        smoothed = carried + share * (position - carried)
        slow = self._velocity + share * (velocity - self._velocity)
        anew = np.isnan(smoothed) | np.isnan(slow)
        if anew.any():
            smoothed, slow = np.where(anew, position, smoothed), np.where(anew, velocity, slow)
        self._t, self._position, self._velocity = t, smoothed, slow
        return smoothed, slow

    def _drive(self, step: float, measured: Array, setpoint: Array) -> Array:
        """Horizontal velocity (F, 2) that setpoints make of the rows that fly; without setpoints the measured one."""
        toward = self._response * (setpoint - self._position[self._flies, :2])
        due_rows = clamp(np.where(self._by_place, toward, setpoint), -self._speed, self._speed)
        driven = self._driven + step / (self._lag + step) * (due_rows - self._driven)
        self._driven = np.where(np.isnan(driven), measured, driven)
        return self._driven
