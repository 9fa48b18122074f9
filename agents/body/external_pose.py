"""External poses (motion capture), and the estimate of velocity from positions, where nothing measures it.

All of it runs on quiet ticks.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite, isnan, nan
from typing import Final

from agents.body.interface import BodyState
from agents.vectors import UNKNOWN, ZERO, Vector

SMOOTHING_S: Final = 0.1  # time constant of the velocity estimate
FASTEST: Final = 5.0  # [m/s] a faster jump results from a mistaken marker
FARTHEST: Final = 1e6  # [m] largest coordinate
PATIENCE_S: Final = 0.5  # silence after which any position is accepted [s]


def velocity_after(velocity: Vector, moved: Vector, since: float) -> Vector:
    """The velocity estimate [m/s] after one more measured position, `moved` [m] in `since` [s], above 0.

    A low-pass with `SMOOTHING_S` on the difference quotient, used for motion capture and odometry. White noise σ of the
    positions makes σ / `SMOOTHING_S` of noise, at any rate.
    """
    (u, v, w), (x, y, z) = velocity, moved
    share = since / (SMOOTHING_S + since)
    return u + share * (x / since - u), v + share * (y / since - v), w + share * (z / since - w)


@dataclass(eq=False, slots=True)
class External:
    """The last external pose of a robot, and a filtered derivative of it."""

    time: float = -inf  # time of the pose [s], minus infinity before the first
    position: Vector = UNKNOWN  # [m], NaN before the first pose
    velocity: Vector = ZERO  # [m/s]
    yaw: float = nan  # [rad], NaN while the newest pose has none
    refused: int = 0  # poses that jumped farther than a robot can move
    _turned: float = nan  # last measured yaw less the body's own at that time [rad], NaN before the first
    _turned_at: float = nan  # time of that yaw [s]

    def update(self, t: float, position: Vector, yaw: float) -> bool:
        """Store a pose; returns False if it is old, or jumps farther than a robot can move."""
        (x, y, z), since = position, t - self.time
        known = abs(x) <= FARTHEST and abs(y) <= FARTHEST and abs(z) <= FARTHEST
        if not (since > 0.0 and known):  # NaN fails as well
            return False
        if since < PATIENCE_S:
            last_x, last_y, last_z = self.position
            x, y, z = x - last_x, y - last_y, z - last_z
            most = FASTEST * since + 0.02
            if x * x + y * y + z * z > most * most:
                self.refused += 1
                return False
            self.velocity = velocity_after(self.velocity, (x, y, z), since)
        else:
            self.velocity = ZERO
        self.time, self.position = t, position
        self.yaw = yaw if isfinite(yaw) else nan
        return True

    def estimate(self, t: float, state: BodyState) -> None:
        """Estimate, at `t` [s], the velocity of a robot from its positions, if its body measures none."""
        velocity = state.velocity
        if isnan(velocity[0]) or isnan(velocity[1]) or isnan(velocity[2]):
            self.update(state.time, state.position, state.yaw)
            state.velocity = self.velocity if t - self.time < PATIENCE_S else UNKNOWN

    def fill(self, state: BodyState) -> None:
        """Replace the pose in a state of the robot's body.

        While poses come without a yaw, it is the body's own, turned to agree with the last measured one.
        """
        state.time, state.position, state.velocity = self.time, self.position, self.velocity
        yaw, own = self.yaw, state.yaw
        if isfinite(yaw):
            if isfinite(own) and self.time != self._turned_at:
                self._turned, self._turned_at = yaw - own, self.time
            state.yaw = yaw
        elif not isnan(self._turned):
            state.yaw = own + self._turned
