"""One TurtleBot3 at the far end of its topics: what it says becomes a pose, what it must do is said until it does it.

The robot has no watchdog of its own: the OpenCR board stops the wheels when the ROS node on the robot falls silent, not
when we do. So nothing here may end without a zero on cmd_vel, and what is sent is sent again.
"""

from __future__ import annotations

from math import atan2, cos, hypot, nan, pi, sin
from typing import Final

import numpy as np
import zenoh

from agents.body.interface import FRESH_S, UNANSWERED, BodyError, BodyRequest, RangeScan, settings
from agents.network import pubsub
from agents.network import session as network
from agents.protocols import ros2, turtlebot3
from agents.protocols.ros2 import Message
from agents.protocols.ros2_node import Participant

SILENCE_S: Final = 0.5  # odometry older than this: the robot is out of reach and gets zeros
REPEAT_S: Final = 0.05  # commands are sent at least this often while the robot is to move,
BETWEEN_S: Final = 0.02  # and at most this often when they change
ZEROS: Final = 20  # so often a zero is repeated, and longer while odometry says that it moves
ANSWER_S: Final = 2.5  # a robot that was told to halt and is not known to stand after this is worth a word
BLOCKED_S: Final = 1.5  # a robot that was told to move for so long and did not has something in its way
STANDING: Final = (0.005, 0.02)  # [m/s, rad/s] slower than this is standing
FASTEST: Final = 0.5  # [m/s] odometry that jumps farther than this was started anew
ORIGIN: Final = (0.01, 0.02)  # [m, rad] nearer than this it is at its origin

Planar = tuple[float, float, float]  # x, y [m], yaw [rad]


