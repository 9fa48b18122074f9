"""The conductor of one case in real time: waits until all are ready, gives the common start, walks the phases, lands.

It decides nothing that a robot needs: if it dies, the robots land by themselves and the recorder finishes its file.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, TypeVar

import zenoh

from agents import lab, wire
from agents import session as network
from agents.keys import Keys
from experiments import hosts as machines
from experiments import orders
from experiments.assign import guided
from experiments.crew import Crew
from experiments.experiment import Experiment
from experiments.hosts import Hosts
from experiments.launcher import LAND_S, Launcher

POLL_S: Final = 0.05
LEAD_S: Final = 0.5  # from the order to the common start: every robot has it by then
CLIMB_S: Final = 15.0  # a robot that is not up after this will not come up
ROUTER_S: Final = 10.0
FROZEN_S: Final = 3.0  # a robot whose status is older than this is shown as silent
GO_ON_S: Final = 5.0  # robots count the deadline from when they run, which is later than the conductor

ADOPT_S: Final = 0.5
AHEAD_S: Final = -0.02  # what comes before it was said is from a clock that is ahead,
BEHIND_S: Final = 0.5  # and what always takes this long, from one that is behind
LEAVE_S: Final = 8.0  # so long may robots of the case before take to end
OUTPUT: Final = "says"  # kind of the events that are a line of a process's output

M = TypeVar("M", wire.Status, wire.State)

ORDER: Final = ("idle", "ready", "airborne", "running", "landing", "done")


class RunFailed(RuntimeError):
    """A run that could not begin, with what is missing and what to do."""


@dataclass
class Seen:
    """What the conductor knows of a robot.

    Attributes:
        status: Its last status.
        error: Formation error as the robot itself sees it [m]; None of one that is guided, and sees none.
        sent: Poses that it sent, and `rate` of them over the last second [1/s].
        alive: Whether its liveliness token stands.
        gone: Whether its process has ended or its token has vanished in mid-run.
        behind: The least time from a stamp of it to its arrival [s]: small, if its clock is right.
    """

    status: wire.Status | None = None
    error: float | None = 0.0
    rate: float = 0.0
    alive: bool = False
    gone: bool = False
    counted: tuple[float, int] = (0.0, 0)
    behind: float = float("inf")

    @property
    def phase(self) -> str:
        return self.status.phase if self.status is not None else "starting"

    def reached(self, phase: str) -> bool:
        """Whether it is in this phase or beyond."""
        return self.status is not None and ORDER.index(self.status.phase) >= ORDER.index(phase)


@dataclass
class Progress:
    """What there is to show of a run."""

    case: str
    phase: str
    elapsed: float | None
    duration: float
    robots: dict[str, Seen]
    events: list[wire.Event] = field(default_factory=list)


Show = Callable[[Progress], None]


@dataclass(frozen=True)
class Result:
    """How a case ended."""

    recording: Path
    interrupted: bool
    start: float | None
    ready_s: float | None
    lost: tuple[str, ...]


class Conductor:
    """Runs one case."""

    def __init__(
        self,
        experiment: Experiment,
        case: str,
        *,
        file: Path,
        source: Path,
        folder: Path,
        endpoints: Sequence[str],
        rights: Path | None = None,
        launcher: Launcher,
        hosts: Hosts,
        show: Show,
        interrupted: Callable[[], bool],
    ) -> None:
        """Prepares a case; nothing is started yet.

        Args:
            experiment: The case, overrides applied.
            case: Its name.
            file: The same as a file, for the processes.
            source: The experiment file as it was written, for the recording.
            folder: Where the recording goes.
            endpoints: Routers.
            rights: Who may do what, for a router that is started again, in a lab.
            launcher: Starts the processes; the process "router", if it has one, is restarted when it dies.
            hosts: Other machines, on which robots may be started.
            show: Called with the progress, about ten times a second.
            interrupted: Asked whether the user wants to end it.
        """
        self._experiment, self._case = experiment, case
        self._file = file
        self._recording = folder / f"{case}.mcap"
        self._endpoints = list(endpoints)
        self._hosts, self._show, self._interrupted = hosts, show, interrupted
        self._keys = Keys(experiment.network.realm)
        steered = guided(experiment)
        self._robots = {name: Seen(error=None if name in steered else 0.0) for name in experiment.robots}
        self._progress = Progress(case, "starting", None, experiment.duration_s, self._robots)
        self._crew = Crew(
            experiment,
            case,
            file=file,
            source=source,
            recording=self._recording,
            endpoints=self._endpoints,
            rights=rights,
            launcher=launcher,
            hosts=hosts,
        )

    def run(self) -> Result:
        """Runs the case to its end, or until the user interrupts it; the robots are down in any case.

        Raises:
            RunFailed: If robots are not ready in time and the file says that the run must not go on without them.
        """
        began = time.monotonic()
        self._progress.phase = "connecting the hosts" if self._experiment.hosts else "starting"
        clocks = self._hosts.join(self._experiment)
        start = ready = None
        try:
            self._crew.prepare(self._interrupted)
            with ExitStack() as stack:
                self._join(stack)
                self._adopt()
                self._crew.start()
                if self._until("ready", self._patience(), recorder=True):
                    ready = time.monotonic() - began
                    self._tell_clocks(clocks)
                    self._say("ready", "conductor", f"{self._count('ready')} robots after {ready:.2f} s")
                    self._order(wire.Order("takeoff"))
                    if self._until("airborne", CLIMB_S):
                        start = self._start()
                        self._walk(start)
                self._land()
                if start is not None:
                    clocks, trouble = self._hosts.clocks()
                    self._tell_clocks(clocks)
                    for each in trouble:
                        self._say("clock", "conductor", each)
        except RunFailed as failure:
            self._progress.phase = str(failure).partition(";")[0]  # ending the others takes a while: say it now
            self._progress.events.append(wire.Event(time.time(), "failed", "conductor", self._progress.phase))
            self._show(self._progress)
            raise
        finally:
            self._crew.end()
        gone = tuple(name for name, seen in self._robots.items() if seen.gone)
        return Result(self._recording, self._interrupted(), start, ready, gone)

    def _adopt(self) -> None:
        """Finds robots that were started by hand or at boot, which nobody needs to start.

        Raises:
            RunFailed: If one of them has flown already.
        """
        away = self._crew.away
        if self._experiment.network.connect is not None or away:  # a router of our own has nobody else
            self._progress.phase = "looking who is there"
            began = time.monotonic()
            while (past := time.monotonic() - began) < ADOPT_S or (self._flown() and past < LEAVE_S):
                self._look()
                time.sleep(POLL_S)
        if flown := self._flown():
            raise RunFailed(
                f"{', '.join(flown)}: on the network already, and {self._robots[flown[0]].phase}; a robot that was "
                "started by hand flies once: end its process and start it again, next time with --once"
            )
        there = {name for name, seen in self._robots.items() if seen.alive}
        for name in self._crew.adopt(there):
            said = f"is there already, {self._robots[name].phase}" if name in there else f"is started on {away[name]}"
            self._say("adopted", name, f"{said}; not started from here")

    def _flown(self) -> list[str]:
        """Robots that are there and have flown, or do."""
        return [name for name, seen in self._robots.items() if seen.alive and seen.reached("airborne")]

    def _tell_clocks(self, clocks: Sequence[wire.HostClock]) -> None:
        """Says how the hosts' clocks lie, for the recording."""
        for each in clocks:
            self._clock.put(wire.encode(each))
            self._say("clock", each.host, f"{each.offset * 1e3:+.2f} ms ± {each.uncertainty * 1e3:.2f} ms against ours")

    # ------------------------------------------------------------------ phases

    def _until(self, phase: str, limit_s: float, *, recorder: bool = False) -> bool:
        """Waits until every robot that is left has reached a phase; False if the user interrupted.

        Raises:
            RunFailed: If they have not in time, unless the file says to go on without them.
        """
        self._progress.phase = f"waiting until all are {phase}"
        deadline = time.monotonic() + limit_s
        while True:
            self._look()
            if self._interrupted():
                return False
            late = [name for name, seen in self._robots.items() if not (seen.reached(phase) or seen.gone)]
            gone = [name for name, seen in self._robots.items() if seen.gone]
            if gone and self._experiment.start.missing == "abort":
                raise RunFailed(self._excuse(gone, "could not start"))
            if not late and (not recorder or self._recording_begun):
                return True
            if time.monotonic() > deadline:
                if late and self._experiment.start.missing == "abort":
                    raise RunFailed(self._excuse(late, f"not {phase} after {limit_s:g} s"))
                for name in late:
                    self._say("late", name, f"not {phase} after {limit_s:g} s: {self._why(name)}")
                return True
            time.sleep(POLL_S)

    def _patience(self) -> float:
        """How long to wait until all are ready [s]: robots that go on without a neighbour say so after the deadline."""
        begin = self._experiment.start
        return begin.deadline_s + (GO_ON_S if begin.missing == "go-on" else 0.0)

    def _start(self) -> float:
        """One start time for all, in UTC; returns it."""
        for name, seen in self._robots.items():
            if not (seen.gone or AHEAD_S < seen.behind < BEHIND_S):
                remedy = "set it (NTP), or let zenpark start the robot: [hosts]"
                self._say("clock", name, f"its clock is {-seen.behind:+.2f} s off and it will start so; {remedy}")
        at = time.time() + LEAD_S
        self._say("start", "conductor", "common start", stamp=at)
        self._order(wire.Order("start", at=at), only="airborne")
        return at

    def _walk(self, start: float) -> None:
        """Follows the run to its end."""
        legs = sorted(self._experiment.timeline, key=lambda leg: leg.at_s)
        names = ["formation", *(f"{leg.robot} under way" for leg in legs)]
        times = [0.0, *(leg.at_s for leg in legs)]
        reached = -1
        end = start + self._experiment.duration_s
        self._progress.phase = "starting together"
        while (now := time.time()) < end + LAND_S and not self._interrupted():
            self._look()
            self._progress.elapsed = now - start
            while reached + 1 < len(times) and now - start >= times[reached + 1]:
                reached += 1
                self._progress.phase = names[reached]
                self._say("phase", "conductor", names[reached], stamp=start + times[reached])
            left = [seen for seen in self._robots.values() if not seen.gone]
            if all(seen.reached("landing") for seen in left):
                return
            time.sleep(POLL_S)

    def _land(self) -> None:
        """Everybody down."""
        self._told.undeclare()  # type: ignore[no-untyped-call]  # who joins from now on waits for the next
        self._progress.phase = "landing"
        self._say("phase", "conductor", "landing" + (" (interrupted)" if self._interrupted() else ""))
        if any(not (seen.gone or seen.reached("landing")) for seen in self._robots.values()):
            self._order(wire.Order("land"))
        deadline = time.monotonic() + LAND_S
        while time.monotonic() < deadline:
            self._look()
            if all(
                seen.gone or seen.reached("done") or seen.phase in ("starting", "idle")
                for seen in self._robots.values()
            ):
                break
            time.sleep(POLL_S)
        self._progress.phase = "done"
        self._show(self._progress)

    # ------------------------------------------------------------------ the network

    def _join(self, stack: ExitStack) -> None:
        keys = self._keys
        self._session = stack.enter_context(
            network.open_session(self._endpoints, name="conductor", wait_s=ROUTER_S, identity="operator")
        )
        self._events = network.pose_publisher(self._session, keys.event, wire.JSON, network.EVENTS)
        if self._endpoints != [network.DEFAULT_ENDPOINT]:
            there = self._endpoints[0]
            look = f"zenpark keys {lab.options(there)}"
            self._say("router", "conductor", f"{lab.bare([there])[0]}: look with `{look}`")
        self._clock = network.publisher(self._session, keys.clock, wire.JSON)
        self._told = network.pose_publisher(self._session, keys.experiment, wire.JSON)
        self._told.put(machines.document(self._experiment))
        self._token = network.alive_token(self._session, keys.conductor)
        self._statuses = network.pose_subscriber(self._session, keys.status("*"), 4096)
        self._states = network.subscriber(self._session, keys.state("*"), 4096)
        self._watch = network.alive_watch(self._session, keys.alive("*"))
        self._recorder_watch = network.alive_watch(self._session, keys.recorder)
        self._recording_begun = False

    def _look(self) -> None:
        """Takes in what has happened since the last look."""
        now = time.time()
        for sample in network.received(self._recorder_watch.handler):
            self._recording_begun |= sample.kind == zenoh.SampleKind.PUT
        for status in self._messages(self._statuses.handler, wire.Status):
            self._heed(status)
        for state in self._messages(self._states.handler, wire.State):
            if self._robots[state.robot].error is not None:
                self._robots[state.robot].error = state.error
        for sample in network.received(self._watch.handler):
            name = self._keys.whose(str(sample.key_expr))
            if name is not None and (seen := self._robots.get(name)) is not None:
                seen.alive = sample.kind == zenoh.SampleKind.PUT
                self._miss(name, seen)
        for death in self._crew.deaths():
            self._say(death.kind, death.source, death.text)
            if death.kind == "recorder":
                self._recording_begun = True  # nothing to wait for
            elif death.kind == "lost":
                self._robots[death.source].gone, self._robots[death.source].alive = True, False
        self._progress.events += [wire.Event(now, OUTPUT, place, line) for place, line in self._crew.output()]
        for name, seen in self._robots.items():
            if seen.gone and seen.alive and seen.status is not None and now - seen.status.stamp < 1.0:
                seen.gone = False  # somebody started it again
                self._say("back", name, "alive again")
        self._show(self._progress)

    def _messages(self, handler: network.Polled[zenoh.Sample], kind: type[M]) -> Iterator[M]:
        for sample in network.received(handler):
            try:
                message = wire.decode(sample.payload.to_bytes(), str(sample.encoding), kind)
            except wire.Malformed:
                continue
            if message.robot in self._robots and self._keys.whose(str(sample.key_expr)) == message.robot:
                yield message

    def _heed(self, status: wire.Status) -> None:
        seen = self._robots[status.robot]
        if status.phase not in ORDER:
            return
        if seen.status is not None and (seen.status.phase, seen.status.reason) != (status.phase, status.reason):
            self._say("robot", status.robot, status.phase + (f": {status.reason}" if status.reason else ""))
        since, sent = seen.counted
        if status.stamp - since >= 0.9:
            seen.rate = max(0.0, (status.sent - sent) / (status.stamp - since)) if since else 0.0
            seen.counted = (status.stamp, status.sent)
        seen.status = status
        seen.behind = min(seen.behind, time.time() - status.stamp)

    def _miss(self, name: str, seen: Seen) -> None:
        """The token of an adopted robot has vanished: all that is known of its end. Without a router all vanish."""
        there = seen.alive or seen.reached("landing")  # who is down before the others takes its token back
        if name in self._crew.adopted and not there and network.connected(self._session):
            seen.gone = True
            self._say("lost", name, "is not on the network any more")

    def _order(self, order: wire.Order, only: str | None = None) -> None:
        """Gives an order to every robot that is left; what is refused is said."""
        for name, seen in self._robots.items():
            if seen.gone or seen.status is None or (only is not None and not seen.reached(only)):
                continue
            reply = orders.give(self._session, self._keys, name, order)
            if not reply.ok:
                self._say("refused", name, f"{order.order}: {reply.reason}")

    def _say(self, kind: str, source: str, text: str, stamp: float | None = None) -> None:
        event = wire.Event(time.time() if stamp is None else stamp, kind, source, text)
        self._progress.events.append(event)
        self._events.put(wire.encode(event))

    # ------------------------------------------------------------------ words

    def _count(self, phase: str) -> int:
        return sum(seen.reached(phase) for seen in self._robots.values())

    def _why(self, name: str) -> str:
        status = self._robots[name].status
        if status is None:
            return "its process says nothing yet"
        return status.reason or f"it is {status.phase}"

    def _excuse(self, names: Sequence[str], what: str) -> str:
        lines = [f"{', '.join(names)}: {what}; nothing has moved or all have landed"]
        for name in names:
            last = self._crew.last_line(name)
            lines.append(f"  {name}: {self._why(name)}" + (f"\n    {last}" if last else ""))
        ended = all(self._robots[name].gone for name in names)
        remedy = "mend that" if ended else "give them more time with start.deadline_s"
        lines.append(f"  {remedy}, or go on without them with start.missing = 'go-on'")
        return "\n".join(lines)
