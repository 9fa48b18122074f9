"""Situation of a tick: everything that the checks of safety judge, and the process around the decision."""

from __future__ import annotations

from math import expm1, inf, isfinite, nan
from typing import Final

from agents.body.interface import BodyState
from agents.vectors import Vector

# a neighbour silent for this long after a suspension had nothing new: missed poses come with the next heartbeat of its
# publisher, 0.5 s after its last pose, or with the history that is requested after a reconnection
SILENT_S: Final = 1.0
LATE_WINDOW_S: Final = 1.0  # window in which missed ticks are counted
LATE_SHARE: Final = 0.9  # with a larger share of missed ticks the control loop fails


class ProcessHealth:
    """State of the process around a decision, set by the process."""

    __slots__ = (
        "conductor_lost_since", "connected_since", "missed_share", "offline_since", "resumed_at", "suspended_s",
    )  # fmt: skip

    def __init__(self) -> None:
        self.offline_since = inf  # loss of the router [s]; infinity while connected
        self.conductor_lost_since = inf  # loss of the conductor [s]; infinity while alive, or never seen
        self.missed_share = 0.0  # of the last ticks, 0 to 1
        self.resumed_at = -inf  # end of the last suspension [s]
        self.suspended_s = 0.0  # its duration [s]
        self.connected_since = -inf  # begin of the connection to a router after it [s]

    def mark_resumed(self, t: float, slept: float) -> None:
        """The process resumed at `t` [s] after a suspension of `slept` [s]."""
        self.resumed_at, self.suspended_s, self.connected_since = t, slept, t

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

    @property
    def troubled(self) -> bool:
        """Whether router, conductor or control loop fails."""
        return self.offline_since < inf or self.conductor_lost_since < inf or self.missed_share > LATE_SHARE

    def count_tick(self, missed: int, period: float) -> None:
        """Count a tick after `missed` ones that did not take place; they are `period` apart [s]."""
        if missed or self.missed_share > 0.0:
            forget = -expm1(-period * (1 + missed) / LATE_WINDOW_S)
            self.missed_share += forget * (missed / (1 + missed) - self.missed_share)
            if self.missed_share < 1e-3:
                self.missed_share = 0.0


class Situation:
    """One robot on a tick; overwritten on each."""

    __slots__ = (
        "excess", "flyaway", "invalid", "jump", "outside", "outside_wall", "position", "sound", "state", "t",
        "velocity", "yaw", "yaw_jump",
    )  # fmt: skip

    t: float  # now [s]
    state: BodyState  # as the body gave it; the decision uses what follows
    position: Vector  # measured [m]; NaN where it jumped
    velocity: Vector  # measured or estimated [m/s]
    yaw: float  # measured [rad]
    jump: float  # length of the jump of its position [m]; NaN: it did not jump
    yaw_jump: float  # size of the jump of its yaw [rad]; NaN: it did not jump
    sound: bool  # pose known, fresh and inside the arena: the five below are False and 0
    invalid: bool  # own pose missing, stale or not finite: no closed loop is possible
    outside_wall: bool  # outside a wall, or above the ceiling
    outside: bool  # outside the arena beyond any doubt
    flyaway: bool  # so far outside that a flying robot must be stopped there
    excess: float  # distance from the arena along the worst axis [m]; 0 inside

    def __init__(self) -> None:
        self.t, self.state, self.jump, self.yaw_jump = 0.0, BodyState(), nan, nan
        self.begin(0.0)
        self.sound = True
        self.invalid = self.outside_wall = self.outside = self.flyaway = False
        self.excess = 0.0

    def begin(self, t: float) -> None:
        """Begin a tick at `t` [s] with the state of the body."""
        state = self.state
        self.t, self.position, self.velocity, self.yaw = t, state.position, state.velocity, state.yaw

    @property
    def jumped(self) -> bool:
        return isfinite(self.jump)
