"""Network of a world: receives commands and mirrored robots, publishes positions, true poses and range readings.

One wildcard subscription for all commands; a key is looked up before a payload is decoded.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Set
from dataclasses import dataclass
from functools import partial
from math import inf, isfinite
from typing import Final

import msgspec

from agents.clock import Clock
from agents.decision.lifecycle import UNDER_WAY
from agents.network import messages, pubsub, validation
from agents.network import session as network
from agents.network.keys import Keys
from agents.runtime import range_inbox
from agents.vectors import NO_SETPOINT, UNKNOWN, ZERO, Vector
from experiments.definition.experiment import WORLD
from experiments.definition.plan import Plan
from experiments.real_time.processes.joining import Network
from experiments.real_time.processes.world_population import HOLD_S, WorldBodies

DEPTH: Final = 16_384  # queued commands: those of two hundred robots in 0.8 s
TRUTH_HZ: Final = 50.0
LAND_S: Final = 3.0  # time without a command after which a flying robot lands
CLIMB_S: Final = 15.0  # limit for the first setpoint after a climb, or after a restart of the world
GONE_S: Final = 1.0  # time without a state after which a mirrored robot is removed
HANG_S: Final = 0.3  # suspension of the world from which silence proves nothing
ANSWER_S: Final = 1.0  # limit for robots to send their state
STRANGERS: Final = 100  # distinct unknown robots that are reported
IN_AIR_M: Final = 0.05
UP: Final = ("ready", "airborne", "running", "landing")  # phases in which a robot may be in the air


class Events:
    """Events of a world, for recorder and viewers; what it has refused."""

    def __init__(self, joint: Network, clock: Clock) -> None:
        self.refused = 0  # commands to unknown robots, and orders that could not be carried out
        self.malformed = 0  # refused payloads
        self.trouble = ""  # last refusal; empty if there was none
        self._clock = clock
        self._publisher = pubsub.publisher(joint.session, joint.keys.world_event, messages.JSON)

    def publish(self, kind: str, text: str) -> None:
        print(f"{kind}: {text}", flush=True)
        self._publisher.put(messages.encode(messages.Event(self._clock.utc(), kind, validation.WORLD, text)))

    def refuse(self, reason: str) -> None:
        self.refused += 1
        self.trouble = reason
        self.publish("refused", reason)

    def count_malformed(self, _key: str, reason: str) -> None:
        self.malformed += 1
        self.trouble = reason


class Commands:
    """Commands to the simulated robots: received, checked, applied; robots without commands hold, then land."""

    def __init__(self, plan: Plan, population: WorldBodies, joint: Network, events: Events) -> None:
        session, keys, names = joint.session, joint.keys, population.names
        self._population, self._session, self._keys, self._events = population, session, keys, events
        # commands to robots with another body are for another simulator
        robots = plan.experiment.robots.items()
        self._elsewhere = {keys.setpoint(name) for name, robot in robots if robot.body != WORLD}
        self._row = {keys.setpoint(names[row]): row for row, here in enumerate(population.carried) if here}
        self._ownership = joint.ownership
        self._router = network.RouterWatch(session, keys.world_alive, joint.endpoints)
        self._cut_off = False
        commands = pubsub.subscriber(session, keys.setpoint("*"), DEPTH)
        self._inbox = pubsub.Inbox(commands, messages.Command, keys=keys, on_refusal=events.count_malformed)
        self.done: dict[str, int] = {}  # number of the last executed command
        # session that owns the name of a robot: a new one restarts the numbers of its commands
        self.lives: dict[str, str] = {}
        self._owners = pubsub.AliveWatch(session, Keys.life(keys.alive("*"), "*"))
        self._stopped = set[str]()  # robots that stay stopped, whatever a process says that missed the stop
        self._tokens = set[str]()  # tokens of all processes that have owned a name
        self._strangers: set[str] = set()
        self.quiet = [inf] * len(names)  # begin of the silence of each robot; infinity: it needs no command
        self.restart()

    def restart(self) -> None:
        rows = len(self._population.names)
        self._held = [False] * rows
        self._given = [NO_SETPOINT] * rows  # setpoints since the last step

    def expect(self, name: str, *, flying: bool) -> None:
        """Expects commands to a robot that was placed: `CLIMB_S` passes before one that flies lands without any."""
        row = self._population.names.index(name)
        self.quiet[row] = CLIMB_S if flying and self._population.flies[row] else inf

    def receive(self, t: float) -> None:
        was_cut_off, self._cut_off = self._cut_off, self._router.silent_since(t) < inf
        if was_cut_off and not self._cut_off:
            self._ownership.begin(self._session)
        for token, stands in self._owners.changes():
            if stands:
                self._note_owner(token)
        for command, sample in self._inbox.read_samples(validation.check_command, self._known):
            row = self._row[str(sample.key_expr)]
            if command.seq > self.done.get(command.robot, 0):
                self.done[command.robot] = command.seq
                if command.robot not in self._stopped:
                    self._obey(row, command, t)

    def stop(self) -> None:
        """Switches all motors off and halts all wheels, as an emergency stop demands of the robots themselves, too.

        A robot moves again once another process owns its name.
        """
        rows = [*self._row.values()]
        self._stopped.update(self._population.names[row] for row in rows)
        for row in rows:
            self._given[row], self._held[row] = NO_SETPOINT, False
            self.quiet[row] = inf
        self._population.body.stop(rows)

    def forgive(self, seconds: float, t: float) -> None:
        """Forgives silence after the world stood still for `seconds`, until `t`."""
        if seconds > HANG_S:
            self.quiet = [max(since, t) for since in self.quiet]

    def apply(self, t: float) -> None:
        """Applies the commands; robots without commands hold, drive on, or land after `LAND_S`."""
        population, body = self._population, self._population.body
        holding, tired = set[int](), list[int]()
        for row, motion in enumerate(body.engine.motions):
            hold_s = population.hold_s[row]
            if self._cut_off:  # no command arrives: robots hold, but need not land
                self.quiet[row] = max(self.quiet[row], t - HOLD_S - 1e-3)
                hold_s = HOLD_S
            silence = t - self.quiet[row]
            if silence > hold_s and not self._held[row]:
                self._held[row] = True
                holding.add(row)
            if silence > max(hold_s, LAND_S) and motion.flying:
                self.quiet[row] = inf
                tired.append(row)
        if holding:
            body.command(population.holding(holding))
        if tired:
            body.land(tired)
            for row in tired:
                self._events.publish("silent", f"{population.names[row]} lands: no command for {LAND_S:g} s")
        if any(isfinite(setpoint[0]) for setpoint in self._given):
            body.command(self._given)
            self._given = [NO_SETPOINT] * len(population.names)

    def _obey(self, row: int, command: messages.Command, t: float) -> None:
        population, action = self._population, command.action
        if action == "drive":
            self._given[row] = command.setpoint or NO_SETPOINT
            self.quiet[row], self._held[row] = t, False
            return
        self._given[row], self._held[row] = NO_SETPOINT, False
        if action == "takeoff" and command.height is not None:
            population.takeoff(row, command.height)
            self.quiet[row] = t + CLIMB_S
        else:
            (population.body.land if action == "land" else population.body.stop)([row])
            self.quiet[row] = inf

    def _note_owner(self, token: str) -> None:
        """A new process owns the name of a robot: it numbers commands by its own clock, which may be behind."""
        name, life = self._keys.robot_of(token), Keys.life_of(token)
        if name is None or life is None:
            return
        if self.lives.get(name, life) != life:
            self.done.pop(name, None)
        if token not in self._tokens:
            self._tokens.add(token)
            self._stopped.discard(name)
        self.lives[name] = life

    def _known(self, key: str) -> bool:
        """Whether a command is for a robot of this world; one that is for no robot of this system is refused."""
        if key in self._row or key in self._elsewhere:
            return key in self._row
        name = self._keys.robot_of(key)
        if name is None:
            self._events.malformed += 1
            return False
        self._events.refused += 1
        if name not in self._strangers and len(self._strangers) < STRANGERS:
            self._strangers.add(name)
            text = f"{name} gets commands, but is not in this world: start the world with the experiment that has it"
            self._events.publish("refused", text)
        return False


class States:
    """States and statuses of the robots: poses of mirrored ones, former poses of simulated ones, start of the run."""

    def __init__(self, plan: Plan, population: WorldBodies, joint: Network, events: Events, clock: Clock) -> None:
        self._population = population
        self._session, self._keys = joint.session, joint.keys
        self._events = events
        self._clock, self._names = clock, population.names
        x, y, z = plan.experiment.arena.size
        self._valid_box = validation.valid_box_of((-0.5 * x, -0.5 * y, 0.0), (0.5 * x, 0.5 * y, z))
        statuses = pubsub.pose_subscriber(joint.session, joint.keys.status("*"), 1024)
        self._statuses = pubsub.Inbox(statuses, messages.Status, on_refusal=events.count_malformed)
        self._started: dict[str, float] = {}
        self._begun = inf
        mirrored = [row for row, here in enumerate(population.carried) if not here]
        self._mirrors = [_Mirror(row, self._states_of(self._names[row])) for row in mirrored]
        self.update_body()

    def mirrored(self) -> list[str]:
        """Names of the mirrored robots with a known pose."""
        return [self._names[mirror.row] for mirror in self._mirrors if isfinite(mirror.place[0])]

    def update_body(self) -> None:
        mirrors = self._mirrors
        self._population.body.mirror(
            [mirror.row for mirror in mirrors],
            [mirror.place for mirror in mirrors],
            [mirror.yaw for mirror in mirrors],
            [mirror.velocity for mirror in mirrors],
        )

    def restore(self, alive: Set[str]) -> dict[str, bool]:
        """Places simulated robots that are `alive` at the poses of their states: their names, and whether they fly."""
        carried = zip(self._names, self._population.carried, strict=True)
        silent = {name: self._states_of(name) for name, here in carried if here and name in alive}
        found: dict[str, bool] = {}
        deadline, pause = time.monotonic() + ANSWER_S, threading.Event()
        while silent and time.monotonic() < deadline:
            pause.wait(0.01)
            for name, inbox in list(silent.items()):
                state = self._newest(inbox)
                if state is None or state.position is None:
                    continue
                found[name] = state.position[2] > IN_AIR_M and state.phase in UP
                self._population.put(name, state.position, state.yaw or 0.0, flying=found[name])
                silent.pop(name).close()
        for inbox in silent.values():
            inbox.close()
        return found

    def receive(self, t: float, utc: float) -> None:
        """Receives all until `t` [s] of a clock that was 0 at `utc` [s]."""
        for status in self._statuses.read():
            self._update_start(status, utc + t)
        changed = False
        for mirror in self._mirrors:
            state = self._newest(mirror.inbox)
            if state is not None and state.position is not None:
                mirror.place, mirror.velocity = state.position, state.velocity or messages.STILL
                mirror.yaw, mirror.received_at = state.yaw or 0.0, t
                changed = True
            elif t - mirror.received_at > GONE_S and isfinite(mirror.place[0]):
                mirror.place = UNKNOWN
                changed = True
        if changed:
            self.update_body()

    def _states_of(self, name: str) -> pubsub.Inbox[messages.State]:
        subscriber = pubsub.subscriber(self._session, self._keys.state(name), 4)
        return pubsub.Inbox(subscriber, messages.State, keys=self._keys, on_refusal=self._events.count_malformed)

    def _newest(self, inbox: pubsub.Inbox[messages.State]) -> messages.State | None:
        """The newest valid state that has a position."""
        found = None
        check = partial(validation.check_state, now=self._clock.utc(), valid_box=self._valid_box)
        for state in inbox.read(check):
            if state.position is not None:
                found = state
        return found

    def _update_start(self, status: messages.Status, now: float) -> None:
        """Derives the start of the run from the robots' statuses, for obstacles that move by a plan."""
        if status.phase in UNDER_WAY and 0.0 < status.started < inf and status.robot in self._names:
            self._started[status.robot] = status.started
        else:
            self._started.pop(status.robot, None)
        begun = min(self._started.values(), default=self._begun)
        if begun != self._begun:
            self._begun = begun
            self._population.begin(self._population.time + begun - now)


