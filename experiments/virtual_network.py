"""Who says what to whom in virtual time: the first half of a tick of all robots, and a log of what was said."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from agents.agent import Agent
from agents.body import BodyState
from agents.rows import Array, Index
from agents.speaking import Said
from experiments.channel import Channel
from experiments.experiment import Experiment
from experiments.steering import Steered, Steering, joined

Heard = tuple[Array, Index, Index, Array, Array, Array]


class VirtualNetwork:
    """Carries poses between robots, and poses and goals between them and their centre, if they have one."""

    def __init__(self, experiment: Experiment, agent: Agent, seeds: Sequence[int], *, lean: bool) -> None:
        """For all repetitions; `lean` as for `experiments.virtual.simulate`."""
        assignment, rows = agent.assignment, len(agent.assignment.names)
        self._agent, self._lean = agent, lean
        self._channel = Channel(experiment, assignment.links, seeds)
        self._steering = None if assignment.guided is None else Steering(experiment, seeds)
        self._seq: Index = np.zeros(rows, dtype=np.intp)
        self._nothing = np.zeros((rows, 0))
        agent.find(np.arange(len(assignment.links)))  # all robots are there from the beginning
        self._sent: list[tuple[Any, ...]] = []
        self._heard: list[tuple[Any, ...]] = []

    def carry(self, t: float, state: BodyState) -> Said:
        """The first half of the tick at `t` [s]: what has arrived is heard, and robots speak.

        Without any delay, what they say is known to all before the second half; and so are the goals that follow.
        """
        agent, steering, instant = self._agent, self._steering, self._channel.instant
        self._deliver(t)
        said = agent.speak(t, state)
        if len(said.rows):
            self._say(t, said, state.yaw)
            if instant:
                self._deliver(t)
        if steering is not None and agent.decides:
            steering.decide(t, agent)
            if instant:
                steering.deliver(t, agent)
        return said

    def _say(self, t: float, said: Said, yaw: Array) -> None:
        """Robots speak to those who listen. Before the common start nothing is lost."""
        speak, start = said.rows, float(self._agent.life.start_at.min())
        self._seq[speak] += 1
        told = (said.position[speak], said.velocity[speak], yaw[speak])
        told = (self._nothing[speak],) * 3 if self._lean else told
        self._sent.append((np.full(len(speak), t), speak, self._seq[speak], *told))
        self._channel.send(t, speak, self._seq, said.position, said.velocity, yaw=yaw, start=start)
        if self._steering is not None:
            self._steering.say(t, speak, self._seq, said.position, said.velocity, yaw, start=start)

    def _deliver(self, t: float) -> None:
        """What has arrived is heard."""
        heard = self._channel.due(t)
        if heard is not None:
            self._agent.hear(heard.link, heard.position, heard.velocity, heard.stamp, heard.arrival)
            if not self._lean:
                news = (heard.arrival, heard.link, heard.seq, heard.stamp, heard.position, heard.velocity)
                self._heard.append(news)
        if self._steering is not None:
            self._steering.deliver(t, self._agent)

    def sent(self, begin: float) -> Heard:
        """Columns time, row, seq, position, velocity, yaw; times from the common start at `begin` [s]."""
        at, row, number, position, velocity, yaw = joined(self._sent, (0,), (0,), (0,), (0, 3), (0, 3), (0,))
        return at - begin, row.astype(np.intp), number.astype(np.intp), position, velocity, yaw

    def heard(self, begin: float) -> Heard:
        """Columns time, link, seq, stamp, position, velocity; likewise."""
        at, link, number, stamp, position, velocity = joined(self._heard, (0,), (0,), (0,), (0,), (0, 3), (0, 3))
        return at - begin, link.astype(np.intp), number.astype(np.intp), stamp - begin, position, velocity

    @property
    def lost(self) -> Index:
        """(E,) samples lost on each link, from the common start to the end of the experiment."""
        return self._channel.lost

    def steered(self, begin: float) -> Steered | None:
        """What went between robots and centre; None if every robot decides for itself."""
        return None if self._steering is None else self._steering.logged(begin)
