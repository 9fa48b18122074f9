"""Check of the direction of flight: a drone must accelerate where it is commanded to.

A drone that takes the yaw of its positions for its own, although the frame of its object is turned against its nose,
accelerates beside each command by that angle. From 60° on it circles wider and wider. One with swapped or mirrored
axes flies away, faster and faster: it accelerates against its commands. The check compares the acceleration that
follows from commanded and measured velocities with the measured one. Their correlation tells the angle as soon as the
drone wobbles by some centimetres. A push, noise or a lag of another size turns nothing. A wind does for a moment, and
so do circles by late positions, but not by as much as swapped axes. Commands that shake, and take effect late, make a
right drone accelerate against those of the moment, to and fro: it does not get far. One that leans against a wind
seems to accelerate against its commands when it moves gently with the wind: what it commands in vain does not count.

Quiet: all of it.
"""

from __future__ import annotations

from math import atan2, exp, inf, sqrt
from typing import Final

from agents.body.kinds import Kind
from agents.ticks import ROUNDING_S
from agents.vectors import ZERO, Vector, clamp

SAMPLE_S: Final = 0.05  # time from one comparison to the next
MISSED_S: Final = 0.3  # time without a comparison after which the acceleration is unknown
FORGET_S: Final = 0.6  # time constant with which comparisons are forgotten
LEAST: Final = 0.25  # [m/s²] mean of the commanded accelerations, below which their directions are noise
ALIKE: Final = 0.6  # least correlation of commanded and measured accelerations
ASIDE: Final = (
    0.65  # [rad] largest angle between the two: right ones show up to 0.53, a frame turned by 60° at least 0.72
)
AGAINST: Final = 2.0  # [rad] smallest angle of swapped or mirrored axes; late ones on circles show up to 1.1
AGAINST_S: Final = 0.3  # time for which that counts: a gust is shorter
WIND_S: Final = 3.0  # time constant with which a steady wind is learned
AGAINST_M: Final = 0.08  # [m] least motion that was not commanded of late: one that is shaken moves by less


class DirectionCheck:
    """Commanded and measured accelerations of one drone, seen from above."""

    __slots__ = (
        "against", "angle", "asks", "by_position", "cross", "due", "followed_s", "gain", "inline", "lag", "last",
        "lean_x", "lean_y", "moved_x", "moved_y", "moves", "opposed_s", "response", "speed", "turned", "velocity",
        "way_x", "way_y", "x", "y",
    )  # fmt: skip

    def __init__(self, kind: Kind) -> None:
        self.response, self.speed = kind.response, kind.speed
        self.by_position = kind.takes == "position"
        self.lag = 0.5 * max(kind.lag, SAMPLE_S)  # lag of the tilt; the velocity loop has the other half [s]
        self.gain = 1.0 / self.lag  # gain of that loop [1/s]
        self.forget()

    def forget(self) -> None:
        """Restart."""
        self.turned = False  # the drone accelerates beside its commands
        self.against, self.opposed_s = False, 0.0  # it accelerates against them; duration so far [s]
        self.lean_x = self.lean_y = 0.0  # velocity that is commanded in vain, against a steady wind [m/s],
        self.followed_s = 0.0  # learned for this time [s]
        self.way_x = self.way_y = 0.0  # commanded of late beyond that [m]
        self.moved_x = self.moved_y = 0.0  # measured of late [m]
        self.angle = 0.0  # angle by this comparison [rad]
        self.last = self.due = -inf  # times of the last comparison and of the next [s]
        self.velocity = ZERO  # velocity at the last comparison [m/s]
        self.x = self.y = 0.0  # acceleration that is commanded, with the lag of the tilt [m/s²]
        # sums over comparisons: products along and across, squares of commanded and of measured ones [m²/s³]
        self.inline = self.cross = self.asks = self.moves = 0.0

    def update(self, t: float, x: float, y: float, position: Vector, velocity: Vector) -> None:
        """Compare at `t` [s], when it is `due`: x, y is the setpoint, a place [m] or a velocity [m/s].

        `position` [m] and `velocity` [m/s] are measured.
        """
        since, self.last = t - self.last, t
        self.due = t + SAMPLE_S - ROUNDING_S
        if self.by_position:
            x, y = self.response * (x - position[0]), self.response * (y - position[1])
        share = min(self.speed / max(sqrt(x * x + y * y), self.speed), 1.0)
        x, y = share * x, share * y
        before, self.velocity = self.velocity, velocity
        if since < MISSED_S:
            self.follow_way(since, x, y)
            self.compare(since, (velocity[0] - before[0]) / since, (velocity[1] - before[1]) / since)
            x, y = self.gain * (x - velocity[0]), self.gain * (y - velocity[1])
            tilts = since / (self.lag + since)
            self.x += tilts * (x - self.x)
            self.y += tilts * (y - self.y)

    def compare(self, since: float, x: float, y: float) -> None:
        """Add an acceleration x, y [m/s²], measured in `since` [s]."""
        keep = exp(-since / FORGET_S)
        self.inline = keep * self.inline + since * (self.x * x + self.y * y)
        self.cross = keep * self.cross + since * (self.x * y - self.y * x)
        self.asks = keep * self.asks + since * (self.x * self.x + self.y * self.y)
        self.moves = keep * self.moves + since * (x * x + y * y)
        self.angle = atan2(self.cross, self.inline)
        alike = self.inline * self.inline + self.cross * self.cross > ALIKE * ALIKE * self.asks * self.moves
        moving = alike and self.asks > LEAST * LEAST * FORGET_S
        opposed = moving and abs(self.angle) > AGAINST
        strays = opposed and self.strays()
        self.turned = moving and abs(self.angle) > ASIDE and (strays or not opposed)
        self.opposed_s = self.opposed_s + since if opposed else 0.0
        self.against = strays and self.opposed_s > AGAINST_S

    def follow_way(self, since: float, x: float, y: float) -> None:
        """Add the ways that x, y [m/s] commands in `since` [s], and that the drone moves."""
        keep = exp(-since / FORGET_S)
        self.followed_s += since
        share = since / min(self.followed_s, WIND_S)
        self.lean_x += share * (x - self.velocity[0] - self.lean_x)
        self.lean_y += share * (y - self.velocity[1] - self.lean_y)
        self.way_x = keep * self.way_x + since * (x - self.lean_x)
        self.way_y = keep * self.way_y + since * (y - self.lean_y)
        self.moved_x = keep * self.moved_x + since * self.velocity[0]
        self.moved_y = keep * self.moved_y + since * self.velocity[1]

    def strays(self) -> bool:
        """Whether it moved aside of what was commanded of late, or against that."""
        way_x, way_y = self.way_x, self.way_y
        along = (self.moved_x * way_x + self.moved_y * way_y) / max(way_x * way_x + way_y * way_y, 1e-9)
        share = clamp(along, 0.0, 1.0)
        x, y = self.moved_x - share * way_x, self.moved_y - share * way_y
        return x * x + y * y > AGAINST_M * AGAINST_M
