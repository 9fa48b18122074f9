"""Protocol twin of Khepera IV robots, over TCP; each robot has its own port.

A robot runs one of the servers that Robotic Park has published, each with what it really does (which commands move the
robot, what `p` answers, whether it serves a second client), or K-Team's. None has a time limit for commands.
"""

from __future__ import annotations

import math
import socket
from collections.abc import Callable, Sequence
from typing import Final

from agents.body.interface import BodyError, BodyRequest, settings
from bridges.khepera4 import protocol
from bridges.khepera4.kind import KHEPERA4
from twins.body import instants
from twins.device import Device, DeviceRequest, Faults, FaultyLink
from twins.models.differential import Differential
from twins.models.disturbance import Latency, OdometryDrift
from twins.models.noise import refill

GARBAGE: Final = (3.0, -2.0)  # [m] goal of servers without a goal from a client: the content of the memory
RECEIVE_S: Final = 0.05  # [s] pause after which the fork's loop turns without a command
SELECT_S: Final = 1.0  # [s] the same of 2023-04-10
MAIN_S: Final = 0.02  # [s] the same of 2025-05, whether or not there are commands


class _WheeledRobot:
    """A robot below its server: wheels, encoders and battery."""

    def __init__(self, body: BodyRequest, row: int, faults: Faults) -> None:
        self._dt, self._faults = 1.0 / body.rate_hz, faults
        self.model = Differential(body.kinds[row], body.start[row], body.yaw[row])
        disturbance, name, seed = body.disturbance[row], body.names[row], body.seeds[row]
        self._latency, self._drift = Latency(disturbance, self._dt), OdometryDrift(disturbance, name, seed)
        self.charge = faults.battery
        self.pulses = (0.0, 0.0)  # counts of the left and the right encoder, since power-on
        self.speed = (0.0, 0.0)  # units
        self.twist = (0.0, 0.0)  # commanded v [m/s], ω [rad/s]
        self.sounding = 31  # mask of the ultrasonic sensors

    def drive(self, left: int, right: int) -> None:
        """Set the wheel speeds in units, within the motors' limits."""
        limit = protocol.FASTEST
        self.twist = protocol.twist(max(-limit, min(limit, left)), max(-limit, min(limit, right)))

    def halt(self) -> None:
        """Stop both wheels."""
        self.twist = (0.0, 0.0)

    def move(self) -> None:
        """One step."""
        self.charge = max(0.0, self.charge - self._faults.drain * self._dt / KHEPERA4.endurance_s)
        if self.charge <= 0.0:
            self.halt()
        model, drift = self.model, self._drift
        (x, y, _), yaw = model.position, model.yaw
        model.command(self._latency.delay((*self.twist, 0.0, 0.0)))
        model.move(self._dt)
        x, y = model.position[0] - x, model.position[1] - y
        turn = model.yaw - yaw
        if drift.present:  # drift of the encoders: wheels that slip
            error_x, error_y = drift.x, drift.y
            drift.advance(x, y)
            refill(drift.noise)
            x, y = x + drift.x - error_x, y + drift.y - error_y
        middle = yaw + 0.5 * turn
        self._add_motion(math.cos(middle) * x + math.sin(middle) * y, turn)

    def _add_motion(self, ahead: float, turn: float) -> None:
        """Add one step of the wheels: way along the nose [m] and turn [rad]."""
        half = 0.5 * protocol.BASE * turn
        left, right = ahead - half, ahead + half
        self.pulses = self.pulses[0] + left / protocol.PULSE, self.pulses[1] + right / protocol.PULSE
        self.speed = left / self._dt / protocol.UNIT, right / self._dt / protocol.UNIT


