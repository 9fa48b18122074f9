"""Environments for learners of Gymnasium: many at once, on all cores, and that of a single agent."""

from __future__ import annotations

import multiprocessing
import pickle
import signal
from collections.abc import Mapping, Sequence
from multiprocessing.connection import Connection
from typing import Any, Final

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_space

from experiments.cores import cores
from experiments.learning.actions import LearningError
from experiments.learning.environment import Environment
from experiments.learning.window import SEEN
from twins.arrays import Array, Mask

SEEDS: Final = 10_000  # seeds of one environment before those of the next one
ENDED_S: Final = 5.0  # [s] longest wait for the end of a process

Outcome = tuple[Any, Array, Mask, Mask, dict[int, Any]]  # results of `Batch.step`


class SingleAgent(gymnasium.Env[Any, Any]):
    """The environment of an experiment with one agent, as one of Gymnasium."""

    def __init__(self, many: Environment) -> None:
        """Take an environment; raises LearningError if it has several agents."""
        if len(many.possible_agents) != 1:
            names = ", ".join(many.possible_agents)
            raise LearningError(f"an environment of Gymnasium has one agent, not {names}; name one with `agents=`")
        self.many, (self.agent,) = many, many.possible_agents
        self.observation_space = many.observation_space(self.agent)
        self.action_space = many.action_space(self.agent)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """As that of `Environment`."""
        super().reset(seed=seed)
        observations, infos = self.many.reset(seed, options)
        return observations[self.agent], infos[self.agent]

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """As that of `Environment`."""
        name = self.agent
        observations, rewards, ended, truncated, infos = self.many.step({name: action})
        return observations[name], rewards[name], ended[name], truncated[name], infos[name]


class Batch:
    """Equal environments in one process."""

    def __init__(self, pickled: bytes, count: int) -> None:
        self.every: list[Environment] = [pickle.loads(pickled) for _ in range(count)]  # noqa: S301 - of `Environments`

    def reset(self, seeds: Sequence[int | None]) -> Array:
        """Observations (E, N, K)."""
        for each, seed in zip(self.every, seeds, strict=True):
            each.reset(seed)
        return np.array([each.observed for each in self.every])

    def step(self, actions: Array) -> Outcome:
        """Fly on by the actions (E, N, A); an environment of which a robot has ended begins again.

        Returns:
            Observations (E, N, K), rewards, ends and truncations (E, N), and the last observations of what has ended.
        """
        every, names = self.every, self.every[0].agents
        for each, given in zip(every, actions, strict=True):
            each.acts.take_rows(given, names)
        found = every[0].rewards.decide([each.flight for each in every], [each.table for each in every], every[0].rows)
        seen = found.shown[:, :, SEEN:].astype(np.float32)
        if every[0].looks:
            seen = np.array([each.observed for each in every])
        done, last = found.over | found.ended.any(axis=1), dict[int, Array]()
        for number in np.flatnonzero(done).tolist():
            last[number] = seen[number].copy()
            every[number].reset()
            seen[number] = every[number].observed
        return seen, found.rewards, found.ended, done[:, None] & ~found.ended, last


class Environments(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """Many equal environments on all cores, as one of Gymnasium's vectors: one row for each agent of each of them.

    All agents share one policy, as most learners have it. Where a robot ends, its whole environment begins again in the
    same step; the others are truncated, and `final_obs` of the infos has the last observations.
    """

    def __init__(self, single: Environment, count: int, *, processes: int | None = None) -> None:
        """Begin `count` environments like a `single` one, in as many `processes`; one for each core if left out.

        Functions given to it must stand in a module, for other processes to find them. Raises LearningError if agents
        have different actions.
        """
        names = single.possible_agents
        highs = {tuple(single.action_space(name).high.tolist()) for name in names}
        if len(highs) > 1:
            raise LearningError("agents have actions of different sizes; name those of one kind with `agents=`")
        self.metadata = {"autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP}
        self.count, self.agents = count, len(names)
        self.num_envs = count * len(names)
        self.single_observation_space = single.observation_space(names[0])
        self.single_action_space = single.action_space(names[0])
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._seed, pickled = single.seed, pickle.dumps(single)
        share = min(processes or cores(), count)
        self._parts = np.array_split(np.arange(count), share)
        context = multiprocessing.get_context("spawn")  # a fork would take our threads' locks along
        self._pipes, self._processes = list[Connection](), list[Any]()
        self._own = Batch(pickled, count) if share == 1 else None
        for part in self._parts if share > 1 else ():
            parent_end, child_end = context.Pipe()
            process = context.Process(target=_serve, args=(child_end, pickled, len(part)), daemon=True)
            process.start()
            child_end.close()
            self._pipes.append(parent_end)
            self._processes.append(process)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin all episodes; environment k of a seed begins with `seed` + 10,000 k, or with the k-th of several."""
        first = self._seed if seed is None else seed
        seeds = [first + SEEDS * k for k in range(self.count)] if isinstance(first, int) else [*first]
        found = self._ask("reset", [[seeds[k] for k in part] for part in self._parts])
        return self._rows(np.concatenate(found)), {}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Fly on; actions, observations and what follows have a row for each agent."""
        given = np.asarray(actions).reshape(self.count, self.agents, -1)
        found = self._ask("step", [given[part] for part in self._parts])
        seen, rewards, ended, truncated = (
            self._rows(np.concatenate(each)) for each in list(zip(*found, strict=True))[:4]
        )
        infos: dict[str, Any] = {}
        for part, (*_, last) in zip(self._parts, found, strict=True):
            for number, observations in last.items():
                rows = slice(self.agents * part[number], self.agents * (part[number] + 1))
                infos.setdefault("final_obs", np.full(self.num_envs, None, dtype=object))[rows] = [*observations]
        if infos:
            infos["_final_obs"] = np.array([each is not None for each in infos["final_obs"]])
        return seen, rewards, ended, truncated, infos

    def _rows(self, values: Array) -> Array:
        """Values (E, N, ...) by rows (E·N, ...)."""
        found: Array = values.reshape(self.num_envs, *values.shape[2:])
        return found

    def _ask(self, what: str, given: Sequence[Any]) -> list[Any]:
        """Results of a method of all batches; raises what one of them raises."""
        if self._own is not None:
            return [getattr(self._own, what)(given[0])]
        for pipe, each in zip(self._pipes, given, strict=True):
            pipe.send((what, each))
        found = [pipe.recv() for pipe in self._pipes]
        for each in found:
            if isinstance(each, Exception):
                raise each
        return found

    def close_extras(self, **_: Any) -> None:  # noqa: ANN401 - as its base
        """End the processes."""
        for pipe in self._pipes:
            pipe.close()
        for process in self._processes:
            process.join(ENDED_S)
            process.kill()
            process.close() if process.exitcode is not None else None


def _serve(pipe: Connection, pickled: bytes, count: int) -> None:
    """A process: a batch, until the other end of the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's
    batch = Batch(pickled, count)
    while True:
        try:
            what, given = pipe.recv()
        except EOFError:
            return
        try:
            found = getattr(batch, what)(given)
        except Exception as error:  # noqa: BLE001 - the parent raises it
            found = error
        pipe.send(found)
