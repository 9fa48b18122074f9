"""Vectors as tuples of numbers, and the little arithmetic that decisions need of them.

Every function takes and gives plain numbers and tuples: the same source runs as Python and compiled. NaN stays NaN.
"""

from __future__ import annotations

from math import isfinite, nan, pi, sqrt, tau
from typing import Annotated, Final

from msgspec import Meta

Vector = tuple[float, float, float]  # x, y, z
Setpoint = tuple[float, float, float, float]  # x y z yaw, v_x v_y v_z yaw rate, or v ω 0 0
Pose = tuple[float, float, float, float]  # x, y, z [m] and yaw [rad]

UNKNOWN: Final[Vector] = (nan, nan, nan)
ZERO: Final[Vector] = (0.0, 0.0, 0.0)
NO_SETPOINT: Final[Setpoint] = (nan, nan, nan, nan)

# of settings
Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Share = Annotated[float, Meta(ge=0, le=1)]


def norm(vector: Vector) -> float:
    """Euclidean length."""
    return sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])


def distance(a: Vector, b: Vector) -> float:
    """Euclidean distance of two places."""
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return sqrt(x * x + y * y + z * z)


def difference(a: Vector, b: Vector) -> Vector:
    """a − b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def planar(a: Vector, b: Vector) -> float:
    """Distance of two places seen from above."""
    x, y = a[0] - b[0], a[1] - b[1]
    return sqrt(x * x + y * y)


def clamp(value: float, low: float, high: float) -> float:
    """`value` between `low` and `high`; NaN stays NaN."""
    if value < low:
        return low
    return high if value > high else value


def wrap(angle: float) -> float:
    """Angle in (−π, π]; NaN stays NaN."""
    if -pi < angle <= pi:
        return angle
    if not isfinite(angle):
        return nan
    return pi - (pi - angle) % tau


def is_finite(vector: Vector) -> bool:
    """Whether a vector has three finite numbers."""
    return isfinite(vector[0]) and isfinite(vector[1]) and isfinite(vector[2])
