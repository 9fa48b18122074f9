"""Triggers: who speaks now.

A trigger is a frozen struct of its parameters, found by the entry-point group `zenpark.triggers`. It has no state:
what it must remember stands in rows outside of it, so that one serves a robot, a swarm, or a sweep of swarms.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from agents.rows import Array, Index, Mask, norm

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]

ROUNDING_S = 1e-6  # ticks are multiples of a period that binary fractions miss by less than this


@dataclass
class Told:
    """What each row's neighbours were last told: position (N, 3), velocity (N, 3), time (N,).

    Rows that never spoke have an infinite position and a time of minus infinity: every trigger lets them speak.
    """

    position: Array
    velocity: Array
    time: Array

    @classmethod
    def nothing(cls, rows: int) -> Told:
        """Before anybody spoke."""
        return cls(np.full((rows, 3), np.inf), np.zeros((rows, 3)), np.full(rows, -np.inf))

    def tell(self, rows: Index, t: float, position: Array, velocity: Array) -> None:
        """Remembers what `rows` say at time `t` [s]."""
        self.position[rows], self.velocity[rows], self.time[rows] = position[rows], velocity[rows], t


@dataclass(frozen=True)
class View:
    """What a trigger may look at.

    Attributes:
        t: Now [s].
        position: (N, 3) own [m].
        velocity: (N, 3) own [m/s].
        told: What the neighbours hold.
        error: (N,) formation error as the row itself sees it [m].
    """

    t: float
    position: Array
    velocity: Array
    told: Told
    error: Array


class Trigger(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters that every trigger has, and the question that each answers in its own way."""

    minimum_interval_s: Annotated[NotNegative, Meta(description="never speak sooner after the last time [s]")] = 0.0
    maximum_silence_s: Annotated[Positive | None, Meta(description="speak at the latest after this [s]")] = None

    def memory(self, rows: int) -> Array:
        """What it remembers of each row, at the beginning: (N, k)."""
        return np.zeros((rows, 0))

    def fires(self, view: View, memory: Array) -> Mask:
        """Which rows (N,) have something to say; `memory` (N, k) is updated in place."""
        raise TypeError(f"{type(self).__name__} must say when it fires")

    def speaks(self, view: View, memory: Array) -> Index:
        """Rows that speak now: what fires, no sooner than the minimum interval, no later than the maximum silence."""
        fired = self.fires(view, memory)
        if np.shape(fired) != view.told.time.shape:
            raise ValueError(f"`fires` must give one bool per row, {view.told.time.shape}, not {np.shape(fired)}")
        if self.minimum_interval_s > 0.0 or self.maximum_silence_s is not None:
            quiet = view.t - view.told.time
            if self.maximum_silence_s is not None:
                fired = fired | (quiet >= self.maximum_silence_s - ROUNDING_S)
            fired = fired & (quiet >= self.minimum_interval_s - ROUNDING_S)
        return np.flatnonzero(fired)


class Periodic(Trigger, frozen=True):
    """Speak every `period_s`."""

    period_s: Annotated[Positive, Meta(description="[s]")] = 0.02

    def fires(self, view: View, memory: Array) -> Mask:
        """t − t_k ≥ T."""
        return view.t - view.told.time >= self.period_s - ROUNDING_S


class SendOnDelta(Trigger, frozen=True):
    """Speak when the neighbours hold a position that is off by more than `threshold` (Miskowicz, Sensors 2006)."""

    threshold: Annotated[Positive, Meta(description="δ [m]")] = 0.01

    def fires(self, view: View, memory: Array) -> Mask:
        """‖p − p_k‖ > δ."""
        return norm(view.position - view.told.position) > self.threshold
