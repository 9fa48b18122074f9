"""Transmission: which rows transmit their pose now, smoothed if the trigger asks for it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from agents.arrays import Array, Index, clamp, every
from agents.body.kinds import Kind
from agents.network.validation import MAX_SPEED
from agents.plugins.calls import failure
from agents.plugins.predictors import HOLD, Predictor
from agents.plugins.registry import FAILURES
from agents.plugins.triggers import LastEvent, Trigger, View


class Transmission(msgspec.Struct, frozen=True):
    """Poses to transmit."""

    rows: Index  # (K,) that transmit
    position: Array  # (N, 3) to transmit [m]
    velocity: Array  # (N, 3) to transmit [m/s]


class Transmitter:
    """Transmissions of N rows."""

    def __init__(
        self, trigger: Trigger, rows: int, predictor: Predictor = HOLD, *, kinds: Sequence[Kind] | None = None
    ) -> None:
        """Without `kinds` rows are smoothed as robots on wheels are."""
        self.trigger = trigger  # may be replaced by one of the same kind
        self.last_event = LastEvent(rows)  # last transmission of each row
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
        """Transmission at `t` [s]; rows without a known position do not transmit. For the arguments see `View`.

        `setpoint` (N, 4) is the last command to the bodies, NaN for rows that their bodies drive by themselves. An
        unknown velocity is transmitted as NaN, and counts as 0 for trigger and smoothing, as the neighbours assume.
        Raises PluginError, which names the trigger, if it fails.
        """
        trigger = self.trigger
        unknown: Index | None = None
        if not every(known := np.abs(velocity) <= MAX_SPEED):  # implausible, hence unknown
            unknown = np.flatnonzero(~known.all(axis=1))
            velocity = velocity.copy()
            velocity[unknown] = 0.0
        if trigger.smoothing_s > 0.0:
            if self._smoothed is None:
                self._smoothed = LowPass(len(position), self._kinds)
            position, velocity = self._smoothed.smooth(t, position, velocity, trigger.smoothing_s, setpoint)
        view = View(t, position, velocity, self.last_event, error, energy, start, offset, self._predictor)
        rows = due_rows(trigger, view, self._state)
        if len(rows):
            valid = np.isfinite(position if len(rows) == len(position) else position[rows])
            if not every(valid):
                rows = rows[valid.all(axis=1)]
            self.last_event.record(rows, view)
        if unknown is not None:
            velocity = velocity.copy()  # the recorded event keeps its values
            velocity[unknown] = np.nan
        return Transmission(rows, position, velocity)


def due_rows(trigger: Trigger, view: View, state: Array) -> Index:
    """`Trigger.due`, with an error that names the trigger."""
    try:
        return trigger.due(view, state)
    except FAILURES as error:
        raise failure("trigger", trigger, error) from error


class LowPass:
    """Positions without jitter: extrapolated by a velocity, and drawn to the measured ones with a time constant.

    A bare low-pass of the position would lag by τ·v behind a robot that drives, 0.1 m at 0.15 m/s and 0.7 s. This one
    does not: ṗ_f = v + (p − p_f)/τ and v̇_f = (v − v_f)/τ, with p − p_f and v as they are at the end of a step.

    v of a robot on wheels is its measured velocity. A flying robot's measured velocity contains the wobble, which would
    enter the transmitted position. Its horizontal v therefore follows from its own setpoints: v̇ = (v_c − v)/T, with T
    the lag of its kind, v_c the commanded velocity, or K (setpoint − p_f) within its speed if positions are commanded.
    Such a model of a robot on both sides of a network is the idea of L. A. Montestruque and P. J. Antsaklis, "On the
    model-based control of networked systems", Automatica 39(10), 2003. Where the robot deviates from its model by Δv,
    p_f is off by τ·Δv.
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
        """Smoothed position [m] and velocity [m/s] (N, 3) at `t` [s], from the measured ones and the last setpoint.

        Rows begin at their measured pose, and begin anew after it was unknown.
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
        """Horizontal velocity (F, 2) of the flying rows from their setpoints; without setpoints the measured one."""
        toward = self._response * (setpoint - self._position[self._flies, :2])
        due_rows = clamp(np.where(self._by_place, toward, setpoint), -self._speed, self._speed)
        driven = self._driven + step / (self._lag + step) * (due_rows - self._driven)
        self._driven = np.where(np.isnan(driven), measured, driven)
        return self._driven
