"""Link to one Khepera IV: a thread that runs one of its two protocols and reconnects after a loss."""

from __future__ import annotations

import fcntl
import math
import os
import select
import socket
import termios
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol
from urllib.parse import urlsplit

import numpy as np

from agents.arrays import Array
from agents.body.device_locks import numeric
from agents.body.interface import FRESH_S, TROUBLE, BodyError
from agents.protocols import khepera4 as protocol
from bridges.khepera4.odometry import Odometer

CONNECT_S: Final = 1.5
RETRY_S: Final = 0.5  # between the end of a connection and the next attempt
STOPS: Final = 3  # stop commands at the end of the link
RANGES_S: Final = 0.2
BATTERY_S: Final = 5.0
STOP_TRIES_S: Final = 3.0  # time for attempts to stop a robot whose connection broke while it moved
STOP_RETRY_S: Final = 0.1  # between two such attempts
STANDING: Final = 0.02  # [m/s] slower robots stand
ANSWER_S: Final = 2.5  # the note reports a robot that is not known to stand so long after a halt


class UnknownAnswer(OSError):
    """The answer does not belong to this protocol."""


class Wire:
    """Byte stream to and from a robot: a TCP connection or a serial line."""

    def __init__(self, descriptor: int, close: Callable[[], None]) -> None:
        self._descriptor, self.close = descriptor, close
        self._poll = select.poll()
        self._poll.register(descriptor, select.POLLIN)

    def send(self, data: bytes) -> None:
        """Discard earlier input, which cannot be the answer, then write at once."""
        while self._poll.poll(0):
            self._read()
        os.write(self._descriptor, data)

    def receive(self, until: float) -> bytes:
        """Next bytes received.

        Raises:
            TimeoutError: If nothing comes before `until` [s, monotonic].
            ConnectionError: If the other end has closed.
        """
        if not self._poll.poll(max(0.0, 1e3 * (until - time.monotonic()))):
            raise TimeoutError
        return self._read()

    def _read(self) -> bytes:
        data = os.read(self._descriptor, 1024)
        if not data:
            raise ConnectionResetError("the robot closed the connection")
        return data


