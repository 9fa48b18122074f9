"""Safety, the last word before a body: whatever was decided, this is what may be sent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agents.avoidance import Avoidance, Nearby, Self
from agents.kinds import Kind
from agents.plugins import FAILURES, PluginError
from agents.rows import Array, Mask, Rows, clamp, every, norm, some, span

ESCAPED = 0.25  # [m] this far outside the arena a robot is no longer under control
ABSURD = 1e6  # [m, m/s, rad, rad/s] no place, speed or angle is that large; NaN is not smaller either
ROUNDING = 1e-9  # smaller differences are arithmetic, not interventions


@dataclass(frozen=True)
class Limits:
    """What no setpoint may exceed.

    Attributes:
        low: (3,) smallest x, y, z of the arena [m].
        high: (3,) largest x, y, z of the arena [m].
        margin: Goals stay this far inside the walls [m].
        speed: [m/s]; the kind's own where that is lower.
        goal_step: Farthest goal from where the robot is [m].
        own_silence_s: Own position older than this is none.
        blind_s: A flying row that has no position of its own for this long lands; one number, or one for each row.
        link_silence_s: A neighbour gone for this long is left out.
    """

    low: Array
    high: Array
    margin: float = 0.05
    speed: float = np.inf
    goal_step: float = 0.5
    own_silence_s: float = 0.5
    blind_s: float | Array = 0.3
    link_silence_s: float = 1.0


@dataclass(frozen=True)
class Verdict:
    """What may be sent, and what else must happen.

    Attributes:
        setpoint: (N, 4) safe.
        changed: (N,) the setpoint was not what had been decided.
        blind: (N,) own position missing, stale or not finite: no closed loop is possible.
        escaped: (N,) outside the arena beyond any doubt.
        avoided: (N,) avoidance changed the setpoint.
    """

    setpoint: Array
    changed: Mask
    blind: Mask
    escaped: Mask
    avoided: Mask


class Safety:
    """Checks setpoints of rows of any kinds."""

    def __init__(self, kinds: Sequence[Kind], limits: Limits) -> None:
        takes = np.array([kind.takes for kind in kinds])
        self.limits = limits
        position, velocity, twist = (np.flatnonzero(takes == what) for what in ("position", "velocity", "twist"))
        self._position, self._velocity, self._twist = span(position), span(velocity), span(twist)
        self._any_position, self._any_velocity, self._any_twist = len(position), len(velocity), len(twist)
        self._takes_position = takes == "position"
        self._speed = np.minimum(np.array([kind.speed for kind in kinds]), limits.speed)
        # a body that closes position errors by itself goes as fast as its goal is far
        self._step = np.minimum(limits.goal_step, self._speed / np.array([kind.response for kind in kinds]))
        self._turn_rate = np.array([kind.turn_rate for kind in kinds])
        flies = np.array([kind.flies for kind in kinds])[:, None]
        inside = np.array([limits.margin, limits.margin, 0.0])
        floor, ceiling = np.array([0.0, 0.0, np.inf]), np.array([0.0, 0.0, limits.margin])
        self._low = limits.low + inside - np.where(flies, 0.0, floor)  # ground robots have no business with heights
        self._high = limits.high - inside - np.where(flies, ceiling, -floor)
        self._centre = 0.5 * (limits.low + limits.high)
        self._lost = 0.5 * (limits.high - limits.low) + ESCAPED

    def check(  # noqa: PLR0917 - the four that always are, and those of avoidance
        self,
        setpoint: Array,
        position: Array,
        yaw: Array,
        age: Array,
        avoidance: Avoidance | None = None,
        own: Self | None = None,
        nearby: Nearby | None = None,
    ) -> Verdict:
        """The last word.

        Args:
            setpoint: (N, 4) as decided, in the meaning of each row's kind.
            position: (N, 3) measured [m].
            yaw: (N,) measured [rad].
            age: (N,) of that measurement [s].
            avoidance: Has its say after all limits.
            own: For it.
            nearby: For it.
        """
        limits = self.limits
        near = np.abs(position - self._centre) <= self._lost
        known = (np.abs(yaw) < ABSURD) & (age <= limits.own_silence_s)
        sane = np.abs(setpoint) < ABSURD
        nobody: Mask = np.zeros(len(yaw), dtype=bool)
        blind, wild, escaped = nobody, nobody, nobody
        safe, here = setpoint.copy(), position
        troubled = not (every(near) and every(known) and every(sane))
        if troubled:
            blind = ~np.asarray(known & (np.abs(position) < ABSURD).all(axis=1))
            wild, escaped = ~np.asarray(sane.all(axis=1)), ~np.asarray(near.all(axis=1) | blind)
            here, yaw = np.where(blind[:, None], self._centre, position), np.where(blind, 0.0, yaw)
            safe[blind | wild] = 0.0
            stay = wild & self._takes_position
            safe[stay, :3] = here[stay]
        self._limit(safe, here, yaw)
        avoided = nobody
        if avoidance is not None and own is not None and nearby is not None:
            limited = safe
            safe = self._restrained(avoidance, limited, own, nearby, here, yaw, blind | wild)
            if safe is not limited:
                avoided = np.asarray((np.abs(safe - limited) > ROUNDING).any(axis=1))
        other = np.abs(safe - setpoint) > ROUNDING
        changed = np.asarray(other.any(axis=1)) if some(other) else nobody
        if troubled:
            changed = (changed | wild) & ~blind
            # a body that controls its position on board keeps its last setpoint while the position is not known here
            safe[blind & self._takes_position] = np.nan
        return Verdict(safe, changed, blind, escaped, avoided)

    def _limit(self, setpoint: Array, here: Array, yaw: Array) -> None:
        """Brings setpoints (N, 4) within all limits, in place."""
        if self._any_position:
            rows = self._position
            setpoint[rows, :3] = self._near(setpoint[rows, :3], here[rows], rows)
        if self._any_velocity:
            rows = self._velocity
            setpoint[rows] = self._slow(setpoint[rows], here[rows], rows)
        if self._any_twist:
            rows = self._twist
            setpoint[rows, :2] = self._drive(setpoint[rows, :2], here[rows, :2], yaw[rows], rows)

    def _restrained(  # noqa: PLR0917
        self, avoidance: Avoidance, setpoint: Array, own: Self, nearby: Nearby, here: Array, yaw: Array, unknown: Mask
    ) -> Array:
        """What avoidance makes of setpoints (N, 4) that are within the limits, within the limits again.

        An avoidance may be somebody's first: one that fails is named, a row that is not made of numbers is not taken,
        and `unknown` rows (N,), which do not know where they are or what they want, stay as they are.
        """
        name = type(avoidance).__name__
        try:
            wished = np.asarray(avoidance.restrain(setpoint.copy(), own, nearby), dtype=float)
        except FAILURES as error:
            raise PluginError(f"the avoidance {name} failed: {type(error).__name__}: {error}") from error
        if wished.shape != setpoint.shape:
            raise PluginError(
                f"`restrain` of the avoidance {name} must give a setpoint per row, {setpoint.shape}, not {wished.shape}"
            )
        other = np.asarray((wished != setpoint).any(axis=1) & np.isfinite(wished).all(axis=1))
        other &= ~unknown
        if not some(other):
            return setpoint
        again = np.where(other[:, None], wished, setpoint)
        self._limit(again, here, yaw)
        return np.where(other[:, None], again, setpoint)  # limits twice over may differ in the last bit

    def _near(self, target: Array, here: Array, rows: Rows) -> Array:
        """Goals inside the arena and not too far ahead of the robot."""
        target = clamp(target, self._low[rows], self._high[rows])
        step = target - here
        length, longest = norm(step), self._step[rows]
        far = length > longest
        if some(far):
            target[far] = here[far] + step[far] * (longest[far] / length[far])[:, None]
        return target

    def _slow(self, velocity: Array, here: Array, rows: Rows) -> Array:
        """Velocities within the limits, and not out of the arena."""
        speed, turn = self._speed[rows, None], self._turn_rate[rows]
        linear = clamp(velocity[:, :3], -speed, speed)
        outward = ((here > self._high[rows]) & (linear > 0)) | ((here < self._low[rows]) & (linear < 0))
        velocity[:, :3] = np.where(outward, 0.0, linear)
        velocity[:, 3] = clamp(velocity[:, 3], -turn, turn)
        return velocity

    def _drive(self, twist: Array, here: Array, yaw: Array, rows: Rows) -> Array:
        """Twists within the limits, and not out of the arena: turning on the spot is always allowed."""
        speed, turn = self._speed[rows], self._turn_rate[rows]
        v = clamp(twist[:, 0], -speed, speed)
        low, high = self._low[rows, :2], self._high[rows, :2]
        if some((here > high) | (here < low)):
            heading = np.stack([np.cos(yaw), np.sin(yaw)], axis=1) * v[:, None]
            outward = ((here > high) & (heading > 0)) | ((here < low) & (heading < 0))
            v = np.where(outward.any(axis=1), 0.0, v)
        twist[:, 0], twist[:, 1] = v, clamp(twist[:, 1], -turn, turn)
        return twist
