"""TurtleBot3 twins and their bridge on one fast clock: four seconds of theirs pass in one of ours."""

import threading
import time
from dataclasses import replace
from unittest.mock import MagicMock

import numpy as np

from agents.clock import Clock
from bridges.ros2 import messages as ros2
from bridges.turtlebot3 import protocol as turtlebot3
from bridges.turtlebot3.body import TurtleBot3
from bridges.turtlebot3.kind import TURTLEBOT3
from bridges.turtlebot3.twin import TurtleBot3Twin
from tests import requests
from tests.bridges.driver import Driver, toward
from twins.device import DeviceRequest, Faults

STYLES = ["ros2dds", "rmw"]
FAST = 4.0
DT = 0.01
BEGIN = time.monotonic()
NOWHERE = "tcp/127.0.0.1:9"


def clock():
    return FAST * time.monotonic()


class FastClock(Clock):
    """Stamps of robots whose seconds are as short."""

    def utc(self):
        return super().utc() + (FAST - 1.0) * (time.monotonic() - BEGIN)


def request(endpoint, *addresses, start=((0.0, 0.0),), **more):
    """Robots TB0, TB1, ... by a router."""
    rows = len(start)
    more = {"names": [f"TB{row}" for row in range(rows)], "seeds": [1] * rows, "clock": FastClock()} | more
    return requests.request(
        [TURTLEBOT3] * rows, addresses or "turtlebot3-twin", start=start, endpoints=(endpoint,), **more
    )


class Stage(Driver):
    """Twins that live on a thread, and what a robot process would do with their bridge."""

    def __init__(self, asked, device=None, **faults):
        """`device` are the settings of the bridge, if others than those of the twins."""
        self.twin = TurtleBot3Twin(DeviceRequest(asked, Faults(**faults)))
        reached = replace(asked, addresses=self.twin.addresses)
        if device is not None:
            reached = replace(reached, device=(device,) * len(asked.names))
        super().__init__(TurtleBot3(reached, clock), clock=clock, fast=FAST)
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._live, name="turtlebot3-twin")

    def __enter__(self):
        self._thread.start()
        self.body.open()
        return self

    def __exit__(self, *_):
        self.body.close()
        self._end.set()
        self._thread.join()
        self.twin.close()

    def _live(self):
        due = 0.0
        while not self._end.wait(max(0.0, (self.zero + due - clock()) / FAST)):
            self.twin.advance(clock() - self.zero)
            due += DT

    def run(self, seconds, *setpoint, goals=None):
        """Drive for some seconds: at v [m/s], ω [rad/s], toward goals, or not at all."""
        self.decide = None
        if goals is not None:
            self.decide = toward(TURTLEBOT3, [(*goal, 0.0) for goal in goals])
        elif setpoint:
            v, w = (*setpoint, 0.0)[:2]
            self.decide = lambda states: [(v, w, 0.0, 0.0)] * len(states)
        return super().run(seconds)

    def note(self, seconds, *setpoint):
        """Note of the first robot after some seconds."""
        return self.run(seconds, *setpoint).note[0]

    def moved(self, seconds, *setpoint):
        """How far the first robot really moves in so long [m]."""
        before = self.place[0]
        self.run(seconds, *setpoint)
        return np.linalg.norm(self.place[0] - before)

    @property
    def place(self):
        return self.twin.truth()[0][:, :2].copy()


class FakeRos:
    """Participant of a ROS that is not there: `odometry` waits to be received, `sent` are the speeds [m/s]."""

    session = MagicMock()
    types = ros2.types("humble")

    def __init__(self, robot, error=None):
        self.odometry, self.sent, self._error = [], [], error
        robot.join(self)

    def node(self, *_):
        return self

    def subscriber(self, topic, *_, **__):
        waiting = self.odometry if topic == turtlebot3.ODOMETRY else []
        return MagicMock(received=lambda: [waiting.pop() for _ in list(waiting)], newest=lambda: None)

    def publisher(self, *_):
        return self

    def put(self, message):
        if self._error is not None:
            raise self._error
        self.sent.append(message.linear.x)


def odometry(types, x, y=0.0, yaw=0.0, stamp=1.0):
    """Odometry at a place [m], with the twist of turtlebot3_node until 2024."""
    zeros = np.zeros(36)
    return types.make(
        ros2.ODOMETRY,
        header=types.header(stamp, ""),
        child_frame_id="",
        pose=types.make("geometry_msgs/msg/PoseWithCovariance", pose=types.pose(x, y, 0.0, yaw), covariance=zeros),
        twist=types.make("geometry_msgs/msg/TwistWithCovariance", twist=types.twist(ZERO, ZERO), covariance=zeros),
    )


ZERO = (0.0, 0.0, 0.0)
