"""Random signals for triggers, and a loop that asks them."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from agents.arrays import norm
from agents.decision.transmission import Transmitter
from agents.plugins.predictors import HOLD, Predictor
from agents.plugins.triggers import Trigger

DT = 0.02


@dataclass
class Signal:
    """Over K ticks: position, velocity and offset (K, N, 3), error and energy (K, N)."""

    position: np.ndarray
    velocity: np.ndarray
    offset: np.ndarray
    error: np.ndarray
    energy: np.ndarray

    def of(self, row: int) -> Signal:
        """One row alone."""
        return Signal(*(getattr(self, field.name)[:, row : row + 1] for field in fields(self)))

    def every(self, ticks: int) -> Signal:
        """Fewer moments."""
        return Signal(*(getattr(self, field.name)[::ticks] for field in fields(self)))


def wander(seed: int, rows: int, ticks: int) -> Signal:
    """Random walks with rests."""
    rng = np.random.default_rng(seed)
    speed = rng.choice([0.0, 0.05, 0.5], (ticks, rows, 1)) * rng.normal(size=(ticks, rows, 3))
    return Signal(
        np.cumsum(speed * DT, axis=0) + rng.normal(size=(rows, 3)),
        speed,
        np.cumsum(0.005 * rng.normal(size=(ticks, rows, 3)), axis=0),
        rng.uniform(0, 0.3, (ticks, rows)),
        np.exp(rng.uniform(-9, -2, (ticks, rows))),
    )


class Play:
    """Asks a trigger on every tick, as an agent does from the start of its experiment on.

    Attributes:
        fired: (K, N) who had an event when.
        gap_before: (K, N) ‖ε‖ when it was asked [m], and `gap_after` what was left then.
        told: At the end.
        state: At the end.
    """

    def __init__(self, trigger: Trigger, signal: Signal, *, predictor: Predictor = HOLD, dt: float = DT) -> None:
        rows = signal.position.shape[1]
        voice = Transmitter(trigger, rows, predictor)
        fired, before, after = [], [], []
        for k in range(len(signal.position)):
            t = k * dt
            told = voice.last_event
            known = np.isfinite(told.time)
            age = np.where(known, t - told.time, 0.0)
            held = predictor.position(told.position, told.velocity, age)
            said = voice.transmit(
                t, signal.position[k], signal.velocity[k], error=signal.error[k], energy=signal.energy[k],
                start=np.zeros(rows), offset=signal.offset[k],
            )  # fmt: skip
            before.append(norm(said.position - held))
            now = np.isin(np.arange(rows), said.rows)
            fired.append(now)
            after.append(np.where(now, 0.0, before[-1]))
        self.fired, self.gap_before, self.gap_after = np.array(fired), np.array(before), np.array(after)
        self.last_event, self.state = voice.last_event, voice._state
