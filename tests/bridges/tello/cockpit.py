"""A Tello's pilot with a drone made of lists and a clock made of numbers."""

from agents.kinds.tello import TELLO
from agents.protocols import tello as protocol
from bridges.tello.pilot import Duty, TelloPilot


class Cockpit:
    """A pilot, its clock, and its drone, which notes commands and reports what the test lets it report."""

    def __init__(self, **chosen):
        self.said, self.sticks, self.state, self.responses = [], [], {}, []
        self.now, self.stall_s = 100.0, 0.0  # a stall is a standstill of the process in the middle of a step
        self.pilot = TelloPilot(self, TELLO, protocol.TelloSettings(**chosen), lambda: self.now + self.stall_s)
        self.report = {"bat": 80, "yaw": 20, "h": 0, "time": 0}
        self.speaks = self.attended = True
        self.broken = False

    # the drone, as the library offers it

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

    # the pilot

    @property
    def duty(self):
        return self.pilot.duty

    @property
    def flying(self):
        return self.pilot.flying

    @property
    def note(self):
        return self.pilot.note(self.now)

    def pass_(self, seconds, **report):
        """Step for some seconds, with a changed report from now on."""
        self.report.update(report)
        for _ in range(round(seconds / 0.05)):
            self.now = round(self.now + 0.05, 6)
            if self.speaks and round(self.now * 20) % 2 == 0:
                self.state = dict(self.report)
            self.pilot.step(self.now, self.now if self.attended else 100.0)
        return self

    def answer(self, *texts, **report):
        """Hand answers of the drone to its pilot."""
        self.responses += texts
        return self.pass_(0.1, **report)

    def forget(self):
        """Forget what was commanded so far."""
        self.said.clear()
        self.sticks.clear()
        return self

    def take_off(self, height, *, at=(0.0, 0.0, 0.0), rested_s=0.2):
        """Order a take-off to `height` [m] at a position, after a rest on the ground."""
        self.pass_(rested_s).forget()
        self.pilot.position = at
        self.pilot.take_off(height, self.now)
        return self

    def land(self):
        self.pilot.land(self.now)

    def cut(self):
        self.pilot.cut(self.now)

    def aim(self, *setpoint):
        """Give the pilot in flight a setpoint."""
        self.pilot.duty, self.pilot.setpoint, self.pilot.setpoint_time = Duty.FLY, setpoint, self.now

    def fly(self):
        """In the air, at its place, its motors' clock running."""
        self.take_off(0.6, at=(1.0, 2.0, 0.0)).pass_(3.0, h=80, time=3).answer(b"ok")
        assert self.duty is Duty.HOLD
        return self.forget()