class ParkProgram:
    """The program of one published park server: its loop, its controller on board, and its answers.

    The loop reads the encoders, lets the controller drive if a goal was set, and waits for one command.
    """

    def __init__(self, robot: _WheeledRobot, name: str) -> None:
        self.robot, self.name = robot, name
        self.kind = protocol.PARK[name]
        self._last = robot.pulses
        self._place = [0.0, 0.0]  # [m]
        self._theta = self._way = self._sum = 0.0  # [rad]; [m] in the last turn; sum of the bearing errors [rad]
        self._goal, self._active = GARBAGE, False
        self._due = 0.0  # [s] time of the next turn without a command

    def begin_session(self) -> None:
        """A client was accepted."""
        if self.name == "fork":
            self._active = False
        self._last = self.robot.pulses

    def end_session(self) -> None:
        """The client has gone."""
        if self.kind.clients is None:
            self.robot.halt()

    def advance(self, t: float, *, connected: bool, left: bool) -> None:
        """Let the loop turn until `t` [s] without a command; after its client has `left` it no longer waits for any."""
        period = {"2023-04-10": SELECT_S, "fork": RECEIVE_S, "2025-05": MAIN_S}.get(self.name, math.inf)
        if left and self.kind.clients is not None:
            self._turn()
        elif (connected or self.name == "2025-05") and t >= self._due:
            self._turn()
            self._due = t + period

    def answer(self, received: bytes, t: float) -> bytes:
        """The answer to what one `read()` brought, if it has one."""
        text = received.rstrip(b"\0").decode("ascii", "replace")
        answer = self._obey(text, text[:1], protocol.scanned(text[1:]))
        if self.name != "2025-05":  # its loop is a thread of its own
            self._turn()
            self._due = t + (SELECT_S if self.name == "2023-04-10" else RECEIVE_S)
        return answer.encode()

    def _obey(self, text: str, letter: str, values: list[float]) -> str:
        newest = self.name == "2025-05"  # the only one that compares whole words
        if letter == "d" and len(values) >= 2:
            if self.kind.drives and not (self.name == "fork" and self._active):
                self._drive(values[0], values[1])
            self._active = self._active and not newest
        elif letter == "g" and self.name != "2023-01-07":
            if len(values) >= 2:
                self._goal = (values[0], values[1])
            self._active = self._active or len(values) >= 2 or not newest
            return self._sounds() if text == "get_data" and self.kind.per_turn else ""
        elif letter == "i" and len(values) >= 2 and self.name != "2023-01-07":
            self._place = values[:2]
            if self.name == "2023-04-10" and len(values) >= 3:
                self._theta = values[2]
            self._active = self._active and not newest
        elif text == "stop":
            self.robot.halt()
        elif text == "get_data":
            return self._sounds() if self.name == "2023-01-07" else ""
        elif text == "p" or (letter == "p" and not newest):
            return self._odometry()
        elif letter == "t" and self.name == "2023-04-10":
            return f"{self._way:.4f},{self._theta:.4f}"
        return ""

    def _sounds(self) -> str:
        return ",".join([str(protocol.SOUND_NOTHING)] * len(protocol.SOUND_BEARING))

    def _odometry(self) -> str:
        if self.kind.answer == "increments":
            way, turn = self._encoders()
            return f"{way:.4f},{turn:.4f}"
        if self.kind.answer == "heading":
            return f"{self._way:.4f},{self._theta:.4f}"
        decimals = self.kind.decimals
        return ",".join(f"{value:.{decimals}f}" for value in (*self._place, self._theta))

    def _encoders(self) -> tuple[float, float]:
        """Way [m] and turn [rad] since the encoders were read last; whole pulses."""
        left, right = (math.trunc(now - last) for now, last in zip(self.robot.pulses, self._last, strict=True))
        self._last = self.robot.pulses
        return 0.5 * protocol.PULSE * (left + right), protocol.PULSE * (right - left) / self.kind.base

    def _turn(self) -> None:
        if self.kind.answer == "increments":  # it has no controller, and reads the encoders for `p` alone
            return
        self._way, turn = self._encoders()
        self._place = [
            self._place[0] + self._way * math.cos(self._theta),
            self._place[1] + self._way * math.sin(self._theta),
        ]
        self._theta += turn
        if self._active:
            self._drive(*self._controller())

    def _controller(self) -> tuple[float, float]:
        """v [cm/s] and ω [rad/s] toward the goal, by the law of this program."""
        dx, dy = self._goal[0] - self._place[0], self._goal[1] - self._place[1]
        error = math.atan2(dy, dx) - self._theta
        if self.name == "2023-04-10":
            off = abs(dx) + 100.0 * dy * dy
            if off <= 0.01:
                return 0.0, 0.0
            error = math.remainder(error, 2.0 * math.pi)
            v = min(off * (3.14 - int(abs(error))) / 3.14, 10.0)
            self._sum += error
            return v, 1.5 * math.sin(error) + 0.008 * self._sum * 0.003
        ahead = dx * math.cos(self._theta) + dy * math.sin(self._theta)
        if self.name == "2025-05" and abs(ahead) <= 0.01:
            return 0.0, 0.0
        v = 10.0 * ahead
        return (0.0 if abs(v) < 0.02 and self.name != "2025-05" else v), math.sin(error)

    def _drive(self, v: float, turn: float) -> None:
        """Drive at v [cm/s] and ω [rad/s], cut to whole units."""
        half, unit = 0.5 * 100.0 * protocol.BASE * turn, 100.0 * protocol.UNIT
        self.robot.drive(int((v - half) / unit), int((v + half) / unit))


