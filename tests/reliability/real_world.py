"""A round of the fault laboratory: real processes, an observer of their keys, and what the rules say about both.

`RealWorld` has the members of a simulated laboratory that faults and rules use.
"""

from __future__ import annotations

import contextlib
import itertools
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from heapq import heappop, heappush
from math import inf, nan
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import psutil  # type: ignore[import-untyped]
import zenoh

from agents.decision.lifecycle import DONE, LANDING, Phase
from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.keys import Keys
from agents.safety.hazards import OVER, QUIET_S, UNRESOLVED, Cause
from experiments.definition import mesh
from experiments.definition.plan import Plan
from experiments.metrics.measure import HOLDING
from tests.commands import ROOT, environment
from tests.reliability.spoilt_process import CABLE, CONDUCTOR, INSIDE, MODULE, OTHER, ROBOT, RUN, Levers, role_of
from tests.simulated.faults import Fault
from tests.simulated.kernel import KILLED
from tests.simulated.look import Look, Seen
from tests.simulated.rules import Rules
from tests.simulated.world import LOOK_S, OUTSIDE, World

BEGIN_S: Final = 90.0  # limit for the common start
GONE_S: Final = 60.0  # time after the end of a run in which its processes must have ended
SCAN_S: Final = 0.25  # period of looks at the list of processes
GAP_S: Final = 1.5  # longer than between two statuses of a robot that can be heard
KNOWN_S: Final = 0.3  # a robot that has told nothing for longer is not known
SLACK_S: Final = 1.0  # added to the limits of rules, and so many times the largest lateness of the laboratory itself:
LATENESSES: Final = 5.0
ALOFT_M: Final = 0.1  # height over its lowest place from which on a drone flies


class RealTime:
    """The clock of the machine as the kernel of a laboratory; `now` is set where a history is looked at again."""

    def __init__(self) -> None:
        self.processes: list[Any] = []
        self.crashes: list[Any] = []
        self.late_s = 0.0  # largest lateness of a call
        self.past: float | None = None
        self._due: list[tuple[float, int, Callable[..., object], tuple[Any, ...]]] = []
        self._count = itertools.count()

    @property
    def now(self) -> float:
        return time.time() if self.past is None else self.past

    def at(self, t: float, call: Callable[..., object], *args: Any) -> None:
        heappush(self._due, (t, next(self._count), call, args))

    def after(self, seconds: float, call: Callable[..., object], *args: Any) -> None:
        self.at(self.now + seconds, call, *args)

    def work(self) -> None:
        """Call what is due."""
        while self._due and self._due[0][0] <= self.now:
            t, _, call, args = heappop(self._due)
            self.late_s = max(self.late_s, self.now - t)
            call(*args)


class RealProcess:
    """A process of the machine, with the members of a simulated one that faults and rules use."""

    drift = wall = 0.0

    def __init__(self, world: RealWorld, handle: psutil.Process, name: str, robots: Sequence[str] = ()) -> None:
        self.name, self.pid, self.robots = name, handle.pid, robots
        self.handle, self._world = handle, world
        self.started, self.ended = world.now, inf
        self.end_code = 0
        self.out: list[str] = []
        self._pauses, self.cuts = list[list[float]](), list[list[float]]()  # begins and ends [s]
        self._late, self._levers = 0.0, Levers(world.levers, [*robots, name][0])

    @property
    def dead(self) -> bool:
        return self._world.now >= self.ended

    @property
    def code(self) -> int | None:
        return self.end_code if self.dead else None

    def _stood(self) -> list[list[float]]:
        return [each for each in self._pauses if each[0] <= self._world.now]

    @property
    def paused(self) -> bool:
        return any(end > self._world.now for _, end in self._stood())

    @property
    def paused_at(self) -> float:
        return max((begin for begin, _ in self._stood()), default=-inf)

    @property
    def resumed_at(self) -> float:
        return max((end for _, end in self._stood() if end <= self._world.now), default=-inf)

    def signal(self, number: int) -> None:
        with contextlib.suppress(psutil.NoSuchProcess):
            self.handle.send_signal(number)

    def pause(self) -> None:
        self._pauses.append([self._world.now, inf])
        self.signal(signal.SIGSTOP)

    def resume(self) -> None:
        for each in self._pauses:
            each[1] = min(each[1], self._world.now)
        self.signal(signal.SIGCONT)

    def kill(self) -> None:
        self.end_code = KILLED
        self.signal(signal.SIGKILL)

    @property
    def late(self) -> float:
        return self._late

    @late.setter
    def late(self, mean_s: float) -> None:
        self._late = mean_s
        self._levers.set("late", mean_s)

    def hang(self, number: int, seconds: float) -> None:
        self._levers.set("hang", [number, seconds])

    def cut(self, cut: bool) -> None:
        """Cut its cable, or mend it."""
        if cut:
            self.cuts.append([self._world.now, inf])
        for each in self.cuts:
            each[1] = min(each[1], inf if cut else self._world.now)
        with contextlib.suppress(psutil.NoSuchProcess):
            for cable in self.handle.children():
                if CABLE in cable.cmdline():
                    cable.send_signal(signal.SIGSTOP if cut else signal.SIGCONT)


