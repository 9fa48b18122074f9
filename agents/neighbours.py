"""What comes from the neighbours of a process's rows: their poses, through the modelled network, and who is there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import zenoh

from agents import plausibility, wire
from agents import session as network
from agents.agent import Agent, links_by_speaker
from agents.channel import Channel, Conditions, Samples
from agents.keys import Keys
from agents.rows import Index


@dataclass
class Neighbour:
    """What comes from one speaker: its pose channel, its liveliness, and the count of its samples."""

    name: str
    links: Index
    poses: network.Polled[zenoh.Sample]
    alive: network.Polled[zenoh.Sample]
    seq: int = 0
    stamp: float = 0.0
    lost: int = 0


class Neighbours:
    """Those whom the rows of a process listen to.

    Attributes:
        speakers: One for each name that is heard.
        news: (n) poses that got through to each row, which telemetry empties.
        heard: (n) how many that were, ever.
        dropped: (E,) samples that the modelled network dropped.
        malformed: Samples that were refused.
        changed: Somebody came or went since whoever looks last said so.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        agent: Agent,
        *,
        reach: wire.Vector,
        conditions: Conditions | None = None,
    ) -> None:
        """Listens.

        Args:
            session: To the network.
            keys: Of the realm.
            agent: Hears what gets through, and who is gone.
            reach: Largest |x|, |y|, |z| that is believed [m].
            conditions: What is done to poses on each link; None: nothing.
        """
        assignment = agent.assignment
        self._agent, self._reach = agent, reach
        self._links, self._names = assignment.links, assignment.speakers
        self._channel = Channel(conditions or Conditions.ideal(len(assignment.links)))
        by_speaker = links_by_speaker(assignment.links, assignment.speakers)
        self._subscribers = [network.pose_subscriber(session, keys.pose(name)) for name in by_speaker]
        self._watches = [network.alive_watch(session, keys.alive(name)) for name in by_speaker]
        self.speakers = [
            Neighbour(name, links, poses.handler, watch.handler)
            for (name, links), poses, watch in zip(by_speaker.items(), self._subscribers, self._watches, strict=True)
        ]
        self.news: list[list[wire.Heard]] = [[] for _ in assignment.names]
        self.heard: Index = np.zeros(len(assignment.names), dtype=np.intp)
        self.dropped = self._channel.dropped
        self.malformed = 0
        self.changed = False

    def listen(self, t: float, utc: float) -> None:
        """Takes in what has arrived at `t` [s] of the process's clock, which stood at 0 at `utc` [s]."""
        for neighbour in self.speakers:
            for sample in network.received(neighbour.poses):
                self._hear(neighbour, sample, t, utc)
            for sample in network.received(neighbour.alive):
                self.changed = True
                if sample.kind == zenoh.SampleKind.DELETE:
                    self._channel.forget(neighbour.links)
                    self._agent.lose(neighbour.links, t)
                else:
                    self._agent.find(neighbour.links)
        if (got := self._channel.due(t)) is not None:
            self._believe(got, utc)

    def _hear(self, neighbour: Neighbour, sample: zenoh.Sample, t: float, utc: float) -> None:
        """One pose has come: checked, counted, and given to the modelled network."""
        payload = sample.payload.to_bytes()
        try:
            pose = wire.decode(payload, str(sample.encoding), wire.Pose)
            plausibility.check_pose(pose, robot=neighbour.name, now=utc + t, reach=self._reach)
        except wire.Malformed:
            self.malformed += 1
            return
        if pose.stamp <= neighbour.stamp:
            return  # known already: told again after a reconnection
        if 0 < neighbour.seq < pose.seq:
            neighbour.lost += pose.seq - neighbour.seq - 1
        neighbour.seq, neighbour.stamp = pose.seq, pose.stamp
        links, count = neighbour.links, len(neighbour.links)
        said = Samples(
            links,
            np.full(count, t),
            np.full(count, pose.stamp - utc),
            np.full(count, pose.seq),
            np.array([pose.position] * count),
            np.array([pose.velocity] * count),
        )
        if self._channel.ideal:
            self._believe(said, utc)
            return
        start = self._agent.life.start_at[self._links.listener[links]]
        size = np.full(count, len(payload))
        self._channel.send(links, said.seq, said.stamp, said.position, said.velocity, start=start, size=size, now=t)

    def _believe(self, got: Samples, utc: float) -> None:
        """Poses have got through."""
        self._agent.hear(got.link, got.position, got.velocity, got.stamp, got.arrival)
        columns = (self._links.listener[got.link], self._links.speaker[got.link], got.seq, got.stamp, got.arrival)
        pose = (got.position.tolist(), got.velocity.tolist())
        for row, who, seq, stamp, arrival, position, velocity in zip(
            *(c.tolist() for c in columns), *pose, strict=True
        ):
            news = wire.Heard(self._names[who], seq, utc + stamp, utc + arrival, tuple(position), tuple(velocity))
            self.news[row].append(news)
            self.heard[row] += 1