def answer_kteam(robot: _WheeledRobot, line: str) -> str:
    """Answer of K-Team's `kh4server` to a line; `$` for an unknown command."""
    letter = line[:1]
    try:
        values = [int(word) for word in line[2:].split(",") if word]
    except ValueError:
        return "$"
    sounds = (protocol.SOUND_NOTHING if robot.sounding >> bit & 1 else 2000 for bit in range(5))
    measured = (7000 + 1400 * robot.charge, -420, -410, 3400 * robot.charge, 29, 100 * robot.charge, 0)
    answers: dict[str, Callable[[], tuple[object, ...]]] = {
        "B": lambda: ("C", 4),
        "E": lambda: tuple(round(speed) for speed in robot.speed),
        "R": lambda: tuple(round(pulses) for pulses in robot.pulses),
        "G": lambda: tuple(sounds),
        "N": lambda: (40,) * 12,
        "O": lambda: (900,) * 12,
        "S": lambda: (0,) * 30,
        "T": lambda: (0,) * 30,
    }
    if letter == "D" and len(values) == 2:
        robot.drive(*values)
    elif letter == "U" and len(values) == 1:
        robot.sounding = values[0]
    elif letter == "I":
        robot.pulses = (0.0, 0.0)
    elif letter == "V" and values and values[0] in range(len(measured)):
        return f"v,{round(measured[values[0]])}"
    elif letter in answers:
        return ",".join([letter.lower(), *map(str, answers[letter]())])
    elif letter not in ("M", "K", "H", "J"):
        return "$"
    return letter.lower()


