"""What comes from the neighbours of a process's rows: their poses, through the modelled network, and who is there."""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np
import zenoh

from agents import wire
from agents.agent import Agent, links_by_speaker
from agents.channel import Channel, Conditions, Samples
from agents.keys import Keys
from agents.rows import Index
from agents.speaker import Said, Speaker

NEWS: Final = 20_000  # newest poses that wait for telemetry, which takes them several times a second: 10 MB


class Neighbours:
    """Those whom the rows of a process listen to.

    Attributes:
        speakers: One for each name that is heard.
        news: (n) the newest poses that got through to each row, which telemetry empties.
        heard: (n) how many that were, ever.
        dropped: (E,) samples that the modelled network dropped.
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
        self._agent = agent
        self._links, self._names = assignment.links, assignment.speakers
        self._channel = Channel(conditions or Conditions.ideal(len(assignment.links)))
        by_speaker = links_by_speaker(assignment.links, assignment.speakers)
        rate = assignment.body_hz / assignment.pose_every
        self.speakers = [
            Speaker(session, keys, name, links, reach=reach, rate=rate) for name, links in by_speaker.items()
        ]
        self.news = [deque[wire.Heard](maxlen=NEWS) for _ in assignment.names]
        self.heard: Index = np.zeros(len(assignment.names), dtype=np.intp)
        self.dropped = self._channel.dropped
        self.changed = False

    @property
    def malformed(self) -> int:
        """Samples that were refused."""
        return sum(speaker.malformed for speaker in self.speakers)

    def listen(self, t: float, utc: float) -> None:
        """Takes in what has arrived at `t` [s] of the process's clock, which stood at 0 at `utc` [s]."""
        for speaker in self.speakers:
            for said in speaker.news(utc + t):
                speaker.lost += said.missed
                self._send(speaker.links, said, t, utc)
            for came in speaker.comings():
                self.changed = True
                if came:
                    self._agent.find(speaker.links)
                else:
                    self._channel.forget(speaker.links)
                    self._agent.lose(speaker.links, t)
        if (got := self._channel.due(t)) is not None:
            self._believe(got, utc)

    def _send(self, links: Index, heard: Said, t: float, utc: float) -> None:
        """One pose has come: it is given to the modelled network."""
        pose, count = heard.pose, len(links)
        said = Samples(
            links,
            np.full(count, t),
            np.full(count, pose.stamp - utc),
            np.full(count, pose.seq),
            np.array([pose.position] * count),
            np.array([pose.velocity or wire.STILL] * count),
        )
        if self._channel.ideal:
            self._believe(said, utc)
            return
        start = self._agent.life.start_at[self._links.listener[links]]
        size = np.full(count, heard.size)
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
