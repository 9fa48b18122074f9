"""TurtleBot3 over Zenoh: through zenoh-bridge-ros2dds (`ros2dds://`) or rmw_zenoh (`rmw://`).

The robot has no watchdog of its own: the OpenCR board stops the wheels when the ROS node on the robot falls silent, not
when we do. So nothing here may end without a zero on cmd_vel, and what is sent is sent again.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from math import atan2, cos, hypot, nan, pi, sin
from typing import Final

import numpy as np
import zenoh

from agents import ros2, turtlebot3
from agents import session as network
from agents.body import Body, BodyError, BodyRequest, BodyState, RangeScan
from agents.positioning import External
from agents.ros2 import Message
from agents.rosnode import Participant
from agents.rows import Array, Index
from agents.turtlebot3 import Address, Settings

OPEN_S: Final = 4.5  # from the first attempt to reach the router to odometry of every robot
DIAGNOSIS_S: Final = 0.3  # how long `open` asks who else is there before it gives up
POLL_S: Final = 0.01

SILENCE_S: Final = 0.5  # odometry older than this: the robot is out of reach and gets zeros
REPEAT_S: Final = 0.05  # commands are sent at least this often while the robot is to move,
BETWEEN_S: Final = 0.02  # and at most this often when they change
ZEROS: Final = 20  # so often a zero is repeated, and longer while odometry says that it moves
FAREWELL_S: Final = 0.5  # how long `close` waits for the robots to stand
BLOCKED_S: Final = 1.5  # a robot that was told to move for so long and did not has something in its way
STANDING: Final = (0.005, 0.02)  # [m/s, rad/s] slower than this is standing
FASTEST: Final = 0.5  # [m/s] odometry that jumps farther than this was started anew

Clock = Callable[[], float]


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

    def __init__(self, name: str, where: Address, chosen: Settings, start: Array, yaw: float, top: Array) -> None:
        self.name, self.where, self.chosen = name, where, chosen
        self.pose = (nan, nan, nan)
        self.speed = (0.0, 0.0)
        self.battery = nan
        self.scan: RangeScan | None = None
        self.heard = self.time = -np.inf
        self._start = (float(start[0]), float(start[1]), yaw)
        self._top = (float(top[0]), float(top[1]))
        self._frame: tuple[float, float, float] | None = None  # where the origin of odometry is in the arena
        self._restarted = False
        self._wanted = self._sent = (0.0, 0.0)
        self._commanded = self._sent_at = self._moved = -np.inf
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
        self._command = node.publisher(turtlebot3.COMMAND, self._command_type)
        topic = ros2.absolute(where.namespace, turtlebot3.COMMAND)
        watched = ros2.endpoints(where.style, "MS", topic, domain=where.domain)
        self._watch = network.alive_watch(participant.session, watched)

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
                _, kind, code = ros2.announced(self.where.style, token)
            except ValueError:
                continue
            self._listeners[token] = (kind, code)

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
        if self.heard > -np.inf:
            jump = hypot(pose[0] - self.pose[0], pose[1] - self.pose[1])
            if jump > FASTEST * (now - self.heard) + 0.1:
                # its node was started anew and counts from zero: it stands where it was last seen, as far as we know
                self._frame, self._restarted = _frame(self.pose, (x, y, yaw)), True
                pose = self.pose
        self.pose, self.speed = pose, (v, w)
        return True

    @property
    def standing(self) -> bool:
        """Whether odometry says that it does not move."""
        return abs(self.speed[0]) < STANDING[0] and abs(self.speed[1]) < STANDING[1]

    # ------------------------------------------------------------------ what it is told

    def drive(self, v: float, w: float, now: float) -> None:
        """Must move at v [m/s], ω [rad/s] until told otherwise, or until nobody has commanded it for `SILENCE_S`."""
        self._commanded = now
        self._want((turtlebot3.whole(v, self._top[0]), turtlebot3.whole(w, self._top[1])), now)

    def halt(self, now: float) -> None:
        """Must stand; says so at once, and again."""
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
        if self._wanted != (0.0, 0.0) and now - min(self._commanded, self.heard) > SILENCE_S:
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
            header = self._types.header(time.time(), "base_footprint")
            message = self._types.make(ros2.TWIST_STAMPED, header=header, twist=message)
        self._command.put(message)

    # ------------------------------------------------------------------ what it says of itself

    def note(self, now: float, linked: bool) -> str:
        """What is wrong with it, for people; empty if nothing."""
        if not linked:
            return "no router"
        if now - self.heard > SILENCE_S:
            return f"odometry silent for {now - self.heard:.0f} s" if self.heard > -np.inf else "no odometry"
        mine = (self._command_type, self._types.hash(self._command_type) if self.where.style == "rmw" else "")
        heard = set(self._listeners.values())
        if heard and mine not in heard:
            other, code = sorted(heard)[0]
            told = f"it hears a {other}" if other != mine[0] else f"its type hash is {code}"
            return f"does not hear cmd_vel: {told}, we send a {mine[0]} as on {self.where.distro}: set distro or stamped"
        if not self.standing or self._wanted == (0.0, 0.0):
            self._moved = now
        elif now - self._moved > BLOCKED_S:
            return f"is told to move and does not: motors on? type of cmd_vel ({self._command_type}) right?"
        return "odometry was started anew: position may be off" if self._restarted else ""


def _placed(frame: tuple[float, float, float], pose: tuple[float, float, float]) -> tuple[float, float, float]:
    """A pose in a frame, as a pose in the arena."""
    x, y, yaw = frame
    c, s = cos(yaw), sin(yaw)
    heading = pi - (pi - yaw - pose[2]) % (2.0 * pi)
    return x + c * pose[0] - s * pose[1], y + s * pose[0] + c * pose[1], heading


def _frame(arena: tuple[float, float, float], pose: tuple[float, float, float]) -> tuple[float, float, float]:
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


class TurtleBot3:
    """Rows of TurtleBot3; implements `agents.body.Body`. Everything is polled: no threads.

    Args:
        request: What to open.
        clock: Monotonic [s].

    Raises:
        BodyError: If an address or a setting is wrong.
    """

    def __init__(self, request: BodyRequest, clock: Clock = time.monotonic) -> None:
        self._clock = clock
        self._robots: list[Robot] = []
        for row, name in enumerate(request.names):
            kind = request.kinds[row]
            if kind.name != "turtlebot3":
                raise BodyError(f"{name} is a {kind.name}; '{request.addresses[row]}' drives a turtlebot3")
            chosen = turtlebot3.settings(name, request.device[row])
            where = turtlebot3.address(name, request.addresses[row], chosen)
            top = np.array([kind.speed, kind.turn_rate])
            self._robots.append(Robot(name, where, chosen, request.start[row], float(request.yaw[row]), top))
        self._endpoints = [
            (robot.chosen.endpoint,) if robot.chosen.endpoint else request.endpoints for robot in self._robots
        ]
        self._sessions: dict[tuple[str, ...], zenoh.Session] = {}
        self._outside = np.flatnonzero(request.external)
        self._external = External(len(self._robots))

    def open(self) -> None:
        """See `Body.open`: returns when every robot's odometry was heard."""
        deadline = self._clock() + OPEN_S
        try:
            participants: dict[tuple[object, ...], Participant] = {}
            for robot, endpoints in zip(self._robots, self._endpoints, strict=True):
                where = robot.where
                session = self._session(robot.name, endpoints, deadline)
                which = (endpoints, where.style, where.distro, where.domain)
                if which not in participants:
                    participants[which] = Participant(
                        session, ros2.types(where.distro), style=where.style, domain=where.domain
                    )
                robot.join(participants[which])
            while missing := [robot for robot in self._robots if robot.heard == -np.inf]:
                now = self._clock()
                if now > deadline:
                    raise BodyError("; ".join(self._absent(robot) for robot in missing))
                time.sleep(POLL_S)
                for robot in self._robots:
                    robot.hear(-np.inf, now)
        except BaseException:
            self._close()
            raise

    def _session(self, name: str, endpoints: tuple[str, ...], deadline: float) -> zenoh.Session:
        if endpoints not in self._sessions:
            wait = max(0.0, deadline - self._clock())
            try:
                self._sessions[endpoints] = network.open_session(endpoints, name=f"{name} ROS 2", wait_s=wait)
            except (network.Unreachable, network.EndpointError) as error:
                raise BodyError(f"{name}: {error}; or set device.endpoint to the router of the robot") from None
        return self._sessions[endpoints]

    def _absent(self, robot: Robot) -> str:
        """Why a robot's odometry may not have come, and what to do."""
        where = robot.where
        session = self._sessions[self._endpoints[self._robots.index(robot)]]
        topic = ros2.absolute(where.namespace, turtlebot3.ODOMETRY)
        hint = (
            "is the robot on, and zenoh-bridge-ros2dds on it connected to this router?"
            if where.style == "ros2dds"
            else "is the robot on, and its ROS 2 (RMW_IMPLEMENTATION=rmw_zenoh_cpp) connected to this router?"
        )
        others = set()
        for reply in session.liveliness().get(
            ros2.endpoints(where.style, "MP", "*", domain=where.domain), timeout=DIAGNOSIS_S
        ):
            if reply.ok is None:
                continue
            try:
                name, kind, code = ros2.announced(where.style, str(reply.ok.key_expr))
            except ValueError:
                continue
            if name == topic and code:
                hint = f"it is published there with type hash {code}: set distro (now {where.distro})"
            elif kind == ros2.ODOMETRY:
                others.add(name.rpartition("/")[0].removeprefix("/") or "(none)")
        if others:
            hint += f" Namespaces with odometry there: {', '.join(sorted(others))}"
        return f"{robot.name}: no odometry on '{robot.odometry_key}': {hint}"

    def read(self, t: float) -> BodyState:
        """See `Body.read`."""
        now = self._clock()
        robots = self._robots
        for robot in robots:
            robot.hear(t, now)
            if robot.time == -np.inf and robot.heard > -np.inf:
                robot.time = t - (now - robot.heard)  # heard while it was opened
            robot.speak(now)
        rows = len(robots)
        pose = np.array([robot.pose for robot in robots])
        speed = np.array([robot.speed[0] for robot in robots])
        position = np.zeros((rows, 3))
        position[:, :2] = pose[:, :2]
        position[np.isnan(pose[:, 0])] = nan
        linked = {endpoints: network.connected(session) for endpoints, session in self._sessions.items()}
        state = BodyState(
            time=np.array([robot.time for robot in robots]),
            position=position,
            velocity=np.zeros((rows, 3)),
            yaw=pose[:, 2].copy(),
            true_position=np.full((rows, 3), nan),
            true_yaw=np.full(rows, nan),
            battery=np.array([robot.battery for robot in robots]),
            flying=np.zeros(rows, dtype=bool),
            notes=tuple(
                robot.note(now, linked[endpoints]) for robot, endpoints in zip(robots, self._endpoints, strict=True)
            ),
            ranges=tuple(robot.scan for robot in robots),
        )
        if len(self._outside):
            odometry = state.time.copy()
            self._external.fill(state, self._outside)
            # a robot that is seen from outside and does not answer is still out of reach
            state.time = np.where(t - odometry > SILENCE_S, np.minimum(state.time, odometry), state.time)
        state.velocity[:, 0], state.velocity[:, 1] = speed * np.cos(state.yaw), speed * np.sin(state.yaw)
        state.velocity[:, 2] = 0.0
        return state

    def command(self, setpoint: Array) -> None:
        """See `Body.command`: v [m/s] and ω [rad/s]."""
        now = self._clock()
        for robot, (v, w, _, _) in zip(self._robots, setpoint.tolist(), strict=True):
            if np.isfinite(v) and np.isfinite(w):
                robot.drive(v, w, now)
            robot.speak(now)

    def takeoff(self, rows: Index, height: Array) -> None:
        """See `Body.takeoff`: does nothing, a ground robot is where it should be."""

    def land(self, rows: Index) -> None:
        """See `Body.land`."""
        now = self._clock()
        for row in rows.tolist():
            self._robots[row].halt(now)

    def stop(self, rows: Index) -> None:
        """See `Body.stop`."""
        self.land(rows)

    def locate(self, row: int, t: float, position: Array, yaw: float) -> None:
        """See `Body.locate`."""
        self._external.update(row, t, position, yaw)

    def close(self) -> None:
        """Stops every robot, waits a moment until they stand, and leaves the network."""
        until = self._clock() + FAREWELL_S
        for robot in self._robots:
            robot.halt(self._clock())
        while (now := self._clock()) < until:
            for robot in self._robots:
                robot.hear(robot.time, now)
                robot.speak(now)
            if all(robot.standing for robot in self._robots):
                break
            time.sleep(POLL_S)
        self._close()

    def _close(self) -> None:
        for session in self._sessions.values():
            session.close()  # type: ignore[no-untyped-call]
        self._sessions.clear()


def open_turtlebot3(request: BodyRequest) -> Body:
    """The entry points `ros2dds` and `rmw` of the group `zenpark.bodies`.

    Raises:
        BodyError: As `TurtleBot3`.
    """
    return TurtleBot3(request)
