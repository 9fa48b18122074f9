"""What the conductor hears of a run, and what it says: its session, and what becomes of each robot by what arrives."""

from __future__ import annotations

import time
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, Protocol, Self, TypeVar

import zenoh

from agents.clock import Clock
from agents.decision.lifecycle import Phase
from agents.network import endpoints as topology
from agents.network import lab, messages, pubsub
from agents.network import session as network
from agents.network.endpoints import DEFAULT_ENDPOINT
from agents.network.keys import Keys
from agents.network.shutdown import held
from agents.network.zenoh_config import ASK_S
from experiments.definition import mesh
from experiments.definition.experiment import Experiment
from experiments.file import document
from experiments.real_time.conductor import orders

M = TypeVar("M", messages.Status, messages.State, messages.Position, messages.Command)


def by_robots(
    handler: network.Polled[zenoh.Sample], kind: type[M], *, keys: Keys, robots: Container[str]
) -> Iterator[M]:
    """What has come on the keys of some robots; what is malformed, or says another name than its key, is left out."""
    for sample in network.received(handler):
        try:
            message = messages.decode(sample.payload.to_bytes(), str(sample.encoding), kind)
        except messages.Malformed:
            continue
        if message.robot in robots and keys.whose(str(sample.key_expr)) == message.robot:
            yield message


ORDER: Final = tuple(phase.word for phase in Phase)
FROZEN_S: Final = 3.0  # a robot whose status is older than this is shown as silent

Out = Literal["", "lost", "removed", "standby"]


@dataclass
class RobotView:
    """What the conductor knows of a robot.

    Attributes:
        status: Its last status.
        error: Formation error as the robot itself sees it [m]; None of one that is guided, and sees none.
        sent: Poses that it sent, and `rate` of them over the last second [1/s].
        alive: Whether its liveliness token stands.
        left_because: Why the run goes on without the robot: process ended or token vanished ("lost"), it was
            taken out ("removed"), or nobody asked for it yet ("standby").
        vanished: Since when its token is missing [s, monotonic]; infinity while it is not, and when that was told.
        behind: The least time from a stamp of it to its arrival [s]: small, if its clock is right.
        last_incident: Number of the last incident that was said.
        place: Where it last said that it was [m].
        origin: Where it, or its plan, began, as its last process said: x, y, z [m] and yaw [rad].
        former: The process whose statuses are of the past: the robot has a new one, or will have.
        began: Stamp of its first tick in the experiment, UTC [s].
    """

    status: messages.Status | None = None
    error: float | None = 0.0
    rate: float = 0.0
    alive: bool = False
    left_because: Out = ""
    counted: tuple[float, int] = (0.0, 0)
    vanished: float = inf
    behind: float = inf
    last_incident: int = 0
    place: messages.Vector | None = None
    origin: messages.Setpoint | None = None
    former: int | None = None
    began: float | None = None

    @property
    def gone(self) -> bool:
        """Whether the run goes on without it."""
        return bool(self.left_because)

    @property
    def phase(self) -> str:
        return self.status.phase if self.status is not None else "starting"

    def reached(self, phase: str) -> bool:
        """Whether it is in this phase or beyond."""
        return self.status is not None and ORDER.index(self.status.phase) >= ORDER.index(phase)

    def forget_process(self) -> None:
        """The process that it had is over: what it said last holds no more, but for where it was and began."""
        self.former = self.status.pid if self.status is not None else self.former
        self.status, self.alive, self.vanished = None, False, inf
        self.rate, self.counted, self.behind, self.last_incident = 0.0, (0.0, 0), inf, 0
        self.began = None


@dataclass
class Progress:
    """What there is to show of a run; `silent_since` says when the routers fell silent [s, monotonic], if they have."""

    case: str
    phase: str
    elapsed: float | None
    duration: float
    robots: dict[str, RobotView]
    events: list[messages.Event] = field(default_factory=list)
    silent_since: float = inf
    clock: Clock = field(default_factory=Clock)


class News:
    """Tells each event of a run once, whatever its case."""

    def __init__(self) -> None:
        self._told, self._case = 0, ""

    def new_events(self, progress: Progress) -> list[messages.Event]:
        """What has happened since it was asked last."""
        if progress.case != self._case:
            self._case, self._told = progress.case, 0
        events = progress.events[self._told :]
        self._told = len(progress.events)
        return events


