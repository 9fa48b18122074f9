"""The network of a virtual run: poses between robots, poses and goals of the central controller, and their log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from msgspec.structs import replace

from agents.agent import Agent
from agents.arrays import Array, Index, PoseTable, no_poses
from agents.body.interface import BodyState
from agents.decision.centralised import Centre
from agents.decision.transmission import Transmission
from agents.formation.graph import Links, links
from agents.network import channel_model, messages
from experiments.definition import link_conditions
from experiments.definition.experiment import Experiment
from experiments.definition.link_conditions import FROM_CENTRE, TO_CENTRE
from experiments.definition.plan import Plan
from experiments.recording.trace import EPOCH


class VirtualChannel(channel_model.Channel):
    """The modelled channel for the links of all repetitions, each with random numbers of its own."""

    def __init__(self, experiment: Experiment, links: Links, seeds: Sequence[int], *, stream: str = "") -> None:
        """`links` of all repetitions, those of the first seed first; each `stream` has random numbers of its own."""
        super().__init__(link_conditions.virtual_conditions(experiment, links, seeds, stream=stream))
        self._sender, self._rows = links.sender, len(experiment.robots) * len(seeds)
        self._names = tuple(experiment.robots)
        self._encoding: messages.Encoding = experiment.network.encoding

    def transmit(self, t: float, poses: PoseTable, start: float) -> None:
        """Transmits poses at `t` [s], whose `link` is the row of the sender.

        `start` is the common start [s]; NaN or infinity as long as it is not known: nothing is lost before.
        """
        place = np.full(self._rows, -1)
        place[poses.link] = np.arange(len(poses.link))
        which = place[self._sender]
        at = np.flatnonzero(which >= 0)
        if not len(at):
            return
        if self.limited:
            poses = replace(poses, bytes=self._sizes(EPOCH + (t - start if t >= start else 0.0), poses))
        self.send(replace(poses.take(which[at]), link=at), start=start)

    def _sizes(self, stamp: float, poses: PoseTable) -> Index:
        """(K,) bytes of the payloads of poses, as a real network carries them."""
        assert poses.yaw is not None
        columns = (poses.link, poses.seq, poses.position, poses.velocity, poses.yaw)
        found = []
        for row, seq, position, velocity, yaw in zip(*(column.tolist() for column in columns), strict=True):
            pose = messages.pose(self._names[row % len(self._names)], seq, stamp, position, velocity, yaw)
            found.append(len(messages.encode(pose, self._encoding)))
        return np.array(found, dtype=np.intp)


@dataclass(frozen=True)
class CentreLog:
    """Messages between robots and the central controller in all repetitions, in the time of the experiment [s].

    `link` is the row of the robot in each table.
    """

    sent: PoseTable  # goals; `extra` is the stamp of the pose on which each rests
    followed: PoseTable  # goals that robots acted on (`arrival`), with the same `extra`
    received: PoseTable  # poses, as the central controller received them
    lost_poses: Index  # (R,) of each robot, from the common start to the end of the experiment


class VirtualCentre:
    """The central controllers of all repetitions. Their poses and goals take as long and are lost as often as poses
    between robots.

    Phases and the common start are the conductor's, and known at once, as they are to the robots.
    """

    def __init__(self, experiment: Experiment, seeds: Sequence[int]) -> None:
        self.centre = Centre(Plan(experiment).assignment(copies=len(seeds), centrally=True))
        self.centre.mark_alive(self.centre.needed)  # all robots are there from the beginning
        self._sent: list[PoseTable] = []
        self._followed: list[PoseTable] = []
        self._received: list[PoseTable] = []
        rows = len(self.centre.guided)
        guided = np.flatnonzero(self.centre.guided)
        ends = [[(row, row) for row in group.tolist()] for group in (self.centre.needed, guided)]
        self._poses, self._goals = (
            VirtualChannel(experiment, links(pairs), seeds, stream=stream)
            for pairs, stream in zip(ends, (TO_CENTRE, FROM_CENTRE), strict=True)
        )
        self._poses_of, self._goals_of = (np.array([row for row, _ in pairs], dtype=np.intp) for pairs in ends)
        self._seq: Index = np.zeros(rows, dtype=np.intp)

    def transmit(self, t: float, poses: PoseTable, start: float) -> None:
        """Robots transmit their poses to the central controller; see `VirtualChannel.transmit`."""
        self._poses.transmit(t, poses, start)

    def deliver(self, t: float, agent: Agent) -> None:
        """Delivers at `t` [s]: poses to the central controller, goals to the robots."""
        if (arrived := self._poses.due(t)) is not None:
            rows = self._poses_of[arrived.link]
            self.centre.receive(replace(arrived, link=rows))
            self._received.append(_bare(rows, arrived.seq, arrived.stamp, arrived.arrival))
        if (arrived := self._goals.due(t)) is not None:
            # of several for one robot the newest counts
            arrived = arrived.take(np.argsort(arrived.stamp, kind="stable"))
            _, last = np.unique(arrived.link[::-1], return_index=True)
            arrived = arrived.take(len(arrived.link) - 1 - last)
            rows = self._goals_of[arrived.link]
            assert agent.guidance is not None
            assert arrived.yaw is not None
            news = agent.guidance.receive(rows, arrived.position, arrived.yaw, arrived.stamp)
            if news.any():
                accepted = _bare(rows, arrived.seq, arrived.stamp, np.full(len(rows), t), arrived.extra)
                self._followed.append(accepted.take(news))

    def decide(self, t: float, agent: Agent) -> None:
        """On a tick on which goals are decided: those of the robots that are guided."""
        goals = self.centre.decide(t, agent.lifecycle.phase, agent.lifecycle.start_at)
        rows = goals.rows
        if not len(rows):
            return
        self._seq[rows] += 1
        now, start = np.full(len(rows), t), float(agent.lifecycle.start_at.min())
        sent = PoseTable(
            rows, self._seq[rows], now, now, goals.goal, np.zeros((len(rows), 3)), goals.yaw,
            extra=goals.pose_stamp[:, None],
        )  # fmt: skip
        self._goals.transmit(t, sent, start)
        self._sent.append(replace(sent, velocity=np.zeros((len(rows), 0))))

    def logged(self, begin: float) -> CentreLog:
        """The log, with times since the common start at `begin` [s]."""
        lost = np.zeros(len(self._seq), dtype=np.intp)
        lost[self._poses_of] = self._poses.dropped
        return CentreLog(
            sent=_goals(self._sent, begin),
            followed=_goals(self._followed, begin),
            received=_joined(self._received, begin),
            lost_poses=lost,
        )


def _bare(link: Index, seq: Index, stamp: Array, arrival: Array, extra: Array | None = None) -> PoseTable:
    """Poses of which only numbers and times are kept."""
    nothing = np.zeros((len(link), 0))
    return PoseTable(link, seq, stamp, arrival, nothing, nothing, extra=extra)


def _joined(tables: list[PoseTable], begin: float) -> PoseTable:
    """A single table, with times since the common start at `begin` [s]."""
    return (PoseTable.joined(tables) if tables else no_poses()).since(begin)


def _goals(tables: list[PoseTable], begin: float) -> PoseTable:
    found = _joined(tables, begin)
    return replace(found, extra=np.zeros((0, 1)) if found.extra is None else found.extra - begin)


class VirtualNetwork:
    """Carries poses between robots, and poses and goals between them and their centre, if they have one."""

    def __init__(self, experiment: Experiment, agent: Agent, seeds: Sequence[int], *, lean: bool) -> None:
        """Network of all repetitions; `lean` as for `experiments.virtual_time.simulation.simulate`."""
        assignment, rows = agent.assignment, len(agent.assignment.names)
        self._agent, self._lean = agent, lean
        self._channel = VirtualChannel(experiment, assignment.links, seeds)
        self._centre = None if assignment.guided is None else VirtualCentre(experiment, seeds)
        self._seq: Index = np.zeros(rows, dtype=np.intp)
        agent.neighbours.mark_alive(np.arange(len(assignment.links)))  # all robots are there from the beginning
        self._sent: list[PoseTable] = []
        self._received: list[PoseTable] = []

    def carry(self, t: float, state: BodyState) -> Transmission:
        """The first half of the tick at `t` [s]: robots receive, then transmit.

        Without any delay, poses are received before the second half; and so are the goals that follow.
        """
        agent, centre, instant = self._agent, self._centre, self._channel.instant
        self._deliver(t)
        transmission = agent.transmit(t, state)
        if len(transmission.rows):
            self._transmit(t, transmission, state.yaw)
            if instant:
                self._deliver(t)
        if centre is not None and agent.decision_due:
            centre.decide(t, agent)
            if instant:
                centre.deliver(t, agent)
        return transmission

    def _transmit(self, t: float, transmission: Transmission, yaw: Array) -> None:
        """Transmits poses. Before the common start nothing is lost."""
        rows, start = transmission.rows, float(self._agent.lifecycle.start_at.min())
        self._seq[rows] += 1
        now = np.full(len(rows), t)
        position, velocity = transmission.position[rows], transmission.velocity[rows]
        poses = PoseTable(rows, self._seq[rows], now, now, position, velocity, yaw[rows])
        self._sent.append(_bare(rows, poses.seq, now, now) if self._lean else poses)
        self._channel.transmit(t, poses, start)
        if self._centre is not None:
            self._centre.transmit(t, poses, start)

    def _deliver(self, t: float) -> None:
        """Delivers poses and goals that have arrived."""
        if (received := self._channel.due(t)) is not None:
            self._agent.neighbours.receive(received)
            if not self._lean:
                self._received.append(replace(received, yaw=None, bytes=None))
        if self._centre is not None:
            self._centre.deliver(t, self._agent)

    def logged(self, begin: float) -> dict[str, Any]:
        """Columns of the log, see `experiments.virtual_time.simulation.Log`; the common start is at `begin` [s]."""
        return {
            "sent": _joined(self._sent, begin),
            "received": _joined(self._received, begin),
            "lost": self._channel.dropped,
            "centre": None if self._centre is None else self._centre.logged(begin),
        }
