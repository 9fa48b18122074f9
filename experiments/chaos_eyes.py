"""What a fault laboratory sees of a run: everything that is said on its network, from a session of its own."""

from __future__ import annotations

import time
from contextlib import suppress

import numpy as np
import zenoh

from agents import session as network
from agents import wire
from agents.keys import Keys
from agents.rows import Array
from experiments.experiment import Experiment
from experiments.invariants import Invariants
from experiments.said import by_robots


class Eyes:
    """Looks, and keeps what was said last.

    Attributes:
        session: Of the laboratory.
        keys: Of the realm.
        invariants: Fed with where robots really are.
        status: The last of each robot, and `heard` when it came (monotonic [s]).
        heard: See `status`.
        alive: Whose token stands.
        truth: When the true place of each robot was last heard (monotonic [s]).
        told: The last command to each body, and when it came.
        orders: Commands to bodies that were not to drive, since whoever reads it emptied it.
        listened: When a listener last said that it heard a speaker (monotonic [s]), by both.
        wrong: Violations that have been seen since the last `judge`.
        connected: Whether a router is there.
    """

    def __init__(self, session: zenoh.Session, experiment: Experiment) -> None:
        keys = self.keys = Keys(experiment.network.realm)
        self._session = session
        self.session = session
        self.invariants = Invariants(experiment)
        self._statuses = network.pose_subscriber(session, keys.status("*"), 4096)
        self._states = network.subscriber(session, keys.state("*"), 8192)
        self._truths = network.subscriber(session, keys.truth("*"), 8192)
        self._commands = network.subscriber(session, keys.setpoint("*"), 8192)
        self._contacts = network.subscriber(session, keys.contact, 1024)
        self._watch = network.alive_watch(session, keys.alive("*"))
        self.status: dict[str, wire.Status] = {}
        self.heard: dict[str, float] = {}
        self.alive: set[str] = set()
        self.truth: dict[str, float] = {}
        self.told: dict[str, tuple[wire.Command, float]] = {}
        self.orders: list[wire.Command] = []
        self.listened: dict[tuple[str, str], float] = {}
        self.wrong: list[str] = []
        self.connected = True

    def look(self) -> None:
        """Takes in what was said since the last look."""
        now, names = time.monotonic(), self.invariants.names
        self.connected = network.connected(self._session)
        for status in by_robots(self._statuses.handler, wire.Status, keys=self.keys, robots=names):
            self.status[status.robot], self.heard[status.robot] = status, now
        for truth in by_robots(self._truths.handler, wire.Position, keys=self.keys, robots=names):
            self.invariants.place(truth.robot, truth.position)
            self.truth[truth.robot] = now
        for state in by_robots(self._states.handler, wire.State, keys=self.keys, robots=names):
            self.listened |= {(state.robot, heard.speaker): now for heard in state.heard}
            if state.true_position is not None:
                self.invariants.place(state.robot, state.true_position)
                self.truth[state.robot] = now
        for command in by_robots(self._commands.handler, wire.Command, keys=self.keys, robots=names):
            self.told[command.robot] = command, now
            if command.action != "drive":
                self.orders.append(command)
            if insane := self.invariants.insane(command):
                self.wrong.append(insane)
        for sample in network.received(self._contacts.handler):
            with suppress(wire.Malformed):  # of our own making, as often as not
                contact = wire.decode(sample.payload.to_bytes(), str(sample.encoding), wire.Contact)
                if sample.kind == zenoh.SampleKind.PUT:
                    self.wrong.append(f"{contact.first} and {contact.second} touched")
        for sample in network.received(self._watch.handler):
            name = self.keys.whose(str(sample.key_expr))
            if name is not None:
                (self.alive.discard if sample.kind == zenoh.SampleKind.DELETE else self.alive.add)(name)
        self.wrong += self.invariants.violations()

    def judge(self) -> list[str]:
        """Violations since the last call, each once."""
        found, self.wrong = list(dict.fromkeys(self.wrong)), []
        return found

    def running(self) -> set[str]:
        """Robots that say that they run the experiment, and are there."""
        return {name for name, status in self.status.items() if status.phase == "running" and name in self.alive}

    def where(self) -> dict[str, Array]:
        """Where everybody is."""
        return {name: self.invariants.where(name) for name in self.invariants.names}

    def moved(self, name: str, before: Array) -> float:
        """How far a robot is from where it was, seen from above [m]."""
        return float(np.linalg.norm((self.invariants.where(name) - before)[:2]))
