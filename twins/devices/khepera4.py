"""Protocol twin of Khepera IV robots: Robotic Park's server or K-Team's, over TCP; each robot has its own port."""

from __future__ import annotations

import math
import socket
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from agents.arrays import Array
from agents.body.interface import BodyError, settings
from agents.body.kinds import KHEPERA4
from agents.decision.position_control import drive
from agents.protocols import khepera4 as protocol
from twins.body import CATCH_UP_S
from twins.devices.device import DeviceRequest, Faults
from twins.models.differential import Differential
from twins.models.disturbance import Drift, Latency
from twins.models.noise import Noise

SCHEMES: Final = {"park": "khepera4", "kteam": "kteam"}
BOARD_GOAL: Final = {  # Robotic Park's controller on board, for `g`
    "response": np.array([KHEPERA4.response]),
    "turn_response": np.array([KHEPERA4.turn_response]),
    "speed": np.array([KHEPERA4.speed]),
    "turn_rate": np.array([KHEPERA4.turn_rate]),
}


class _Robot:
    """State of a robot's server: odometry since power-on, and commands of the wheels."""

    def __init__(self, chosen: protocol.Settings, faults: Faults) -> None:
        self.odometry = chosen.odometry
        self.charge = faults.battery
        self.pose = np.zeros(3)  # x, y [m], theta [rad]
        self.pulses = [0.0, 0.0]
        self.speed = (0.0, 0.0)  # units
        self.twist = (0.0, 0.0)  # v [m/s], ω [rad/s]
        self.goal: tuple[float, float] | None = None
        self.last_answer = (0.0, 0.0, 0.0)  # way [m] and turn [rad] since power-on, at the last `p`
        self.way = self.turn = 0.0
        self.sounding = 31  # mask of the ultrasonic sensors

    def drive(self, left: int, right: int) -> None:
        """Set the wheel speeds in units, within the motors' limits."""
        limit = protocol.FASTEST
        self.goal = None
        self.twist = protocol.twist(max(-limit, min(limit, left)), max(-limit, min(limit, right)))

    def halt(self) -> None:
        """Stop both wheels."""
        self.goal, self.twist = None, (0.0, 0.0)

    def run_goal_controller(self) -> None:
        """Run the controller on board, if there is a goal."""
        if self.goal is not None:
            way = np.array([[self.goal[0] - self.pose[0], self.goal[1] - self.pose[1]]])
            v, turn = drive(way, self.pose[2:], np.array([np.nan]), **BOARD_GOAL)[0].tolist()
            self.twist = protocol.twist(*protocol.units(v, turn))

    def add_motion(self, ahead: float, moved: Array, turn: float, dt: float) -> None:
        """Add one step: way along the nose [m], motion (2,) [m] in the frame of odometry, turn [rad]."""
        self.pose[:2] += moved
        self.pose[2] = math.remainder(self.pose[2] + turn, 2.0 * math.pi)
        self.way, self.turn = self.way + ahead, self.turn + turn
        half = 0.5 * protocol.BASE * turn
        for wheel, way in enumerate((ahead - half, ahead + half)):
            self.pulses[wheel] += way / protocol.PULSE
        self.speed = (ahead - half) / dt / protocol.UNIT, (ahead + half) / dt / protocol.UNIT


def answer_park(robot: _Robot, received: bytes) -> bytes:
    """Answer of Robotic Park's server, which reads one command per read; most commands have no answer."""
    text = received.decode("ascii", "replace").strip("\0\r\n ")
    if text == "stop":
        robot.halt()
    elif text == "get_data":
        return b",".join([str(protocol.SOUND_NOTHING).encode()] * len(protocol.SOUND_BEARING))
    elif text[:1] in ("p", "t"):
        return _answer_pose(robot, text[0])
    else:
        values = protocol.scanned(text[1:])
        if text[:1] == "d" and len(values) >= 2:
            robot.drive(*protocol.units(values[0] * protocol.CENTIMETRE, values[1]))
        elif text[:1] == "g" and len(values) >= 2:
            robot.goal = (values[0], values[1])
        elif text[:1] == "i" and len(values) >= 2:
            robot.pose[: len(values)] = values
    return b""