class _Server:
    """Port of one robot: serves one client; others wait until that client has left, or for ever."""

    def __init__(self, robot: _WheeledRobot, name: str, faults: Faults, listener: socket.socket) -> None:
        self.robot, self.listener = robot, listener
        self.program = ParkProgram(robot, name) if name in protocol.PARK else None
        self._answers = FaultyLink[bytes](faults)
        self.client: socket.socket | None = None
        self._left = False  # whether a client has left
        self._partial = b""

    def sockets(self, *, silent: bool) -> list[socket.socket]:
        """Sockets to wait on; what is sent to a silent robot waits in its connection, as in a gap of the radio."""
        if silent or (self._left and self.program is not None and self.program.kind.clients == 1):
            return []
        return [self.listener if self.client is None else self.client]

    def serve(self, ready: socket.socket, t: float) -> None:
        """Accept a client, answer a command, or close the connection."""
        self._answers.t = t
        try:
            if ready is self.listener:
                self.client, _ = self.listener.accept()
                self.client.setblocking(False)
                self.client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                if self.program is not None:
                    self.program.begin_session()
                return
            received = ready.recv(255)
        except BlockingIOError:
            return
        except OSError:
            received = b""
        if not received:
            self.hang_up()
        else:
            self._answers.put(self._answer(received, t))
            self.flush()

    def advance(self, t: float) -> None:
        """Let the program on the robot go on until `t` [s]."""
        self._answers.t = t
        if self.program is not None:
            self.program.advance(t, connected=self.client is not None, left=self._left)

    def flush(self) -> None:
        """Send due answers."""
        for answer in self._answers.due():
            if self.client is not None and answer:
                try:
                    self.client.send(answer)
                except OSError:
                    self.hang_up()

    def hang_up(self) -> None:
        """Close the client's connection: the robot stops if its server does that, else it drives on."""
        if self.client is not None:
            self.client.close()
            self._left = True
            if self.program is not None:
                self.program.end_session()
        self.client, self._partial = None, b""
        self._answers = FaultyLink(self._answers.faults)

    def _answer(self, received: bytes, t: float) -> bytes:
        if self.program is not None:
            return self.program.answer(received, t)
        *lines, self._partial = (self._partial + received).replace(b"\n", b"\r").split(b"\r")
        answers = [answer_kteam(self.robot, line.decode("ascii", "replace")) for line in lines if line]
        return "".join(f"{answer}\r\n" for answer in answers).encode()


class KheperaDevice(Device):
    """Khepera IV robots. Their range sensors measure nothing."""

    def __init__(self, request: DeviceRequest) -> None:
        body, self._faults = request.body, request.faults
        chosen = [settings(protocol.Khepera4Settings, *row) for row in zip(body.names, body.device, strict=True)]
        self._dt = 1.0 / body.rate_hz
        self._t = 0.0
        self.servers: list[_Server] = []
        addresses = []
        try:
            for row, choice in enumerate(chosen):
                listener = _listen(body.names[row], body.addresses[row])
                server = choice.server or protocol.NEWEST
                robot = _WheeledRobot(body, row, request.faults)
                self.servers.append(_Server(robot, server, request.faults, listener))
                host, port = listener.getsockname()
                addresses.append(f"{'kteam' if server == 'kteam' else 'khepera4'}://{host}:{port}")
        except BodyError:
            self.close()
            raise
        self.addresses = tuple(addresses)
        self.models = [server.robot.model for server in self.servers]

    def sockets(self) -> Sequence[socket.socket]:
        return [wire for server in self.servers for wire in server.sockets(silent=self._silent(server, self._t))]

    def serve(self, ready: socket.socket, t: float) -> None:
        for server in self.servers:
            if ready in server.sockets(silent=False):
                server.serve(ready, t)

    def advance(self, t: float) -> None:
        for now in instants(self._t, t, self._dt):
            for server in self.servers:
                server.robot.move()
                server.advance(now)
        self._t = t
        for server in self.servers:
            if not self._faults.silent(t):
                server.flush()

    def close(self) -> None:
        for server in self.servers:
            server.hang_up()
            server.listener.close()

    def _silent(self, server: _Server, t: float) -> bool:
        return self._faults.silent(t) or server.robot.charge <= 0.0


def _listen(name: str, address: str) -> socket.socket:
    """Listening socket at the address, else on a free port of this host's loopback."""
    place = address.partition("://")[2]
    host, _, port = place.partition(":")
    host = host or "127.0.0.1"
    if not host.startswith("127.") or not (port or "0").isdecimal():
        raise BodyError(f"{name}: {address}: a twin needs a loopback address, such as khepera4-twin://127.0.0.1:50000")
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, int(port or "0")))
        listener.listen(4)
    except (OSError, OverflowError) as error:
        listener.close()
        raise BodyError(f"{name}: no Khepera twin at {host}:{port}: {error}; name another address") from error
    listener.setblocking(False)
    return listener
