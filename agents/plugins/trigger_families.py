"""Families of triggers from the literature on event-based sampling and control, by their inequalities.

ε is the held value less the true one, e the errors of a row's links, y = Σ|e| and V = Σ ½e² as the row itself knows
them, t_k its last event. Each publication is about a state, an input and a plant of its own; here ε and y take their
place.
"""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta

from agents.arrays import Array, Mask, NotNegative, Positive, norm
from agents.plugins.triggers import ROUNDING_S, Place, SendOnDelta, Trigger, View


class Relative(Trigger, frozen=True):
    """‖ε‖ > σ·y: off by more than a share of the error that the row has still to correct.

    P. Tabuada, "Event-triggered real-time scheduling of stabilizing control tasks", IEEE Transactions on Automatic
    Control 52(9), 2007, 1680–1685; for agents that look at their neighbours only: D. V. Dimarogonas, E. Frazzoli and
    K. H. Johansson, "Distributed event-triggered control for multi-agent systems", ibid. 57(5), 2012, 1291–1297.
    A row without errors, such as a leader without links, transmits whenever noise moves it: `mixed` has a floor.
    """

    judges_errors: ClassVar[bool] = True

    share: Annotated[Positive, Meta(description="σ: share of the error, as a deviation, that is allowed [1]")] = 0.03

    def fires(self, view: View, memory: Array) -> Mask:
        return view.deviation > self.share * view.error


class Mixed(Trigger, frozen=True):
    """‖ε‖² > σ·y² + c²: a share of the error, and a floor for small errors.

    M. C. F. Donkers and W. P. M. H. Heemels, "Output-based event-triggered control with guaranteed L∞-gain and improved
    and decentralized event-triggering", IEEE Transactions on Automatic Control 57(6), 2012, 1362–1376: the additional
    threshold is what keeps the time between two events from going to zero.
    """

    judges_errors: ClassVar[bool] = True

    share: Annotated[NotNegative, Meta(description="σ: share of the error, as a deviation, that is allowed [1]")] = (
        0.0004
    )
    floor: Annotated[Positive, Meta(description="c: deviation that is allowed without errors [m]")] = 0.007

    def fires(self, view: View, memory: Array) -> Mask:
        return view.deviation**2 > self.share * view.error**2 + self.floor**2


class Decaying(Trigger, frozen=True):
    """‖ε‖ > c0 + c1·exp(−α·t), t since the start: coarse during fast motion, fine at the end.

    An exponentially decaying term in the threshold, as in J. Wang, Y. Wang, H. Yan, J. Cao and H. Shen, "Hybrid
    event-based leader-following consensus of nonlinear multiagent systems with semi-Markov jump parameters", IEEE
    Systems Journal, 2022.
    """

    floor: Annotated[Positive, Meta(description="c0: deviation that is allowed in the end [m]")] = 0.008
    extra: Annotated[NotNegative, Meta(description="c1: deviation that is allowed beside it at the start [m]")] = 0.02
    rate: Annotated[Positive, Meta(description="α: rate at which that addition fades [1/s]")] = 0.3

    def fires(self, view: View, memory: Array) -> Mask:
        return view.deviation > self.floor + self.extra * np.exp(-self.rate * view.since_start)


class Dynamic(Trigger, frozen=True):
    """η + θ·w ≤ 0 with w = σ·y² + c² − ‖ε‖² and η̇ = −λη + w: earlier margin may be spent now.

    A. Girard, "Dynamic triggering mechanisms for event-triggered control", IEEE Transactions on Automatic Control
    60(7), 2015, 1992–1997; the floor c is ours, and 0 is the publication's. Between two questions w counts as it is at
    the later one, and η, which never falls below zero in continuous time, is kept from it.
    """

    judges_errors: ClassVar[bool] = True

    share: Annotated[NotNegative, Meta(description="σ: share of the error, as a deviation, that is allowed [1]")] = (
        0.0003
    )
    floor: Annotated[NotNegative, Meta(description="c: deviation that is allowed without errors [m]")] = 0.005
    decay: Annotated[Positive, Meta(description="λ: rate at which earlier margin is forgotten [1/s]")] = 2.0
    weight: Annotated[NotNegative, Meta(description="θ: weight of the present margin [s]")] = 0.5

    def memory(self, rows: int) -> Array:
        """η [m² s] and time of its last computation [s]."""
        return np.tile([0.0, np.nan], (rows, 1))

    def fires(self, view: View, memory: Array) -> Mask:
        gap = view.deviation
        known = np.isfinite(gap)
        w = self.share * view.error**2 + self.floor**2 - np.where(known, gap, 0.0) ** 2
        step = np.where(np.isnan(memory[:, 1]), 0.0, view.t - memory[:, 1])
        kept = np.exp(-self.decay * step)
        eta = np.maximum(kept * memory[:, 0] + (1.0 - kept) / self.decay * w, 0.0)
        memory[:, 0] = np.where(known, eta, memory[:, 0])
        memory[:, 1] = view.t
        return np.asarray(known & (eta + self.weight * w <= 0.0))


