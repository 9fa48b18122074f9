"""The robot process: a deadline loop around the decision. Here is the I/O; `agents.robot` decides.

One plain loop on the clock `uptime`, no asyncio: received samples wait in queues and are polled on each tick. Poses of
neighbours can wake the loop between two ticks: then they are known at once, while decisions keep their ticks.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from math import ceil, inf, isfinite, isnan
from typing import Final, Literal

import zenoh

from agents.body.device_locks import Claims
from agents.body.external_pose import External
from agents.body.interface import Body, BodyState, call_all
from agents.body.measured_positions import MeasuredPositions
from agents.clock import Clock, uptime
from agents.decision.assignment import Assignment
from agents.decision.lifecycle import DONE, RUNNING, TOLD_TO_END
from agents.decision.situation import ProcessHealth
from agents.network import messages, pubsub, validation
from agents.network import session as network
from agents.network.access_control import Rights
from agents.network.channel_model import Conditions
from agents.network.keys import Keys
from agents.network.name_ownership import NameKeeper, OwnershipTiming
from agents.network.shutdown import leave
from agents.plugins.calls import explain
from agents.plugins.registry import FAILURES
from agents.robot import Robot
from agents.runtime import command_line
from agents.runtime.descent import Descent, DescentTiming
from agents.runtime.goal_inbox import GoalInbox
from agents.runtime.lifeline import SILENCE_S as LIFELINE_S
from agents.runtime.lifeline import Lifeline, stop_in
from agents.runtime.orders import LAND, STOP, OrderDesk
from agents.runtime.pose_inbox import PoseInbox
from agents.runtime.range_inbox import RangeInbox
from agents.runtime.telemetry import Counts, TelemetryPublisher
from agents.runtime.watchdog import SILENCE_S
from agents.ticks import Ticks
from agents.vectors import Setpoint

STOP_YIELD_S: Final = 0.05  # sleep after an emergency stop, so that other processes get the CPU to stop their motors
ROUTER_S: Final = 0.045  # pause between two checks of the router

Ranging = Literal["body", "world", "remote"]


@dataclass(frozen=True)
class Setup:
    """Settings of a robot process."""

    keys: Keys  # key expressions of the realm
    endpoints: Sequence[str]  # routers, or the members of a mesh
    encoding: messages.Encoding  # encoding of sent payloads
    state_hz: float  # [1/s] rate of telemetry
    lifeline: bool  # whether standard input is a lifeline
    externally_measured: Sequence[bool]  # robots with a position measured from outside
    # source of the range readings of each row: its body; the world, by the key `ranges` of the row ("world"); or that
    # key, received by the body itself ("remote"). Left out: the bodies.
    ranging: Sequence[Ranging] = ()
    # externally measured rows with noise-free positions from a simulation, which may repeat. Left out: none
    exact: Sequence[bool] = ()
    # effects of the modelled channel on received poses, for each robot by link; empty: none
    conditions: Sequence[Sequence[Conditions]] = ()
    goal_conditions: Sequence[Conditions] = ()  # conditions on received goals, for each robot; empty: none
    clock: Clock = field(default_factory=Clock)  # clock of the experiment
    once: bool = False  # the process ends when its robots are down after an experiment
    rights: Rights | None = None  # enforced by the robots themselves in the mesh of a lab
    # [s] without a tick after which the watchdog lands the robots
    loop_timeout_s: float = SILENCE_S
    wake: bool = False  # a pose of a neighbour wakes the loop
    lifeline_s: float = LIFELINE_S  # silence of the lifeline that counts as its loss [s]
    descent: DescentTiming = field(default_factory=DescentTiming)
    ownership: OwnershipTiming = field(default_factory=OwnershipTiming)
    claims: Claims = field(default_factory=Claims)  # locks on the devices of the body


class Runtime:
    """Drives the robots of one process through an experiment."""

    def __init__(self, assignments: Sequence[Assignment], body: Body, setup: Setup) -> None:
        self.health = ProcessHealth()
        self.robots = [Robot(assignment, self.health) for assignment in assignments]
        self._body, self._setup = body, setup
        self._names = tuple(assignment.name for assignment in assignments)
        common = assignments[0]  # rates, limits and duration are those of the experiment
        self._limits, self._duration = common.limits, common.duration
        self._mime = messages.MIME[setup.encoding]
        self._dt = 1.0 / common.body_hz
        self._state_every = round(common.body_hz / setup.state_hz)
        self.counts = Counts([0] * len(self._names))
        self._state_slot = 0
        self._stopping: str | None = None
        self._retired: set[int] = set()  # rows that land, or have landed, while the run goes on
        self._cut_off = False  # motors were cut by a stop that the loop has not polled yet
        self._early_stop: messages.Stop | None = None  # stop on the lifeline, maybe before there is a network
        self._estimators = [External() for _ in self._names]
        self.states: Sequence[BodyState] = ()  # last reading of the body
        self._opened = self._joined = False
        self.ticks = Ticks(common.body_hz, clock=uptime)
        self._bell = pubsub.Bell() if setup.wake else None
        self._utc = 0.0
        self.keeper = NameKeeper(setup.keys, self._names, setup.clock.utc(), setup.ownership)
        self._valid_box = validation.valid_box_of(common.limits.low, common.limits.high)
        self._everyone = tuple(range(len(self._names)))
        self._descent = Descent(
            self.robots, body, self.keeper, self.ticks,
            silence_s=setup.loop_timeout_s, alarm=self._leave_formation, recover=self._land_after_hang,
            timing=setup.descent,
        )  # fmt: skip
        self.watchdog = self._descent.watchdog

    def run(self) -> int:
        """Opens the body, joins the network, drives until all is done; returns the exit code of the process.

        Raises BodyError if the body cannot be opened, and network.Unreachable if no router answers. Raises NameTaken if
        another process owns the name of a robot, or took it while this one was suspended or cut off. The body then
        belongs to that process and is left as it is.
        """
        lost = threading.Event()
        lifeline = Lifeline(lost, self._setup.lifeline_s, on_line=self.follow_line)
        if self._setup.lifeline:
            lifeline.start()
        asked = threading.Event()

        # at the end all steps are tried, the last entry first, even if others raise
        with command_line.on_termination(asked.set), ExitStack() as out:
            session = network.open_session(
                self._setup.endpoints,
                name="+".join(self._names),
                stop=asked,
                lease_s=network.ROBOT_LEASE_S,
                identity=self._names[0],
                rights=self._setup.rights,
            )
            out.callback(leave, session, self)
            self.subscribe_to_stops(session)
            self.keeper.claim(session, self._setup.endpoints, asked)
            out.callback(self.keeper.ownership.end)
            out.callback(self._setup.claims.release)
            self._setup.claims.take()
            self._body.open()
            self._descent.register(out)
            self.join(session)
            self._loop(lambda: lifeline.reason if lost.is_set() else self._reason(asked.is_set()))
        return 0

    def _reason(self, asked: bool) -> str | None:
        if asked:
            return TOLD_TO_END
        return "ordered to leave" if len(self._orders.leaving) == len(self._names) else None

    def subscribe_to_stops(self, session: zenoh.Session) -> None:
        """Subscribes to emergency stops before the body is opened, which may take a minute."""
        self.estop = pubsub.ImmediateSubscriber(session, self._setup.keys.estop, self._cut)
        if self._early_stop is not None:
            self.estop.obey(self._early_stop)

    def follow_line(self, line: bytes) -> None:
        """Follows a line of the lifeline, in its thread: an emergency stop, or a correction of the clock."""
        if (stop := stop_in(line)) is None:
            self._setup.clock.follow(line)
            return
        self._early_stop = stop
        if hasattr(self, "estop"):  # else it is obeyed as soon as there is something to stop
            self.estop.obey(stop)

    def join(self, session: zenoh.Session) -> None:
        self._opened = True
        keys, names = self._setup.keys, self._names
        self._session = self._descent.session = session
        self._router_due = -inf
        self._router = network.RouterWatch(session, keys.alive(names[0]), self._setup.endpoints)
        self._poses = [pubsub.pose_publisher(session, keys.pose(name), self._mime) for name in names]
        self._last = [pubsub.LastValue(session, keys.pose(name), self._mime) for name in names]
        self._orders = OrderDesk(
            session, keys, self._setup.encoding, robots=self.robots, body=self._body, counts=self.counts,
            on_start=self._align,
        )  # fmt: skip
        self._conductor = pubsub.AliveWatch(session, keys.conductor)
        located = [row for row, marked in enumerate(self._setup.externally_measured) if marked]
        exact = [row for row, marked in enumerate(self._setup.exact) if marked]
        silence_s = self._limits.position_timeout_s
        late_s = [robot.assignment.limits.late_s for robot in self.robots]
        self._located = (
            MeasuredPositions(
                session, keys, names, located, self._valid_box, exact=exact, late_s=late_s, silence_s=silence_s
            )
            if located
            else None
        )
        ranging = tuple(self._setup.ranging) or ("body",) * len(names)
        seen_by_world = [row for row, source in enumerate(ranging) if source == "world"]
        self._ranges = RangeInbox(session, keys, names, seen_by_world) if seen_by_world else None
        self._neighbours = neighbours = PoseInbox(
            session, keys, self.robots, valid_box=self._valid_box, conditions=self._setup.conditions, bell=self._bell
        )
        self._goals = None
        if any(robot.guidance is not None for robot in self.robots):
            of_goals = self._setup.goal_conditions
            self._goals = GoalInbox(session, keys, self.robots, valid_box=self._valid_box, conditions=of_goals)
        self._telemetry = TelemetryPublisher(
            session,
            keys,
            self._setup.encoding,
            robots=self.robots,
            neighbours=neighbours,
            counts=self.counts,
            malformed=self._malformed,
            ranged=[source == "body" for source in ranging],
            receipts=None if self._goals is None else self._goals.unreported,
        )
        self._declare_tokens()

    # ------------------------------------------------------------------ the loop

    def _loop(self, stopping: Callable[[], str | None]) -> None:
        command_line.spare_imports()
        self._descent.reason_to_end = stopping
        self._descent.await_ownership()  # opening the body may have taken long
        # one reading: a step of the wall clock in mid-run does not move the experiment
        self._utc = self._telemetry.utc = self._setup.clock.at(self.ticks.start())
        self._joined = True
        self.watchdog.start()
        self.run_ticks(stopping)

    def run_ticks(self, stopping: Callable[[], str | None]) -> None:
        ticks, counts = self.ticks, self.counts
        farewell, patience = inf, inf
        while True:
            self.watchdog.beat()
            if self.watchdog.tripped:
                self._land_after_hang(self.watchdog.forgive())
            self._wait(ticks.until_next())
            if self._cut_off:  # most stops come during that sleep
                self._yield_after_stop()
            if ticks.next >= self._router_due:  # a check of the router costs as much as a law
                self._look_for_router(max(ticks.next, ticks.elapsed()))
            if self._descent.await_ownership():
                continue
            missed = ticks.begin()
            counts.missed += missed
            counts.late_s = max(counts.late_s, ticks.late_s)
            if missed or self.health.missed_share > 0.0:
                self._skip_ticks(missed)
            if missed * self._dt > self._setup.loop_timeout_s:
                self._hold_after_suspend(missed * self._dt)
            t = ticks.t
            ticks.zero -= self._setup.clock.slew(self._dt)
            self.tick(t)
            if farewell == inf and (reason := stopping()) is not None:
                farewell = t + self._descent.limit_s
                self._stopping = reason
                for robot in self.robots:
                    robot.lifecycle.land(reason)
            down = all(robot.lifecycle.phase == DONE for robot in self.robots)
            if down and patience == inf:
                patience = t + self._descent.stop_s
            # statuses tell of a stop that is confirmed late, and of wheels that still roll
            over = down and (t > patience or not (self._descent.airborne or self._telemetry.unconfirmed()))
            if (self._stopping is not None or self._setup.once) and (t > farewell or over):
                self._telemetry.send_statuses(t, everything=True)
                return

    def _wait(self, ahead: float) -> None:
        """Waits until the next tick, `ahead` [s] from now; each pose that arrives meanwhile is received at once.

        A robot only knows more by that: it decides, sends and moves on its ticks.
        """
        ticks, bell = self.ticks, self._bell
        if bell is None or ahead <= 0.0:
            time.sleep(ahead)
            return
        while ahead > 0.0 and bell.wait(ahead):
            now = ticks.elapsed()
            if now < ticks.next and not self._cut_off:  # other processes need the CPU after a stop
                self._neighbours.deliver(now, self._utc)
            # not by `until_next`: a wait that lasts too long delays its tick and skips none
            ahead = ticks.next - ticks.elapsed()

    def tick(self, t: float) -> None:
        self._receive(t)
        states = self.states = self._read(t)
        try:
            running = self._decide(t, states)
        except FAILURES as error:
            plugins = (plugin for robot in self.robots for plugin in robot.assignment.plugins)
            raise explain(error, plugins) from error
        if self._retired or not running:
            self._retire(t)
        self.counts.ticks += 1
        slot = (self.robots[0].tick - 1) // self._state_every
        telemetry = self._telemetry
        if slot != self._state_slot:
            self._state_slot = slot
            telemetry.send_states(t)
            telemetry.send_ranges(states)
        telemetry.send_statuses(t, everything=t >= telemetry.due, states=states, changed=self._neighbours.changed)
        self._neighbours.changed = False

    def _receive(self, t: float) -> None:
        health = self.health
        for _, stands in self._conductor.changes() if self._conductor.queue else ():
            health.conductor_lost_since = inf if stands else min(health.conductor_lost_since, t)
        self._neighbours.deliver(t, self._utc)
        if self._goals is not None:
            self._goals.receive(t, self._utc)
        if self.estop.queue:
            self._apply_stops()
        if (located := self._located) is not None:
            for row, taken, position, yaw in located.receive(self._utc, t):
                robot = self.robots[row]
                if robot.believes(taken, position):
                    self._body.locate(row, taken, position, robot.believed_yaw(taken, yaw))
        self._orders.answer(t, self._utc, self.states)
        for last in self._last:
            if last.queue:
                last.answer()

    def _read(self, t: float) -> Sequence[BodyState]:
        """States of the bodies, completed by what others measure."""
        states = self._body.read(t)
        airborne = False
        for row, state in enumerate(states):
            airborne = airborne or state.flying
            if isnan(state.velocity[0]):
                self._estimators[row].estimate(t, state)
        self._descent.airborne = airborne
        if self._located is not None:
            self._located.annotate(states, t)
        if self._ranges is not None:
            self._ranges.replace_scans(states, self._utc, t)
        return states

    def _decide(self, t: float, states: Sequence[BodyState]) -> bool:
        """Let all robots decide, transmit and act; returns whether all are running, as before."""
        counts, running = self.counts, True
        begun = self.robots[0].decisions > 0
        for row, robot in enumerate(self.robots):
            if robot.transmit(t, states[row]) and row not in self._retired:
                self._send_pose(row, robot, states[row].yaw, t)
        ordered, setpoints = False, []
        for robot in self.robots:
            robot.act(t)
            running = running and robot.lifecycle.phase == RUNNING
            ordered = ordered or robot.stops or robot.lands or robot.takes_off
            setpoints.append(robot.setpoint)
        self._act(setpoints, ordered=ordered)
        if not begun and self.robots[0].decisions:
            counts.begin()
        return running

    def _act(self, setpoints: Sequence[Setpoint], *, ordered: bool) -> None:
        """Commands the body, motors-off first; `ordered`: some robot stops, lands or takes off."""
        self.health.asked_since = inf  # noted
        stale = self._descent.await_ownership()
        overruled = self._cut_off or self.watchdog.tripped  # another thread has ordered the body to stop or to land
        if ordered:
            self._order(stale=stale, overruled=bool(overruled))
        if not overruled and not stale:
            self._body.command(setpoints)
        if self._cut_off and not overruled:  # the stop came in between: it has the last word
            self._body.stop(self._everyone)

    def _order(self, *, stale: bool, overruled: bool) -> None:
        robots, body = self.robots, self._body
        stops = [row for row, robot in enumerate(robots) if robot.stops]
        lands = [row for row, robot in enumerate(robots) if robot.lands]
        call_all(partial(order, rows) for order, rows in ((body.stop, stops), (body.land, lands)) if rows)
        rises = [row for row, robot in enumerate(robots) if robot.takes_off]
        if stale:  # the order is old now
            for row in rises:
                robots[row].lifecycle.land("its process stood still or was cut off at its take-off")
        elif rises and not overruled:
            self._descent.airborne = True
            body.takeoff(rises, [robots[row].assignment.hover for row in rises])

    def _send_pose(self, row: int, robot: Robot, yaw: float, t: float) -> None:
        self.counts.sent[row] += 1
        pose = messages.pose(
            self._names[row], self.counts.sent[row], self._utc + t, robot.sent_position, robot.sent_velocity,
            yaw=yaw, words=robot.words,
        )  # fmt: skip
        payload = messages.encode(pose, self._setup.encoding)
        self._last[row].hold(payload)
        self._poses[row].put(payload)

    # ------------------------------------------------------------------ what is rare

    def _align(self, at: float, t: float) -> None:
        """Aligns the ticks with a common start at `at` [s]: robots that start together decide together."""
        self.ticks.align(at)
        self._telemetry.due = t  # the central controller must know the start in time

    def _declare_tokens(self) -> None:
        self.keeper.declare(self._session, (row for row in self._everyone if row not in self._retired))

    def _retire(self, t: float) -> None:
        """Undeclares the tokens of rows that leave, or land unasked, and silences them: no neighbour must follow them.

        The latter declare theirs again after the experiment; rows that were ordered to land keep theirs.
        """
        during = []
        for row, robot in enumerate(self.robots):
            life = robot.lifecycle
            during.append(isfinite(life.start_at) and t < life.start_at + self._duration)
            # support processes without a launcher end with the last token (`agents.network.shutdown`)
            down = robot.descending if self._stopping is None else life.phase == DONE
            unasked = during[row] and not life.reason.startswith((messages.EMERGENCY, LAND, STOP))
            if down and (unasked or row in self._orders.leaving) and row not in self._retired:
                self._retired.add(row)
                self.keeper.withdraw((row,))  # nothing, if the watchdog has done it
        if back := [row for row in self._retired if not (during[row] or row in self._orders.leaving)]:
            self._retired.difference_update(back)
            self._declare_tokens()

    def _cut(self, _stop: messages.Stop) -> None:
        """Cuts the motors on reception of an emergency stop, in the receiving thread; the loop does the rest.

        A body that is still being opened is stopped on the first tick.
        """
        self._cut_off = True
        if self._opened:
            self._body.stop(self._everyone)

    def _apply_stops(self) -> None:
        """Ends the lifecycle of all rows after an emergency stop, see `_cut`."""
        for stop in network.received(self.estop):
            self._cut_off = False  # the phases hold it from now on
            for robot in self.robots:
                robot.lifecycle.stop(stop.words)

    def _yield_after_stop(self) -> None:
        """Sleeps, so that other processes get the CPU to stop their motors."""
        self._descent.leave_out(ceil(STOP_YIELD_S / self._dt))
        time.sleep(STOP_YIELD_S)

    def _skip_ticks(self, ticks: int) -> None:
        """Count a tick after `ticks` that are too late."""
        self.health.count_tick(ticks, self._dt)
        self._router_due = -inf  # a slow loop looks on each of its ticks
        for robot in self.robots:
            robot.tick += ticks

    def _hold_after_suspend(self, slept: float) -> None:
        """Holds position until neighbour poses are fresh again, after the loop was suspended for `slept` [s]."""
        self.health.mark_resumed(self.ticks.t, slept)
        print(f"{', '.join(self._names)}: stood still for {slept:.1f} s; holding", flush=True)

    def _look_for_router(self, t: float) -> None:
        """Notes since when no router answers; the first sign of a silent one begins the check of the names."""
        health, router = self.health, self._router
        before, health.offline_since = health.offline_since, router.silent_since(t, self._neighbours.arrived)
        self._router_due = t + ROUTER_S if health.offline_since == inf else t
        if router.heard and self._descent.asked_at - self.ticks.zero < before < inf:
            self.keeper.ownership.begin(self._session)

    def _leave_formation(self, why: str) -> None:
        """Removes the robots from the formation while their loop hangs, or is over; called by the watchdog's thread."""
        print(f"{', '.join(self._names)}: {why}; landing it", flush=True)
        if self._joined:
            self._telemetry.repeat_statuses(why, self._setup.clock.utc())
            # a loop that has recovered meanwhile keeps its tokens
            self.keeper.withdraw(self._everyone, lambda: self._descent.begun or bool(self.watchdog.tripped))

    def _land_after_hang(self, why: str) -> None:
        """Lands the robots after the watchdog ordered it, although the loop runs again."""
        for robot in self.robots:
            if robot.lifecycle.active:
                robot.lifecycle.land(why)
            robot.landing.aside = False  # the body lands by other means
        self._retire(self.ticks.t)
        self._declare_tokens()

    def _malformed(self) -> int:
        """Payloads that were refused, of all kinds but poses."""
        return (
            self._orders.malformed
            + (self._goals.malformed if self._goals is not None else 0)
            + (self._located.malformed if self._located is not None else 0)
            + (self._ranges.malformed if self._ranges is not None else 0)
        )
