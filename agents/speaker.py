"""One robot that is listened to: which of its poses are news, how many got lost, and whether it is there."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import zenoh

from agents import plausibility, wire
from agents import session as network
from agents.keys import Keys
from agents.rows import Index


class Said(NamedTuple):
    """A pose that is news.

    Attributes:
        pose: Checked.
        size: Of its payload [bytes].
        missed: Poses before it that never came.
    """

    pose: wire.Pose
    size: int
    missed: int


class Speaker:
    """Listens to one robot.

    Attributes:
        name: Of the robot.
        links: (K,) on which it is heard.
        lost: Poses that never came; whoever listens counts them, because it knows since when they matter.
        malformed: Samples that were refused.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        name: str,
        links: Index,
        *,
        reach: wire.Vector,
        rate: float,
        depth: int = network.POSES,
    ) -> None:
        """Listens.

        Args:
            session: To the network.
            keys: Of the realm.
            name: Of the robot.
            links: (K,) on which it is heard.
            reach: Largest |x|, |y|, |z| that is believed [m].
            rate: Poses that it says in a second at most [1/s].
            depth: Newest poses that may wait.
        """
        self.name, self.links, self._reach, self._rate = name, links, reach, rate
        self._poses = network.pose_subscriber(session, keys.pose(name), depth)
        self._alive = network.alive_watch(session, keys.alive(name))
        self._seq, self._stamp = 0, 0.0
        self.lost = self.malformed = 0

    def news(self, now: float) -> Iterator[Said]:
        """What has come until `now` (UTC [s]), oldest first: what cannot be true is refused, what is known left out."""
        for sample in network.received(self._poses.handler):
            payload = sample.payload.to_bytes()
            try:
                pose = wire.decode(payload, str(sample.encoding), wire.Pose)
                plausibility.check_pose(pose, robot=self.name, now=now, reach=self._reach)
            except wire.Malformed:
                self.malformed += 1
                continue
            if pose.stamp <= self._stamp:
                continue  # known already: told again after a reconnection
            since = pose.stamp - self._stamp
            missed = plausibility.missed(self._seq, pose.seq, since, self._rate) if self._seq else 0
            self._seq, self._stamp = pose.seq, pose.stamp
            yield Said(pose, len(payload), missed)

    def comings(self) -> Iterator[bool]:
        """Whether it came (True) or went, each time that it did, oldest first."""
        for sample in network.received(self._alive.handler):
            yield sample.kind == zenoh.SampleKind.PUT
