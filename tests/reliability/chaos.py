"""`./zenpark test --chaos`: draws a script of faults, runs it in rounds, and reports what did not hold.

A round is one run, with faults one after the other, and whether all is well after each.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import statistics
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Annotated, Final

import msgspec
import typer

from agents.errors import ExplainedError
from agents.network import session as network
from agents.runtime.command_line import interrupts
from experiments.definition.plan import Plan
from experiments.file.document import chosen, load
from experiments.metrics.measure import measure
from experiments.recording import playback
from experiments.recording.reader import recover
from experiments.recording.run_folder import SOURCE, new_folder
from experiments.report.page import NONE, VerdictLine
from tests.reliability.faults import FAULT_KINDS, FAULTS, NOTICE_S, ActiveFault, Check, Fault, next_fault, script
from tests.reliability.observer import Observer
from tests.reliability.spoilt_run import Setting, SpoiltRun
from tools.options import AsJson, File, Out, Settings, known_words, print_result
from tools.progress import columns

POLL_S: Final = 0.02
BEGIN_S: Final = 100.0  # to the common start
FORM_S: Final = 45.0  # a formation that has not come together by then does not: avoidance takes its time
HEAL_S: Final = 30.0  # the formation stands again at most so long after the end of a fault
SETTLED_S: Final = 0.5  # and stays so
FRESH_S: Final = 1.6  # a robot without a status for longer is not back: statuses come once a second
FEWEST: Final = 3  # running robots with which a round goes on
LEAD_S: Final = 1.0  # the start is announced not longer before
LANDED_S: Final = 40.0  # after the launcher's death or the end everything is gone
LAST_BREATH_S: Final = 5.0  # from when a process cannot be found any more to when its exit code is known
END_S: Final = 60.0  # and no round takes longer than this after its time


class FaultResult(msgspec.Struct, frozen=True):
    """Result of one fault."""

    round: int  # counted from 1
    fault: Fault  # as in the script
    victim: str  # a robot; empty: the whole run
    note: str  # for the report
    recovered: bool  # in time
    at_s: float  # from the common start [s]
    begin_s: float  # from its begin to the recovery [s]
    ended: bool  # robots came down instead of going on, dead ones not counted
    violations: list[str]  # of the invariants


class RoundResult(msgspec.Struct, frozen=True):
    """Result of one round."""

    round: int  # counted from 1
    violations: list[str]  # of the invariants, outside of a fault
    nearest_m: float  # least distance between surfaces of two robots [m]
    gone_s: float  # from its end until all of its processes were gone [s]
    missed: float  # share of missed ticks of robots without a fault: the load of the machine


def line(outcome: FaultResult) -> str:
    whom = f" {outcome.victim}" if outcome.victim else ""
    how = f"well after {outcome.begin_s:.1f} s" if outcome.recovered else "NOT WELL"
    note = f" ({outcome.note})" if outcome.note else ""
    ends = "; ".join([how + ", came down" * outcome.ended, *outcome.violations])
    return f"round {outcome.round}, {outcome.at_s:5.1f} s: {outcome.fault.kind}{whom}{note}: {ends}"


def recording_faults(recording: Path, outcomes: Sequence[FaultResult], *, disk_full: bool) -> list[str]:
    """Faults of the recording of a round, which must open and have the events."""
    try:
        if disk_full:
            mended = recording.with_name("mended.mcap")
            if not recover(recording, mended).complete:
                recording = mended
        read = playback.read(recording)
    except (ExplainedError, OSError) as error:
        return [f"the recording does not open: {error}"]
    if disk_full:
        return []
    events = {(event.kind.rstrip("0123456789"), event.source) for event in read.trace.events}
    kinds = {kind for kind, _ in events}
    wrong = [] if read.complete else ["the recording has no end"]
    for each in outcomes:
        kind = each.fault.properties.recorded
        if kind and not ((kind, each.victim) in events if each.victim else kind in kinds):
            wrong.append(f"the recording has no event {kind} {each.victim}".rstrip())
    left = [each for each in outcomes if each.ended and not each.fault.properties.ordered]
    if left and not measure(read.trace).failures:
        wrong.append(f"robots came down by {left[0].fault.kind}, and the run would end with 0")
    return wrong


class _Over(Exception):
    """The run has ended, or goes on without end."""


class ChaosRound:
    """A round.

    Attributes:
        outcomes: Of the faults that were done.
    """

    def __init__(self, setting: Setting, number: int, waiting: list[Fault]) -> None:
        """Faults that are begun are taken from those that are `waiting`; the first one decides on the stage."""
        self._setting, self._number, self._waiting = setting, number, waiting
        self._stage = waiting[0].properties.stage
        self.outcomes: list[FaultResult] = []
        self._begun: Counter[str] = Counter()  # faults by kind
        self._wrong: list[str] = []
        self._active: ActiveFault | None = None

    def run(self) -> RoundResult:
        """Run the round to its end; no process is left behind."""
        nearest, missed = math.inf, 0.0
        with ExitStack() as stack:
            run = self._run = SpoiltRun(stack, self._setting, self._stage, self._number)
            try:
                with network.open_session(run.routers, name="chaos", wait_s=BEGIN_S) as session:  # routers wait for it
                    run.session, self._observer = session, Observer(session, run.plan)
                    with contextlib.suppress(_Over):
                        self._follow()
                    nearest, missed = self._observer.invariants.nearest, self._missed_share()
            except network.Unreachable as error:
                self._wrong.append(f"it never began: {error}; {run.process.tail()}")
            if (active := self._active) is not None:  # put back: its recovery was not observed before the run ended
                self._wrong += [f"{active.fault.kind} {active.victim}: {text}" for text in active.violations]
                self._waiting.insert(0, active.fault)
            run.release()
            gone_s = self._finish()
        if run.started is not None:
            self._wrong += recording_faults(run.recording, self.outcomes, disk_full=self._begun["disk"] > 0)
        for each in self._wrong:
            print(f"round {self._number}: {each}", file=sys.stderr)
        return RoundResult(self._number, self._wrong, round(nearest, 4), round(gone_s, 1), missed)

    def _follow(self) -> None:
        """Inject one fault after the other, until none is left that fits into the run."""
        began = time.monotonic()
        while self._run.started is None:
            self._poll()
            self._observer.violations()  # robots are placed
            if time.monotonic() > began + BEGIN_S:
                self._wrong.append(f"no common start within {BEGIN_S:g} s")
                return
        well, why = self._settle(self._not_in_formation, FORM_S)
        if why:
            self._wrong.append(f"not in formation {FORM_S:g} s after the start ({why}): no fault was done")
        while not (why or self._begun["conductor"] or self._setting.interrupted()):
            t = self._poll()
            running = self._observer.running() - self._run.dead.keys()
            able = [each for each in self._waiting if running.intersection(self._run.robots(each.properties.among))]
            fault = next_fault(able, self._stage, self._begun, self._run.experiment.duration_s - t)
            if fault is None or len(running) < FEWEST:
                return
            if time.monotonic() >= well + fault.after_s:
                self._waiting.remove(fault)
                self._do(fault, t, running)
                well = time.monotonic()

    def _poll(self) -> float:
        """Wait a moment, and take in what has happened; return the time since the common start [s]."""
        run, observer = self._run, self._observer
        if not (run.process.alive or self._begun["conductor"]):
            raise _Over
        time.sleep(POLL_S)
        observer.update()
        now = time.monotonic()
        if run.started is None:
            start = next((event.stamp for event in observer.events if event.kind == "start"), None)
            if start is None:
                return 0.0
            run.started = now + max(0.0, min(LEAD_S, start - time.time()))
        self._judge(now)
        if now - run.started > run.experiment.duration_s + END_S:
            self._wrong.append(f"it does not end {END_S:g} s after its time")
            raise _Over
        return now - run.started

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
            driven = max((leg.at_s for leg in self._run.experiment.timeline if leg.at_s <= t), default=-math.inf)
            if t > max(limit_s, driven + FORM_S) and why:
                return now, last

    def _judge(self, now: float) -> None:
        """Add new violations to the active fault, or to the round."""
        wrong = self._observer.violations()
        for name, since in self._run.dead.items():
            command = self._observer.command.get(name)
            if command is not None and command[1] > since + NOTICE_S and now < command[1] + POLL_S * 5:
                wrong.append(f"{name} is dead and still commands its body")
        target = self._wrong if self._active is None else self._active.violations
        target += [each for each in wrong if each not in target]

    def _do(self, fault: Fault, t: float, running: set[str]) -> None:
        """Inject a fault, lift it when its time is over, and wait until all is well."""
        run, observer, victim, at_s = self._run, self._observer, fault.victim, t
        if victim:
            names = observer.invariants.names
            able = running.intersection(run.robots(fault.properties.among))
            victim = next(name for name in (*names, *names)[names.index(victim) :] if name in able)
        active = self._active = ActiveFault(fault, victim, run, observer, running)
        check = fault.properties.begin(active)
        self._begun[fault.kind] += 1
        while time.monotonic() < active.begun + fault.properties.lasts_s:
            t = self._poll()
            if fault.properties.unsteered:
                active.check_held()
        run.release()
        active.lifted = time.monotonic()
        recovered = partial(self._not_recovered, active, check)
        well, why = self._settle(recovered, t + HEAL_S + fault.properties.heals_s)
        if why:
            active.violations.append(f"not well {well - active.lifted:.0f} s later: {why}")
        left = set() if self._begun["conductor"] or run.over else active.there - run.dead.keys()
        down = sorted(filter(observer.is_down, left))
        note = "; ".join(filter(None, (active.note, *(f"{name}: {observer.status[name].reason}" for name in down))))
        times = round(at_s, 2), round(well - active.begun, 3)
        outcome = FaultResult(self._number, fault, victim, note, not why, *times, bool(down), active.violations)
        self.outcomes.append(outcome)
        self._active = None
        print(line(outcome), file=sys.stderr, flush=True)

    def _not_recovered(self, active: ActiveFault, check: Check, t: float) -> str:
        """Reason why the run is not yet as it was; empty if it is."""
        observer, dead = self._observer, self._run.dead.keys()
        active.live = observer.running() - dead
        if (why := check()) or self._begun["conductor"]:
            return why
        away = active.there - active.live - dead - {active.victim}
        away = {name for name in away if observer.invariants.in_the_air(name) or not observer.is_down(name)}
        if away:
            return f"{', '.join(sorted(away))}: not back"
        return self._not_in_formation(t, active.lifted)

    def _not_in_formation(self, t: float, lifted: float = 0.0) -> str:
        """Reason why living robots are not in formation: silent since a fault, missing each other, or elsewhere."""
        live = self._observer.running() - self._run.dead.keys()
        since = max(lifted, time.monotonic() - FRESH_S)
        if not live and not self._run.dead:
            return "no robot is running"
        for name in live:
            if self._observer.status_at.get(name, 0.0) < since:
                return f"no status of {name} yet"
            absent = [other for other in self._observer.status[name].missing if other in live]
            if absent:
                return f"{name} misses {', '.join(absent)}"
        if any(FAULT_KINDS[kind].disbands for kind in self._begun):
            return ""
        error = self._observer.invariants.formation_error(live, t)
        return f"a link is {error:.3f} off" if error > self._run.experiment.tolerance else ""

    def _finish(self) -> float:
        """End the run if it has not ended; return the time until all its processes had ended [s]."""
        run, began = self._run, time.monotonic()
        run.close()
        while (left := run.processes()) and time.monotonic() < began + LANDED_S:
            time.sleep(POLL_S * 5)
        gone_s = time.monotonic() - began
        if left:
            self._wrong.append(f"left behind after {LANDED_S:g} s: {', '.join(sorted(left.values()))}")
        with contextlib.suppress(subprocess.TimeoutExpired):
            run.process.handle.wait(LAST_BREATH_S)
        if not self._begun["conductor"] and run.process.handle.poll() != 0:
            self._wrong.append(f"the run ended with {run.process.exit}{run.process.because}")
        return gone_s

    def _missed_share(self) -> float:
        """Share of missed ticks of robots without a fault."""
        stopped = {each.victim for each in self.outcomes} | self._run.dead.keys()
        statuses = [status for name, status in self._observer.status.items() if name not in stopped and status.ticks]
        ticks, missed = (sum(getattr(status, what) for status in statuses) for what in ("ticks", "missed"))
        return round(missed / (ticks + missed), 4) if ticks else 0.0


BARREN: Final = 3  # rounds without any fault, and it gives up
BUSY: Final = 0.05  # share of the ticks that a machine may miss which is to be trusted with the rest
# pymunk measures contacts; a busy machine is no fault; rounds are long, for starts take time
ALWAYS: Final = ('world.engine="pymunk"', "world.wheel_watchdog_s=0.5", "start.deadline_s=60", "duration_s=90")
# without one, robots cannot keep clear of a dead one that stands in their way, nor of one that lands below them
AVOIDANCE: Final = 'avoidance={ kind = "barrier", hears = "all", clearance = 1.0 }'
BODY_HZ: Final = 50.0  # relays, world and robots share one machine: at 100 Hz two cores are full, and ticks are missed
SCRIPT: Final = "script.json"
RESULT: Final = "chaos.json"


def chaos(
    file: File,
    *,
    faults: Annotated[int, typer.Option(min=1, help="How many.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Of the script; the same seed gives the same.")] = 1,
    kinds: Annotated[
        list[str] | None, typer.Option(metavar="KIND,KIND", help="Only these: kill, freeze, partition, ... [all]")
    ] = None,
    case: Annotated[str | None, typer.Option(metavar="NAME", help="A case of the file. [the last]")] = None,
    out: Out = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> int:
    """Run an experiment again and again while faults befall it, and say what did not hold."""
    changes = [*defaults(load(file).plan), *(settings or [])]
    read = load(file, *changes)
    name = case or list(read.cases())[-1]
    plan = chosen(read, [name])[name]
    planned = script(list(plan.names), faults, seed, known_words("--kinds", kinds or [], FAULTS) or FAULTS)
    folder = new_folder(dataclasses.replace(read, path=Path(f"{read.path.stem}-chaos")), out)
    read.keep(folder / SOURCE)
    (folder / SCRIPT).write_bytes(msgspec.json.format(msgspec.json.encode(planned), indent=1))

    print(f"{faults} faults in rounds of {plan.experiment.duration_s:g} s; script: {folder / SCRIPT}", file=sys.stderr)
    waiting, barren = list(planned), 0
    outcomes: list[FaultResult] = []
    ends: list[RoundResult] = []
    with interrupts() as interrupted:
        setting = Setting(folder / SOURCE, name, plan, folder, changes, interrupted)
        while waiting and not interrupted() and barren < BARREN:
            flown = ChaosRound(setting, len(ends) + 1, waiting)
            ends.append(flown.run())
            outcomes += flown.outcomes
            barren = 0 if flown.outcomes else barren + 1
    result = ChaosResult(read.experiment.title, seed, planned, outcomes, ends)
    (folder / RESULT).write_bytes(msgspec.json.format(msgspec.json.encode(result), indent=1))
    verdict = findings(result)
    print_result(result, *columns(table(result)), *map(str, verdict), f"results: {folder}", as_json=as_json)
    if interrupted():
        return 130
    return int(any(finding.mark == "bad" for finding in verdict))


def defaults(plan: Plan) -> list[str]:
    """Settings of the laboratory, which `--set` overrides."""
    made = list(ALWAYS)
    if plan.experiment.avoidance is None:
        made.append(AVOIDANCE)
    rates = plan.experiment.rates
    if rates.body_hz > BODY_HZ and all(
        (BODY_HZ / rate).is_integer() for rate in (rates.pose_hz, rates.coordination_hz, rates.state_hz)
    ):
        made.append(f"rates.body_hz={BODY_HZ:g}")
    return made


class ChaosResult(msgspec.Struct, frozen=True):
    """Everything of a laboratory, as `chaos.json` keeps it."""

    experiment: str
    seed: int
    script: list[Fault]
    outcomes: list[FaultResult]
    rounds: list[RoundResult]


def table(result: ChaosResult) -> list[tuple[str, ...]]:
    """A head and a row for each kind of fault; times count from the begin of the fault."""
    rows: list[tuple[str, ...]] = [("fault", "done", "well again", "came down", "median", "longest", "violations")]
    for kind in FAULTS:
        mine = [each for each in result.outcomes if each.fault.kind == kind]
        well = [each.begin_s for each in mine if each.recovered]
        counts = len(mine), len(well), sum(each.ended for each in mine)
        times = (f"{what(well):.1f} s" if well else NONE for what in (statistics.median, max))
        wrong = sum(len(each.violations) for each in mine)
        rows += [(kind, *map(str, counts), *times, str(wrong))] if mine else []
    return rows


def findings(result: ChaosResult) -> list[VerdictLine]:
    """The verdict; bad findings are violations, or faults that could not be done."""
    done, wanted, rounds = len(result.outcomes), len(result.script), result.rounds
    nearest = min((each.nearest_m for each in rounds), default=math.inf)
    late = max((each.gone_s for each in rounds), default=0.0)
    found = [
        VerdictLine("good" if done == wanted else "bad", f"{done} of {wanted} faults in {len(rounds)} rounds"),
        VerdictLine("plain", f"robots came as near as {nearest:.3f} m to each other, surface to surface"),
        VerdictLine("plain", f"after the end of a round all of its processes were gone within {late:.1f} s"),
    ]
    for each in rounds:
        if each.missed > BUSY:
            text = f"the machine was too busy, {100 * each.missed:.0f} % of ticks were missed"
            found.append(VerdictLine("fair", f"round {each.round}: {text}"))
    wrong = [line(each) for each in result.outcomes if each.violations]
    wrong += [f"round {each.round}: {text}" for each in rounds for text in each.violations]
    return found + ([VerdictLine("bad", text) for text in wrong] or [VerdictLine("good", "0 violations")])