def _answer_pose(robot: _Robot, letter: str) -> bytes:
    """Answer to `p`, of which three variants exist, and to `t`."""
    x, y, theta = robot.pose.tolist()
    way, turn = robot.way - robot.last_answer[0], robot.turn - robot.last_answer[1]
    if letter == "t":
        return f"{way:.4f},{theta:.4f}".encode()
    if robot.odometry == "pose":
        return f"{x:.4f},{y:.4f},{theta:.4f}".encode()
    robot.last_answer = (robot.way, robot.turn, 0.0)
    return f"{way:.6f},{turn if robot.odometry == 'increments' else theta:.6f}".encode()


def answer_kteam(robot: _Robot, line: str) -> str:
    """Answer of K-Team's `kh4server` to a line; `$` for an unknown command."""
    letter = line[:1]
    try:
        values = [int(word) for word in line[2:].split(",") if word]
    except ValueError:
        return "$"
    sounds = (protocol.SOUND_NOTHING if robot.sounding >> bit & 1 else 2000 for bit in range(5))
    measured = {
        0: 7000 + 1400 * robot.charge,
        1: -420,
        2: -410,
        3: 3400 * robot.charge,
        4: 29,
        5: 100 * robot.charge,
        6: 0,
    }
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
        robot.pulses = [0.0, 0.0]
    elif letter == "V" and values and values[0] in measured:
        return f"v,{round(measured[values[0]])}"
    elif letter in answers:
        return ",".join([letter.lower(), *map(str, answers[letter]())])
    elif letter not in ("M", "K", "H", "J"):
        return "$"
    return letter.lower()


class _Server:
    """Port of one robot: serves one client; others wait until that client has left."""

    def __init__(self, robot: _Robot, chosen: protocol.Settings, faults: Faults, listener: socket.socket) -> None:
        self.robot, self.listener = robot, listener
        self._protocol, self._stops_alone, self._faults = chosen.protocol, chosen.stops_alone, faults
        self._client: socket.socket | None = None
        self._partial = b""
        self._outbox: deque[tuple[float, bytes]] = deque()

    def sockets(self, *, silent: bool) -> list[socket.socket]:
        """Sockets to wait on."""
        if self._client is not None:
            return [self._client]
        return [] if silent else [self.listener]

    def serve(self, ready: socket.socket, t: float, *, silent: bool) -> None:
        """Accept a client, answer a command, or close the connection."""
        try:
            if ready is self.listener:
                self._client, _ = self.listener.accept()
                self._client.setblocking(False)
                self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                return
            received = ready.recv(255)
        except BlockingIOError:
            return
        except OSError:
            received = b""
        if not received:
            self.hang_up()
        elif not silent:
            self._outbox.append((t + self._faults.delay_s, self._answer(received)))
            self.flush(t)

    def flush(self, t: float) -> None:
        """Send due answers."""
        while self._outbox and self._outbox[0][0] <= t:
            _, answer = self._outbox.popleft()
            if self._client is not None and answer:
                try:
                    self._client.send(answer)
                except OSError:
                    self.hang_up()

    def hang_up(self) -> None:
        """Close the client's connection: the robot stops if its server does that, else it drives on."""
        if self._client is not None:
            self._client.close()
        self._client, self._partial = None, b""
        self._outbox.clear()
        if self._stops_alone:
            self.robot.halt()

    def _answer(self, received: bytes) -> bytes:
        if self._protocol == "park":
            return answer_park(self.robot, received)
        *lines, self._partial = (self._partial + received).replace(b"\n", b"\r").split(b"\r")
        answers = [answer_kteam(self.robot, line.decode("ascii", "replace")) for line in lines if line]
        return "".join(f"{answer}\r\n" for answer in answers).encode()


