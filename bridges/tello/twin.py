"""Protocol twin of DJI Tellos: the SDK 2.0 text protocol, each drone on its own loopback address."""

from __future__ import annotations

import errno
import math
import re
import socket
import zlib
from collections.abc import Sequence
from enum import Enum
from typing import Final

import numpy as np

from agents.body.interface import BodyError, BodyRequest, settings
from agents.vectors import NO_SETPOINT, ZERO, Setpoint, Vector, difference, norm
from bridges.tello import protocol
from bridges.tello.kind import TELLO
from twins.arrays import Array
from twins.body import Twin, instants
from twins.device import Device, DeviceRequest, Faults, FaultyLink
from twins.models.quadrotor import Quadrotor

PORT: Final = 18889  # not the drone's own 8889: djitellopy binds that on every address of this host
HOSTS: Final = range(2, 255)  # addresses 127.0.0.x: djitellopy distinguishes drones by address only
LOWEST_TAKEOFF_CHARGE: Final = 0.10  # charge below which take-offs are refused
LANDING_CHARGE: Final = 0.05  # charge of an automatic landing
NEAR: Final = 0.03  # [m] distance from the goal at which a move is complete
NEAR_YAW: Final = 0.01  # [rad] likewise for a turn
MOVES: Final = {
    "forward": (1.0, 0.0, 0.0),
    "back": (-1.0, 0.0, 0.0),
    "left": (0.0, 1.0, 0.0),
    "right": (0.0, -1.0, 0.0),
    "up": (0.0, 0.0, 1.0),
    "down": (0.0, 0.0, -1.0),
}


LOWEST_FLIP_CHARGE: Final = 0.50
FLIPS: Final = {"l": "left", "r": "right", "f": "forward", "b": "back"}
FLIP_M: Final = 0.2  # displacement by a flip
PASSED: Final = 0.15  # [m] distance from a point of an arc at which the next one is flown to
ARC_M: Final = 0.2
LINE: Final = 1e-6  # [m⁴] three points with a smaller squared area are on a line
PAD: Final = re.compile(r"m-?[1-8]")
MANOEUVRES: Final = (*MOVES, "go", "curve", "jump", "flip", "cw", "ccw")
OTHERS: Final = (
    *("command", "takeoff", "land", "emergency", "stop", "rc", "speed"),
    *("streamon", "streamoff", "mon", "moff", "mdirection"),
)
TEXT_ANSWERS: Final = {"wifi": "ok", "ap": "ok,drone will reboot in 3s"}  # commands with arguments of text


class Mode(Enum):
    """State of a drone."""

    GROUND = "on the ground"
    CLIMB = "taking off"
    STICKS = "hovering or flying by the sticks"
    MOVE = "on the way to a point"
    TURN = "turning"
    LAND = "landing"
    FALL = "motors off in the air"


