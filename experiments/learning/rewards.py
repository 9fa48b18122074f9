"""Rewards of agents, and the ends of their episodes, of many flights at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np

from agents.decision.lifecycle import LANDING
from experiments.definition.plan import Plan
from experiments.learning.actions import LearningError
from experiments.learning.window import ERROR, HURT, OUTSIDE, PHASE, SENT
from experiments.metrics.clearance import present_overlaps
from experiments.virtual_time.simulation import Snapshot, VirtualRun
from twins.arrays import Array, Index, Mask

Reward = Callable[[Snapshot, int], float]  # reward of the robot of a row

PENALTY: Final = 50.0  # loss of a robot that ends early


class Payoff(NamedTuple):
    """Payoff of a decision in E flights, for N agents in each."""

    rewards: Array  # (E, N)
    ended: Mask  # (E, N) whether an agent ends early
    over: Mask  # (E,) whether a flight is over
    messages: Index  # (E, N) poses that were sent since the last decision
    shown: Array  # (E, N, 8 + K) rows of the agents, see `experiments.learning.window`


class Rewards:
    """Payoff and losses of agents."""

    def __init__(self, plan: Plan, reward: Reward | None, price: float, penalty: float) -> None:
        """Take a `reward`, or the mean true error of the links; the `price` of a pose and the `penalty` of an end."""
        self._plan, self._reward = plan, reward
        self._price, self._penalty = price, penalty
        self._numbers = {name: row for row, name in enumerate(plan.names)}

    def decide(self, flights: Sequence[VirtualRun], tables: Sequence[Array], rows: Sequence[int]) -> Payoff:
        """Fly until the next decision of these flights, of agents in these `rows`; `tables` show all robots."""
        sent = np.array([table[rows, SENT] for table in tables])
        for flight in flights:
            flight.fly_ticks(flight.robots[0].assignment.decide_every)
        shown = np.array(tables)
        of_agents, experiment = shown[:, rows], self._plan.experiment
        ends = experiment.duration_s - 0.5 * flights[0].dt
        over = np.array([flight.time - flight.start_at >= ends for flight in flights])
        ended = (of_agents[..., PHASE] >= LANDING) & ~over[:, None]
        some = np.ones(len(flights)) if experiment.arena.obstacles else shown[..., HURT].any(axis=1)
        for number in np.flatnonzero(some).tolist():
            ended[number] |= np.isin(rows, self._hurt(flights[number], shown[number]))
        messages = of_agents[..., SENT] - sent
        rewards = -of_agents[..., ERROR]
        if self._reward is not None:
            rewards = np.array([self._given(self._reward, flight, rows) for flight in flights])
        rewards = rewards - self._price * messages - self._penalty * ended
        return Payoff(rewards, ended, over, messages.astype(np.intp), of_agents)

    def _given(self, reward: Reward, flight: VirtualRun, rows: Sequence[int]) -> list[float]:
        """Rewards by a function, checked."""
        flight.read()
        snapshot, found = flight.snapshot(flight.time), list[float]()
        for row in rows:
            given = reward(snapshot, row)
            if not (isinstance(given, int | float | np.number) and math.isfinite(given)):
                when = f"the reward at {snapshot.time:.2f} s"
                raise LearningError(f"{self._plan.names[row]}: {when} is {given!r}; return a finite number")
            found.append(float(given))
        return found

    def _hurt(self, flight: VirtualRun, table: Array) -> list[int]:
        """Rows of robots that touch something now, or are outside of the arena."""
        plan, found = self._plan, np.flatnonzero(table[:, HURT] == OUTSIDE).tolist()
        obstacles = np.array(flight.twin.engine.obstacles)
        for each in present_overlaps(plan.names, plan.kinds, table[:, :3], plan.scene, obstacles, watched=False):
            found += [self._numbers[name] for name in (each.first, each.second) if name in self._numbers]
        return found
