"""Supervisor: state machine that permits or forbids the motors.

The states follow the firmware's, with one transition that the firmware's table lacks: a Crazyflie that levelled out
without setpoints does not count as landed; it locks.
"""

from __future__ import annotations

from enum import IntEnum
from math import inf
from typing import Final

from bridges.crazyflie.protocol.crtp import Info

LEVEL_S: Final = 0.5  # an older low-level setpoint is ignored: the drone levels out
LOCK_S: Final = 2.0  # time without setpoints after which the drone locks
FLYING_S: Final = 2.0  # time after the last turn of its motors for which a drone counts as flying
LANDED_S: Final = 3.0  # time from landing to disarming
PREFLIGHT_S: Final = 30.0  # time from arming to disarming, if it does not take off
SPIN_UP_S: Final = 0.5  # time from the arming of brushless motors to their readiness
WATCHDOG_S: Final = 1.0  # longest time between two packets of the emergency watchdog


class SupervisorState(IntEnum):
    """State of a supervisor."""

    DISARMED = 0
    READY = 1
    FLYING = 2
    LEVEL = 3  # setpoints have ceased: height and attitude are held, not the position
    LANDED = 4
    LOCKED = 5  # lasts until a restart
    ARMING = 6  # brushless motors spin up: armed, but not yet allowed to fly
    CRASHED = 7  # lasts until it stands upright again and recovery is requested


MAY_FLY: Final = (SupervisorState.READY, SupervisorState.FLYING, SupervisorState.LEVEL, SupervisorState.LANDED)


class Supervisor:
    """Supervisor of one drone."""

    def __init__(self, *, auto_arm: bool) -> None:
        self._auto = auto_arm
        self.tumbled = False  # upside down, or on its side
        self._since = 0.0  # time of arming or landing [s]
        self.restart()

    def restart(self) -> None:
        """State after switching on."""
        self.state = SupervisorState.READY if self._auto else SupervisorState.DISARMED
        self._motors_ran = -inf
        self._watchdog = inf  # infinity while it is not in use
        self._stop = False

    @property
    def may_fly(self) -> bool:
        """Whether the motors may turn."""
        return self.state in MAY_FLY

    @property
    def level(self) -> bool:
        """Whether horizontal setpoints are ignored."""
        return self.state == SupervisorState.LEVEL

    @property
    def armed(self) -> bool:
        return self.may_fly or self.state == SupervisorState.ARMING

    def arm(self, t: float, *, on: bool) -> bool:
        """Arm or disarm; False if not possible in this state."""
        if on and self.state == SupervisorState.DISARMED and not self.tumbled:
            self.state, self._since = SupervisorState.ARMING, t
        elif not on and self.state in (SupervisorState.FLYING, SupervisorState.LEVEL) and not self._auto:
            self._stop = True  # disarmed in the air, it locks
        elif not on and self.state not in (SupervisorState.LOCKED, SupervisorState.CRASHED):
            self.state = SupervisorState.DISARMED
        return self.armed == on

    def recover(self) -> bool:
        """Recover from a crash, once it stands upright; whether it is in order."""
        if self.state == SupervisorState.CRASHED and not self.tumbled:
            self.state = SupervisorState.DISARMED
        return self.state != SupervisorState.CRASHED

    def stop(self) -> None:
        """Request an emergency stop."""
        self._stop = True

    def reset_watchdog(self, t: float) -> None:
        """Restart the emergency watchdog, which is active from its first packet on."""
        self._watchdog = t

    def advance(self, t: float, age: float, *, spinning: bool) -> bool:
        """Advance one tick to `t` [s]; returns whether the drone has just been locked or has crashed.

        `age`: of the newest setpoint [s]; `spinning`: motors turn.
        """
        if spinning:
            self._motors_ran = t
        before = self.state
        self.state = self._next(t, age)
        if self.state != before and self.state in (SupervisorState.LANDED, SupervisorState.READY):
            self._since = t
        return self.state != before and self.state in (SupervisorState.LOCKED, SupervisorState.CRASHED)

    def _next(self, t: float, age: float) -> SupervisorState:  # noqa: PLR0911 - a table of transitions
        state, flying = self.state, t - self._motors_ran < FLYING_S
        settled = t - self._since
        airborne = state in (SupervisorState.FLYING, SupervisorState.LEVEL)
        late = self._stop or t - self._watchdog > WATCHDOG_S or (airborne and age > LOCK_S)
        if late or (state == SupervisorState.LEVEL and self.tumbled):
            return SupervisorState.LOCKED
        if state == SupervisorState.FLYING and self.tumbled:
            return SupervisorState.CRASHED
        if self.tumbled and state in (SupervisorState.READY, SupervisorState.ARMING):
            return SupervisorState.DISARMED
        if state == SupervisorState.DISARMED and self._auto and not self.tumbled:
            return SupervisorState.READY
        if state == SupervisorState.ARMING and settled >= SPIN_UP_S:
            return SupervisorState.READY
        if airborne and (state == SupervisorState.LEVEL) != (age > LEVEL_S):
            return SupervisorState.LEVEL if age > LEVEL_S else SupervisorState.FLYING
        if state == SupervisorState.FLYING and not flying:
            return SupervisorState.LANDED
        if state in (SupervisorState.READY, SupervisorState.LANDED) and flying:
            return SupervisorState.FLYING
        if state == SupervisorState.READY and not self._auto and settled > PREFLIGHT_S:
            return SupervisorState.DISARMED
        if state == SupervisorState.LANDED and settled > LANDED_S:
            return SupervisorState.DISARMED
        return state

    @property
    def info(self) -> Info:
        """Flags, without those of the planner."""
        state = self.state
        flags = {
            Info.CAN_BE_ARMED: state == SupervisorState.DISARMED and not self.tumbled,
            Info.ARMED: self.armed,
            Info.CAN_FLY: self.may_fly,
            Info.AUTO_ARM: self._auto,
            Info.FLYING: state in (SupervisorState.FLYING, SupervisorState.LEVEL),
            Info.TUMBLED: self.tumbled,
            Info.LOCKED: state == SupervisorState.LOCKED,
            Info.CRASHED: state == SupervisorState.CRASHED,
        }
        return Info(sum(flag for flag, holds in flags.items() if holds))
