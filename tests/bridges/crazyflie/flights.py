"""A Crazyflie bridge driven as a robot's process drives it, against twins that the test can look into."""

from contextlib import contextmanager

import numpy as np

from bridges.crazyflie import flight, telemetry, trajectory
from bridges.crazyflie.body import MEASURING_S, CrazyflieBody
from bridges.crazyflie.twin.device import CrazyflieTwin
from tests.bridges.driver import Driver
from tests.requests import request
from tests.twins.loopback import Served


def clocked(monkeypatch, clock):
    """Let flight control, telemetry and trajectories take their time from a clock."""
    for module in (flight, telemetry, trajectory):
        monkeypatch.setattr(module, "uptime", clock.monotonic)


class Process(Driver):
    """Opens a body, and drives it until it is closed at the end of a `with` statement, or before."""

    def __init__(self, body):
        body.open()
        super().__init__(body)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        self.body.close()

    @property
    def rows(self):
        return range(len((self.state or self.tick()).time))

    def lead(self, *setpoints):
        """Give these setpoints (x, y, z, yaw) from now on."""
        self.decide = lambda _: setpoints
        return self

    def takeoff(self, height=0.5):
        self.decide = None
        self.body.takeoff(self.rows, [height] * len(self.rows))
        self.until(lambda: bool((np.abs(self.state.position[:, 2] - height) < 0.05).all()), "take-off")

    def land(self):
        self.body.land(self.rows)
        self.until(lambda: not self.state.flying.any(), "landing")

    def cut(self):
        """Motors off, wherever they are: the quick end of a test."""
        self.body.stop(self.rows)
        self.until(lambda: not self.state.flying.any(), "motors off")

    def noted(self, *texts, row=0):
        """Go on until the note of a robot contains these texts."""
        self.until(lambda: all(text in self.state.note[row] for text in texts), f"note {texts}")


def connected(addresses, *, measuring_s=MEASURING_S, **options):
    """A process that is connected to Crazyflies."""
    return Process(CrazyflieBody(request("crazyflie", addresses, **options), measuring_s))


@contextmanager
def connected_twins(rows=1, *, device=None, external=False, start=None, serve=None, measuring_s=MEASURING_S, **faults):
    """Twins of Crazyflies, and a process that is connected to them; `serve`: settings of the twins, if others."""
    options = {"device": device, "external": external, "start": start}
    asked = request("crazyflie", ["crazyflie-twin"] * rows, **options | ({"device": serve} if serve else {}))
    with (
        Served(CrazyflieTwin, asked, **faults) as twin,
        connected(twin.addresses, measuring_s=measuring_s, **options) as process,
    ):
        yield twin, process


def truth(twin, row=0):
    """Where a twin really is [m]."""
    return twin.truth()[0][row]


def supervised(twin, row=0):
    """State of the supervisor."""
    return twin.device.drones[row].vehicle.supervisor.state


def motors(twin, row=0):
    """Whether its motors run."""
    return twin.device.drones[row].vehicle.model.flying
