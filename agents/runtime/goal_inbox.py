"""Reception of goals by guided robots, and liveliness of the central controller."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from functools import partial
from math import nan

import zenoh

from agents.network import messages, pubsub, validation
from agents.network import session as network
from agents.network.channel_model import Channel, Conditions
from agents.network.keys import Keys
from agents.robot import Robot
from agents.runtime.pose_inbox import MAX_UNREPORTED


class GoalInbox:
    """Goals for the guided robots of one process, through the modelled channel; polled."""

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        robots: Sequence[Robot],
        *,
        valid_box: messages.Vector,
        conditions: Sequence[Conditions] = (),
    ) -> None:
        """Subscribes for the guided ones of `robots`; goals beyond `valid_box` [m] are refused.

        `conditions` are the effects of the modelled channel on the goals of each robot; empty: none.
        """
        self._session, self._robots, self._valid_box = session, robots, valid_box
        self._guidance = {row: robot.guidance for row, robot in enumerate(robots) if robot.guidance is not None}
        own = {row: keys.goal(robots[row].assignment.name) for row in self._guidance}
        self._inboxes = {
            row: pubsub.Inbox(pubsub.subscriber(session, key, 8), messages.Goal, keys=keys) for row, key in own.items()
        }
        self._watch = pubsub.AliveWatch(session, keys.lives(keys.centre_alive))
        self._centre, self._life = keys.centre_alive, ""
        self._seq = dict.fromkeys(self._guidance, 0)
        self._channel = Channel(conditions or [Conditions()] * len(robots))
        # by row, for telemetry, which empties them
        self.unreported = [deque[messages.GoalReceipt](maxlen=MAX_UNREPORTED) for _ in robots]

    @property
    def malformed(self) -> int:
        return sum(inbox.malformed for inbox in self._inboxes.values())

    def receive(self, t: float, utc: float) -> None:
        """Receives all until `t` [s] of a clock that was 0 at `utc`."""
        for token, stands in self._watch.changes():
            if token != self._centre:
                self._begin(Keys.life_of(token), stands=stands)
            elif stands or network.connected(self._session):  # tokens vanish without a router, too: proves nothing
                for guidance in self._guidance.values():
                    guidance.mark_alive() if stands else guidance.mark_lost(t)
        for row, inbox in self._inboxes.items():
            for goal, sample in inbox.read_samples(partial(self._check, row, utc + t)):
                self._seq[row] = goal.seq
                stamp, start = validation.taken(goal.stamp - utc, t), self._robots[row].lifecycle.start_at
                size = len(sample.payload)
                self._channel.send(row, (goal, stamp), goal.seq, stamp, start=start, size=size, now=t)
        for row, _, (goal, stamp) in self._channel.due(t):
            yaw = nan if goal.yaw is None else goal.yaw
            x, y, z = (*(goal.velocity or (nan, nan)), nan)[:3]
            if self._guidance[row].receive(goal.position, yaw, stamp, (x, y, z)):
                self.unreported[row].append(messages.GoalReceipt(goal.seq, goal.stamp, goal.pose, utc + t))

    def _begin(self, life: str | None, *, stands: bool) -> None:
        """Resets the numbers for a new central controller: its clock may be behind that of the former one."""
        if life is None or not stands or life == self._life:
            return
        if self._life:
            self._seq = dict.fromkeys(self._seq, 0)
            for guidance in self._guidance.values():
                guidance.begin_anew()
        self._life = life

    def _check(self, row: int, now: float, goal: messages.Goal) -> None:
        oldest_s = self._robots[row].assignment.limits.neighbour_timeout_s
        validation.check_goal(goal, now=now, valid_box=self._valid_box, oldest_s=oldest_s)
        if goal.seq <= self._seq[row]:
            raise messages.Malformed(f"goal {goal.seq} after {self._seq[row]}")