Show = Callable[[Progress], None]


ROUTER_S: Final = 10.0
MISSED_S: Final = 1.0  # who changes from one router to another is back sooner


class NetworkView:
    """The network as the conductor of a case sees it."""

    def __init__(
        self,
        stack: ExitStack,
        experiment: Experiment,
        endpoints: Sequence[str],
        progress: Progress,
        folder: Path,
        *,
        identity: str,
        clock: Clock,
    ) -> None:
        """Join the network.

        Raises:
            Unreachable: If no router answers.
        """
        self.clock = clock
        self.robots, self._progress = progress.robots, progress
        self._keys = keys = Keys(experiment.network.realm)
        opened = network.open_session(
            endpoints,
            name="conductor",
            wait_s=ROUTER_S,
            identity=identity,
            rights=mesh.member_rights(experiment, endpoints),
        )
        self._session, declared = stack.enter_context(held(opened))
        declared.append(self)
        self._events = pubsub.pose_publisher(self._session, keys.event, messages.JSON, pubsub.EVENTS)
        if list(endpoints) != [DEFAULT_ENDPOINT]:
            options = lab.options(endpoints[0]) if len(endpoints) == 1 else f"--connect @{folder / mesh.ENDPOINTS}"
            where = "a mesh" if topology.is_mesh(endpoints) else ", ".join(lab.bare(endpoints))
            self.report("router", "conductor", f"{where}: look with `zenpark keys {options}`")
        self._clock = pubsub.publisher(self._session, keys.clock, messages.JSON)
        self._told = pubsub.pose_publisher(self._session, keys.experiment, messages.JSON)
        self._told.put(document.case_document(experiment))
        self.orders = pubsub.Orders(self._session, keys.run_order, messages.RunOrder)  # to the conductor
        self._token = pubsub.alive_token(self._session, keys.conductor)
        self._statuses = pubsub.pose_subscriber(self._session, keys.status("*"), 4096)
        self._states = pubsub.subscriber(self._session, keys.state("*"), 4096)
        self._watch = pubsub.AliveWatch(self._session, keys.alive("*"))
        self._recorder_watch = pubsub.AliveWatch(self._session, keys.recorder)
        self.recording_begun = False  # the recorder is there
        self._cut_off = -inf
        self._router = network.RouterWatch(self._session, keys.conductor, endpoints)
        self._safety, self._mesh = experiment.safety, topology.is_mesh(endpoints)

    @property
    def session(self) -> zenoh.Session:
        """Its session, for whoever hears more by it."""
        return self._session

    def refuse_joining(self) -> None:
        """Who joins from now on waits for the next run."""
        self._told.undeclare()  # type: ignore[no-untyped-call]

    def update(self) -> list[str]:
        """Take in what has arrived since the last update; return the robots whose token has vanished for good."""
        for sample in network.received(self._recorder_watch.handler):
            self.recording_begun |= sample.kind == zenoh.SampleKind.PUT
        for status in by_robots(self._statuses.handler, messages.Status, keys=self._keys, robots=self.robots):
            self._receive_status(status)
        for state in by_robots(self._states.handler, messages.State, keys=self._keys, robots=self.robots):
            seen = self.robots[state.robot]
            if seen.error is not None:
                seen.error = state.error
            seen.place = state.true_position or state.position or seen.place
        for sample in network.received(self._watch.handler):
            name = self._keys.whose(str(sample.key_expr))
            if name is not None and (known := self.robots.get(name)) is not None:
                known.alive = sample.kind == zenoh.SampleKind.PUT
                known.vanished = inf if known.alive else time.monotonic()
        return self._missed()

    def order(self, names: Sequence[str], order: messages.Order) -> dict[str, messages.Reply]:
        """Give an order to robots, see `orders.send_order`."""
        return orders.send_order(self._session, self._keys, names, order)

    def report(self, kind: str, source: str, text: str, stamp: float | None = None) -> None:
        """An event of the run, now or at `stamp` [s, UTC]."""
        event = messages.Event(self.clock.utc() if stamp is None else stamp, kind, source, text)
        self._progress.events.append(event)
        self._events.put(messages.encode(event))

    def report_clocks(self, clocks: Sequence[messages.HostClock]) -> None:
        """Report the offsets of the hosts' clocks, for the recording."""
        for each in clocks:
            self._clock.put(messages.encode(each))
            self.report(
                "clock", each.host, f"{each.offset * 1e3:+.2f} ms ± {each.uncertainty * 1e3:.2f} ms against ours"
            )

    def report_drift(self, measured: Iterable[messages.HostClock], trouble: Iterable[str]) -> None:
        """Report, for the recording, how the hosts' clocks have drifted and what their robots do about it."""
        for each in measured:
            self._clock.put(messages.encode(each))
        for text in trouble:
            self.report("clock", "conductor", text)

    def _missed(self) -> list[str]:
        """Robots whose token has been missing for long: where there is another router, it comes back at once."""
        now = time.monotonic()
        self._watch_router(now)
        missed = [name for name, seen in self.robots.items() if now - max(seen.vanished, self._cut_off) > MISSED_S]
        for name in missed:
            self.robots[name].vanished = inf
        return missed

    def _watch_router(self, now: float) -> None:
        """Report once that the router is silent for longer than `link_silence_s`, and once that it is back."""
        since, progress = self._router.silent_since(now), self._progress
        if since < inf:
            self._cut_off = now
            safety = self._safety
            if progress.silent_since == inf and not self._mesh and now - since > safety.link_silence_s:
                progress.silent_since = since
                what = f"robots hold, and land after {safety.offline_s:g} s"
                self.report("router", "conductor", f"no router answers for {now - since:.1f} s: {what}")
        elif progress.silent_since < inf:
            away_s, progress.silent_since = now - progress.silent_since, inf
            self.report("router", "conductor", f"a router answers again, after {away_s:.1f} s")

    def _receive_status(self, status: messages.Status) -> None:
        seen = self.robots[status.robot]
        if status.phase not in ORDER or status.pid == seen.former:
            return
        if seen.status is not None and (seen.status.phase, seen.status.reason) != (status.phase, status.reason):
            self.report("robot", status.robot, status.phase + (f": {status.reason}" if status.reason else ""))
        if seen.status is not None and seen.status.pid != status.pid:
            seen.last_incident = 0
        for incident in status.incidents:
            if incident.seq > seen.last_incident:
                seen.last_incident = incident.seq
                self.report("hazard", status.robot, incident.text)
        since, sent = seen.counted
        if status.stamp - since >= 0.9:
            seen.rate = max(0.0, (status.sent - sent) / (status.stamp - since)) if since else 0.0
            seen.counted = (status.stamp, status.sent)
        if status.phase == Phase.RUNNING.word and seen.phase != status.phase:
            seen.began = status.stamp
        seen.status = status
        seen.origin = status.origin or seen.origin
        seen.behind = min(seen.behind, self.clock.utc() - status.stamp)