def _gone(handle: psutil.Process) -> bool:
    with contextlib.suppress(psutil.NoSuchProcess):
        return not handle.is_running() or handle.status() == psutil.STATUS_ZOMBIE
    return True


class Effects(dict[str, Any]):
    """Faults of one kind that last, by their victim; each change is told."""

    def __init__(self, tell: Callable[[str, Any], object]) -> None:
        super().__init__()
        self._tell = tell

    def __setitem__(self, who: str, what: Any) -> None:
        super().__setitem__(who, what)
        self._tell(who, what)

    def pop(self, who: str, *default: Any) -> Any:
        self._tell(who, None)
        return super().pop(who, *default)


@dataclass
class Told:
    """A robot, by what it has told: changes in order of time, and what they have made of it."""

    changes: list[tuple[float, dict[str, Any]]] = field(default_factory=list)
    next: int = 0
    known_until: dict[int, float] = field(default_factory=dict)  # by process [s]
    gaps: list[tuple[float, float]] = field(default_factory=list)  # times in which its phase changed unseen [s]
    pid: int = 0
    phase: int = 0
    reason: str = ""
    hazards: dict[Cause, str] = field(default_factory=dict)
    start: float = inf
    place: tuple[float, float, float] = (nan, nan, nan)
    low: float = inf  # its lowest height [m]

    def advance(self, now: float) -> None:
        while self.next < len(self.changes) and self.changes[self.next][0] <= now:
            for name, value in self.changes[self.next][1].items():
                if name == "hazard":
                    self._change_hazard(value)
                else:
                    setattr(self, name, value)
            self.low = min(self.low, self.place[2])
            self.next += 1

    def _change_hazard(self, text: str) -> None:
        outcome, _, words = text.partition(": ")
        cause = next((each for each in Cause if words.startswith(each.rule.words)), None)
        if outcome in {"land", "cut", UNRESOLVED}:
            self.phase = max(self.phase, LANDING)
        if cause is not None and outcome in {OVER, UNRESOLVED}:
            self.hazards.pop(cause, None)
        elif cause is not None:
            self.hazards[cause] = text

    @property
    def aloft(self) -> bool:
        return self.phase < DONE and self.place[2] > self.low + ALOFT_M  # one with its motors off may still fall

    @property
    def worst(self) -> str:
        order = ("warn", "hold", "land", "cut")
        return max(self.hazards.values(), key=lambda text: order.index(text.partition(":")[0]), default="")


