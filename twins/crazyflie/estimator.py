"""Where a Crazyflie believes to be: right where it is if its positioning system works, ever less sure if not."""

from __future__ import annotations

from typing import Final

import numpy as np

from agents.rows import Array, Mask

SETTLING_S: Final = 0.1  # time constant with which measurements pull the estimate and its variance
PRECISE: Final = 1e-5  # [m²] variance that is reached
LOST: Final = 100.0  # [m²] variance after a reset
GROWTH: Final = 1.0  # [m²/s] of the variance without measurements
FRESH_S: Final = 0.5  # an external position older than this says nothing any more


class Estimator:
    """Estimators of N rows.

    Attributes:
        error: (N, 3) estimate less truth [m].
        variance: (N,) of the estimate, per axis [m²].
        external: (N, 3) the last position that came from outside [m].
        received: (N,) how many came.
    """

    def __init__(self, rows: int) -> None:
        self.error = np.zeros((rows, 3))
        self.variance = np.full(rows, LOST)
        self.external = np.zeros((rows, 3))
        self.received = np.zeros(rows, dtype=np.intp)
        self._heard = np.full(rows, -np.inf)

    def reset(self, row: int, error: Array) -> None:
        """Begins anew with the estimate that far (3,) from the truth."""
        self.error[row], self.variance[row] = error, LOST

    def hear(self, row: int, t: float, position: tuple[float, float, float]) -> None:
        """A position from outside."""
        self.external[row], self._heard[row] = position, t
        self.received[row] += 1

    def advance(self, t: float, dt: float, truth: Array, ready: Mask) -> None:
        """One step of dt [s]; `ready` (N,) rows have a positioning system on board that works."""
        outside = t - self._heard <= FRESH_S
        share = -np.expm1(-dt / SETTLING_S)
        wanted = np.where(ready[:, None], 0.0, self.external - truth)
        measured = ready | outside
        self.error += np.where(measured[:, None], share * (wanted - self.error), 0.0)
        settled = self.variance + share * (PRECISE - self.variance)
        self.variance = np.where(measured, settled, np.minimum(self.variance + GROWTH * dt, LOST))
