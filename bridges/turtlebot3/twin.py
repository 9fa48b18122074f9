"""Protocol twin of the TurtleBot3 Burger: the topics of turtlebot3_node on Zenoh, with the motion model of `twins`.

The Zenoh session is polled, so there are no sockets to wait on. As on the robot, a command holds until the next one:
OpenCR stops the wheels when its ROS node is silent (500 ms without heartbeat), but turtlebot3_node has no time limit
for cmd_vel. `watchdog_s` in the robot's settings adds such a limit.
"""

from __future__ import annotations

from math import cos, inf, isfinite, nan, pi, sin
from typing import Final

import numpy as np
import zenoh

from agents.body.interface import BodyRequest, settings
from agents.network import session as network
from agents.vectors import clamp
from bridges.ros2 import messages as ros2
from bridges.ros2.messages import Message
from bridges.ros2.node import Participant, Publisher
from bridges.turtlebot3 import protocol as turtlebot3
from bridges.turtlebot3.kind import TURTLEBOT3
from bridges.turtlebot3.protocol import TurtleBot3Settings, TurtleBotAddress
from twins.body import instants
from twins.device import Device, DeviceRequest, FaultyLink
from twins.models.differential import Differential
from twins.models.disturbance import MeasurementNoise, OdometryDrift
from twins.models.noise import refill

JOIN_S: Final = 5.0  # deadline of the router's answer


class _TurtleBot:
    """Wheels, odometry and ROS node of one robot."""

    def __init__(
        self, participant: Participant, where: TurtleBotAddress, chosen: TurtleBot3Settings, body: BodyRequest, row: int
    ) -> None:
        kind = turtlebot3.command_type(where.distro, chosen.stamped)
        node = participant.node("turtlebot3_node", where.namespace)
        self.types, self.stamped = participant.types, kind == ros2.TWIST_STAMPED
        self.commands = node.subscriber(chosen.command_topic, kind, depth=10)
        self.odometry = node.publisher(turtlebot3.ODOMETRY, ros2.ODOMETRY)
        self.scan = node.publisher(turtlebot3.SCAN, ros2.LASER_SCAN, ros2.SENSOR_DATA)
        self.battery = node.publisher(turtlebot3.BATTERY, ros2.BATTERY_STATE)
        self.watchdog_s = chosen.watchdog_s or inf
        self._dt = 1.0 / body.rate_hz
        self.model = Differential(body.kinds[row], body.start[row], body.yaw[row])
        self.start = (*body.start[row][:2], body.yaw[row])
        disturbance, name, seed = body.disturbance[row], body.names[row], body.seeds[row]
        self._measurement = MeasurementNoise(disturbance, name, seed, spatial=False)
        self._drift = OdometryDrift(disturbance, name, seed)
        self.twist = (0.0, 0.0)  # v [m/s], ω [rad/s]
        self.commanded = -inf  # time of the last command [s]
        self.executed = 0  # commands
        self._last_yaw = self.model.yaw

    def move(self) -> None:
        """One step."""
        x, y, _ = self.model.position
        self.model.command((*self.twist, 0.0, 0.0))
        self.model.move(self._dt)
        if self._drift.present:
            self._drift.advance(self.model.position[0] - x, self.model.position[1] - y)
            refill(self._drift.noise)

    def measure(self) -> tuple[float, float, float, float, float]:
        """Measured x, y [m] and yaw [rad] from the start; speed [m/s] and mean yaw rate since the last call [rad/s]."""
        model = self.model
        (x, y, _), yaw = model.position, model.yaw
        if self._measurement.present:
            dx, dy, _, turn = self._measurement.draw()
            refill(self._measurement.noise)
            x, y, yaw = x + dx, y + dy, yaw + turn
        x0, y0, yaw0 = self.start
        x, y = x + self._drift.x - x0, y + self._drift.y - y0
        # as in the robot's node: speeds are averages since the last odometry
        turned, self._last_yaw = model.yaw - self._last_yaw, model.yaw
        speed = model.velocity[0] * cos(model.yaw) + model.velocity[1] * sin(model.yaw)
        ahead, left = cos(yaw0) * x + sin(yaw0) * y, cos(yaw0) * y - sin(yaw0) * x
        return ahead, left, yaw - yaw0, speed, turned * turtlebot3.ODOMETRY_HZ


