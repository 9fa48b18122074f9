"""Invariants that hold whatever fails: robots inside the arena, apart and in formation; and their observer."""

from __future__ import annotations

import time
from collections.abc import Collection
from typing import Any, Final

import numpy as np
import zenoh

from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.messages import Command
from experiments.definition.formation import errors_over_time
from experiments.definition.plan import Plan
from twins.arrays import Array, norm

TOUCH_M: Final = 1e-3  # [m] less overlap than this is rounding and the age of poses
OUT_M: Final = 0.01  # [m] so far outside a place is outside
BELOW_M: Final = 0.05
DOWN_M: Final = 0.08  # [m] a robot that flies and is lower is on the floor
SLACK: Final = 1.05  # of limits that a setpoint may not exceed
STEP_M: Final = 0.6  # [m] outside the arena no goal may be


class Invariants:
    """Robots as solids, and the links that the formation asks for."""

    def __init__(self, plan: Plan) -> None:
        """No position is known yet."""
        self.names, kinds = plan.names, plan.kinds
        self._row = {name: number for number, name in enumerate(self.names)}
        self._kinds = kinds
        self._radius, self._height = (
            np.array([getattr(kind, what) for kind in kinds]) for what in ("radius", "height")
        )
        x, y, z = plan.experiment.arena.size
        self._low = np.array([-0.5 * x - OUT_M, -0.5 * y - OUT_M, -BELOW_M])
        self._high = np.array([0.5 * x + OUT_M, 0.5 * y + OUT_M, z + OUT_M])
        self.position: Array = np.full((len(kinds), 3), np.nan)
        self._law, self._formation = plan.law, plan.formation
        self._lasting = np.array([link.reach == np.inf for link in plan.one_way_links], dtype=bool)
        self.nearest = np.inf  # [m] between surfaces of any two robots, so far
        self._wrong: set[str] = set()

    def place(self, name: str, position: tuple[float, float, float]) -> None:
        """Set the true position of a robot [m]."""
        self.position[self._row[name]] = position

    def where(self, name: str) -> Array:
        """(3,) its last true position [m]; NaN if unknown."""
        return np.asarray(self.position[self._row[name]]).copy()

    def in_the_air(self, name: str) -> bool:
        row = self._row[name]
        return bool(self._kinds[row].flies and self.position[row, 2] > DOWN_M)

    def violations(self) -> list[str]:
        """Violations that have begun since the last call."""
        p = self.position
        outside = ((p < self._low) | (p > self._high)).any(axis=1)
        wrong = {f"{self.names[row]} is outside the arena" for row in np.flatnonzero(outside)}
        wrong |= {f"{self.names[i]} and {self.names[j]} overlap" for i, j in self._overlaps(p)}
        new, self._wrong = sorted(wrong - self._wrong), wrong
        return new

    def _overlaps(self, p: Array) -> list[tuple[int, int]]:
        """Pairs of robots that overlap at positions (N, 3); keeps the least distance of any two."""
        first, second = np.triu_indices(len(p), 1)
        level = norm(p[first, :2] - p[second, :2]) - (self._radius[first] + self._radius[second])
        bottom, top = p[:, 2], p[:, 2] + self._height
        upright = np.maximum(bottom[first] - top[second], bottom[second] - top[first])
        gap = np.hypot(np.maximum(level, 0.0), np.maximum(upright, 0.0))
        self.nearest = min(self.nearest, float(np.nan_to_num(gap, nan=np.inf).min(initial=np.inf)))
        both = (level < -TOUCH_M) & (upright < -TOUCH_M)
        return list(zip(first[both].tolist(), second[both].tolist(), strict=True))

    def formation_error(self, live: Collection[str], t: float) -> float:
        """The largest error [m] of links between robots that live, `t` [s] after the common start, by their law."""
        here = np.array([name in live for name in self.names])
        links = self._formation.links
        counted = here[links.receiver] & here[links.sender] & self._lasting  # links by range may end at any time
        position = self.position[np.union1d(links.receiver[counted], links.sender[counted])]
        if not np.isfinite(position).all():
            return np.inf
        error = errors_over_time(self._law, self._formation, np.array([t]), self.position[None])[0]
        return float(np.where(counted & np.isfinite(error), error, 0.0).max(initial=0.0))

    def invalid_command(self, command: Command) -> str:
        """The fault of a command to a body; empty if it has none."""
        if command.action != "drive":
            return ""
        setpoint = np.array(command.setpoint or (np.nan,) * 4)
        kind = self._kinds[self._row[command.robot]]
        if kind.takes == "position":
            good = (setpoint[:3] >= self._low - STEP_M) & (setpoint[:3] <= self._high + STEP_M)
        else:
            good = np.abs(setpoint[: 3 if kind.takes == "velocity" else 1]) <= SLACK * kind.speed
        if good.all() and np.isfinite(setpoint).all():
            return ""
        return f"{command.robot} gets the command {command.setpoint}"


