"""Whether a robot flies, of bodies that tell no more than positions: known by orders and by measured heights."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot, inf, isfinite, isnan
from typing import Final

from agents.body.limits import LOWEST_DESCENT_M_S
from agents.vectors import ZERO, Vector, norm

FRESH_S: Final = 0.5  # older positions are lost; robots tolerate as much
LANDING_S: Final = 10.0  # time from `land`, and a slow descent, until a robot without positions counts as landed
GROUNDED_S: Final = 1.0  # time measured on the ground after which a robot has landed that was not seen to descend
AWAY_M: Final = 0.05  # [m] height above the ground: higher is in the air, lower is down
FLOOR_M: Final = 0.2  # [m] a take-off from higher up is one from a table: the floor is at 0
TABLE_M: Final = 0.3  # [m] horizontally from there it ends
SETTLED: Final = 0.1  # [m/s] slower robots stand


@dataclass(slots=True)
class MeasuredFlight:
    """Flight of a robot, and since when it lands; all times are on the clock of the body [s]."""

    flying: bool = False
    landing_since: float = inf  # order to land or to stop; infinity without one
    _start: Vector = ZERO  # place of the take-off [m]
    _highest: float = -inf  # greatest height since the order to land [m]
    _still_since: float = inf
    _grounded_since: float = inf  # measured on the ground although it should fly

    def take_off(self, position: Vector) -> None:
        """Begin a flight at a position [m], NaN if unknown."""
        x, y, z = position
        self._start = x if isfinite(x) else 0.0, y if isfinite(y) else 0.0, z if isfinite(z) else 0.0
        self.flying, self.landing_since = True, inf
        self._highest = -inf

    def land(self, now: float) -> None:
        """Note an order to land; a repeated one in flight changes nothing."""
        if not (self.flying and isfinite(self.landing_since)):
            self.landing_since = now

    def update(self, now: float, measured: float, position: Vector, velocity: Vector, *, climbing: bool) -> bool:
        """Whether the flight has ended since the last update.

        Args:
            measured: Time of the position.
            position: [m].
            velocity: [m/s].
            climbing: An order is repeated; after one to take off the robot stands before it rises.
        """
        if not self.flying:
            return False
        landing, aged = isfinite(self.landing_since), now - measured > FRESH_S
        z = position[2]
        still = not aged and norm(velocity) < SETTLED
        self._still_since = min(self._still_since, now) if still else inf
        if not landing:
            self._highest = -inf
        elif z > self._highest:
            self._highest = z
        grounded = not aged and self._on_ground(position) and abs(velocity[2]) < SETTLED
        stands = grounded and (landing or not climbing)
        self._grounded_since = min(self._grounded_since, now) if stands else inf
        grounded_s, came_down = now - self._grounded_since, self._highest - z > AWAY_M
        if not landing:
            down = grounded_s > GROUNDED_S
        elif aged:
            descent = LANDING_S if isnan(z) else max(LANDING_S, z / LOWEST_DESCENT_M_S)
            down = now - self.landing_since > descent
        elif grounded:  # one that was ordered down as it began to climb is as low and as slow
            down = came_down or grounded_s > GROUNDED_S
        else:  # it has come lower and stands: on a table
            down = came_down and now - self._still_since > LANDING_S
        self.flying = not down
        return down

    def _on_ground(self, position: Vector) -> bool:
        """Whether the robot is at the height of the floor, or at the place of its take-off."""
        (x, y, z), (x0, y0, z0) = position, self._start
        if z0 < FLOOR_M:
            return z - z0 <= AWAY_M
        return z <= AWAY_M or (abs(z - z0) <= AWAY_M and hypot(x - x0, y - y0) < TABLE_M)
