"""Perception: things near a robot, from its own range readings and received poses. Quiet, except for new readings."""

from __future__ import annotations

from math import cos, inf, isfinite, sin
from typing import ClassVar, Final, NamedTuple

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


class Point(NamedTuple):
    """End of a range reading in the room."""

    x: float  # [m]
    y: float
    height: float  # [m]
    distance: float  # distance from the robot, when it was measured [m]


class Perception:
    """Inputs of the avoidance of a robot."""

    FIXED: ClassVar = ("sees",)

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
        self._scan: RangeScan | None = None
        self._points: list[Point] = []

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

    def _look(self, t: float, now: Situation, neighbours: Neighbours, aware: bool) -> None:
        """Add what the newest range readings saw; rare."""
        scan = now.state.scan
        if scan is not self._scan:
            self._scan = scan
            self._update_points(scan, now, neighbours)
            self.near.reserve(self._links + len(self._points))
        if aware and scan is not None and t - scan.time <= SCAN_S:
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

    def _update_points(self, scan: RangeScan | None, now: Situation, neighbours: Neighbours) -> None:
        """Update the end points of new range readings, by the pose of the robot at their measurement."""
        self._points = []
        if scan is None or not (is_finite(now.position) and isfinite(now.yaw)):
            return
        then = clamp(now.state.time - scan.time, 0.0, SCAN_S)
        vx, vy, vz = (each if isfinite(each) else 0.0 for each in now.velocity)
        x, y, z = now.position[0] - vx * then, now.position[1] - vy * then, now.position[2] - vz * then
        # those of which a point can be; never received: NaN
        close = [each for each in neighbours.all if planar(each.position, now.position) <= SIGHT_M + 1.0]
        farthest = min(SIGHT_M, self._in_time)
        for bearing, elevation, far in zip(scan.bearing, scan.elevation, scan.distance, strict=True):
            # NaN: nothing was hit; nothing is inside the robot either
            if not (INSIDE * self._radius < far <= SIGHT_M and isfinite(bearing) and isfinite(elevation)):
                continue
            flat = cos(elevation)
            if flat > STEEP and far * flat <= farthest:
                out, toward = far * flat, now.yaw + bearing
                height = z + 0.5 * self._height + far * sin(elevation)
                point = Point(x + out * cos(toward), y + out * sin(toward), height, far)
                if not any(_lies_on(point, sender, scan.time) for sender in close):
                    self._points.append(point)

    def _add_points(self, here: Vector) -> None:
        low, high = -self._clearance, self._height + self._clearance
        near_x, near_y = here[0], here[1]
        squared = self._horizon * self._horizon
        for point in self._points:
            off_x, off_y = point.x - near_x, point.y - near_y
            up = point.height - here[2]
            if low < up < high and off_x * off_x + off_y * off_y <= squared:
                thing = self.near.add()
                thing.x, thing.y, thing.low, thing.high = point.x, point.y, point.height, point.height
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


def _lies_on(point: Point, sender: Neighbour, time: float) -> bool:
    """Whether a point that was measured at `time` [s] lies on a received robot."""
    (x, y, z), (vx, vy, vz) = sender.position, sender.velocity
    late = clamp(time - sender.stamp, 0.0, AHEAD_S)
    off_x, off_y, up = point.x - (x + vx * late), point.y - (y + vy * late), point.height - (z + vz * late)
    outline = sender.radius + OUTLINE + OUTLINE_SHARE * point.distance
    beside = -OUTLINE < up < sender.height + OUTLINE
    return beside and off_x * off_x + off_y * off_y <= outline * outline
