"""An experiment as an environment of learning, in virtual time: robots, channel and triggers are those that fly.

The environment is PettingZoo's `ParallelEnv` (J. K. Terry et al., "PettingZoo: Gym for Multi-Agent Reinforcement
Learning", NeurIPS 2021). An episode is the flight of its seed, from the common start to the end: with the actions of a
law it is the same to the last bit.
"""

from __future__ import annotations

import io
import math
import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import cached_property
from itertools import combinations
from typing import Any, Final

import numpy as np

from agents.decision.goals import GoalComputer
from agents.decision.lifecycle import LANDING
from agents.errors import did_you_mean
from agents.plugins.extras.observation import Observation
from agents.plugins.extras.policy import ACTIONS
from agents.plugins.law import View
from agents.vectors import difference
from experiments.file.document import Document, chosen_case
from experiments.learning.actions import Action, AgentActions, LearningError
from experiments.metrics.clearance import present_overlaps
from experiments.virtual_time.simulation import Snapshot, VirtualRun
from experiments.virtual_time.stretch import stretches_of
from twins.arrays import Array

try:
    from gymnasium import spaces
    from pettingzoo import ParallelEnv
except ImportError as error:
    remedy = "./zenpark install pettingzoo gymnasium, or pip install -e '.[learn]'"
    raise ImportError(f"{error}: environments need extra libraries: {remedy}") from None

Observe = Callable[[View], Sequence[float]]
Reward = Callable[[Snapshot, int], float]  # reward of the robot of a row
Infos = dict[str, dict[str, Any]]

PENALTY: Final = 50.0  # loss of a robot that ends early


class StatePickler(pickle.Pickler):
    """Writes a state without what all states of an environment share: its place in `shared` stands for it."""

    def __init__(self, buffer: io.BytesIO, shared: Sequence[object]) -> None:
        super().__init__(buffer, pickle.HIGHEST_PROTOCOL)
        self._places = {id(each): number for number, each in enumerate(shared)}

    def persistent_id(self, obj: object) -> int | None:
        return self._places.get(id(obj))


class StateUnpickler(pickle.Unpickler):
    """Reads a state that `Environment.save` made in this process."""

    def __init__(self, state: bytes, shared: Sequence[object]) -> None:
        super().__init__(io.BytesIO(state))
        self._shared = shared

    def persistent_load(self, pid: int) -> object:
        return self._shared[pid]


