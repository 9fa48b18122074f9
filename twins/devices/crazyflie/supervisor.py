"""The supervisor: whether the motors may turn, and when they must not.

The table of states follows the firmware's, with the edge that it lacks: a Crazyflie that levelled out because nobody
spoke to it does not become a landed one, it locks.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from agents.arrays import Array, Mask
from agents.protocols.crtp import Info

LEVEL_S: Final = 0.5  # a low-level setpoint older than this is not followed any more
LOCK_S: Final = 2.0  # and after this nobody will come back
SPUN_S: Final = 2.0  # it counts as flying for so long after its motors turned
LANDED_S: Final = 3.0  # from landing to disarming
PREFLIGHT_S: Final = 30.0  # from arming to disarming, if it does not take off
WATCHDOG_S: Final = 1.0  # between two packets of the emergency watchdog


class State(IntEnum):
    """Where a supervisor stands."""

    DISARMED = 0
    READY = 1
    FLYING = 2
    LEVEL = 3  # setpoints have stopped coming: it holds its height and its attitude, not its place
    LANDED = 4
    LOCKED = 5  # for ever: only a restart helps


class Supervisor:
    """Supervisors of N rows.

    Attributes:
        state: (N,) each a `State`.
    """

    def __init__(self, auto_arm: Mask) -> None:
        rows = len(auto_arm)
        self._auto = auto_arm
        self.state: NDArray[np.int8] = np.where(auto_arm, State.READY, State.DISARMED).astype(np.int8)
        self._since = np.zeros(rows)  # armed, or landed
        self._spun = np.full(rows, -np.inf)
        self._fed = np.full(rows, np.inf)  # watchdog; infinity while it is not in use
        self._stop = np.zeros(rows, dtype=bool)

    @property
    def may_fly(self) -> Mask:
        """(N,) motors may turn."""
        return np.asarray((self.state != State.DISARMED) & (self.state != State.LOCKED))

    @property
    def level(self) -> Mask:
        """(N,) setpoints are not followed in the horizontal."""
        return np.asarray(self.state == State.LEVEL)

    def arm(self, row: int, t: float, *, on: bool) -> bool:
        """Arms or disarms; False if that is not possible now."""
        if on and self.state[row] == State.DISARMED:
            self.state[row], self._since[row] = State.READY, t
        elif not on and self.state[row] != State.LOCKED:
            self.state[row] = State.DISARMED
        return bool(self.armed(row) == on)

    def armed(self, row: int) -> bool:
        """Whether a row is armed."""
        return bool(self.may_fly[row])

    def stop(self, row: int) -> None:
        """Emergency stop."""
        self._stop[row] = True

    def feed(self, row: int, t: float) -> None:
        """A packet of the emergency watchdog: from the first one on they must keep coming."""
        self._fed[row] = t

    def advance(self, t: float, spinning: Mask, age: Array) -> Mask:
        """One tick; returns (N,) which rows have just been locked.

        Args:
            t: Now [s].
            spinning: (N,) motors turn.
            age: (N,) of the newest setpoint [s].
        """
        self._spun[spinning] = t
        flying, state = t - self._spun < SPUN_S, self.state
        airborne = (state == State.FLYING) | (state == State.LEVEL)
        lock = (state != State.LOCKED) & (self._stop | (t - self._fed > WATCHDOG_S) | (airborne & (age > LOCK_S)))
        settled = t - self._since
        home = np.where(self._auto, State.READY, State.DISARMED)
        after = np.select(
            [
                lock,
                (state == State.FLYING) & (age > LEVEL_S),
                (state == State.LEVEL) & (age <= LEVEL_S),
                (state == State.FLYING) & ~flying,
                ((state == State.READY) | (state == State.LANDED)) & flying,
                (state == State.READY) & ~self._auto & (settled > PREFLIGHT_S),
                (state == State.LANDED) & (settled > LANDED_S),
            ],
            [State.LOCKED, State.LEVEL, State.FLYING, State.LANDED, State.FLYING, State.DISARMED, home],
            state,
        ).astype(np.int8)
        self._since[(after == State.LANDED) & (state != State.LANDED)] = t
        self.state = after
        return np.asarray(lock)

    def info(self, row: int) -> Info:
        """What a row says of itself, without the planner's part."""
        state = State(self.state[row])
        info = Info(0)
        if state == State.DISARMED:
            info |= Info.CAN_BE_ARMED
        if self.may_fly[row]:
            info |= Info.ARMED | Info.CAN_FLY
        if self._auto[row]:
            info |= Info.AUTO_ARM
        if state in (State.FLYING, State.LEVEL):
            info |= Info.FLYING
        if state == State.LOCKED:
            info |= Info.LOCKED
        return info
