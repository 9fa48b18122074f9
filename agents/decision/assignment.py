"""What the experiment tells some of its robots."""

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
    """What the experiment tells some of its robots.

    Attributes:
        names: Of the rows (N).
        kinds: Of the rows (N).
        hover: (N,) height that a flying row holds [m]; NaN for ground robots.
        robots: Names of all robots of the experiment; `links.speaker` points here.
        links: On which the rows listen.
        law: Formation law.
        trigger: Who speaks when.
        predictor: Where a neighbour is believed to be between two messages.
        update: When the law is computed anew; None: at every decision.
        clamp: Largest step of a goal per axis and decision [m].
        tracking_gain: k of (7) [1/(m² decision)].
        legs: Plans: rows, and the legs that they follow.
        limits: For `agents.safety.setpoint_filter`.
        avoidance: How the rows keep clear of what they see and hear; None: they do not.
        robot_kinds: Kinds of all robots of the experiment.
        avoidance_only: (E,) links that are only for avoidance: the law knows nothing of them; None: there are none.
        avoids: (N,) rows that keep clear at all; None: all.
        anchors: Distances that the rows keep to what stands still; None: none.
        changes: What becomes of the links' targets, over all links.
        presence: When the links are there, over all links; None: always.
        guided: (N,) rows for which a centre decides; None: none. Links of the law, anchors and legs are those of the
            other rows; in the assignment of a centre, of these.
        body_hz: Rate of ticks.
        pose_every: The trigger is asked on every so many ticks.
        decide_every: A goal is decided on every so many ticks.
        duration: Of the experiment [s].
        patience_s: A row that misses a neighbour for this long is ready without it; None: never.
        awaited: (E,) links without which a row is not ready; None: all.
    """

    names: tuple[str, ...]
    kinds: tuple[Kind, ...]
    hover: Array
    robots: tuple[str, ...]
    links: Links
    law: laws.Law
    trigger: Trigger
    clamp: float
    tracking_gain: float
    legs: tuple[tuple[Index, tuple[Leg, ...]], ...]
    limits: Limits
    body_hz: float
    pose_every: int
    decide_every: int
    duration: float
    patience_s: float | None = None
    awaited: Mask | None = None
    predictor: Predictor = HOLD
    update: Trigger | None = None
    avoidance: Avoidance | None = None
    robot_kinds: tuple[Kind, ...] = ()
    avoidance_only: Mask | None = None
    avoids: Mask | None = None
    anchors: Anchors | None = None
    changes: tuple[Change, ...] = ()
    presence: Presence | None = None
    guided: Mask | None = None

    def unreceived(self, stamp: Array) -> Mask:
        """Links (E,) that are waited for and on which nothing was heard yet: the last `stamp` (E,) is not finite."""
        unheard: Mask = ~np.isfinite(stamp)
        return unheard if self.awaited is None else unheard & self.awaited
