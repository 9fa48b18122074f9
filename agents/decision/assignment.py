"""Assignment: the experiment as some of its robots need it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agents.arrays import Array, Index, Mask
from agents.body.kinds import Kind
from agents.body.limits import Limits
from agents.formation.anchors import Anchors
from agents.formation.changes import Change, Presence
from agents.formation.graph import Links
from agents.plugins import laws
from agents.plugins.avoidance import Avoidance
from agents.plugins.planners import Leg
from agents.plugins.predictors import HOLD, Predictor
from agents.plugins.triggers import Trigger


@dataclass(frozen=True)
class Assignment:
    """Settings of the experiment for its rows (N), with their links (E)."""

    names: tuple[str, ...]  # of the rows (N)
    kinds: tuple[Kind, ...]  # of the rows (N)
    hover: Array  # (N,) height that a flying row holds [m]; NaN for ground robots
    robots: tuple[str, ...]  # names of all robots of the experiment; `links.sender` points here
    links: Links  # on which the rows receive
    law: laws.Law
    trigger: Trigger  # of transmissions
    clamp: float  # largest step of a goal per axis and decision [m]
    tracking_gain: float  # k of (7) [1/(m² decision)]
    legs: tuple[tuple[Index, tuple[Leg, ...]], ...]  # plans: rows, and the legs that they follow
    limits: Limits
    body_hz: float  # rate of ticks
    pose_every: int  # ticks from one question to the trigger to the next
    decide_every: int  # ticks from one goal to the next
    duration: float  # of the experiment [s]
    patience_s: float | None = None  # wait for a missing neighbour [s]; None: without limit
    awaited: Mask | None = None  # (E,) links without which a row is not ready; None: all
    predictor: Predictor = HOLD  # of neighbours between two messages
    update: Trigger | None = None  # of the law; None: at every decision
    avoidance: Avoidance | None = None  # None: no collision avoidance
    robot_kinds: tuple[Kind, ...] = ()  # of all robots of the experiment
    avoidance_only: Mask | None = None  # (E,) links that never enter the law; None: none
    avoids: Mask | None = None  # (N,) rows that avoid; None: all
    anchors: Anchors | None = None  # distances to fixed points, lines, planes
    changes: tuple[Change, ...] = ()  # of the targets of all links
    presence: Presence | None = None  # times of all links; None: always
    start: Array | None = None  # (N, 2) where the rows begin [m]; None: anywhere
    start_within: float = 0.0  # farthest from there that a row may take off [m]
    # (R, 2) where the robots of the experiment begin, in the order of `robots` [m]; None: not known to a row
    all_starts: Array | None = None
    # (N,) rows that the central controller guides; links of the law, anchors and legs are those of the other rows, and
    # in the assignment of a central controller those of these rows
    guided: Mask | None = None

    def unreceived(self, stamp: Array) -> Mask:
        """Awaited links (E,) without a pose so far: the last `stamp` (E,) is not finite."""
        missing: Mask = ~np.isfinite(stamp)
        return missing if self.awaited is None else missing & self.awaited
