"""One Crazyflie twin without sockets: packets go in, answers are kept, time is told."""

import pickle
import struct

import numpy as np

from agents.protocols.crtp import HighLevel, Port, Setpoint, SupervisorCommand
from tests.twins.loopback import request
from twins.devices.crazyflie.drone import Drone
from twins.devices.crazyflie.flock import Flock
from twins.devices.crazyflie.supervisor import SupervisorState
from twins.devices.device import Faults

DT = 0.01
SETTLED_S = 18.0  # a take-off overshoots, and is within 1 cm of 1 m after 13 s
HOVERING: dict[bytes, bytes] = {}  # twins in the air, by what they were before their take-off


class Wire:
    """A twin in virtual time."""

    def __init__(self, device=None, start=None, yaw=0.0, external=False, **faults):
        asked = request("crazyflie", ["x"], device=device, start=start, yaw=yaw, external=external)
        self.flock = Flock(asked, Faults(**faults))
        self.flock.estimator.turn[:] = 0.0  # it was told how it stands
        self.sent = []
        self._make_drone()
        self.ticks = 0

    def _make_drone(self):
        self.drone = Drone(self.flock, 0, lambda port, channel, data: self.sent.append((port, channel, data)))

    @property
    def t(self):
        return self.ticks * DT

    @property
    def position(self):
        return self.flock.quadrotor.position[0]

    @property
    def state(self):
        return SupervisorState(self.flock.supervisor.state[0])

    @property
    def motors(self):
        return bool(self.flock.quadrotor.flying[0])

    def put(self, port, channel, *data):
        """Sends a packet; returns the answers."""
        self.sent.clear()
        self.drone.receive(port, channel, b"".join(bytes((d,)) if isinstance(d, int) else d for d in data))
        return list(self.sent)

    def wait(self, seconds, each=None):
        """Lets time pass; `each` is done before every tick, and the log packets of the ticks are returned."""
        packets = []
        for _ in range(round(seconds / DT)):
            if each is not None:
                each()
            self.ticks += 1
            self.flock.advance(self.t)
            self.sent.clear()
            for packet in self.drone.logs.due(self.t):
                self.drone.send(Port.LOG, 2, packet)
            packets += self.sent
        return packets

    def plan(self, command, payload=b"", group=0):
        """A high-level command; returns the status."""
        ((port, channel, answer),) = self.put(Port.HIGH_LEVEL, 0, int(command), group, payload)
        assert (port, channel, answer[0], len(answer)) == (Port.HIGH_LEVEL, 0, command, 4)
        return answer[3]

    def takeoff(self, height, span):
        return self.plan(HighLevel.TAKEOFF, struct.pack("<ff?f", height, 0.0, True, span))

    def land(self, span):
        return self.plan(HighLevel.LAND, struct.pack("<ff?f", 0.0, 0.0, True, span))

    def go_to(self, x, y, z, yaw, span, *, relative=False, linear=False):
        return self.plan(HighLevel.GO_TO, struct.pack("<??fffff", relative, linear, x, y, z, yaw, span))

    def goal(self, x, y, z, yaw=0.0):
        """A streamed position, yaw in degrees."""
        self.put(Port.SETPOINT, 0, int(Setpoint.POSITION), struct.pack("<ffff", x, y, z, yaw))

    def zero(self):
        """What cflib sends when it closes a link."""
        self.put(Port.COMMANDER, 0, struct.pack("<fffH", 0.0, 0.0, 0.0, 0))

    def release(self):
        """The client says that it streams no more."""
        self.put(Port.SETPOINT, 1, 0, struct.pack("<I", 0))

    def arm(self, on=True):
        ((_, _, answer),) = self.put(Port.SUPERVISOR, 1, int(SupervisorCommand.ARM), int(on))
        return answer

    def hovering(self, height=1.0):
        """In the air, at rest, held by the planner; what begins alike takes off once."""
        begin, values = pickle.dumps((self.flock, self.ticks, height)), self.drone.values
        if begin in HOVERING:
            self.flock, self.ticks = pickle.loads(HOVERING[begin])  # noqa: S301 (made here)
            self._make_drone()
            assert self.drone.values == values  # no parameter was set
            return self
        assert self.takeoff(height, 2.0) == 0
        self.wait(SETTLED_S)
        assert abs(self.position[2] - height) < 0.01
        HOVERING[begin] = pickle.dumps((self.flock, self.ticks))
        return self

    def streaming(self, height=1.0):
        """In the air, at rest, held by streamed positions."""
        self.hovering(height)
        self.wait(0.5, lambda: self.goal(*np.array([0.0, 0.0, height])))
        return self
