"""The conductor of one case in real time: waits until all are ready, gives the common start, walks the phases, lands.

It decides nothing that a robot needs: if it dies, the robots land by themselves and the recorder finishes its file.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Final

from agents.clock import Clock
from agents.decision.lifecycle import PAUSED, TOLD_TO_END
from agents.network import messages
from agents.network.keys import Keys
from agents.runtime.orders import LAND, STOP
from experiments.definition.formation import targeted
from experiments.file.document import write_json
from experiments.real_time.conductor import run_view
from experiments.real_time.conductor.case_processes import CaseContext, CaseProcesses
from experiments.real_time.conductor.hot_changes import HotChanges
from experiments.real_time.conductor.orders import start_lead_s
from experiments.real_time.hosts.hosts import Drift
from experiments.real_time.hosts.launcher import travel_s
from experiments.recording.playback import EARLY_S

POLL_S: Final = 0.05
TARDY_S: Final = 0.05  # robots that begin farther than this from the common start are reported
GO_ON_S: Final = 5.0  # robots start later than the conductor, and count the deadline from then
MARGIN_S: Final = 0.5  # a robot that is not ready this long after its own deadline is not awaited any more

ADOPT_S: Final = 0.5
LATE_S: Final = 1.0  # a robot that still waits this long after the common start has missed the order [s]
OVER_S: Final = 3.0  # a robot that still runs this long after the planned end is ordered to land [s]
LEAVE_S: Final = 8.0  # limit for robots of the previous case to end [s]


@dataclass(frozen=True)
class CaseResult:
    recording: Path
    start: float | None
    ready_s: float | None
    lost: tuple[str, ...]
    failures: tuple[str, ...] = ()  # failures that its recording may not tell
    # why no further case begins: an operator landed, stopped or held robots, and may be among them; empty: it begins
    halted: str = ""


class CaseRun:
    """A case with its processes, and its network as this process sees it."""

    _view: run_view.NetworkView

    def __init__(self, context: CaseContext, show: run_view.ShowProgress) -> None:
        """Write the case as a file for its processes; nothing is started yet."""
        self._context, self._show = context, show
        self._plan = plan = context.plan
        self._experiment = experiment = plan.experiment
        context.file.parent.mkdir(parents=True, exist_ok=True)
        context.file.write_bytes(write_json(plan))
        self._keys = Keys(experiment.network.realm)
        # of each case, for all its processes here, however late they start
        self._clock = context.launcher.clock = Clock()
        judged = plan.links.receiver[targeted(plan.law, plan.formation)]
        linked = {plan.names[row] for row in judged.tolist()} - {*plan.guided}
        self._robots = {
            name: run_view.RobotView(linked=name in linked, left_because="standby" if robot.standby else "")
            for name, robot in experiment.robots.items()
        }
        self._progress = run_view.Progress(
            context.case, "starting", None, experiment.duration_s, self._robots, clock=self._clock
        )
        self._processes = CaseProcesses(context)

    def _join(self, stack: ExitStack) -> None:
        """Join the network; `stack` leaves it."""
        self._view = run_view.NetworkView(stack, self._context, self._progress)
        stack.callback(self._context.emergency.listen(self._view.session, self._keys).close)

    def _show_progress(self) -> None:
        """Show the progress, with new output of processes on other machines."""
        now = self._clock.utc()
        for place, line in self._processes.output():
            self._progress.events.append(messages.Event(now, run_view.OUTPUT, place, line))
        self._show(self._progress)


class Conductor(CaseRun):
    _lifted = False  # True if a take-off was ordered

    def run(self) -> CaseResult:
        """Run the case to its end, or until the user interrupts it; the robots are down in any case."""
        began = time.monotonic()
        self._progress.phase = "connecting the hosts" if self._experiment.hosts else "starting"
        clocks = self._context.hosts.join(self._plan)
        start = ready = None
        self.failures: list[str] = []
        # robots that an operator has landed or stopped before the end, by reason and time in words
        self._landed: dict[tuple[str, str], list[str]] = {}
        self._held: set[str] = set()  # robots that an operator holds, as far as they say
        try:
            self._processes.prepare()
            with ExitStack() as stack:
                self._join(stack)
                self._adopt()
                self._processes.start()
                if self._await_ready():
                    ready = time.monotonic() - began
                    self._view.report_clocks(clocks)
                    self._drift = stack.enter_context(Drift(self._context.hosts.in_use()))
                    count = sum(view.reached("ready") for view in self._robots.values())
                    self._view.report("ready", "conductor", f"{count} robots after {ready:.2f} s")
                    if self._take_off():
                        start = self._start()
                        self.walk(start)
                        self._report_unbegun()
                self._land()
                if start is not None:
                    if not self._context.ended():
                        self._note_landings(start)
                    self._drift.close()
                    self._view.report_drift(*self._drift.news())
                for name in self._processes.end_robots():
                    self._leave_behind(name, "its process hung after the landing, and was killed")
        except run_view.RunFailed as failure:
            self._progress.phase = str(failure).partition(";")[0]  # ending the others takes a while: show it now
            self._show(self._progress)
            raise
        finally:
            broken = [self._processes.end(), self._processes.join_parts()]
        lost = tuple(name for name, view in self._robots.items() if view.left_because == "lost")
        failures = [
            *([f"lost {', '.join(lost)}"] if lost else []),
            *self._landings(),
            *self.failures,
            *filter(None, broken),
        ]
        landed = [f"{', '.join(names)} {reason} by an operator" for (reason, _), names in self._landed.items()]
        held = [f"{', '.join(sorted(self._held))} held by an operator to the end"] if self._held else []
        halted = "; ".join([*landed, *held])
        return CaseResult(self._context.recording, start, ready, lost, tuple(failures), halted)

    def _join(self, stack: ExitStack) -> None:
        super()._join(stack)
        self._changes = HotChanges(self._plan, self._processes, self._view, self._keys)

    def _adopt(self) -> None:
        """Adopt robots that were started by hand or at boot."""
        away = self._processes.away
        if self._experiment.network.connect is not None or away:  # a router of our own has no other robots
            self._progress.phase = "looking for robots"
            began = time.monotonic()
            while (past := time.monotonic() - began) < ADOPT_S or (self._flown() and past < LEAVE_S):
                self._update()
                time.sleep(POLL_S)
        if flown := self._flown():
            raise run_view.RunFailed(
                f"{', '.join(flown)}: on the network already, and {self._robots[flown[0]].phase}; a robot that was "
                "started by hand flies once: end its process and start it again, next time with --once"
            )
        alive = {name for name, view in self._robots.items() if view.alive}
        for name in self._processes.adopt(alive):
            state = f"is there already, {self._robots[name].phase}" if name in alive else f"is started on {away[name]}"
            self._view.report("adopted", name, f"{state}; not started from here")

    def _flown(self) -> list[str]:
        """Robots that are there and have flown, or do."""
        return [name for name, view in self._robots.items() if view.alive and view.reached("airborne")]

    def _await_ready(self) -> bool:
        """Wait until all are ready, or leave those out that are not, if the file says so; False if interrupted."""
        begin = self._experiment.start  # robots that go on without a neighbour report it after the deadline
        if begin.missing == "abort":
            return self.await_phase("ready", begin.deadline_s, recorder=True)
        limit_s = begin.deadline_s + GO_ON_S
        on = self.await_phase("ready", limit_s, recorder=True, own_limit_s=begin.deadline_s + MARGIN_S)
        late = [name for name, view in self._robots.items() if not (view.reached("ready") or view.gone)] if on else []
        if late and not any(view.reached("ready") for view in self._robots.values()):
            raise run_view.RunFailed(self.start_failure(late, f"not ready after {limit_s:g} s"))
        for name in late:
            self._robots[name].left_because = "late"
            self._view.report("failed", name, f"takes no part: it is not ready: {self._reason(name)}")
        return on

    def await_phase(
        self,
        phase: str,
        limit_s: float,
        *,
        recorder: bool = False,
        own_limit_s: float = inf,
        meanwhile: Callable[[], None] = lambda: None,
    ) -> bool:
        """Wait until every robot that is left has reached a phase; False if the user interrupted.

        Args:
            recorder: Whether a recorder is awaited too.
            own_limit_s: Time after its first status from which a robot is not awaited any more [s].
            meanwhile: Called at each look.
        """
        self._progress.phase = f"waiting until all are {phase}"
        deadline = time.monotonic() + limit_s
        while True:
            self._update()
            if self._context.ended():
                return False
            meanwhile()
            late = [name for name, view in self._robots.items() if not (view.reached(phase) or view.gone)]
            lost = [name for name, view in self._robots.items() if view.left_because == "lost"]
            if lost and self._experiment.start.missing == "abort":
                raise run_view.RunFailed(self.start_failure(lost, "could not start"))
            if recorder and not self._processes.recording:
                raise run_view.RunFailed("nothing would be recorded: the recorder ended each time; its log says why")
            now = time.monotonic()
            awaited = [name for name in late if now - self._robots[name].seen <= own_limit_s]
            if not awaited and (not recorder or self._view.recording_begun):
                return True
            if now > deadline:
                if late and self._experiment.start.missing == "abort":
                    raise run_view.RunFailed(self.start_failure(late, f"not {phase} after {limit_s:g} s"))
                for name in late:
                    self._view.report("late", name, f"not {phase} after {limit_s:g} s: {self._reason(name)}")
                return True
            time.sleep(POLL_S)

    def _take_off(self) -> bool:
        """Order all robots to climb, those that were not ready again when they are; False if interrupted."""
        self._lifted = True
        refused = {name: time.monotonic() for name in self._order(messages.Order("takeoff"))}

        def again() -> None:
            now = time.monotonic()
            due = [name for name, asked in refused.items() if now > asked + LATE_S]
            for name in [name for name in due if self._robots[name].phase == "ready"]:
                refused[name] = now
                if not self._order(messages.Order("takeoff"), [name]):
                    del refused[name]

        # a recorder that has ended meanwhile is awaited again: a run without any would be flown for nothing
        highest = max((robot.hover or 0.0 for robot in self._experiment.robots.values()), default=0.0)
        return self.await_phase("airborne", travel_s(highest), recorder=True, meanwhile=again)

    def _start(self) -> float:
        """Order the common start; returns its time [s, UTC]."""
        for name, view in self._robots.items():
            if not view.gone and view.clock_off:
                off = f"its clock is {-view.clock_off:+.2f} s off and it will start so"
                self._view.report("clock", name, f"{off}; set it (NTP), or let zenpark start the robot: [hosts]")
        ready = [name for name, view in self._robots.items() if view.reached("airborne") and not view.gone]
        at = self._clock.utc() + start_lead_s(len(ready))
        self._view.report("start", "conductor", "common start", stamp=at)
        self._order(messages.Order("start", at=at), ready)
        self._starting = {name for name, view in self._robots.items() if not view.gone}
        return at

    def walk(self, start: float) -> None:
        """Follow the run to its end."""
        coming = deque(self._experiment.phases)
        end = start + self._experiment.duration_s
        self._changes.begin(start)
        self._repeat_at = self._progress.start = start
        self._progress.phase = "starting together"
        while (now := self._clock.utc()) < end + OVER_S and not self._context.ended():
            self._update()
            self._note_holds()
            self._view.report_drift(*self._drift.news())
            self._progress.elapsed = now - start
            self._report_tardy(start)
            self._start_late(start)
            while coming and now - start >= coming[0][0]:
                at, self._progress.phase = coming.popleft()
                self._view.report("phase", "conductor", self._progress.phase, stamp=start + at)
            busy = self._changes.under_way
            left = [view for name, view in self._robots.items() if not view.gone and name not in busy]
            ended = all(view.reached("landing") for view in left) and (left or not busy)
            self._note_landings(start)
            if ended and now < end - EARLY_S and not self._landed:
                what = "all robots were down" if left else "no robot was left"
                self.failures.append(f"{what} after {now - start:.1f} of {self._experiment.duration_s:g} s")
            if ended:
                break
            time.sleep(POLL_S)

    def _note_holds(self) -> None:
        """Note which robots hold by order; one that lands at the end does not say so any more."""
        for name, view in self._robots.items():
            if view.gone or (view.phase == "running" and self._reason(name) != PAUSED):
                self._held.discard(name)
            elif view.phase == "running":
                self._held.add(name)

    def _note_landings(self, start: float) -> None:
        """Note robots that others have ordered to land or to stop before the end: the run is spoilt without a fault."""
        known, busy = {name for names in self._landed.values() for name in names}, self._changes.under_way
        duration_s = self._experiment.duration_s
        for name, view in self._robots.items():
            if view.status is None or view.gone or name in busy or name in known or not view.reached("landing"):
                continue
            after_s = max(0.0, view.status.ended + view.clock_off - start)
            if after_s < duration_s - EARLY_S and view.status.reason.startswith((LAND, STOP, TOLD_TO_END)):
                self._landed.setdefault((view.status.reason, f"after {after_s:.1f} of {duration_s:g} s"), []).append(
                    name
                )
        for name, at in self._changes.stopped.items():
            if name not in known:
                self._landed.setdefault((STOP, f"after {at - start:.1f} of {duration_s:g} s"), []).append(name)

    def _landings(self) -> list[str]:
        """Sentences about the robots of `_note_landings`."""
        return [f"{', '.join(who)} landed {when}: {why} by an operator" for (why, when), who in self._landed.items()]

    def _start_late(self, start: float) -> None:
        """Repeat the start to robots that still wait: a busy machine may have lost the order, or its answer."""
        now, busy = self._clock.utc(), self._changes.under_way
        late = [
            name
            for name, view in self._robots.items()
            if view.status is not None and view.status.phase == "airborne" and view.status.stamp > start + LATE_S
            if not view.gone and name not in busy
        ]
        if late and now > self._repeat_at:
            self._repeat_at = now + LATE_S
            for name in late:
                self._view.report("late", name, "still waits for the start; ordered again")
            self._view.order(late, messages.Order("start", at=start))

    def _report_tardy(self, start: float) -> None:
        """Report robots that began earlier or later than all, also by a wrong clock: it spoils or fails the run."""
        for name in sorted(self._starting):
            view = self._robots[name]
            if view.began is None and not view.gone and name not in self._changes.under_way:
                continue
            self._starting.remove(name)
            off = 0.0 if view.began is None else view.began + view.clock_off - start
            if abs(off) > TARDY_S:
                text = f"began {abs(off):.2f} s {'before' if off < 0.0 else 'after'} the common start"
                self._view.report("late" if abs(off) <= LATE_S else "failed", name, text)

    def _report_unbegun(self) -> None:
        """Report robots that did not begin at all, at the end of a run that went on to there."""
        for name in [] if self._context.ended() else sorted(self._starting):
            view = self._robots[name]
            if view.began is None and not view.gone and not (view.status is not None and view.status.started):
                self._view.report("failed", name, f"took no part: it did not begin: {self._reason(name)}")

    def _land(self) -> None:
        self._view.refuse_joining()
        self._changes.close()
        self._progress.phase = "stopped" if self._context.emergency else "landing"
        if self._context.emergency:
            self._view.report("stop", "conductor", f"{self._context.emergency.words}; the run ends here")
        how = "emergency stop" if self._context.emergency else "interrupted" if self._context.ended() else ""
        self._view.report("phase", "conductor", "landing" + (f" ({how})" if how else ""))
        land_s = self._context.launcher.land_s
        deadline, repeat_at = time.monotonic() + land_s, -inf
        while True:
            self._update()  # raises before robots count as late that stood still with this process
            if time.monotonic() >= repeat_at:  # a busy machine may have lost the order
                up = [name for name, view in self._robots.items() if not view.reached("landing")]
                self._order(messages.Order("land"), up)
                repeat_at = time.monotonic() + LATE_S
            late = self._not_down()
            if not late or time.monotonic() >= deadline:
                break
            time.sleep(POLL_S)
        for name in late:
            self._leave_behind(name, f"did not end its landing within {land_s:g} s: {self._reason(name)}")
            status = self._robots[name].status
            if status is not None and self._clock.utc() - status.stamp > land_s:  # a process that stands still
                self._processes.kill(name)
        self._progress.phase = "done"
        self._show(self._progress)

    def _not_down(self) -> list[str]:
        """Robots that are left and have neither landed nor never risen."""
        left = {name: view.phase for name, view in self._robots.items() if not (view.gone or view.reached("done"))}
        return [name for name, phase in left.items() if phase not in {"starting", "idle"}]

    def _leave_behind(self, name: str, why: str) -> None:
        """Report a robot that did not end as ordered: it counts as lost, once, and fails the run."""
        if not self._robots[name].gone:
            self._robots[name].left_because = "lost"
            self._view.report("lost", name, why)

    def _update(self) -> None:
        now, report = self._clock.utc(), self._view.report
        for name in self._view.update():
            self._miss(name)
        for death in self._processes.deaths():
            if death.kind == "lost" and self._changes.expects(death.source, death.text):
                continue
            report(death.kind, death.source, death.text)
            if death.kind == "recorder":
                self._view.await_recorder()
                if self._progress.elapsed is not None:
                    self.failures.append(death.text)
            elif death.kind == "lost":
                self._robots[death.source].alive = False
                self._changes.mark_lost(death.source)
        for name, view in self._robots.items():
            if view.left_because == "lost" and view.alive and view.status is not None and now - view.status.stamp < 1.0:
                self._come_back(name, view)
        if self._view.recorder_stands_still:
            self._processes.kill_recorder()
        self._changes.advance()
        self._show_progress()

    def _miss(self, name: str) -> None:
        """Report an adopted robot with a token that has vanished for good."""
        if name not in self._processes.adopted or self._changes.expects(name, "it is gone"):
            return
        if not self._robots[name].reached("landing"):  # a robot that is down before the others undeclares its token
            self._view.report("lost", name, "is not on the network any more")
            self._changes.mark_lost(name)

    def _come_back(self, name: str, view: run_view.RobotView) -> None:
        """Take back a robot that was only away, or was started again."""
        if name in self._changes.under_way:
            return
        view.left_because = ""
        joins = "" if view.reached("running") else f"; `./zenpark robot add {name}` lets it join the run"
        self._view.report("back", name, f"alive again{joins}")
        if not self._processes.runs(name):
            self._processes.adopted.add(name)

    def _order(self, order: messages.Order, to: Sequence[str] | None = None) -> list[str]:
        """Give an order to all robots that are left, or to some of them; report and return those that refused."""
        left = [name for name, view in self._robots.items() if not (view.gone or view.status is None)]
        replies = self._view.order([name for name in left if to is None or name in to], order)
        refused = {name: reply.reason for name, reply in replies.items() if not reply.ok}
        for name, reason in refused.items():
            self._view.report("refused", name, f"{order.order}: {reason}")
        return list(refused)

    def _reason(self, name: str) -> str:
        status = self._robots[name].status
        if status is None:
            return "no status of its process yet"
        return status.reason or f"it is {status.phase}"

    def start_failure(self, names: Sequence[str], what: str) -> str:
        flown = self._lifted or any(view.reached("airborne") for view in self._robots.values())
        moved = "a take-off was ordered: robots may have moved, all are landed" if flown else "nothing has moved"
        lines = [f"{', '.join(names)}: {what}; {moved}"]
        for name in names:
            gone = self._robots[name].gone  # the event of its end has then shown the last line of its output
            if not gone or self._robots[name].status is not None:
                last = "" if gone else self._processes.last_line(name)
                lines.append(f"  {name}: {self._reason(name)}" + (f"\n    {last}" if last else ""))
        ended = all(self._robots[name].gone for name in names)
        remedy = "mend that" if ended else "mend that, give them more time with start.deadline_s"
        lines.append(f"  {remedy}, or go on without them with start.missing = 'go-on'")
        return "\n".join(lines)
