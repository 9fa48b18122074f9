"""TurtleBot3: its topics, and velocity commands that are repeated.

The robot has no watchdog for this connection: the OpenCR board stops the wheels when the ROS node on the robot is
silent, not when we are. So every end sends zeros on cmd_vel, and every command is repeated until it is stale.
"""

from __future__ import annotations

from math import inf, isfinite, nan
from typing import Final

import zenoh

from agents.body.interface import FRESH_S, UNANSWERED, UNANSWERED_S, BodyRequest, RangeScan, settings
from agents.clock import StampAge
from agents.network import pubsub
from agents.network import session as network
from bridges.ros2 import messages as ros2
from bridges.ros2.messages import Message
from bridges.ros2.node import Participant
from bridges.turtlebot3 import protocol as turtlebot3
from bridges.turtlebot3.odometry import DRIFT, STANDING, Odometry

REPEAT_S: Final = 0.05  # longest time between commands while the robot shall move,
BETWEEN_S: Final = 0.02  # shortest time between commands that change
ZEROS: Final = 20  # number of zeros after a stop; more while odometry reports motion
BLOCKED_S: Final = 1.5  # time at which the note reports a robot that does not move despite commands

Velocity = tuple[float, float]  # v [m/s], ω [rad/s]
REST: Final[Velocity] = (0.0, 0.0)


class RepeatedVelocity:
    """Velocity that a robot shall have, repeated until it is stale, then zeros. Times are monotonic [s]."""

    def __init__(self, top: Velocity) -> None:
        """At most `top`, the kind's speed and turn rate."""
        self.velocity = self._sent = REST
        self._top = top
        self.halted_since = inf  # infinity while the robot may move
        self._commanded = self._sent_at = self._still_since = -inf
        self._zeros = ZEROS  # number of zeros sent; none is due to a robot that stands

    def drive(self, v: float, w: float, now: float) -> None:
        """Drive at v [m/s], ω [rad/s] until the next command, for `FRESH_S` at most."""
        if v or w:
            if now < self.halted_since < inf:
                return  # a stop from another thread came after that decision
            self.halted_since = inf
        self._commanded = now
        self._change((turtlebot3.whole(v, self._top[0]), turtlebot3.whole(w, self._top[1])), now)

    def stale(self, now: float) -> bool:
        """Whether the last command is too old to be driven by."""
        return now - self._commanded > FRESH_S

    def halt(self, now: float) -> None:
        """Begin to send zeros at once."""
        self.halted_since = min(self.halted_since, now)
        self._zeros = 0
        self._sent_at = -inf
        self._change(REST, now)

    def _change(self, velocity: Velocity, now: float) -> None:
        if velocity == REST:
            if self.velocity != velocity:
                self._zeros = 0
        elif self.velocity == REST:
            self._still_since = now  # the robot should move from here on
        self.velocity = velocity

    def due(self, now: float, odometry: Odometry) -> Velocity | None:
        """The velocity to send now, which counts as sent then; None: not yet.

        A robot out of reach gets zeros, and one of which the frame of odometry is not certain.
        """
        if self.velocity != REST and (self.stale(now) or odometry.silent(now) or odometry.settles(now)):
            self._change(REST, now)
        velocity = self.velocity
        moving = velocity != REST
        if not moving and self._zeros >= ZEROS and odometry.standing:
            return None
        if now - self._sent_at < (BETWEEN_S if velocity != self._sent else REPEAT_S):
            return None
        self._sent, self._sent_at = velocity, now
        self._zeros += not moving
        return velocity

    @property
    def settled(self) -> bool:
        """Whether the robot got several zeros: one sample may be lost."""
        return self._zeros >= 3

    def blocked(self, now: float, *, standing: bool) -> bool:
        """Whether a robot stands for long although it shall move; asked repeatedly."""
        v, w = self.velocity
        if not standing or (abs(v) < 2.0 * STANDING[0] and abs(w) < 2.0 * STANDING[1]):
            self._still_since = now
        return now - self._still_since > BLOCKED_S


