"""Life of a robot in an experiment: idle, ready, airborne, running, landing, done. Pure.

Orders and facts go in, phases and commands to the body come out. `advance` is quiet while the robot runs.
"""

from __future__ import annotations

from enum import IntEnum
from math import inf, nan
from typing import Final

from agents.body.kinds import Kind
from agents.vectors import Vector, distance, norm


class Phase(IntEnum):
    """Phase in the life of a robot; the numbers grow with time."""

    IDLE = 0  # process alive, something missing: position or a neighbour
    READY = 1  # body open, own position fresh, all neighbours received, `agents.safety.preflight` passed
    AIRBORNE = 2  # hovers at its height (a ground robot: at once) and waits for the common start
    RUNNING = 3  # the experiment
    LANDING = 4  # going down, or rolling out
    DONE = 5  # stands on the ground, motors off

    @property
    def word(self) -> str:
        """Name on the network."""
        return self.name.lower()


# the members of an enumeration are slow to look up, and every tick asks for them
IDLE, READY, AIRBORNE, RUNNING, LANDING, DONE = (int(phase) for phase in Phase)
PHASES: Final = {phase.word: int(phase) for phase in Phase}
UNDER_WAY: Final = (Phase.AIRBORNE.word, Phase.RUNNING.word)

AT_HEIGHT: Final = 0.05  # [m] distance below the hover height at which it has arrived
ABOVE_HEIGHT: Final = 0.1  # [m] excess of height that counts as arrived: a Crazyflie overshoots
FINISHED: Final = "finished"  # reasons for a landing that is no fault; orders are others
SCRIPTED: Final = "lands as its file says"
TOLD_TO_END: Final = "asked to end"
PAUSED: Final = "ordered to hold"
SETTLED: Final = 0.1  # [m/s] slower: climbing or rolling has ended
STANDS: Final = 0.02  # [m/s] slower: wheels stand
STANDS_S: Final = 0.5  # [s] time after which wheels stand that have rolled no farther than
ROLLED: Final = 0.01  # [m]


class Standing:
    """Whether a robot on wheels stands: by its velocity or, as that may be noisy, by its places over half a second."""

    def __init__(self) -> None:
        """Of a robot of which nothing was measured yet."""
        self._place, self._since = (nan, nan, nan), inf

    def stands(self, t: float, place: Vector, velocity: Vector) -> bool:
        """Whether it stands at `t` [s]; an unknown velocity counts as slow."""
        if not distance(place, self._place) <= ROLLED:
            self._place, self._since = place, t
        speed = norm(velocity)
        return not speed >= STANDS or (speed < SETTLED and t - self._since >= STANDS_S)


