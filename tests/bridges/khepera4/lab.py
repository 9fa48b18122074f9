"""Drivers of the Khepera bridge against the twins of the servers, on one simulated clock and without sockets."""

import math

from agents.decision.position_control import PositionController
from agents.kinds.khepera4 import KHEPERA4
from agents.protocols import khepera4 as protocol
from bridges.khepera4 import drivers
from bridges.khepera4.odometry import Odometer
from tests.requests import request
from twins.devices.device import DeviceRequest, Faults
from twins.devices.khepera4 import KheperaDevice

DT = 0.01


class Lab:
    """One robot, its twin, the wire between the driver and it, and the clock of the driver."""

    def __init__(self, server, monkeypatch, *, named=True, **settings):
        asked = request("khepera4", ["khepera4-twin"], device={"server": server})
        self.device = KheperaDevice(DeviceRequest(asked, Faults()))
        self.program = self.device.servers[0].program
        self.now, self.due, self.gap_until = 0.0, DT, -math.inf
        self.queue, self.answers, self.heard = b"", b"", []
        monkeypatch.setattr(drivers, "time", self)
        monkeypatch.setattr(drivers, "uptime", self.monotonic)
        self.program.begin_session()
        self.device.servers[0].client = self  # a client is there
        chosen = protocol.Khepera4Settings(server=server if named else None, **settings)
        self.odometer = Odometer(0.0, 0.0, 0.0)
        try:
            self.driver = drivers.identify(self, chosen, chosen.server)
        except OSError:
            self.close()
            raise
        self.driver.begin()
        self.driver.move(self.odometer)

    # the clock

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        until = self.now + seconds
        while self.due < until:  # the twin moves in whole steps
            self.now = self.due
            self.due += DT
            self.device.advance(self.now)
            self._deliver()
        self.now = until
        self._deliver()

    # the wire

    def send(self, data):
        self.queue += data
        self._deliver()

    def pending(self):
        answers, self.answers = self.answers, b""
        return answers

    def receive(self, until):
        while not self.answers:
            if self.now >= until:
                raise TimeoutError
            self.sleep(0.001)
        return self.pending()

    def _deliver(self):
        if self.queue and self.now >= self.gap_until:
            read, self.queue = self.queue[:255], self.queue[255:]
            self.heard.append(read)
            self.answers += self.program.answer(read, self.now)

    # what drives

    @property
    def truth(self):
        position, yaw = self.device.truth()
        return *position[0, :2].tolist(), float(yaw[0])

    def exchange(self, v, turn=0.0, periods=1):
        """Periods of the link, of 40 ms each."""
        for _ in range(periods):
            due = self.now + 0.04
            self.driver.drive(v, turn)
            self.driver.move(self.odometer)
            self.sleep(max(0.0, due - self.now))

    def go_to(self, goal, seconds):
        law, until, at = PositionController(KHEPERA4), self.now + seconds, self.odometer
        while self.now < until:
            v, turn, _, _ = law.setpoint((*goal, 0.0), math.nan, (at.x, at.y, 0.0), at.yaw)
            self.exchange(v, turn)

    def stands(self):
        before = self.truth
        self.exchange(0.0, periods=25)
        return self.truth == before

    def close(self):
        self.device.servers[0].client = None
        self.device.close()
