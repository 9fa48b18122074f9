"""Triggers: for which rows it is time, to speak (communication) or to compute the law anew (control).

A trigger is a frozen struct of its parameters, found by the entry-point group `zenpark.triggers`. It has no state:
what it must remember stands in rows outside of it, so that one serves a robot, a swarm, or a sweep of swarms. It judges
a value that somebody holds: for communication the position that the neighbours believe, for control the input that
the law was last computed from. Here are the seam and the two basic ones; the others are in
`agents.plugins.trigger_families`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np
from msgspec import Meta

from agents.arrays import Array, Index, Mask, norm, some
from agents.plugins.predictors import HOLD, Predictor

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Place = Literal["communication", "control"]

ROUNDING_S = 1e-6  # ticks are multiples of a period that binary fractions miss by less than this


@dataclass
class LastEvent:
    """What was so at the last event of each row: when it last spoke, or the law was last computed.

    Rows without an event have an infinite position and a time of minus infinity.

    Attributes:
        position: (N, 3) said [m].
        velocity: (N, 3) said [m/s].
        time: (N,) of the event [s].
        offset: (N, 3) of the law [m].
        energy: (N,) of the formation error [m²].
    """

    position: Array
    velocity: Array
    time: Array
    offset: Array
    energy: Array

    @classmethod
    def none(cls, rows: int) -> LastEvent:
        """Before any event."""
        zeros = np.zeros((rows, 3))
        return cls(np.full((rows, 3), np.inf), zeros, np.full(rows, -np.inf), zeros.copy(), np.zeros(rows))

    def record(self, rows: Index, view: View) -> None:
        """An event of `rows`: remembers what they see."""
        if len(rows) == len(self.time):  # all of them, as always in a process of one: a copy, without an index
            self.position[:], self.velocity[:], self.time[:] = view.position, view.velocity, view.t
            self.offset[:], self.energy[:] = view.offset, view.energy
            return
        self.position[rows], self.velocity[rows], self.time[rows] = view.position[rows], view.velocity[rows], view.t
        self.offset[rows], self.energy[rows] = view.offset[rows], view.energy[rows]


class View:
    """What a trigger may look at, in rows; what costs something is computed when it is looked at.

    Attributes:
        t: Now [s].
        position: (N, 3) own [m]; for communication what would be said, smoothed if that is asked for.
        velocity: (N, 3) own [m/s].
        last_event: The last event of each row.
        error: (N,) Σ|e| of its links, as the row itself sees them [m].
        energy: (N,) edge potential Σ ½e² of its links [m²].
        start: (N,) when each row began, or will [s].
        predictor: How neighbours carry on what they were told.
    """

    def __init__(
        self,
        t: float,
        position: Array,
        velocity: Array,
        last_event: LastEvent,
        *,
        error: Array,
        energy: Array,
        start: Array,
        offset: Array,
        predictor: Predictor = HOLD,
    ) -> None:
        self.t, self.position, self.velocity, self.last_event = t, position, velocity, last_event
        self.error, self.energy, self.start, self.predictor = error, energy, start, predictor
        self._offset = offset

    @property
    def since_event(self) -> Array:
        """(N,) t − t_k: time since the last event [s], infinite before the first."""
        return self.t - self.last_event.time

    @property
    def since_start(self) -> Array:
        """(N,) time since the row's start in the experiment [s], 0 before."""
        return np.maximum(self.t - self.start, 0.0)

    @property
    def offset(self) -> Array:
        """(N, 3) u of the law [m]: as it was last decided, for control as it would be now."""
        return self._offset

    @cached_property
    def believed(self) -> Array:
        """(N, 3) where the neighbours believe each row to be [m]; infinite before it first spoke."""
        if self.predictor is HOLD:
            return self.last_event.position
        age = np.where(np.isinf(self.last_event.time), 0.0, self.since_event)
        return self.predictor.position(self.last_event.position, self.last_event.velocity, age)

    @cached_property
    def deviation(self) -> Array:
        """(N,) ‖ε‖: how far what is held is from what is [m]."""
        return norm(self.position - self.believed)

    @property
    def drift(self) -> Array:
        """(N,) how fast ε began to grow after the last event, as was known then [m/s]."""
        told = self.last_event.velocity
        return norm(told - self.predictor.velocity(told, np.zeros(len(told))))

    @property
    def reach_s(self) -> float:
        """For how long after an event `drift` stays what it was [s], if nobody changes speed."""
        return self.predictor.reach_s


