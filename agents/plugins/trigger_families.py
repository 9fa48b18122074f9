"""Families of triggers from the literature on event-based sampling and control, by their inequalities.

ε is the held value less the true one, e the errors of a robot's links, y = Σ|e| and V = Σ ½e² as the robot itself knows
them, t_k its last event. Each publication has its own state, input and plant; here ε and y replace them.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import exp, isfinite, isnan, nan, sqrt
from typing import Annotated, ClassVar

from msgspec import Meta

from agents.plugins.triggers import Place, SendOnDelta, Trigger, TriggerView
from agents.ticks import ROUNDING_S
from agents.vectors import NotNegative, Positive, distance, norm


class Relative(Trigger, frozen=True):
    """‖ε‖ > σ·y: off by more than a share of the error that the robot has still to correct.

    P. Tabuada, "Event-triggered real-time scheduling of stabilizing control tasks", IEEE Transactions on Automatic
    Control 52(9), 2007, 1680–1685; for agents that look at their neighbours only: D. V. Dimarogonas, E. Frazzoli and
    K. H. Johansson, "Distributed event-triggered control for multi-agent systems", ibid. 57(5), 2012, 1291–1297.
    A robot without errors, such as a leader without links, transmits whenever noise moves it: `mixed` has a floor.
    """

    JUDGES_ERRORS: ClassVar[bool] = True

    share: Annotated[Positive, Meta(description="σ: share of the error, as a deviation, that is allowed [1]")] = 0.03

    def fires(self, view: TriggerView) -> bool:
        return view.deviation > self.share * view.error


class MixedTrigger(Trigger, frozen=True):
    """‖ε‖² > σ·y² + c²: a share of the error, and a floor for small errors.

    M. C. F. Donkers and W. P. M. H. Heemels, "Output-based event-triggered control with guaranteed L∞-gain and improved
    and decentralized event-triggering", IEEE Transactions on Automatic Control 57(6), 2012, 1362–1376: the additional
    threshold is what keeps the time between two events from going to zero.
    """

    JUDGES_ERRORS: ClassVar[bool] = True

    share: Annotated[NotNegative, Meta(description="σ: share of the error, as a deviation, that is allowed [1]")] = (
        0.0004
    )
    floor: Annotated[Positive, Meta(description="c: deviation that is allowed without errors [m]")] = 0.007

    def fires(self, view: TriggerView) -> bool:
        return view.deviation * view.deviation > self.share * view.error * view.error + self.floor * self.floor


class Decaying(Trigger, frozen=True):
    """‖ε‖ > c0 + c1·exp(−α·t), t since the start: coarse during fast motion, fine at the end.

    An exponentially decaying term in the threshold, as in J. Wang, Y. Wang, H. Yan, J. Cao and H. Shen, "Hybrid
    event-based leader-following consensus of nonlinear multiagent systems with semi-Markov jump parameters", IEEE
    Systems Journal, 2022.
    """

    floor: Annotated[Positive, Meta(description="c0: deviation that is allowed in the end [m]")] = 0.008
    extra: Annotated[NotNegative, Meta(description="c1: deviation that is allowed beside it at the start [m]")] = 0.02
    rate: Annotated[Positive, Meta(description="α: rate at which that addition fades [1/s]")] = 0.3

    def fires(self, view: TriggerView) -> bool:
        return view.deviation > self.floor + self.extra * exp(-self.rate * view.since_start)


class Dynamic(Trigger, frozen=True):
    """η + θ·w ≤ 0 with w = σ·y² + c² − ‖ε‖² and η̇ = −λη + w: earlier margin may be spent now.

    A. Girard, "Dynamic triggering mechanisms for event-triggered control", IEEE Transactions on Automatic Control
    60(7), 2015, 1992–1997; the floor c is ours, and 0 is the publication's. Between two questions w counts as it is at
    the later one, and η, which never falls below zero in continuous time, is kept from it.
    """

    JUDGES_ERRORS: ClassVar[bool] = True

    share: Annotated[NotNegative, Meta(description="σ: share of the error, as a deviation, that is allowed [1]")] = (
        0.0003
    )
    floor: Annotated[NotNegative, Meta(description="c: deviation that is allowed without errors [m]")] = 0.005
    decay: Annotated[Positive, Meta(description="λ: rate at which earlier margin is forgotten [1/s]")] = 2.0
    weight: Annotated[NotNegative, Meta(description="θ: weight of the present margin [s]")] = 0.5

    # η [m² s], and time of its last computation [s]
    MEMORY: ClassVar[Mapping[str, float]] = {"eta": 0.0, "computed_at": nan}

    def fires(self, view: TriggerView) -> bool:
        memory, gap = view.memory, view.deviation
        known = isfinite(gap)
        w = self.share * view.error * view.error + self.floor * self.floor
        if known:
            w -= gap * gap
        step = view.t - memory.computed_at
        kept = 1.0 if isnan(step) else exp(-self.decay * step)
        eta: float = kept * memory.eta + (1.0 - kept) / self.decay * w
        eta = max(eta, 0.0)
        memory.computed_at = view.t
        if not known:
            return False
        memory.eta = eta
        return eta + self.weight * w <= 0.0


class IntegralTrigger(Trigger, frozen=True):
    """∫‖ε‖ dt > A since t_k: a large deviation for a short time, or a small one for long.

    M. Miskowicz, "Asymptotic Effectiveness of the Event-Based Sampling According to the Integral Criterion", Sensors
    7(1), 2007, 16–37; V. H. Nguyen and Y. S. Suh, "Networked Estimation with an Area-Triggered Transmission Method",
    Sensors 8, 2008, 897–909, for noisy signals. Between two questions the deviation counts as it is at the later one.
    """

    area: Annotated[Positive, Meta(description="A: integral of the deviation that is allowed [m s]")] = 0.001

    # integral [m s], its end [s], and the time of the event since which it runs [s]
    MEMORY: ClassVar[Mapping[str, float]] = {"area": 0.0, "until": 0.0, "event": nan}

    def fires(self, view: TriggerView) -> bool:
        memory, event = view.memory, view.last.time
        if memory.event != event:
            memory.area = 0.0
            memory.until, memory.event = event, event
        if isfinite(view.deviation) and isfinite(memory.until):
            memory.area += view.deviation * (view.t - memory.until)
        memory.until = view.t
        area: float = memory.area
        return area > self.area


class Predictive(SendOnDelta, frozen=True):
    """‖p − p̂‖ > δ, p̂ = p_k + v_k·(t − t_k): no transmission while the neighbours extrapolate well.

    Y. S. Suh, "Send-On-Delta Sensor Data Transmission With A Linear Predictor". The same inequality as send-on-delta
    on any belief: what makes it predictive is the experiment's `prediction`, which is constant velocity unless said.
    """

    PLACES: ClassVar[tuple[Place, ...]] = ("communication",)
    PREDICTION: ClassVar[str] = "constant-velocity"


class SelfTriggered(Trigger, frozen=True):
    """t ≥ t_k + τ, the first τ at which r·τ + ½a·τ² = δ: each event plans the next one, without evaluation in between.

    A. Anta and P. Tabuada, "To sample or not to sample: self-triggered control for nonlinear systems", IEEE
    Transactions on Automatic Control, 2010. The bound is on ‖ε(t_k + τ)‖: r is the rate of ε after the event, as
    known then, and a bounds its growth. A drone's wobble is in a.
    """

    JUDGES_DRIFT: ClassVar[bool] = True
    threshold: Annotated[Positive, Meta(description="δ: deviation of the held position that is allowed [m]")] = 0.01
    acceleration: Annotated[Positive, Meta(description="a: bound on the acceleration of the deviation [m/s²]")] = 0.25
    longest_s: Annotated[Positive, Meta(description="longest planned interval [s]")] = 2.0

    def fires(self, view: TriggerView) -> bool:
        drift, bound = view.drift, self.acceleration
        wait = 2.0 * self.threshold / (drift + sqrt(drift * drift + 2.0 * bound * self.threshold))
        return view.since_event >= min(wait, self.longest_s, view.reach_s) - ROUNDING_S


class Lyapunov(Trigger, frozen=True):
    """V leaves (η·V(t_k), V(t_k)/η) by more than c²/2, or ‖ε‖ > δ: the edge potential has left its level.

    On events from Lyapunov functions: A. Seuret, C. Prieur and N. Marchand, "Stability of nonlinear systems by means of
    event-triggered sampling algorithms", IMA Journal of Mathematical Control and Information 31(3), 2014, 415–433. The
    floor c is for noise; δ is for robots that move without errors of their own: a leader has no links, and a whole
    formation can travel.
    """

    JUDGES_ERRORS: ClassVar[bool] = True

    level: Annotated[
        float, Meta(gt=0, lt=1, description="η: share of the potential at the last event that bounds its level [1]")
    ] = 0.7
    floor: Annotated[NotNegative, Meta(description="c: deviation that is allowed without errors [m]")] = 0.006
    largest: Annotated[Positive, Meta(description="δ: deviation that is allowed at any level [m]")] = 0.012

    def fires(self, view: TriggerView) -> bool:
        now, then = view.energy, view.last.energy
        slack = 0.5 * self.floor * self.floor
        left = now < self.level * then - slack or now > then / self.level + slack
        return left or view.deviation > self.largest


class RelativeControl(Trigger, frozen=True):
    """‖u − u(t_k)‖ ≥ c0 + min(a·‖u‖, a): the output of the law has changed. For `formation.update`.

    The threshold {type, co, ai} of controllers in the public experiment files of the paper's authors (organisation
    Robotic-Park-Lab).
    """

    PLACES: ClassVar[tuple[Place, ...]] = ("control",)

    floor: Annotated[Positive, Meta(description="c0: change of the law's output that is allowed [m]")] = 0.005
    share: Annotated[
        NotNegative, Meta(description="a: share of the output that is allowed beside it [1], and its largest value [m]")
    ] = 0.1

    def fires(self, view: TriggerView) -> bool:
        change = distance(view.offset, view.last.offset)
        return change >= self.floor + min(self.share * norm(view.offset), self.share)