class Environment(ParallelEnv):  # type: ignore[misc] # it has no types
    """A case of an experiment as an environment; its agents are the robots that the law moves."""

    metadata: dict[str, Any] = {"name": "zenpark_v0", "render_modes": [], "is_parallelizable": True}  # noqa: RUF012
    render_mode = None

    def __init__(
        self,
        document: Document,
        case: str | None = None,
        *,
        agents: Sequence[str] = (),
        action: Action = "velocity",
        talk: bool = False,
        observes: str | Observe = "position velocity",
        observes_each: str = "place wanted",
        reward: Reward | None = None,
        message_price: float = 0.0,
        penalty: float = PENALTY,
        starts: int | None = None,
    ) -> None:
        """Prepare a case.

        Args:
            case: Its name; the first case if left out.
            agents: Which of the robots that the law moves; it goes on to move the others. All if left out.
            action: Meaning of an action: a velocity x, y [m/s], or a goal as seen from the robot [m].
            talk: An action has a third number, and the robot transmits its pose if that is positive. Intervals are
                those of the file's trigger.
            observes: Observation as in the metadata of the law `policy`, or a function from a `View` to numbers.
            observes_each: The same for each neighbour.
            reward: Function of the snapshot after a decision and of the row of a robot; less the mean of the true
                errors of its links [m] if left out.
            message_price: Loss for each pose that a robot sends.
            penalty: Loss of a robot that touches something, leaves the arena, or lands before the end.
            starts: Count of seeds that `reset` flies in turn, with common starts that are kept; all others if left
                out.

        Raises:
            DocumentError: If there is no such case.
            LearningError: If a robot cannot be an agent, with the remedy.
        """
        self.plan = plan = chosen_case(document, case)
        moved = [] if plan.guided else [each for each in plan.names if GoalComputer(plan.assignment(each)).follows]
        if not moved:
            guided = "a central controller decides for the robots; take a case without one"
            fault = guided if plan.guided else "the law moves no robot; give the formation links"
            raise LearningError(f"{document.path}: {fault}")
        for what, words, known in (("action", [action], ACTIONS), ("agent", agents, moved)):
            for word in words:
                if word not in known:
                    raise LearningError(f"{document.path}: no {what} {word!r}; {did_you_mean(word, known)}")
        self.possible_agents, self.agents = [each for each in moved if each in (agents or moved)], list[str]()
        self._reward: Reward = reward or self._link_error
        self._price, self._penalty = message_price, penalty
        self._rows = {name: row for row, name in enumerate(plan.names)}
        self._acts = AgentActions(action, plan.law, self._rows, talk=talk)
        given = {name: plan.assignment(name) for name in plan.names}
        self._assignments = given | {name: self._acts.assignment(given[name]) for name in self.possible_agents}
        self._every, kinds = given[plan.names[0]].decide_every, plan.kinds
        pairs = combinations(range(len(kinds)), 2)
        self._reach = [
            (i, j, kinds[i].radius + kinds[j].radius) for i, j in pairs
        ]  # rows, and distance at which they touch [m]
        self._starts, self._kept = starts, dict[int, bytes]()
        self._first = self._next = self.seed = plan.experiment.seed
        if callable(observes):
            self._observe: Observe = observes
            robots = VirtualRun(plan, self.seed, assignments=self._assignments).robots
            size = len(observes(robots[self._rows[self.possible_agents[0]]].view(0.0)))
        else:
            places = max(len(given[name].neighbours) for name in self.possible_agents)
            parts = Observation(tuple(observes.split()), tuple(observes_each.split()), places)
            self._observe, size = parts.of, parts.size
        self.action_spaces, self.observation_spaces = {}, {}
        for name in self.possible_agents:
            most = kinds[self._rows[name]].speed if action == ACTIONS[0] else given[name].clamp
            high = np.array([most, most, 1.0][: len(self._acts.numbers)], np.float32)
            self.action_spaces[name] = spaces.Box(-high, high, dtype=np.float32)
            self.observation_spaces[name] = spaces.Box(-np.inf, np.inf, (size,), np.float32)

    def observation_space(self, agent: str) -> spaces.Box:
        """Space of the observations of an agent."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Box:
        """Space of the actions of an agent; longer ones are limited by the setpoint filter, as in flight."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Array], Infos]:
        """Begin the episode that is the flight of a seed; without a seed that of the next one.

        `options`: with `state`, a result of `save`, the episode goes on from there.
        """
        if seed is not None:
            self._first = self._next = int(seed)
        self._acts.clear()
        if options and "state" in options:
            self._restore(options["state"])
        else:
            self.seed = self._next
            self._next += 1
            if self._starts is not None and self._next >= self._first + self._starts:
                self._next = self._first
            self._begin(self.seed)
        return self._observations(), {agent: {"seed": self.seed} for agent in self.agents}

    def _begin(self, seed: int) -> None:
        """Fly to the common start, or take the one that is kept."""
        if (kept := self._kept.get(seed)) is not None:
            return self._restore(kept)
        self.agents, self.seed = list(self.possible_agents), seed
        self._run = VirtualRun(self.plan, seed, lean=True, assignments=self._assignments)
        self._run.begin()
        if self._starts is not None:
            self._kept[seed] = self.save()
        return None

    def save(self) -> bytes:
        """State of the episode, for `reset(options={"state": state})` of this environment.

        Raises LearningError where the engine keeps none.
        """
        buffer = io.BytesIO()
        pickler = StatePickler(buffer, self._shared)
        try:
            pickler.dump((self.seed, self.agents, self._run))
        except TypeError as error:  # a foreign engine
            message = f"the engine {self.plan.engine_name} keeps no states ({error})"
            raise LearningError(f"{message}; leave `starts` out, or take the engine point-mass") from None
        return buffer.getvalue()

    def _restore(self, state: bytes) -> None:
        self.seed, self.agents, self._run = StateUnpickler(state, self._shared).load()
        self._run.stretches = stretches_of(self._run)

    @cached_property
    def _shared(self) -> list[object]:
        """Objects that no flight changes: states refer to them."""
        assignments = self._assignments.values()
        parts = [getattr(each, field.name) for each in assignments for field in fields(each)]
        return [self.plan, *assignments, *(part for part in parts if not isinstance(part, int | float | str))]

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[dict[str, Array], dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Fly until the next decision; raises LearningError where an action is missing, or a number is not finite."""
        self._acts.take(actions, self.agents)
        run, sent = self._run, list(self._run.network.seq)
        run.fly_ticks(self._every, everything=self._reward != self._link_error)
        snapshot = run.snapshot(run.time)
        over, hurt = snapshot.time >= self.plan.experiment.duration_s - 0.5 * run.dt, self._hurt(snapshot)
        rewards, infos = dict[str, float](), Infos()
        ended = dict[str, bool]()
        for agent in self.agents:
            row = self._rows[agent]
            lands = snapshot.robots[row].lifecycle.phase >= LANDING
            ended[agent] = row in hurt or (lands and not over)
            count = run.network.seq[row] - sent[row]
            infos[agent] = {"messages": count, "seed": self.seed}
            rewards[agent] = self._given(agent, snapshot, row) - self._price * count - self._penalty * ended[agent]
        truncated = {agent: over and not ended[agent] for agent in self.agents}
        observations = self._observations()
        self.agents = [agent for agent in self.agents if not (over or ended[agent])]
        return observations, rewards, ended, truncated, infos

    def _given(self, agent: str, snapshot: Snapshot, row: int) -> float:
        """The reward of an agent, checked."""
        given = self._reward(snapshot, row)
        if not (isinstance(given, int | float | np.number) and math.isfinite(given)):
            raise LearningError(f"{agent}: the reward at {snapshot.time:.2f} s is {given!r}; return a finite number")
        return float(given)

    def view(self, agent: str) -> View:
        """View of an agent, as its law would get it now; once between two steps."""
        return self._run.view(self._rows[agent])

    def _observations(self) -> dict[str, Array]:
        return {agent: np.array(self._observe(self.view(agent)), dtype=np.float32) for agent in self.agents}

    def _link_error(self, snapshot: Snapshot, row: int) -> float:
        """Less the mean of the true errors of a robot's links [m]; 0 where none is known."""
        place, errors = snapshot.states[row].true_position, list[float]()
        for sender in snapshot.robots[row].neighbours.all:
            if sender.active:
                other = snapshot.states[sender.sender].true_position
                errors.append(self.plan.law.error(difference(place, other), sender.link))
        known = [each for each in errors if math.isfinite(each)]
        return -sum(known) / len(known) if known else 0.0

    def _hurt(self, snapshot: Snapshot) -> set[int]:
        """Rows of robots that touch something now, or are outside of the arena."""
        plan, places = self.plan, [state.true_position for state in snapshot.states]
        limits = snapshot.robots[0].assignment.limits
        bounds = tuple(zip(limits.low, limits.high, strict=True))
        inside = [all(low <= x <= high for x, (low, high) in zip(each, bounds, strict=True)) for each in places]
        found = {row for row, holds in enumerate(inside) if not holds}
        near = [math.hypot(places[i][0] - places[j][0], places[i][1] - places[j][1]) < r for i, j, r in self._reach]
        if any(near) or plan.experiment.arena.obstacles:
            obstacles = np.array(snapshot.engine.obstacles)
            for each in present_overlaps(
                plan.names, plan.kinds, np.array(places), plan.scene, obstacles, watched=False
            ):
                found |= {self._rows[name] for name in (each.first, each.second) if name in self._rows}
        return found