class _Drone(FaultyLink[tuple[bytes, tuple[str, int]]]):
    """Socket, client, commands and motion of one drone."""

    def __init__(
        self, wire: socket.socket, faults: Faults, body: BodyRequest, row: int, chosen: protocol.TelloSettings
    ) -> None:
        name, seed, disturbance = body.names[row], body.seeds[row], body.disturbance[row]
        super().__init__(faults, np.random.default_rng([seed, zlib.crc32(name.encode()), zlib.crc32(b"loss")]))
        self.wire, self._dt = wire, 1.0 / body.rate_hz
        self.model = Quadrotor(body.kinds[row], body.start[row], body.yaw[row])
        self._twin = Twin(self.model, body.kinds[row], disturbance, name=name, seed=seed, dt=self._dt)
        self.number, self.start_yaw = row, body.yaw[row]
        self.stick_speed = chosen.twin_stick_speed  # [m/s] speed at full deflection
        self.seeks_pads = False  # mission pads are switched on
        self.mode = Mode.GROUND
        self.sdk = False
        self.peer: tuple[str, int] | None = None  # sender of the last command
        self.answer_to: tuple[str, int] | None = None  # receiver of the answer at the end of the manoeuvre
        self.last_command = 0.0
        self.sticks = (0, 0, 0, 0)
        self.goal = ZERO
        self.further: list[Vector] = []  # points after the goal
        self.heading = 0.0
        self.pace = protocol.STICK_SPEED  # [m/s] speed of moves
        self.motors_s = 0.0
        self.charge = faults.battery
        self.state_due = 0.0
        self.landing_due = math.inf  # time until which `land` is refused

    @property
    def aloft(self) -> bool:
        """Whether the drone accepts motion commands."""
        return self.mode in (Mode.STICKS, Mode.MOVE, Mode.TURN)

    def step(self) -> None:
        """One step; the setpoint takes effect after the latency."""
        self._twin.command(self._setpoint())
        if self._twin.advance(self.t, self._dt):
            self._twin.refill()
        self._update()

    def _hover(self) -> None:
        self.mode, self.sticks = Mode.STICKS, (0, 0, 0, 0)

    def send(self, text: str, to: tuple[str, int]) -> None:
        """Queue a packet; sent at once, or after the injected delay."""
        if not self.lost():
            self.put((text.encode("ascii", "replace"), to))
            self.flush()

    def flush(self) -> None:
        """Send due packets."""
        for packet, to in self.due():
            try:
                self.wire.sendto(packet, to)
            except OSError:
                continue  # no client there: unknown to the drone

    def finish(self, text: str) -> None:
        """Answer the sender of a completed manoeuvre."""
        if self.answer_to is not None:
            self.send(text, self.answer_to)
        self.answer_to = None

    def receive(self, packet: bytes, sender: tuple[str, int]) -> None:
        """Execute a packet and answer it."""
        words = packet.decode("ascii", "replace").split()
        if not words:
            return
        word = words[0]
        if word == "command":
            self.sdk = True
        if not self.sdk:
            return  # the drone listens to the phone alone until `command`
        self.peer, self.last_command = sender, self.t
        try:
            answer = self._answer(word) if word.endswith("?") else self._execute(word, words[1:], sender)
        except _Refusal as refusal:
            answer = str(refusal)
        if answer:
            self.send(answer, sender)

    def _answer(self, question: str) -> str:
        height = self.model.position[2]
        answers = {
            "battery?": f"{round(100.0 * self.charge)}\r\n",
            "speed?": f"{100.0 * self.pace:.1f}\r\n",
            "time?": f"{int(self.motors_s)}s\r\n",
            "height?": f"{int(10.0 * height)}dm\r\n",
            "temp?": "63~66C\r\n",
            "attitude?": f"pitch:0;roll:0;yaw:{self._yaw()};\r\n",
            "baro?": f"{170.0 + height:.6f}\r\n",
            "acceleration?": "agx:-6.00;agy:1.00;agz:-999.00;\r\n",
            "tof?": f"{max(100, round(1000.0 * height))}mm\r\n",
            "wifi?": "90\r\n",
            "sdk?": "20\r\n",
            "sn?": f"0TQTWIN{self.number:04d}\r\n",
        }
        return answers.get(question, f"unknown command: {question}")

    def _execute(self, word: str, arguments: list[str], sender: tuple[str, int]) -> str:
        """Execute a command; returns the answer, empty if there is none, or none yet; raises _Refusal."""
        if word in MANOEUVRES:
            _require("error Motor stop", met=self.aloft)
            self._begin_manoeuvre(word, arguments)
            self.answer_to = sender
            return ""
        if word not in OTHERS:
            return TEXT_ANSWERS.get(word, f"unknown command: {word}")
        values = _integers(arguments)
        if word in ("takeoff", "land", "emergency"):
            return self._start_automatic(word, sender)
        if word == "rc":
            _require("error", met=len(values) == 4)
            right, forward, up, clockwise = (max(-protocol.STICK, min(protocol.STICK, value)) for value in values)
            self.sticks = (right, forward, up, clockwise)
            return ""
        if word == "stop":
            _require("error Motor stop", met=self.aloft)
            self._hover()
        elif word == "speed":
            _require("out of range", met=len(values) == 1 and 10 <= values[0] <= 100)
            self.pace = 0.01 * values[0]
        elif word in ("mon", "moff"):
            self.seeks_pads = word == "mon"
        return "ok"

    def _start_automatic(self, word: str, sender: tuple[str, int]) -> str:
        """Start an automatic manoeuvre: take-off, landing or emergency stop; returns an immediate answer, or empty."""
        if word == "emergency":
            self.model.stop()
            self.mode, self.answer_to = Mode.FALL, None
            self.sticks = (0, 0, 0, 0)
            return "ok"
        if word == "takeoff":
            if self.mode is not Mode.GROUND or self.charge < LOWEST_TAKEOFF_CHARGE:
                return "error"
            self.model.takeoff(protocol.TAKEOFF_HEIGHT)
            self.mode, self.answer_to = Mode.CLIMB, sender
            self.sticks = (0, 0, 0, 0)
            return ""
        self.landing_due = min(self.landing_due, self.t + self.faults.refuse_landing_s)
        if self.mode in (Mode.GROUND, Mode.CLIMB, Mode.FALL) or self.t < self.landing_due:
            return "error"  # busy with its take-off it obeys `emergency` only
        if self.mode is not Mode.LAND:  # a repeated command changes nothing
            self.model.land()
        self.mode, self.answer_to = Mode.LAND, sender
        return ""

    def _begin_manoeuvre(self, word: str, arguments: list[str]) -> None:
        """Begin a move or turn; raises _Refusal."""
        yaw = self.model.yaw
        if word in ("cw", "ccw"):
            (angle,) = _integers(arguments, 1)
            _require("out of range", met=1 <= angle <= 360)
            self.mode = Mode.TURN
            self.heading = yaw + math.radians(angle) * (-1.0 if word == "cw" else 1.0)
        else:
            ways, self.pace = self._path_of_move(word, arguments)
            cos, sin = math.cos(yaw), math.sin(yaw)
            x, y, z = self.model.held
            points = [(x + cos * a - sin * b, y + sin * a + cos * b, z + c) for a, b, c in np.array(ways).tolist()]
            self.goal, *self.further = points
            self.mode = Mode.MOVE

    def _path_of_move(self, word: str, arguments: list[str]) -> tuple[list[Array], float]:
        """Points (3,) of a move one after the other [m], forward, left and up of the drone, and its pace [m/s]."""
        if word == "flip":  # attitude is not simulated: a short way in its direction
            direction = FLIPS.get(" ".join(arguments))
            if direction is None or self.charge < LOWEST_FLIP_CHARGE:
                raise _Refusal("error")
            return [FLIP_M * np.array(MOVES[direction])], self.pace
        if arguments and PAD.fullmatch(arguments[-1]):
            raise _Refusal("error No valid marker")  # there are no mission pads
        if word in MOVES:
            (distance,) = _integers(arguments, 1)
            _require("out of range", met=20 <= distance <= 500)
            return [0.01 * distance * np.array(MOVES[word])], self.pace
        count, fastest = {"go": (1, 100), "curve": (2, 60)}.get(word, (0, 0))
        _require("error", met=count > 0)
        *way, speed = _integers(arguments, 3 * count + 1)
        _require("out of range", met=max(map(abs, way)) <= 500 and 10 <= speed <= fastest)
        points = 0.01 * np.array(way).reshape(count, 3)
        _require("error", met=bool((np.abs(points) >= 0.2).any(axis=1).all()))
        return ([points[0]] if word == "go" else _arc(*points)), 0.01 * speed

    def _yaw(self) -> int:
        """Yaw as reported: degrees clockwise from the yaw at power-on, -180 to 179."""
        return (round(-math.degrees(self.model.yaw - self.start_yaw)) + 180) % 360 - 180

    def state(self) -> str:
        """The line that is sent at `STATE_HZ`."""
        height = self.model.position[2]
        pad, at = (-1, -100) if self.seeks_pads else (-2, -200)  # none seen; not searched for
        right, forward, up, _ = protocol.sticks(self.model.velocity, 0.0, self.model.yaw)
        return (
            f"mid:{pad};x:{at};y:{at};z:{at};mpry:0,0,0;pitch:0;roll:0;yaw:{self._yaw()};"
            f"vgx:{int(forward / 10)};vgy:{int(right / 10)};vgz:{int(-up / 10)};templ:63;temph:66;"
            f"tof:{max(10, round(100.0 * height))};h:{10 * int(10.0 * height + 1e-6)};"
            f"bat:{round(100.0 * self.charge)};baro:{170.0 + height:.2f};time:{int(self.motors_s)};"
            "agx:-6.00;agy:1.00;agz:-999.00;\r\n"
        )

    def _setpoint(self) -> Setpoint:
        yaw = self.model.yaw
        if self.mode is Mode.STICKS:
            return protocol.motion(self.sticks, yaw, self.stick_speed)
        if self.mode is Mode.TURN:
            rate = max(-protocol.STICK_TURN, min(protocol.STICK_TURN, 4.0 * (self.heading - yaw)))
            return 0.0, 0.0, 0.0, rate
        if self.mode is Mode.MOVE:
            way = difference(self.goal, self.model.held)
            pace = min(self.pace / max(norm(way), 1e-9), 1.5)
            return way[0] * pace, way[1] * pace, way[2] * pace, 0.0
        return NO_SETPOINT

    def _update(self) -> None:
        """Update after a step: end of manoeuvres, battery, automatic landing."""
        z, flying = self.model.held[2], self.model.flying
        if self.mode is Mode.CLIMB and abs(z - protocol.TAKEOFF_HEIGHT) < NEAR:
            self.mode = Mode.STICKS
            self.finish("ok")
        elif self.mode is Mode.LAND and not flying:
            self.mode = Mode.GROUND
            self.finish("ok")
        elif self.mode is Mode.FALL and z <= 0.0:
            self.mode = Mode.GROUND
        elif self.mode in (Mode.MOVE, Mode.TURN) and self._arrived():
            if self.mode is Mode.MOVE and self.further:
                self.goal = self.further.pop(0)
            else:
                self._hover()
                self.finish("ok")
        if not flying:
            return
        self.motors_s += self._dt
        self.charge = max(0.0, self.charge - self.faults.drain * self._dt / TELLO.endurance_s)
        alone = self.t - self.last_command > protocol.AUTO_LAND_S
        if self.mode is not Mode.LAND and (alone or self.charge <= LANDING_CHARGE):
            self.model.land()
            self.finish("error Auto land")
            self.mode = Mode.LAND

    def _arrived(self) -> bool:
        if self.mode is Mode.TURN:
            return abs(self.heading - self.model.yaw) < NEAR_YAW
        near = PASSED if self.further else NEAR
        return max(map(abs, difference(self.goal, self.model.held))) < near


