"""Perception: things near a robot, from its own range readings and received poses. Quiet, except for new readings."""

from __future__ import annotations

from array import array
from itertools import chain
from math import cos, inf, isfinite, sin
from typing import ClassVar, Final

from agents.body.interface import RangeScan
from agents.decision.assignment import Assignment
from agents.decision.neighbours import Neighbour, Neighbours
from agents.decision.situation import Situation
from agents.network.validation import MAX_SPEED
from agents.plugins.avoidance import HURRY, Avoidance, Nearby, OwnState
from agents.plugins.calls import failure, wrong
from agents.plugins.registry import FAILURES
from agents.vectors import Vector, clamp, is_finite, planar

SIGHT_M: Final = 3.0  # [m] distance of axes beyond which things are ignored
AHEAD_S: Final = 0.1  # received positions are extrapolated for this long: a silent robot may have stopped
BELIEVED_S: Final = 0.5  # [s] longest use of a received velocity
SCAN_S: Final = 1.0  # readings older than this are dropped
CLIMB: Final = 0.1  # [m/s] a robot that sinks or rises faster may be landing or taking off,
CLIMB_S: Final = 2.0  # [s] time within which a climbing drone may be in the way
OUTLINE: Final = 0.05  # [m] a reading that ends this near to a received robot has hit that robot,
OUTLINE_SHARE: Final = 0.05  # share of its length that is added: long ones are measured worse
INSIDE: Final = 0.5  # share of its radius: a shorter reading of a robot is none
STEEP: Final = 0.5  # cosine of the elevation above which a ray looks up or down, not around


NUMBERS: Final = 3  # numbers of a ray, and of a point


