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
from agents.speaker import Coming, Said, Speaker

NEWS: Final = 20_000  # newest poses that wait for telemetry, which takes them several times a second: 10 MB


class Neighbours:
    """Those whom the rows of a process listen to.

    Attributes:
        speakers: One for each name that is heard.
        news: (n) the newest poses that got through to each row, which telemetry empties.
        heard: (n) how many that were, ever.
        dropped: (E,) samples that the modelled network dropped.
        arrived: Poses of other processes that the network brought, ever, each once, before the modelled channel.
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
        self._links = assignment.links
        names = [assignment.speakers[speaker] for speaker in assignment.links.speaker.tolist()]
        self._ends = list(zip(assignment.links.listener.tolist(), names, strict=True))
        self._channel = Channel(conditions or Conditions.ideal(len(assignment.links)))
        by_speaker = links_by_speaker(assignment.links, assignment.speakers)
        rate = assignment.body_hz / assignment.pose_every
        self.speakers = [
            Speaker(session, keys, name, links, reach=reach, rate=rate) for name, links in by_speaker.items()
        ]
        self.news = [deque[wire.Heard](maxlen=NEWS) for _ in assignment.names]
        self.heard = [0] * len(assignment.names)
        self.arrived = 0
        self.dropped = self._channel.dropped
        self.changed = False

    @property
    def malformed(self) -> int:
        """Samples that were refused."""
        return sum(speaker.malformed for speaker in self.speakers)

    def listen(self, t: float, utc: float) -> None:
        """Takes in what has arrived at `t` [s] of the process's clock, which stood at 0 at `utc` [s]."""
        for speaker in self.speakers:
            for coming in speaker.comings():
                self.changed = True
                if coming is Coming.CAME:
                    self._agent.find(speaker.links)
                elif coming is Coming.ANEW:
                    self._begin(speaker)
                else:
                    self._channel.forget(speaker.links)
                    self._agent.lose(speaker.links, t)
        arrived: list[tuple[int, Said]] = []
        for speaker in self.speakers:
            behind = speaker.behind
            for said in speaker.news(utc + t):
                speaker.lost += said.missed
                self.arrived += speaker.name not in self._agent.assignment.names
                if said.anew:
                    self._begin(speaker)
                    arrived = [(link, before) for link, before in arrived if link not in speaker.links]
                arrived += [(link, said) for link in speaker.links.tolist()]
            if speaker.behind != behind:
                self._agent.hearing.distrust(speaker.links, speaker.behind)
        if arrived:
            self._send(arrived, t, utc)
        if (got := self._channel.due(t)) is not None:
            self._believe(got, utc)

    def _begin(self, speaker: Speaker) -> None:
        """A neighbour begins a new life."""
        self._channel.forget(speaker.links)
        self._agent.forget(speaker.links)

    def _send(self, arrived: list[tuple[int, Said]], t: float, utc: float) -> None:
        """Gives poses, each with the link on which it arrived, to the modelled network, all of a tick at once."""
        poses = [heard.pose for _, heard in arrived]
        measured = np.array([[heard.measured - utc] for _, heard in arrived])
        got = Samples(
            np.array([link for link, _ in arrived]),
            np.array([t] * len(arrived)),
            np.array([pose.stamp - utc for pose in poses]),
            np.array([pose.seq for pose in poses]),
            np.array([pose.position for pose in poses]),
            np.array([pose.velocity or wire.STILL for pose in poses]),
            measured,
        )
        if self._channel.ideal:
            self._believe(got, utc)
            return
        start = self._agent.life.start_at[self._links.listener[got.link]]
        sizes = np.array([heard.size for _, heard in arrived])
        for at in range(len(arrived)):  # the queue of a link counts one sample after the other
            one = slice(at, at + 1)
            self._channel.send(
                got.link[one], got.seq[one], got.stamp[one], got.position[one], got.velocity[one],
                start=start[one], size=sizes[one], now=t, extra=measured[one],
            )  # fmt: skip

    def _believe(self, got: Samples, utc: float) -> None:
        """Poses have got through."""
        assert got.extra is not None  # all bring along when they were measured; what is recorded keeps its own stamp
        self._agent.hear(got.link, got.position, got.velocity, got.extra[:, 0], got.arrival)
        columns = (got.link, got.seq, got.stamp, got.arrival, got.position, got.velocity)
        for link, seq, stamp, arrival, position, velocity in zip(*(c.tolist() for c in columns), strict=True):
            row, who = self._ends[link]
            self.news[row].append(wire.Heard(who, seq, utc + stamp, utc + arrival, tuple(position), tuple(velocity)))
            self.heard[row] += 1