class Integral(Trigger, frozen=True):
    """∫‖ε‖ dt > A since t_k: a large deviation for a short time, or a small one for long.

    M. Miskowicz, "Asymptotic Effectiveness of the Event-Based Sampling According to the Integral Criterion", Sensors
    7(1), 2007, 16–37; V. H. Nguyen and Y. S. Suh, "Networked Estimation with an Area-Triggered Transmission Method",
    Sensors 8, 2008, 897–909, for noisy signals. Between two questions the deviation counts as it is at the later one.
    """

    area: Annotated[Positive, Meta(description="A: integral of the deviation that is allowed [m s]")] = 0.001

    def memory(self, rows: int) -> Array:
        """Integral [m s], its end and the time of its event [s]."""
        return np.tile([0.0, 0.0, np.nan], (rows, 1))

    def fires(self, view: View, memory: Array) -> Mask:
        event, deviation = view.last_event.time, view.deviation
        anew = memory[:, 2] != event
        area, until = np.where(anew, 0.0, memory[:, 0]), np.where(anew, event, memory[:, 1])
        known = np.isfinite(deviation) & np.isfinite(until)
        area = area + np.where(known, deviation, 0.0) * np.where(known, view.t - until, 0.0)
        memory[:, 0], memory[:, 1], memory[:, 2] = area, view.t, event
        return np.asarray(area > self.area)


class Predictive(SendOnDelta, frozen=True):
    """‖p − p̂‖ > δ, p̂ = p_k + v_k·(t − t_k): no transmission while the neighbours extrapolate well.

    Y. S. Suh, "Send-On-Delta Sensor Data Transmission With A Linear Predictor". The same inequality as send-on-delta
    on any belief: what makes it predictive is the experiment's `prediction`, which is constant velocity unless said.
    """

    places: ClassVar[tuple[Place, ...]] = ("communication",)
    prediction: ClassVar[str] = "constant-velocity"


class SelfTriggered(Trigger, frozen=True):
    """t ≥ t_k + τ, the first τ at which r·τ + ½a·τ² = δ: each event plans the next one, without evaluation in between.

    A. Anta and P. Tabuada, "To sample or not to sample: self-triggered control for nonlinear systems", IEEE
    Transactions on Automatic Control, 2010. The bound is on ‖ε(t_k + τ)‖: r is the rate of ε after the event, as
    known then, and a bounds its growth. A drone's wobble is in a.
    """

    threshold: Annotated[Positive, Meta(description="δ: deviation of the held position that is allowed [m]")] = 0.01
    acceleration: Annotated[Positive, Meta(description="a: bound on the acceleration of the deviation [m/s²]")] = 0.25
    longest_s: Annotated[Positive, Meta(description="longest planned interval [s]")] = 2.0

    def fires(self, view: View, memory: Array) -> Mask:
        drift, bound = view.drift, self.acceleration
        wait = 2.0 * self.threshold / (drift + np.sqrt(drift**2 + 2.0 * bound * self.threshold))
        return view.since_event >= np.minimum(wait, min(self.longest_s, view.reach_s)) - ROUNDING_S


class Lyapunov(Trigger, frozen=True):
    """V leaves (η·V(t_k), V(t_k)/η) by more than c²/2, or ‖ε‖ > δ: the edge potential has left its level.

    On events from Lyapunov functions: A. Seuret, C. Prieur and N. Marchand, "Stability of nonlinear systems by means of
    event-triggered sampling algorithms", IMA Journal of Mathematical Control and Information 31(3), 2014, 415–433. The
    floor c is for noise; δ is for robots that move without errors of their own: a leader has no links, and a whole
    formation can travel.
    """

    judges_errors: ClassVar[bool] = True

    level: Annotated[
        float, Meta(gt=0, lt=1, description="η: share of the potential at the last event that bounds its level [1]")
    ] = 0.7
    floor: Annotated[NotNegative, Meta(description="c: deviation that is allowed without errors [m]")] = 0.006
    largest: Annotated[Positive, Meta(description="δ: deviation that is allowed at any level [m]")] = 0.012

    def fires(self, view: View, memory: Array) -> Mask:
        now, then, slack = view.energy, view.last_event.energy, 0.5 * self.floor**2
        left = (now < self.level * then - slack) | (now > then / self.level + slack)
        return left | (view.deviation > self.largest)


class RelativeControl(Trigger, frozen=True):
    """‖u − u(t_k)‖ ≥ c0 + min(a·‖u‖, a): the output of the law has changed. For `formation.update`.

    The threshold {type, co, ai} of controllers in the public experiment files of the paper's authors (organisation
    Robotic-Park-Lab).
    """

    places: ClassVar[tuple[Place, ...]] = ("control",)

    floor: Annotated[Positive, Meta(description="c0: change of the law's output that is allowed [m]")] = 0.005
    share: Annotated[
        NotNegative, Meta(description="a: share of the output that is allowed beside it [1], and its largest value [m]")
    ] = 0.1

    def fires(self, view: View, memory: Array) -> Mask:
        u = view.offset
        return norm(u - view.last_event.offset) >= self.floor + np.minimum(self.share * norm(u), self.share)