class Lifecycle:
    """Phases of one robot."""

    def __init__(self, kind: Kind, hover: float, duration: float, lands_at: float = inf) -> None:
        """Of a robot that hovers at `hover` [m], in an experiment of `duration`, and lands at `lands_at` [s] in it."""
        self._flies, self._hover = kind.flies, hover
        self._ends_after, self._scripted = min(duration, lands_at), lands_at < duration
        self.phase = self._before = IDLE  # members of `Phase`
        self.climbing = False  # True on its way up
        self.start_at = inf  # the common start on the process's clock [s]; infinity before it is known
        self.settled_until = -inf  # the robot runs, and goes on, until then [s]: there is no need to advance
        self.moved = False  # whether the phase changed on the last tick, or by an order since the one before
        # commands that the body has not received yet
        self.takeoff_due = self.land_due = self.stop_due = False
        self.reason = self._obstacle = ""  # why it is not ready, or has landed
        self.failing = ""  # check that fails on this tick, though the robot may be ready; empty: none

    def takeoff(self) -> str:
        """Order to climb; returns the reason of a refusal, empty when accepted."""
        if self.climbing or self.phase in (AIRBORNE, RUNNING):
            return ""  # an order may be repeated when its reply was lost
        if self.phase != READY:
            return f"cannot take off while {Phase(self.phase).word}" + (f": {self.reason}" if self.reason else "")
        if self.failing:  # it is being lifted, say: a failure that does not last is over when asked again
            return f"cannot take off now: {self.failing}"
        self.climbing = self.takeoff_due = True
        return ""

    def start(self, at: float) -> str:
        """Order to begin the experiment at `at` on the process's clock [s]; returns as `takeoff`."""
        if self.phase == RUNNING:
            return ""
        if self.phase != AIRBORNE:
            return f"cannot start while {Phase(self.phase).word}"
        self.start_at = at
        return ""

    def land(self, reason: str) -> None:
        """Land, or roll out, in any phase."""
        if self.phase < LANDING:
            self.phase, self.climbing = LANDING, False
            self.reason = reason
            self.takeoff_due, self.land_due = False, True
            self.settled_until = -inf

    def stop(self, reason: str) -> None:
        """Motors off."""
        self.phase, self.climbing = DONE, False
        self.reason = reason
        self.takeoff_due = self.land_due = False  # the body would get them after the stop
        self.stop_due = True
        self.settled_until = -inf

    def set_missing(self, reason: str) -> None:
        """Store why an idle robot is not ready, or why a ready one will not be any more on this tick."""
        self._obstacle = reason
        if self.phase == IDLE:
            self.reason = reason

    @property
    def active(self) -> bool:
        """Whether the robot climbs, waits in the air, or runs."""
        return self.climbing or self.phase in (AIRBORNE, RUNNING)

    @property
    def in_motion(self) -> bool:
        """Whether the robot climbs, waits in the air, runs, or lands."""
        return self.climbing or AIRBORNE <= self.phase <= LANDING

    def stays(self, t: float, position: Vector, velocity: Vector, flying: bool) -> bool:
        """Whether `advance` would change nothing at `t` [s]; quiet. Of a robot that has yet to climb it is False."""
        if self.takeoff_due or self.land_due or self.stop_due:
            return False
        if self.climbing:
            return not self._is_up(position, velocity)
        if self.phase == AIRBORNE:
            return t < self.start_at - 1e-6
        if self.phase == LANDING:
            return not self._is_down(velocity, flying)
        return self.phase == DONE or (self.phase == RUNNING and t < self.settled_until)

    def _is_up(self, position: Vector, velocity: Vector) -> bool:
        """Whether a climb has ended."""
        above = position[2] - self._hover
        return not self._flies or (-AT_HEIGHT < above < ABOVE_HEIGHT and abs(velocity[2]) < SETTLED)

    def _is_down(self, velocity: Vector, flying: bool) -> bool:
        """Whether a landing has ended; an unknown velocity counts as slow."""
        vx, vy, vz = velocity
        slow = not vx * vx + vy * vy + vz * vz >= SETTLED * SETTLED
        return not flying if self._flies else slow

    def advance(self, t: float, position: Vector, velocity: Vector, *, flying: bool, ready: bool) -> None:
        """Advance the phase at `t` [s]: `position` [m], `velocity` [m/s], `flying`: the motors are on.

        `ready`: nothing is missing; a ready robot that loses this is idle again, unless it climbs already.
        """
        self._advance(t, position, velocity, flying, ready)
        self.moved = self.phase != self._before  # orders between ticks count as well
        self._before = self.phase
        if self.phase == RUNNING:
            self.settled_until = self.start_at + self._ends_after - 1e-6

    def _advance(self, t: float, position: Vector, velocity: Vector, flying: bool, ready: bool) -> None:
        if self.phase == IDLE and ready:
            self.phase, self.reason = READY, ""
        elif self.phase == READY and not (ready or self.climbing):
            self.phase, self.reason = IDLE, self._obstacle
        if self.climbing and not self.takeoff_due and self._is_up(position, velocity):
            self.phase, self.climbing = AIRBORNE, False
        if self.phase == AIRBORNE and t >= self.start_at - 1e-6:
            self.phase = RUNNING
        if self.phase == RUNNING and t - self.start_at >= self._ends_after - 1e-6:
            self.land(SCRIPTED if self._scripted else FINISHED)
        if self.phase == LANDING and not self.land_due and self._is_down(velocity, flying):
            self.phase = DONE  # set after the body has received the command
