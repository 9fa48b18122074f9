"""The conductor of the virtual clock: the orders of a real run, at the same moments of the robots' lives."""

from __future__ import annotations

from collections.abc import Sequence
from math import nan
from typing import Final

from agents.decision.lifecycle import Phase
from agents.errors import ExplainedError
from agents.robot import Robot

LEAD_S: Final = 0.5  # time from the order to the common start
ORDERS_S: Final = 0.5  # orders before the start fall on multiples of this, as those of a conductor do
PATIENCE_S: Final = 60.0  # limit for robots to be ready, up or down: after it they never will be


class Stuck(ExplainedError):
    """Robots that do not become ready, airborne or done."""


class VirtualConductor:
    """Orders take-off, common start and end."""

    airborne_at: float  # [s] time of the clock; NaN before
    start_at: float  # [s] common start; NaN before it is known
    over: bool  # all robots are done

    def __init__(self, robots: Sequence[Robot], patience_s: float = PATIENCE_S) -> None:
        self._robots, self._patience_s = robots, patience_s
        self._stage = Phase.READY
        self._since = 0.0
        self.airborne_at = self.start_at = nan
        self.over = False

    def next_order(self, tick: int, dt: float) -> int:
        """Tick after which an order may be due or phases end by the clock; asked before `tick`, of `dt` [s].

        For as long as no phase changes.
        """
        if self._stage == Phase.RUNNING:
            for end in (self.start_at, self.start_at + self._robots[0].assignment.duration):
                if (last := round(end / dt)) > tick:
                    return last
            return tick
        if min([robot.lifecycle.phase for robot in self._robots]) < self._stage:
            return max(tick, round((self._since + self._patience_s) / dt))
        every = max(1, round(ORDERS_S / dt)) if self._stage < Phase.RUNNING else 1
        return -(-tick // every) * every

    def give_orders(self, t: float, dt: float) -> None:
        """Gives the orders that are due after the tick at `t`, of length `dt` [s].

        Raises Stuck if robots have not reached the stage for too long.
        """
        lowest = min([robot.lifecycle.phase for robot in self._robots])
        if self._stage == Phase.RUNNING:
            if lowest >= Phase.LANDING:
                self._since, self._stage = t, Phase.DONE
            return
        if lowest < self._stage:
            if t - self._since > self._patience_s:
                late = [robot for robot in self._robots if robot.lifecycle.phase < self._stage]
                names = ", ".join(sorted(robot.assignment.name for robot in late))
                reason = late[0].lifecycle.reason
                raise Stuck(f"not {self._stage.word} after {self._patience_s:g} s: {names} ({reason})")
            return
        if self._stage < Phase.RUNNING and round(t / dt) % max(1, round(ORDERS_S / dt)):
            return
        self._since = t
        if self._stage == Phase.READY:
            for robot in self._robots:
                robot.lifecycle.takeoff()
            self._stage = Phase.AIRBORNE
        elif self._stage == Phase.AIRBORNE:
            self.airborne_at = t
            self.start_at = t + round(LEAD_S / dt) * dt
            for robot in self._robots:
                robot.lifecycle.start(self.start_at)
            self._stage = Phase.RUNNING
        else:
            self.over = True
