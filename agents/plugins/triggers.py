"""Triggers: decide when a robot transmits (communication) or computes its law anew (control).

A trigger is a frozen struct of its parameters, found by the entry-point group `zenpark.triggers`. It has no state:
its memory stands in rows outside of it, so that one serves a robot, a swarm, or a sweep of swarms. It judges a held
value: for communication the position that the neighbours believe, for control the input of the last computation of
the law. This module has the interface and the two basic ones; the others are in `agents.plugins.trigger_families`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np
from msgspec import Meta

from agents.arrays import Array, Index, Mask, NotNegative, Positive, norm, some
from agents.plugins.predictors import HOLD, Predictor

Place = Literal["communication", "control"]

ROUNDING_S = 1e-6  # ticks are multiples of a period that binary fractions miss by less than this


class LastEvent:
    """State at the last event of each row (N): its last transmission, or the last computation of its law.

    Rows without an event have an infinite position and a time of minus infinity.
    """

    def __init__(self, rows: int) -> None:
        self.position: Array = np.full((rows, 3), np.inf)  # (N, 3) transmitted [m]
        self.velocity: Array = np.zeros((rows, 3))  # (N, 3) transmitted [m/s]
        self.offset: Array = np.zeros((rows, 3))  # (N, 3) of the law [m]
        self.time: Array = np.full(rows, -np.inf)  # (N,) of the event [s]
        self.energy: Array = np.zeros(rows)  # (N,) of the formation error [m²]

    def record(self, rows: Index, view: View) -> None:
        """Record an event of `rows` with the values of `view`."""
        if len(rows) == len(self.time):  # all, as always in a process of one robot: a copy, without an index
            self.position[:], self.velocity[:], self.time[:] = view.position, view.velocity, view.t
            self.offset[:], self.energy[:] = view.offset, view.energy
            return
        self.position[rows], self.velocity[rows], self.time[rows] = view.position[rows], view.velocity[rows], view.t
        self.offset[rows], self.energy[rows] = view.offset[rows], view.energy[rows]


@dataclass(eq=False)
class View:
    """Quantities that a trigger may use, in rows (N); the costly ones are computed on first use."""

    t: float  # now [s]
    position: Array  # (N, 3) own [m]; for communication the pose to transmit, smoothed if asked for
    velocity: Array  # (N, 3) own [m/s]
    last_event: LastEvent  # of each row
    error: Array  # (N,) Σ|e| of its links, as the row itself knows them [m]
    energy: Array  # (N,) edge potential Σ ½e² of its links [m²]
    start: Array  # (N,) start of each row in the experiment [s]
    offset: Array  # (N, 3) u of the law [m]: of the last decision; for control, as it would be now
    predictor: Predictor = HOLD  # of the neighbours

    @property
    def since_event(self) -> Array:
        """(N,) t − t_k: time since the last event [s], infinite before the first."""
        return self.t - self.last_event.time

    @property
    def since_start(self) -> Array:
        """(N,) time since the row's start in the experiment [s], 0 before."""
        return np.maximum(self.t - self.start, 0.0)

    @cached_property
    def believed(self) -> Array:
        """(N, 3) position that the neighbours believe [m]; infinite before the first transmission."""
        if self.predictor is HOLD:
            return self.last_event.position
        age = np.where(np.isinf(self.last_event.time), 0.0, self.since_event)
        return self.predictor.position(self.last_event.position, self.last_event.velocity, age)

    @cached_property
    def deviation(self) -> Array:
        """(N,) ‖ε‖: distance of the held value from the true one [m]."""
        return norm(self.position - self.believed)

    @property
    def drift(self) -> Array:
        """(N,) rate at which ε began to grow after the last event, as known then [m/s]."""
        velocity = self.last_event.velocity
        return norm(velocity - self.predictor.velocity(velocity, np.zeros(len(velocity))))

    @property
    def reach_s(self) -> float:
        """Time after an event for which `drift` holds at constant speed [s]."""
        return self.predictor.reach_s


class Trigger(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of all triggers, with the parameters that every one has.

    Class attributes of a kind of trigger: `places` where it makes sense, the `prediction` that it needs (the default of
    an experiment that names none), `judges_errors`: it uses errors of the formation, which are 0 for robots that the
    central controller guides, and `timed`: it fires by time alone, whatever is measured.
    """

    places: ClassVar[tuple[Place, ...]] = ("communication", "control")
    prediction: ClassVar[str] = "hold"
    judges_errors: ClassVar[bool] = False
    timed: ClassVar[bool] = False

    minimum_interval_s: Annotated[NotNegative, Meta(description="shortest time between two events [s]")] = 0.0
    maximum_silence_s: Annotated[
        Positive | None, Meta(description="longest time between two events [s]; left out: unlimited")
    ] = None
    evaluate_every_s: Annotated[
        Positive | None,
        Meta(description="period of the condition's evaluation [s]; left out: at every question"),
    ] = None
    smoothing_s: Annotated[
        NotNegative, Meta(description="time constant of the low-pass on transmitted and judged poses [s]; 0: none")
    ] = 0.0

    def memory(self, rows: int) -> Array:
        """Initial memory of each row (N, k)."""
        return np.zeros((rows, 0))

    def fires(self, view: View, memory: Array) -> Mask:
        """Rows (N,) whose condition holds; `memory` (N, k) is updated in place."""
        raise TypeError(f"{type(self).__name__} must define `fires`")

    def state(self, rows: int) -> Array:
        """Initial state from one question to the next (N, 1 + k): time of the last evaluation, and memory."""
        return np.concatenate([np.full((rows, 1), -np.inf), self.memory(rows)], axis=1)

    def due(self, view: View, state: Array) -> Index:
        """Rows that have an event now; `state` of `Trigger.state` is updated in place.

        Rows without any event yet have one. Others have one where the condition holds, no sooner than the minimum
        interval, and in any case at the maximum silence. With `evaluate_every_s` this is periodic event-triggered
        control (Heemels, Donkers and Teel, "Periodic event-triggered control for linear systems", IEEE Transactions
        on Automatic Control 58(4), 2013). Raises ValueError if `fires` does not give one bool per row.
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
        state[~ripe] = before[~ripe]  # rows that were not evaluated keep their memory
        return fired & ripe


class Periodic(Trigger, frozen=True):
    """t − t_k ≥ T."""

    timed: ClassVar[bool] = True

    period_s: Annotated[Positive, Meta(description="T: time between two transmissions [s]")] = 0.02

    def fires(self, view: View, memory: Array) -> Mask:
        return view.since_event >= self.period_s - ROUNDING_S


class SendOnDelta(Trigger, frozen=True):
    """‖ε‖ > δ: the held value is off by more than a threshold.

    M. Miskowicz, "Send-On-Delta Concept: An Event-Based Data Reporting Strategy", Sensors 6(1), 2006, 49–63; here on
    the distance of positions. Case 2 of the paper's experiment, with δ = 1 cm.
    """

    threshold: Annotated[Positive, Meta(description="δ: deviation of the held position that is allowed [m]")] = 0.01

    def fires(self, view: View, memory: Array) -> Mask:
        return view.deviation > self.threshold