class Trigger(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters that every trigger has, and the question that each answers in its own way.

    Class attributes of a kind of trigger: `places` where it makes sense, the `prediction` that it needs (an experiment
    that names none gets it), and whether it `judges_errors` of the formation, which a robot that is guided by a centre
    does not know: for it they are 0.
    """

    places: ClassVar[tuple[Place, ...]] = ("communication", "control")
    prediction: ClassVar[str] = "hold"
    judges_errors: ClassVar[bool] = False

    minimum_interval_s: Annotated[NotNegative, Meta(description="never sooner after the last event [s]")] = 0.0
    maximum_silence_s: Annotated[Positive | None, Meta(description="at the latest so long after it [s]")] = None
    evaluate_every_s: Annotated[
        Positive | None,
        Meta(description="its condition is looked at this often [s]; left out: as often as it is asked"),
    ] = None
    smoothing_s: Annotated[
        NotNegative, Meta(description="time constant of the low-pass on what is said and judged [s]; 0: none")
    ] = 0.0

    def memory(self, rows: int) -> Array:
        """What it remembers of each row, at the beginning: (N, k)."""
        return np.zeros((rows, 0))

    def fires(self, view: View, memory: Array) -> Mask:
        """For which rows (N,) its condition holds; `memory` (N, k) is updated in place."""
        raise TypeError(f"{type(self).__name__} must say when it fires")

    def state(self, rows: int) -> Array:
        """What must be kept from one question to the next (N, 1 + k): when it was last evaluated, and its memory."""
        return np.concatenate([np.full((rows, 1), -np.inf), self.memory(rows)], axis=1)

    def due(self, view: View, state: Array) -> Index:
        """Rows that have an event now; `state` of `Trigger.state` is updated in place.

        Rows without any event yet have one. Others have one where the condition holds, no sooner than the minimum
        interval, and in any case at the maximum silence. With `evaluate_every_s` this is periodic event-triggered
        control (Heemels, Donkers and Teel, "Periodic event-triggered control for linear systems", IEEE Transactions
        on Automatic Control 58(4), 2013).

        Raises:
            ValueError: If `fires` does not give one bool per row.
        """
        fired = self._evaluated(view, state)
        if np.shape(fired) != view.last_event.time.shape:
            raise ValueError(f"`fires` must give one bool per row, {view.last_event.time.shape}, not {np.shape(fired)}")
        quiet = view.since_event
        if self.maximum_silence_s is not None:
            fired = fired | (quiet >= self.maximum_silence_s - ROUNDING_S)
        if self.minimum_interval_s > 0.0:
            fired = fired & (quiet >= self.minimum_interval_s - ROUNDING_S)
        return np.asarray((fired | (quiet == np.inf)).nonzero()[0])

    def _evaluated(self, view: View, state: Array) -> Mask:
        if self.evaluate_every_s is None:
            return self.fires(view, state[:, 1:])
        ripe = view.t - state[:, 0] >= self.evaluate_every_s - ROUNDING_S
        if not some(ripe):
            return ripe
        before = state.copy()
        fired = self.fires(view, state[:, 1:])
        state[:, 0] = view.t
        state[~ripe] = before[~ripe]  # rows that nobody looked at remember what they did
        return fired & ripe


class Periodic(Trigger, frozen=True):
    """t − t_k ≥ T."""

    period_s: Annotated[Positive, Meta(description="T [s]")] = 0.02

    def fires(self, view: View, memory: Array) -> Mask:
        """See `Trigger.fires`."""
        return view.since_event >= self.period_s - ROUNDING_S


class SendOnDelta(Trigger, frozen=True):
    """‖ε‖ > δ: what is held is off by more than a threshold.

    M. Miskowicz, "Send-On-Delta Concept: An Event-Based Data Reporting Strategy", Sensors 6(1), 2006, 49–63; here on
    the distance of positions. Case 2 of the paper's experiment, with δ = 1 cm.
    """

    threshold: Annotated[Positive, Meta(description="δ [m]")] = 0.01

    def fires(self, view: View, memory: Array) -> Mask:
        """See `Trigger.fires`."""
        return view.deviation > self.threshold
