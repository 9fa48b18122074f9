"""The robot process: a deadline loop around the decision. Everything here is I/O; everything decided is `agents.agent`.

One plain loop on the monotonic clock, no asyncio, no callbacks: what arrives waits in ring channels and is polled.
"""

from __future__ import annotations

import gc
import os
import resource
import signal
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import floor, inf, isfinite, nan
from types import FrameType
from typing import Any, Final

import numpy as np
import zenoh

from agents import session as network
from agents import wire
from agents.agent import Actions, Agent, Assignment, links_by_speaker
from agents.body import Body, BodyState
from agents.keys import Keys
from agents.lifecycle import Phase
from agents.lifeline import Lifeline
from agents.orders import carry_out
from agents.rows import Array, Index

STATUS_S: Final = 1.0
FAREWELL_S: Final = 15.0  # a robot that has not landed this long after its launcher was lost has its motors cut
GHOST_S: Final = 2.5  # so long may the token of a robot that hangs stand after its end
REACH_M: Final = 1.0  # a neighbour said to be farther outside the arena than this is not believed


@dataclass(frozen=True)
class Setup:
    """Where a robot process finds its network and how it talks.

    Attributes:
        keys: Key expressions of the realm.
        endpoints: Routers.
        encoding: Of the payloads that it sends.
        state_hz: Rate of telemetry.
        lifeline: Whether standard input is a lifeline.
        located: Which rows get their position from outside.
    """

    keys: Keys
    endpoints: Sequence[str]
    encoding: wire.Encoding
    state_hz: float
    lifeline: bool
    located: Sequence[bool]


@dataclass
class _Neighbour:
    """What comes from one speaker: its pose channel, its liveliness, and the count of its samples."""

    name: str
    links: Index
    poses: network.Polled[zenoh.Sample]
    alive: network.Polled[zenoh.Sample]
    seq: int = 0
    stamp: float = 0.0
    heard: int = 0
    lost: int = 0


class NameTaken(RuntimeError):
    """A robot of the same name is on the network already."""