class Publications:
    """Positions, true poses, range readings and contacts, published after each step."""

    contacts = 0  # number that have begun

    def __init__(self, plan: Plan, population: WorldBodies, joint: Network, events: Events) -> None:
        session, keys, experiment = joint.session, joint.keys, plan.experiment
        names = self._names = population.names
        self._population, self._events = population, events
        self._encoding = experiment.network.encoding
        self._truth_every = max(1, round(experiment.rates.body_hz / TRUTH_HZ))
        self._contacts = pubsub.publisher(session, keys.contact, messages.JSON)
        self._met: set[frozenset[str]] = set()
        self._ticks = 0
        mime, measured = messages.MIME[self._encoding], frozenset(plan.externally_measured)
        carried = [row for row, here in enumerate(population.carried) if here]

        def publishers(key: Callable[[str], str], rows: Iterable[int]) -> dict[int, pubsub.NumberedPublisher]:
            return {row: pubsub.NumberedPublisher(session, key(names[row]), mime) for row in rows}

        self._positions = publishers(keys.position, (row for row in carried if names[row] not in measured))
        self._truths = publishers(keys.truth, carried)
        self._ranges = publishers(keys.ranges, (row for row, seen in enumerate(population.seen) if seen))
        self.restart()

    def restart(self) -> None:
        self._scanned = dict.fromkeys(self._ranges, -inf)  # time of the last published sweep [s]

    def publish(self, stamp: float) -> None:
        """Publishes all that is new at `stamp` [s] UTC."""
        states = self._population.states
        names, encoding = self._names, self._encoding
        for row, publisher in self._positions.items():
            state = states[row]
            position = messages.position(names[row], stamp, *_rounded(state.position, state.yaw))
            publisher.put(messages.encode(position, encoding))
        if self._ticks % self._truth_every == 0:
            for row, publisher in self._truths.items():
                truth = messages.position(names[row], stamp, *_rounded(states[row].true_position, states[row].true_yaw))
                publisher.put(messages.encode(truth, encoding))
        self._ticks += 1
        for row, publisher in self._ranges.items():
            scan = states[row].scan
            if scan is not None and scan.time > self._scanned[row]:
                self._scanned[row] = scan.time
                message = range_inbox.message(names[row], stamp, msgspec.structs.replace(scan, time=0.0))
                publisher.put(messages.encode(message, encoding))
        for contact in self._population.meetings(stamp):
            self.contacts += 1
            self._contacts.put(messages.encode(contact))
            pair = frozenset((contact.first, contact.second))
            if pair not in self._met:
                self._met.add(pair)
                who = f"{contact.first} touches {contact.second}"
                self._events.publish("contact", f"{who} ({contact.impulse:.3g} N s)")


@dataclass(slots=True)
class _Mirror:
    """A robot that another process carries, as its states show it."""

    row: int
    inbox: pubsub.Inbox[messages.State]
    place: Vector = UNKNOWN  # [m], NaN while it is absent
    velocity: Vector = ZERO  # [m/s]
    yaw: float = 0.0  # [rad]
    received_at: float = -inf  # arrival of the last state [s]


def _rounded(position: Vector, yaw: float) -> tuple[Vector, float]:
    """A pose in micrometres and microradians, still in metres and radians."""
    return (round(position[0], 6), round(position[1], 6), round(position[2], 6)), round(yaw, 6)