class Robot:
    """One TurtleBot3: its topics, the pose that its odometry means, and the command that it must have.

    Attributes:
        name: For messages.
        pose: x, y [m] and yaw [rad] in the arena; NaN before the first odometry.
        speed: v [m/s] and ω [rad/s] by odometry.
        battery: Charge, 0 to 1; NaN if unknown.
        scan: The newest.
        heard: When odometry came last, on the clock.
        time: When the pose was measured, on the clock of `Body.read`.
    """

    def __init__(self, request: BodyRequest, row: int) -> None:
        name, kind = request.names[row], request.kinds[row]
        if kind.name != "turtlebot3":
            raise BodyError(f"{name} is a {kind.name}; '{request.addresses[row]}' drives a turtlebot3")
        chosen = settings(turtlebot3.Settings, name, request.device[row])
        where = turtlebot3.address(name, request.addresses[row], chosen)
        self.name, self.where, self.chosen = name, where, chosen
        self.endpoints = (chosen.endpoint,) if chosen.endpoint else request.endpoints
        self._clock = request.clock
        self.pose = (nan, nan, nan)
        self.speed = (0.0, 0.0)
        self.battery = nan
        self.scan: RangeScan | None = None
        self.heard = self.time = -np.inf
        x, y, _ = request.start[row].tolist()
        self._start = (x, y, float(request.yaw[row]))
        self._top = (kind.speed, kind.turn_rate)
        self._counted: Planar = (nan, nan, nan)  # what odometry itself said
        self._frame: Planar | None = None  # where the origin of odometry is in the arena
        self._restarted = False
        self._wanted = self._sent = (0.0, 0.0)
        self._commanded = self._sent_at = self._moved = -np.inf
        self._halted = np.inf  # since when it must stand
        self._zeros = ZEROS  # nothing to repeat: no robot is spoken to before it is commanded
        self._listeners: dict[str, tuple[str, str]] = {}

    def join(self, participant: Participant) -> None:
        """Declares what it says and hears."""
        where = self.where
        self._types = participant.types
        self._command_type = turtlebot3.command_type(where.distro, self.chosen.stamped)
        node = participant.node(f"zenpark_{self.name}", where.namespace)
        self._odometry = node.subscriber(turtlebot3.ODOMETRY, ros2.ODOMETRY, depth=4)
        self._scan = node.subscriber(turtlebot3.SCAN, ros2.LASER_SCAN, ros2.SENSOR_DATA, depth=1)
        self._battery = node.subscriber(turtlebot3.BATTERY, ros2.BATTERY_STATE, depth=1)
        self._command = node.publisher(self.chosen.command_topic, self._command_type)
        topic = ros2.absolute(where.namespace, self.chosen.command_topic)
        watched = ros2.endpoints(where.style, "MS", topic, domain=where.domain)
        self._watch = pubsub.AliveWatch(participant.session, watched)

    @property
    def device(self) -> str:
        """Canonical address of a robot: its namespace and its endpoint."""
        where = self.where
        domain = f"?domain={where.domain}" if where.style == "rmw" else ""
        return f"{where.style}://{where.namespace}{domain} by {', '.join(self.endpoints)}"

    @property
    def odometry_key(self) -> str:
        """Where its odometry is looked for."""
        return self._odometry.key

    # ------------------------------------------------------------------ what it hears

    def hear(self, t: float, now: float) -> None:
        """Takes in what has arrived: `t` on the clock of `Body.read`, `now` on the monotonic one [s]."""
        for message in self._odometry.received():
            if self._measure(message, now):
                self.heard, self.time = now, t
        if (scan := self._scan.newest()) is not None:
            self.scan = ranges(scan, t)
        if (battery := self._battery.newest()) is not None:
            self.battery = turtlebot3.charge(battery.voltage, battery.percentage)
        for sample in network.received(self._watch.handler):
            token = str(sample.key_expr)
            if sample.kind == zenoh.SampleKind.DELETE:
                self._listeners.pop(token, None)
                continue
            try:
                listener = ros2.announced(self.where.style, token)
            except ValueError:
                continue
            self._listeners[token] = (listener.kind, listener.hash)

    def _measure(self, message: Message, now: float) -> bool:
        """Odometry as a pose in the arena; False if it is none."""
        place, q = message.pose.pose.position, message.pose.pose.orientation
        twist = message.twist.twist
        x, y, v, w = place.x, place.y, twist.linear.x, twist.angular.z
        yaw = atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
        if not np.isfinite((x, y, yaw, v, w)).all():
            return False
        if self._frame is None:
            boot = self.chosen.origin == "boot"
            self._frame = self._start if boot else _frame(self._start, (x, y, yaw))
        pose = _placed(self._frame, (x, y, yaw))
        if self.heard > -np.inf and self._anew((x, y, yaw), pose, now):
            # its node counts from zero again: it stands where it was last seen, as far as we know
            self._frame, self._restarted = _frame(self.pose, (x, y, yaw)), True
            pose = self.pose
        self._counted = (x, y, yaw)
        self.pose, self.speed = pose, (v, w)
        return True

    def _anew(self, counted: Planar, pose: Planar, now: float) -> bool:
        """Whether odometry was reset: it jumps as no robot moves, or is back at its origin after a silence."""
        silence = now - self.heard
        jump = hypot(pose[0] - self.pose[0], pose[1] - self.pose[1])
        back = silence > SILENCE_S and _zero(counted) and not _zero(self._counted)
        return back or jump > FASTEST * silence + 0.1

    @property
    def standing(self) -> bool:
        """Whether odometry says that it does not move."""
        return abs(self.speed[0]) < STANDING[0] and abs(self.speed[1]) < STANDING[1]

    @property
    def settled(self) -> bool:
        """Whether it stands, and was told so more than once: one sample may be lost."""
        return self.standing and self._zeros >= 3

    # ------------------------------------------------------------------ what it is told

    def drive(self, v: float, w: float, now: float) -> None:
        """Must move at v [m/s], ω [rad/s] until told otherwise, or until nobody has commanded it for `FRESH_S`."""
        self._commanded = now
        if v or w:
            self._halted = np.inf
        self._want((turtlebot3.whole(v, self._top[0]), turtlebot3.whole(w, self._top[1])), now)

    def halt(self, now: float) -> None:
        """Must stand; says so at once, and again."""
        self._halted = min(self._halted, now)
        self._zeros = 0
        self._sent_at = -np.inf
        self._want((0.0, 0.0), now)
        self.speak(now)

    def _want(self, twist: tuple[float, float], now: float) -> None:
        if twist == (0.0, 0.0):
            if self._wanted != twist:
                self._zeros = 0
        elif self._wanted == (0.0, 0.0):
            self._moved = now  # from here on it should move
        self._wanted = twist

    def speak(self, now: float) -> None:
        """Sends the command when it is due."""
        if self._wanted != (0.0, 0.0) and (now - self._commanded > FRESH_S or now - self.heard > SILENCE_S):
            self._want((0.0, 0.0), now)
        twist = self._wanted
        moving = twist != (0.0, 0.0)
        if not moving and self._zeros >= ZEROS and (self._sent_at == -np.inf or self.standing):
            return
        if now - self._sent_at < (BETWEEN_S if twist != self._sent else REPEAT_S):
            return
        self._sent, self._sent_at = twist, now
        self._zeros += not moving
        message = self._types.twist((twist[0], 0.0, 0.0), (0.0, 0.0, twist[1]))
        if self._command_type == ros2.TWIST_STAMPED:
            header = self._types.header(self._clock.utc(), "base_footprint")
            message = self._types.make(ros2.TWIST_STAMPED, header=header, twist=message)
        self._command.put(message)

    # ------------------------------------------------------------------ what it says of itself

    def note(self, now: float, linked: bool) -> str:
        """What is wrong with it, for people; empty if nothing."""
        unanswered = UNANSWERED if now - self._halted > ANSWER_S and not self.standing else ""
        return "; ".join(part for part in (unanswered, self._trouble(now, linked)) if part)

    def _trouble(self, now: float, linked: bool) -> str:
        if not linked:
            return "no router"
        if now - self.heard > SILENCE_S:
            return f"odometry silent for {now - self.heard:.0f} s" if self.heard > -np.inf else "no odometry"
        mine = (self._command_type, self._types.hash(self._command_type) if self.where.style == "rmw" else "")
        heard = set(self._listeners.values())
        if heard and mine not in heard:
            other, code = sorted(heard)[0]
            told = f"it hears a {other}" if other != mine[0] else f"its type hash is {code}"
            return (
                f"does not hear cmd_vel: {told}, we send a {mine[0]} as on {self.where.distro}: set distro or stamped"
            )
        if not self.standing or self._wanted == (0.0, 0.0):
            self._moved = now
        elif now - self._moved > BLOCKED_S:
            return f"is told to move and does not: motors on? type of cmd_vel ({self._command_type}) right?"
        return "odometry was started anew: position may be off" if self._restarted else ""


