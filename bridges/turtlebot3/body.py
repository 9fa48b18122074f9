"""Body of several TurtleBot3 over Zenoh: zenoh-bridge-ros2dds (`ros2dds://`) or rmw_zenoh (`rmw://`).

A thread sends zeros while the loop sends nothing: it hangs, or waits until the robot's name is its own again.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from math import cos, inf, isfinite, sin
from typing import Final

import zenoh

from agents.body.device_address import DeviceAddress
from agents.body.external_pose import External
from agents.body.interface import (
    Body,
    BodyEntry,
    BodyError,
    BodyFault,
    BodyRequest,
    BodyState,
    call_all,
    judged,
    settings,
)
from agents.clock import uptime
from agents.errors import ExplainedError
from agents.network import session as network
from agents.network.endpoints import Endpoint
from agents.network.messages import Inspection, number
from agents.network.shutdown import leave
from agents.vectors import UNKNOWN, Setpoint, Vector
from bridges.ros2 import messages as ros2
from bridges.ros2.node import Participant
from bridges.turtlebot3 import protocol as turtlebot3
from bridges.turtlebot3.odometry import SILENCE_S
from bridges.turtlebot3.robot import REPEAT_S, TurtleBotConnection

OPEN_S: Final = 4.5  # time from the first attempt to reach the router to odometry of every robot
DIAGNOSIS_S: Final = 0.3  # how long a failing `open` looks for other robots, to name them in the error
POLL_S: Final = 0.01
STANDSTILL_S: Final = 3.0  # how long `close` waits for the robots to stand

Clock = Callable[[], float]


class TurtleBot3(Body):
    """TurtleBot3 robots. All topics are polled.

    Args:
        clock: Monotonic [s]; commands from before a suspension of the machine are old by it.
        open_timeout: Limit for the router and the odometry of every robot [s].

    Raises:
        BodyError: If an address or a setting is wrong.
    """

    SETTINGS = turtlebot3.TurtleBot3Settings

    @classmethod
    def faults(cls, robots: Sequence[BodyEntry]) -> Iterator[BodyFault]:
        """See `Body.faults`."""
        for each in robots:
            chosen = settings(turtlebot3.TurtleBot3Settings, each.name, each.device)
            yield from judged(each, ("body",), partial(turtlebot3.address, each.name, each.address, chosen))

    @classmethod
    def device_of(cls, robot: BodyEntry, endpoints: Sequence[str] = ()) -> DeviceAddress:
        """See `Body.device_of`: what a router has by one namespace; DDS behind ros2dds has any domain."""
        chosen = settings(turtlebot3.TurtleBot3Settings, robot.name, robot.device)
        where = turtlebot3.address(robot.name, robot.address, chosen)
        try:
            routers = [Endpoint.parse(each) for each in ((chosen.endpoint,) if chosen.endpoint else endpoints)]
        except ValueError as error:
            raise BodyError(f"{robot.name}: device.endpoint: {error}") from None
        ports = ",".join(sorted({str(each.port) for each in routers}))
        domain = str(where.domain) if where.style == "rmw" else ""
        return DeviceAddress(
            robot.address, tuple(each.host for each in routers), (ports, f"/{where.namespace}", domain)
        )

    def __init__(self, request: BodyRequest, clock: Clock = uptime, open_timeout: float = OPEN_S) -> None:
        self._clock, self._open_timeout = clock, open_timeout
        self.robots = [TurtleBotConnection(request, row) for row in range(len(request.names))]
        self._sessions: dict[tuple[str, ...], zenoh.Session] = {}
        self._outside = request.external
        self._external = [External() for _ in self.robots]
        self._read_at = -inf  # [s] the state on which the next command is decided
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """See `Body.open`: returns after the first odometry of every robot."""
        deadline = self._clock() + self._open_timeout
        try:
            participants: dict[tuple[object, ...], Participant] = {}
            for robot in self.robots:
                where = robot.address
                session = self._session(robot, deadline)
                which = (robot.endpoints, where.style, where.distro, where.domain)
                if which not in participants:
                    participants[which] = Participant(
                        session, ros2.types(where.distro), style=where.style, domain=where.domain
                    )
                robot.join(participants[which])
            while missing := [robot for robot in self.robots if robot.odometry.received == -inf]:
                if self._clock() > deadline:
                    raise BodyError("; ".join(self._missing_odometry(robot) for robot in missing))
                time.sleep(POLL_S)
                for robot in self.robots:
                    robot.receive_messages(-inf, self._clock())
        except BaseException:
            self._close()
            raise
        self._ending.clear()
        self._thread = threading.Thread(target=self._run, name="turtlebot3 zeros", daemon=True)
        self._thread.start()

    def _session(self, robot: TurtleBotConnection, deadline: float) -> zenoh.Session:
        if robot.endpoints not in self._sessions:
            wait = max(0.0, deadline - self._clock())
            try:
                session = network.open_session(
                    robot.endpoints, name=f"{robot.name} ROS 2", wait_s=wait, identity=robot.name
                )
            except ExplainedError as error:
                raise BodyError(f"{robot.name}: {error}; or set device.endpoint to the router of the robot") from None
            self._sessions[robot.endpoints] = session
        return self._sessions[robot.endpoints]

    def _missing_odometry(self, robot: TurtleBotConnection) -> str:
        """Diagnosis and remedy for a robot without odometry."""
        where = robot.address
        session = self._sessions[robot.endpoints]
        topic = ros2.absolute(where.namespace, turtlebot3.ODOMETRY)
        hint = (
            "is the robot on, and zenoh-bridge-ros2dds on it connected to this router?"
            if where.style == "ros2dds"
            else "is the robot on, and its ROS 2 (RMW_IMPLEMENTATION=rmw_zenoh_cpp) connected to this router?"
        )
        others = set()
        tokens = session.liveliness().get(ros2.endpoints(where.style, "MP", "*"), timeout=DIAGNOSIS_S)
        for token in (str(reply.ok.key_expr) for reply in tokens if reply.ok is not None):
            try:
                found = ros2.announced(where.style, token)
            except ValueError:
                continue
            if found.kind == ros2.ODOMETRY and found.topic != topic:
                others.add(found.topic.rpartition("/")[0].removeprefix("/") or "(none)")
            elif found.topic == topic and found.domain != where.domain:
                hint = f"it is published in domain {found.domain}: write rmw://{where.namespace}?domain={found.domain}."
            elif found.topic == topic and where.style == "rmw":
                hint = f"it is published with type hash {found.hash}: set another distro than {where.distro}."
        if others:
            hint += f" Namespaces with odometry there: {', '.join(sorted(others))}"
        return f"{robot.name}: no odometry on '{robot.odometry_inbox.key}': {hint}"

    def read(self, t: float) -> Sequence[BodyState]:
        now = self._read_at = self._clock()
        for robot in self.robots:
            robot.receive_messages(t, now)
            if robot.time == -inf and robot.odometry.received > -inf:
                robot.time = t - (now - robot.odometry.received)  # received during `open`
            robot.send_command(self._clock())
        linked = {endpoints: network.connected(session) for endpoints, session in self._sessions.items()}
        return [
            self._state(row, robot, t, now, linked=linked[robot.endpoints]) for row, robot in enumerate(self.robots)
        ]

    def _state(self, row: int, robot: TurtleBotConnection, t: float, now: float, *, linked: bool) -> BodyState:
        (x, y, yaw), odometry = robot.odometry.pose, robot.time
        state = BodyState(
            odometry,
            (x, y, 0.0) if isfinite(x) else UNKNOWN,
            yaw=yaw,
            battery=robot.battery,
            received=t - now + robot.odometry.received,
            note=robot.note(now, linked),
            scan=robot.scan,
        )
        if self._outside[row]:
            self._external[row].fill(state)
            # a robot with external positions but without odometry is still out of reach
            if t - odometry > SILENCE_S:
                state.time = min(state.time, odometry)
        speed = robot.odometry.speed[0]
        state.velocity = speed * cos(state.yaw), speed * sin(state.yaw), 0.0
        return state

    def command(self, setpoints: Sequence[Setpoint]) -> None:
        """See `Body.command`: v [m/s] and ω [rad/s]."""
        for robot, (v, w, _, _) in zip(self.robots, setpoints, strict=True):
            if isfinite(v) and isfinite(w):
                robot.commanded.drive(v, w, self._read_at)
            robot.send_command(self._clock())

    def takeoff(self, rows: Sequence[int], heights: Sequence[float]) -> None:
        """See `Body.takeoff`: no effect on a ground robot."""

    def land(self, rows: Sequence[int]) -> None:
        now = self._clock()
        call_all(partial(self.robots[row].halt, now) for row in rows if self.robots[row].joined)

    def stop(self, rows: Sequence[int]) -> None:
        self.land(rows)

    def locate(self, row: int, t: float, position: Vector, yaw: float) -> None:
        self._external[row].update(t, position, yaw)

    def inspect(self, row: int) -> Inspection:
        return Inspection(volts=number(self.robots[row].volts))

    def close(self) -> None:
        """Stop all robots, wait until they stand (3 s at most), and leave the network."""
        if not self._sessions:
            return
        until = self._clock() + STANDSTILL_S
        try:
            self.stop(range(len(self.robots)))
            while (now := self._clock()) < until:
                for robot in self.robots:
                    robot.receive_messages(robot.time, now)
                call_all(partial(robot.send_command, now) for robot in self.robots)
                if all(robot.settled for robot in self.robots):
                    break
                time.sleep(POLL_S)
        finally:
            self._close()

    def _run(self) -> None:
        while not self._ending.wait(REPEAT_S):
            self.stop_stale()

    def stop_stale(self) -> None:
        """Send zeros to robots with a stale last command, as `command` does while the loop runs."""
        now = self._clock()
        for robot in self.robots:
            try:
                if robot.commanded.stale(now):
                    robot.send_command(now)
            except Exception:  # noqa: BLE001 - of any kind: the others are stopped; the loop meets it as well
                continue

    def _close(self) -> None:
        self._ending.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        for robot in self.robots:
            robot.joined = False
        for session in self._sessions.values():
            leave(session, self)
        self._sessions.clear()
