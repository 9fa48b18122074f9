"""Control updates: decision whether a robot recomputes its law; otherwise it keeps its goal. Quiet."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from agents.decision.neighbours import Neighbours
from agents.plugins.predictors import Predictor
from agents.plugins.triggers import Trigger, TriggerState
from agents.vectors import ZERO, Vector, difference, distance, is_finite, norm


@dataclass(eq=False, slots=True)
class Input:
    """Input of the law on one link at the last computation."""

    apart: Vector = ZERO  # p_i − p̂_j [m]
    rate: Vector = ZERO  # its rate [m/s]


class ControlUpdates:
    """Choice whether the law is recomputed, and its inputs at the last computation.

    ε of a control trigger is the change of the input of the law since its last computation. These inputs are the
    relative positions p_i − p̂_j on the links, as the robot estimates them, and p_i if it keeps a distance to a fixed
    object. ‖ε‖ is their largest change.
    """

    asking: TriggerState

    def __init__(self, trigger: Trigger, links: int, *, anchored: bool) -> None:
        self.asking, self._anchored = TriggerState(trigger), anchored
        self._inputs = [Input() for _ in range(links)]

    def due(  # noqa: PLR0917 - quiet: compilers take no arguments by name alone
        self, t: float, position: Vector, velocity: Vector, neighbours: Neighbours, predictor: Predictor,
        since_start: float, offset: Vector, error: float, energy: float,
    ) -> bool:  # fmt: skip
        """Whether the law is computed now, at `t` [s]; without a known position it is not.

        For the quantities see `View`; `offset`, `error` and `energy` are those of now.
        """
        view, last = self.asking.view, self.asking.last
        view.t, view.position, view.velocity, view.offset = t, position, velocity, offset
        view.error, view.energy, view.since_start = error, energy, since_start
        view.since_event = t - last.time
        deviation = drift = 0.0
        for k in range(len(self._inputs)):
            sender, before = neighbours.all[k], self._inputs[k]
            if sender.active:
                deviation = max(deviation, distance(sender.apart(position, predictor, t), before.apart))
                drift = max(drift, norm(before.rate))
        if self._anchored:
            deviation = max(deviation, distance(position, last.position))
            drift = max(drift, norm(last.velocity))
        view.deviation, view.drift = deviation, drift
        if not (self.asking.due() and is_finite(position)):
            return False
        self.asking.record()
        for k in range(len(self._inputs)):
            sender, before = neighbours.all[k], self._inputs[k]
            if sender.active:
                before.apart = sender.apart(position, predictor, t)
                before.rate = difference(velocity, predictor.velocity(sender, t - sender.stamp))
        return True

    def require(self) -> None:
        """Compute the law at the next decision, whatever the trigger decides."""
        self.asking.last.time = -inf
