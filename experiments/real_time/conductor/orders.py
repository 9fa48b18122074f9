"""Orders to robots, to the world and to the conductor of a run, from outside of them; the emergency stop of a run."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, TypeVar

import zenoh

from agents.clock import wait_until
from agents.network import endpoints as topology
from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.shutdown import closing_cleanly
from experiments.real_time.hosts import run_registry

if TYPE_CHECKING:
    from experiments.real_time.hosts.launcher import Launcher
    from experiments.real_time.hosts.run_registry import RegisteredRun

REPLY_S: Final = 1.0
STARTING_S: Final = 10.0  # limit for routers that were just started: on a busy machine that takes seconds
LEAD_S: Final = 0.5  # time from the order to the common start: every robot has it by then
LEAD_EACH_S: Final = 0.01  # additional time for each robot
STOP_ANSWER_S: Final = 2.0
STOP_AGAIN_S: Final = 0.05
STOPPED: Final = "done"
UNKNOWN: Final = "NOT known to have stopped: cut its power, or `./zenpark estop`"
LOOK_S: Final = 0.2  # time for reports of robots without a token, which were landing
CHANGE_S: Final = 90.0  # a robot lands, its process ends, another starts, is ready, and climbs

R = TypeVar("R", messages.Reply, messages.WorldReply, messages.RunReply)


def start_lead_s(robots: int) -> float:
    """Time from the order to the common start of `robots` robots [s]."""
    return LEAD_S + LEAD_EACH_S * robots


def send_order(
    session: zenoh.Session, keys: Keys, robots: Sequence[str], order: messages.Order, wait_s: float = REPLY_S
) -> dict[str, messages.Reply]:
    """Give an order to robots, to all at once, and return their replies; a refusal, with why, for one that is silent.

    A robot that hangs costs the others no time: each has the order before the first answer is waited for.
    """
    asked = {robot: _ask(session, keys.order(robot), order, wait_s) for robot in robots}
    replies = {}
    for robot, answers in asked.items():
        reply, why = _read(answers, keys.order(robot), messages.Reply, robot)
        replies[robot] = reply or messages.Reply(robot, ok=False, phase="unknown", reason=why or "no answer")
    return replies


def send_stop_order(session: zenoh.Session, keys: Keys, robots: Sequence[str]) -> dict[str, messages.Reply]:
    """Order robots to stop and return their replies; a refusal for one that does not report in time that it stopped."""
    statuses = pubsub.pose_subscriber(session, keys.status("*"), 4096)
    inbox = pubsub.Inbox(statuses, messages.Status, keys=keys)
    replies = send_order(session, keys, robots, messages.Order("stop"))
    moving = {name for name, reply in replies.items() if reply.ok}
    deadline = time.monotonic() + STOP_ANSWER_S
    while moving and time.monotonic() < deadline:
        moving -= {status.robot for status in inbox.read() if status.phase == STOPPED}
        time.sleep(STOP_AGAIN_S)
    return replies | {name: messages.Reply(name, ok=False, phase="landing", reason=UNKNOWN) for name in moving}


def send_world_order(session: zenoh.Session, keys: Keys, order: messages.WorldOrder) -> messages.WorldReply:
    """Give an order to the world and return its reply; one that says no, and why, when it does not answer."""
    reply, why = _read(_ask(session, keys.world_order, order, REPLY_S), keys.world_order, messages.WorldReply)
    nobody = "no world answers: is `./zenpark world serve` running in this realm?"
    return reply or messages.WorldReply(ok=False, paused=False, time=0.0, reason=why or nobody)


def send_run_order(
    session: zenoh.Session, keys: Keys, order: messages.RunOrder, wait_s: float = CHANGE_S
) -> messages.RunReply:
    """Give an order to the conductor and return its reply when all is done, or that no conductor answers."""
    reply, why = _read(_ask(session, keys.run_order, order, wait_s), keys.run_order, messages.RunReply)
    nobody = (
        "no conductor answers: is `./zenpark run` running in this realm, at this router (--connect), and is this an "
        "operator (--as)?"
    )
    return reply or messages.RunReply(reason=why or nobody)


def _ask(
    session: zenoh.Session, key: str, order: messages.Order | messages.WorldOrder | messages.RunOrder, wait_s: float
) -> Iterable[zenoh.Reply]:
    """Replies to an order, of all that answer on its key.

    A storage of the network may answer as well. By default Zenoh asks the nearest complete queryable alone, and merges
    the replies on one key.
    """
    return session.get(
        key,
        payload=messages.encode(order),
        encoding=messages.JSON,
        timeout=wait_s,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
    )


def _read(asked: Iterable[zenoh.Reply], key: str, kind: type[R], robot: str | None = None) -> tuple[R | None, str]:
    """The first reply on the key, of `robot` if one is named, or the reason why there is none; empty: no answer."""
    why = ""
    for reply in asked:
        if reply.ok is not None and str(reply.ok.key_expr) == key:
            try:
                found = messages.decode(reply.ok.payload.to_bytes(), str(reply.ok.encoding), kind)
            except messages.Malformed as error:
                why = why or f"malformed reply: {error}"
            else:
                if getattr(found, "robot", None) == robot:
                    return found, ""
        elif reply.err is not None:
            why = reply.err.payload.to_bytes().decode(errors="replace")
    return None, why


def stop_publisher(session: zenoh.Session, keys: Keys) -> zenoh.Publisher:
    """The publisher of emergency stops, which overtake and wait for nothing."""
    return session.declare_publisher(
        keys.estop,
        encoding=messages.JSON,
        congestion_control=zenoh.CongestionControl.BLOCK,
        priority=zenoh.Priority.REAL_TIME,
        express=True,
    )


def alive(session: zenoh.Session, keys: Keys) -> set[str]:
    """Robots that are on the network."""
    replies = session.liveliness().get(keys.alive("*"), timeout=STOP_ANSWER_S)
    found = {keys.robot_of(str(reply.ok.key_expr)) for reply in replies if reply.ok is not None}
    return {robot for robot in found if robot is not None}


def _stopped(asked: Future[run_registry.StopReport | None] | None) -> set[str]:
    """Robots that the process of a run has reported as stopped: its router may end before their own words arrive."""
    report = asked.result() if asked is not None and asked.done() else None
    return set() if report is None else {*report.stopped}


@dataclass
class EmergencyStop:
    """An emergency stop of one run, or at some routers: over the network, and by the process of the run."""

    endpoints: Sequence[str]
    realm: str
    identity: str  # identity to show, in a lab
    run: RegisteredRun | None = None  # None: only the routers are known
    seen: set[str] = field(default_factory=set)  # robots of the run, or at the routers, that had to stop
    moving: set[str] = field(default_factory=set)  # those of them without a report of their stop
    # robots at the routers that are none of the run's, and those of them without a report
    strangers: set[str] = field(default_factory=set)
    moving_strangers: set[str] = field(default_factory=set)
    failure: Exception | None = None  # why the routers cannot be reached
    unreached: list[str] = field(default_factory=list)  # those of several routers that do not answer
    answered: bool = False  # whether the process of the run has taken the stop, which ends the run
    run_ended: bool = False  # whether it was asked to end, since neither it nor a robot has answered

    @property
    def where(self) -> str:
        return f"at {topology.describe(self.endpoints)}" if self.run is None else self.run.words

    @property
    def expected(self) -> bool:
        """Whether robots must be alive: the process of a run on this machine is."""
        return self.run is not None and self.run.what == "run" and self.run.alive

    @property
    def missed(self) -> bool:
        """Whether robots may go on: some have not reported, or the stop did not reach a run that is up."""
        silent = self.expected or (self.run is not None and self.failure is not None)
        doubt = (silent and not (self.seen or self.answered)) or (self.run is None and bool(self.unreached))
        return bool(self.moving or self.moving_strangers) or doubt

    def send(self, reason: str) -> None:
        """Send the stop both ways until every robot that is alive reports that it has stopped."""
        stop = messages.Stop(self.identity, reason)
        with ThreadPoolExecutor(1) as pool:  # neither way waits for the other
            asked = None if self.run is None else pool.submit(run_registry.tell, self.run, stop)
            self._at_each_router(lambda routers: self._send(routers, stop, lambda: _stopped(asked)))
            report = None if asked is None else asked.result()
        self._set_strangers_apart()
        unseen = not self.seen
        self._count_robots_of_run(report)
        if self.run is not None and self.expected and unseen and not self.answered:
            # between the cases of a mesh no member is there to receive the stop, and the next case would begin
            with suppress(OSError):
                os.kill(self.run.pid, signal.SIGTERM)
                self.run_ended = True

    def look(self) -> None:
        """Find the robots that the stop would reach; nothing is sent to them."""

        def see(routers: Sequence[str]) -> tuple[set[str], set[str]]:
            opened = network.open_session(routers, name="estop", wait_s=2.0, identity=self.identity)
            with closing_cleanly(opened) as (session, _):
                return alive(session, Keys(self.realm)), set()

        self._at_each_router(see)
        self._set_strangers_apart()

    def _at_each_router(self, act: Callable[[Sequence[str]], tuple[set[str], set[str]]]) -> None:
        """Act at all routers at once, and note which robots are there, and which of them move.

        Routers share their robots, unless the network between them is split.
        """

        def attempt(routers: Sequence[str]) -> tuple[set[str], set[str]] | Exception:
            try:
                return act(routers)
            except Exception as error:  # noqa: BLE001 - the others are stopped whatever happens to this one
                return error

        mesh = topology.is_mesh(self.endpoints)
        places = [self.endpoints] if mesh else [[endpoint] for endpoint in self.endpoints]
        with ThreadPoolExecutor(len(places)) as pool:
            results = [asked.result() for asked in [pool.submit(attempt, routers) for routers in places]]
        found = [result for result in results if not isinstance(result, Exception)]
        self.seen = set().union(*(seen for seen, _ in found))
        self.moving = self.seen - set().union(*(seen - moving for seen, moving in found))
        errors = [result for result in results if isinstance(result, Exception)]
        if errors and not found:
            self.failure = errors[0]
        elif errors:
            pairs = zip(places, results, strict=True)
            self.unreached = [topology.describe(routers) for routers, result in pairs if isinstance(result, Exception)]

    def _set_strangers_apart(self) -> None:
        """Set robots apart that are none of the run's: another run may have its router's address by now."""
        if self.run is not None and self.run.what == "run" and self.run.robots:
            robots = self.run.robots.keys()
            self.strangers, self.moving_strangers = self.seen - robots, self.moving - robots
            self.seen, self.moving = self.seen & robots, self.moving & robots

    def _count_robots_of_run(self, report: run_registry.StopReport | None) -> None:
        """Add what the process of the run has reported; without a router, robots that it did not start count as well.

        Without any answer all robots of a run that is up may go on.
        """
        self.answered = report is not None
        down = self.seen - self.moving
        if report is not None:
            self.seen |= {*report.robots}
            down |= {*report.stopped}
        doubt = self.failure is not None or (bool(self.unreached) and report is None)
        if self.run is not None and self.expected and (doubt or not (self.seen or self.answered)):
            self.seen |= self.run.robots.keys()
        self.moving = self.seen - down

    def _send(
        self, routers: Sequence[str], stop: messages.Stop, reported: Callable[[], set[str]]
    ) -> tuple[set[str], set[str]]:
        """Send it until no robot moves, by its own status or as `reported` by the process of the run.

        Returns the robots that are there, and those that move.
        """
        keys = Keys(self.realm)
        # a robot that does not answer must not delay the others' stop
        opened = network.open_session(routers, name="estop", wait_s=2.0, identity=self.identity, gather_s=0.0)
        with closing_cleanly(opened) as (session, declared):
            payload = messages.encode(stop)
            urgent = stop_publisher(session, keys)
            urgent.put(payload)
            statuses = pubsub.pose_subscriber(session, keys.status("*"), 4096)
            inbox = pubsub.Inbox(statuses, messages.Status, keys=keys)
            declared += [urgent, statuses]
            seen = alive(session, keys)
            moving = set(seen)
            begun = time.monotonic()  # begun after the question who is there, which may take as long
            watch = pubsub.AliveWatch(session, keys.alive("*"))
            while (now := time.monotonic()) < begun + STOP_ANSWER_S and (
                moving - reported() or now < begun + LOOK_S or self._awaited(session, begun)
            ):
                urgent.put(payload)
                time.sleep(STOP_AGAIN_S)
                for token, stands in watch.changes():
                    robot = keys.robot_of(token)
                    if robot is not None and stands and robot not in seen:
                        seen.add(robot)
                        moving.add(robot)
                for status in inbox.read():
                    if status.robot not in seen and status.reason.startswith(messages.EMERGENCY):
                        seen.add(status.robot)  # it has no token, because a hazard was landing it
                        moving.add(status.robot)
                    if status.phase == STOPPED:
                        moving.discard(status.robot)
        return seen, moving

    def _awaited(self, session: zenoh.Session, begun: float) -> bool:
        """Whether more members of a mesh may still be linked."""
        late = time.monotonic() > begun + network.GATHER_S
        return topology.is_mesh(self.endpoints) and not late and network.count_links(session) < len(self.endpoints)


class Emergency:
    """Reception of emergency stops."""

    def __init__(self) -> None:
        self.stop: messages.Stop | None = None  # the first one received
        self.launcher: Launcher | None = None  # launcher of the run's processes, while there is one

    def __bool__(self) -> bool:
        return self.stop is not None

    @property
    def words(self) -> str:
        """Sender and reason of the stop; empty without one."""
        return "" if self.stop is None else self.stop.words

    def listen(self, session: zenoh.Session, keys: Keys) -> pubsub.ImmediateSubscriber:
        """Receive stops in a realm until the subscriber is closed."""
        return pubsub.ImmediateSubscriber(session, keys.estop, self.receive)

    def guard(self, launcher: Launcher) -> None:
        """Pass stops on to the processes of a launcher from now on, with one that was received before."""
        self.launcher = launcher
        if self.stop is not None:
            launcher.stop(self.stop)

    def receive(self, stop: messages.Stop) -> None:
        """End the run, and pass the stop on to its processes by their lifelines: a router may keep it from robots."""
        self.stop = self.stop or stop
        if self.launcher is not None:
            self.launcher.stop(stop)

    def obey(self, stop: messages.Stop) -> run_registry.StopReport:
        """Receive a stop that needed no router; returns when all robots have stopped, or their time is over."""
        self.receive(stop)
        stopped = dict[str, bool] if self.launcher is None else self.launcher.stopped
        wait_until(lambda: all(stopped().values()), STOP_ANSWER_S, STOP_AGAIN_S)
        robots = stopped()
        return run_registry.StopReport(sorted(robots), sorted(name for name, down in robots.items() if down))

    @contextmanager
    def throughout(self, endpoints: Sequence[str], keys: Keys, identity: str, wait_s: float) -> Iterator[None]:
        """Receive stops by a session of its own: those of the cases are closed between them.

        `identity` is the name in the certificate, in a lab. Raises Unreachable if no router answers in `wait_s`.
        """
        opened = network.open_session(endpoints, name="emergency stops", identity=identity, wait_s=wait_s)
        with closing_cleanly(opened) as (session, declared):
            declared.append(self.listen(session, keys))
            yield
