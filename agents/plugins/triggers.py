"""Triggers: decide when a robot transmits (communication) or recomputes its law (control).

A trigger is a frozen struct of its parameters, found by the entry-point group `zenpark.triggers`. What it remembers
stands outside of it, by name, so that one serves all robots. It judges a held value: for communication the position
that the neighbours believe, for control the input of the last computation of the law. This module has the interface and
the two basic ones; the others are in `agents.plugins.trigger_families`. `fires` and `TriggerState.due` are quiet.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from types import SimpleNamespace
from typing import Annotated, Any, ClassVar, Final, Literal

import msgspec
from msgspec import Meta

from agents.ticks import ROUNDING_S
from agents.vectors import ZERO, NotNegative, Positive, Vector

Place = Literal["communication", "control"]

NOWHERE: Final[Vector] = (inf, inf, inf)


@dataclass(eq=False, slots=True)
class LastEvent:
    """State of a robot at its last event: its last transmission, or the last computation of its law."""

    position: Vector = NOWHERE  # transmitted [m]; infinite before the first event
    velocity: Vector = ZERO  # transmitted [m/s]
    offset: Vector = ZERO  # output of the law [m]
    time: float = -inf  # time of the event [s]; minus infinity before the first
    energy: float = 0.0  # energy of the formation error [m²]


class TriggerView:
    """Quantities that a trigger may use; overwritten at each question."""

    t: float  # now [s]
    position: Vector  # own [m]; for communication the pose to transmit, smoothed if asked for
    velocity: Vector  # own [m/s]
    deviation: float  # ‖ε‖: distance of the held value from the true one [m]; infinite before the first transmission
    since_event: float  # t − t_k: time since the last event [s], infinite before the first
    since_start: float  # time since the robot's start in the experiment [s], 0 before
    error: float  # Σ|e| of its links, as the robot itself knows them [m]
    energy: float  # edge potential Σ ½e² of its links [m²]
    offset: Vector  # u of the law [m]: of the last decision; for control, as it would be now
    drift: float  # rate at which ε began to grow after the last event, as known then [m/s]
    reach_s: float  # time after an event for which `drift` holds at constant speed [s]
    last: LastEvent
    memory: Any  # an attribute for each of the trigger's MEMORY, to be read and set

    def __init__(self, memory: Mapping[str, float]) -> None:
        self.t = self.since_start = self.error = self.energy = self.drift = 0.0
        self.deviation = self.since_event = self.reach_s = inf
        self.position = self.velocity = self.offset = ZERO
        self.last, self.memory = LastEvent(), SimpleNamespace(**{name: float(first) for name, first in memory.items()})


class Trigger(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of all triggers, with the parameters that every one has."""

    PLACES: ClassVar[tuple[Place, ...]] = ("communication", "control")  # places where it makes sense
    PREDICTION: ClassVar[str] = "hold"  # default of an experiment that names none
    JUDGES_ERRORS: ClassVar[bool] = False  # uses errors of the formation, which are 0 for robots that a centre guides
    JUDGES_DRIFT: ClassVar[bool] = False  # waits by the drift of the pose, and uses no other input meanwhile
    TIMED: ClassVar[bool] = False  # fires by time alone, whatever is measured
    LIBRARY: ClassVar[str] = ""  # `LIBRARY` and `FILES` are those of a law
    FILES: ClassVar[Mapping[str, str]] = {}
    MEMORY: ClassVar[Mapping[str, float]] = {}  # what it remembers from question to question, with its first values

    minimum_interval_s: Annotated[NotNegative, Meta(description="shortest time between two events [s]")] = 0.0
    maximum_silence_s: Annotated[
        Positive, Meta(description="longest time between two events [s]; left out: unlimited")
    ] = inf
    evaluate_every_s: Annotated[
        NotNegative, Meta(description="period of the condition's evaluation [s]; 0: at every question")
    ] = 0.0
    smoothing_s: Annotated[
        NotNegative, Meta(description="time constant of the low-pass on transmitted and judged poses [s]; 0: none")
    ] = 0.0

    def fires(self, view: TriggerView) -> bool:
        """Whether the condition holds."""
        raise TypeError(f"{type(self).__name__} must define `fires`")


class TriggerState:
    """A trigger at work for one robot: its view, its last event and its last evaluation."""

    def __init__(self, trigger: Trigger) -> None:
        self.trigger = trigger  # may be replaced by one of the same kind
        self.view = TriggerView(trigger.MEMORY)  # argument of the next question
        self.last, self.evaluated_at = self.view.last, -inf  # [s]

    def due(self) -> bool:
        """Whether the robot has an event now, by its `view`.

        Without any event yet it has one. Else it has one where the condition holds, no sooner than the minimum
        interval, and in any case at the maximum silence. With `evaluate_every_s` this is periodic event-triggered
        control (Heemels, Donkers and Teel, "Periodic event-triggered control for linear systems", IEEE Transactions
        on Automatic Control 58(4), 2013).
        """
        trigger, view = self.trigger, self.view
        fired, quiet = False, view.since_event
        if not trigger.evaluate_every_s > 0.0 or view.t - self.evaluated_at >= trigger.evaluate_every_s - ROUNDING_S:
            self.evaluated_at = view.t
            fired = trigger.fires(view)
        if quiet >= trigger.maximum_silence_s - ROUNDING_S:
            fired = True
        if quiet < trigger.minimum_interval_s - ROUNDING_S:
            fired = False
        return fired or quiet == inf

    def record(self) -> None:
        """Record an event with the values of the view."""
        view, last = self.view, self.last
        last.position, last.velocity, last.time = view.position, view.velocity, view.t
        last.offset, last.energy = view.offset, view.energy


class Periodic(Trigger, frozen=True):
    """t − t_k ≥ T."""

    TIMED: ClassVar[bool] = True

    period_s: Annotated[Positive, Meta(description="T: time between two transmissions [s]")] = 0.02

    def fires(self, view: TriggerView) -> bool:
        return view.since_event >= self.period_s - ROUNDING_S


class SendOnDelta(Trigger, frozen=True):
    """‖ε‖ > δ: the held value is off by more than a threshold.

    M. Miskowicz, "Send-On-Delta Concept: An Event-Based Data Reporting Strategy", Sensors 6(1), 2006, 49–63; here on
    the distance of positions. Case 2 of the paper's experiment, with δ = 1 cm.
    """

    threshold: Annotated[Positive, Meta(description="δ: deviation of the held position that is allowed [m]")] = 0.01

    def fires(self, view: TriggerView) -> bool:
        return view.deviation > self.threshold