class Emergency:
    """Listens for emergency stops as long as a run goes on, between its cases too."""

    def __init__(self) -> None:
        self.stop: messages.Stop | None = None  # the first one received

    def __bool__(self) -> bool:
        return self.stop is not None

    @property
    def words(self) -> str:
        """Who stopped the run, and why; empty if nobody has."""
        return "" if self.stop is None else self.stop.words

    def listen(self, session: zenoh.Session, keys: Keys) -> pubsub.ImmediateSubscriber:
        """Receive stops in a realm, for as long as what is returned is kept."""
        return pubsub.ImmediateSubscriber(session, keys.estop, self._receive_stop)

    @contextmanager
    def throughout(
        self, endpoints: Sequence[str], keys: Keys, identity: str, *, starting: bool = False
    ) -> Iterator[None]:
        """Receive stops by a session of its own: those of the cases are closed between them.

        Args:
            endpoints: Routers.
            keys: Of the realm.
            identity: Whose certificate is shown, in a lab.
            starting: The routers were started just now, which takes seconds on a busy machine.

        Raises:
            Unreachable: If no router answers.
        """
        wait_s = ROUTER_S if starting else ASK_S
        opened = network.open_session(endpoints, name="emergency stops", identity=identity, wait_s=wait_s)
        with held(opened) as (session, declared):
            declared.append(self.listen(session, keys))
            yield

    def _receive_stop(self, stop: messages.Stop) -> None:
        self.stop = self.stop or stop


OUTPUT: Final = "says"  # kind of the events that are a line of a process's output

if TYPE_CHECKING:
    pass


class Shown(Protocol):
    """A way to show progress; a context manager, because a live table takes the terminal over."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def __call__(self, progress: Progress) -> None: ...
