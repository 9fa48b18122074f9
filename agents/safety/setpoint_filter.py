"""Setpoint filter, the last stage before a body: limits every setpoint, whatever was decided."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from agents.arrays import Array, Mask, Rows, clamp, every, norm, some, span
from agents.body.kinds import Kind
from agents.body.limits import Limits
from agents.plugins.avoidance import Avoidance, Nearby, OwnState
from agents.plugins.calls import call

FLOOR_M = 0.05  # [m] least height of a goal above the floor, or the robot's own: a descent overshoots its goal
OUTSIDE_M = 0.25  # [m] outside the arena: no longer under control
ABSURD = 1e6  # [m, m/s, rad, rad/s] larger than any place, speed or angle; NaN is not smaller either
BEFORE_WALL = 0.6  # share of the way to a wall that a goal may be ahead: a drone overshoots a step by a tenth
ROUNDING = 1e-9  # smaller differences are arithmetic, not interventions


@dataclass(frozen=True)
class PoseValidity:
    """Validity of the measured poses of N rows: known, fresh, inside the arena."""

    all_valid: bool  # every row knows its pose, and is inside the arena
    invalid: Mask  # (N,) own pose missing, stale or not finite: no closed loop is possible
    outside_wall: Mask  # (N,) outside a wall, or above the ceiling
    outside: Mask  # (N,) outside the arena beyond any doubt
    flyaway: Mask  # (N,) so far outside that a flying row must be stopped there
    excess: Array  # (N,) distance from the arena along the worst axis [m]; 0 inside


class FilteredSetpoint(msgspec.Struct, frozen=True):
    """Safe setpoints, and what was changed."""

    setpoint: Array  # (N, 4) safe
    changed: Mask  # (N,) the setpoint differs from the decided one
    invalid_pose: Mask  # (N,) own pose missing, stale or not finite: no closed loop is possible
    not_finite: Mask  # (N,) decided setpoint not finite although the pose is valid; the row is kept in place instead
    avoided: Mask  # (N,) changed by avoidance


class SetpointFilter:
    """Filter for setpoints of rows of any kinds."""

    def __init__(self, kinds: Sequence[Kind], limits: Limits) -> None:
        takes = np.array([kind.takes for kind in kinds])
        self.limits = limits
        position, velocity, twist = (np.flatnonzero(takes == what) for what in ("position", "velocity", "twist"))
        self._position, self._velocity, self._twist = span(position), span(velocity), span(twist)
        self._any_position, self._any_velocity, self._any_twist = len(position), len(velocity), len(twist)
        self._takes_position = takes == "position"
        self._speed = np.minimum(np.array([kind.speed for kind in kinds]), limits.top_speed)
        # a body that closes position errors by itself goes as fast as its goal is far
        self._closes_s = 1.0 / np.array([kind.response for kind in kinds])
        self._step = np.minimum(limits.goal_step, self._speed * self._closes_s)
        self._turn_rate = np.array([kind.turn_rate for kind in kinds])
        flies = np.array([kind.flies for kind in kinds])
        inside = np.full((len(kinds), 3), limits.margin)
        self._low, self._high = limits.low + inside, limits.high - inside
        # a goal on the floor would be flown into it
        height = np.array([kind.height for kind in kinds])
        self._low[:, 2] = np.where(flies, limits.low[2] + np.maximum(height, FLOOR_M), -np.inf)
        self._high[~flies, 2] = np.inf  # heights do not limit ground robots
        self._centre = 0.5 * (limits.low + limits.high)
        self._half = 0.5 * (limits.high - limits.low)
        self._no_row: Mask = np.zeros(len(kinds), dtype=bool)
        self._sure = PoseValidity(True, *(self._no_row,) * 4, np.zeros(len(kinds)))

    def validate_poses(self, position: Array, yaw: Array, age: Array) -> PoseValidity:
        """Validity of poses: `position` (N, 3) [m], `yaw` (N,) [rad], and their `age` (N,) [s].

        A pose of the future would never become old: its time is wrong.
        """
        off = np.abs(position - self._centre)
        known, fresh = np.abs(yaw) < ABSURD, np.abs(age) <= self.limits.own_silence_s
        if every(off <= self._half) and every(known) and every(fresh):
            return self._sure
        invalid = ~np.asarray(known & fresh & (np.abs(position) < ABSURD).all(axis=1))
        off = np.where(invalid[:, None], 0.0, off)  # an unknown pose is not outside
        excess = np.maximum((off - self._half).max(axis=1), 0.0)
        walls = (off[:, :2] > self._half[:2]).any(axis=1) | (~invalid & (position[:, 2] > self.limits.high[2]))
        outside = np.asarray((off > self._half + OUTSIDE_M).any(axis=1))
        return PoseValidity(False, invalid, np.asarray(walls), outside, excess > self.limits.cut_outside, excess)

    def check(
        self,
        setpoint: Array,  # (N, 4) as decided, in the meaning of each row's kind
        position: Array,  # (N, 3) measured [m]
        yaw: Array,  # (N,) measured [rad]
        age: Array,  # (N,) of that measurement [s]
        *,
        where: PoseValidity | None = None,  # validity of the pose, if known already
        avoidance: tuple[Avoidance, OwnState, Nearby] | None = None,  # applied after all limits, with its inputs
    ) -> FilteredSetpoint:
        where = self.validate_poses(position, yaw, age) if where is None else where
        sane = np.abs(setpoint) < ABSURD
        no_row = self._no_row
        invalid, not_finite = where.invalid, no_row
        safe, here = setpoint.copy(), position
        troubled = not (where.all_valid and every(sane))
        if troubled:
            not_finite = ~np.asarray(sane.all(axis=1) | invalid)
            here, yaw = np.where(invalid[:, None], self._centre, position), np.where(invalid, 0.0, yaw)
            safe[invalid | not_finite] = 0.0
            age = np.where(invalid, 0.0, age)
            stay = not_finite & self._takes_position
            safe[stay, :3] = here[stay]
        self._limit(safe, here, yaw, age)
        avoided = no_row
        if avoidance is not None:
            rule, own, near = avoidance
            inputs, each = (safe.copy(), own, near), "a setpoint per row"
            wished = call("avoidance", rule, "restrain", *inputs, shape=safe.shape, each=each)
            other = np.asarray((wished != safe).any(axis=1) & np.isfinite(wished).all(axis=1))
            other &= ~(invalid | not_finite)
            if some(other):
                again = np.where(other[:, None], wished, safe)
                self._limit(again, here, yaw, age)
                again = np.where(other[:, None], again, safe)  # limits twice over may differ in the last bit
                avoided, safe = np.asarray((np.abs(again - safe) > ROUNDING).any(axis=1)), again
        changed = no_row
        if safe.tobytes() != setpoint.tobytes():
            changed = np.asarray((np.abs(safe - setpoint) > ROUNDING).any(axis=1))
        if troubled:
            changed = (changed | not_finite) & ~invalid
            # a body that controls its position on board keeps its last setpoint while the position is not known here
            safe[invalid & self._takes_position] = np.nan
        return FilteredSetpoint(safe, changed, invalid, not_finite, avoided)

    def _limit(self, setpoint: Array, here: Array, yaw: Array, age: Array) -> None:
        """Bring setpoints (N, 4) within all limits, in place; rows were `here` (N, 3) [m] `age` (N,) [s] ago."""
        if self._any_position:
            rows = self._position
            setpoint[rows, :3] = self._clamp_target(setpoint[rows, :3], here[rows], rows)
        if self._any_velocity:
            rows = self._velocity
            setpoint[rows] = self._slow(setpoint[rows], here[rows], age[rows], rows)
        if self._any_twist:
            rows = self._twist
            setpoint[rows, :2] = self._drive(setpoint[rows, :2], here[rows, :2], yaw[rows], age[rows], rows)

    def _clamp_target(self, target: Array, here: Array, rows: Rows) -> Array:
        """Goals inside the arena, not too far ahead of the robot, and before a wall that it would overshoot to."""
        low, high = self._low[rows], self._high[rows]
        target = clamp(target, here + BEFORE_WALL * (low - here), here + BEFORE_WALL * (high - here))
        step = target - here
        length, longest = norm(step), self._step[rows]
        far = length > longest
        if some(far):
            target[far] = here[far] + step[far] * (longest[far] / length[far])[:, None]
        return target

    def _slow(self, velocity: Array, here: Array, age: Array, rows: Rows) -> Array:
        """Velocities within the limits, and not out of the arena.

        Toward a wall as fast as a goal on it would be closed in on, less what was flown since `here` was measured; from
        beyond a wall, back.
        """
        speed, turn = self._speed[rows, None], self._turn_rate[rows]
        seconds = (self._closes_s[rows] + np.maximum(age, 0.0))[:, None]
        inside = clamp(velocity[:, :3], (self._low[rows] - here) / seconds, (self._high[rows] - here) / seconds)
        velocity[:, :3] = clamp(inside, -speed, speed)
        velocity[:, 3] = clamp(velocity[:, 3], -turn, turn)
        return velocity

    def _drive(self, twist: Array, here: Array, yaw: Array, age: Array, rows: Rows) -> Array:
        """Twists within the limits, and not out of the arena, as `_slow`: turning on the spot is always allowed."""
        speed, turn = self._speed[rows], self._turn_rate[rows]
        v = clamp(twist[:, 0], -speed, speed)
        below, above = here - self._low[rows, :2], self._high[rows, :2] - here
        seconds = self._closes_s[rows] + np.maximum(age, 0.0)
        if some(np.minimum(below, above) < (speed * seconds)[:, None]):
            moves = np.empty((len(v), 2))  # `stack` takes three times as long
            moves[:, 0], moves[:, 1] = np.cos(yaw) * v, np.sin(yaw) * v
            most = np.maximum(np.where(moves > 0.0, above, below), 0.0) / seconds[:, None]
            amount = np.abs(moves)
            if some(beyond := amount > most):
                v = v * np.where(beyond, most / np.maximum(amount, ROUNDING), 1.0).min(axis=1)
        twist[:, 0], twist[:, 1] = v, clamp(twist[:, 1], -turn, turn)
        return twist
