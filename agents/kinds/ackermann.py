"""A car-like robot with front steering; its figures are a choice, of the size of common ones."""

from __future__ import annotations

from math import atan, cos, isfinite, nan, sin, sqrt
from typing import Final

from agents.body.kinds import Agility, Kind, Steered, Steering
from agents.vectors import clamp

BASE: Final = 0.15  # [m] distance of the axles
RADIUS: Final = 0.26  # [m] smallest turning radius
NEAR: Final = 0.02  # [m] it stops nearer than this to its goal
FIRMLY: Final = 1.2  # times the curvature of the arc to a goal: turned toward it before it is reached


class Pursuit(Steering, frozen=True):
    """Steer along the arc to the goal; back away from one within the turning circle until an arc leads there.

    The arc that touches the heading and meets a goal at the distance d, of which a is across, has the curvature 2 a/d²:
    Coulter, "Implementation of the pure pursuit path tracking algorithm", CMU-RI-TR-92-01, 1992. It meets goals behind
    as well, backward.
    """

    radius: float = RADIUS  # smallest turning radius [m]

    def twist(self, x: float, y: float, yaw: float, goal_yaw: float, agility: Agility) -> tuple[float, float]:
        """As `Steering.twist`; the yaw at the goal is that of arrival."""
        distance = sqrt(x * x + y * y)
        if distance <= NEAR:
            return 0.0, 0.0
        if not isfinite(yaw):
            return nan, nan
        along, across = cos(yaw) * x + sin(yaw) * y, cos(yaw) * y - sin(yaw) * x
        v = min(agility.response * distance, agility.speed)
        ahead = along >= 0.0
        curvature = FIRMLY * 2.0 * across / (distance * distance)
        if abs(curvature) * self.radius > 1.0:  # no arc leads there: drive away, and turn the near end to it
            ahead = not ahead
            curvature = -1.0 / self.radius if across > 0.0 else 1.0 / self.radius
        if not ahead:
            v = -v
        omega = clamp(v * curvature, -agility.turn_rate, agility.turn_rate)
        return v, omega


ACKERMANN: Final = Kind(
    "ackermann",
    "twist",
    flies=False,
    radius=0.20,
    height=0.12,
    mass=2.0,
    endurance_s=7200.0,
    speed=0.5,
    turn_rate=2.0,
    response=1.0,
    turn_response=1.5,
    turn_radius=RADIUS,
    steering=Pursuit(),
    motion=Steered(base=BASE, angle=atan(BASE / RADIUS), angle_rate=3.0, acceleration=1.0),
    prefix="AC",
    colour="#DDCC77",
)
