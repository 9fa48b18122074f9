"""The centre of a run in virtual time: what it hears, its goals on their way to the robots, and a log of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from agents.agent import Agent
from agents.centre import Centre
from agents.graph import links
from agents.rows import Array, Index
from experiments import assign
from experiments.channel import FROM_CENTRE, TO_CENTRE, Channel
from experiments.experiment import Experiment


@dataclass
class SteeringLog:
    """What went between robots and centre, columns that grow; times on the clock of the run [s].

    Attributes:
        sent: Goals: time, row, number, goal (K, 3), yaw, time of the pose on which it rests.
        followed: Goals that reached a robot which runs: time, row, number, time sent, time of the pose.
        heard: Poses that the centre heard: time, row.
    """

    sent: list[tuple[Array | Index, ...]] = field(default_factory=list)
    followed: list[tuple[Array | Index, ...]] = field(default_factory=list)
    heard: list[tuple[Array | Index, ...]] = field(default_factory=list)


class Steering:
    """A centre for all repetitions of an experiment. It has one process's share of the network: what robots say to it,
    and what it says to them, takes as long and is lost as often as what robots say to each other.

    Phases and the common start are the conductor's, and known to everybody at once, as they are to the robots.

    Attributes:
        log: See `SteeringLog`.
        centre: The decision.
    """

    def __init__(self, experiment: Experiment, seeds: Sequence[int]) -> None:
        self.centre = Centre(assign.assign_centre(experiment, len(seeds)))
        self.log = SteeringLog()
        rows = len(self.centre.guided)
        ends = [(row, row) for row in self.centre.listens.tolist()], [(row, row) for row in np.flatnonzero(self.centre.guided).tolist()]
        self._poses, self._goals = (
            Channel(links(pairs, [1.0] * len(pairs), [1.0] * len(pairs)), experiment.channel, seeds, stream=stream)
            for pairs, stream in zip(ends, (TO_CENTRE, FROM_CENTRE), strict=True)
        )
        self._poses_of, self._goals_of = (np.array([row for row, _ in pairs], dtype=np.intp) for pairs in ends)
        self._seq: Index = np.zeros(rows, dtype=np.intp)
        self._goal, self._still = np.full((rows, 3), np.nan), np.zeros((rows, 3))
        self._extra = np.full((rows, 2), np.nan)

    @property
    def lost(self) -> tuple[Index, Index]:
        """(N,) poses that did not reach the centre, and goals that did not reach their robots."""
        counts = np.zeros((2, len(self._seq)), dtype=np.intp)
        counts[0, self._poses_of], counts[1, self._goals_of] = self._poses.lost, self._goals.lost
        return counts[0], counts[1]

    def say(self, t: float, rows: Index, seq: Index, position: Array, velocity: Array, yaw: Array, *, surely: bool) -> None:
        """Robots say where they are, to whoever listens; see `Channel.send`."""
        self._poses.send(t, rows, seq, position, velocity, surely=surely, extra=yaw[:, None])

    def deliver(self, t: float, agent: Agent) -> None:
        """Hands out at `t` [s] what has arrived: poses to the centre, goals to the robots."""
        arrived = self._poses.due(t)
        if arrived is not None and arrived.extra is not None:
            rows = self._poses_of[arrived.link]
            self.centre.hear(
                rows, arrived.position, arrived.velocity, arrived.extra[:, 0], arrived.stamp, arrived.arrival
            )
            self.log.heard.append((arrived.arrival, rows))
        arrived = self._goals.due(t)
        if arrived is not None and arrived.extra is not None:
            # of several for one robot the newest counts
            arrived = arrived.take(np.argsort(arrived.stamp, kind="stable"))
            _, last = np.unique(arrived.link[::-1], return_index=True)
            arrived = arrived.take(len(arrived.link) - 1 - last)
            rows = self._goals_of[arrived.link]
            assert arrived.extra is not None
            toward, rests = arrived.extra.T
            news = agent.hear_goal(rows, arrived.position, toward, arrived.stamp)
            if news.any():
                now = np.full(int(news.sum()), t)
                self.log.followed.append((now, rows[news], arrived.seq[news], arrived.stamp[news], rests[news]))

    def decide(self, t: float, agent: Agent) -> None:
        """On a tick on which goals are decided: those of the robots that are guided."""
        told = self.centre.decide(t, agent.life.phase, agent.life.start_at)
        rows = told.rows
        if not len(rows):
            return
        self._seq[rows] += 1
        self._goal[rows], self._extra[rows, 0], self._extra[rows, 1] = told.goal, told.toward, told.rests
        self._goals.send(
            t, rows, self._seq, self._goal, self._still, surely=not agent.begun, extra=self._extra
        )
        self.log.sent.append((np.full(len(rows), t), rows, self._seq[rows], told.goal, told.toward, told.rests))
