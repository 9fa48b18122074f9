"""One TurtleBot3: odometry becomes a pose in the arena, velocity commands are repeated.

The robot has no watchdog for this connection: the OpenCR board stops the wheels when the ROS node on the robot is
silent, not when we are. So every end sends zeros on cmd_vel, and every command is repeated until it is stale.
"""

from __future__ import annotations

from collections import deque
from math import cos, hypot, inf, isfinite, nan, pi, sin
from typing import Final

import zenoh

from agents.body.interface import FRESH_S, UNANSWERED, BodyError, BodyRequest, RangeScan, settings
from agents.network import pubsub
from agents.network import session as network
from agents.protocols import ros2, turtlebot3
from agents.protocols.ros2 import Message
from agents.protocols.ros2_node import Participant

SILENCE_S: Final = 0.5  # with older odometry the robot is out of reach and gets zeros
REPEAT_S: Final = 0.05  # longest time between commands while the robot shall move,
BETWEEN_S: Final = 0.02  # shortest time between commands that change
ZEROS: Final = 20  # number of zeros after a stop; more while odometry reports motion
ANSWER_S: Final = 2.5  # time after a halt at which the note reports a robot that is not known to stand still
BLOCKED_S: Final = 1.5  # time at which the note reports a robot that does not move despite commands
STANDING: Final = (0.005, 0.02)  # [m/s, rad/s] slower robots stand
FASTEST: Final = 0.5  # [m/s] odometry that jumps faster was restarted
RESETS: Final = (3, 5.0)  # as many within as many seconds are no restarts: two robots send odometry, or it is broken
DRIFT: Final = 1e-3  # [s/s] largest difference between the robot's clock, which may be slewed, and ours
ORIGIN: Final = (0.01, 0.02)  # [m, rad] odometry closer to zero is at its origin

Planar = tuple[float, float, float]  # x, y [m], yaw [rad]


class StampAge:
    """Age of messages: arrival less stamp, less the smallest such difference so far, for the clocks are not the same.

    A stamp that does not grow comes from a clock that was set back, or from a sender without stamps: the record
    restarts.
    """

    def __init__(self) -> None:
        self._stamp = self._arrival = -inf
        self._least = inf

    def age(self, arrival: float, stamp: float) -> float:
        """Age [s] of a message with this stamp [s] that arrived at `arrival` [s, monotonic]."""
        if stamp <= self._stamp:
            self._least = inf
        crept = DRIFT * max(arrival - self._arrival, 0.0) if isfinite(self._arrival) else 0.0
        delay = arrival - stamp
        self._least = min(self._least + crept, delay)
        self._stamp, self._arrival = stamp, arrival
        return delay - self._least