class RealWorld(World):
    """The laboratory of one round: processes of this machine, and an observer of their keys."""

    kernel: Any
    robots: Any

    def __init__(self, folder: Path, plan: Plan, case: str, script: Sequence[Fault], words: Sequence[str]) -> None:
        super().__init__(RealTime(), script, varied=False, clocks={})  # type: ignore[arg-type]
        self.folder, self.plan, self.cases = folder, plan, [case]
        self.levers = folder.parent / f"{folder.name}-levers"
        self.levers.mkdir(parents=True)
        for who in {fault.who for fault in script if fault.kind in INSIDE}:
            Levers(self.levers, who).set("kinds", [fault.kind for fault in script if fault.who == who])
        self.network: Any = self  # of cables
        self.told = {name: Told() for name in plan.names}
        self._errors = (self.levers / "stderr").open("w")
        command = [sys.executable, "-m", MODULE, str(self.levers), RUN, "run", *words, "--out", str(folder)]
        self._popen = self._start(command, stderr=self._errors, stdout=self._errors)
        self.conductor = RealProcess(self, psutil.Process(self._popen.pid), CONDUCTOR)  # type: ignore[assignment]
        self.kernel.processes.append(self.conductor)
        self._commands: list[tuple[subprocess.Popen[str], RealProcess]] = [(self._popen, self.conductor)]  # type: ignore[list-item]
        self._keys, self._scan_at = Keys(plan.experiment.network.realm), 0.0
        self._session: zenoh.Session | None = None
        self._inboxes: list[tuple[Any, Callable[[Any], None]]] = []
        self._hangs = itertools.count(1)
        self._statuses: dict[str, messages.Status] = {}
        self._misread = list[tuple[float, str, Any]]()
        self.readings, self.disks = Effects(self._misread_body), Effects(self._spoil_disk)
        self._schedule("launch")

    def _start(self, command: Sequence[str], **streams: Any) -> subprocess.Popen[str]:
        given = {"stdin": subprocess.DEVNULL, "cwd": ROOT, "env": environment(), **streams}
        return subprocess.Popen(command, text=True, start_new_session=True, **given)

    # ------------------------------------------------------------------ as a script sees it

    def process(self, who: str) -> Any:
        same = [each for each in self.kernel.processes if who == each.name or who in each.robots]
        return next((each for each in reversed(same) if not (each.dead or each.name.startswith("second"))), None)

    def sessions(self, who: str) -> Any:
        process = self.process(who)
        return [] if process is None else [process]

    def cut(self, session: RealProcess, cut: bool = True) -> None:
        session.cut(cut)

    def signal(self, process: Any, number: int) -> None:
        process.signal(number)

    def _misread_body(self, who: str, made: Any) -> None:
        self._misread.append((self.now, who, made))
        Levers(self.levers, who).set("body", made and {who: made})

    def _spoil_disk(self, who: str, fault: Any) -> None:
        Levers(self.levers, who).set("disk", fault)

    def hang(self, process: Any, seconds: float) -> None:
        process.hang(next(self._hangs), seconds)

    def start_second(self, name: str, wall: float) -> None:
        if (process := self.process(name)) is not None:
            with contextlib.suppress(psutil.NoSuchProcess):
                words = process.handle.cmdline()
                words = words[words.index("-m") + 1 :]
                words = words[words.index(ROBOT) :] if ROBOT in words else words
                more = ["--once", "--clock-correction", str(wall)]
                words = [word for word in words if word and word != "--lifeline"]
                self._watch([sys.executable, "-m", *words, *more], f"second {name}", [name])

    def operate(self, words: Sequence[str], who: str) -> None:
        if (file := self.folder / mesh.ENDPOINTS).exists():
            connect = ["--connect", f"@{file}"] if words[0] in {"robot", "estop", "world"} else []
            command = [sys.executable, "-m", RUN, *words, *connect]
            made = self._watch(command, f"operator {len(self.answers) + 1}")
            self.answers.append((self.now, who, " ".join(words), made))  # type: ignore[arg-type]

    def _watch(self, command: Sequence[str], name: str, robots: Sequence[str] = ()) -> RealProcess:
        output = (self.levers / f"{len(self._commands)}.out").open("w")
        popen = self._start(command, stdout=output, stderr=output)
        process = RealProcess(self, psutil.Process(popen.pid), name, robots)
        self._commands.append((popen, process))
        self.kernel.processes.append(process)
        return process

    # ------------------------------------------------------------------ as an observer sees it

    def fly(self, duration_s: float) -> None:
        """Do the script to the run, until all its processes have ended."""
        limit = self.now + BEGIN_S
        try:
            while not self.conductor.dead and self.now < limit:
                if "start" in self.moments:
                    limit = self.moments["start"] + duration_s + GONE_S
                self._work()
            over = self.now + GONE_S
            while self._left() and self.now < over:
                self._work()
        finally:
            self._end()

    def _left(self) -> list[Any]:
        return [each for each in self.kernel.processes if not (each.dead or each.name.startswith(OUTSIDE))]

    def _work(self) -> None:
        self.kernel.work()
        if self.now >= self._scan_at:
            self._scan_at = self.now + SCAN_S
            self._scan()
        if self._session is None and (file := self.folder / mesh.ENDPOINTS).exists() and file.read_text("utf-8"):
            self._observe(file.read_text("utf-8").split())
        for inbox, keep in self._inboxes:
            for message in inbox.read():
                keep(message)
        time.sleep(0.01)

    def _scan(self) -> None:
        """Find processes that have begun or ended."""
        known = {process.pid for process in self.kernel.processes}
        with contextlib.suppress(psutil.NoSuchProcess):
            for each in psutil.Process(self._popen.pid).children():
                with contextlib.suppress(psutil.NoSuchProcess):
                    role = role_of(each.cmdline()) if each.pid not in known else OTHER
                    if role not in {OTHER, CONDUCTOR}:
                        self.kernel.processes.append(self._made(each, role))
        for popen, process in self._commands:
            if process.ended == inf and popen.poll() is not None:
                process.ended, process.end_code = self.now, popen.returncode
                self.ends[process.pid] = self.now
        children = {process.pid for _, process in self._commands}  # only of these the end is known by now
        for process in self.kernel.processes:
            if process.ended == inf and process.pid not in children and _gone(process.handle):
                process.ended = self.ends[process.pid] = self.now

    def _made(self, handle: psutil.Process, role: str) -> RealProcess:
        robots = [name for name in role.split("+") if name in self.told]
        links = handle.cmdline().count("--connect") if role == "router" else 0  # with the routers before it
        return RealProcess(self, handle, f"{role}{links + 1}" if links else role, robots)

    def _observe(self, endpoints: Sequence[str]) -> None:
        with contextlib.suppress(network.Unreachable):
            self._session = session = network.open_session(endpoints, name="chaos", identity="operator")
            feed = pubsub.RobotFeed(session, self._keys)
            events = pubsub.Inbox(pubsub.subscriber(session, self._keys.event), messages.Event)
            self._inboxes += [
                (feed.statuses, self._keep_status), (feed.states, self._keep_state), (events, self._keep_event)
            ]  # fmt: skip

    def _keep_status(self, status: messages.Status) -> None:
        told, last = self.told[status.robot], self._statuses.get(status.robot)
        phase = Phase[status.phase.upper()]
        if last is None or (last.pid, last.phase) != (status.pid, status.phase):
            self.phases.append((status.stamp, status.robot, status.pid, phase, status.reason))
            if last is not None and last.pid == status.pid and status.stamp - last.stamp > GAP_S:
                told.gaps.append((last.stamp, status.stamp))
        self._statuses[status.robot] = status
        for incident in status.incidents_since(last):
            over = incident.text.startswith(OVER)
            told.changes.append((incident.stamp - QUIET_S * over, {"hazard": incident.text}))
        change = {"pid": status.pid, "phase": phase, "reason": status.reason}
        told.changes.append((status.stamp, {**change, "start": status.started or inf}))
        told.known_until[status.pid] = max(told.known_until.get(status.pid, 0.0), status.stamp)

    def _keep_state(self, state: messages.State) -> None:
        if state.true_position is not None:
            self.told[state.robot].changes.append((state.stamp, {"place": state.true_position}))

    def _keep_event(self, event: messages.Event) -> None:
        if event.kind in {"ready", "start"}:
            self.reach(event.kind, event.stamp)
        elif event.kind == "phase" and event.text.startswith("landing"):
            self.reach("landing", event.stamp)
        elif event.kind == "stop":
            self.stops.append(event.stamp)

    def _end(self) -> None:
        for popen, process in self._commands:
            process.resume()
            if process.name.startswith("second"):
                popen.terminate()
        for process in self.kernel.processes:
            if process.ended == inf and process is not self.conductor:
                process.signal(signal.SIGCONT)
        if self._session is not None:
            self._session.close()
        self._scan()
        self.finished = self.now
        for process in self.kernel.processes:
            process.signal(signal.SIGKILL)
        for popen, _ in self._commands:
            popen.wait()
        self._errors.close()
        for number, (_, process) in enumerate(self._commands):
            file = self.levers / (f"{number}.out" if number else "stderr")
            process.out.append(file.read_text("utf-8"))
        logs = {file.stem.removeprefix(f"{self.cases[0]}-"): file for file in (self.folder / "logs").glob("*.log")}
        for process in self.kernel.processes:
            if not process.out and process.name in logs:
                process.out.append(logs[process.name].read_text("utf-8"))

    # ------------------------------------------------------------------ afterwards

    @property
    def slack_s(self) -> float:
        """Tolerance of the rules, by the lateness of this process on the same machine [s]."""
        return SLACK_S + LATENESSES * float(self.kernel.late_s)

    def judge(self) -> list[str]:
        """Look at what was seen again, and ask the rules."""
        for told in self.told.values():
            told.changes.sort(key=lambda change: change[0])
        self.disks = dict.fromkeys(fault.who for fault in self.script if fault.kind == "disk")
        rules = Rules(self, RealLook(self, self.slack_s))
        t = self.moments["launch"]
        while t < self.finished:
            self.kernel.past = t
            last = {who: made for at, who, made in self._misread if at <= t}
            self.readings = {who: made for who, made in last.items() if made is not None}
            for told in self.told.values():
                told.advance(t)
            for watch in self.watchers:
                watch()
            t += LOOK_S
        self.kernel.past = self.finished
        rules.judge(self.folder)
        killed = {process.pid for process in self.kernel.processes if process.end_code == KILLED}
        aloft = [name for name, told in self.told.items() if told.aloft and told.pid not in killed]
        rules.violations += [("robots-are-down", self.finished, f"{name} was last seen aloft") for name in aloft]
        zero = self.moments.get("start", self.moments["launch"])
        return [f"{name} at {t - zero:.1f} s: {text.strip()[:300]}" for name, t, text in rules.violations]


