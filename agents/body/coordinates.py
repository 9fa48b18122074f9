"""Coordinates of a motion capture system and of the arena: upward axis, unit, origin and heading."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from agents.vectors import Vector

SKEW: Final = 1e-3  # tolerance of a rotation's orthonormality
UNITS: Final = {"m": 1.0, "cm": 0.01, "mm": 0.001}  # metres in a unit
Coordinate = Annotated[float, Meta(ge=-1e6, le=1e6)]


class Coordinates(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Where the arena lies in the coordinates of a motion capture system."""

    up: Annotated[
        Literal["y", "z"] | None,
        Meta(description="axis of the system that points up; left out: as its stream says, or as is usual there"),
    ] = None
    unit: Annotated[
        Literal["m", "cm", "mm"], Meta(description="unit of length of a stream that does not name it, such as VRPN's")
    ] = "m"
    origin: Annotated[
        tuple[Coordinate, Coordinate, Coordinate],
        Meta(description="centre of the arena's floor in the system's coordinates, turned to z up [m]"),
    ] = (0.0, 0.0, 0.0)
    heading: Annotated[
        Coordinate, Meta(description="yaw of the arena's x axis in the system's coordinates, turned to z up [rad]")
    ] = 0.0

    def placed(self, position: Vector, rotation: Sequence[float], up: str) -> tuple[Vector, float]:
        """Position [m] and yaw [rad] in the arena of a pose in a system with an axis `up`.

        The yaw is NaN for a rotation (9,), row by row, that is none.
        """
        x, y, z = position
        if up == "y":
            a, b, c, d, e, f, g, h, i = rotation
            y, z = -z, y
            rotation = (a, -c, b, -g, i, -h, d, -f, e)
        yaw = yaw_of(rotation)
        turn, scale = self.heading, UNITS[self.unit]
        begin_x, begin_y, begin_z = self.origin
        x = scale * x - begin_x
        y = scale * y - begin_y
        z = scale * z - begin_z
        if turn == 0.0:
            return (x, y, z), yaw
        cos, sin = math.cos(turn), math.sin(turn)
        return (cos * x + sin * y, cos * y - sin * x, z), math.remainder(yaw - turn, math.tau)

    def measured(self, position: Vector, yaw: float) -> tuple[Vector, float]:
        """The inverse of `placed`, with z up and in metres, for twins of systems."""
        (x, y, z), (a, b, c) = position, self.origin
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        return (a + cos * x - sin * y, b + sin * x + cos * y, c + z), yaw + self.heading

    def options(self) -> list[str]:
        """Options that say this on the command line of a process."""
        up = [f"--up={self.up}"] if self.up else []
        return [*up, f"--unit={self.unit}", f"--origin={','.join(map(str, self.origin))}", f"--heading={self.heading}"]

    @classmethod
    def parse(cls, up: str | None, unit: str, origin: str, heading: float) -> Coordinates:
        """The coordinates that `options` says; raises ValueError for another origin than three numbers."""
        try:
            numbers = [float(each) for each in origin.split(",")]
            return msgspec.convert({"up": up, "unit": unit, "origin": numbers, "heading": heading}, cls)
        except ValueError:
            raise ValueError(f"--origin {origin} is not X,Y,Z in metres, such as 1.5,0,0") from None


def yaw_of(rotation: Sequence[float]) -> float:
    """Yaw [rad] of a rotation matrix (9,), row by row; NaN for an invalid one, such as zeros."""
    a, b, c, d, e, f, g, h, i = rotation
    worst = max(
        abs(a * a + b * b + c * c - 1.0),
        abs(d * d + e * e + f * f - 1.0),
        abs(a * d + b * e + c * f),
        abs(b * f - c * e - g),  # the third row is the product of the others
        abs(c * d - a * f - h),
        abs(a * e - b * d - i),
    )
    return math.atan2(d, a) if worst < SKEW and math.isfinite(sum(rotation)) else math.nan