class Robot:
    """One TurtleBot3: topics, pose from odometry, and current command."""

    def __init__(self, request: BodyRequest, row: int) -> None:
        name, kind = request.names[row], request.kinds[row]
        if kind.name != "turtlebot3":
            raise BodyError(f"{name} is a {kind.name}; '{request.addresses[row]}' drives a turtlebot3")
        chosen = settings(turtlebot3.TurtleBot3Settings, name, request.device[row])
        where = turtlebot3.address(name, request.addresses[row], chosen)
        self.name, self.address, self.settings = name, where, chosen
        self.endpoints = (chosen.endpoint,) if chosen.endpoint else request.endpoints
        self._clock = request.clock
        self.pose = (nan, nan, nan)  # x, y [m] and yaw [rad] in the arena; NaN before the first odometry
        self.speed = (0.0, 0.0)  # v [m/s] and ω [rad/s] by odometry
        self.volts = nan  # of the battery [V]
        self.battery = nan  # charge, 0 to 1
        self.scan: RangeScan | None = None  # the newest
        self.odometry_received = -inf  # time of the last odometry, monotonic [s]
        self.time = -inf  # time of measurement of the pose, on the clock of `Body.read` [s]
        self.age = 0.0  # of the last odometry when it arrived, by its stamp [s]
        x, y, _ = request.start[row]
        self._start = (x, y, request.yaw[row])
        self._top = (kind.speed, kind.turn_rate)
        self._raw_pose: Planar = (nan, nan, nan)  # in odometry's own frame
        self._frame: Planar | None = None  # origin of odometry in the arena
        self._restarted = False
        self._resets: deque[float] = deque(maxlen=RESETS[0])  # times of the last, monotonic [s]
        self._odometry_age, self._scan_age = StampAge(), StampAge()
        self._twist = self._sent_twist = (0.0, 0.0)
        self._commanded = self._sent_at = self._still_since = -inf
        self._halted_since = inf  # monotonic [s]; infinity while the robot may move
        self._zeros = ZEROS  # nothing to repeat: nothing is sent before the first command
        self._command_receivers: dict[str, tuple[str, str]] = {}

    def join(self, participant: Participant) -> None:
        """Declare publishers and subscribers of the robot's topics."""
        where = self.address
        self._types = participant.types
        self._command_type = turtlebot3.command_type(where.distro, self.settings.stamped)
        node = participant.node(f"zenpark_{self.name}", where.namespace)
        self._odometry = node.subscriber(turtlebot3.ODOMETRY, ros2.ODOMETRY, depth=4)
        self._scan = node.subscriber(turtlebot3.SCAN, ros2.LASER_SCAN, ros2.SENSOR_DATA, depth=1)
        self._battery = node.subscriber(turtlebot3.BATTERY, ros2.BATTERY_STATE, depth=1)
        self._command = node.publisher(self.settings.command_topic, self._command_type)
        topic = ros2.absolute(where.namespace, self.settings.command_topic)
        watched = ros2.endpoints(where.style, "MS", topic, domain=where.domain)
        self._watch = pubsub.AliveWatch(participant.session, watched)

    @property
    def device(self) -> str:
        """Canonical address: namespace and endpoint."""
        where = self.address
        domain = f"?domain={where.domain}" if where.style == "rmw" else ""
        return f"{where.style}://{where.namespace}{domain} by {', '.join(self.endpoints)}"

    @property
    def odometry_key(self) -> str:
        return self._odometry.key

    # ------------------------------------------------------------------ reception

    def receive_messages(self, t: float, now: float) -> None:
        """Process received messages at `t` on the clock of `Body.read` and `now` on the monotonic clock [s]."""
        for message in self._odometry.received():
            if self._integrate(message, now):
                self.age = self._odometry_age.age(now, ros2.stamp_of(message.header))
                self.odometry_received = now
                if not self._unsteady(now):
                    self.time = t - self.age
        if (scan := self._scan.newest()) is not None:
            self.scan = ranges(scan, t - self._scan_age.age(now, ros2.stamp_of(scan.header)))
        if (battery := self._battery.newest()) is not None:
            self.battery = turtlebot3.charge(battery.voltage, battery.percentage)
            self.volts = float(battery.voltage)
        for sample in network.received(self._watch.handler):
            token = str(sample.key_expr)
            if sample.kind == zenoh.SampleKind.DELETE:
                self._command_receivers.pop(token, None)
                continue
            try:
                listener = ros2.announced(self.address.style, token)
            except ValueError:
                continue
            self._command_receivers[token] = (listener.kind, listener.hash)

    def _integrate(self, message: Message, now: float) -> bool:
        """Update the pose in the arena from odometry; False if a number is not finite."""
        place, q = message.pose.pose.position, message.pose.pose.orientation
        twist = message.twist.twist
        x, y, v, w = place.x, place.y, twist.linear.x, twist.angular.z
        yaw = ros2.yaw_of(q)
        if not all(map(isfinite, (x, y, yaw, v, w))):
            return False
        if self._frame is None:
            boot = self.settings.origin == "boot"
            self._frame = self._start if boot else _frame(self._start, (x, y, yaw))
        pose = _to_arena(self._frame, (x, y, yaw))
        if self.odometry_received > -inf and self._odometry_reset((x, y, yaw), pose, now):
            # odometry counts from zero again: assume that the robot stands at its last known pose
            self._frame, self._restarted = _frame(self.pose, (x, y, yaw)), True
            self._resets.append(now)
            pose = self.pose
        self._raw_pose = (x, y, yaw)
        self.pose, self.speed = pose, (v, w)
        return True

    def _odometry_reset(self, counted: Planar, pose: Planar, now: float) -> bool:
        """Whether odometry was reset: a jump faster than any robot, or back at the origin after a silence."""
        silence = now - self.odometry_received
        jump = hypot(pose[0] - self.pose[0], pose[1] - self.pose[1])
        back = silence > SILENCE_S and _at_origin(counted) and not _at_origin(self._raw_pose)
        return back or jump > FASTEST * silence + 0.1

    def _unsteady(self, now: float) -> bool:
        """Whether odometry was reset too often to tell a position."""
        count, span = RESETS
        return len(self._resets) == count and now - self._resets[0] < span

    @property
    def standing(self) -> bool:
        return abs(self.speed[0]) < STANDING[0] and abs(self.speed[1]) < STANDING[1]

    @property
    def settled(self) -> bool:
        """Whether the robot stands and got several zeros: one sample may be lost."""
        return self.standing and self._zeros >= 3

    # ------------------------------------------------------------------ commands

    def drive(self, v: float, w: float, now: float) -> None:
        """Drive at v [m/s], ω [rad/s] until the next command, for `FRESH_S` at most."""
        self._commanded = now
        if v or w:
            self._halted_since = inf
        self._set_twist((turtlebot3.whole(v, self._top[0]), turtlebot3.whole(w, self._top[1])), now)

    def stale(self, now: float) -> bool:
        """Whether the last command is too old to be driven by."""
        return now - self._commanded > FRESH_S

    def halt(self, now: float) -> None:
        """Stop the robot: send zeros at once and repeat them."""
        self._halted_since = min(self._halted_since, now)
        self._zeros = 0
        self._sent_at = -inf
        self._set_twist((0.0, 0.0), now)
        self.send_command(now)

    def _set_twist(self, twist: tuple[float, float], now: float) -> None:
        if twist == (0.0, 0.0):
            if self._twist != twist:
                self._zeros = 0
        elif self._twist == (0.0, 0.0):
            self._still_since = now  # from here on the robot should move
        self._twist = twist

    def send_command(self, now: float) -> None:
        """Send the current command, if due."""
        if self._twist != (0.0, 0.0) and (self.stale(now) or now - self.odometry_received > SILENCE_S):
            self._set_twist((0.0, 0.0), now)
        twist = self._twist
        moving = twist != (0.0, 0.0)
        if not moving and self._zeros >= ZEROS and (self._sent_at == -inf or self.standing):
            return
        if now - self._sent_at < (BETWEEN_S if twist != self._sent_twist else REPEAT_S):
            return
        self._sent_twist, self._sent_at = twist, now
        self._zeros += not moving
        message = self._types.twist((twist[0], 0.0, 0.0), (0.0, 0.0, twist[1]))
        if self._command_type == ros2.TWIST_STAMPED:
            header = self._types.header(self._clock.utc(), "base_footprint")
            message = self._types.make(ros2.TWIST_STAMPED, header=header, twist=message)
        self._command.put(message)

    # ------------------------------------------------------------------ faults

    def note(self, now: float, linked: bool) -> str:
        """Faults for users; empty if none."""
        unanswered = UNANSWERED if now - self._halted_since > ANSWER_S and not self.standing else ""
        return "; ".join(part for part in (unanswered, self._link_fault(now, linked)) if part)

    def _odometry_fault(self, now: float) -> str:
        if now - self.odometry_received > SILENCE_S:
            return (
                f"odometry silent for {now - self.odometry_received:.0f} s"
                if self.odometry_received > -inf
                else "no odometry"
            )
        if self._unsteady(now):
            return "odometry jumps again and again: do two robots have this namespace?"
        if self.age > SILENCE_S:
            return f"odometry is {self.age:.1f} s old by its stamps: its link holds it back, or its clock was set"
        return ""

    def _link_fault(self, now: float, linked: bool) -> str:
        if not linked:
            return "no router"
        if fault := self._odometry_fault(now):
            return fault
        mine = (self._command_type, self._types.hash(self._command_type) if self.address.style == "rmw" else "")
        types = set(self._command_receivers.values())
        if types and mine not in types:
            other, code = sorted(types)[0]
            expected = f"the robot expects a {other}" if other != mine[0] else f"its type hash is {code}"
            return (
                f"cmd_vel is not received: {expected}, we send a {mine[0]} as on {self.address.distro}: "
                "set distro or stamped"
            )
        if not self.standing or self._twist == (0.0, 0.0):
            self._still_since = now
        elif now - self._still_since > BLOCKED_S:
            return f"does not move despite commands: motors on? type of cmd_vel ({self._command_type}) right?"
        return "odometry was restarted: position may be off" if self._restarted else ""


