"""A round of the fault laboratory: one run, in a process of its own that may be killed.

Robots live in one world, so that the body of a robot whose process is dead, frozen or cut off stays in the room. They
reach their routers through cables (`tools.reliability.cables`).
"""

from __future__ import annotations

import contextlib
import math
import subprocess
import sys
import time
from collections.abc import Callable, Set
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from agents.arrays import Array
from agents.network import messages
from agents.network import session as network
from experiments.definition.plan import Plan
from tools.reliability.chaos_report import FaultResult, RoundResult, line, recording_faults
from tools.reliability.fault_script import Fault, Round
from tools.reliability.injection import Setting, SpoiltRun
from tools.reliability.observer import Observer
from tools.reliability.run_process import WatchedRun

POLL_S: Final = 0.02
BEGIN_S: Final = 100.0  # to the common start
FORM_S: Final = 45.0  # a formation that has not come together by then does not: avoidance takes its time
HEAL_S: Final = 30.0  # the formation stands again at most so long after the end of a fault
SETTLED_S: Final = 0.5  # and stays so
FRESH_S: Final = 1.6  # a robot without a status for longer is not back: statuses come once a second
HELD_M: Final = 0.25  # largest distance of a robot that no process steers
NOTICE_S: Final = 1.0  # after which it must have stopped
FEWEST: Final = 3  # running robots with which a round goes on
LATEST_S: Final = 4.0  # before the end no fault is begun that could not heal
LEAD_S: Final = 1.0  # the start is announced not longer before
DEAF_S: Final = 1.0  # after the return of a robot its receivers have a pose of it
NOTICED_S: Final = 1.0  # a robot without a router holds `link_silence_s` and so much later
REFUSED: Final = 2  # exit code of a process whose name is taken
LANDED_S: Final = 40.0  # after the launcher's death or the end everything is gone
LAST_BREATH_S: Final = 5.0  # from when a process cannot be found any more to when its exit code is known
END_S: Final = 60.0  # and no round takes longer than this after its time


class _Over(Exception):
    """The run has ended, or goes on without end."""


@dataclass
class _ActiveFault:
    """A fault that was begun; all times are monotonic [s]."""

    fault: Fault
    victim: str
    begun: float
    at_s: float  # since the common start
    there: set[str]  # robots under way before
    events: int  # that had happened before
    incidents: dict[str, int]  # number of the last incident of each robot before
    note: str = ""
    utc: float = 0.0  # [s] by the wall clock, when it was done
    lifted: float = 0.0
    held_at: Array | None = None
    restarted: float | None = None
    back: float | None = None
    violations: list[str] = field(default_factory=list)

    def add_violation(self, text: str) -> None:
        """A violation of an invariant, reported once."""
        if text not in self.violations:
            self.violations.append(text)


