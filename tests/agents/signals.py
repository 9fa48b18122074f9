"""Random signals for a trigger, and a loop that asks it."""

from __future__ import annotations

import itertools
from math import dist, inf
from typing import NamedTuple

import numpy as np

from agents.decision.transmission import Transmitter
from agents.kinds.khepera4 import KHEPERA4
from agents.plugins.predictors import HOLD, Predictor
from agents.plugins.triggers import Trigger
from agents.vectors import NO_SETPOINT, UNKNOWN, ZERO, Vector

DT = 0.02


class Moment(NamedTuple):
    """Quantities of a robot at one question."""

    position: Vector
    velocity: Vector
    offset: Vector
    error: float
    energy: float


def wander(seed: int, ticks: int) -> list[Moment]:
    """Random walk with rests."""
    rng = np.random.default_rng(seed)
    speed = rng.choice([0.0, 0.05, 0.5], (ticks, 1)) * rng.normal(size=(ticks, 3))
    place = np.cumsum(speed * DT, axis=0) + rng.normal(size=3)
    offset = np.cumsum(0.005 * rng.normal(size=(ticks, 3)), axis=0)
    error, energy = rng.uniform(0, 0.3, ticks), np.exp(rng.uniform(-9, -2, ticks))
    columns = (place, speed, offset, error, energy)
    vectors = [[tuple(row) if isinstance(row, list) else row for row in column.tolist()] for column in columns]
    return [Moment(*values) for values in zip(*vectors, strict=True)]


def standing(ticks: int, position: Vector = (0.0, 0.0, 0.0)) -> list[Moment]:
    """A robot that stays, without errors."""
    return [Moment(position, ZERO, ZERO, 0.0, 0.0)] * ticks


class Play:
    """Asks a trigger on every tick, as a robot does from the start of its experiment on.

    Attributes:
        fired: Whether there was an event, at each question.
        gaps: ‖ε‖ when it was asked [m], infinite at first.
        intervals: Questions from each event to the next.
    """

    def __init__(self, trigger: Trigger, signal: list[Moment], *, predictor: Predictor = HOLD, dt: float = DT) -> None:
        transmitter = Transmitter(trigger, predictor, KHEPERA4)
        self.fired: list[bool] = []
        self.gaps: list[float] = []
        last = transmitter.asking.last
        for k, moment in enumerate(signal):
            t = k * dt
            held = predictor.position(last, t - last.time) if last.time > -inf else UNKNOWN
            fired = transmitter.transmits(
                t, moment.position, moment.velocity, moment.error, moment.energy, t, moment.offset, NO_SETPOINT
            )
            self.fired.append(fired)
            self.gaps.append(dist(transmitter.position, held) if k else inf)
        events = [k for k, fired in enumerate(self.fired) if fired]
        self.intervals = [later - earlier for earlier, later in itertools.pairwise(events)]