def _at_origin(pose: Planar) -> bool:
    return hypot(pose[0], pose[1]) < ORIGIN[0] and abs(pose[2]) < ORIGIN[1]


def _to_arena(frame: Planar, pose: Planar) -> Planar:
    """Transform a pose from `frame` to the arena."""
    x, y, yaw = frame
    c, s = cos(yaw), sin(yaw)
    heading = pi - (pi - yaw - pose[2]) % (2.0 * pi)
    return x + c * pose[0] - s * pose[1], y + s * pose[0] + c * pose[1], heading


def _frame(arena: Planar, pose: Planar) -> Planar:
    """Frame in which `pose` equals the pose `arena` of the arena."""
    yaw = arena[2] - pose[2]
    c, s = cos(yaw), sin(yaw)
    return arena[0] - c * pose[0] + s * pose[1], arena[1] - s * pose[0] - c * pose[1], yaw


def ranges(scan: Message, t: float) -> RangeScan:
    """A LaserScan taken at `t` [s]; rays without a hit inside the sensor's range, or without a bearing, are NaN."""
    bearings, distances = [], []
    for number, distance in enumerate(scan.ranges.tolist()):
        bearing = scan.angle_min + scan.angle_increment * number
        valid = scan.range_min <= distance <= scan.range_max and 0.0 < distance < inf and isfinite(bearing)
        bearings.append(bearing if isfinite(bearing) else 0.0)
        distances.append(distance if valid else nan)
    return RangeScan(t, bearings, (0.0,) * len(distances), distances)