class Perception:
    """Inputs of the avoidance of a robot."""

    FIXED: ClassVar = ("sees",)
    RARE: ClassVar = ("scan",)

    def __init__(self, assignment: Assignment) -> None:
        assert assignment.avoidance is not None
        kind, limits, self.avoidance = assignment.kind, assignment.limits, assignment.avoidance
        self._position_timeout_s, self._neighbour_timeout_s = limits.position_timeout_s, limits.neighbour_timeout_s
        self._clearance = assignment.avoidance.clearance  # things farther above or below are ignored [m]
        self._radius, self._height = kind.radius, kind.height
        self._links = len(assignment.neighbours)
        self.near = Nearby()  # result of the last call of `sense`
        self.near.reserve(self._links)
        own = self.own = OwnState()  # likewise
        own.radius, own.height, own.turn_rate = kind.radius, kind.height, kind.turn_rate
        own.speed = min(kind.speed, limits.top_speed)
        own.response, own.lag = kind.response, kind.lag
        own.by_position, own.by_twist = kind.takes == "position", kind.takes == "twist"
        own.flies = kind.flies
        self._horizon = kind.radius + _horizon(self.avoidance, own)  # range of sight from the own axis [m]
        self._in_time = self._horizon + HURRY * own.speed * SCAN_S  # what comes within the horizon before it is old
        self.sees = False  # there are range readings
        self.scan: RangeScan | None = None  # the newest ones
        self._unread = False  # nothing was made of them yet
        self._scanned = -inf  # their time [s]
        self._rays = array("d", (0.0,)) * NUMBERS  # bearing and elevation [rad], and distance [m] of each ray
        self._points = array("d", (0.0,)) * NUMBERS  # ends of rays in the room: x, y and height of each [m]
        self._close = array("d", (0.0,)) * (1 + self._links)  # numbers of the links of robots that a point may be
        self._ray_count = self._point_count = self._close_count = 0

    def sense(self, t: float, now: Situation, neighbours: Neighbours) -> None:
        """Set `own` and `near` at `t` [s].

        Without an own position, or with an old one, there are no things. A received robot is extrapolated with its
        velocity; a range reading on a received robot is not counted a second time.
        """
        own, near, state = self.own, self.near, now.state
        vx, vy, vz = now.velocity  # 0 of a diverged estimator, or NaN
        own.velocity = (
            vx if abs(vx) <= MAX_SPEED else 0.0,
            vy if abs(vy) <= MAX_SPEED else 0.0,
            vz if abs(vz) <= MAX_SPEED else 0.0,
        )
        own.position, own.yaw = now.position, now.yaw
        before, near.count = near.count, 0
        aware = isfinite(now.yaw) and t - state.time <= self._position_timeout_s
        if aware:
            for sender in neighbours.all:
                self._add_robot(t, now.position, sender)
        if self.sees:
            self._look(t, now, neighbours, aware)
        near.clear_rest(before)

    def notice(self, scan: RangeScan | None) -> None:
        """Take the newest range readings; rare. Raises ValueError if some of their rays lack a number."""
        before = self.scan
        if scan is before:
            return
        self.scan = scan
        self._unread = self.sees = True
        count = self._ray_count
        self._scanned, self._ray_count = -inf, 0
        if scan is None:
            return
        same = before is not None and scan.bearing is before.bearing and scan.elevation is before.elevation
        if count and same and type(scan.bearing) is type(scan.elevation) is tuple:  # constant directions
            self._rays[2 : NUMBERS * count : NUMBERS] = array("d", scan.distance)
            self._scanned, self._ray_count = scan.time, count
            return
        rays = array("d", chain.from_iterable(zip(scan.bearing, scan.elevation, scan.distance, strict=True)))
        self._scanned, self._ray_count = scan.time, len(rays) // NUMBERS
        if len(rays) > len(self._rays):  # room for all that may be seen
            self._rays, self._points = rays[:], rays[:]
            self.near.reserve(self._links + self._ray_count)
        self._rays[: len(rays)] = rays

    def _look(self, t: float, now: Situation, neighbours: Neighbours, aware: bool) -> None:
        """Add what the newest range readings saw."""
        if self._unread:
            self._read(now, neighbours)
        if aware and t - self._scanned <= SCAN_S:
            self._add_points(now.position)

    def _add_robot(self, t: float, here: Vector, sender: Neighbour) -> None:
        """Add a received robot that is near; a lost one stays at its last received place."""
        age = t - sender.stamp
        ahead = 0.0 if age < 0.0 else AHEAD_S if age > AHEAD_S else age
        (x, y, z), (vx, vy, vz) = sender.position, sender.velocity
        x = x + vx * ahead
        off_x = here[0] - x
        if not abs(off_x) <= SIGHT_M:  # most of a large company
            return
        y, z = y + vy * ahead, z + vz * ahead
        off_y, up = here[1] - y, here[2] - z
        if not off_x * off_x + off_y * off_y <= SIGHT_M * SIGHT_M:
            return
        # a lost drone still hovers, has landed, or falls: it is in the way from the floor up
        lost = t - sender.lost_since > self._neighbour_timeout_s or sender.stamp == -inf
        believed = age <= BELIEVED_S
        rise = CLIMB_S * vz if abs(vz) > CLIMB and believed else 0.0
        low, high = z + min(rise, 0.0), z + max(rise, 0.0) + sender.height
        # its lower end under the own upper one, and the other way round; `up` is the own height above it
        beside = here[2] + self._height + self._clearance > low or lost
        if not (beside and up - max(rise, 0.0) - sender.height - self._clearance < 0.0):
            return
        thing = self.near.add()
        thing.x, thing.y = x, y
        thing.velocity_x, thing.velocity_y = (vx, vy) if believed else (0.0, 0.0)
        thing.radius, thing.lag = sender.radius, sender.lag
        thing.is_robot = True
        thing.low, thing.high = min(z, 0.0) if lost else low, high

    def _read(self, now: Situation, neighbours: Neighbours) -> None:
        """Find the end points of new range readings, by the pose of the robot at their measurement."""
        self._unread, self._point_count = False, 0
        if not (is_finite(now.position) and isfinite(now.yaw)):
            return
        then = clamp(now.state.time - self._scanned, 0.0, SCAN_S)
        (x, y, z), (vx, vy, vz) = now.position, now.velocity
        x, y = x - (vx if isfinite(vx) else 0.0) * then, y - (vy if isfinite(vy) else 0.0) * then
        z -= (vz if isfinite(vz) else 0.0) * then
        self._find_close(now.position, neighbours)
        farthest = min(SIGHT_M, self._in_time)
        rays, points = self._rays, self._points
        for k in range(0, NUMBERS * self._ray_count, NUMBERS):
            bearing, elevation = rays[k], rays[k + 1]
            far = rays[k + 2]
            # NaN: nothing was hit; nothing is inside the robot either
            if not (INSIDE * self._radius < far <= SIGHT_M and isfinite(bearing) and isfinite(elevation)):
                continue
            flat = cos(elevation)
            if flat > STEEP and far * flat <= farthest:
                out, toward = far * flat, now.yaw + bearing
                height = z + 0.5 * self._height + far * sin(elevation)
                end = x + out * cos(toward), y + out * sin(toward), height
                if not self._lies_on_robot(end, far, neighbours):
                    place = NUMBERS * self._point_count
                    points[place], points[place + 1], points[place + 2] = end
                    self._point_count += 1

    def _find_close(self, here: Vector, neighbours: Neighbours) -> None:
        """Find received robots of which a point can be; never received: NaN."""
        self._close_count = 0
        for k, sender in enumerate(neighbours.all):
            if planar(sender.position, here) <= SIGHT_M + 1.0:
                self._close[self._close_count] = float(k)
                self._close_count += 1

    def _lies_on_robot(self, end: Vector, far: float, neighbours: Neighbours) -> bool:
        """Whether the `end` of a ray that is `far` [m] long lies on a received robot."""
        for k in range(self._close_count):
            if _lies_on(end, far, neighbours.all[int(self._close[k])], self._scanned):
                return True
        return False

    def _add_points(self, here: Vector) -> None:
        low, high = -self._clearance, self._height + self._clearance
        near_x, near_y = here[0], here[1]
        squared = self._horizon * self._horizon
        points = self._points
        for k in range(0, NUMBERS * self._point_count, NUMBERS):
            x, y = points[k], points[k + 1]
            height = points[k + 2]
            off_x, off_y = x - near_x, y - near_y
            up = height - here[2]
            if low < up < high and off_x * off_x + off_y * off_y <= squared:
                thing = self.near.add()
                thing.x, thing.y, thing.low, thing.high = x, y, height, height
                thing.velocity_x = thing.velocity_y = thing.radius = thing.lag = 0.0
                thing.is_robot = False


def _horizon(avoidance: Avoidance, own: OwnState) -> float:
    """Horizon of an avoidance [m]. Raises PluginError if there is none: readings must not be left out by mistake."""
    try:
        horizon = avoidance.horizon(own)
    except FAILURES as error:
        raise failure("avoidance", avoidance, error) from error
    if not (isinstance(horizon, float | int) and horizon >= 0.0):
        raise wrong("avoidance", avoidance, "horizon", horizon, "a distance of 0 m or more")
    return horizon


def _lies_on(end: Vector, far: float, sender: Neighbour, time: float) -> bool:
    """Whether the `end` of a ray that is `far` long [m], and was measured at `time` [s], lies on a received robot."""
    (x, y, z), (vx, vy, vz) = sender.position, sender.velocity
    late = clamp(time - sender.stamp, 0.0, AHEAD_S)
    off_x, off_y, up = end[0] - (x + vx * late), end[1] - (y + vy * late), end[2] - (z + vz * late)
    outline = sender.radius + OUTLINE + OUTLINE_SHARE * far
    beside = -OUTLINE < up < sender.height + OUTLINE
    return beside and off_x * off_x + off_y * off_y <= outline * outline
