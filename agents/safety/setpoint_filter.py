"""Setpoint filter, the last stage before a body: limits every setpoint, whatever was decided.

All of it runs on quiet ticks.
"""

from __future__ import annotations

from math import cos, inf, isfinite, sin, sqrt
from typing import Final

from agents.body.kinds import Kind
from agents.body.limits import Limits
from agents.decision.situation import Situation
from agents.plugins.avoidance import Avoidance, Nearby, OwnState
from agents.vectors import NO_SETPOINT, Setpoint, Vector, clamp

FLOOR_M: Final = 0.05  # [m] least height of a goal above the floor, or the robot's own: a descent overshoots its goal
OUTSIDE_M: Final = 0.25  # [m] distance outside the arena: no longer under control
ABSURD: Final = 1e6  # [m, m/s, rad, rad/s] larger than any place, speed or angle; NaN is not smaller either
BEFORE_WALL: Final = 0.6  # share of the way to a wall that a goal may be ahead: a drone overshoots a step by a tenth
ROUNDING: Final = 1e-9  # smaller differences are arithmetic, not interventions
REST: Final[Setpoint] = (0.0, 0.0, 0.0, 0.0)  # setpoint of rest for robots that take velocities or twists


class SetpointFilter:
    """Filter for the setpoints of a robot."""

    def __init__(self, kind: Kind, limits: Limits) -> None:
        self.changed = False  # the last setpoint differs from the decided one
        self.avoided = False  # it was changed by avoidance
        # the decided one was not finite although the pose is valid: the robot is kept in place instead
        self.not_finite = False
        # the body takes positions, or twists; one that takes neither takes velocities
        self._flies_to, self._drives = kind.takes == "position", kind.takes == "twist"
        self._speed, self._turn_rate = min(kind.speed, limits.top_speed), kind.turn_rate  # [m/s], [rad/s]
        self._fastest = inf if kind.flies else self._speed  # largest speed in any direction [m/s]
        self._turn_radius = kind.turn_radius  # smallest [m]; 0: it turns on the spot
        # time in which the body closes a position error [s]: it goes as fast as its goal is far
        self._closes_s = 1.0 / kind.response
        # way that it can drive in that time, and as long as a pose is valid [m]
        self._far = self._speed * (self._closes_s + limits.position_timeout_s)
        self._step = min(limits.max_goal_distance, self._speed * self._closes_s)  # longest way to a goal [m]
        self._walls_low, self._walls_high, margin = limits.low, limits.high, limits.margin  # walls of the arena [m]
        beside = margin + kind.radius  # its surface, not its centre, keeps the margin
        # a goal on the floor would be flown into it; heights do not limit ground robots
        (x, y, z), (far_x, far_y, far_z) = limits.low, limits.high
        bottom, top = (z + max(kind.height, FLOOR_M), far_z - margin) if kind.flies else (-inf, inf)
        self._low, self._high = (x + beside, y + beside, bottom), (far_x - beside, far_y - beside, top)  # limits [m]
        self._cut_beyond_m, self._position_timeout_s = limits.cut_beyond_m, limits.position_timeout_s

    def judge(self, now: Situation) -> None:
        """Judge the pose of a situation: known, fresh, inside the arena.

        A pose of the future would never become old: its time is wrong.
        """
        x, y, z = now.position
        (low_x, low_y, low_z), (high_x, high_y, high_z) = self._walls_low, self._walls_high
        inside = low_x <= x <= high_x and low_y <= y <= high_y and low_z <= z <= high_z
        known = -ABSURD < now.yaw < ABSURD and abs(now.t - now.state.time) <= self._position_timeout_s
        if inside and known:
            if not now.sound:
                now.sound, now.excess = True, 0.0
                now.invalid = now.outside_wall = now.outside = now.flyaway = False
            return
        now.sound, now.excess = False, 0.0
        now.invalid = not (known and abs(x) < ABSURD and abs(y) < ABSURD and abs(z) < ABSURD)
        now.outside_wall = now.outside = now.flyaway = False
        if not now.invalid:  # an unknown pose is not outside
            beside = max(low_x - x, x - high_x, low_y - y, y - high_y)
            now.excess = max(beside, low_z - z, z - high_z, 0.0)
            now.outside_wall = beside > 0.0 or z > high_z
            now.outside, now.flyaway = now.excess > OUTSIDE_M, now.excess > self._cut_beyond_m

    def judge_far(self, now: Situation, place: Vector) -> None:
        """Judge a `place` [m] that is not believed, NaN for none, by the distance beyond which motors are cut."""
        x, y, z = place
        (low_x, low_y, low_z), (high_x, high_y, high_z) = self._walls_low, self._walls_high
        excess = max(0.0, low_x - x, x - high_x, low_y - y, y - high_y, low_z - z, z - high_z)
        if excess > self._cut_beyond_m:  # not of NaN, which is never larger
            now.excess = excess
            now.flyaway, now.sound = True, False

    def limit(self, setpoint: Setpoint, now: Situation) -> Setpoint:
        """Safe setpoint in place of a decided one, of a robot without avoidance; `now` was judged.

        A body that controls its position on board keeps its last setpoint while the position is not known here.
        """
        self.changed = self.avoided = self.not_finite = False
        if now.invalid:
            return NO_SETPOINT if self._flies_to else REST
        if self._lawful(setpoint, now):
            return setpoint
        if is_sane(setpoint):
            safe = self._within(setpoint, now)
            self.changed = differ(safe, setpoint)
            return safe
        self.changed = self.not_finite = True
        x, y, z = now.position
        return self._within((x, y, z, 0.0) if self._flies_to else REST, now)

    def check(self, setpoint: Setpoint, now: Situation, avoidance: Avoidance, own: OwnState, near: Nearby) -> Setpoint:
        """Safe setpoint as `limit`, with an avoidance, applied after all limits, and its inputs."""
        safe = self.limit(setpoint, now)
        if now.invalid or self.not_finite:
            return safe
        a, b, c, d = avoidance.restrain(safe, own, near)
        same = a == safe[0] and b == safe[1] and c == safe[2] and d == safe[3]
        if same or not (isfinite(a) and isfinite(b) and isfinite(c) and isfinite(d)):
            return safe
        again = self._within((a, b, c, d), now)
        self.avoided, self.changed = differ(again, safe), differ(again, setpoint)
        return again

    def _lawful(self, setpoint: Setpoint, now: Situation) -> bool:
        """Whether a setpoint is within all limits, as nearly every one is; False is no proof of the contrary."""
        a, b, c, d = setpoint
        x, y, z = now.position
        (low_x, low_y, low_z), (high_x, high_y, high_z) = self._low, self._high
        if self._drives:
            speed, turn, far = self._speed, self._turn_rate, self._far
            return (
                -speed <= a <= speed and -turn <= b <= turn and c == 0.0 and d == 0.0
                and abs(b) * self._turn_radius <= abs(a)
                and low_x + far < x < high_x - far and low_y + far < y < high_y - far
            )  # fmt: skip
        if self._flies_to:
            step_x, step_y, step_z = a - x, b - y, c - z
            longest = self._step
            return (
                step_x * step_x + step_y * step_y + step_z * step_z < longest * longest
                and BEFORE_WALL * (low_x - x) < step_x < BEFORE_WALL * (high_x - x)
                and BEFORE_WALL * (low_y - y) < step_y < BEFORE_WALL * (high_y - y)
                and BEFORE_WALL * (low_z - z) < step_z < BEFORE_WALL * (high_z - z)
                and -ABSURD < d < ABSURD
            )
        speed, turn = self._speed, self._turn_rate
        seconds = self._closes_s + max(now.t - now.state.time, 0.0)
        return (
            -speed <= a <= speed and -speed <= b <= speed and -speed <= c <= speed and -turn <= d <= turn
            and a * a + b * b <= self._fastest * self._fastest
            and low_x - x < seconds * a < high_x - x
            and low_y - y < seconds * b < high_y - y
            and low_z - z < seconds * c < high_z - z
        )  # fmt: skip

    def _within(self, setpoint: Setpoint, now: Situation) -> Setpoint:
        """Setpoint within all limits."""
        if self._drives:
            return self._drive(setpoint, now)
        return self._clamp_target(setpoint, now) if self._flies_to else self._slow(setpoint, now)

    def _clamp_target(self, target: Setpoint, now: Situation) -> Setpoint:
        """Goal inside the arena, not too far ahead of the robot, and before a wall that it would overshoot to."""
        here_x, here_y, here_z = now.position
        (low_x, low_y, low_z), (high_x, high_y, high_z) = self._low, self._high
        x = clamp(target[0], here_x + BEFORE_WALL * (low_x - here_x), here_x + BEFORE_WALL * (high_x - here_x))
        y = clamp(target[1], here_y + BEFORE_WALL * (low_y - here_y), here_y + BEFORE_WALL * (high_y - here_y))
        z = clamp(target[2], here_z + BEFORE_WALL * (low_z - here_z), here_z + BEFORE_WALL * (high_z - here_z))
        step_x, step_y, step_z = x - here_x, y - here_y, z - here_z
        length, longest = sqrt(step_x * step_x + step_y * step_y + step_z * step_z), self._step
        if length > longest:
            share = longest / length
            x, y, z = here_x + step_x * share, here_y + step_y * share, here_z + step_z * share
        return x, y, z, target[3]

    def _slow(self, velocity: Setpoint, now: Situation) -> Setpoint:
        """Velocity within the limits, and not out of the arena.

        Toward a wall as fast as a goal on it would be closed in on, less what was flown since the pose was measured;
        from beyond a wall, back.
        """
        (x, y, z), low, high, speed, turn = now.position, self._low, self._high, self._speed, self._turn_rate
        seconds = self._closes_s + max(now.t - now.state.time, 0.0)
        v_x = clamp(clamp(velocity[0], (low[0] - x) / seconds, (high[0] - x) / seconds), -speed, speed)
        v_y = clamp(clamp(velocity[1], (low[1] - y) / seconds, (high[1] - y) / seconds), -speed, speed)
        v_z = clamp(clamp(velocity[2], (low[2] - z) / seconds, (high[2] - z) / seconds), -speed, speed)
        size = sqrt(v_x * v_x + v_y * v_y)
        if size > self._fastest:
            v_x, v_y = v_x * self._fastest / size, v_y * self._fastest / size
        return v_x, v_y, v_z, clamp(velocity[3], -turn, turn)

    def _drive(self, twist: Setpoint, now: Situation) -> Setpoint:
        """Twist within the limits, and not out of the arena, as `_slow`; one that can may always turn on the spot."""
        speed, turn = self._speed, self._turn_rate
        v, omega = clamp(twist[0], -speed, speed), clamp(twist[1], -turn, turn)
        (x, y, _), (low_x, low_y, _), (high_x, high_y, _) = now.position, self._low, self._high
        seconds = self._closes_s + max(now.t - now.state.time, 0.0)
        reach = speed * seconds
        if x - low_x < reach or high_x - x < reach or y - low_y < reach or high_y - y < reach:
            move_x, move_y = cos(now.yaw) * v, sin(now.yaw) * v
            most_x = max(high_x - x if move_x > 0.0 else x - low_x, 0.0) / seconds
            most_y = max(high_y - y if move_y > 0.0 else y - low_y, 0.0) / seconds
            share = 1.0
            if abs(move_x) > most_x:
                share = most_x / max(abs(move_x), ROUNDING)
            if abs(move_y) > most_y:
                share = min(share, most_y / max(abs(move_y), ROUNDING))
            v *= share
        if self._turn_radius > 0.0:
            omega = clamp(omega, -abs(v) / self._turn_radius, abs(v) / self._turn_radius)
        return v, omega, twist[2], twist[3]


def is_sane(setpoint: Setpoint) -> bool:
    """Whether all numbers of a setpoint are finite and of a size that occurs."""
    a, b, c, d = setpoint
    return -ABSURD < a < ABSURD and -ABSURD < b < ABSURD and -ABSURD < c < ABSURD and -ABSURD < d < ABSURD


def differ(a: Setpoint, b: Setpoint) -> bool:
    """Whether two setpoints differ by more than rounding."""
    return (
        abs(a[0] - b[0]) > ROUNDING
        or abs(a[1] - b[1]) > ROUNDING
        or abs(a[2] - b[2]) > ROUNDING
        or abs(a[3] - b[3]) > ROUNDING
    )
