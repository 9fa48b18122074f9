"""Reception of the neighbours' poses, through the modelled channel, and liveliness of the neighbours."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from enum import Enum
from functools import partial
from math import inf
from typing import Final, NamedTuple

import numpy as np
import zenoh

from agents.agent import Agent, links_by_sender
from agents.arrays import Index, PoseTable
from agents.network import messages, pubsub, validation
from agents.network.channel_model import Channel, Conditions
from agents.network.keys import Keys

LATE_S: Final = 3.0  # longest delay of a pose in a network: Zenoh holds one back for 2 s behind a missing one
PROOFS: Final = 3  # late poses in succession that prove a slow clock: one may be the last value of a silent robot


class TokenChange(Enum):
    """Change of the liveliness of a robot."""

    APPEARED = 1
    VANISHED = 2
    NEW_SESSION = 3  # its process is another one than before


class ReceivedPose(NamedTuple):
    """A valid pose that is newer than those before it."""

    pose: messages.Pose
    size: int  # [bytes] of its payload
    missed: int  # lost poses before it
    # [s] UTC of the measurement, as far as its stamp can be true: not after its arrival, and, if the clock of the robot
    # is behind, not longer before it than a network delays poses
    measured: float
    anew: bool  # first pose of a new session of the robot: earlier knowledge is void


class NeighbourSubscription:
    """Subscription to one robot: drops duplicates, counts losses, tracks liveliness."""

    name: str  # of the robot
    links: Index  # (K,) links with this sender
    lost: int  # lost poses; counted by the caller, which knows from when on they matter
    stale: int  # poses that were dropped: older than a known one, or of a former session
    # [s] age of the last pose on arrival if the clock of the robot is behind: the last poses were older than the
    # longest delay of a network; else 0
    behind: float

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        name: str,
        links: Index,
        *,
        reach: messages.Vector,
        rate: float,
        depth: int = pubsub.POSES,
    ) -> None:
        """Subscribes to the robot `name`.

        Args:
            session: Of the process.
            keys: Of the realm.
            name: Of the robot.
            links: (K,) links with this sender.
            reach: Largest |x|, |y|, |z| of a valid pose [m].
            rate: Largest rate of its poses [1/s].
            depth: Poses that may wait.
        """
        self.name, self.links, self._reach, self._rate = name, links, reach, rate
        self._poses = pubsub.Inbox(pubsub.pose_subscriber(session, keys.pose(name), depth), messages.Pose, keys=keys)
        self._token = keys.alive(name)
        self._alive = pubsub.AliveWatch(session, keys.lives(self._token))
        self._seq, self._stamp = 0, 0.0
        self._life: str | None = None  # session of the robot's process, as far as it is known
        self._past: set[str] = set()
        self._owned = False  # the token of that session is there: no other one speaks for the robot
        self._gone = False
        self._heard_at = -inf  # when news came last (UTC [s])
        self._old, self._old_at = 0, 0.0  # how often in succession poses were old on arrival, and when last
        self.lost = self.stale = 0
        self.behind = 0.0

    @property
    def malformed(self) -> int:
        """Samples that were refused."""
        return self._poses.malformed

    def news(self, now: float) -> Iterator[ReceivedPose]:
        """Poses received until `now` (UTC [s]), oldest first, without invalid and known ones.

        A new session of the robot resets the order of poses, as does a clock that was set back in one session.
        """
        before = self._heard_at  # poses that waited while this process stood still count as one reception
        check = partial(validation.check_pose, now=now, reach=self._reach)
        for pose, sample in self._poses.read_samples(check):
            life = _session_of(sample)
            if life in self._past or (self._owned and life not in (None, self._life)):
                self.stale += 1
                continue
            anew = life is not None and self._live(life)
            if pose.stamp <= self._stamp and pose.seq > self._seq:  # its clock was set back
                self._seq, self._stamp, anew = 0, 0.0, True
            if pose.stamp <= self._stamp:  # equal: repeated after a reconnection
                self.stale += pose.stamp < self._stamp
                continue
            self._weigh(now, now - pose.stamp)
            since = pose.stamp - self._stamp
            missed = validation.missed(self._seq, pose.seq, since, self._rate) if self._seq else 0
            self._seq, self._stamp = pose.seq, pose.stamp
            # A clock that is behind: a predictor must not extrapolate over that time. A pose from before the last
            # reception, too late for a network, proves it at once; the first pose ever may be that of a silent robot.
            slow = self.behind or (pose.stamp < before and now - pose.stamp > LATE_S)
            measured = now - LATE_S if slow else validation.taken(pose.stamp, now)
            self._heard_at = now
            yield ReceivedPose(pose, len(sample.payload), missed, measured, anew)

    def comings(self) -> Iterator[TokenChange]:
        """Changes of the liveliness of the robot, oldest first."""
        for token, there in self._alive.changes():
            if token == self._token:
                if there and self._gone and self._life is None and self._stamp:  # no token names its session
                    self._seq, self._stamp = 0, 0.0
                    yield TokenChange.NEW_SESSION
                self._gone = not there
                yield TokenChange.APPEARED if there else TokenChange.VANISHED
            elif (life := Keys.life_of(token)) is not None and life not in self._past:
                if there and self._live(life):
                    yield TokenChange.NEW_SESSION
                self._owned = there if life == self._life else self._owned

    def _live(self, life: str) -> bool:
        """Stores the session of the robot's process; returns whether it follows another one."""
        if life == self._life:
            return False
        before, self._life = self._life, life
        if before is not None:
            self._past.add(before)
            self._seq, self._stamp = 0, 0.0
        return before is not None

    def _weigh(self, now: float, age: float) -> None:
        """Detects a clock that is behind, from the `age` [s] of poses on arrival."""
        if age <= LATE_S:
            self._old, self.behind = 0, 0.0
        elif now > self._old_at:  # poses that waited while this process stood still arrive at once, and count once
            self._old, self._old_at = self._old + 1, now
            self.behind = age if self._old >= PROOFS else 0.0


