"""Transmission: whether a robot transmits its pose now, smoothed if the trigger asks for it. All of it is quiet."""

from __future__ import annotations

from math import expm1, inf, isfinite, nan
from typing import ClassVar, cast

from agents.body.kinds import Kind
from agents.decision.stepping import Speech
from agents.network.validation import MAX_SPEED
from agents.plugins.predictors import Predictor
from agents.plugins.triggers import Trigger, TriggerState
from agents.vectors import UNKNOWN, ZERO, Setpoint, Vector, clamp, distance, is_finite


class Transmitter:
    """Transmissions of one robot."""

    FIXED: ClassVar = ("_smooths", "_speaks")

    def __init__(self, trigger: Trigger, predictor: Predictor, kind: Kind, speech: Speech | None = None) -> None:
        self.asking, self.smoothed = TriggerState(trigger), LowPass(kind)
        self.predictor = predictor  # predictor of the receivers
        self._smooths, self._speaks = trigger.smoothing_s > 0.0, speech is not None
        self.speech = cast(Speech, speech)  # what is said beside the pose, if anything is
        # of the last question: what would be transmitted [m], [m/s], NaN where unknown
        self.position = self.velocity = UNKNOWN
        self.asking.view.reach_s = predictor.reach()

    def replace_trigger(self, trigger: Trigger) -> None:
        """Use another trigger of the same kind from now on; what was remembered stays."""
        self.asking.trigger, self._smooths = trigger, trigger.smoothing_s > 0.0

    def transmits(  # noqa: PLR0917 - quiet: compilers take no arguments by name alone
        self,
        t: float,
        position: Vector,
        velocity: Vector,
        error: float,
        energy: float,
        since_start: float,
        offset: Vector,
        setpoint: Setpoint,
    ) -> bool:
        """Whether the robot transmits its pose at `t` [s]; without a known position it does not.

        For the arguments see `View`. `setpoint` is the last command to the body, NaN where the body drives by itself.
        An unknown velocity is transmitted as NaN, and counts as 0 for trigger and smoothing, as the neighbours assume.
        """
        known = abs(velocity[0]) <= MAX_SPEED and abs(velocity[1]) <= MAX_SPEED and abs(velocity[2]) <= MAX_SPEED
        if not known:  # implausible, hence unknown
            velocity = ZERO
        asking = self.asking
        if self._smooths:
            smoothed = self.smoothed
            smoothed.smooth(t, position, velocity, asking.trigger.smoothing_s, setpoint)
            position, velocity = smoothed.position, smoothed.velocity
        view, last = asking.view, asking.last
        view.t, view.position, view.velocity, view.error, view.energy = t, position, velocity, error, energy
        view.since_start, view.offset = since_start, offset
        view.since_event = t - last.time
        if last.time > -inf:
            believed = self.predictor.position(last, view.since_event)
            view.deviation = distance(position, believed)
            view.drift = distance(last.velocity, self.predictor.velocity(last, 0.0))
            if self._speaks:
                view.deviation = self.speech.deviation(view.deviation)
        due = asking.due() and is_finite(position)
        if due:
            asking.record()
            if self._speaks:
                self.speech.record()
        self.position, self.velocity = position, velocity if known else UNKNOWN
        return due


class LowPass:
    """Positions without jitter: extrapolated by a velocity, and drawn to the measured ones with a time constant.

    A bare low-pass of the position would lag by τ·v behind a robot that drives, 0.1 m at 0.15 m/s and 0.7 s. This one
    does not: ṗ_f = v + (p − p_f)/τ and v̇_f = (v − v_f)/τ, with p − p_f and v as they are at the end of a step.

    v of a robot on wheels is its measured velocity. The measured velocity of a flying robot contains the wobble, which
    would enter the transmitted position. Its horizontal v therefore follows from its own setpoints: v̇ = (v_c − v)/T. T
    is the lag of its kind, v_c the commanded velocity; if positions are commanded, v_c is K (setpoint − p_f) within its
    speed. Such a model of a robot on both sides of a network is the idea of L. A. Montestruque and P. J. Antsaklis, "On
    the model-based control of networked systems", Automatica 39(10), 2003. Where the robot deviates from its model by
    Δv, p_f is off by τ·Δv.
    """

    def __init__(self, kind: Kind) -> None:
        self._flies, self._by_place = kind.flies, kind.takes == "position"
        self._response, self._speed, self._lag = kind.response, kind.speed, kind.lag
        self._t = -inf
        self._driven_x = self._driven_y = nan
        self.position = self.velocity = UNKNOWN  # smoothed [m], [m/s]; NaN at the beginning

    def smooth(self, t: float, position: Vector, velocity: Vector, constant_s: float, setpoint: Setpoint) -> None:
        """Smooth a measured `position` [m] and `velocity` [m/s] at `t` [s], with the last setpoint.

        Smoothing starts at the measured pose, and restarts there after the pose was unknown.
        """
        step = t - self._t if isfinite(self._t) else 0.0
        self._t = t
        if self._flies:
            velocity = self._driven(step, velocity, setpoint)
        share = -expm1(-step / constant_s)
        self.position = (
            _drawn(self.position[0] + step * velocity[0], position[0], share),
            _drawn(self.position[1] + step * velocity[1], position[1], share),
            _drawn(self.position[2] + step * velocity[2], position[2], share),
        )
        self.velocity = (
            _drawn(self.velocity[0], velocity[0], share),
            _drawn(self.velocity[1], velocity[1], share),
            _drawn(self.velocity[2], velocity[2], share),
        )
        if not (is_finite(self.position) and is_finite(self.velocity)):
            self.position, self.velocity = position, velocity

    def _driven(self, step: float, measured: Vector, setpoint: Setpoint) -> Vector:
        """Velocity of a flying robot: horizontally from its setpoints, without setpoints the measured one."""
        x, y = setpoint[0], setpoint[1]
        if self._by_place:
            x, y = self._response * (x - self.position[0]), self._response * (y - self.position[1])
        share = step / (self._lag + step)
        self._driven_x += share * (clamp(x, -self._speed, self._speed) - self._driven_x)
        self._driven_y += share * (clamp(y, -self._speed, self._speed) - self._driven_y)
        if not isfinite(self._driven_x):
            self._driven_x = measured[0]
        if not isfinite(self._driven_y):
            self._driven_y = measured[1]
        return self._driven_x, self._driven_y, measured[2]


def _drawn(carried: float, measured: float, share: float) -> float:
    return carried + share * (measured - carried)
