"""The run as its conductor sees it: session, events to all others, and the state of each robot by its messages."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field
from math import inf
from typing import Final, Literal

import zenoh

from agents.clock import Clock, uptime, wait_until
from agents.decision.lifecycle import FINISHED, SCRIPTED, TOLD_TO_END, Phase
from agents.errors import ExplainedError
from agents.network import endpoints as topology
from agents.network import lab, messages, pubsub
from agents.network import session as network
from agents.network.endpoints import DEFAULT_ENDPOINT
from agents.network.keys import Keys
from agents.network.shutdown import closing_cleanly
from agents.runtime.lifeline import SILENCE_S, event_line
from experiments.definition import mesh
from experiments.file import document
from experiments.real_time.conductor import orders
from experiments.real_time.conductor.case_processes import CaseContext
from experiments.scene.condition import SILENT_S, Condition, condition

ORDER: Final = tuple(phase.word for phase in Phase)
AHEAD_S: Final = -0.02  # what comes before it was said is from a clock that is ahead [s],
BEHIND_S: Final = 0.1  # delay that shows one that is behind
OTHERS_S: Final = 3.0  # limit for the conductor of the case before to leave the network
LOOK_S: Final = 0.2  # pause of two looks for it
ROUTER_S: Final = 10.0  # limit for a router that was just started to answer
MISSED_S: Final = 1.0  # a robot that changes from one router to another is back sooner
STILL_S: Final = 3.0  # a recorder without a token for longer than this is killed, and started again
# beginnings of reasons for a landing that a user or the conductor wanted; every other one is a fault
ASKED: Final = (FINISHED, SCRIPTED, "ordered to ", messages.EMERGENCY, TOLD_TO_END)
OUTPUT: Final = "output"  # kind of the events that are a line of a process's output


@dataclass
class RobotView:
    """State of a robot as the conductor knows it."""

    status: messages.Status | None = None  # last received
    error: float | None = None  # [m] formation error by its own knowledge; None until it reports one
    linked: bool = True  # it has an error: it is not guided, and has links
    alive: bool = False  # its liveliness token stands
    # why the run goes on without it: not ready in time, process ended or token vanished, taken out, not asked for yet
    left_because: Literal["", "late", "lost", "removed", "standby"] = ""
    vanished: float = inf  # [s, monotonic] loss of its token; infinity while it stands, and once that was reported
    seen: float = inf  # [s, monotonic] first status of its process
    behind: float = inf  # [s] least time from a stamp to its arrival: small, if its clock is right
    note: str = ""  # last reported note of its body, without numbers
    place: messages.Vector | None = None  # [m] last known
    origin: messages.Setpoint | None = None  # start of the robot, or of its plan: x, y, z [m], yaw [rad]
    former: int | None = None  # process with outdated statuses: the robot has a new one, or will have
    began: float | None = None  # [s, UTC] stamp of its first tick in the experiment

    @property
    def gone(self) -> bool:
        """Whether the run goes on without it."""
        return bool(self.left_because)

    @property
    def clock_off(self) -> float:
        """Time by which its clock is behind [s]; 0 if it is right, as far as its messages show."""
        return 0.0 if AHEAD_S < self.behind < BEHIND_S or self.behind == inf else self.behind

    def silent(self, now: float) -> bool:
        """Whether its last status is old at `now` [s, UTC]; it has none before its process begins."""
        return self.status is not None and now - self.status.stamp > SILENT_S

    def condition(self, now: float) -> Condition:
        """Condition at `now` [s, UTC]."""
        return condition(self.status, left=self.left_because, silent=self.silent(now))

    @property
    def phase(self) -> str:
        return self.status.phase if self.status is not None else "starting"

    def reached(self, phase: str) -> bool:
        return self.status is not None and ORDER.index(self.status.phase) >= ORDER.index(phase)

    def forget_process(self) -> None:
        """Forget the process that has ended, except its last place and its origin."""
        self.former = self.status.pid if self.status is not None else self.former
        self.status, self.alive = None, False
        self.vanished, self.seen = inf, inf
        self.behind, self.began = inf, None


@dataclass
class Progress:
    """State of a run, to be shown."""

    case: str
    phase: str
    elapsed: float | None
    duration: float
    robots: dict[str, RobotView]
    events: list[messages.Event] = field(default_factory=list)
    states: list[messages.State] = field(default_factory=list)  # states of the last update
    silent_since: float = inf  # [s, monotonic] begin of the silence of the routers
    clock: Clock = field(default_factory=Clock)
    start: float | None = None  # [s, UTC] common start; None before it is known


class EventFeed:
    """Each event of a run once, whatever its case."""

    def __init__(self) -> None:
        self._shown, self._case = 0, ""

    def new_events(self, progress: Progress) -> list[messages.Event]:
        if progress.case != self._case:
            self._case, self._shown = progress.case, 0
        events = progress.events[self._shown :]
        self._shown = len(progress.events)
        return events


ShowProgress = Callable[[Progress], None]
ProgressDisplay = AbstractContextManager[ShowProgress]  # a live table takes the terminal over


class RunFailed(ExplainedError):
    """A run that could not begin or go on, with reason and remedy."""


def await_sole_conductor(session: zenoh.Session, keys: Keys) -> None:
    """Wait until no other conductor is in the realm: that of the case before is just leaving.

    Raises RunFailed if one stays: its robots would get the orders of both.
    """
    if not wait_until(lambda: not network.tokens_present(session, keys.conductor), OTHERS_S, LOOK_S):
        raise RunFailed(
            f"another run is up at this router, in the realm '{keys.realm}': its robots would take the orders of "
            "both; wait for its end, or choose another network.realm"
        )


class NetworkView:
    """The network as the conductor of a case sees it."""

    def __init__(self, stack: ExitStack, context: CaseContext, progress: Progress) -> None:
        """Join the network; `stack` leaves it."""
        self.clock, self.robots = progress.clock, progress.robots
        self._progress = progress
        self._launcher, self._begun = context.launcher, uptime()
        self._recorder = context.process("recorder")
        experiment, endpoints = context.plan.experiment, context.endpoints
        self._keys = keys = Keys(experiment.network.realm)
        identity, rights = context.identity, mesh.member_rights(context.plan, endpoints)
        opened = network.open_session(endpoints, name="conductor", wait_s=ROUTER_S, identity=identity, rights=rights)
        self.session, declared = stack.enter_context(closing_cleanly(opened))
        declared.append(self)
        session = self.session
        if experiment.network.connect is not None:  # a router of our own has no other runs
            await_sole_conductor(session, keys)
        self._events = pubsub.pose_publisher(session, keys.event, messages.JSON, pubsub.EVENTS)
        if list(endpoints) != [DEFAULT_ENDPOINT]:
            network_file = f"--connect @{context.folder / mesh.ENDPOINTS}"
            options = lab.options(endpoints[0]) if len(endpoints) == 1 else network_file
            where = "a mesh" if topology.is_mesh(endpoints) else ", ".join(lab.bare(endpoints))
            self.report("router", "conductor", f"{where}: look with `./zenpark keys {options}`")
        self._clock = pubsub.publisher(session, keys.clock, messages.JSON)
        self._experiment = pubsub.pose_publisher(session, keys.experiment, messages.JSON)
        self._experiment.put(document.case_document(context.plan, context.case))
        self.orders = pubsub.Orders(session, keys.run_order, messages.RunOrder)  # orders to the conductor
        self._token = pubsub.alive_token(session, keys.conductor)
        self._feed = pubsub.RobotFeed(session, keys, self.robots)
        self._recorder_watch = pubsub.AliveWatch(session, keys.recorder)
        self.recording_begun = False  # the recorder is there
        self._recorder_vanished = inf  # [s, monotonic] loss of its token; infinity while it stands, or before its first
        self._cut_off = -inf
        self._router = network.RouterWatch(session, keys.conductor, endpoints)
        self._safety, self._mesh = experiment.safety, topology.is_mesh(endpoints)

    @property
    def recorder_stands_still(self) -> bool:
        """Whether the recorder has been out of the network for long, although the router answers."""
        return time.monotonic() - max(self._recorder_vanished, self._cut_off) > STILL_S

    def await_recorder(self) -> None:
        """Forget the recorder, which has ended."""
        self.recording_begun, self._recorder_vanished = False, inf

    def refuse_joining(self) -> None:
        """Robots that join from now on wait for the next run."""
        self._experiment.undeclare()

    def update(self) -> list[str]:
        """Receive all since the last update; return the robots with a token that has vanished for good.

        Raises RunFailed if this process was suspended until its robots have landed; other ones may have their names
        now.
        """
        if self._launcher.last_silence > self._begun:
            raise RunFailed(
                f"this process stood still for more than {SILENCE_S:g} s; its robots have landed without it, and get "
                "no further order: robots of these names may belong to another run now"
            )
        for _, stands in self._recorder_watch.changes():
            self.recording_begun |= stands
            self._recorder_vanished = inf if stands else time.monotonic()
        for status in self._feed.statuses.read():
            self.receive_status(status)
        self._progress.states = list(self._feed.states.read())
        arrived = self.clock.utc()
        for state in self._progress.states:
            view = self.robots[state.robot]
            view.behind = min(view.behind, arrived - state.stamp)
            view.error = state.error if view.linked else None
            view.place = state.true_position or state.position or view.place
        for name, stands in self._feed.alive():
            if (known := self.robots.get(name)) is not None:
                known.alive, known.vanished = stands, inf if stands else time.monotonic()
        now = time.monotonic()
        self._watch_router(now)
        # with another router, a token comes back at once
        missed = [name for name, view in self.robots.items() if now - max(view.vanished, self._cut_off) > MISSED_S]
        for name in missed:
            self.robots[name].vanished = inf
        return missed

    def order(self, names: Sequence[str], order: messages.Order) -> dict[str, messages.Reply]:
        return orders.send_order(self.session, self._keys, names, order)

    def report(self, kind: str, source: str, text: str, stamp: float | None = None) -> None:
        """Report an event of the run, now or at `stamp` [s, UTC]; a conductor that is cut off reaches its recorder."""
        event = messages.Event(self.clock.utc() if stamp is None else stamp, kind, source, text)
        self._progress.events.append(event)
        self._events.put(messages.encode(event))
        self._launcher.tell(self._recorder, event_line(event))

    def report_clocks(self, clocks: Iterable[messages.HostClock]) -> None:
        """Report the offsets of the hosts' clocks, for the recording."""
        for each in clocks:
            self._clock.put(messages.encode(each))
            offset_ms, uncertainty_ms = each.offset * 1e3, each.uncertainty * 1e3
            self.report("clock", each.host, f"{offset_ms:+.2f} ms ± {uncertainty_ms:.2f} ms against ours")

    def report_drift(self, measured: Iterable[messages.HostClock], trouble: Iterable[str]) -> None:
        """Report, for the recording, the drift of the hosts' clocks and how their robots follow it."""
        for each in measured:
            self._clock.put(messages.encode(each))
        for text in trouble:
            self.report("clock", "conductor", text)

    def _watch_router(self, now: float) -> None:
        """Report once that the router is silent for longer than `neighbour_timeout_s`, and once that it is back."""
        since, progress = self._router.silent_since(now), self._progress
        if since < inf:
            self._cut_off = now
            safety = self._safety
            if progress.silent_since == inf and not self._mesh and now - since > safety.neighbour_timeout_s:
                progress.silent_since = since
                what = f"robots hold, and land after {safety.offline_s:g} s"
                self.report("router", "conductor", f"no router answers for {now - since:.1f} s: {what}")
        elif progress.silent_since < inf:
            away_s, progress.silent_since = now - progress.silent_since, inf
            self.report("router", "conductor", f"a router answers again, after {away_s:.1f} s")

    def receive_status(self, status: messages.Status) -> None:
        view = self.robots[status.robot]
        if status.phase not in ORDER or status.pid == view.former:
            return
        view.seen = min(view.seen, time.monotonic())
        now = self.clock.utc()
        view.behind = min(view.behind, now - status.stamp)

        def report(kind: str, text: str, at: float) -> None:
            """Report what was at a time of the robot's clock, of which the news may be late."""
            self.report(kind, status.robot, text, min(at + view.clock_off, now))

        if view.status is not None and _plain(view.status) != _plain(status):
            at = status.stamp if view.reached("landing") else status.ended or status.stamp
            report("robot", status.phase + (f": {status.reason}" if status.reason else ""), at)
        for incident in status.incidents_since(view.status):
            report("hazard", incident.text, incident.stamp)
        if _fell_out(view.status, status):
            report("hazard", f"land: {status.reason}", status.ended)
        note = messages.without_numbers(status.body)
        if note != view.note:
            view.note = note
            self.report("body", status.robot, status.body or "no trouble any more")
        if status.phase == Phase.RUNNING.word and view.phase != status.phase:
            view.began = status.stamp
        view.status = status
        view.origin = status.origin or view.origin


def _plain(status: messages.Status) -> tuple[str, str]:
    return status.phase, messages.without_numbers(status.reason)


def _fell_out(before: messages.Status | None, now: messages.Status) -> bool:
    """Whether a robot has landed for a fault that none of its hazards tells: its loop hung, or its starter is gone.

    Its process may have recovered, and know of the fault only from outside of its loop (`agents.runtime.watchdog`).
    """
    if before is None or before.pid != now.pid or before.phase not in ("ready", "airborne", "running"):
        return False
    reported = any(incident.text.startswith(("land: ", "cut: ")) for incident in now.incidents)
    return now.phase in ("landing", "done") and not (reported or now.reason.startswith(ASKED))