def _session_of(sample: zenoh.Sample) -> str | None:
    """Session that published a sample, if the sample names it."""
    source = sample.source_info
    return None if source is None else str(source.source_id.zid)


NEWS: Final = 20_000  # poses that wait for telemetry, which empties them several times a second: 10 MB


class PoseInbox:
    """Poses of all neighbours of the rows of a process, through the modelled channel; polled."""

    speakers: list[NeighbourSubscription]  # one for each sender
    news: list[deque[messages.Heard]]  # (n) newest received poses of each row, for telemetry, which empties them
    heard: list[int]  # (n) received poses of each row
    dropped: Index  # (E,) samples that the modelled channel dropped
    arrived: int  # poses of other processes before the modelled channel, each counted once
    changed: bool  # a neighbour appeared or vanished since the caller reset this

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        agent: Agent,
        *,
        reach: messages.Vector,
        conditions: Conditions | None = None,
    ) -> None:
        """Subscribes to the neighbours of the rows of `agent`.

        Args:
            session: Of the process.
            keys: Of the realm.
            agent: Gets received poses and the loss of neighbours.
            reach: Largest |x|, |y|, |z| of a valid pose [m].
            conditions: Effects of the modelled channel on each link; None: none.
        """
        assignment = agent.assignment
        self._agent = agent
        self._links = assignment.links
        names = [assignment.robots[speaker] for speaker in assignment.links.sender.tolist()]
        self._ends = list(zip(assignment.links.receiver.tolist(), names, strict=True))
        self._channel = Channel(conditions or Conditions.ideal(len(assignment.links)))
        by_speaker = links_by_sender(assignment.links, assignment.robots)
        rate = assignment.body_hz / assignment.pose_every
        self.speakers = [
            NeighbourSubscription(session, keys, name, links, reach=reach, rate=rate)
            for name, links in by_speaker.items()
        ]
        self.news = [deque[messages.Heard](maxlen=NEWS) for _ in assignment.names]
        self.heard = [0] * len(assignment.names)
        self.arrived = 0
        self.dropped = self._channel.dropped
        self.changed = False

    @property
    def malformed(self) -> int:
        """Samples that were refused."""
        return sum(speaker.malformed for speaker in self.speakers)

    def listen(self, t: float, utc: float) -> None:
        """Receives all until `t` [s] of a clock that was 0 at `utc` [s]."""
        for speaker in self.speakers:
            for coming in speaker.comings():
                self.changed = True
                if coming is TokenChange.APPEARED:
                    self._agent.neighbours.mark_alive(speaker.links)
                elif coming is TokenChange.NEW_SESSION:
                    self._begin(speaker)
                else:
                    self._channel.forget(speaker.links)
                    self._agent.neighbours.mark_lost(speaker.links, t)
        arrived: list[tuple[int, ReceivedPose]] = []
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
                self._agent.neighbours.mark_clock_lag(speaker.links, speaker.behind)
        if arrived:
            self._send(arrived, t, utc)
        if (got := self._channel.due(t)) is not None:
            self._believe(got, utc)

    def _begin(self, speaker: NeighbourSubscription) -> None:
        """Forgets a neighbour that has a new session."""
        self._channel.forget(speaker.links)
        self._agent.neighbours.discard_poses(speaker.links)

    def _send(self, arrived: list[tuple[int, ReceivedPose]], t: float, utc: float) -> None:
        """Puts poses, each with its link, into the modelled channel, all of a tick at once."""
        poses = [heard.pose for _, heard in arrived]
        measured = np.array([[heard.measured - utc] for _, heard in arrived])
        got = PoseTable(
            np.array([link for link, _ in arrived]),
            np.array([pose.seq for pose in poses]),
            np.array([pose.stamp - utc for pose in poses]),
            np.array([t] * len(arrived)),
            np.array([pose.position for pose in poses]),
            np.array([pose.velocity or messages.STILL for pose in poses]),
            extra=measured,
        )
        if self._channel.ideal:
            self._believe(got, utc)
            return
        start = self._agent.lifecycle.start_at[self._links.receiver[got.link]]
        sizes = np.array([heard.size for _, heard in arrived])
        for at in range(len(arrived)):  # the queue of a link counts one sample after the other
            one = slice(at, at + 1)
            self._channel.send(
                got.link[one], got.seq[one], got.stamp[one], got.position[one], got.velocity[one],
                start=start[one], size=sizes[one], now=t, extra=measured[one],
            )  # fmt: skip

    def _believe(self, got: PoseTable, utc: float) -> None:
        """Passes poses that got through to the agent and to telemetry."""
        assert got.extra is not None  # time of measurement; the recorded pose keeps its own stamp
        self._agent.neighbours.receive(got.link, got.position, got.velocity, got.extra[:, 0], got.arrival)
        columns = (got.link, got.seq, got.stamp, got.arrival, got.position, got.velocity)
        for link, seq, stamp, arrival, position, velocity in zip(*(c.tolist() for c in columns), strict=True):
            row, who = self._ends[link]
            self.news[row].append(
                messages.Heard(who, seq, utc + stamp, utc + arrival, tuple(position), tuple(velocity))
            )
            self.heard[row] += 1
