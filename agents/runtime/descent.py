"""Landing of the robots of a process by other means than their decisions, and the end of their body."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from math import inf

import zenoh

from agents.body.interface import Body
from agents.body.limits import LOWEST_DESCENT_M_S
from agents.decision.lifecycle import Phase
from agents.network import session as network
from agents.network.name_ownership import ANSWER_S, NameKeeper
from agents.network.shutdown import FAREWELL_S, STOPPED_S
from agents.robot import Robot
from agents.runtime.watchdog import AGAIN_S, DOWN_S, Watchdog
from agents.safety.hazards import Cause
from agents.ticks import Ticks
from agents.vectors import NO_SETPOINT


@dataclass(frozen=True)
class DescentTiming:
    """Limits of a descent."""

    landing_s: float = FAREWELL_S  # [s] least limit for a landing
    stop_s: float = STOPPED_S  # [s] limit for a body to confirm that its motors are off
    again_s: float = AGAIN_S  # [s] pause between two orders
    slowest: float = LOWEST_DESCENT_M_S  # [m/s] lowest speed of a descent


class Descent:
    """Halts and lands the robots of one process when it stood still, when its loop hangs, and when the loop is over.

    A body that belongs to another process, or may do so, is left as it is.
    """

    session: zenoh.Session  # set before the loop begins

    def __init__(
        self,
        robots: Sequence[Robot],
        body: Body,
        keeper: NameKeeper,
        ticks: Ticks,
        *,
        silence_s: float,  # [s] time without a tick after which the watchdog lands the robots
        alarm: Callable[[str], object],  # tells the other processes why they land, in another thread
        recover: Callable[[str], object],  # lands the robots by their decisions, for a reason
        timing: DescentTiming,
    ) -> None:
        self.begun = False  # the loop is over
        self._resigned = False  # no answer came about the owner of the names, and the robots land
        self.airborne = False  # a row flew at the last reading of its body, or took off since
        self.asked_at = -inf  # end of the last wait for the owner of the names, on the clock `uptime` [s]
        self._silent_at = inf  # begin of the first such wait since the last command, on the same clock [s]
        self.reason_to_end: Callable[[], str | None] = lambda: None
        self.stop_s = timing.stop_s  # [s] limit for a body to confirm that its motors are off
        kinds = [robot.assignment.kind for robot in robots]
        self._robots, self._body, self._keeper, self._ticks = robots, body, keeper, ticks
        self._recover, self._timing = recover, timing
        self._limits = robots[0].assignment.limits  # those of the experiment
        self._everyone = tuple(range(len(robots)))
        self._no_setpoints = [NO_SETPOINT] * len(robots)
        self._on_wheels = tuple(row for row, kind in enumerate(kinds) if not kind.flies)
        ceiling = self._limits.high[2] if any(kind.flies for kind in kinds) else 0.0
        longest_s = ceiling / timing.slowest  # [s] landing: what still descends after a limit would fall
        self.limit_s = max(timing.landing_s, longest_s)  # [s] longest landing
        down_s = max(DOWN_S, longest_s)
        self.watchdog = Watchdog(
            body, self._everyone, alarm=alarm, silence_s=silence_s, down_s=down_s,
            displaced=lambda: keeper.ownership.is_contested(self.session),
        )  # fmt: skip

    def await_ownership(self) -> bool:
        """Whether the process was suspended or cut off until now; if so, it has waited until its names were certain.

        While it waits it must not command its bodies, since another process may drive them. Without an answer those on
        wheels halt after `neighbour_timeout_s`. After `offline_s`, or `ANSWER_S` if the process is asked to end, all
        land, also if it is cut off and linked again meanwhile. While the answer names another owner, neither happens.
        The process then drives its bodies again, until it learns that they belong to another one. One that stays cut
        off holds and lands by its decisions.
        """
        ownership, session = self._keeper.ownership, self.session
        if self.watchdog.tripped:  # the watchdog handles a loop that hangs
            return False
        stood = ownership.check_standstill()
        if ownership.check_return(session) or stood:
            ownership.begin(session)
        elif self._keeper.is_owner():
            self._resigned, self._silent_at = False, inf
            return False
        elif not ownership.linked:
            self._silent_at = inf
            return False
        elif self._resigned and not ownership.contested:
            return False
        limits, drives = self._limits, self._on_wheels
        began, self._keeper.hands_off = self._ticks.elapsed(), True
        contested = False
        self._silent_at = min(self._silent_at, self._ticks.zero + began)
        while not self._keeper.is_owner() and (stood or ownership.contested or network.connected(session)):
            silent_s = self._ticks.zero + self._ticks.elapsed() - self._silent_at
            contested |= ownership.contested
            waited = 0.0 if ownership.contested else silent_s  # else the other owner drives them
            if waited > limits.offline_s or (waited > ANSWER_S and self.reason_to_end() is not None):
                what = "stood still" if stood else "was cut off"
                self._resigned = True  # its landing needs ticks
                self._recover(f"it {what}, and for {waited:.0f} s no router answers about the owner of its name")
                break
            if drives and waited > limits.neighbour_timeout_s:
                self._body.land(drives)
                drives = ()
            self.watchdog.beat()
            time.sleep(self._ticks.period)
        ownership.note_run()
        self._keeper.hands_off = False
        over = self._ticks.elapsed()
        self.asked_at = self._ticks.zero + over
        self._robots[0].health.mark_asked(began, contested)
        for robot in self._robots:
            robot.hazards.since[Cause.OWNER] = robot.health.asked_since
        if not stood:  # the machine missed no deadline
            self.leave_out(int((over - began) / self._ticks.period))
        return True

    def leave_out(self, ticks: int) -> None:
        """Leave out the next `ticks` on purpose: they do not count as missed."""
        self._ticks.next += ticks * self._ticks.period
        for robot in self._robots:
            robot.tick += ticks

    def register(self, steps: ExitStack) -> None:
        """Register the steps of the end: land what still flies, stop it, end the watchdog, close the body."""
        steps.callback(self._close_body)
        steps.callback(self.watchdog.end)
        steps.callback(self._order_down, self._body.stop, self.stop_s)
        steps.callback(self._land)

    def _close_body(self) -> None:
        if not self._keeper.hands_off:
            self._body.close()

    def _land(self) -> None:
        """Lands robots that still fly, after an error or too late, before the motors are switched off.

        The others learn of an error at once, of a robot on wheels too: its body may be beyond reach, and drive on.
        """
        if self._keeper.hands_off:
            return
        self.begun = True
        self.watchdog.start()
        failures: list[Exception] = []
        lives, error = [robot.lifecycle for robot in self._robots], sys.exception()
        falls = self._in_the_air(failures) and any(life.phase < Phase.DONE for life in lives)  # else it was stopped
        if error is not None and (falls or any(life.in_motion for life in lives)):
            self.watchdog.call_for_help(f"its control loop broke: {type(error).__name__}: {error}")
        elif falls:
            self.watchdog.call_for_help("it did not land in time")
        if falls:
            self._order_down(self._body.land, self.limit_s)
        if failures:
            raise failures[0]

    def _order_down(self, order: Callable[[Sequence[int]], object], limit_s: float) -> None:
        """Repeats an order until it succeeds and no row flies any more, for at most `limit_s` [s].

        A body that cannot be read gets all of that time if it flew before. The first error is raised at the end.
        """
        if self._keeper.hands_off:
            return
        failures: list[Exception] = []
        begin, again = self._ticks.elapsed(), -inf
        obeyed = False
        while True:
            self.watchdog.beat()
            self.await_ownership()
            if (now := self._ticks.elapsed()) >= again:
                again = now + self._timing.again_s
                obeyed = False
                with _noted(failures):
                    order(self._everyone)
                    obeyed = True
            with _noted(failures):
                self._body.command(self._no_setpoints)  # repeats an order to a body in another process
            if (obeyed and not self._in_the_air(failures)) or now > begin + limit_s:
                break
            time.sleep(self._ticks.period)
        if failures:
            raise failures[0]

    def _in_the_air(self, failures: list[Exception]) -> bool:
        """Whether a row flies, by the last successful reading of its body; an error is noted."""
        with _noted(failures):
            states = self._body.read(max(self._ticks.t, self._ticks.elapsed()))
            self.airborne = any(state.flying for state in states)
        return self.airborne


@contextmanager
def _noted(failures: list[Exception]) -> Iterator[None]:
    """Keeps the first error, to be raised when all has been tried."""
    try:
        yield
    except Exception as error:  # noqa: BLE001
        failures[:] = failures or [error]