class ChaosRound:
    """A round.

    Attributes:
        outcomes: Of the faults that were done.
    """

    def __init__(self, setting: Setting, script: Round, number: int) -> None:
        self._setting, self._script, self._number = setting, script, number
        self.outcomes: list[FaultResult] = []
        self._left = list(script.faults)
        self._wrong: list[str] = []
        self._events: list[messages.Event] = []
        self._dead: dict[str, float] = {}  # killed by us, and when
        self._off: set[str] = set()  # robots whose clock is not that of the others
        self._conductor_dead = self._disk_full = False
        self._now: _ActiveFault | None = None
        self._started: float | None = None
        self._senders: dict[str, set[str]] = {name: set() for name in setting.experiment.robots}
        for link in Plan(setting.experiment).one_way_links:
            self._senders[link.receiver].add(link.sender)

    def run(self) -> RoundResult:
        """Run the round to its end; no process is left behind."""
        setting = self._setting
        folder = setting.folder / f"round-{self._number:03}"
        nearest, missed = math.inf, 0.0
        with ExitStack() as stack:
            run = self._run = SpoiltRun(stack, setting, self._script, folder, [setting.seed, self._number])
            try:
                with network.open_session(run.routers, name="chaos", wait_s=BEGIN_S) as session:  # routers wait for it
                    self._observer = Observer(session, setting.experiment)
                    with contextlib.suppress(_Over):
                        self._follow()
                    nearest, missed = self._observer.invariants.nearest, self._missed_share()
            except network.Unreachable as error:
                self._wrong.append(f"it never began: {error}; {run.watched.process.tail()}")
            if self._now is not None:  # put back: its recovery was not observed before the run ended
                active = self._now
                self._wrong += [f"{active.fault.kind} {active.victim}: {text}" for text in active.violations]
                self._left.insert(0, active.fault)
            run.release()
            gone_s = self._finish(run.watched)
        if self._started is not None:
            self._wrong += recording_faults(run.recording, self.outcomes, disk_full=self._disk_full)
        for each in self._wrong:
            print(f"round {self._number}: {each}", file=sys.stderr)
        kept = folder.name if run.recording.exists() else ""
        return RoundResult(self._number, self._left, self._wrong, round(nearest, 4), round(gone_s, 1), missed, kept)

    # ------------------------------------------------------------------ the run

    def _follow(self) -> None:
        """Inject the faults of the script, one after the other, until it is through or the run's time is over."""
        experiment = self._setting.experiment
        began = time.monotonic()
        while self._started is None:
            self._poll()
            self._observer.violations()  # robots are placed
            if time.monotonic() > began + BEGIN_S:
                self._wrong.append(f"no common start within {BEGIN_S:g} s")
                return
        well, why = self._settle(self._not_formed, FORM_S)
        if why:
            self._wrong.append(f"not in formation {FORM_S:g} s after the start ({why}): no fault was done")
            return
        while self._left and not self._conductor_dead:
            nature, t = self._left[0].properties, self._poll()
            if self._setting.interrupted() or t > experiment.duration_s - nature.lasts_s - max(
                LATEST_S, nature.heals_s
            ):
                return
            if time.monotonic() >= well + self._left[0].after_s:
                running = self._observer.running() - self._dead.keys()
                if len(running) < FEWEST:
                    return
                self._do(self._left.pop(0), t, running)
                well = time.monotonic()

    def _poll(self) -> float:
        """Wait a moment, and take in what has happened; return the time since the common start [s]."""
        if not (self._run.watched.process.alive or self._conductor_dead):
            raise _Over
        time.sleep(POLL_S)
        self._observer.update()
        now = time.monotonic()
        for event in self._run.watched.news():
            self._events.append(event)
            if event.kind == "start":
                self._started = now + max(0.0, min(LEAD_S, event.stamp - time.time()))
        if self._started is None:
            return 0.0
        self._judge(now)
        if now - self._started > self._setting.experiment.duration_s + END_S:
            self._wrong.append(f"it does not end {END_S:g} s after its time")
            raise _Over
        return now - self._started

    def _settle(self, reason: Callable[[float], str], limit_s: float) -> tuple[float, str]:
        """Wait until there has been no `reason` against it for a while; return since when, else the last reason.

        Args:
            reason: By the time since the common start [s].
            limit_s: Since the common start, or `FORM_S` since the leader began to drive: with avoidance, robots need up
                to 35 s to come up with it, without any fault.
        """
        since, last = None, ""
        while True:
            t, now = self._poll(), time.monotonic()
            why = reason(t)
            since, last = None if why else (since or now), why or last
            if since is not None and now >= since + SETTLED_S:
                return since, ""
            driven = max((leg.at_s for leg in self._setting.experiment.timeline if leg.at_s <= t), default=-math.inf)
            if t > max(limit_s, driven + FORM_S) and why:
                return now, last

    def _judge(self, now: float) -> None:
        """Add new violations to the active fault, or to the round."""
        wrong = self._observer.violations()
        for name, since in self._dead.items():
            command = self._observer.command.get(name)
            if command is not None and command[1] > since + NOTICE_S and now < command[1] + POLL_S * 5:
                wrong.append(f"{name} is dead and still commands its body")
        target = self._wrong if self._now is None else self._now.violations
        target += [each for each in wrong if each not in target]

    def _do(self, fault: Fault, t: float, running: set[str]) -> None:
        """Inject a fault, lift it when its time is over, and wait until all is well."""
        observer, victim = self._observer, fault.victim
        if victim:
            names = observer.invariants.names
            victim = next(name for name in (*names, *names)[names.index(victim) :] if name in running)
        observer.orders.clear()
        last = {name: status.incidents[-1].seq for name, status in observer.status.items() if status.incidents}
        active = self._now = _ActiveFault(fault, victim, time.monotonic(), t, running, len(self._events), last)
        active.note, active.utc = self._run.begin(fault, victim, observer.session), time.time()
        if fault.kind == "kill":
            self._dead[victim] = active.begun
        self._disk_full |= fault.kind == "disk"
        self._conductor_dead = fault.kind == "conductor"
        while time.monotonic() < active.begun + fault.lasts_s:
            t = self._poll()
            if fault.kind in ("freeze", "partition"):
                self._check_held(active)
        self._run.end(fault)
        active.lifted = time.monotonic()
        well, why = self._settle(partial(self._not_recovered, active), t + HEAL_S + fault.properties.heals_s)
        if why:
            active.violations.append(f"not well {well - active.lifted:.0f} s later: {why}")
        if fault.kind == "read-error":
            self._dead[victim] = time.monotonic()
        left = set() if self._conductor_dead or self._run_is_over() else active.there - self._dead.keys()
        down = [name for name in sorted(left) if self._is_down(name)]
        reasons = [f"{name}: {observer.status[name].reason}" for name in down]
        outcome = FaultResult(
            self._number,
            fault,
            victim,
            round(active.at_s, 2),
            "; ".join(filter(None, (active.note, *reasons))),
            not why,
            round(well - active.begun, 3),
            round(max(0.0, well - active.lifted), 3),
            bool(down),
            active.violations,
        )
        self.outcomes.append(outcome)
        self._now = None
        print(line(outcome), file=sys.stderr, flush=True)

    def _run_is_over(self) -> bool:
        """Whether the run's time is over: then the conductor lands all robots, and lets none in again."""
        return time.monotonic() - (self._started or 0.0) > self._setting.experiment.duration_s - NOTICE_S

    def _check_held(self, active: _ActiveFault) -> None:
        """Check that the body of a victim stops soon, for no process steers it."""
        if time.monotonic() < active.begun + NOTICE_S or not self._observer.connected:
            return
        if active.held_at is None:
            active.held_at = self._observer.invariants.where(active.victim)
        if self._observer.moved(active.victim, active.held_at) > HELD_M:
            active.add_violation(f"{active.victim} moved although no process steered it")

    def _not_recovered(self, active: _ActiveFault, t: float) -> str:
        """Reason why the run is not yet as it was; empty if it is."""
        if self._conductor_dead:
            return self._not_landed()
        live = self._observer.running() - self._dead.keys()
        check = getattr(self, f"_after_{active.fault.kind.replace('-', '_')}", self._after_any)
        away = active.there - live - self._dead.keys() - {active.victim}
        away = {name for name in away if self._observer.invariants.in_the_air(name) or not self._is_down(name)}
        since = max(active.lifted, time.monotonic() - FRESH_S)
        return (
            check(active, live)
            or (f"{', '.join(sorted(away))}: not back" if away else "")
            or self._not_in_formation(live, since, t)
        )

    def _not_landed(self) -> str:
        """Reason why robots without a conductor are not down yet; empty if they are."""
        observer = self._observer
        up = [name for name in observer.invariants.names if observer.invariants.in_the_air(name)]
        asked = observer.status.keys() - self._dead.keys()
        awake = sorted(name for name in asked if observer.status[name].phase != "done")
        return f"in the air {up}, not done {awake}" if up or awake else ""

    # ------------------------------------------------------------------ checks by kind: why it is not well yet

    def _after_any(self, active: _ActiveFault, live: Set[str]) -> str:
        if active.victim:
            return self._not_back(active.victim, live, active.lifted)
        ended = active.fault.properties.reported
        if ended and not any(event.kind.startswith(ended) and "ended" in event.text for event in self._events):
            return f"the end of the {ended} is not reported"
        return ""

    def _after_kill(self, active: _ActiveFault, live: Set[str]) -> str:
        victim = active.victim
        if victim in self._observer.alive:
            return f"{victim} is dead, and its token still stands"
        unaware = [name for name in self._receivers(victim, live) if victim not in self._observer.status[name].missing]
        return f"{', '.join(unaware)}: not noticed that {victim} is lost" if unaware else ""

    def _receivers(self, sender: str, live: Set[str]) -> list[str]:
        """Living robots that receive the poses of a sender."""
        return [name for name in live if sender in self._senders[name]]

    def _lost_since(self, active: _ActiveFault) -> str:
        """Report of the conductor on the end of the victim's process since the fault began; empty without one."""
        ends = [e.text for e in self._events[active.events :] if e.kind == "lost" and e.source == active.victim]
        return "".join(ends[:1])

    def _after_read_error(self, active: _ActiveFault, live: Set[str]) -> str:
        victim = active.victim
        if not any(order.robot == victim and order.action in ("land", "stop") for order in self._observer.orders):
            return f"the body of {victim} was ordered neither to land nor to stop"
        if self._observer.invariants.in_the_air(victim):
            return f"{victim} has not come down yet"
        if not self._lost_since(active):  # it lands for as long as a landing may take, for it sees nothing of it
            return f"the process of {victim} has not ended yet"
        return self._after_kill(active, live)

    def _after_clock_behind(self, active: _ActiveFault, live: Set[str]) -> str:
        victim = active.victim
        if active.restarted is None:
            if victim in self._observer.alive or not self._lost_since(active):
                return f"the loss of {victim} is not reported"
            self._off.add(victim)
            active.restarted = time.monotonic()
            self._run.restart(victim, self._observer.session)
        if (why := self._run.answer.reason or self._run.answer.refused.get(victim)) and not self._run_is_over():
            active.add_violation(f"{victim} is not let in again: {why}")
            return ""
        if victim not in self._observer.alive:
            return f"{victim} is not back"
        active.back = active.back or time.monotonic()
        receivers = self._receivers(victim, live)
        deaf = [name for name in receivers if self._observer.received_at.get((name, victim), 0.0) < active.restarted]
        if deaf and time.monotonic() - active.back > DEAF_S:
            names = ", ".join(deaf)
            active.add_violation(f"{names}: no pose of {victim} received in the first {DEAF_S:g} s after its restart")
        if deaf or victim not in live:
            return f"{victim} does not take part yet, or its poses do not reach {', '.join(deaf) or 'any robot'}"
        return ""

    def _after_double(self, active: _ActiveFault, live: Set[str]) -> str:
        victim, second = active.victim, self._run.second
        assert second is not None
        for order in self._observer.orders:
            if order.robot == victim and not self._run_is_over():
                active.add_violation(f"the body of {victim} was ordered to {order.action}")
        if second.alive:
            return f"the second process of {victim} is not refused yet"
        if second.handle.returncode != REFUSED:
            active.add_violation(f"the second process of {victim}: {second.exit}, {second.tail()[-200:]}")
        return "" if victim in live else f"{victim} is not running any more"

    def _after_frozen_router(self, active: _ActiveFault, live: Set[str]) -> str:
        limit = self._setting.experiment.safety.link_silence_s + NOTICED_S
        free = []
        for name in live - self._off:
            since = [each.stamp - active.utc for each in self._incidents_since(name, "router", active)]
            if not since:
                free.append(name)
            elif min(since) > limit:
                active.add_violation(f"{name} held only {min(since):.1f} s after the router had frozen")
        return f"{', '.join(free)}: never held while the router was frozen" if free else ""

    def _after_mocap_clock(self, active: _ActiveFault, live: Set[str]) -> str:
        for name in self._observer.status:
            for incident in self._incidents_since(name, "position", active):
                active.add_violation(f"{name}: {incident.text}")
        return ""

    _after_clock = _after_mocap_clock

    def _is_down(self, name: str) -> bool:
        """Whether a robot reports that it comes down, or is down."""
        status = self._observer.status.get(name)
        return status is not None and status.phase in ("landing", "done")

    def _incidents_since(self, name: str, what: str, active: _ActiveFault) -> list[messages.Incident]:
        """Incidents since the fault began that made a robot hold, land or cut its motors, and whose text has `what`."""
        last = active.incidents.get(name, 0)
        new = [each for each in self._observer.status[name].incidents if each.seq > last and what in each.text]
        return [each for each in new if each.text.startswith(("hold", "land", "cut"))]

    def _not_back(self, victim: str, live: Set[str], lifted: float) -> str:
        """Reason why a living victim is neither back nor down; empty if it is."""
        if self._observer.status_at.get(victim, 0.0) < lifted:
            return f"no status of {victim} yet"
        if self._is_down(victim):
            return f"{victim} has not come down yet" if self._observer.invariants.in_the_air(victim) else ""
        return "" if victim in live else f"{victim} is not back"

    def _not_formed(self, t: float) -> str:
        """Reason why running robots are not in formation."""
        return self._not_in_formation(self._observer.running(), time.monotonic() - FRESH_S, t)

    def _not_in_formation(self, live: Set[str], since: float, t: float) -> str:
        """Reason why living robots are not in formation: silent since then, missing each other, or elsewhere."""
        if not live and not self._dead:
            return "no robot is running"
        for name in live:
            if self._observer.status_at.get(name, 0.0) < since:
                return f"no status of {name} yet"
            absent = [other for other in self._observer.status[name].missing if other in live]
            if absent:
                return f"{name} misses {', '.join(absent)}"
        error = self._observer.invariants.formation_error(live, t)
        return f"a link is {error:.3f} off" if error > self._setting.experiment.tolerance else ""

    # ------------------------------------------------------------------ the end

    def _finish(self, watched: WatchedRun) -> float:
        """End the run if it has not ended; return the time until all its processes had ended [s]."""
        began = time.monotonic()
        if watched.process.alive:
            watched.close()
        deadline = began + LANDED_S
        while (left := watched.processes()) and time.monotonic() < deadline:
            time.sleep(POLL_S * 5)
        gone_s = time.monotonic() - began
        self._events += watched.news()
        with contextlib.suppress(subprocess.TimeoutExpired):
            watched.process.handle.wait(LAST_BREATH_S)
        if left:
            self._wrong.append(f"left behind after {LANDED_S:g} s: {', '.join(sorted(left.values()))}")
        code = watched.process.handle.poll()
        if not self._conductor_dead and code != 0:
            self._wrong.append(f"the run ended with exit code {code}: {' '.join(watched.output)}")
        return gone_s

    def _missed_share(self) -> float:
        """Share of missed ticks of robots without a fault."""
        stopped = {each.victim for each in self.outcomes} | self._dead.keys()
        statuses = [status for name, status in self._observer.status.items() if name not in stopped and status.ticks]
        ticks, missed = (sum(getattr(status, what) for status in statuses) for what in ("ticks", "missed"))
        return round(missed / (ticks + missed), 4) if ticks else 0.0
