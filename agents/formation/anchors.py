"""Anchors: distances that robots keep to a fixed point, line or plane."""

from __future__ import annotations

import msgspec

from agents.vectors import Vector, difference, dot, norm


class Anchor(msgspec.Struct, frozen=True):
    """Distance of a robot to a fixed point, a line along `axis` through it, or a plane across `axis` through it."""

    point: Vector  # [m]
    axis: Vector  # unit vector; unused for points
    whole: float  # share of p − point that counts: 1 for points and lines, 0 for planes
    along: float  # share of its part along `axis` that is added: 0 for points, −1 for lines, 1 for planes
    distance: float  # wanted [m]; 0: on it
    gain: float  # [1/(m² decision)], or [1/decision] where the distance is 0

    def pull(self, position: Vector) -> Vector:
        """½ g (d² − ‖x‖²) x [m], with x from the nearest point to p; −g x where d = 0.

        For points this is the pull to the origin of the authors' controllers; −g x because the cube of a small x never
        gets there.
        """
        x, y, z = self.displacement(position)
        share = -1.0
        if self.distance > 0.0:
            share = 0.5 * (self.distance * self.distance - (x * x + y * y + z * z))
        pull = self.gain * share
        return pull * x, pull * y, pull * z

    def error(self, position: Vector) -> float:
        """|d − ‖x‖| [m]."""
        return abs(self.distance - norm(self.displacement(position)))

    def displacement(self, position: Vector) -> Vector:
        """x from the nearest point of the point, line or plane to the robot [m]."""
        (x, y, z), (ax, ay, az) = difference(position, self.point), self.axis
        whole = self.whole
        part = dot((x, y, z), self.axis) * self.along
        return whole * x + part * ax, whole * y + part * ay, whole * z + part * az
