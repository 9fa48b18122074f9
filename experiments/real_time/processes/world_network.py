"""Network of a world: receives commands and mirrored robots, publishes positions, true poses and range readings.

One wildcard subscription for all commands; a key is looked up before a payload is decoded.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping, Set
from functools import partial
from math import inf
from typing import Final

import numpy as np
import zenoh

from agents.arrays import Array, some
from agents.body.interface import RangeScan, Rays
from agents.clock import Clock
from agents.network import messages, pubsub, validation
from agents.network import session as network
from agents.network.keys import Keys
from agents.runtime import range_inbox
from experiments.definition.bodies import WORLD
from experiments.definition.experiment import Experiment
from experiments.definition.plan import Plan
from experiments.real_time.processes.joining import Network
from experiments.real_time.processes.world_population import HOLD_S, Population

DEPTH: Final = 16_384  # queued commands: those of two hundred robots in 0.8 s
TRUTH_HZ: Final = 50.0
LAND_S: Final = 3.0  # without a command for this long a flying robot lands
CLIMB_S: Final = 15.0  # limit for the first setpoint after a climb, or after a restart of the world
GONE_S: Final = 1.0  # without a state for this long a mirrored robot is removed
HANG_S: Final = 0.3  # after a longer suspension of the world silence proves nothing
ANSWER_S: Final = 1.0  # limit for robots to send their state
STRANGERS: Final = 100  # distinct unknown robots that are reported
IN_AIR_M: Final = 0.05
UP: Final = ("ready", "airborne", "running", "landing")  # phases in which a robot may be in the air
UNDER_WAY: Final = ("airborne", "running")


class Exchange:
    """The network of a world. Times `t` are on the clock of the world [s]."""

    utc: float  # [s] UTC at which the clock of the world was 0
    contacts: int  # that have begun
    refused: int  # commands to unknown robots, and orders that could not be carried out
    malformed: int  # refused payloads
    trouble: str  # last refusal; empty if there was none

    def __init__(self, experiment: Experiment, population: Population, joint: Network) -> None:
        session, keys = joint.session, joint.keys
        self._population, self._session, self._keys = population, session, keys
        self._encoding = experiment.network.encoding
        self._mime = messages.MIME[self._encoding]
        x, y, z = experiment.arena.size
        self._reach = validation.reach_of((-0.5 * x, -0.5 * y, 0.0), (0.5 * x, 0.5 * y, z))
        self._truth_every = max(1, round(experiment.rates.body_hz / TRUTH_HZ))
        # commands to robots with another body are for another simulator
        self._elsewhere = {keys.setpoint(name) for name, robot in experiment.robots.items() if robot.body != WORLD}
        self._clock = Clock()
        self.utc = self._clock.utc()
        self.contacts = self.refused = self.malformed = 0
        self.trouble = ""
        self._ownership = joint.ownership
        self._router = network.RouterWatch(session, keys.world_alive, joint.endpoints)
        self._cut_off = False
        self._setpoints = pubsub.Inbox(
            pubsub.subscriber(session, keys.setpoint("*"), DEPTH),
            messages.Command,
            keys=keys,
            on_refusal=self._count_malformed,
        )
        self._statuses = pubsub.Inbox(
            pubsub.pose_subscriber(session, keys.status("*"), 1024), messages.Status, on_refusal=self._count_malformed
        )
        self._contacts = pubsub.publisher(session, keys.contact, messages.JSON)
        self._events = pubsub.publisher(session, keys.event, messages.JSON)
        self._done: dict[str, int] = {}  # number of the last executed command
        # session that owns the name of a robot: a new one numbers its commands from anew
        self._lives: dict[str, str] = {}
        self._owners = pubsub.AliveWatch(session, Keys.life(keys.alive("*"), "*"))
        self._strangers: set[str] = set()
        self._met: set[frozenset[str]] = set()
        self._started: dict[str, float] = {}
        self._begun = inf
        self._ticks = 0
        names = self._names = population.names
        rows = len(names)
        self._quiet = np.full(rows, inf)  # begin of the silence of each row; infinity: it needs no command
        # time and pose of the last state of each mirrored row
        self._received_at = np.full(rows, -inf)
        self._place, self._velocity, self._yaw = np.full((rows, 3), np.nan), np.zeros((rows, 3)), np.zeros(rows)
        self._carried, self._mirrored = np.flatnonzero(population.carried), np.flatnonzero(~population.carried)
        carried = self._carried.tolist()
        self._row = {keys.setpoint(names[row]): row for row in carried}
        measured = frozenset(Plan(experiment).externally_measured)
        placed = [row for row in carried if names[row] not in measured]
        self._placed = np.array(placed, dtype=np.intp)

        def publishers(key: Callable[[str], str], rows: Iterable[int]) -> dict[str, zenoh.Publisher]:
            return {names[row]: pubsub.publisher(session, key(names[row]), self._mime) for row in rows}

        self._positions = publishers(keys.position, placed)
        self._truths = publishers(keys.truth, carried)
        self._ranges = publishers(keys.ranges, np.flatnonzero(population.seen).tolist())
        self._mirrors = [(row, self._states_of(names[row])) for row in self._mirrored.tolist()]
        self.restart()

    def begin(self, up: float) -> None:
        """Sets the clock of the world to 0 at a time `up` of the clock `uptime` [s]."""
        self.utc = self._clock.at(up)

    def restart(self) -> None:
        """Follows a body that is made anew: it has no commands, and does not know the mirrored robots."""
        rows = len(self._names)
        self._held = np.zeros(rows, dtype=bool)
        self._given = np.full((rows, 4), np.nan)  # setpoints since the last step
        self._scanned = np.full(rows, -inf)
        self._rays: Rays | None = None
        if len(self._mirrored):
            self._update_mirrors()

    def restore_positions(self, there: Set[str]) -> list[str]:
        """Places simulated robots that are on the network at the poses of their states; returns their names."""
        waiting = {
            name: self._states_of(name)
            for name in (self._names[row] for row in self._carried.tolist())
            if name in there
        }
        found: list[str] = []
        deadline, pause = time.monotonic() + ANSWER_S, threading.Event()
        while waiting and time.monotonic() < deadline:
            pause.wait(0.01)
            for name, inbox in list(waiting.items()):
                state = self._newest(inbox)
                if state is None or state.position is None:
                    continue
                flying = state.position[2] > IN_AIR_M and state.phase in UP
                self._population.put(name, state.position, state.yaw or 0.0, flying=flying)
                row = self._names.index(name)
                self._quiet[row] = CLIMB_S if flying and self._population.flies[row] else inf
                found.append(name)
                waiting.pop(name).close()
        for inbox in waiting.values():
            inbox.close()
        return found

    def mirrored(self) -> list[str]:
        """Names of the mirrored robots with a known pose."""
        return [self._names[row] for row in self._mirrored.tolist() if np.isfinite(self._place[row, 0])]

    # ------------------------------------------------------------------ receive

    def receive(self, t: float) -> None:
        """Receives all until `t`."""
        was_cut_off, self._cut_off = self._cut_off, self._router.silent_since(t) < inf
        if was_cut_off and not self._cut_off:
            self._ownership.begin(self._session)
        for token, there in self._owners.changes():
            if there:
                self._note_owner(token)
        for command, sample in self._setpoints.read_samples(validation.check_command, self._known):
            row = self._row[str(sample.key_expr)]
            if command.seq > self._done.get(command.robot, 0):
                self._done[command.robot] = command.seq
                self._obey(row, command, t)
        if len(self._mirrored):
            self._update_poses(t)
        for status in self._statuses.read():
            self._update_start(status, t)

    def slept(self, seconds: float, t: float) -> None:
        """Forgives silence after the world stood still for so long, until `t`."""
        if seconds > HANG_S:
            self._quiet = np.where(np.isfinite(self._quiet), np.maximum(self._quiet, t), self._quiet)

    def apply_commands(self, t: float) -> None:
        """Applies the commands; robots without commands hold, drive on, or land after `LAND_S`."""
        population = self._population
        hold_s: float | Array = population.hold_s
        if self._cut_off:  # without a router no command arrives: robots hold, but need not land
            self._quiet = np.maximum(self._quiet, t - HOLD_S - 1e-3)
            hold_s = HOLD_S
        silent = t - self._quiet > hold_s
        if some(silent):
            holding = np.flatnonzero(silent & ~self._held)
            if len(holding):
                self._held[holding] = True
                population.body.command(population.holding(holding))
            tired = np.flatnonzero(silent & (t - self._quiet > LAND_S) & population.body.engine.flying)
            if len(tired):
                population.body.land(tired)
                self._quiet[tired] = inf
                for row in tired.tolist():
                    self.publish_event("silent", self._names[row], f"lands: no command for {LAND_S:g} s")
        given = np.isfinite(self._given[:, 0])
        if some(given):
            population.body.command(self._given)
            self._given = np.full_like(self._given, np.nan)

    def _obey(self, row: int, command: messages.Command, t: float) -> None:
        population, action = self._population, command.action
        if action == "drive":
            self._given[row] = command.setpoint
            self._quiet[row], self._held[row] = t, False
            return
        self._given[row], self._held[row] = np.nan, False
        if action == "takeoff" and command.height is not None:
            population.takeoff(row, command.height)
            self._quiet[row] = t + CLIMB_S
        else:
            (population.body.land if action == "land" else population.body.stop)(np.array([row]))
            self._quiet[row] = inf

    def _note_owner(self, token: str) -> None:
        """A new process owns the name of a robot: it numbers commands by its own clock, which may be behind."""
        name, life = self._keys.whose(token), Keys.life_of(token)
        if name is None or life is None:
            return
        if self._lives.get(name, life) != life:
            self._done.pop(name, None)
        self._lives[name] = life

    def _known(self, key: str) -> bool:
        """Whether a command is for a robot of this world; one that is for no robot of this system is refused."""
        known = key in self._row
        if not known and key not in self._elsewhere:
            self._reject_unknown(key)
        return known

    def _reject_unknown(self, key: str) -> None:
        name = self._keys.whose(key)
        if name is None:
            self.malformed += 1
            return
        self.refused += 1
        if name not in self._strangers and len(self._strangers) < STRANGERS:
            self._strangers.add(name)
            self.publish_event(
                "refused",
                "world",
                f"{name} gets commands, but is not in this world: start the world with the experiment that has it",
            )

    def _update_poses(self, t: float) -> None:
        """Updates the poses of mirrored robots."""
        changed = False
        for row, inbox in self._mirrors:
            state = self._newest(inbox)
            if state is not None and state.position is not None:
                self._place[row], self._velocity[row] = state.position, state.velocity or messages.STILL
                self._yaw[row] = state.yaw or 0.0
                self._received_at[row] = t
                changed = True
            elif t - self._received_at[row] > GONE_S and np.isfinite(self._place[row, 0]):
                self._place[row] = np.nan
                changed = True
        if changed:
            self._update_mirrors()

    def _update_mirrors(self) -> None:
        rows = self._mirrored
        self._population.body.mirror(rows, self._place[rows], self._yaw[rows], self._velocity[rows])

    def _states_of(self, name: str) -> pubsub.Inbox[messages.State]:
        subscriber = pubsub.subscriber(self._session, self._keys.state(name), 4)
        return pubsub.Inbox(subscriber, messages.State, keys=self._keys, on_refusal=self._count_malformed)

    def _newest(self, inbox: pubsub.Inbox[messages.State]) -> messages.State | None:
        """The newest valid state that has a position."""
        found = None
        check = partial(validation.check_state, now=self._clock.utc(), reach=self._reach)
        for state in inbox.read(check):
            if state.position is not None:
                found = state
        return found

    def _update_start(self, status: messages.Status, t: float) -> None:
        """Derives the start of the run from the robots' statuses, for obstacles that move by a plan."""
        if status.phase in UNDER_WAY and 0.0 < status.started < inf and status.robot in self._names:
            self._started[status.robot] = status.started
        else:
            self._started.pop(status.robot, None)
        begun = min(self._started.values(), default=self._begun)
        if begun != self._begun:
            self._begun = begun
            self._population.begin(self._population.time + begun - (self.utc + t))

    def _count_malformed(self, _key: str, reason: str) -> None:
        self.malformed += 1
        self.trouble = reason

    # ------------------------------------------------------------------ publish

    def publish(self, t: float) -> None:
        """Publishes positions, true poses, range readings and contacts."""
        state, rows = self._population.state, self._carried
        stamp = round(self.utc + t, 6)
        self._publish(self._positions, state.position[self._placed], state.yaw[self._placed], stamp)
        if self._ticks % self._truth_every == 0:
            self._publish(self._truths, state.true_position[rows], state.true_yaw[rows], stamp)
        self._ticks += 1
        rays = state.rays
        if rays is not None and rays is not self._rays:
            self._rays = rays
            self._sweep(rays, stamp)
        for meeting in self._population.meetings():
            self.contacts += 1
            contact = messages.Contact(stamp, meeting.first, meeting.second, meeting.impulse, meeting.overlap)
            self._contacts.put(messages.encode(contact))
            pair = frozenset((meeting.first, meeting.second))
            if pair not in self._met:
                self._met.add(pair)
                self.publish_event("contact", meeting.first, f"touches {meeting.second} ({meeting.impulse:.3g} N s)")

    def publish_event(self, kind: str, source: str, text: str) -> None:
        """Publishes an event, for recorder and viewers."""
        print(f"{kind} {source}: {text}", flush=True)
        self._events.put(messages.encode(messages.Event(self._clock.utc(), kind, source, text)))

    def refuse(self, source: str, reason: str) -> None:
        """Counts and publishes a refusal."""
        self.refused += 1
        self.trouble = reason
        self.publish_event("refused", source, reason)

    def _publish(self, publishers: Mapping[str, zenoh.Publisher], position: Array, yaw: Array, stamp: float) -> None:
        encoding = self._encoding
        for (name, publisher), place, heading in zip(
            publishers.items(), position.round(6).tolist(), yaw.round(6).tolist(), strict=True
        ):
            said = messages.encode(messages.position(name, stamp, place, heading), encoding)
            publisher.put(said, source_info=pubsub.source_of(publisher))

    def _sweep(self, rays: Rays, stamp: float) -> None:
        """Publishes the readings of rows that have new ones."""
        begin = np.flatnonzero(np.diff(rays.row, prepend=-1))  # rays of one row follow one another
        end = np.append(begin[1:], len(rays.row))
        time = np.maximum.reduceat(rays.time, begin)
        rows = rays.row[begin]
        for k in np.flatnonzero(time > self._scanned[rows]).tolist():
            row, part = int(rows[k]), slice(int(begin[k]), int(end[k]))
            self._scanned[row] = time[k]
            scan = RangeScan(0.0, rays.bearing[part], rays.elevation[part], rays.distance[part])
            message = range_inbox.message(self._names[row], stamp, scan)
            self._ranges[self._names[row]].put(messages.encode(message, self._encoding))