class Runtime:
    """Drives the robots of one process through an experiment."""

    def __init__(self, assignment: Assignment, body: Body, setup: Setup) -> None:
        self.agent = Agent(assignment)
        self._assignment, self._body, self._setup = assignment, body, setup
        self._names = assignment.names
        self._mime = wire.MIME[setup.encoding]
        self._dt = 1.0 / assignment.body_hz
        self._state_every = round(assignment.body_hz / setup.state_hz)
        rows = len(self._names)
        self._sent = [0] * rows
        self._state_slot = self._states = 0
        self._news: list[list[wire.Heard]] = [[] for _ in range(rows)]
        self._interventions, self._avoided = np.zeros(rows, dtype=np.intp), np.zeros(rows, dtype=np.intp)
        self._malformed = self._refused = 0
        self._ticks = self._missed = 0
        self._late = 0.0
        self._reported: list[tuple[object, ...]] = [()] * rows
        self._status_due = 0.0
        self._stopping: str | None = None
        self._utc = self._now = self._next = 0.0
        limits = assignment.limits
        x, y, z = np.maximum(np.abs(limits.low), np.abs(limits.high)) + REACH_M
        self._reach = (float(x), float(y), float(z))

    def run(self) -> int:
        """Opens the body, joins the network, drives until all is done; returns the exit code of the process.

        Raises:
            BodyError: If the body cannot be opened.
            network.Unreachable: If no router answers.
        """
        lost = threading.Event()
        rope = Lifeline(lost)
        if self._setup.lifeline:
            rope.start()
        asked = threading.Event()

        def end(_signal: int, _frame: FrameType | None) -> None:
            asked.set()

        before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            self._body.open()
            try:
                name = "+".join(self._names)
                with network.open_session(self._setup.endpoints, name=name, stop=asked) as session:
                    self._refuse_doubles(session)
                    self._join(session)
                    self._loop(lambda: rope.reason if lost.is_set() else ("told to end" if asked.is_set() else None))
            finally:
                self._come_down()
                self._body.close()
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
        return 0

    def _come_down(self) -> None:
        """Motors off; what is still in the air, because something broke on the way, lands first."""
        everyone = np.arange(len(self._names))
        if self._body.read(self._now).flying.any():
            self._body.land(everyone)
            zero, begin = time.monotonic(), self._now
            while self._body.read(self._now).flying.any() and self._now < begin + FAREWELL_S:
                time.sleep(self._dt)
                self._now = begin + time.monotonic() - zero
        self._body.stop(everyone)

    # ------------------------------------------------------------------ the network

    def _refuse_doubles(self, session: zenoh.Session) -> None:
        """Two robots of one name would speak with one voice.

        Raises:
            NameTaken: If one is on the network already. One that was killed is given the time until that is noticed.
        """
        deadline = time.monotonic() + GHOST_S
        while True:
            replies = [session.liveliness().get(self._setup.keys.alive(name), timeout=1.0) for name in self._names]
            taken = [name for name, there in zip(self._names, replies, strict=True) if list(there)]
            if not taken:
                return
            if time.monotonic() > deadline:
                raise NameTaken(
                    f"{', '.join(taken)}: a robot of this name is on the network already; end it first "
                    "(`zenpark keys` shows who is there), or choose another router with --connect"
                )
            time.sleep(0.1)

    def _join(self, session: zenoh.Session) -> None:
        keys, names = self._setup.keys, self._names
        self._session = session
        self._poses = [network.pose_publisher(session, keys.pose(name), self._mime) for name in names]
        self._last = [network.last_value(session, keys.pose(name), self._mime) for name in names]
        self._telemetry = [network.publisher(session, keys.state(name), self._mime) for name in names]
        self._statuses = [network.pose_publisher(session, keys.status(name), self._mime) for name in names]
        self._orders = [network.orders(session, keys.order(name)) for name in names]
        self._estop = network.subscriber(session, keys.estop)
        self._located = [
            (row, network.subscriber(session, keys.position(name), 32))
            for row, name in enumerate(names)
            if self._setup.located[row]
        ]
        self._ranges = [network.publisher(session, keys.ranges(name), self._mime) for name in names]
        self._scanned = [-inf] * len(names)
        self._tokens = [network.alive_token(session, keys.alive(name)) for name in names]
        by_speaker = links_by_speaker(self._assignment.links, self._assignment.speakers)
        self._subscribers = [network.pose_subscriber(session, keys.pose(name)) for name in by_speaker]
        self._watches = [network.alive_watch(session, keys.alive(name)) for name in by_speaker]
        self._neighbours = [
            _Neighbour(name, links, poses.handler, watch.handler)
            for (name, links), poses, watch in zip(by_speaker.items(), self._subscribers, self._watches, strict=True)
        ]

    def _listen(self, t: float) -> None:
        """Takes in what has arrived since the last tick."""
        agent = self.agent
        agent.offline_since = np.inf if network.connected(self._session) else min(agent.offline_since, t)
        for neighbour in self._neighbours:
            for sample in network.received(neighbour.poses):
                self._hear(neighbour, sample, t)
            for sample in network.received(neighbour.alive):
                if sample.kind == zenoh.SampleKind.DELETE:
                    agent.lose(neighbour.links, t)
                else:
                    agent.find(neighbour.links)
        for sample in network.received(self._estop.handler):
            self._stop(sample)
        for row, positions in self._located:
            for sample in network.received(positions.handler):
                self._locate(row, sample, t)
        for row, queryable in enumerate(self._orders):
            for query in network.received(queryable.handler):
                self._obey(row, query, t)
        for last in self._last:
            last.answer()

    def _locate(self, row: int, sample: zenoh.Sample, t: float) -> None:
        """Where a row is, as something outside of it says."""
        try:
            measured = wire.decode(sample.payload.to_bytes(), str(sample.encoding), wire.Position)
            wire.check_position(measured, robot=self._names[row], now=self._utc + t, reach=self._reach)
        except wire.Malformed:
            self._malformed += 1
            return
        yaw = nan if measured.yaw is None else measured.yaw
        self._body.locate(row, measured.stamp - self._utc, np.array(measured.position), yaw)

    def _stop(self, sample: zenoh.Sample) -> None:
        """The emergency stop of everybody."""
        try:
            stop = wire.decode(sample.payload.to_bytes(), str(sample.encoding), wire.Stop)
        except wire.Malformed:
            self._malformed += 1
            return
        for row in range(len(self._names)):
            self.agent.life.stop(row, f"emergency stop by {stop.who}: {stop.reason}")

    def _hear(self, neighbour: _Neighbour, sample: zenoh.Sample, t: float) -> None:
        """One pose of a neighbour: checked, counted, believed."""
        now = self._utc + t
        try:
            pose = wire.decode(sample.payload.to_bytes(), str(sample.encoding), wire.Pose)
            wire.check_pose(pose, robot=neighbour.name, now=now, reach=self._reach)
        except wire.Malformed:
            self._malformed += 1
            return
        if pose.stamp <= neighbour.stamp:
            return  # known already: told again after a reconnection
        if 0 < neighbour.seq < pose.seq:
            neighbour.lost += pose.seq - neighbour.seq - 1
        neighbour.seq, neighbour.stamp = pose.seq, pose.stamp
        neighbour.heard += 1
        links = neighbour.links
        full = np.full(len(links), pose.stamp - self._utc)
        self.agent.hear(
            links,
            np.repeat(np.array([pose.position]), len(links), axis=0),
            np.repeat(np.array([pose.velocity]), len(links), axis=0),
            full,
            np.full(len(links), t),
        )
        news = wire.Heard(neighbour.name, pose.seq, pose.stamp, now, pose.position)
        for row in self._assignment.links.listener[links]:
            self._news[row].append(news)

    def _obey(self, row: int, query: zenoh.Query, t: float) -> None:
        """One order to one row; it always gets a reply."""
        key = self._setup.keys.order(self._names[row])
        with query:
            payload = query.payload.to_bytes() if query.payload is not None else b""
            try:
                order = wire.decode(payload, str(query.encoding or wire.JSON), wire.Order)
            except wire.Malformed as error:
                self._malformed += 1
                query.reply_err(str(error).encode(), encoding="text/plain")
                return
            refusal, value = carry_out(self.agent, row, order, t, self._utc)
            self._refused += bool(refusal)
            if order.order == "start" and order.at is not None and not refusal:
                self._align(order.at - self._utc)
            phase = Phase(self.agent.life.phase[row]).word
            reply = wire.Reply(self._names[row], not refusal, phase, refusal, value)
            query.reply(key, wire.encode(reply, self._setup.encoding), encoding=self._mime)

    # ------------------------------------------------------------------ the loop

    def _align(self, at: float) -> None:
        """Moves the grid of ticks so that one falls on `at`: robots that start together then decide together."""
        self._next = at - floor((at - self._now) / self._dt - 1e-6) * self._dt

    def _loop(self, stopping: Callable[[], str | None]) -> None:
        gc.collect()
        gc.freeze()  # what was imported lives as long as the process: a collection need not look at it
        zero = time.monotonic()
        self._utc = time.time()  # one reading: a step of the wall clock in mid-run does not move the experiment
        farewell = np.inf
        while True:
            wait = zero + self._next - time.monotonic()
            if wait > 0.0:
                time.sleep(wait)
            else:
                behind = int(-wait / self._dt)
                self._missed += behind
                self._next += behind * self._dt
                self.agent.tick += behind
            t = self._now = self._next
            self._late = max(self._late, time.monotonic() - zero - t)
            self._next = t + self._dt
            self._tick(t)
            if farewell == np.inf and (reason := stopping()) is not None:
                farewell = t + FAREWELL_S
                self._stopping = reason
                for row in range(len(self._names)):
                    self.agent.life.land(row, reason)
            if self._stopping is not None and (t > farewell or (self.agent.life.phase == Phase.DONE).all()):
                self._report(t, everything=True)
                return

    def _tick(self, t: float) -> None:
        begun = self.agent.decisions > 0
        self._listen(t)
        state = self._body.read(t)
        actions = self.agent.step(t, state)
        self._act(actions)
        if not begun and self.agent.decisions:
            self._ticks = self._missed = 0  # counted from the common start
            self._interventions[:] = self._avoided[:] = 0
        self._ticks += 1
        self._interventions += actions.changed
        self._avoided += actions.avoided
        for row in actions.speak:
            self._say(int(row), state, t)
        slot = (self.agent.tick - 1) // self._state_every
        if slot != self._state_slot:
            self._state_slot = slot
            self._tell(state, actions, t)
            self._scan(state)
        self._report(t, everything=t >= self._status_due, state=state)

    def _act(self, actions: Actions) -> None:
        """What the body must do, the motors-off first."""
        duties = actions.duties
        if duties is not None:
            if len(duties.stop):
                self._body.stop(duties.stop)
            if len(duties.land):
                self._body.land(duties.land)
            if len(duties.takeoff):
                self._body.takeoff(duties.takeoff, self._assignment.hover[duties.takeoff])
        self._body.command(actions.setpoint)

    def _say(self, row: int, state: BodyState, t: float) -> None:
        """Sends a row's pose to its neighbours."""
        self._sent[row] += 1
        pose = wire.pose(
            self._names[row],
            self._sent[row],
            self._utc + t,
            state.position[row].tolist(),
            state.velocity[row].tolist(),
            float(state.yaw[row]),
        )
        payload = wire.encode(pose, self._setup.encoding)
        self._last[row].hold(payload)
        self._poses[row].put(payload)

    def _tell(self, state: BodyState, actions: Actions, t: float) -> None:
        """Sends the telemetry of every row that knows where it is."""
        self._states += 1
        position, velocity, truth = state.position.tolist(), state.velocity.tolist(), state.true_position.tolist()
        goal, setpoint = self.agent.goal.tolist(), actions.setpoint.tolist()
        for row, name in enumerate(self._names):
            if not isfinite(position[row][0]):
                continue
            known = isfinite(truth[row][0])
            message = wire.State(
                name,
                self._states,
                self._utc + t,
                Phase(self.agent.life.phase[row]).word,
                tuple(position[row]),
                tuple(velocity[row]),
                float(state.yaw[row]),
                tuple(goal[row]) if isfinite(goal[row][0]) else None,
                tuple(setpoint[row]) if isfinite(setpoint[row][0]) else None,
                float(self.agent.error[row]),
                tuple(truth[row]) if known else None,
                float(state.true_yaw[row]) if known else None,
                self._news[row],
                _known_row(state.attitude, row),
                _known_row(state.shadow_position, row),
                _known_row(state.shadow_yaw, row),
            )
            self._telemetry[row].put(wire.encode(message, self._setup.encoding))
            self._news[row] = []

    def _scan(self, state: BodyState) -> None:
        """Sends the range readings that are new."""
        if state.rays is None:
            return
        for row in np.unique(state.rays.row).tolist():
            scan = state.rays.of(row)
            if scan is not None and scan.time > self._scanned[row]:
                self._scanned[row] = scan.time
                distance = [value if isfinite(value) else None for value in scan.distance.tolist()]
                ranges = wire.Ranges(
                    self._names[row],
                    self._utc + scan.time,
                    scan.bearing.tolist(),
                    scan.elevation.tolist(),
                    distance,
                )
                self._ranges[row].put(wire.encode(ranges, self._setup.encoding))

    def _report(self, t: float, *, everything: bool, state: BodyState | None = None) -> None:
        """Sends statuses: of all rows when due, else of those whose phase or reason changed."""
        if not (everything or self.agent.life.moved):
            return
        if everything:
            self._status_due = t + STATUS_S
        life = self.agent.life
        missing = [self.agent.missing(row) for row in range(len(self._names))]
        for row, name in enumerate(self._names):
            news = (life.phase[row], life.reason[row], tuple(missing[row]))
            if not everything and news == self._reported[row]:
                continue
            if news[:2] != self._reported[row][:2]:
                print(f"{name}: {Phase(life.phase[row]).word}" + (f" ({news[1]})" if news[1] else ""), flush=True)
            self._reported[row] = news
            mine = [n for n in self._neighbours if (self._assignment.links.listener[n.links] == row).any()]
            battery = float(state.battery[row]) if state is not None else float("nan")
            start = float(life.start_at[row])  # a plain float: msgspec does not encode those of numpy
            status = wire.Status(
                robot=name,
                stamp=self._utc + t,
                phase=Phase(life.phase[row]).word,
                reason=life.reason[row],
                body=state.notes[row] if state is not None and state.notes else "",
                battery=battery if isfinite(battery) else None,
                sent=self._sent[row],
                heard=sum(n.heard for n in mine),
                lost={n.name: n.lost for n in mine},
                malformed=self._malformed,
                refused=self._refused,
                ticks=self._ticks,
                missed=self._missed,
                decisions=self.agent.decisions,
                interventions=int(self._interventions[row]),
                avoided=int(self._avoided[row]),
                late_s=self._late,
                started=self._utc + start if isfinite(start) else 0.0,
                missing=missing[row],
                pid=os.getpid(),
                cpu_s=time.process_time(),
                rss_mb=_resident_mb(),
            )
            self._statuses[row].put(wire.encode(status, self._setup.encoding))
        if everything:
            self._late = 0.0


def _known_row(column: Array | None, row: int) -> Any:  # noqa: ANN401 - a number or a tuple, as the column has it
    """A row of what a body may know or not, for the wire; None if it does not."""
    if column is None or not np.isfinite(column[row]).all():
        return None
    value = column[row].tolist()
    return tuple(value) if isinstance(value, list) else value


def _resident_mb() -> float:
    try:
        with open("/proc/self/statm", "rb") as pages:  # noqa: PTH123 - a Path costs more than the read
            return int(pages.read().split()[1]) * resource.getpagesize() / 1e6
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