class TurtleBotConnection:
    """TurtleBot3 with its topics, state and current command."""

    def __init__(self, request: BodyRequest, row: int) -> None:
        name, kind = request.names[row], request.kinds[row]
        chosen = settings(turtlebot3.TurtleBot3Settings, name, request.device[row])
        where = turtlebot3.address(name, request.addresses[row], chosen)
        self.name, self.address, self.settings = name, where, chosen
        self.endpoints = (chosen.endpoint,) if chosen.endpoint else request.endpoints
        x, y, _ = request.start[row]
        self.odometry = Odometry((x, y, request.yaw[row]), boot=chosen.origin == "boot")
        self.commanded = RepeatedVelocity((kind.speed, kind.turn_rate))
        self.volts = nan  # voltage of the battery [V]
        self.battery = nan  # charge, 0 to 1
        self.scan: RangeScan | None = None  # the newest
        self.joined = False  # True once its topics are joined
        self.time = -inf  # time of measurement of the pose, on the clock of `Body.read` [s]
        self._clock = request.clock
        self._scan_age = StampAge(DRIFT)
        self._command_receivers: dict[str, tuple[str, str]] = {}

    def join(self, participant: Participant) -> None:
        """Declare publishers and subscribers of the robot's topics."""
        where = self.address
        self._types = participant.types
        self._command_type = turtlebot3.command_type(where.distro, self.settings.stamped)
        node = participant.node(f"zenpark_{self.name}", where.namespace)
        self.odometry_inbox = node.subscriber(turtlebot3.ODOMETRY, ros2.ODOMETRY, depth=4)
        self._scan = node.subscriber(turtlebot3.SCAN, ros2.LASER_SCAN, ros2.SENSOR_DATA, depth=1)
        self._battery = node.subscriber(turtlebot3.BATTERY, ros2.BATTERY_STATE, depth=1)
        self._command = node.publisher(self.settings.command_topic, self._command_type)
        topic = ros2.absolute(where.namespace, self.settings.command_topic)
        watched = ros2.endpoints(where.style, "MS", topic, domain=where.domain)
        self._watch = pubsub.AliveWatch(participant.session, watched)
        self.joined = True

    # ------------------------------------------------------------------ reception

    def receive_messages(self, t: float, now: float) -> None:
        """Process received messages at `t` on the clock of `Body.read` and `now` on the monotonic clock [s]."""
        for message in self.odometry_inbox.received():
            if self.odometry.update(message, now) and not self.odometry.unsteady(now):
                self.time = t - self.odometry.age
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

    @property
    def settled(self) -> bool:
        """Whether the robot stands and got several zeros."""
        return self.odometry.standing and self.commanded.settled

    # ------------------------------------------------------------------ commands

    def halt(self, now: float) -> None:
        """Stop the robot: send zeros at once and repeat them."""
        self.commanded.halt(now)
        self.send_command(now)

    def send_command(self, now: float) -> None:
        """Send the current command, if due."""
        velocity = self.commanded.due(now, self.odometry)
        if velocity is None:
            return
        message = self._types.twist((velocity[0], 0.0, 0.0), (0.0, 0.0, velocity[1]))
        if self._command_type == ros2.TWIST_STAMPED:
            header = self._types.header(self._clock.utc(), "base_footprint")
            message = self._types.make(ros2.TWIST_STAMPED, header=header, twist=message)
        self._command.put(message)

    # ------------------------------------------------------------------ faults

    def note(self, now: float, linked: bool) -> str:
        """Faults for users; empty if none."""
        late = now - self.commanded.halted_since > UNANSWERED_S and not self.odometry.standing
        return "; ".join(part for part in (UNANSWERED if late else "", self._link_fault(now, linked)) if part)

    def _link_fault(self, now: float, linked: bool) -> str:
        if not linked:
            return "no router"
        if fault := self.odometry.fault(now):
            return fault
        sent_type = (self._command_type, self._types.hash(self._command_type) if self.address.style == "rmw" else "")
        types = set(self._command_receivers.values())
        if types and sent_type not in types:
            other, code = sorted(types)[0]
            expected = f"the robot expects a {other}" if other != sent_type[0] else f"its type hash is {code}"
            return (
                f"cmd_vel is not received: {expected}, we send a {sent_type[0]} as on {self.address.distro}: "
                "set distro or stamped"
            )
        if self.commanded.blocked(now, standing=self.odometry.standing):
            return f"does not move despite commands: motors on? type of cmd_vel ({self._command_type}) right?"
        return "odometry was restarted: position may be off" if self.odometry.restarted else ""


def ranges(scan: Message, t: float) -> RangeScan:
    """A LaserScan taken at `t` [s]; rays without a hit inside the sensor's range, or without a bearing, are NaN."""
    bearings, distances = [], []
    for number, distance in enumerate(scan.ranges.tolist()):
        bearing = scan.angle_min + scan.angle_increment * number
        valid = scan.range_min <= distance <= scan.range_max and 0.0 < distance < inf and isfinite(bearing)
        bearings.append(bearing if isfinite(bearing) else 0.0)
        distances.append(distance if valid else nan)
    return RangeScan(t, bearings, (0.0,) * len(distances), distances)