def _zero(pose: Planar) -> bool:
    return hypot(pose[0], pose[1]) < ORIGIN[0] and abs(pose[2]) < ORIGIN[1]


def _placed(frame: Planar, pose: Planar) -> Planar:
    """A pose in a frame, as a pose in the arena."""
    x, y, yaw = frame
    c, s = cos(yaw), sin(yaw)
    heading = pi - (pi - yaw - pose[2]) % (2.0 * pi)
    return x + c * pose[0] - s * pose[1], y + s * pose[0] + c * pose[1], heading


def _frame(arena: Planar, pose: Planar) -> Planar:
    """The frame in which `pose` is the pose `arena` of the arena."""
    yaw = arena[2] - pose[2]
    c, s = cos(yaw), sin(yaw)
    return arena[0] - c * pose[0] + s * pose[1], arena[1] - s * pose[0] - c * pose[1], yaw


def ranges(scan: Message, t: float) -> RangeScan:
    """A LaserScan heard at `t`; rays that hit nothing, or nearer or farther than the sensor sees, are NaN."""
    distance = scan.ranges.astype(float)
    seen = (distance >= scan.range_min) & (distance <= scan.range_max)
    bearing = scan.angle_min + scan.angle_increment * np.arange(len(distance))
    return RangeScan(t, bearing, np.zeros(len(distance)), np.where(seen, distance, nan))
