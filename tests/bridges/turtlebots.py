"""TurtleBot3 twins and their bridge on one fast clock: four seconds of theirs pass in one of ours."""

import threading
import time
from dataclasses import replace
from math import nan

import numpy as np

from agents.body.interface import BodyRequest, Disturbance
from agents.clock import Clock
from agents.decision.position_control import PositionController
from agents.kinds.turtlebot3 import TURTLEBOT3
from agents.network.keys import Keys
from agents.vectors import NO_SETPOINT
from bridges.turtlebot3.body import TurtleBot3
from tests.bridges.columns import Columns
from twins.devices.device import DeviceRequest, Faults
from twins.devices.turtlebot3 import TurtleBot3Twin

STYLES = ["ros2dds", "rmw"]
FAST = 4.0
DT = 0.01
BEGIN = time.monotonic()


def clock():
    return FAST * time.monotonic()


class FastClock(Clock):
    """Stamps of robots whose seconds are as short."""

    def utc(self):
        return super().utc() + (FAST - 1.0) * (time.monotonic() - BEGIN)


def request(endpoint, *, start=((0.0, 0.0),), yaw=None, device=None, external=False, addresses=None, disturbance=None):
    rows = len(start)
    return BodyRequest(
        names=tuple(f"TB{row}" for row in range(rows)),
        kinds=(TURTLEBOT3,) * rows,
        addresses=addresses or ("turtlebot3-twin",) * rows,
        start=tuple((float(x), float(y), 0.0) for x, y in start),
        yaw=tuple(map(float, (0.0,) * rows if yaw is None else yaw)),
        rate_hz=1.0 / DT,
        seeds=(1,) * rows,
        disturbance=(disturbance or Disturbance(),) * rows,
        external=(external,) * rows,
        device=(device or {},) * rows,
        endpoints=(endpoint,),
        keys=Keys("park"),
        clock=FastClock(),
    )


class Stage:
    """Twins that live on a thread, and what a robot process would do with their bridge."""

    def __init__(self, twins_request, *, faults=None, body_request=None):
        self.twin = TurtleBot3Twin(DeviceRequest(twins_request, faults or Faults()))
        wanted = body_request or twins_request
        self.body = TurtleBot3(replace(wanted, addresses=wanted.addresses if body_request else self.twin.addresses))
        self.body._clock = clock
        self.rows = len(twins_request.names)
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._live, name="turtlebot3-twin")
        self.zero = clock()
        self.t = 0.0
        self.state = None

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self.body.close()
        self.kill()

    def kill(self):
        if not self._end.is_set():
            self._end.set()
            self._thread.join()
            self.twin.close()

    def _live(self):
        due = 0.0
        while not self._end.wait(max(0.0, (self.zero + due - clock()) / FAST)):
            self.twin.advance(clock() - self.zero)
            due += DT

    def run(self, seconds, decide=None):
        """Reads and commands at 100 Hz of the fast clock for so long, or until `decide` returns True."""
        end = self.t + seconds
        pause = threading.Event()
        while self.t < end:
            pause.wait(max(0.0, (self.zero + self.t + DT - clock()) / FAST))
            self.t = clock() - self.zero
            self.state = Columns(self.body.read(self.t))
            setpoints = [NO_SETPOINT] * self.rows
            if decide is not None and (decided := decide(self.state)) is not None:
                setpoints = [(v, w, 0.0, 0.0) for v, w in decided]
            self.body.command(setpoints)
        return self.state

    def toward(self, goal):
        """The position controller of the robot process."""
        law = PositionController(TURTLEBOT3)

        def decide(state):
            for (x, y), position, yaw in zip(goal, state.position.tolist(), state.yaw.tolist(), strict=True):
                yield law.setpoint((x, y, 0.0), nan, tuple(position), yaw)[:2]

        return decide

    def constant(self, v, w=0.0):
        return lambda _: [(v, w)] * self.rows

    @property
    def place(self):
        return self.twin.truth()[0][:, :2].copy()

    def moved(self, seconds, decide=None):
        """How far the robots really move in so long [m]."""
        before = self.place
        self.run(seconds, decide)
        return np.linalg.norm(self.place - before, axis=1)
