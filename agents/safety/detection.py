"""Detection of hazards: the causes of `agents.safety.hazards` that are present on a tick.

Quiet: all but `Detector.words`, `nearest_robot`, `clock_text` and `tilt_angle`, which tell the extent of a cause.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import asin, degrees, hypot, inf, isfinite, nan, sin, sqrt
from typing import ClassVar, Final

from agents.body.interface import Attitude, BodyState, RangeScan
from agents.body.kinds import Kind
from agents.body.limits import LOWEST_DESCENT_M_S
from agents.decision.assignment import Assignment
from agents.decision.neighbours import Neighbour, Neighbours
from agents.decision.perception import SCAN_S
from agents.decision.situation import LATE_SHARE, SILENT_S, ProcessHealth, Situation
from agents.plugins.predictors import Predictor
from agents.safety.direction_check import DirectionCheck
from agents.safety.hazards import BY_OPERATOR, Cause
from agents.safety.landing import LOW, SLOW
from agents.safety.motion_check import RUSH_S, MotionCheck
from agents.safety.setpoint_filter import OUTSIDE_M
from agents.vectors import NO_SETPOINT, UNKNOWN, Setpoint, Vector, is_finite, norm, planar

SUNK: Final = 0.15  # [m] depth below its goal
CREEPS: Final = 0.025  # [m/s] largest speed of a robot that creeps
STEP: Final = 0.05  # [m]
STALLS_S: Final = 4.0  # [s] time after which a climb without `STEP` of gained height counts as stalled
STALLS_OUTSIDE_S: Final = 0.7  # [s] the same of a robot that flies by positions from outside, once it has risen
GAP_S: Final = 1.0  # [s] time without a tick after which the watch of a climb restarts: its process stood still
STALLS_VELOCITY_S: Final = 10.0  # [s] the same of a device that takes velocities: it may need a second order
SINKS: Final = 0.15  # [m/s] downward speed at which the robot does not fly to its goal
AHEAD_S: Final = 0.1  # no network here is later than this: stamps further ahead come from a clock that is ahead
FOREIGN_S: Final = 0.5  # a gap in the poses from another source does not end their hazard before
NOT_UNIT: Final = 0.1  # largest deviation of the squared norm of a quaternion from 1


@dataclass(eq=False, slots=True)
class RobotStatus:
    """Status of a robot in its experiment, for `Detector`; the robot overwrites it on each tick."""

    ordered: bool = False  # holds by order
    cruising: bool = False  # True at its height or running: its setpoints are followed
    climbing: bool = False  # True on its way up
    landing: bool = False  # descending
    alone: bool = False  # the law has no input
    unguided: bool = False  # running without the guidance that it needs
    goal_stamp: float = -inf  # decision time of the goal of a guided robot [s]; −inf: it is not guided
    unstarted: bool = False  # True on its way up, or in the air, without a start order
    goal_height: float = nan  # [m]
    setpoint: Setpoint = NO_SETPOINT  # setpoint of the tick before, NaN when the body drives by itself
    not_finite: bool = False  # the last setpoint was not finite
    aside: bool = False  # True on its way to a landing place


class Ascent:
    """Progress of a climb: straight up, as bodies do by themselves.

    If the measured height does not follow, it is a wrong one, and the robot flies higher and higher: its markers lie on
    the floor.
    """

    def __init__(self, kind: Kind, hover: float, *, outside: bool) -> None:
        self.climbing = False  # state on the last tick
        self.last = -inf  # time of that [s]
        self.hover = hover  # height at the end [m]
        self.begin = UNKNOWN  # position at the begin [m]
        self.free = RUSH_S * kind.speed + kind.radius  # distance from there that is no matter [m]
        self.aside = 0.0  # distance from there, seen from above [m]
        self.carried = False  # it is carried aside
        self.patience_s = STALLS_VELOCITY_S if kind.takes == "velocity" else STALLS_S  # time for a step of height [s]
        at_once, per_metre, low = kind.lift_s if outside else (inf, 0.0, 0.0)
        self.lifts_s = at_once + per_metre * hover + low / hover if hover > 0.0 else inf  # time for the first step [s],
        self.rises_s = STALLS_OUTSIDE_S if outside else inf  # time for each of the others [s]
        self.highest = 0.0  # last step of height [m],
        self.risen_at = 0.0  # time of that height [s]
        self.risen = False  # there was such a step
        self.stalled = False  # it is measured to stay low
        self.stuck = False  # likewise, by positions from outside: it flies higher and higher

    def update(self, t: float, climbing: bool, spinning: bool, position: Vector) -> None:
        """Follow a robot that may be `climbing`, with motors `spinning`, at `t` [s], at a `position` [m]."""
        begins, self.climbing = climbing and not self.climbing, climbing
        if begins:
            self.begin = position
        height = position[2]
        stands = begins or not spinning or t - self.last > GAP_S
        self.last = t
        if stands or not height <= self.highest + STEP:
            self.highest, self.risen_at = height, t
            self.risen = not stands
        self.aside = planar(position, self.begin)
        self.carried = climbing and self.aside > self.free
        low, since = climbing and self.hover - height > SUNK, t - self.risen_at
        self.stalled = low and since > self.patience_s
        self.stuck = (low and since > self.rises_s) if self.risen else (climbing and since > self.lifts_s)


@dataclass(eq=False, slots=True)
class LandingProgress:
    """Progress of a landing."""

    room: float  # height from which a robot of unknown height descends [m]
    landing: bool = False  # state on the last tick
    due: float = 0.0  # time at which it is down, at the slowest [s]
    lowest: float = 0.0  # last step of height [m],
    lowered_at: float = 0.0  # time of that height [s]
    late: bool = False  # its motors do no good
    hovers: bool = False  # it stays at a height; it is never cut: it would fall

    def update(self, t: float, landing: bool, valid: bool, height: float, velocity: Vector) -> None:
        """Follow a robot that may be `landing` at `t` [s]; the `height` [m] of a `valid` pose is known.

        One that comes down is given its time.
        """
        begins, self.landing = landing and not self.landing, landing
        if begins:
            self.due = t + (height if valid else self.room) / LOWEST_DESCENT_M_S
        if begins or (valid and height < self.lowest - STEP):
            self.lowest, self.lowered_at = height, t
        still = landing and t - self.lowered_at > STEP / CREEPS
        level = valid and height > LOW and norm(velocity) < SLOW
        self.late = still and not level and t > self.due
        self.hovers = still and level


class Detector:
    """Detector of the causes of hazards of one robot."""

    FIXED: ClassVar = ("flies", "outside", "sees")
    RARE: ClassVar = ("scan",)

    def __init__(self, assignment: Assignment) -> None:
        kind, limits = assignment.kind, assignment.limits
        self.name, self.limits = assignment.name, limits
        self.predictor = assignment.predictor
        self.flies, self.radius = kind.flies, kind.radius
        # [m/s] a faster robot has lost control; the speed of flying kinds is per axis
        self.fastest = limits.overspeed * (sqrt(3.0) if kind.flies else 1.0) * kind.speed
        self.fastest_squared = self.fastest * self.fastest
        self.slow_squared = min(self.fastest_squared, SINKS * SINKS)  # slower robots neither sink nor race [m²/s²]
        half = sin(0.5 * limits.tilt)
        self.lean = half * half  # largest x² + y² of an attitude
        self.battery_low = limits.battery_low
        self.silence_s = limits.position_timeout_s  # silence of the device, and of the pose, that is too long [s]
        self.behind_s = limits.behind_s  # stamps that are older have a wrong clock [s]
        self.separation = 0.0 if limits.separation is None else limits.separation  # least distance [m]; 0: any
        self.outside = limits.late_s < inf  # it flies on board by positions from outside
        self.motion_check, self.direction = MotionCheck(kind, outside=self.outside), DirectionCheck(kind)
        self.ascent = Ascent(kind, assignment.hover, outside=self.outside)
        self.descent = LandingProgress(limits.high[2])
        self.leaned = False  # state on the tick before
        self.leans_since = 0.0  # time of the first sample of that [s]
        self.sees = False  # it avoids, and has range readings
        self.scan: RangeScan | None = None  # scan on the tick before
        self.scanned = inf  # time of the newest range readings [s]; infinity before the first

    def causes(self, now: Situation, status: RobotStatus, neighbours: Neighbours, health: ProcessHealth) -> int:
        """Causes that are present, as a set of bits `1 << cause`; call it once on every tick."""
        t, state = now.t, now.state
        found = 0
        if self.separation > 0.0:
            found |= self.too_near(now, neighbours)
        if neighbours.incomplete or neighbours.lagging or neighbours.refused or t - neighbours.foreign_at < FOREIGN_S:
            found |= self.of_neighbours(t, status, neighbours)
        if (
            health.offline_since < inf
            or health.conductor_lost_since < inf
            or health.missed_share > LATE_SHARE
            or health.asked_since < inf
            or t < health.connected_since + SILENT_S
        ):
            found |= self.of_process(t, status, neighbours, health)
        v = now.velocity
        squared = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
        if not squared < self.slow_squared:
            found |= self.of_motion(now, status, squared)
        if (
            state.battery < self.battery_low
            or state.flying != self.flies
            or t - state.received > self.silence_s
            or state.ahead > AHEAD_S
            or state.ahead < -self.behind_s
        ):
            found |= self.of_device(t, state, status)
        if self.flies:
            x, y = state.attitude[1], state.attitude[2]
            if (x * x + y * y > self.lean or self.leaned) and self.leans(state):
                found |= 1 << Cause.TILT
            if status.climbing or self.ascent.climbing:
                self.ascent.update(t, status.climbing, state.flying and state.spinning, now.position)
        if status.landing or status.ordered or status.not_finite or status.unguided:
            found |= self.of_orders(now, status)
        if self.sees and t - self.scanned > SCAN_S and status.cruising:
            found |= 1 << Cause.UNSEEING
        self.motion_check.update(t, status.setpoint, now.position, now.yaw, status.cruising and not now.invalid)
        found |= self.of_obedience(now, status)
        return found if now.sound else found | self.of_place(now)

    def too_near(self, now: Situation, neighbours: Neighbours) -> int:
        """Other robots that are received."""
        t, position, predictor, silence_s = now.t, now.position, self.predictor, neighbours.silence_s
        near = False
        for sender in neighbours.all:
            if separation(position, sender, predictor, t, silence_s) < self.separation:
                near = True
        if not near:
            return 0
        for sender in neighbours.all:
            apart = separation(position, sender, predictor, t, silence_s)
            if apart < max(0.5 * self.separation, self.radius + sender.radius):
                return 1 << Cause.SEPARATION | 1 << Cause.TOUCHING
        return 1 << Cause.SEPARATION

    def of_neighbours(self, t: float, status: RobotStatus, neighbours: Neighbours) -> int:
        """Neighbours, and their poses."""
        found = 0
        for sender in neighbours.all:
            if status.cruising and is_lost(sender, t, neighbours.silence_s):
                found |= 1 << Cause.NEIGHBOUR
            if lags(sender):
                found |= 1 << Cause.BEHIND
        if neighbours.incomplete and status.alone and status.cruising:
            found |= 1 << Cause.ALONE
        if neighbours.refused:
            found |= 1 << Cause.REFUSED
        if t - neighbours.foreign_at < FOREIGN_S:
            found |= 1 << Cause.FOREIGN
        return found

    def of_process(self, t: float, status: RobotStatus, neighbours: Neighbours, health: ProcessHealth) -> int:
        """Router, conductor, control loop and suspensions."""
        found = 0
        if health.just_resumed(t):
            # no new pose of an alive neighbour yet, or no new goal
            outdated = -inf < status.goal_stamp < health.resumed_at
            for sender in neighbours.all:
                outdated = outdated or (-inf < sender.stamp < health.resumed_at and not isfinite(sender.lost_since))
            if outdated:
                found |= 1 << Cause.SUSPENDED
        if health.offline_since < inf:
            found |= 1 << Cause.ROUTER
        elif health.conductor_lost_since < inf:
            found |= 1 << Cause.CONDUCTOR
            if status.unstarted:
                found |= 1 << Cause.UNSTARTED
        if health.missed_share > LATE_SHARE:
            found |= 1 << Cause.LATE
        if health.asked_since < inf:
            found |= 1 << Cause.OWNER
        return found

    def of_motion(self, now: Situation, status: RobotStatus, squared: float) -> int:
        """Speed, of which the square is known [m²/s²], and sinking."""
        found = 0
        if squared > self.fastest_squared:
            found |= 1 << Cause.OVERSPEED
        if self.flies and status.cruising and now.velocity[2] < -SINKS and status.goal_height - now.position[2] > SUNK:
            found |= 1 << Cause.SINKING
        return found

    def of_device(self, t: float, state: BodyState, status: RobotStatus) -> int:
        """Battery, motors, link and clock."""
        found = 0
        if state.battery < self.battery_low:
            found |= 1 << Cause.BATTERY
        if self.flies and not state.flying and status.cruising:
            found |= 1 << Cause.FALLEN
        if t - state.received > self.silence_s:
            found |= 1 << Cause.UNREACHABLE
        if clock_off(state.ahead, self.behind_s):
            found |= 1 << Cause.CLOCK
        return found

    def of_orders(self, now: Situation, status: RobotStatus) -> int:
        """Operator, decision, central controller and landing."""
        found = 0
        if status.ordered:
            found |= 1 << Cause.ORDERED
        if status.not_finite and status.cruising:
            found |= 1 << Cause.SETPOINT
        if status.unguided:
            found |= 1 << Cause.CENTRE
        if status.landing:
            descent = self.descent
            descent.update(now.t, self.flies and now.state.flying, not now.invalid, now.position[2], now.velocity)
            if descent.late:
                found |= 1 << Cause.LANDING
            if descent.hovers:
                found |= 1 << Cause.HOVERING
            if status.aside:
                found |= 1 << Cause.BELOW
        return found

    def of_place(self, now: Situation) -> int:
        """Position and arena."""
        found = 0
        if now.invalid:
            found |= 1 << Cause.POSITION
        if now.outside:
            found |= 1 << Cause.OUTSIDE
        elif now.outside_wall:
            found |= 1 << Cause.MARGIN
        if now.flyaway and self.flies:
            found |= 1 << Cause.FAR_OUTSIDE
        return found

    def of_obedience(self, now: Situation, status: RobotStatus) -> int:
        """Motion that is not as commanded."""
        motion_check, ascent = self.motion_check, self.ascent
        found = 0
        if motion_check.unresponsive or ascent.stalled:
            found |= 1 << Cause.UNRESPONSIVE
        if self.flies and now.t >= self.direction.due:
            self.follow_direction(now, status)
        if motion_check.uncommanded or ascent.carried or self.direction.against:
            found |= 1 << Cause.STRAYING
        if self.outside:  # positions that mislead the controller on board
            found |= (1 << Cause.TURNED if self.direction.turned else 0) | (1 << Cause.STUCK if ascent.stuck else 0)
        return found

    def follow_direction(self, now: Situation, status: RobotStatus) -> None:
        """Compare commanded and measured accelerations of a drone."""
        direction, setpoint = self.direction, status.setpoint
        if status.climbing and self.outside:
            setpoint = (self.ascent.begin[0], self.ascent.begin[1], 0.0, 0.0)
        follows = now.state.flying and (status.cruising or (status.climbing and self.outside))
        if not (follows and isfinite(setpoint[0]) and isfinite(setpoint[1])):
            direction.forget()
        elif not now.invalid and isfinite(now.velocity[0]) and isfinite(now.velocity[1]):
            direction.update(now.t, setpoint[0], setpoint[1], now.position, now.velocity)

    def leans(self, state: BodyState) -> bool:
        """Whether it leans, by a first sample or a newer one: the first one alone, repeated, proves nothing."""
        before, self.leaned = self.leaned, state.flying and tilted(state.attitude, self.limits.tilt)
        if self.leaned and not before:
            self.leans_since = state.time
            return True
        return self.leaned and state.time > self.leans_since

    def notice(self, scan: RangeScan | None) -> None:
        """Take the newest range readings of a robot that avoids; rare."""
        if scan is not self.scan:
            self.scan, self.sees = scan, True
            if scan is not None and len(scan.distance) > 0 and isfinite(scan.time):
                self.scanned = scan.time

    def words(
        self, cause: Cause, now: Situation, status: RobotStatus, neighbours: Neighbours, health: ProcessHealth
    ) -> str:
        """Extent of a cause that the last call of `causes` found; of `BELOW` by `Landing.robot_below`."""
        t, state, limits = now.t, now.state, self.limits
        motion_check, ascent = self.motion_check, self.ascent

        def nearest() -> str:
            apart, other = nearest_robot(now.position, neighbours, self.predictor, t)
            return f"{apart:.2f} m from {other} (limit {self.separation:g} m)"

        def names() -> str:
            return ", ".join(sender.name for sender in neighbours.all if is_lost(sender, t, neighbours.silence_s))

        def late() -> str:
            return ", ".join(
                f"the poses of {sender.name} are {sender.behind:.1f} s old when they arrive"
                for sender in neighbours.all
                if lags(sender)
            )

        def foreign() -> str:
            text = "{} poses of {} came from another source, and were not used"
            return ", ".join(text.format(sender.foreign, sender.name) for sender in neighbours.all if sender.foreign)

        def outside(limit: float) -> str:
            return f"{now.excess:.2f} m outside (limit {limit:g} m)"

        def leaning() -> str:
            return f"it leans {degrees(tilt_angle(state.attitude)):.0f}° (limit {degrees(limits.tilt):.0f}°)"

        def sinking() -> str:
            short = status.goal_height - now.position[2]
            return f"{short:.2f} m below its goal, and sinks at {-now.velocity[2]:.2f} m/s"

        extents: dict[Cause, Callable[[], str]] = {
            Cause.ORDERED: lambda: BY_OPERATOR,
            Cause.POSITION: lambda: lost_position(now),
            Cause.MARGIN: lambda: outside(0.0),
            Cause.OUTSIDE: lambda: outside(OUTSIDE_M),
            Cause.FAR_OUTSIDE: lambda: outside(limits.cut_beyond_m),
            Cause.SEPARATION: nearest,
            Cause.TOUCHING: nearest,
            Cause.OVERSPEED: lambda: f"{norm(now.velocity):.2f} m/s (limit {self.fastest:.2f} m/s)",
            Cause.TILT: leaning,
            Cause.NEIGHBOUR: names,
            Cause.ALONE: lambda: names() or "none was received",
            Cause.CENTRE: lambda: "its centre is gone, or its goals are old",
            Cause.BATTERY: lambda: f"{state.battery:.0%} (limit {self.battery_low:.0%})",
            Cause.ROUTER: lambda: f"for {t - health.offline_since:.1f} s",
            Cause.CONDUCTOR: lambda: f"for {t - health.conductor_lost_since:.1f} s",
            Cause.FALLEN: lambda: "its motors are off",
            Cause.SETPOINT: lambda: "not made of finite numbers",
            Cause.LATE: lambda: f"{health.missed_share:.0%} of the last second's",
            Cause.LANDING: lambda: f"more than {limits.landing_s:g} s without a descent",
            Cause.SINKING: sinking,
            Cause.CLOCK: lambda: clock_text(self.name, state.ahead),
            Cause.BEHIND: late,
            Cause.FOREIGN: foreign,
            Cause.REFUSED: lambda: ", ".join(f"{each.name}: {each.doubt}" for each in neighbours.all if each.doubt),
            Cause.SUSPENDED: lambda: f"for {health.suspended_s:.1f} s; it waits for its neighbours",
            Cause.UNRESPONSIVE: lambda: (
                "it does not rise" if ascent.stalled else f"{motion_check.commanded:.2f} m commanded in vain"
            ),
            Cause.STRAYING: lambda: (
                f"{ascent.aside:.2f} m aside while it climbs"
                if ascent.carried
                else "it flies against its commands; are its axes swapped or mirrored?"
                if self.direction.against
                else motion_check.words()
            ),
            Cause.UNREACHABLE: lambda: f"for {t - state.received:.1f} s",
            Cause.HOVERING: lambda: f"at {now.position[2]:.2f} m",
            Cause.UNSEEING: lambda: f"for {t - self.scanned:.1f} s",
            Cause.STUCK: lambda: f"{now.position[2] - ascent.begin[2]:.2f} m high after {t - ascent.risen_at:.1f} s",
            Cause.TURNED: lambda: (
                f"by {degrees(abs(self.direction.angle)):.0f}°; does the x axis of its object in the "
                "motion capture point along its nose?"
            ),
            Cause.UNSTARTED: lambda: f"the conductor is gone for {t - health.conductor_lost_since:.1f} s",
            Cause.OWNER: lambda: (
                f"for {t - health.asked_since:.1f} s{'; another process had it, too' * health.contested}"
            ),
        }
        return extents[cause]()


def separation(position: Vector, sender: Neighbour, predictor: Predictor, t: float, silence_s: float) -> float:
    """Distance [m] from a robot at `position` [m] to the believed place of a sender at `t` [s].

    Infinite before its first pose, without an own position, and where the sender is lost for longer than `silence_s`,
    or restarted and without a pose since.
    """
    if sender.stamp == -inf or not t - sender.lost_since <= silence_s:
        return inf
    place = sender.place(predictor, t)
    x, y, z = position[0] - place[0], position[1] - place[1], position[2] - place[2]
    apart = sqrt(x * x + y * y + z * z)
    return apart if apart < inf else inf  # not NaN


def nearest_robot(position: Vector, neighbours: Neighbours, predictor: Predictor, t: float) -> tuple[float, str]:
    """Distance of the nearest robot from `position` [m] at `t` [s], and its name; infinity if there is none."""
    nearest, name = inf, ""
    for sender in neighbours.all:
        apart = separation(position, sender, predictor, t, neighbours.silence_s)
        if apart < nearest:
            nearest, name = apart, sender.name
    return nearest, name


def is_lost(sender: Neighbour, t: float, silence_s: float) -> bool:
    """Whether a neighbour of the law is lost for longer than `silence_s`."""
    return sender.in_law and isfinite(sender.lost_since) and t - sender.lost_since > silence_s


def lags(sender: Neighbour) -> bool:
    """Whether the clock of an alive sender is behind."""
    return sender.behind > 0.0 and sender.lost_since == inf


def lost_position(now: Situation) -> str:
    """Reason why the own pose is invalid."""
    if isfinite(now.yaw_jump):
        return f"its yaw jumped by {now.yaw_jump:.2f} rad"
    if isfinite(now.jump):
        return f"it jumped by {now.jump:.2f} m"
    if not is_finite(now.position):
        return "none"
    age = now.t - now.state.time
    return f"the last is {age:.2f} s old" if age >= 0.0 else f"it is stamped {-age:.3g} s ahead"


def clock_off(ahead: float, behind_s: float) -> bool:
    """Whether positions come late or from a wrong clock; `ahead` as in `BodyState`, `behind_s` as in `Limits`."""
    return ahead > AHEAD_S or ahead < -behind_s


def clock_text(name: str, ahead: float) -> str:
    """Clock error of the positions of a robot, in words; `ahead` as in `BodyState`."""
    return f"positions of {name} are stamped {abs(ahead):.3g} s {'ahead' if ahead > 0.0 else 'behind'}"


def tilted(attitude: Attitude, limit: float) -> bool:
    """Whether a robot leans more than `limit` [rad]; one of unknown attitude does not."""
    w, x, y, z = attitude
    if not abs(w * w + x * x + y * y + z * z - 1.0) < NOT_UNIT:  # it is no attitude
        return False
    half = sin(0.5 * limit)
    return x * x + y * y > half * half  # a turn about the vertical has neither of these; sin² of half the angle, else


def tilt_angle(attitude: Attitude) -> float:
    """Angle [rad] between the upward axis of a robot and that of the room."""
    return 2.0 * asin(min(1.0, hypot(attitude[1], attitude[2])))
