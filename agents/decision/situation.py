"""Situation of a tick: everything that the checks of safety judge, and the process around the decision."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import expm1, inf, nan
from typing import Final

from agents.body.interface import BodyState
from agents.vectors import UNKNOWN, Vector

# a neighbour silent for this long after a suspension had nothing new: missed poses come with the next heartbeat of its
# publisher, 0.5 s after its last pose, or with the history that is requested after a reconnection
SILENT_S: Final = 1.0
LATE_WINDOW_S: Final = 1.0  # window in which missed ticks are counted
LATE_SHARE: Final = 0.9  # share of missed ticks from which the control loop fails


@dataclass(eq=False, slots=True)
class ProcessHealth:
    """State of the process around a decision, set by the process."""

    offline_since: float = inf  # loss of the router [s]; infinity while connected
    conductor_lost_since: float = inf  # loss of the conductor [s]; infinity while alive, or never seen
    missed_share: float = 0.0  # share of the last ticks, 0 to 1
    resumed_at: float = -inf  # end of the last suspension [s]
    suspended_s: float = 0.0  # its duration [s]
    connected_since: float = -inf  # begin of the connection to a router after it [s]
    asked_since: float = (
        inf  # begin of the wait for the owner of the names, until the tick after it [s]; infinity: none
    )
    contested: bool = False  # another owner was seen in that wait

    def mark_resumed(self, t: float, slept: float) -> None:
        """The process resumed at `t` [s] after a suspension of `slept` [s]."""
        self.resumed_at, self.suspended_s, self.connected_since = t, slept, t

    def mark_asked(self, since: float, contested: bool) -> None:
        """The process has waited since `since` [s] for the owner of its names, maybe twice since the last tick."""
        self.contested = contested or (self.contested and self.asked_since < inf)
        self.asked_since = min(self.asked_since, since)

    def just_resumed(self, t: float) -> bool:
        """Whether poses missed in a suspension may still be on their way at `t` [s]; call it on every tick."""
        recent = t < self.connected_since + SILENT_S
        if recent and self.offline_since < inf:
            self.connected_since = t
        return recent

    @property
    def loop_failing(self) -> bool:
        """Whether the control loop misses too many ticks to control the robot."""
        return self.missed_share > LATE_SHARE

    def count_tick(self, missed: int, period: float) -> None:
        """Count a tick after `missed` ones that did not take place; they are `period` apart [s]."""
        forget = -expm1(-period * (1 + missed) / LATE_WINDOW_S)
        self.missed_share += forget * (missed / (1 + missed) - self.missed_share)
        if self.missed_share < 1e-3:
            self.missed_share = 0.0


@dataclass(eq=False, slots=True)
class Situation:
    """One robot on a tick; overwritten on each."""

    t: float = 0.0  # now [s]
    state: BodyState = field(default_factory=BodyState)  # reading of the body; the decision uses what follows
    position: Vector = UNKNOWN  # measured [m]; NaN where it jumped
    velocity: Vector = UNKNOWN  # measured or estimated [m/s]
    yaw: float = nan  # measured [rad]
    jump: float = nan  # length of the jump of its position [m]; NaN: it did not jump
    yaw_jump: float = nan  # size of the jump of its yaw [rad]; NaN: it did not jump
    sound: bool = True  # pose known, fresh and inside the arena: the five below are False and 0
    invalid: bool = False  # own pose missing, stale or not finite: no closed loop is possible
    outside_wall: bool = False  # True outside a wall, or above the ceiling
    outside: bool = False  # True outside the arena beyond any doubt
    flyaway: bool = False  # True so far outside that a flying robot must be stopped there
    excess: float = 0.0  # distance from the arena along the worst axis [m]; 0 inside

    def begin(self, t: float) -> None:
        """Begin a tick at `t` [s] with the state of the body."""
        state = self.state
        self.t = t
        self.position, self.velocity, self.yaw = state.position, state.velocity, state.yaw
