"""A Tello's pilot with a drone made of lists and a clock made of numbers."""

from agents.kinds.tello import TELLO
from agents.protocols import tello as protocol
from bridges.tello.pilot import Duty, TelloPilot


class Paper:
    """A drone that notes what it is told, and says what the test lets it say."""

    def __init__(self):
        self.said, self.sticks, self.state, self.responses, self.broken = [], [], {}, [], False

    def send_command_without_return(self, command):
        if self.broken:
            raise OSError(101, "Network is unreachable")
        word, *numbers = command.split()
        if word == "rc":
            self.sticks.append(tuple(map(int, numbers)))
        else:
            self.said.append(command)

    def get_current_state(self):
        return self.state

    def get_own_udp_object(self):
        return {"responses": self.responses}

    def end(self):
        self.said.append("(end)")


class Cockpit:
    """A pilot, its paper drone, and a clock."""

    def __init__(self, **chosen):
        self.drone, self.now = Paper(), 100.0
        self.pilot = TelloPilot(self.drone, TELLO, protocol.TelloSettings(**chosen), lambda: self.now)
        self.report = {"bat": 80, "yaw": 20, "h": 0, "time": 0}
        self.speaks = self.attended = True

    def pass_(self, seconds, **report):
        self.report.update(report)
        for _ in range(round(seconds / 0.05)):
            self.now = round(self.now + 0.05, 6)
            if self.speaks and round(self.now * 20) % 2 == 0:
                self.drone.state = dict(self.report)
            self.pilot.step(self.now, self.now if self.attended else 100.0)
        return self

    def take_off(self, height, *, at=(0.0, 0.0, 0.0), rested_s=0.2):
        """Order a take-off to `height` [m] at a position, after a rest on the ground."""
        self.pass_(rested_s)
        self.pilot.position = at
        self.pilot.take_off(height, self.now)

    def aim(self, setpoint):
        """Give the pilot in flight a setpoint."""
        self.pilot.duty, self.pilot.setpoint, self.pilot.setpoint_time = Duty.FLY, setpoint, self.now

    def fly(self):
        """In the air, at its place, its motors' clock running."""
        self.take_off(0.6, at=(1.0, 2.0, 0.0))
        self.pass_(3.0, h=80, time=3)
        self.drone.responses.append(b"ok")
        self.pass_(0.05)
        assert self.pilot.duty is Duty.HOLD
        return self
