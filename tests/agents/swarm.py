"""Robots of an experiment in any number of groups, each with its own decision and its own twins, that only exchange
what their triggers send: every group is what a process would be.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import msgspec
import numpy as np

from agents.agent import Actions, Agent
from agents.body.interface import BodyState
from agents.decision.lifecycle import AIRBORNE, READY, RUNNING
from experiments.definition import bodies
from experiments.definition.experiment import Experiment
from experiments.definition.plan import Plan
from tests.agents.things import poses
from twins.body import TwinBody

LEAD_S = 0.5


class Group:
    """The robots of one process."""

    def __init__(self, experiment: Experiment, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self.assignment = Plan(experiment).assignment(self.names)
        self.agent = Agent(self.assignment)
        self.body = TwinBody(bodies.body_request(experiment, self.names, [experiment.seed]))
        self.agent.neighbours.mark_alive(np.arange(len(self.assignment.links)))
        self.by_speaker = self.assignment.links.by_sender(self.assignment.robots)
        self.state: BodyState
        self.actions: Actions

    def hear(self, speaker: str, position, velocity, stamp: float, arrived: float) -> None:
        """As a process does it: one sample on all links of its speaker."""
        links = self.by_speaker.get(speaker)
        if links is not None:
            many = (len(links), 1)
            stamps, arrivals = np.full(len(links), stamp), np.full(len(links), arrived)
            self.agent.neighbours.receive(
                poses(links, np.tile(position, many), np.tile(velocity, many), stamps, arrivals)
            )

    def step(self, t: float) -> None:
        """One tick of the process."""
        agent, body = self.agent, self.body
        state = body.read(t)
        # copies: without noise the measured position is the true one, in the same array
        self.state = self.spoil(t, replace(state, time=state.time.copy(), position=state.position.copy()))
        self.actions = agent.step(t, self.state)
        duties = self.actions.commands
        if duties is not None:
            body.stop(duties.stop)
            body.land(duties.land)
            body.takeoff(duties.takeoff, self.assignment.hover[duties.takeoff])
        body.command(self.actions.setpoint)

    def spoil(self, t: float, state: BodyState) -> BodyState:
        """What a test makes of the measurement."""
        return state


class Swarm:
    """All groups on one clock; `order` gives every robot by name, whichever group it is in."""

    def __init__(self, experiment: Experiment, groups: Iterable[Sequence[str]] | None = None) -> None:
        self.experiment = experiment
        names = tuple(experiment.robots)
        self.groups = [Group(experiment, group) for group in (groups if groups is not None else [names])]
        self.where = {name: (group, row) for group in self.groups for row, name in enumerate(group.names)}
        self.names = tuple(name for name in names if name in self.where)
        self.dt = 1.0 / experiment.rates.body_hz
        self.tick = 0
        self.start_at = np.inf
        self.sent: list[tuple[int, str]] = []
        self.log: list[dict[str, np.ndarray]] = []
        self._flying: list[tuple[str, np.ndarray, np.ndarray, float]] = []

    @property
    def t(self) -> float:
        return self.tick * self.dt

    @property
    def since(self) -> float:
        """Time of the experiment [s]."""
        return self.t - self.start_at

    def agent(self, name: str) -> Agent:
        return self.where[name][0].agent

    def phase(self, name: str) -> int:
        group, row = self.where[name]
        return int(group.agent.lifecycle.phase[row])

    def row(self, name: str, what: str) -> np.ndarray:
        """What the last tick says of one robot."""
        return self.log[-1][what][self.names.index(name)]

    def speaker_links(self, speaker: str) -> list[tuple[Agent, np.ndarray]]:
        """Every decision that listens to a robot, and on which of its links."""
        return [(g.agent, g.by_speaker[speaker]) for g in self.groups if speaker in g.by_speaker]

    def conduct(self) -> None:
        """Gives the orders that a conductor gives."""
        phases = [self.phase(name) for name in self.names]
        if min(phases) == READY:
            for group, row in self.where.values():
                assert group.agent.lifecycle.takeoff(row) == ""
        elif min(phases) == AIRBORNE and self.start_at == np.inf:
            self.start_at = self.t + LEAD_S
            for group, row in self.where.values():
                assert group.agent.start(row, self.start_at) == ""

    def step(self) -> None:
        """One tick of everybody; what is said now is heard on the next one."""
        arriving, self._flying = self._flying, []
        for speaker, position, velocity, stamp in arriving:
            for group in self.groups:
                group.hear(speaker, position, velocity, stamp, self.t)
        for group in self.groups:
            group.step(self.t)
        for name in self.names:  # in one order, however they are grouped
            group, row = self.where[name]
            if row in group.actions.transmit:
                self.sent.append((self.tick, name))
                said = group.actions
                self._flying.append((name, said.position[row].copy(), said.velocity[row].copy(), self.t))
        self.log.append({what: self._all(what) for what in ("phase", "goal", "error", "setpoint", "position", "truth")})
        self.tick += 1

    def _all(self, what: str) -> np.ndarray:
        def of(group: Group) -> np.ndarray:
            match what:
                case "phase":
                    return group.agent.lifecycle.phase
                case "setpoint":
                    return group.actions.setpoint
                case "position":
                    return group.state.position
                case "truth":
                    return group.state.true_position
            return getattr(group.agent, what)

        return np.array([of(group)[row] for group, row in (self.where[name] for name in self.names)])

    def until(self, phase: int, most_s: float = 60.0) -> Swarm:
        """Until all are there."""
        deadline = self.t + most_s
        while min(self.phase(name) for name in self.names) < phase:
            assert self.t < deadline, {name: self.phase(name) for name in self.names}
            self.step()
            self.conduct()
        return self

    def run(self, seconds: float) -> Swarm:
        for _ in range(round(seconds / self.dt)):
            self.step()
        return self

    def running(self) -> Swarm:
        """Until the experiment begins."""
        return self.until(RUNNING)

    def column(self, what: str) -> np.ndarray:
        """Over time."""
        return np.array([moment[what] for moment in self.log])


def changed(experiment: Experiment, **parts: object) -> Experiment:
    """The experiment with other parts."""
    return msgspec.structs.replace(experiment, **parts)
