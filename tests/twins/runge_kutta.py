"""Solutions of differential equations that models are compared with."""

from collections.abc import Callable

import numpy as np


def runge_kutta(slope: Callable[[np.ndarray], np.ndarray], y: np.ndarray, h: float) -> np.ndarray:
    """y after one more step of h of y' = slope(y), by the classical method of fourth order."""
    k1 = slope(y)
    k2 = slope(y + 0.5 * h * k1)
    k3 = slope(y + 0.5 * h * k2)
    k4 = slope(y + h * k3)
    return y + h / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)