class Observer:
    """Receives what robots, bodies and world send, and checks the invariants on it."""

    def __init__(self, session: zenoh.Session, plan: Plan) -> None:
        self.session = session
        keys = self.keys = Keys(plan.experiment.network.realm)
        self.invariants = Invariants(plan)
        typed: Any = {"keys": keys, "robots": self.invariants.names}
        statuses = pubsub.pose_subscriber(session, keys.status("*"), 4096)
        self._statuses = pubsub.Inbox(statuses, messages.Status, **typed)
        self._states = pubsub.Inbox(pubsub.subscriber(session, keys.state("*"), 8192), messages.State, **typed)
        self._truths = pubsub.Inbox(pubsub.subscriber(session, keys.truth("*"), 8192), messages.Position, **typed)
        self._commands = pubsub.Inbox(pubsub.subscriber(session, keys.setpoint("*"), 8192), messages.Command, **typed)
        self._contacts = pubsub.Inbox(pubsub.subscriber(session, keys.contact, 1024), messages.Contact)
        self._events = pubsub.Inbox(pubsub.pose_subscriber(session, keys.event, 256, pubsub.EVENTS), messages.Event)
        self._watch = pubsub.AliveWatch(session, keys.alive("*"))
        self.receivers: dict[str, set[str]] = {name: set() for name in self.invariants.names}  # by sender
        for link in plan.one_way_links:
            self.receivers[link.sender].add(link.receiver)
        self.events: list[messages.Event] = []  # of the conductor
        # the last of each robot, and when it came; all times are monotonic [s]
        self.status: dict[str, messages.Status] = {}
        self.status_at: dict[str, float] = {}
        self.command: dict[str, tuple[messages.Command, float]] = {}  # to each body, and when it came
        self.alive: set[str] = set()  # robots whose token stands
        self.orders: list[messages.Command] = []  # commands other than "drive", since the list was emptied
        self.received_at: dict[tuple[str, str], float] = {}  # when (receiver, sender) last reported a pose
        self.sent_at: dict[str, float] = {}  # when a robot last reported a further transmission
        self.wrong: list[str] = []  # violations since the last `violations`
        self.connected = True  # a router is there

    def update(self) -> None:
        """Take in messages received since the last update."""
        now = time.monotonic()
        self.connected = network.connected(self.session)
        self.events += self._events.read()
        for status in self._statuses.read():
            if (before := self.status.get(status.robot)) is None or status.sent != before.sent:
                self.sent_at[status.robot] = now
            self.status[status.robot], self.status_at[status.robot] = status, now
        for truth in self._truths.read():
            self.invariants.place(truth.robot, truth.position)
        for state in self._states.read():
            self.received_at |= {(state.robot, pose.sender): now for pose in state.received}
            if state.true_position is not None:
                self.invariants.place(state.robot, state.true_position)
        for command in self._commands.read():
            self.command[command.robot] = command, now
            if command.action != "drive":
                self.orders.append(command)
            if invalid := self.invariants.invalid_command(command):
                self.wrong.append(invalid)
        for contact in self._contacts.read():
            self.wrong.append(f"{contact.first} and {contact.second} touched")
        for token, there in self._watch.changes():
            if (name := self.keys.whose(token)) is not None:
                (self.alive.add if there else self.alive.discard)(name)
        self.wrong += self.invariants.violations()

    def violations(self) -> list[str]:
        """Violations since the last call, each once."""
        found, self.wrong = list(dict.fromkeys(self.wrong)), []
        return found

    def running(self) -> set[str]:
        """Robots whose phase is `running` and whose token stands."""
        return {name for name, status in self.status.items() if status.phase == "running" and name in self.alive}

    def is_down(self, name: str) -> bool:
        """Whether a robot reports that it comes down, or is down."""
        return name in self.status and self.status[name].phase in ("landing", "done")

    def moved(self, name: str, before: Array) -> float:
        """Horizontal distance of a robot from an earlier position [m]."""
        return float(np.linalg.norm((self.invariants.where(name) - before)[:2]))