class TelloDevice(Device):
    """Tellos."""

    def __init__(self, request: DeviceRequest, state_port: int = protocol.STATE_PORT) -> None:
        """`state_port`: UDP port of a client, to which the states are sent."""
        body = request.body
        self._state_port = state_port
        chosen = [settings(protocol.TelloSettings, *row) for row in zip(body.names, body.device, strict=True)]
        self._dt = 1.0 / body.rate_hz
        self._t = 0.0
        self._drones: list[_Drone] = []
        try:
            for row, name in enumerate(body.names):
                wire = _listen(name, body.addresses[row])
                self._drones.append(_Drone(wire, request.faults, body, row, chosen[row]))
        except BodyError:
            self.close()
            raise
        self.models = [drone.model for drone in self._drones]
        places = (drone.wire.getsockname() for drone in self._drones)
        self.addresses = tuple(f"tello://{host}:{port}" for host, port in places)

    def silence(self, row: int, seconds: float) -> None:
        """Begin a gap of a drone's Wi-Fi: nothing is received in either direction, the sticks stay as they are."""
        self._drones[row].silence(seconds)

    def sockets(self) -> Sequence[socket.socket]:
        return [drone.wire for drone in self._drones]

    def serve(self, ready: socket.socket, t: float) -> None:
        for drone in self._drones:
            if drone.wire is ready:
                drone.t = t
                try:
                    packet, sender = drone.wire.recvfrom(1024)
                except OSError:
                    return
                if not drone.lost():
                    drone.receive(packet, sender)

    def advance(self, t: float) -> None:
        for drone in self._drones:
            drone.t = t
        for _ in instants(self._t, t, self._dt):
            for drone in self._drones:
                drone.step()
        self._t = t
        for drone in self._drones:
            if drone.sdk and drone.peer is not None and t >= drone.state_due - 0.5 * self._dt:
                late = t - drone.state_due
                period = 1.0 / protocol.STATE_HZ
                drone.state_due += period if late < period else late + period  # missed packets are not repeated
                drone.send(drone.state(), (drone.peer[0], self._state_port))
            drone.flush()

    def close(self) -> None:
        for drone in self._drones:
            drone.wire.close()


