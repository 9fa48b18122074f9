"""Life of a robot in an experiment: idle, ready, airborne, running, landing, done. Pure and row-wise.

Orders and facts go in, phases come out; resulting commands to the body are collected in `BodyCommands`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from agents.arrays import Array, Index, Mask


class Phase(IntEnum):
    """Phase in the life of a robot; the numbers grow with time."""

    IDLE = 0  # process alive, something missing: position or a neighbour
    READY = 1  # body open, own position fresh, all neighbours received, `agents.safety.preflight` passed
    AIRBORNE = 2  # at its hover height (a ground robot: at once), waiting for the common start
    RUNNING = 3  # the experiment
    LANDING = 4  # going down, or rolling out
    DONE = 5  # on the ground, motors off

    @property
    def word(self) -> str:
        """Name on the network."""
        return self.name.lower()


# the members of an enumeration are slow to look up, and every tick asks for them
IDLE, READY, AIRBORNE, RUNNING, LANDING, DONE = (int(phase) for phase in Phase)

AT_HEIGHT = 0.05  # [m] below the hover height, and less: arrived,
ABOVE_HEIGHT = 0.1  # or above it: a Crazyflie overshoots, and takes 10 s to come back
FINISHED, TOLD_TO_END = "finished", "told to end"  # reasons for a landing that is no fault; orders are others
SETTLED = 0.1  # [m/s] slower: climbing or rolling has ended


@dataclass(frozen=True)
class BodyCommands:
    """Commands to the body: rows that take off, land, and stop their motors."""

    takeoff: Index
    land: Index
    stop: Index


class Lifecycle:
    """Phases of N rows."""

    def __init__(self, flies: Mask, hover: Array, duration: float) -> None:
        """Rows that fly (N,), their hover heights (N,) [m], and the duration of the experiment [s]."""
        rows = len(flies)
        self.phase = np.full(rows, IDLE)
        self.start_at = np.full(rows, np.inf)
        self.reason, self._waits = [""] * rows, [""] * rows
        self.failing: dict[int, str] = {}  # rows that fail a check on this tick, though they may be ready, and why
        self.moved = False  # whether a phase changed on the last tick, or by an order since the one before
        self._before = self.phase.tobytes()
        self._flies, self._hover, self._duration = flies, hover, duration
        self._climbing = np.zeros(rows, dtype=bool)
        self._due: dict[str, list[int]] = {"takeoff": [], "land": [], "stop": []}
        self._settled_until = -np.inf  # no change by itself before this time

    def takeoff(self, row: int) -> str:
        """Order to climb; returns the reason of a refusal, empty when accepted."""
        phase = Phase(self.phase[row])
        if self._climbing[row] or phase in (AIRBORNE, RUNNING):
            return ""  # an order may be repeated when its reply was lost
        if phase != READY:
            return f"cannot take off while {phase.word}" + (f": {self.reason[row]}" if self.reason[row] else "")
        if row in self.failing:  # it is being lifted, say: a failure that does not last is over when asked again
            return f"cannot take off now: {self.failing[row]}"
        self._climbing[row] = True
        self._due["takeoff"].append(row)
        return ""

    def start(self, row: int, at: float) -> str:
        """Order to begin the experiment at `at` on the process's clock [s]; returns as `takeoff`."""
        phase = Phase(self.phase[row])
        if phase == RUNNING:
            return ""
        if phase != AIRBORNE:
            return f"cannot start while {phase.word}"
        self.start_at[row] = at
        return ""

    def land(self, row: int, reason: str) -> None:
        """Land, or roll out, in any phase."""
        if self.phase[row] < LANDING:
            self.phase[row], self._climbing[row], self.reason[row] = LANDING, False, reason
            self._forget("takeoff", row)
            self._due["land"].append(row)
            self._settled_until = -np.inf

    def stop(self, row: int, reason: str) -> None:
        """Motors off."""
        self.phase[row], self._climbing[row], self.reason[row] = DONE, False, reason
        self._forget("takeoff", row)
        self._forget("land", row)  # the body would get it after the stop
        self._due["stop"].append(row)
        self._settled_until = -np.inf

    def _forget(self, what: str, row: int) -> None:
        """Drop a command that the body has not received yet."""
        if row in self._due[what]:
            self._due[what].remove(row)

    def set_missing(self, row: int, reason: str) -> None:
        """Store why an idle row is not ready, or why a ready one will not be any more on this tick."""
        self._waits[row] = reason
        if self.phase[row] == IDLE:
            self.reason[row] = reason

    @property
    def active(self) -> Mask:
        """Rows (N,) that climb, wait in the air, or run."""
        return np.asarray(self._climbing | (self.phase == AIRBORNE) | (self.phase == RUNNING))

    @property
    def climbing(self) -> Mask | None:
        """Rows (N,) on their way up to their height; None if no row is."""
        return self._climbing.copy() if self._climbing.any() else None

    def in_motion(self, row: int) -> bool:
        """Whether a row climbs, waits in the air, runs, or lands."""
        return bool(self._climbing[row] or AIRBORNE <= self.phase[row] <= LANDING)

    @property
    def waiting(self) -> bool:
        """Whether a row has yet to take off."""
        return self._settled_until == -np.inf and bool(self.phase.min() <= READY)

    @property
    def all_running(self) -> bool:
        return self._settled_until > -np.inf or bool((self.phase == RUNNING).all())

    def advance(self, t: float, ready: Mask, position: Array, velocity: Array, flying: Mask) -> BodyCommands | None:
        """Advance the phase of every row at `t` [s]: `position` (N, 3) [m], `velocity` (N, 3) [m/s], `flying` (N,).

        `ready` (N,): nothing is missing; a ready row that loses this is idle again, unless it climbs already.
        """
        if t < self._settled_until:
            self.moved = False
            return None
        phase = self.phase
        lowest, highest = phase.min(), phase.max()
        if lowest <= READY:
            for row in np.flatnonzero((phase == IDLE) & ready):
                phase[row], self.reason[row] = READY, ""
            for row in np.flatnonzero((phase == READY) & ~ready & ~self._climbing):
                phase[row], self.reason[row] = IDLE, self._waits[row]
        if self._climbing.any():
            above = position[:, 2] - self._hover
            there = ~self._flies | ((above > -AT_HEIGHT) & (above < ABOVE_HEIGHT) & (np.abs(velocity[:, 2]) < SETTLED))
            arrived = self._climbing & there & ~np.isin(np.arange(len(phase)), self._due["takeoff"])
            phase[arrived] = AIRBORNE
            self._climbing &= ~arrived
        if lowest <= AIRBORNE:
            phase[(phase == AIRBORNE) & (t >= self.start_at - 1e-6)] = RUNNING
        if highest >= RUNNING:
            over = (phase == RUNNING) & (t - self.start_at >= self._duration - 1e-6)
            for row in np.flatnonzero(over) if over.any() else ():
                self.land(int(row), FINISHED)
        if highest >= LANDING:
            slow = ~((velocity * velocity).sum(axis=1) >= SETTLED**2)  # an unknown velocity counts as slow
            down = (phase == LANDING) & np.where(self._flies, ~flying, slow)
            down[self._due["land"]] = False  # the body has not received the command yet
            phase[down] = DONE
        now = phase.tobytes()
        self.moved, self._before = now != self._before, now  # orders between ticks count as well
        if (phase == RUNNING).all():
            self._settled_until = float(self.start_at.min()) + self._duration - 1e-6
        return self._commands()

    def _commands(self) -> BodyCommands | None:
        if not any(self._due.values()):
            return None
        commands = BodyCommands(*(np.array(self._due[what], dtype=np.intp) for what in ("takeoff", "land", "stop")))
        for rows in self._due.values():
            rows.clear()
        return commands
