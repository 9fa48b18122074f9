"""One robot that is listened to: which of its poses are news, how many got lost, and whether it is there."""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum
from math import inf
from typing import Final, NamedTuple

import zenoh

from agents import plausibility, wire
from agents import session as network
from agents.keys import Keys
from agents.rows import Index

LATE_S: Final = 3.0  # a network delays no pose longer: Zenoh holds one back for 2 s where another is missing
PROOFS: Final = 3  # so many late poses in succession: one may be the last value of a robot that is silent


class Coming(Enum):
    """A change of the liveliness of a robot."""

    CAME = 1
    WENT = 2
    ANEW = 3  # its process is another one than before


class Said(NamedTuple):
    """A pose that is news.

    Attributes:
        pose: Checked.
        size: Of its payload [bytes].
        missed: Poses before it that never came.
        measured: When the pose was measured (UTC [s]), as far as its stamp can be true: not after its arrival; of a
            clock that is behind, not earlier before it than a network delays poses.
        anew: Whether it is the first of a new life: what was known of the robot is of the past.
    """

    pose: wire.Pose
    size: int
    missed: int
    measured: float
    anew: bool


class Speaker:
    """Listens to one robot.

    Attributes:
        name: Of the robot.
        links: (K,) on which it is heard.
        lost: Poses that never came; whoever listens counts them, because it knows since when they matter.
        stale: Poses that were left out because a newer one was known, or because they are of a life that is over.
        malformed: Samples that were refused.
        behind: Age [s] of the last pose on arrival if the clock of the robot is behind: the last poses were older than
            a network delays them. 0 if not.
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
        self._token = keys.alive(name)
        self._alive = network.alive_watch(session, keys.lives(self._token))
        self._seq, self._stamp = 0, 0.0
        self._life: str | None = None  # session of the robot's process, as far as it is known
        self._past: set[str] = set()
        self._owned = False  # the token of that session is there: no other one speaks for the robot
        self._gone = False
        self._heard_at = -inf  # when news came last (UTC [s])
        self._old, self._old_at = 0, 0.0  # how often in succession poses were old on arrival, and when last
        self.lost = self.stale = self.malformed = 0
        self.behind = 0.0

    def news(self, now: float) -> Iterator[Said]:
        """Poses that have come until `now` (UTC [s]), oldest first: what cannot be true is refused, what is known left
        out.

        A new session of the robot, or a clock that was set back in one session, begins anew.
        """
        before = self._heard_at  # what waited with others while this process stood still was not heard then
        for sample in network.received(self._poses.handler):
            payload = sample.payload.to_bytes()
            try:
                pose = wire.decode(payload, str(sample.encoding), wire.Pose)
                plausibility.check_pose(pose, robot=self.name, now=now, reach=self._reach)
            except wire.Malformed:
                self.malformed += 1
                continue
            life = _session_of(sample)
            if life in self._past or (self._owned and life not in (None, self._life)):
                self.stale += 1
                continue
            anew = life is not None and self._live(life)
            if pose.stamp <= self._stamp and pose.seq > self._seq:  # its clock was set back
                self._seq, self._stamp, anew = 0, 0.0, True
            if pose.stamp <= self._stamp:  # equal: told again after a reconnection
                self.stale += pose.stamp < self._stamp
                continue
            self._weigh(now, now - pose.stamp)
            since = pose.stamp - self._stamp
            missed = plausibility.missed(self._seq, pose.seq, since, self._rate) if self._seq else 0
            self._seq, self._stamp = pose.seq, pose.stamp
            # A clock that is behind: a predictor must not carry the pose on over that time. News from before the last
            # news came, too late for a network, tell it at once; the first pose ever may be one of a silent robot.
            slow = self.behind or (pose.stamp < before and now - pose.stamp > LATE_S)
            measured = now - LATE_S if slow else plausibility.taken(pose.stamp, now)
            self._heard_at = now
            yield Said(pose, len(payload), missed, measured, anew)

    def comings(self) -> Iterator[Coming]:
        """Changes of its liveliness, oldest first."""
        for sample in network.received(self._alive.handler):
            token, there = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
            if token == self._token:
                if there and self._gone and self._life is None and self._stamp:  # no token tells which life it is
                    self._seq, self._stamp = 0, 0.0
                    yield Coming.ANEW
                self._gone = not there
                yield Coming.CAME if there else Coming.WENT
            elif (life := Keys.life_of(token)) is not None and life not in self._past:
                if there and self._live(life):
                    yield Coming.ANEW
                self._owned = there if life == self._life else self._owned

    def _live(self, life: str) -> bool:
        """Takes in the session of the robot's process; whether that is a new life, after another one."""
        if life == self._life:
            return False
        before, self._life = self._life, life
        if before is not None:
            self._past.add(before)
            self._seq, self._stamp = 0, 0.0
        return before is not None

    def _weigh(self, now: float, age: float) -> None:
        """Counts how often, at different times, a pose was `age` [s] old when it arrived."""
        if age <= LATE_S:
            self._old, self.behind = 0, 0.0
        elif now > self._old_at:  # what waited while this process stood still came at once, and counts once
            self._old, self._old_at = self._old + 1, now
            self.behind = age if self._old >= PROOFS else 0.0


def _session_of(sample: zenoh.Sample) -> str | None:
    """Session that published a sample, if its publisher says so."""
    source = sample.source_info
    return None if source is None else str(source.source_id.zid)