class RealLook(Look):
    """What an observer of the keys has seen."""

    world: Any

    def __init__(self, world: RealWorld, slack_s: float) -> None:
        super().__init__(world, slack_s)
        self._kinds = dict(zip(world.told, world.plan.kinds, strict=True))  # type: ignore[union-attr]

    def seen(self) -> Iterator[Seen]:
        for name, told in self.world.told.items():
            process = next((each for each in self.world.kernel.processes if each.pid == told.pid), None)
            known = self.now <= told.known_until.get(told.pid, -inf) + KNOWN_S
            known = known and not any(begin < self.now < end for begin, end in told.gaps)
            if process is None or process.dead or process.paused or not known:
                self.forget(name)
                continue
            kind = self._kinds[name]
            flying = kind.flies and told.aloft
            motion = None if told.low == inf else SimpleNamespace(position=told.place, flying=flying)
            held = any(told.hazards.get(each, "").startswith("hold") for each in HOLDING)
            yield Seen(
                name, process, kind, self.before(name, process, told.phase), told.phase, told.worst, held, True,
                told.reason, told.start, motion,
            )  # fmt: skip

    def _link(self, process: Any, *, slowly: bool) -> bool:
        routers = [each for each in self.world.kernel.processes if each.name.startswith("router")]
        served = any(not (each.dead or each.paused) for each in routers if each.started <= self.now)
        return served and not any(begin <= self.now < end for begin, end in process.cuts)