class KheperaDevice:
    """Khepera IV robots; implements `twins.devices.device.Device`. Their range sensors measure nothing."""

    def __init__(self, request: DeviceRequest) -> None:
        body, self._faults = request.body, request.faults
        chosen = [settings(protocol.Settings, *row) for row in zip(body.names, body.device, strict=True)]
        self._dt = 1.0 / body.rate_hz
        self._t = 0.0
        self._model = Differential(body.kinds, body.start, body.yaw, self._dt)
        self._latency = Latency(body.disturbance, self._dt)
        self._drift = Drift(body.disturbance, Noise(body.names, body.seeds, "odometry", 2))
        self._servers: list[_Server] = []
        addresses = []
        try:
            for name, address, choice in zip(body.names, body.addresses, chosen, strict=True):
                listener = _listen(name, address)
                robot = _Robot(choice, request.faults)
                self._servers.append(_Server(robot, choice, request.faults, listener))
                host, port = listener.getsockname()
                addresses.append(f"{SCHEMES[choice.protocol]}://{host}:{port}")
        except BodyError:
            self.close()
            raise
        self.addresses = tuple(addresses)

    def sockets(self) -> Sequence[socket.socket]:
        """See `Device.sockets`."""
        return [wire for server in self._servers for wire in server.sockets(silent=self._silent(server, self._t))]

    def serve(self, ready: socket.socket, t: float) -> None:
        """See `Device.serve`."""
        for server in self._servers:
            if ready in server.sockets(silent=False):
                server.serve(ready, t, silent=self._silent(server, t))

    def advance(self, t: float) -> None:
        """See `Device.advance`."""
        steps = round((t - self._t) / self._dt)
        if steps * self._dt > CATCH_UP_S:
            steps = 1
        for _ in range(steps):
            self._step()
        self._t = t
        for server in self._servers:
            if not self._faults.silent(t):
                server.flush(t)

    def truth(self) -> tuple[Array, Array]:
        """See `Device.truth`."""
        return self._model.position.copy(), self._model.yaw.copy()

    def close(self) -> None:
        """See `Device.close`."""
        for server in self._servers:
            server.hang_up()
            server.listener.close()

    def _silent(self, server: _Server, t: float) -> bool:
        return self._faults.silent(t) or server.robot.charge <= 0.0

    def _step(self) -> None:
        wanted = np.zeros((len(self._servers), 4))
        for row, server in enumerate(self._servers):
            robot = server.robot
            robot.charge = max(0.0, robot.charge - self._faults.drain * self._dt / KHEPERA4.endurance_s)
            if robot.charge <= 0.0:
                robot.halt()
            robot.run_goal_controller()
            wanted[row, :2] = robot.twist
        if self._latency.present:
            wanted = self._latency.delay(wanted)
        place, yaw = self._model.position.copy(), self._model.yaw.copy()
        self._model.command(wanted[:, :2])
        self._model.advance()
        moved, turn = (self._model.position - place)[:, :2], self._model.yaw - yaw
        middle = yaw + 0.5 * turn
        ahead = np.cos(middle) * moved[:, 0] + np.sin(middle) * moved[:, 1]
        if self._drift.present:
            error = self._drift.error.copy()
            self._drift.advance(moved)
            moved = moved + self._drift.error - error
        for row, server in enumerate(self._servers):
            frame = float(server.robot.pose[2] - yaw[row])  # between its odometry and the world
            cos, sin = math.cos(frame), math.sin(frame)
            x, y = moved[row].tolist()
            own = np.array([cos * x - sin * y, sin * x + cos * y])
            server.robot.add_motion(float(ahead[row]), own, float(turn[row]), self._dt)


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


def open_device(request: DeviceRequest) -> KheperaDevice:
    """Entry point `khepera4-twin` of the group `zenpark.devices`."""
    return KheperaDevice(request)
