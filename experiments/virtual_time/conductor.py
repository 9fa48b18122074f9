"""The conductor of the virtual clock: the orders of a real run, at the same moments of the robots' lives."""

from __future__ import annotations

from typing import Final

import numpy as np

from agents.agent import Agent
from agents.arrays import Mask
from agents.decision.lifecycle import Phase
from agents.errors import ExplainedError

LEAD_S: Final = 0.5  # from the order to the common start
# orders before the start fall on multiples of this, so that repetitions a few ticks apart get the same
ORDERS_S: Final = 0.5
PATIENCE_S: Final = 60.0  # an experiment whose robots are not ready, up or down after this long never will be


class Stuck(ExplainedError):
    """Robots that do not become ready, airborne or done."""


class VirtualConductor:
    """Orders take-off, common start and end of all repetitions together."""

    airborne_at: float  # [s] of the clock; NaN before
    start_at: float  # [s] common start; NaN before it is known
    waited: Mask  # (repetitions,) that got an order later than alone, because another one was late
    over: bool  # all robots are done

    def __init__(self, agent: Agent, names: tuple[str, ...]) -> None:
        """`names` are the robots of one repetition; `agent` has the rows of all."""
        self._agent, self._names = agent, names
        self._stage = Phase.READY
        self._since = 0.0
        self.airborne_at = self.start_at = np.nan
        self.waited = np.zeros(len(agent.lifecycle.phase) // len(names), dtype=bool)
        self.over = False

    def give_orders(self, t: float, dt: float) -> None:
        """Gives the orders that are due after the tick at `t`, of length `dt` [s]."""
        if self._agent.lifecycle.all_running:
            return
        phase = self._agent.lifecycle.phase
        if self._stage == Phase.RUNNING:
            if phase.min() >= Phase.LANDING:
                self._since, self._stage = t, Phase.DONE
            return
        orders = not round(t / dt) % max(1, round(ORDERS_S / dt))
        if phase.min() < self._stage:
            if orders and self._stage < Phase.RUNNING:
                self.waited |= phase.reshape(len(self.waited), -1).min(axis=1) >= self._stage
            if t - self._since > PATIENCE_S:
                late = np.flatnonzero(phase < self._stage)[: len(self._names)]
                names = ", ".join(sorted({self._names[row % len(self._names)] for row in late}))
                reason = self._agent.lifecycle.reason[late[0]]
                raise Stuck(f"not {self._stage.word} after {PATIENCE_S:g} s: {names} ({reason})")
            return
        if self._stage < Phase.RUNNING and not orders:
            return
        self._since = t
        life = self._agent.lifecycle
        if self._stage == Phase.READY:
            for row in range(len(phase)):
                life.takeoff(row)
            self._stage = Phase.AIRBORNE
        elif self._stage == Phase.AIRBORNE:
            self.airborne_at = t
            self.start_at = t + round(LEAD_S / dt) * dt
            for row in np.flatnonzero(phase == Phase.AIRBORNE).tolist():
                life.start(row, self.start_at)
            self._stage = Phase.RUNNING
        else:
            self.over = True