class _Refusal(Exception):
    """Answer to a command that is not executed."""


def _require(answer: str, *, met: bool) -> None:
    if not met:
        raise _Refusal(answer)


def _integers(arguments: list[str], count: int | None = None) -> list[int]:
    try:
        values = [int(argument) for argument in arguments]
    except ValueError:
        raise _Refusal("error") from None
    _require("out of range", met=count in (None, len(values)))
    return values


def _arc(first: Array, second: Array) -> list[Array]:
    """Points (3,) on the arc from the origin through `first` to `second` [m], `ARC_M` apart at most."""
    normal = np.cross(first, second)
    area = float(normal @ normal)
    _require("error", met=area > LINE)
    centre = np.cross((first @ first) * second - (second @ second) * first, normal) / (2.0 * area)
    radius = float(np.linalg.norm(centre))
    _require("error", met=0.5 <= radius <= 10.0)
    out = -centre
    side = np.cross(normal / math.sqrt(area), out)
    end = math.atan2(float((second - centre) @ side), float((second - centre) @ out)) % (2.0 * math.pi)
    angles = np.linspace(0.0, end, max(2, math.ceil(end * radius / ARC_M)) + 1)[1:]
    return [centre + out * math.cos(angle) + side * math.sin(angle) for angle in angles]


def _listen(name: str, address: str) -> socket.socket:
    """Socket at the address, else on the first loopback host without a Tello."""
    _, named, place = address.partition("://")
    if named:
        host, port, _ = protocol.endpoint(name, f"tello://{place}")
        if not host.startswith("127."):
            raise BodyError(f"{name}: {address}: a twin needs a loopback address, such as tello-twin://127.0.0.2")
        hosts, port = [host], port if ":" in place else PORT
    else:
        hosts, port = [f"127.0.0.{number}" for number in HOSTS], PORT
    for host in hosts:
        wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            wire.bind((host, port))
        except OSError as error:
            wire.close()
            if error.errno != errno.EADDRINUSE:
                raise BodyError(f"{name}: no Tello twin at {host}:{port}: {error.strerror}") from error
            continue
        wire.setblocking(False)
        return wire
    raise BodyError(f"{name}: {address}: in use; end the twin that holds {hosts[0]}:{port}, or name another address")
