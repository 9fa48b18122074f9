"""Supervisor: state machine that permits or forbids the motors.

The states follow the firmware's, with one transition that the firmware's table lacks: a Crazyflie that levelled out
without setpoints does not count as landed; it locks.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from agents.protocols.crtp import Info
from twins.arrays import Array, Mask

LEVEL_S: Final = 0.5  # an older low-level setpoint is ignored: the drone levels out
LOCK_S: Final = 2.0  # time without setpoints after which the drone locks
FLYING_S: Final = 2.0  # time after the last turn of its motors for which a drone counts as flying
LANDED_S: Final = 3.0  # from landing to disarming
PREFLIGHT_S: Final = 30.0  # from arming to disarming, if it does not take off
SPIN_UP_S: Final = 0.5  # from the arming of brushless motors to their readiness
WATCHDOG_S: Final = 1.0  # longest time between two packets of the emergency watchdog


class SupervisorState(IntEnum):
    """State of a supervisor."""

    DISARMED = 0
    READY = 1
    FLYING = 2
    LEVEL = 3  # setpoints have ceased: height and attitude are held, not the position
    LANDED = 4
    LOCKED = 5  # until a restart
    ARMING = 6  # brushless motors spin up: armed, but not yet allowed to fly
    CRASHED = 7  # until it stands upright again and recovery is requested


class Supervisor:
    """Supervisors of N rows."""

    def __init__(self, auto_arm: Mask) -> None:
        rows = len(auto_arm)
        self._auto = auto_arm
        self.state: NDArray[np.int8] = np.where(auto_arm, SupervisorState.READY, SupervisorState.DISARMED).astype(
            np.int8
        )
        self.tumbled: NDArray[np.bool_] = np.zeros(rows, dtype=bool)  # upside down, or on their side
        self._since = np.zeros(rows)  # time of arming or landing [s]
        self._motors_ran = np.full(rows, -np.inf)
        self._watchdog = np.full(rows, np.inf)  # watchdog; infinity while it is not in use
        self._stop = np.zeros(rows, dtype=bool)

    @property
    def may_fly(self) -> Mask:
        """Rows (N,) with motors that may turn."""
        state = self.state
        return np.asarray(
            (state == SupervisorState.READY)
            | (state == SupervisorState.FLYING)
            | (state == SupervisorState.LEVEL)
            | (state == SupervisorState.LANDED)
        )

    @property
    def level(self) -> Mask:
        """Rows (N,) that ignore horizontal setpoints."""
        return np.asarray(self.state == SupervisorState.LEVEL)

    def restart(self, row: int) -> None:
        """State after switching off and on."""
        self.state[row] = SupervisorState.READY if self._auto[row] else SupervisorState.DISARMED
        self._motors_ran[row], self._watchdog[row], self._stop[row] = -np.inf, np.inf, False

    def arm(self, row: int, t: float, *, on: bool) -> bool:
        """Arm or disarm a row; False if not possible in its state."""
        if on and self.state[row] == SupervisorState.DISARMED and not self.tumbled[row]:
            self.state[row], self._since[row] = SupervisorState.ARMING, t
        elif not on and self.state[row] in (SupervisorState.FLYING, SupervisorState.LEVEL) and not self._auto[row]:
            self._stop[row] = True  # disarmed in the air, it locks
        elif not on and self.state[row] not in (SupervisorState.LOCKED, SupervisorState.CRASHED):
            self.state[row] = SupervisorState.DISARMED
        return bool(self.armed(row) == on)

    def recover(self, row: int) -> bool:
        """Recover a row from a crash, once it stands upright; whether it is in order."""
        if self.state[row] == SupervisorState.CRASHED and not self.tumbled[row]:
            self.state[row] = SupervisorState.DISARMED
        return bool(self.state[row] != SupervisorState.CRASHED)

    def armed(self, row: int) -> bool:
        return bool(self.may_fly[row] or self.state[row] == SupervisorState.ARMING)

    def stop(self, row: int) -> None:
        """Request an emergency stop of a row."""
        self._stop[row] = True

    def reset_watchdog(self, row: int, t: float) -> None:
        """Restart the emergency watchdog, which is active from its first packet on."""
        self._watchdog[row] = t

    def advance(self, t: float, spinning: Mask, age: Array) -> Mask:
        """Advance one tick; returns the rows (N,) that have just been locked or have crashed.

        Args:
            t: Current time [s].
            spinning: (N,) motors turn.
            age: (N,) of the newest setpoint [s].
        """
        self._motors_ran[spinning] = t
        flying, state = t - self._motors_ran < FLYING_S, self.state
        airborne = (state == SupervisorState.FLYING) | (state == SupervisorState.LEVEL)
        lock = (state != SupervisorState.LOCKED) & (
            self._stop
            | (t - self._watchdog > WATCHDOG_S)
            | (airborne & (age > LOCK_S))
            | ((state == SupervisorState.LEVEL) & self.tumbled)
        )
        crash = (state == SupervisorState.FLYING) & self.tumbled & ~lock
        settled = t - self._since
        rules = (
            (lock, SupervisorState.LOCKED),
            (crash, SupervisorState.CRASHED),
            (
                self.tumbled & ((state == SupervisorState.READY) | (state == SupervisorState.ARMING)),
                SupervisorState.DISARMED,
            ),
            ((state == SupervisorState.DISARMED) & self._auto & ~self.tumbled, SupervisorState.READY),
            ((state == SupervisorState.ARMING) & (settled >= SPIN_UP_S), SupervisorState.READY),
            ((state == SupervisorState.FLYING) & (age > LEVEL_S), SupervisorState.LEVEL),
            ((state == SupervisorState.LEVEL) & (age <= LEVEL_S), SupervisorState.FLYING),
            ((state == SupervisorState.FLYING) & ~flying, SupervisorState.LANDED),
            (((state == SupervisorState.READY) | (state == SupervisorState.LANDED)) & flying, SupervisorState.FLYING),
            ((state == SupervisorState.READY) & ~self._auto & (settled > PREFLIGHT_S), SupervisorState.DISARMED),
            ((state == SupervisorState.LANDED) & (settled > LANDED_S), SupervisorState.DISARMED),
        )
        after = state.copy()
        for rule, to in reversed(rules):  # the first that applies counts; np.select takes five times as long
            after[rule] = to
        self._since[((after == SupervisorState.LANDED) | (after == SupervisorState.READY)) & (state != after)] = t
        self.state = after
        return np.asarray(lock | crash)

    def info(self, row: int) -> Info:
        """Flags of a row, without those of the planner."""
        state, tumbled = self.state[row], self.tumbled[row]
        flags = {
            Info.CAN_BE_ARMED: state == SupervisorState.DISARMED and not tumbled,
            Info.ARMED: self.armed(row),
            Info.CAN_FLY: self.may_fly[row],
            Info.AUTO_ARM: self._auto[row],
            Info.FLYING: state in (SupervisorState.FLYING, SupervisorState.LEVEL),
            Info.TUMBLED: tumbled,
            Info.LOCKED: state == SupervisorState.LOCKED,
            Info.CRASHED: state == SupervisorState.CRASHED,
        }
        return Info(sum(flag for flag, holds in flags.items() if holds))
