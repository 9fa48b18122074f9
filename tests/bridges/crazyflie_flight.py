"""A Crazyflie bridge driven as a robot's process drives it, against twins that the test can look into."""

import threading
import time
from contextlib import contextmanager

import numpy as np

from agents.vectors import NO_SETPOINT
from bridges.crazyflie.body import CrazyflieBody
from tests.bridges.columns import Columns
from tests.requests import request
from tests.twins.loopback import Served
from twins.devices.crazyflie.device import CrazyflieTwin
from twins.devices.crazyflie.supervisor import SupervisorState

PATIENCE_S = 30.0


class Process:
    """Opens a body, and reads and commands it every 10 ms until it is closed."""

    def __init__(self, body):
        self.body = body
        self.state = None
        self.setpoint = None
        self.located_as = None  # the twin whose place is measured from outside
        body.open()
        self._zero = time.monotonic()
        self._pause = threading.Event()

    @property
    def t(self):
        return time.monotonic() - self._zero

    def tick(self):
        if self.located_as is not None:
            self.body.locate(0, self.t, tuple(truth(self.located_as).tolist()), 0.0)
        self._pause.wait(0.01)
        self.state = Columns(self.body.read(self.t))
        rows = len(self.state.time)
        self.body.command([NO_SETPOINT] * rows if self.setpoint is None else [tuple(each) for each in self.setpoint])
        return self.state

    def until(self, true, what):
        """Goes on until something is true; returns how long that took [s]."""
        begin = self.t
        self.tick()
        while not true():
            assert self.t - begin < PATIENCE_S, (
                f"not in {PATIENCE_S} s: {what}; notes: {self.state and self.state.note}"
            )
            self.tick()
        return self.t - begin

    def run(self, seconds):
        end = self.t + seconds
        while self.t < end:
            self.tick()
        return self.state

    def takeoff(self, height=0.5):
        rows = range(len(self.tick().time))
        self.setpoint = None
        self.body.takeoff(rows, [height] * len(rows))
        self.until(lambda: bool((np.abs(self.state.position[:, 2] - height) < 0.05).all()), "take-off")

    def land(self):
        self.body.land(range(len(self.state.time)))
        self.until(lambda: not self.state.flying.any(), "landing")

    def cut(self):
        """Motors off, wherever they are: the quick end of a test."""
        self.body.stop(range(len(self.state.time)))
        self.until(lambda: not self.state.flying.any(), "motors off")

    def close(self):
        self.body.close()


@contextmanager
def flown(rows=1, *, device=None, external=False, start=None, serve=None, **faults):
    """Twins of Crazyflies, and a process that is connected to them; `serve`: settings of the twins, if others."""
    asked = request("crazyflie", ["crazyflie-twin"] * rows, device=serve or device, external=external, start=start)
    with Served(CrazyflieTwin, asked, **faults) as twin:
        body = request("crazyflie", twin.addresses, device=device, external=external, start=start)
        process = Process(CrazyflieBody(body))
        try:
            yield twin, process
        finally:
            process.close()


def truth(twin, row=0):
    """Where a twin really is [m]."""
    return twin.truth()[0][row]


def supervised(twin, row=0):
    """What its supervisor is at."""
    return SupervisorState(twin.device.flock.supervisor.state[row])
