"""Checks of the robots of an experiment before the first flight: each alone, by the processes that a run starts.

All robots are observed at rest together, under the network load of a run. Motors are touched in the trials only, one
robot after the other, under the safety of the robot's own process; an interrupt lands it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Final

import msgspec

from agents.body.interface import UNANSWERED
from agents.body.kinds import KINDS, Trial
from agents.network import messages
from agents.ticks import POLL_S
from experiments.definition.experiment import ChannelTable, Formation, LegTable, RobotTable
from experiments.definition.plan import Plan, latest_s
from experiments.file.document import Document
from experiments.real_time.conductor import preflight_checks as checks
from experiments.real_time.conductor.case_processes import CaseContext
from experiments.real_time.conductor.conduct import RunOptions, Supervision, run_setup, with_bodies
from experiments.real_time.conductor.conductor import CaseRun
from experiments.real_time.conductor.orders import start_lead_s
from experiments.real_time.conductor.preflight_checks import DRIVE_M, HOP_M, Check, Observed, RobotChecks, Tried
from experiments.real_time.conductor.run_view import ShowProgress
from experiments.real_time.hosts.launcher import travel_s

PREFLIGHT: Final = "preflight"  # name of the case, in files and on the console
SAMPLE_S: Final = 2.0  # time for which robots are observed at rest
INSPECT_S: Final = 0.2  # pause of two inspections
HOLD_S: Final = 2.0  # time for which a hopping drone stays at its height
DRIVE_M_S: Final = 0.05  # speed of the drive
DRIVE_S: Final = 4.0  # its duration: the way, and time to stop
RADIUS_M: Final = 1.0  # radius of its arc, which begins along the robot's nose
RISEN_M: Final = 0.03  # a climbing drone is stopped when it is this high,
MOVED_M: Final = 0.02  # way after which a robot on wheels has moved
TRY_S: Final = 4.0  # time without motion after which a robot is stopped nevertheless
STOP_LIMIT_S: Final = 3.0  # time limit for a stop
STANDS_M_S: Final = 0.02  # slower: a robot on wheels stands


@dataclass(frozen=True)
class Trials:
    """Trials beyond observing; all of them touch the motors."""

    hop: bool = False  # drones hop to `HOP_M` (see `alone`), robots on wheels drive `DRIVE_M`
    stop: bool = False  # emergency stop of a drone that begins to climb, of a robot on wheels that drives
    own: bool = False  # kinds that have a `Trial` of their own make it


def check_robots(
    read: Document, folder: Path, options: RunOptions, trials: Trials, user: Supervision
) -> list[RobotChecks]:
    """Check the robots of the first of the chosen cases; return no check if the user ended that before it began.

    After an interrupt the robot that moves lands; emergency stops end the checks as well.
    """
    plan = alone(next(iter(with_bodies(read, options).values())))
    with run_setup(read, {PREFLIGHT: plan}, folder, options, user) as (contexts, _), user.show as show:
        return Inspector(contexts[PREFLIGHT], show, trials).run()


def alone(plan: Plan) -> Plan:
    """The robots of a case without formation and plans: drones hop to `HOP_M`, robots on wheels drive `DRIVE_M`.

    A drone that climbs to a height of its own before it obeys is not sent down to `HOP_M` from there.
    """
    fixed = [name for name, kind in zip(plan.names, plan.kinds, strict=True) if math.isfinite(kind.takeoff_height)]
    robots = {}
    for name, robot in plan.experiment.robots.items():
        hover = robot.hover if robot.hover is None or name in fixed else min(HOP_M, robot.hover)
        robots[name] = msgspec.structs.replace(robot, hover=hover, shadow=None, standby=False)
    around = math.tau * RADIUS_M  # [m]
    arc = {"kind": "circle", "radius": RADIUS_M, "period_s": around / DRIVE_M_S, "turns": DRIVE_M / around}
    drives = [LegTable(at_s=0.0, robot=name, plan=arc) for name, robot in robots.items() if robot.hover is None]
    return plan.changed(
        robots=robots, duration_s=DRIVE_S, timeline=drives, formation=Formation(), channel=ChannelTable(),
        architecture="distributed", avoidance=None, on_loss="none", cases={},
    )  # fmt: skip


class Inspector(CaseRun):
    """Checks the robots of one case, see `check_robots`."""

    def __init__(self, context: CaseContext, show: ShowProgress, trials: Trials) -> None:
        super().__init__(context, show)
        self._trials = trials
        self._ended: dict[str, str] = {}  # last words of processes that have ended
        self._states: dict[str, list[messages.State]] = {}  # states of the robots that are observed

    def run(self) -> list[RobotChecks]:
        """Check all robots; those that have moved are down in any case."""
        self._context.hosts.join(self._plan)
        try:
            self._processes.prepare(recorder=False)
            with ExitStack() as stack:
                self._join(stack)
                self._processes.adopt(())
                self._phase("waiting until all answer")
                self._processes.start()
                self._wait_ready(list(self._robots))
                if self._context.ended():
                    return []
                observed = self._observe()
                today = datetime.now(UTC).date()
                found = checks.at_rest(observed, self._experiment.safety, today)
                for name in (name for name, each in observed.items() if each.status is not None):
                    self._phase(f"{name}: stop, motors off")
                    found[name].append(checks.stop_at_rest(self._experiment.robots[name], self._stop(name, Tried())))
                self._processes.end_robots()
                for name, each in observed.items():
                    found[name] += self._try(name, each, red=any(check.verdict == "bad" for check in found[name]))
                self._phase("done")
        finally:
            self._processes.end()
        robots = self._experiment.robots
        return [RobotChecks(name, robots[name].kind, robots[name].body, each) for name, each in found.items()]

    def _observe(self) -> dict[str, Observed]:
        self._phase("observing all at rest")
        observed = {name: Observed(self._experiment.robots[name]) for name in self._robots}
        self._states = {name: each.states for name, each in observed.items()}
        deadline = time.monotonic() + SAMPLE_S
        while time.monotonic() < deadline and not self._context.ended():
            heard = [name for name, view in self._robots.items() if view.status is not None and name not in self._ended]
            for name, inspection in self._inspect(heard):
                observed[name].inspections.append(inspection)
            self._wait(INSPECT_S, lambda: False)
        for name, each in observed.items():
            each.status, each.behind_s = self._robots[name].status, self._robots[name].behind
            if name in self._ended:
                each.status, each.ended = None, self._ended[name]
            elif name in self._processes.adopted:
                each.ended = "its host has no address: it is started there by hand or at boot; check it there"
        return observed

    def _stop(self, name: str, tried: Tried) -> Tried:
        """Order the motors off, wait until the robot reports that, and add to what was tried."""
        tried.states = self._states[name] = []
        begun = time.monotonic()
        reply = self._order(name, messages.Order("stop"))
        tried.failure = "" if reply.ok else f"refused: {reply.reason}"
        seen, drone = self._robots[name], self._experiment.robots[name].hover is not None

        def obeyed() -> bool:
            status = seen.status
            if status is None or not seen.reached("done") or UNANSWERED in status.body:
                return False
            if drone:
                return not any(inspection.flying for _, inspection in self._inspect([name]))
            last = tried.states[-1].velocity if tried.states else None
            return last is not None and math.hypot(*last[:2]) < STANDS_M_S

        if reply.ok and self._wait(STOP_LIMIT_S, obeyed):
            tried.stopped_s = time.monotonic() - begun
        tried.note = "" if seen.status is None else seen.status.body
        return tried

    def _try(self, name: str, each: Observed, *, red: bool) -> Iterator[Check]:
        """Hop or drive, then stop in motion, of one robot; what is red is not moved."""
        robot, asked = self._processes.robot(name), self._trials
        safety = self._experiment.safety
        trials: list[tuple[str, str, bool, Callable[[], Tried], Callable[[Tried], Check]]] = [
            (checks.hop_of(robot), "hop", asked.hop,
             lambda: self._move(name, robot), lambda tried: checks.hop(each, tried, safety)),
            ("stop, motors on", "stop", asked.stop,
             lambda: self._move(name, robot, stop=True), partial(checks.stop_in_motion, each)),
        ]  # fmt: skip
        own = KINDS[robot.kind].trial
        if own is not None:  # first: the other flights are steered by what it measures
            judged = partial(checks.trial, own, each)
            trials.insert(0, (own.name, own.name, asked.own, lambda: self._own_trial(name, own), judged))
        for check, option, wanted, attempt, judge in trials:
            why = "" if wanted else f"--{option} tries it"
            if wanted and (red or self._context.ended()):
                why = f"not tried: {self._end or 'mend that first'}"
            if not why:
                self._phase(f"{name}: {check}")
                tried = attempt()
                made = judge(tried)
                why = f"{self._end}; {self._at_end(name)}" if self._end and not tried.over else ""
                red = made.verdict == "bad"
            yield Check(check, "unknown", why) if why else made

    def _own_trial(self, name: str, own: Trial) -> Tried:
        """Trial of a kind, flown at the height of its take-off."""
        robot = self._processes.robot(name)
        height = KINDS[robot.kind].takeoff_height
        robot = msgspec.structs.replace(
            robot, hover=height if math.isfinite(height) else robot.hover, device={**robot.device, **own.device}
        )
        return self._move(name, robot, hold_s=own.hold_s)

    def _move(self, name: str, robot: RobotTable, *, stop: bool = False, hold_s: float = HOLD_S) -> Tried:
        """Trial of a robot, with its address, in a process of its own: it hops or drives, and lands or is stopped."""
        tried = Tried()
        self._robots[name].forget_process()
        self._processes.start([name], {name: robot})
        try:
            self._wait_ready([name])
            if self._context.ended() or not self._robots[name].reached("ready"):
                tried.failure = f"not ready: {self._reason(name)}"
                return tried
            tried.states = self._states[name] = []
            tried.failure = self._order_motion(name, robot)
            if not tried.failure:
                if stop:
                    self._wait(TRY_S, lambda: _moved(tried.states, robot))
                    self._stop(name, tried)
                else:
                    self._fly(name, robot, tried, hold_s)
        finally:
            tried.over = tried.over or not self._end
            self._processes.end_robots()  # lands it, whatever has happened
        return tried

    def _order_motion(self, name: str, robot: RobotTable) -> str:
        """Order a robot to move; the reason of a refusal."""
        reply = self._order(name, messages.Order("takeoff"))
        if reply.ok and robot.hover is None:
            self._wait(TRY_S, lambda: self._robots[name].reached("airborne"))
            if self._end:
                return self._end
            reply = self._order(name, messages.Order("start", at=self._clock.utc() + start_lead_s(1)))
        return "" if reply.ok else f"refused: {reply.reason}"

    def _fly(self, name: str, robot: RobotTable, tried: Tried, hold_s: float) -> None:
        """Follow a hop or a drive to its end; a drone lands after `hold_s` [s] at its height."""
        seen = self._robots[name]
        measured = -math.inf

        def measure() -> None:
            nonlocal measured
            if time.monotonic() - measured > INSPECT_S:
                measured = time.monotonic()
                for _, inspection in self._inspect([name]):
                    tried.volts = _lowest(tried.volts, inspection.volts)
                    tried.delay_s = tried.delay_s if inspection.delay_s is None else inspection.delay_s
            tried.charge = _lowest(tried.charge, None if seen.status is None else seen.status.battery)

        def over() -> bool:
            if strays():
                return True
            measure()
            return seen.reached("landing") or name in self._ended

        def strays() -> bool:
            """Whether a drone goes aside; one that flies by positions from outside is stopped, for it would go on."""
            side, limit = checks.aside(tried.states), checks.hop_limit(robot)
            if robot.hover is None or side <= limit:
                return False
            tried.over, outside = not self._end, math.isfinite(latest_s(robot))
            self._order(name, messages.Order("stop" if outside else "land"))
            tried.failure = f"{side:.2f} m to the side (limit {limit:g} m): {'stopped' if outside else 'landed'} there"
            return True

        if robot.hover is None:
            self._wait(DRIVE_S + start_lead_s(1) + travel_s(0.0), over)
        else:
            limit_s = travel_s(robot.hover)
            self._wait(limit_s, lambda: over() or seen.reached("airborne"))
            if tried.failure:
                return
            if not seen.reached("airborne"):
                tried.failure = f"not at {robot.hover:g} m after {limit_s:g} s: {self._reason(name)}"
            elif not self._wait(hold_s, over) and not tried.failure:
                tried.states = list(tried.states)  # the landing is no part of it
                self._order(name, messages.Order("land"))
                if not self._wait(limit_s, lambda: seen.reached("done") or name in self._ended):
                    tried.failure = f"not down after {limit_s:g} s: {self._reason(name)}"
                return
        status = seen.status
        if name in self._ended or (status is not None and status.hazard):
            tried.failure = tried.failure or self._reason(name)
        elif robot.hover is not None and not tried.failure:
            tried.failure = f"came down by itself: {self._reason(name)}"

    def _phase(self, text: str) -> None:
        self._progress.phase = text
        self._view.report("phase", "conductor", text)
        self._show(self._progress)

    def _update(self) -> None:
        self._view.update()
        for state in self._progress.states:
            if state.robot in self._states:
                self._states[state.robot].append(state)
        for death in self._processes.deaths():
            if death.kind == "lost":
                last = self._processes.last_line(death.source).removeprefix("zenpark: ")
                self._ended[death.source] = last or death.text
            else:
                self._view.report(death.kind, death.source, death.text)
        self._show_progress()

    def _wait(self, limit_s: float, true: Callable[[], bool]) -> bool:
        """Wait until something is true; False at the limit, or if the user or an emergency stop ends the checks."""
        deadline = time.monotonic() + limit_s
        while True:
            self._update()
            if true():
                return True
            if self._context.ended() or time.monotonic() > deadline:
                return False
            time.sleep(POLL_S)

    def _wait_ready(self, names: Sequence[str]) -> None:
        """Wait until robots are ready, or have ended, for as long as the file allows."""
        self._ended = {name: words for name, words in self._ended.items() if name not in names}
        limit_s = self._experiment.start.deadline_s
        awaited = [name for name in names if name not in self._processes.adopted]
        self._wait(limit_s, lambda: all(self._robots[n].reached("ready") or n in self._ended for n in awaited))

    def _inspect(self, names: Sequence[str]) -> Iterator[tuple[str, messages.Inspection]]:
        for name, reply in self._view.order(names, messages.Order("inspect")).items():
            if reply.inspection is not None:
                yield name, reply.inspection

    def _order(self, name: str, order: messages.Order) -> messages.Reply:
        return self._view.order([name], order)[name]

    @property
    def _end(self) -> str:
        """Words for the end of the checks; empty while they go on."""
        return "" if not self._context.ended() else "emergency stop" if self._context.emergency else "interrupted"

    def _at_end(self, name: str) -> str:
        """Last report of a robot that was moved about its motors."""
        self._update()
        seen = self._robots[name]
        off = seen.reached("done") and UNANSWERED not in (seen.status.body if seen.status else "")
        return "its motors are off" if off else f"look at it: {self._reason(name)}"

    def _reason(self, name: str) -> str:
        status = self._robots[name].status
        if name in self._ended or status is None:
            return self._ended.get(name, "its process says nothing")
        return status.hazard or status.reason or f"it is {status.phase}" + (f"; {status.body}" if status.body else "")


def _moved(states: Sequence[messages.State], robot: RobotTable) -> bool:
    """Whether a robot has begun to climb or to drive."""
    positions = checks.positions_of(states)
    if not len(positions):
        return False
    x, y, z = positions[-1] - positions[0]
    return bool(math.hypot(x, y) > MOVED_M if robot.hover is None else z > RISEN_M)


def _lowest(*values: float | None) -> float | None:
    return min((value for value in values if value is not None), default=None)
