"""The centre of a run in virtual time: what it hears, its goals on their way to the robots, and a log of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from agents.agent import Agent
from agents.centre import Centre
from agents.graph import links
from agents.rows import Array, Index
from experiments import assign
from experiments.channel import Channel
from experiments.conditions import FROM_CENTRE, TO_CENTRE
from experiments.experiment import Experiment


@dataclass(frozen=True)
class Steered:
    """What went between robots and centre in all repetitions, in the time of the experiment [s].

    Attributes:
        sent: Goals: time, row, number, goal (K, 3), yaw, time of the pose on which it rests.
        followed: Goals that reached their robots: time, row, number, time sent, time of the pose.
        heard: Poses that the centre heard: time, row.
        lost_poses: (R,) of each row, that did not reach the centre, from the common start to the end of the experiment.
        lost_goals: (R,) goals that did not reach their rows.
    """

    sent: tuple[Array, Index, Index, Array, Array, Array]
    followed: tuple[Array, Index, Index, Array, Array]
    heard: tuple[Array, Index]
    lost_poses: Index
    lost_goals: Index


class Steering:
    """A centre for all repetitions of an experiment. It has one process's share of the network: what robots say to it,
    and what it says to them, takes as long and is lost as often as what robots say to each other.

    Phases and the common start are the conductor's, and known to everybody at once, as they are to the robots.

    Attributes:
        centre: The decision.
    """

    def __init__(self, experiment: Experiment, seeds: Sequence[int]) -> None:
        self.centre = Centre(assign.assign_centre(experiment, len(seeds)))
        self.centre.find(self.centre.listens)  # all robots are there from the beginning
        self._sent: list[tuple[Any, ...]] = []
        self._followed: list[tuple[Any, ...]] = []
        self._heard: list[tuple[Any, ...]] = []
        rows = len(self.centre.guided)
        told = np.flatnonzero(self.centre.guided)
        ends = [[(row, row) for row in group.tolist()] for group in (self.centre.listens, told)]
        self._poses, self._goals = (
            Channel(experiment, links(pairs), seeds, stream=stream)
            for pairs, stream in zip(ends, (TO_CENTRE, FROM_CENTRE), strict=True)
        )
        self._poses_of, self._goals_of = (np.array([row for row, _ in pairs], dtype=np.intp) for pairs in ends)
        self._seq: Index = np.zeros(rows, dtype=np.intp)
        self._goal, self._still = np.full((rows, 3), np.nan), np.zeros((rows, 3))
        self._extra = np.full((rows, 2), np.nan)

    def _counted(self, channel: Channel, rows: Index) -> Index:
        counts = np.zeros(len(self._seq), dtype=np.intp)
        counts[rows] = channel.lost
        return counts

    def say(  # noqa: PLR0917 - as `Channel.send`
        self, t: float, rows: Index, seq: Index, position: Array, velocity: Array, yaw: Array, *, start: float
    ) -> None:
        """Robots say where they are, to whoever listens; see `Channel.send`."""
        self._poses.send(t, rows, seq, position, velocity, yaw=yaw, start=start, extra=yaw[:, None])

    def deliver(self, t: float, agent: Agent) -> None:
        """Hands out at `t` [s] what has arrived: poses to the centre, goals to the robots."""
        arrived = self._poses.due(t)
        if arrived is not None and arrived.extra is not None:
            rows = self._poses_of[arrived.link]
            self.centre.hear(
                rows, arrived.position, arrived.velocity, arrived.extra[:, 0], arrived.stamp, arrived.arrival
            )
            self._heard.append((arrived.arrival, rows))
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
                self._followed.append((now, rows[news], arrived.seq[news], arrived.stamp[news], rests[news]))

    def decide(self, t: float, agent: Agent) -> None:
        """On a tick on which goals are decided: those of the robots that are guided."""
        told = self.centre.decide(t, agent.life.phase, agent.life.start_at)
        rows = told.rows
        if not len(rows):
            return
        self._seq[rows] += 1
        self._goal[rows], self._extra[rows, 0], self._extra[rows, 1] = told.goal, told.toward, told.rests
        start, yaw = float(agent.life.start_at.min()), self._extra[:, 0]
        self._goals.send(t, rows, self._seq, self._goal, self._still, yaw=yaw, start=start, extra=self._extra)
        self._sent.append((np.full(len(rows), t), rows, self._seq[rows], told.goal, told.toward, told.rests))

    def logged(self, begin: float) -> Steered:
        """All of it, when the common start was at `begin` [s]."""
        time, row, seq, goal, toward, rests = joined(self._sent, (0,), (0,), (0,), (0, 3), (0,), (0,))
        at, who, number, stamp, pose = joined(self._followed, (0,), (0,), (0,), (0,), (0,))
        heard, speaker = joined(self._heard, (0,), (0,))
        return Steered(
            sent=(time - begin, row.astype(np.intp), seq.astype(np.intp), goal, toward, rests - begin),
            followed=(at - begin, who.astype(np.intp), number.astype(np.intp), stamp - begin, pose - begin),
            heard=(heard - begin, speaker.astype(np.intp)),
            lost_poses=self._counted(self._poses, self._poses_of),
            lost_goals=self._counted(self._goals, self._goals_of),
        )


def joined(columns: list[tuple[Any, ...]], *empty: tuple[int, ...]) -> tuple[Any, ...]:
    """Concatenated; `empty` gives the shapes of columns when nothing was added."""
    if not columns:
        return tuple(np.zeros(shape) for shape in empty)
    return tuple(np.concatenate(column) for column in zip(*columns, strict=True))
