"""Knowledge of an observer about a run, from the network alone: experiment, poses, statuses, transmissions, events."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field
from math import inf
from typing import Final

import numpy as np
import zenoh

from agents.clock import Clock
from agents.decision.lifecycle import Phase
from agents.network import messages, pubsub, validation
from agents.network.keys import Keys
from agents.network.session import received
from experiments.file import document
from experiments.file.problems import DocumentError
from experiments.metrics.clearance import Overlap
from experiments.scene.condition import AT_REST, SILENT_S, Condition, condition
from experiments.scene.stage import TOUCH_S, LinkTracker, Moment, SceneModel, Trail, drawn_columns
from experiments.view.heartbeat import DataAge

UNKNOWN_S: Final = 2.0  # time without an experiment after which robots are drawn that are known by name only
RATE_S: Final = 1.0
DEPTH: Final = 8192  # samples between two rounds
EVENTS: Final = 200  # kept


@dataclass
class RobotReport:
    """State of one robot, as far as it is known."""

    state: messages.State | None = None
    status: messages.Status | None = None
    memory: messages.LawMemory = field(default_factory=lambda: messages.LawMemory("", 0, 0.0))
    heard_at: float = -inf  # [s, monotonic] arrival of that status
    alive: bool = False
    known: bool = False  # it was alive, or reported, at some time
    sent_at: float = -inf  # [s, monotonic] arrival of its last transmitted pose
    sent: int = 0  # poses since the rate was computed
    rate: float = 0.0  # [1/s] rate of transmitted poses, over the last second
    delay: dict[str, float] = field(default_factory=dict)  # [s] delay of the last pose, by sender


class Observer:
    """A realm as it is seen from outside; polled. Needs no experiment file."""

    stage: SceneModel
    case: str
    robots: dict[str, RobotReport]  # reports by name, ordered as the stage
    events: deque[messages.Event]  # events of the run, incidents of robots included, oldest first
    world: messages.WorldState | None
    scans: dict[str, messages.Ranges]  # last range readings, while they are asked for
    age: DataAge  # age of the poses

    def __init__(self, session: zenoh.Session, keys: Keys) -> None:
        self._session, self._keys = session, keys
        self._clock = Clock()
        self._experiments = pubsub.pose_subscriber(session, keys.experiment, 4)
        self._feed = pubsub.RobotFeed(session, keys)
        memories = pubsub.subscriber(session, keys.memory("*"), DEPTH)
        self._memories = pubsub.Inbox(memories, messages.LawMemory, keys=keys)
        self._poses = pubsub.subscriber(session, keys.pose("*"), DEPTH)
        self._run_events = pubsub.Inbox(pubsub.pose_subscriber(session, keys.event, 256, pubsub.EVENTS), messages.Event)
        self._world_events = pubsub.Inbox(pubsub.subscriber(session, keys.world_event, 256), messages.Event)
        self._worlds = pubsub.Inbox(pubsub.subscriber(session, keys.world, 8), messages.WorldState)
        self._contacts = pubsub.Inbox(pubsub.subscriber(session, keys.contact, 256), messages.Contact)
        self._conductor = pubsub.AliveWatch(session, keys.conductor)
        self._ranges: pubsub.Inbox[messages.Ranges] | None = None
        self._opened = self._rated = time.monotonic()
        self.robots, self.scans = {}, {}
        self.events = deque(maxlen=EVENTS)
        self.world, self.conducted = None, False
        self._touching: dict[tuple[str, str], tuple[float, Overlap]] = {}  # last time [s, monotonic] of each contact
        self._begin(SceneModel.of_robots(()))

    # ------------------------------------------------------------------ reception

    def update(self) -> bool:
        """Takes in what has arrived; returns whether another case has begun, with another stage."""
        now = time.monotonic()
        changed = self._read_experiment()
        for name, stands in self._feed.alive():
            report = self._report(name)
            report.alive = stands
            report.known |= stands
        for _, stands in self._conductor.changes():
            self.conducted = stands
        for status in self._feed.statuses.read():
            self._receive_status(status, now)
        self._read_states(now)
        for sample in received(self._poses.handler):
            sender = self._keys.robot_of(str(sample.key_expr))
            if sender is not None:
                report = self._report(sender)
                report.sent_at, report.sent = now, report.sent + 1
        self.events.extend(self._run_events.read())
        self.events.extend(self._world_events.read(validation.check_world_event))
        for world in self._worlds.read():
            self.world = world
        if self._ranges is not None:
            self.scans |= {scan.robot: scan for scan in self._ranges.newest()}
        if now - self._rated >= RATE_S:
            for report in self.robots.values():
                report.rate, report.sent = report.sent / (now - self._rated), 0
            self._rated = now
        if not changed and self.stage.plan is None and now - self._opened > UNKNOWN_S:
            names = tuple(sorted(name for name, report in self.robots.items() if report.known))
            if names != self.stage.names:
                self._begin(SceneModel.of_robots(names))
                changed = True
        return changed

    def _read_experiment(self) -> bool:
        changed = False
        for sample in received(self._experiments.handler):
            try:
                read = document.received(sample.payload.to_bytes().decode(), str(sample.key_expr))
            except (DocumentError, UnicodeDecodeError):
                continue  # another version: robots are drawn without it
            case, plan = next(iter(read.cases().items()))
            if (case, plan) != (self.case, self.stage.plan):
                self._begin(SceneModel.of_plan(plan), case)
                self.events.clear()
                changed = True
        return changed

    def _begin(self, stage: SceneModel, case: str = "") -> None:
        self.stage, self.case = stage, case
        before, self.robots = self.robots, {}
        for name in stage.names:
            self.robots[name] = before.get(name, RobotReport())
        for name, report in before.items():
            self.robots.setdefault(name, report)
        self._tracker, self._trail = LinkTracker(stage), Trail(len(stage.names))
        self._touching = {}
        self.age = DataAge()

    def _report(self, name: str) -> RobotReport:
        return self.robots.setdefault(name, RobotReport())

    def _receive_status(self, status: messages.Status, now: float) -> None:
        report = self._report(status.robot)
        if not self.conducted:  # else the conductor says so
            for incident in status.incidents_since(report.status):
                self.events.append(messages.Event(incident.stamp, "hazard", status.robot, incident.text))
        report.status, report.heard_at = status, now
        report.known = True

    def _read_states(self, now: float) -> None:
        states = list(self._feed.states.newest())
        if states:
            self.age.add(max(state.stamp for state in states), self._clock.utc(), now)
        for memory in self._memories.newest():
            self._report(memory.robot).memory = memory
        for state in states:
            report = self._report(state.robot)
            report.state, report.known = state, True
            for each in state.received:
                report.delay[each.sender] = each.arrived - each.stamp
        if states:
            self._find_contacts(now)

    def _find_contacts(self, now: float) -> None:
        """Contacts that the world reports, and those that the last positions show."""
        touching = self._touching
        for each in self._contacts.read():
            touching[each.first, each.second] = now, Overlap(each.first, each.second, each.overlap)
        position = drawn_columns(self.robots[name].state for name in self.stage.names)["position"]
        obstacles = self.stage.obstacles_at(self.elapsed or 0.0, self.world)
        for overlap in self.stage.overlaps(position, obstacles, self.world):
            if (overlap.first, overlap.second) not in touching:
                self.events.append(messages.Event(self.now(), "contact", overlap.first, f"touches {overlap.second}"))
            touching[overlap.first, overlap.second] = now, overlap
        self._touching = {pair: each for pair, each in touching.items() if now - each[0] < TOUCH_S}

    def watch_ranges(self, *, wanted: bool) -> None:
        """Receives range readings, or receives them no more."""
        if wanted and self._ranges is None:
            ranges = pubsub.subscriber(self._session, self._keys.ranges("*"), DEPTH)
            self._ranges = pubsub.Inbox(ranges, messages.Ranges, keys=self._keys)
        elif not wanted and self._ranges is not None:
            self._ranges.close()
            self._ranges = None
            self.scans.clear()

    # ------------------------------------------------------------------ what is drawn

    @property
    def started(self) -> float | None:
        """Common start [s, UTC]; None before it is known."""
        statuses = [report.status for report in self.robots.values() if report.status is not None]
        return min((status.started for status in statuses if status.started > 0.0), default=None)

    @property
    def elapsed(self) -> float | None:
        """Time since the common start [s]; None before it is known."""
        return None if (started := self.started) is None else self.now() - started

    @property
    def ended(self) -> bool:
        """Whether all robots have reported their end."""
        statuses = [self.robots[name].status for name in self.stage.names]
        return bool(statuses) and all(each is not None and each.phase == Phase.DONE.word for each in statuses)

    @property
    def phase(self) -> str:
        """Phase of the case by the conductor's last words, else by the clock; empty before the start."""
        last = next((event.text for event in reversed(self.events) if event.kind == "phase"), "")
        elapsed, plan = self.elapsed, self.stage.plan
        if last or elapsed is None or plan is None:
            return last
        return next((name for at, name in reversed(plan.experiment.phases) if elapsed >= at), "")

    def now(self) -> float:
        """Time [s, UTC] by the stamps of the statuses: that of a recording, where one is played."""
        heard = max(self.robots.values(), key=lambda report: report.heard_at, default=None)
        if heard is None or heard.status is None:
            return self._clock.utc()
        return heard.status.stamp + (time.monotonic() - heard.heard_at)

    @property
    def overlaps(self) -> list[Overlap]:
        """Robots that touch one another, an obstacle or a wall, or did a moment ago."""
        return [overlap for _, overlap in self._touching.values()]

    def condition(self, name: str) -> Condition:
        """Condition of a robot."""
        report, touches = self.robots[name], any(name in pair for pair in self._touching)
        silent = report.status is not None and time.monotonic() - report.heard_at > SILENT_S
        return condition(report.status, alive=report.alive or not report.known, silent=silent, touches=touches)

    def moment(self) -> Moment:
        now, stage = time.monotonic(), self.stage
        reports = [self.robots[name] for name in stage.names]
        columns = drawn_columns(report.state for report in reports)
        position = columns["position"]
        elapsed = self.elapsed
        error = self._tracker.errors(elapsed, position)
        self._trail.add(now, position)
        conditions = [self.condition(name) for name in stage.names]
        columns["goal"][np.isin(conditions, AT_REST)] = np.nan
        return Moment(
            **columns,
            condition=np.array(conditions, dtype=np.intp),
            silent_for=np.array([now - report.sent_at for report in reports]),
            error=error,
            broken=stage.broken_links(np.array(conditions), [report.status for report in reports]),
            obstacles=stage.obstacles_at(elapsed or 0.0, self.world),
            trail=self._trail.points,
            time=elapsed,
            places=stage.said_places([report.memory.variables for report in reports], position),
            measures=[report.memory.numbers for report in reports],
            overlaps=self.overlaps,
        )