class TurtleBot3Twin(Device):
    """TurtleBot3 robots behind ROS topics; raises BodyError for a wrong setting, or Unreachable."""

    def __init__(self, request: DeviceRequest) -> None:
        body = request.body
        self._dt = 1.0 / body.rate_hz
        self._t = 0.0
        self._ticks = 0
        self._used = 0.0
        random = np.random.default_rng([body.seeds[0], 0x7B3])
        self.link = FaultyLink[tuple[Publisher, bytes]](request.faults, random)
        self._sessions: dict[tuple[str, ...], zenoh.Session] = {}
        self.robots: list[_TurtleBot] = []
        addresses = []
        self._clock = body.clock
        participants: dict[tuple[object, ...], Participant] = {}
        try:
            for row, name in enumerate(body.names):
                chosen = settings(TurtleBot3Settings, name, body.device[row])
                where = turtlebot3.twin(name, chosen)
                endpoints = (chosen.endpoint,) if chosen.endpoint else body.endpoints
                which = (endpoints, where.style, where.distro, where.domain)
                if which not in participants:
                    participants[which] = self._participant(endpoints, where)
                self.robots.append(_TurtleBot(participants[which], where, chosen, body, row))
                addresses.append(str(where))
        except BaseException:
            self.close()
            raise
        self.addresses = tuple(addresses)
        self.models = [robot.model for robot in self.robots]

    def _participant(self, endpoints: tuple[str, ...], where: TurtleBotAddress) -> Participant:
        if endpoints not in self._sessions:
            session = network.open_session(endpoints, name="turtlebot3-twin", wait_s=JOIN_S, identity="twin")
            self._sessions[endpoints] = session
        return Participant(
            self._sessions[endpoints],
            ros2.types(where.distro),
            style=where.style,
            domain=where.domain,
            announces=True,  # set where, with ros2dds, the twin includes the bridge on the robot
        )

    def advance(self, t: float) -> None:
        steps = instants(self._t, t, self._dt)
        self._t = self.link.t = t
        silent = self.link.faults.silent(t)
        self._receive_commands(t)
        for _ in steps:
            for robot in self.robots:
                robot.move()
            self._used += self._dt
            self._ticks += 1
            for rate, publish in (
                (turtlebot3.ODOMETRY_HZ, self._odometry),
                (turtlebot3.SCAN_HZ, self._scan),
                (turtlebot3.BATTERY_HZ, self._battery),
            ):
                if self._ticks % max(1, round(1.0 / (rate * self._dt))) == 0 and not silent:
                    publish()
        for publisher, payload in self.link.due():
            if not silent:
                publisher.send(payload)

    @property
    def commands_received(self) -> list[int]:
        """Executed commands of each robot."""
        return [robot.executed for robot in self.robots]

    def close(self) -> None:
        for session in self._sessions.values():
            session.close()
        self._sessions.clear()

    # ------------------------------------------------------------------ commands

    def _receive_commands(self, t: float) -> None:
        for robot in self.robots:
            for message in robot.commands.received():
                if self.link.lost():
                    continue
                said = message.twist if robot.stamped else message
                v, w = said.linear.x, said.angular.z
                if not (isfinite(v) and isfinite(w) and max(abs(v), abs(w)) < 1e6):
                    continue
                speed, rate = TURTLEBOT3.speed, TURTLEBOT3.turn_rate  # the maker's limits
                robot.twist = clamp(turtlebot3.cut(v), -speed, speed), clamp(turtlebot3.cut(w), -rate, rate)
                robot.commanded = t
                robot.executed += 1
            if t - robot.commanded > robot.watchdog_s:
                robot.twist = (0.0, 0.0)

    # ------------------------------------------------------------------ published topics

    def _publish(self, publisher: Publisher, types: ros2.Types, message: Message) -> None:
        if not self.link.lost():
            self.link.put((publisher, types.encode(message, publisher.kind)))

    def _odometry(self) -> None:
        now = self._clock.utc()
        for robot in self.robots:
            types, make = robot.types, robot.types.make
            ahead, left, turned, speed, rate = robot.measure()
            pose = types.pose(ahead, left, 0.0, turned)
            twist = types.twist((speed, 0.0, 0.0), (0.0, 0.0, rate))
            message = make(
                ros2.ODOMETRY,
                header=types.header(now, "odom"),
                child_frame_id="base_footprint",
                pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
                twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
            )
            self._publish(robot.odometry, types, message)

    def _scan(self) -> None:
        now, step = self._clock.utc(), 2.0 * pi / turtlebot3.RAYS
        for robot in self.robots:
            message = robot.types.make(
                ros2.LASER_SCAN,
                header=robot.types.header(now, "base_scan"),
                angle_min=0.0,
                angle_max=step * (turtlebot3.RAYS - 1),
                angle_increment=step,
                time_increment=1.0 / (turtlebot3.SCAN_HZ * turtlebot3.RAYS),
                scan_time=1.0 / turtlebot3.SCAN_HZ,
                range_min=turtlebot3.NEAREST,
                range_max=turtlebot3.FARTHEST,
                ranges=np.full(turtlebot3.RAYS, inf, np.float32),  # nothing is in reach
                intensities=np.zeros(turtlebot3.RAYS, np.float32),
            )
            self._publish(robot.scan, robot.types, message)

    def _battery(self) -> None:
        spent = self._used * self.link.faults.drain / TURTLEBOT3.endurance_s
        charge = max(0.0, self.link.faults.battery - spent)
        voltage = turtlebot3.EMPTY_V + charge * (turtlebot3.FULL_V - turtlebot3.EMPTY_V)
        now = self._clock.utc()
        for robot in self.robots:
            message = robot.types.make(
                ros2.BATTERY_STATE,
                header=robot.types.header(now, ""),
                voltage=voltage,
                temperature=nan,
                current=nan,
                charge=nan,
                capacity=nan,
                design_capacity=1.8,
                percentage=100.0 * charge,  # the robot's scale; ROS defines 0 to 1
                power_supply_status=0,
                power_supply_health=0,
                power_supply_technology=0,
                present=voltage > turtlebot3.ABSENT_V,
                cell_voltage=np.zeros(0, np.float32),
                cell_temperature=np.zeros(0, np.float32),
                location="",
                serial_number="",
            )
            self._publish(robot.battery, robot.types, message)
