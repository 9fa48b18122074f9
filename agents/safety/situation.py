"""Situation of a tick: everything that the checks of safety judge."""

from __future__ import annotations

from dataclasses import dataclass
from math import expm1
from typing import Final

import msgspec
import numpy as np

from agents.arrays import Array
from agents.body.interface import BodyState
from agents.decision.neighbours import NeighbourStates
from agents.safety.setpoint_filter import PoseValidity

# a neighbour silent for this long after a suspension had nothing new: missed poses come with the next heartbeat of its
# publisher, 0.5 s after its last pose, or with the history that is requested after a reconnection
SILENT_S: Final = 1.0
LATE_WINDOW_S: Final = 1.0  # window in which missed ticks are counted
LATE_SHARE: Final = 0.9  # with a larger share of missed ticks the control loop fails


@dataclass
class ProcessHealth:
    """State of the process around a decision, set by the process."""

    offline_since: float = np.inf  # loss of the router [s]; infinity while connected
    conductor_lost_since: float = np.inf  # loss of the conductor [s]; infinity while alive, or never seen
    missed_share: float = 0.0  # of the last ticks, 0 to 1
    resumed_at: float = -np.inf  # end of the last suspension [s]
    suspended_s: float = 0.0  # its duration [s]
    connected_since: float = -np.inf  # begin of the connection to a router after it [s]

    def mark_resumed(self, t: float, slept: float) -> None:
        """The process resumed at `t` [s] after a suspension of `slept` [s]."""
        self.resumed_at, self.suspended_s, self.connected_since = t, slept, t

    def just_resumed(self, t: float) -> bool:
        """Whether poses missed in a suspension may still be on their way at `t` [s]; call it on every tick."""
        recent = t < self.connected_since + SILENT_S
        if recent and self.offline_since < np.inf:
            self.connected_since = t
        return recent

    @property
    def loop_failing(self) -> bool:
        """Whether the control loop misses so many ticks that it controls nothing."""
        return self.missed_share > LATE_SHARE

    @property
    def troubled(self) -> bool:
        """Whether router, conductor or control loop fails."""
        return self.offline_since < np.inf or self.conductor_lost_since < np.inf or self.loop_failing

    def count_tick(self, missed: int, period: float) -> None:
        """Count a tick after `missed` ones that did not take place; they are `period` apart [s]."""
        if missed or self.missed_share > 0.0:
            forget = -expm1(-period * (1 + missed) / LATE_WINDOW_S)
            self.missed_share += forget * (missed / (1 + missed) - self.missed_share)
            if self.missed_share < 1e-3:
                self.missed_share = 0.0


class Situation(msgspec.Struct, frozen=True):
    """Rows (N) on a tick."""

    t: float  # now [s]
    state: BodyState  # of the bodies
    where: PoseValidity  # validity of their poses
    neighbours: NeighbourStates  # of the rows
    health: ProcessHealth  # of the process around the decision
    jump: Array | None = None  # (N,) [m] of rows whose position jumped: `state` has none of them; None: of no row
    turned: Array | None = None  # (N,) [rad] of those of them whose yaw jumped, NaN of others; None: of no row
