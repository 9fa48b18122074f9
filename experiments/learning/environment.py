"""An experiment as an environment of learning, in virtual time: robots, channel and triggers are those that fly.

The environment is PettingZoo's `ParallelEnv` (J. K. Terry et al., "PettingZoo: Gym for Multi-Agent Reinforcement
Learning", NeurIPS 2021). An episode is the flight of its seed, from the common start to the end: with the actions of a
law it is the same to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from agents.decision.goals import GoalComputer
from agents.errors import did_you_mean
from agents.plugins.extras.observation import Observation
from agents.plugins.extras.policy import ACTIONS
from agents.plugins.law import View
from experiments.file.document import Document, chosen_case
from experiments.learning.actions import Action, AgentActions, LearningError
from experiments.learning.rewards import PENALTY, Reward, Rewards
from experiments.learning.states import EpisodeStates
from experiments.learning.window import SEEN, Window
from experiments.virtual_time.simulation import VirtualRun
from experiments.virtual_time.stretch import stretches_of
from twins.arrays import Array

try:
    from gymnasium import spaces
    from pettingzoo import ParallelEnv
except ImportError as error:
    remedy = "./zenpark install pettingzoo gymnasium, or pip install -e '.[learn]'"
    raise ImportError(f"{error}: environments need extra libraries: {remedy}") from None

Observe = Callable[[View], Sequence[float]]
Infos = dict[str, dict[str, Any]]

LONGER_S: Final = 1.0  # [s] time from the end of an episode to that of its robots' flight


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
        self.rewards = Rewards(plan, reward, message_price, penalty)
        self._rows = {name: row for row, name in enumerate(plan.names)}
        self.acts = AgentActions(action, plan.law, self._rows, talk=talk)
        given = {name: plan.assignment(name) for name in plan.names}
        given |= {name: self.acts.assignment(given[name]) for name in self.possible_agents}
        # no robot begins to land on the tick on which an episode ends
        self._assignments = {name: replace(each, duration=each.duration + LONGER_S) for name, each in given.items()}
        self._every, kinds = given[plan.names[0]].decide_every, plan.kinds
        self._starts, self._kept = starts, dict[int, bytes]()
        # by seed, each with the time of its start [s], and what is shown then
        self.flights: dict[int, tuple[VirtualRun, float, Array]] = {}
        self._first = self._next = self.seed = plan.experiment.seed
        if callable(observes):
            self.looks: Observe | None = observes  # function that observes
            robots = VirtualRun(plan, self.seed, assignments=self._assignments).robots
            size = len(observes(robots[self._rows[self.possible_agents[0]]].view(0.0)))
            parts = Observation((), ())
        else:
            self.looks = None
            places = max(len(given[name].neighbours) for name in self.possible_agents)
            parts = Observation(tuple(observes.split()), tuple(observes_each.split()), places)
            size = parts.size
        limits, rows = given[plan.names[0]].limits, [self._rows[name] for name in self.possible_agents]
        self._window = Window(plan.law, kinds, limits.low, limits.high, rows, parts)
        self._states = EpisodeStates(plan, self._assignments.values())
        self.action_spaces, self.observation_spaces = {}, {}
        for name in self.possible_agents:
            most = kinds[self._rows[name]].speed if action == ACTIONS[0] else given[name].clamp
            high = np.array([most, most, 1.0][: len(self.acts.numbers)], np.float32)
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
        if options and "state" in options:
            self._restore(options["state"])
            self._show()
        else:
            self.seed = self._next
            self._next += 1
            if self._starts is not None and self._next >= self._first + self._starts:
                self._next = self._first
            self._begin(self.seed)
        self.acts.clear()
        self.np_random = np.random.default_rng(self.seed)  # wrappers draw from it
        return self._observations(), {agent: {"seed": self.seed} for agent in self.agents}

    def _begin(self, seed: int) -> None:
        """Fly to the common start, or take the one that is kept."""
        flight, begin, shown = self.flights.get(seed, (None, 0.0, None))
        if flight is not None and flight.rewind(begin):
            self.flight, self._window.table[:] = flight, shown
            self.agents, self.seed = list(self.possible_agents), seed
            return
        if seed in self._kept:
            self._restore(self._kept[seed])
        else:
            self.agents, self.seed = list(self.possible_agents), seed
            self.flight = VirtualRun(self.plan, seed, lean=True, assignments=self._assignments, window=self._window)
            self.flight.begin()
        if self._starts is not None and seed not in self._kept:
            self._restore(self._kept.setdefault(seed, self.save()))
        self._show()
        if self._starts is not None:
            self.flights[seed] = self.flight, self.flight.time, self._window.table.copy()

    def _show(self) -> None:
        """Show the robots as they are now."""
        self._window.clear()
        self.flight.show()

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"flights": {}}

    def save(self) -> bytes:
        """State of the episode, for `reset(options={"state": state})` of this environment.

        Raises LearningError where the engine keeps none.
        """
        return self._states.save((self.seed, self.agents, self.flight))

    def _restore(self, state: bytes) -> None:
        self.seed, self.agents, self.flight = self._states.restore(state)
        self.flight.window = self._window
        self.flight.stretches = stretches_of(self.flight)

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[dict[str, Array], dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Fly until the next decision; raises LearningError where an action is missing, or a number is not finite."""
        self.acts.take(actions, self.agents)
        names, seed = self.agents, self.seed
        found = self.rewards.decide([self.flight], [self.table], self.rows)
        ended = dict(zip(names, found.ended[0].tolist(), strict=True))
        rewards = dict(zip(names, found.rewards[0].tolist(), strict=True))
        counts = zip(names, found.messages[0].tolist(), strict=True)
        infos = {name: {"messages": count, "seed": seed} for name, count in counts}
        over = bool(found.over[0])
        truncated = {name: over and not end for name, end in ended.items()}
        observations = self._observations()
        self.agents = [name for name, end in ended.items() if not (over or end)]
        return observations, rewards, ended, truncated, infos

    @property
    def table(self) -> Array:
        """The robots as they are shown, see `experiments.learning.window`."""
        return self._window.table

    @property
    def rows(self) -> list[int]:
        """Rows of the agents among all robots."""
        return [self._rows[name] for name in self.agents]

    def view(self, agent: str) -> View:
        """View of an agent, as its law would get it now; once between two steps."""
        self.flight.read(everything=False)
        return self.flight.view(self._rows[agent])

    @property
    def observed(self) -> Array:
        """Observations (N, K) of the agents, float32."""
        if self.looks is not None:
            return np.array([self.looks(self.view(agent)) for agent in self.agents], dtype=np.float32)
        return self.table[self.rows, SEEN:].astype(np.float32)

    def _observations(self) -> dict[str, Array]:
        return dict(zip(self.agents, self.observed, strict=True))