@dataclass(frozen=True)
class Address:
    """Address and protocol of a robot: `khepera4://HOST[:PORT]`, `kteam://HOST:PORT` or `kteam:///dev/ttyS0`."""

    kteam: bool
    host: str
    port: int
    serial: str

    @classmethod
    def parse(cls, robot: str, address: str) -> Address:
        """Parse an address.

        Raises:
            BodyError: If it has none of the three forms.
        """
        try:
            parts = urlsplit(address)
            host, port = parts.hostname or "", parts.port
        except ValueError as error:
            raise BodyError(f"{robot}: {address}: {error}") from error
        kteam = parts.scheme == "kteam"
        if kteam and not host and parts.path:
            return cls(kteam, "", 0, parts.path)
        if parts.scheme not in ("khepera4", "kteam") or not host or (kteam and not port):
            raise BodyError(
                f"{robot}: {address}: write khepera4://HOST for Robotic Park's server, kteam://HOST:PORT or "
                "kteam:///dev/ttyS0 for K-Team's kh4server"
            )
        return cls(kteam, host, port or protocol.PARK_PORT, "")

    def __str__(self) -> str:
        return self.serial or f"{self.host}:{self.port}"

    @property
    def device(self) -> str:
        """Canonical address, independent of aliases of the host or the line."""
        return os.path.realpath(self.serial) if self.serial else f"{numeric(self.host)}:{self.port}"

    def connect(self) -> Wire:
        """Open the connection or line.

        Raises:
            OSError: If that fails.
        """
        if not self.serial:
            wire = socket.create_connection((self.host, self.port), CONNECT_S)
            wire.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return Wire(wire.fileno(), wire.close)
        line = os.open(self.serial, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            fcntl.flock(line, fcntl.LOCK_EX | fcntl.LOCK_NB)  # before any change: another process may drive the robot
        except OSError as error:
            os.close(line)
            raise BlockingIOError(error.errno, "another process has this line") from None
        try:
            control = termios.CS8 | termios.CREAD | termios.CLOCAL
            special = termios.tcgetattr(line)[6]
            speed = termios.B115200
            termios.tcsetattr(line, termios.TCSANOW, [0, 0, control, 0, speed, speed, special])  # raw, 8N1
        except termios.error as error:
            os.close(line)
            raise OSError(*error.args) from error
        return Wire(line, lambda: os.close(line))


class Driver(Protocol):
    """One protocol. Every method raises OSError if the robot does not answer, or not in this protocol."""

    def begin(self) -> None:
        """Initialise a new connection."""
        ...

    def drive(self, v: float, turn: float) -> None:
        """Drive at v [m/s] and ω [rad/s]; zeros stop the robot."""
        ...

    def move(self, odometer: Odometer) -> None:
        """Request odometry and update `odometer`."""
        ...

    def ranges(self) -> tuple[Array, Array]:
        """Bearings [rad] and distances from the robot's centre [m]."""
        ...

    def battery(self) -> float:
        """Charge, 0 to 1; NaN if the protocol has no such value."""
        ...


class Park:
    """The server of Robotic Park."""

    def __init__(self, wire: Wire, chosen: protocol.Settings) -> None:
        self._wire, self._settings = wire, chosen
        self._free = 0.0

    def begin(self) -> None:
        """See `Driver`."""

    def drive(self, v: float, turn: float) -> None:
        """See `Driver`."""
        self._send_command(protocol.park_drive(v, turn) if v or turn else b"stop")

    def move(self, odometer: Odometer) -> None:
        """See `Driver`."""
        kind = self._settings.odometry
        values = self._request(b"p", 3 if kind == "pose" else 2, 'does device = { odometry = "..." } fit its server?')
        stamp = time.monotonic()
        if kind == "pose":
            x, y, theta = values
            odometer.pose(x, y, theta, stamp)
            return
        way, angle = values
        if kind == "increments":
            odometer.steps(way, angle, stamp)
        else:
            odometer.heading(way, angle, stamp)

    def ranges(self) -> tuple[Array, Array]:
        """See `Driver`."""
        count = len(protocol.SOUND_BEARING)
        sound = self._request(b"get_data", count, "if its server does not know get_data: device = { ranges = false }")
        return protocol.SOUND_BEARING, protocol.sound_distance(np.array(sound))

    def battery(self) -> float:
        """See `Driver`."""
        return math.nan

    def _send_command(self, command: bytes) -> None:
        time.sleep(max(0.0, self._free - time.monotonic()))  # the server reads two commands in one segment as one
        self._wire.send(command)
        self._free = time.monotonic() + protocol.GAP_S

    def _request(self, command: bytes, count: int, remedy: str) -> list[float]:
        self._send_command(command)
        try:
            answer = self._wire.receive(time.monotonic() + self._settings.silence_s).decode("ascii", "replace")
        except TimeoutError as error:
            raise TimeoutError(f"no answer to {command.decode()}; {remedy}") from error
        values = protocol.numbers(answer.strip("\0\r\n "))
        if len(values) != count:
            raise UnknownAnswer(f"answers {command.decode()} with {answer[:40]!r}, not with {count} numbers; {remedy}")
        return values


class KTeam:
    """K-Team's `kh4server`."""

    def __init__(self, wire: Wire, chosen: protocol.Settings) -> None:
        self._wire, self._settings = wire, chosen

    def begin(self) -> None:
        """See `Driver`."""
        self._request("B")
        if self._settings.ranges:
            self._request("U,31")

    def drive(self, v: float, turn: float) -> None:
        """See `Driver`."""
        left, right = protocol.units(v, turn)
        self._request(f"D,{left},{right}")

    def move(self, odometer: Odometer) -> None:
        """See `Driver`."""
        left, right = self._request("R", 2)[:2]
        odometer.wheels(left, right, time.monotonic())

    def ranges(self) -> tuple[Array, Array]:
        """See `Driver`."""
        sound, light = len(protocol.SOUND_BEARING), len(protocol.LIGHT_BEARING)
        distances = (
            protocol.sound_distance(np.array(self._request("G", sound)[:sound])),
            protocol.light_distance(np.array(self._request("N", light)[:light])),
        )
        return np.concatenate([protocol.SOUND_BEARING, protocol.LIGHT_BEARING]), np.concatenate(distances)

    def battery(self) -> float:
        """See `Driver`."""
        return 0.01 * self._request("V,5", 1)[0]

    def _request(self, request: str, count: int = 0) -> list[float]:
        """Send a request; returns the numbers of the answer, at least `count`."""
        self._wire.send(f"{request}\r".encode())
        until = time.monotonic() + self._settings.silence_s
        answer = b""
        while not answer.endswith(b"\n"):
            try:
                answer += self._wire.receive(until)
            except TimeoutError as error:
                raise TimeoutError(f"no answer to {request}") from error
        letter, _, rest = answer.decode("ascii", "replace").strip().rpartition("\n")[2].partition(",")
        values = protocol.numbers(rest)
        if letter != request[0].lower() or len(values) < count:
            raise UnknownAnswer(f"answers {request} with {answer[:40]!r}; is it K-Team's kh4server?")
        return values


@dataclass(frozen=True)
class Odometry:
    """Newest odometry of a robot, in the experiment's frame."""

    stamp: float = -math.inf  # time of reception, monotonic [s]
    x: float = math.nan  # [m]
    y: float = math.nan  # [m]
    yaw: float = math.nan  # [rad]
    velocity: tuple[float, float] = (math.nan, math.nan)  # [m/s]


class Link:
    """Thread of one robot. Odometry and setpoint are exchanged as whole objects, so neither side waits."""

    def __init__(
        self, name: str, address: Address, chosen: protocol.Settings, start: tuple[float, float, float]
    ) -> None:
        self.odometry = Odometry()
        self.scan: tuple[float, Array, Array] | None = None  # monotonic time [s], bearings [rad], distances [m]
        self.battery = math.nan  # charge, 0 to 1
        self.setpoint = (0.0, 0.0, -math.inf)  # v [m/s], ω [rad/s], monotonic time of the command [s]
        self.halted_since = math.inf  # monotonic [s]; infinity while the robot may move
        self.trouble = f"{address}: not connected yet"  # for users; empty while connected
        self._address, self._settings = address, chosen
        self._odometer = Odometer(*start)
        self._stands = True  # by the last command that was answered
        self._stop_deadline = math.inf
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"{name} link", daemon=True)

    def start(self) -> None:
        """Start the thread, which connects and reconnects until `end`."""
        self._thread.start()

    def drive(self, v: float, turn: float, now: float) -> None:
        """Drive at v [m/s], ω [rad/s] until the next command, for `FRESH_S` at most."""
        if v or turn:
            self.halted_since = math.inf
        self.setpoint = (v, turn, now)

    def halt(self, now: float) -> None:
        """Stop the robot."""
        self.halted_since = min(self.halted_since, now)
        self.setpoint = (0.0, 0.0, now)

    def unanswered(self, now: float) -> bool:
        """Whether a halt is not confirmed by odometry in time."""
        return now - self.halted_since > ANSWER_S and not (
            self._stands and math.hypot(*self.odometry.velocity) < STANDING
        )

    def end(self) -> None:
        """Ask the thread to stop the wheels and end; `join` waits for it."""
        self._stop_deadline = time.monotonic() + STOP_TRIES_S
        self._ending.set()

    def join(self) -> None:
        """Wait for the end of the thread."""
        if self._thread.ident is not None:
            self._thread.join()

    @property
    def battery_empty(self) -> bool:
        """Whether the battery is too low to drive."""
        return self.battery < self._settings.low_battery

    def _run(self) -> None:
        while not self._finished:
            try:
                wire = self._address.connect()
            except OSError as error:
                self.trouble = f"{self._address}: {error.strerror or error}; {self._remedy(error)}"
            else:
                try:
                    self._run_connection(
                        KTeam(wire, self._settings) if self._address.kteam else Park(wire, self._settings)
                    )
                except TROUBLE as error:  # of any kind: the wheels must stop
                    why = error.strerror if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
                    self.trouble = f"{self._address}: {why or error}"
                    if isinstance(error, TimeoutError):
                        self.trouble += "; another program may hold it, or the robot uses the other protocol"
                finally:
                    wire.close()
                self._odometer.reconnected()
            if not self._ending.wait(RETRY_S):
                continue
            if not self._finished:
                time.sleep(STOP_RETRY_S)

    @property
    def _finished(self) -> bool:
        """Whether the thread may end: asked to, and the wheels stand or the time for that is over."""
        return self._ending.is_set() and (self._stands or time.monotonic() > self._stop_deadline)

    def _remedy(self, error: OSError) -> str:
        if isinstance(error, BlockingIOError):
            return "end it first"
        if self._address.serial:
            return "is the line plugged in, and are you permitted to use it (group dialout)?"
        if isinstance(error, ConnectionRefusedError):
            return "start the server on the robot"
        return "is the robot on, and is the address right?"

    def _run_connection(self, driver: Driver) -> None:
        """Loop of one connection, until it breaks or the link ends."""
        driver.begin()
        driver.drive(0.0, 0.0)
        driver.move(self._odometer)  # before any motion: counters at zero show that the robot was switched on anew
        self._stands = True
        period = 1.0 / self._settings.poll_hz
        ranges_due = battery_due = due = time.monotonic()
        while not self._ending.wait(max(0.0, due - time.monotonic())):
            due = max(due + period, time.monotonic())
            twist = self._current_twist()
            self._stands = self._stands and not any(twist)
            driver.drive(*twist)
            driver.move(self._odometer)
            self._stands = not any(twist)
            now, at = time.monotonic(), self._odometer
            self.odometry = Odometry(now, at.x, at.y, at.yaw, at.velocity)
            self.trouble = ""
            if self._settings.ranges and now >= ranges_due:
                ranges_due = now + RANGES_S
                bearing, distance = driver.ranges()
                self.scan = (now, bearing, distance)
            if now >= battery_due:
                battery_due = now + BATTERY_S
                self.battery = driver.battery()
        for _ in range(STOPS):
            driver.drive(0.0, 0.0)
        self._stands = True

    def _current_twist(self) -> tuple[float, float]:
        v, turn, since = self.setpoint
        if self.battery_empty or time.monotonic() - since > FRESH_S:
            return 0.0, 0.0
        return v, turn
