"""Reception of goals by guided robots, and liveliness of the central controller."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from functools import partial
from math import nan

import numpy as np
import zenoh

from agents.agent import Agent
from agents.arrays import PoseTable
from agents.decision.centralised import Guidance
from agents.network import messages, pubsub, validation
from agents.network import session as network
from agents.network.channel_model import Channel, Conditions
from agents.network.keys import Keys
from agents.runtime.pose_inbox import NEWS


class GoalInbox:
    """Goals for the guided rows of one process, through the modelled channel; polled."""

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        agent: Agent,
        guidance: Guidance,
        *,
        reach: messages.Vector,
        conditions: Conditions | None = None,
    ) -> None:
        """Subscribes for the guided rows of `agent`; goals beyond `reach` [m] are refused.

        `conditions` are the effects of the modelled channel on the goals of each guided row; None: none.
        """
        self._session, self._agent, self._guidance, self._reach = session, agent, guidance, reach
        self._names: Sequence[str] = agent.assignment.names
        rows = np.flatnonzero(guidance.guided).tolist()
        self._inboxes = [
            pubsub.Inbox(pubsub.subscriber(session, keys.goal(self._names[row]), 8), messages.Goal, keys=keys)
            for row in rows
        ]
        self._watch = pubsub.AliveWatch(session, keys.lives(keys.centre_alive))
        self._centre, self._life = keys.centre_alive, ""
        self._seq = dict.fromkeys(rows, 0)
        self._rows = np.array(rows, dtype=np.intp)
        self._channel = Channel(conditions or Conditions.ideal(len(rows)))
        # by row, for telemetry, which empties them
        self.news = [deque[messages.GoalReceipt](maxlen=NEWS) for _ in self._names]

    @property
    def malformed(self) -> int:
        return sum(inbox.malformed for inbox in self._inboxes)

    def receive(self, t: float, utc: float) -> None:
        """Receives all until `t` [s] of a clock that was 0 at `utc`."""
        for token, there in self._watch.changes():
            if token != self._centre:
                self._begin(Keys.life_of(token), there=there)
            elif there:
                self._guidance.mark_alive()
            elif network.connected(self._session):  # without a router every token vanishes, which proves nothing
                self._guidance.mark_lost(t)
        for link, (row, inbox) in enumerate(zip(self._rows.tolist(), self._inboxes, strict=True)):
            for goal, sample in inbox.read_samples(partial(self._check, row, utc + t)):
                self._receive(link, goal, len(sample.payload), t, utc)
        if (got := self._channel.due(t)) is None:
            return
        assert got.yaw is not None
        assert got.extra is not None
        for at, (sent, pose) in enumerate(got.extra.tolist()):
            row, one = self._rows[got.link[at : at + 1]], slice(at, at + 1)
            if self._guidance.receive(row, got.position[one], got.yaw[one], got.stamp[one]).any():
                receipt = messages.GoalReceipt(int(got.seq[at]), utc + sent, utc + pose, utc + t)
                self.news[int(row[0])].append(receipt)

    def _begin(self, life: str | None, *, there: bool) -> None:
        """Resets the numbers for a new central controller: its clock may be behind that of the former one."""
        if life is None or not there or life == self._life:
            return
        if self._life:
            self._seq = dict.fromkeys(self._seq, 0)
            self._guidance.stamp[self._rows] = -np.inf
        self._life = life

    def _check(self, row: int, now: float, goal: messages.Goal) -> None:
        oldest_s = self._agent.assignment.limits.link_silence_s
        validation.check_goal(goal, now=now, reach=self._reach, oldest_s=oldest_s)
        if goal.seq <= self._seq[row]:
            raise messages.Malformed(f"goal {goal.seq} after {self._seq[row]}")

    def _receive(self, link: int, goal: messages.Goal, size: int, t: float, utc: float) -> None:
        """Puts a goal of `size` [bytes] into the modelled channel."""
        row = int(self._rows[link])
        self._seq[row] = goal.seq
        stamp, sent = validation.taken(goal.stamp - utc, t), goal.stamp - utc
        table = PoseTable(
            np.array([link]), np.array([goal.seq]), np.array([stamp]), np.array([t]), np.array([goal.position]),
            np.zeros((1, 3)), np.array([nan if goal.yaw is None else goal.yaw]), np.array([size]),
            np.array([[sent, goal.pose - utc]]),
        )  # fmt: skip
        self._channel.send(table, start=self._agent.lifecycle.start_at[[row]], now=t)
