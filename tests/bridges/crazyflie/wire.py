"""One Crazyflie twin without sockets: packets go in, answers are kept, time is told."""

import pickle
import struct

import numpy as np

from bridges.crazyflie.protocol.crtp import HighLevel, Port, Setpoint, SupervisorCommand
from bridges.crazyflie.twin.drone import Drone
from bridges.crazyflie.twin.vehicle import Vehicle
from tests.requests import request
from twins.device import Faults

DT = 0.01
SETTLED_S = 18.0  # a take-off overshoots, and is within 1 cm of 1 m after 13 s
HOVERING: dict[bytes, bytes] = {}  # twins in the air, by what they were before their take-off


class Wire:
    def __init__(self, device=None, start=None, yaw=0.0, external=False, **faults):
        asked = request("crazyflie", ["x"], device=device, start=start, yaw=yaw, external=external)
        self.vehicle = Vehicle(asked, Faults(**faults), 0)
        self.vehicle.estimator.turn = 0.0  # it was told how it stands
        self.sent = []
        self._make_drone()
        self.ticks = 0

    def _make_drone(self):
        self.drone = Drone(self.vehicle, lambda port, channel, data: self.sent.append((port, channel, data)))

    @property
    def t(self):
        return self.ticks * DT

    @property
    def position(self):
        return np.array(self.vehicle.model.held)

    @property
    def velocity(self):
        return np.array(self.vehicle.model.velocity)

    @property
    def yaw(self):
        return self.vehicle.model.yaw

    @property
    def estimate(self):
        return np.array(self.vehicle.estimate)

    @property
    def planned(self):
        goal = self.vehicle.planner.goal(self.t)
        return np.full(4, np.nan) if goal is None else np.array(goal)

    @property
    def info(self):
        return self.vehicle.info

    @property
    def state(self):
        return self.vehicle.supervisor.state

    @property
    def motors(self):
        return self.vehicle.model.flying

    def put(self, port, channel, *data):
        self.sent.clear()
        self.drone.receive(port, channel, b"".join(bytes((d,)) if isinstance(d, int) else d for d in data))
        return list(self.sent)

    def ask(self, port, channel, *data):
        """Sends a packet; returns what its one answer carries."""
        ((answered, on, answer),) = self.put(port, channel, *data)
        assert (answered, on) == (port, channel)
        return answer

    def wait(self, seconds, each=None):
        """Lets time pass; `each` is done before every tick, and the log packets of the ticks are returned."""
        packets = []
        for _ in range(round(seconds / DT)):
            if each is not None:
                each()
            self.ticks += 1
            self.vehicle.advance(self.t)
            self.sent.clear()
            for packet in self.drone.logs.due(self.t):
                self.drone.send(Port.LOG, 2, packet)
            packets += self.sent
        return packets

    def after(self, seconds, each=None):
        self.wait(seconds, each)
        return self

    def key(self, name):
        return struct.pack("<H", self.drone.parameters.number[name])

    def set(self, name, packing, value):
        return self.put(Port.PARAM, 2, self.key(name), struct.pack(f"<{packing}", value))

    def log(self, command, *data):
        """A command to the log blocks; returns the status."""
        return self.ask(Port.LOG, 1, command, *data)[2]

    def plan(self, command, packing="", *values, group=0):
        """A high-level command; returns the status."""
        answer = self.ask(Port.HIGH_LEVEL, 0, command, group, struct.pack(f"<{packing}", *values))
        assert (answer[0], len(answer)) == (command, 4)
        return answer[3]

    def takeoff(self, height, span, group=0):
        return self.plan(HighLevel.TAKEOFF, "ff?f", height, 0.0, True, span, group=group)

    def land(self, span):
        return self.plan(HighLevel.LAND, "ff?f", 0.0, 0.0, True, span)

    def go_to(self, x, y, z, yaw, span):
        return self.plan(HighLevel.GO_TO, "??fffff", False, False, x, y, z, yaw, span)

    def setpoint(self, kind, *values):
        self.put(Port.SETPOINT, 0, kind, struct.pack("<4f", *values))

    def goal(self, x, y, z, yaw=0.0):
        """A streamed position, yaw in degrees."""
        self.setpoint(Setpoint.POSITION, x, y, z, yaw)

    def thrust(self, thrust):
        self.put(Port.COMMANDER, 0, struct.pack("<fffH", 0.0, 0.0, 0.0, thrust))

    def zero(self):  # as cflib does when it closes a link
        self.thrust(0)

    def release(self):
        self.put(Port.SETPOINT, 1, 0, struct.pack("<I", 0))

    def arm(self, on=True):
        return self.ask(Port.SUPERVISOR, 1, SupervisorCommand.ARM, int(on))

    def locate(self, position=None):
        """A measured position, by default the true one."""
        self.put(Port.LOCATION, 0, struct.pack("<fff", *(self.position if position is None else position)))

    def hovering(self, height=1.0):
        """In the air, at rest, held by the planner; what begins alike takes off once."""
        begin, values = pickle.dumps((self.vehicle, self.ticks, height)), self.drone.values
        if begin in HOVERING:
            self.vehicle, self.ticks = pickle.loads(HOVERING[begin])  # noqa: S301 (made here)
            self._make_drone()
            assert self.drone.values == values  # no parameter was set
            return self
        assert self.takeoff(height, 2.0) == 0
        self.wait(SETTLED_S)
        assert abs(self.position[2] - height) < 0.01
        HOVERING[begin] = pickle.dumps((self.vehicle, self.ticks))
        return self

    def streaming(self, height=1.0):
        """In the air, at rest, held by streamed positions."""
        return self.hovering(height).after(0.5, lambda: self.goal(0.0, 0.0, height))


def brushless(**parts):
    """A twin that must be armed, and is, with motors that have spun up."""
    wire = Wire({"platform": "brushless"}, **parts)
    wire.arm()
    return wire.after(0.6)
