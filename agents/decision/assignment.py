"""Assignment: the experiment as one of its robots needs it."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, nan

from agents.body.kinds import Kind
from agents.body.limits import Limits
from agents.decision.neighbours import Incoming
from agents.formation.anchors import Anchor
from agents.formation.changes import Change
from agents.plugins.avoidance import Avoidance
from agents.plugins.law import Law
from agents.plugins.planners import Leg
from agents.plugins.predictors import HOLD, Predictor
from agents.plugins.triggers import Trigger


@dataclass(frozen=True)
class Assignment:
    """Settings of the experiment for one robot."""

    name: str
    kind: Kind
    hover: float  # height that a flying robot holds [m]; NaN on wheels
    neighbours: tuple[Incoming, ...]  # links on which it receives, those of its law first
    law: Law
    trigger: Trigger  # decides when to transmit
    clamp: float  # largest step of a goal per axis and decision [m]
    tracking_gain: float  # k of (7) [1/(m² decision)]
    limits: Limits
    body_hz: float  # rate of ticks
    pose_every: int  # ticks from one question to the trigger to the next
    decide_every: int  # ticks from one goal to the next
    duration: float  # duration of the experiment [s]
    lands_at: float = inf  # time of an earlier landing [s]
    number: int = 0  # index among all robots of the experiment
    count: int = 1  # number of all robots
    legs: tuple[Leg, ...] = ()  # its plan
    patience_s: float | None = None  # wait for a missing neighbour [s]; None: without limit
    predictor: Predictor = HOLD  # extrapolates neighbours between two messages
    update: Trigger | None = None  # decides when the law is evaluated; None: at every decision
    avoidance: Avoidance | None = None  # None: no collision avoidance
    avoids: bool = True
    anchors: tuple[Anchor, ...] = ()  # distances to fixed points, lines, planes
    changes: tuple[Change, ...] = ()  # changes of the targets of all links
    start: tuple[float, float] | None = None  # place where it begins [m]; None: anywhere
    start_within: float = 0.0  # farthest from there that it may take off [m]
    start_yaw: float = nan  # wanted there [rad]; NaN: any
    # all robots: name, x and y where they begin [m], radius [m]; empty where that is not known
    starts: tuple[tuple[str, float, float, float], ...] = ()
    # goals come from a central controller; then links of the law, anchors and legs are empty
    guided: bool = False

    @property
    def ground(self) -> float:
        """Height that the robot holds [m]: 0 on wheels."""
        return self.hover if self.kind.flies else 0.0

    @property
    def plugins(self) -> tuple[tuple[str, object], ...]:
        """Plug-ins at work in a tick, each with what it is."""
        planners = (("planner", leg.planner) for leg in self.legs)
        return (
            ("law", self.law), ("trigger", self.trigger), ("trigger", self.update), ("predictor", self.predictor),
            ("avoidance", self.avoidance), *planners,
        )  # fmt: skip
