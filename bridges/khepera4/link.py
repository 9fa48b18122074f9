"""The link to one Khepera IV: a thread that speaks one of its two protocols, and connects anew when that ends."""

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
RETRY_S: Final = 0.5  # between the end of a connection and the next
STOPS: Final = 3  # said when the link is let go
RANGES_S: Final = 0.2
BATTERY_S: Final = 5.0
FAREWELL_S: Final = 3.0  # so long it is tried to stop a robot whose connection broke while it moved
AGAIN_S: Final = 0.1  # between two such attempts
STANDING: Final = 0.02  # [m/s] slower than this it stands
ANSWER_S: Final = 2.5  # a robot that was told to halt and is not known to stand after this is worth a word


class Unintelligible(OSError):
    """The other end says what this protocol does not."""


class Wire:
    """Bytes to and from a robot: a TCP connection or a serial line."""

    def __init__(self, descriptor: int, close: Callable[[], None]) -> None:
        self._descriptor, self.close = descriptor, close
        self._poll = select.poll()
        self._poll.register(descriptor, select.POLLIN)

    def send(self, data: bytes) -> None:
        """Writes at once; what came in before is not an answer to it."""
        while self._poll.poll(0):
            self._read()
        os.write(self._descriptor, data)

    def receive(self, until: float) -> bytes:
        """What comes next.

        Raises:
            TimeoutError: If nothing comes until then [s, monotonic].
            ConnectionError: If the other end has closed.
        """
        if not self._poll.poll(max(0.0, 1e3 * (until - time.monotonic()))):
            raise TimeoutError
        return self._read()

    def _read(self) -> bytes:
        data = os.read(self._descriptor, 1024)
        if not data:
            raise ConnectionResetError("it closed the connection")
        return data


@dataclass(frozen=True)
class Address:
    """Where a robot is, and what it speaks: `khepera4://HOST[:PORT]`, `kteam://HOST:PORT` or `kteam:///dev/ttyS0`."""

    kteam: bool
    host: str
    port: int
    serial: str

    @classmethod
    def of(cls, robot: str, address: str) -> Address:
        """Reads one.

        Raises:
            BodyError: If it is none of the three.
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
        """Canonical address of a robot, whatever its host or line is called."""
        return os.path.realpath(self.serial) if self.serial else f"{numeric(self.host)}:{self.port}"

    def connect(self) -> Wire:
        """Opens the line.

        Raises:
            OSError: If it cannot.
        """
        if not self.serial:
            wire = socket.create_connection((self.host, self.port), CONNECT_S)
            wire.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return Wire(wire.fileno(), wire.close)
        line = os.open(self.serial, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            fcntl.flock(line, fcntl.LOCK_EX | fcntl.LOCK_NB)  # before anything is changed: another process may drive
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
    """One protocol. Everything raises OSError when the robot does not answer, or not in this protocol."""

    def begin(self) -> None:
        """Once for each connection."""
        ...

    def drive(self, v: float, turn: float) -> None:
        """Wheels as v [m/s] and ω [rad/s] say; zero is a stop."""
        ...

    def move(self, odometer: Odometer) -> None:
        """Asks where the robot is."""
        ...

    def ranges(self) -> tuple[Array, Array]:
        """Bearings [rad] and distances from the robot's centre [m]."""
        ...

    def battery(self) -> float:
        """Charge, 0 to 1; NaN if the protocol does not say."""
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
        self._say(protocol.park_drive(v, turn) if v or turn else b"stop")

    def move(self, odometer: Odometer) -> None:
        """See `Driver`."""
        kind = self._settings.odometry
        values = self._ask(b"p", 3 if kind == "pose" else 2, 'does device = { odometry = "..." } fit its server?')
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
        sound = self._ask(b"get_data", count, "if its server does not know get_data: device = { ranges = false }")
        return protocol.SOUND_BEARING, protocol.sound_distance(np.array(sound))

    def battery(self) -> float:
        """See `Driver`."""
        return math.nan

    def _say(self, command: bytes) -> None:
        time.sleep(max(0.0, self._free - time.monotonic()))  # two commands in one segment are one to the server
        self._wire.send(command)
        self._free = time.monotonic() + protocol.GAP_S

    def _ask(self, command: bytes, count: int, remedy: str) -> list[float]:
        self._say(command)
        try:
            answer = self._wire.receive(time.monotonic() + self._settings.silence_s).decode("ascii", "replace")
        except TimeoutError as error:
            raise TimeoutError(f"no answer to {command.decode()}; {remedy}") from error
        values = protocol.numbers(answer.strip("\0\r\n "))
        if len(values) != count:
            raise Unintelligible(f"answers {command.decode()} with {answer[:40]!r}, not with {count} numbers; {remedy}")
        return values


class KTeam:
    """K-Team's `kh4server`."""

    def __init__(self, wire: Wire, chosen: protocol.Settings) -> None:
        self._wire, self._settings = wire, chosen

    def begin(self) -> None:
        """See `Driver`."""
        self._ask("B")
        if self._settings.ranges:
            self._ask("U,31")

    def drive(self, v: float, turn: float) -> None:
        """See `Driver`."""
        left, right = protocol.units(v, turn)
        self._ask(f"D,{left},{right}")

    def move(self, odometer: Odometer) -> None:
        """See `Driver`."""
        left, right = self._ask("R", 2)[:2]
        odometer.wheels(left, right, time.monotonic())

    def ranges(self) -> tuple[Array, Array]:
        """See `Driver`."""
        sound, light = len(protocol.SOUND_BEARING), len(protocol.LIGHT_BEARING)
        distances = (
            protocol.sound_distance(np.array(self._ask("G", sound)[:sound])),
            protocol.light_distance(np.array(self._ask("N", light)[:light])),
        )
        return np.concatenate([protocol.SOUND_BEARING, protocol.LIGHT_BEARING]), np.concatenate(distances)

    def battery(self) -> float:
        """See `Driver`."""
        return 0.01 * self._ask("V,5", 1)[0]

    def _ask(self, request: str, count: int = 0) -> list[float]:
        """Numbers of the answer, at least `count` of them."""
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
            raise Unintelligible(f"answers {request} with {answer[:40]!r}; is it K-Team's kh4server?")
        return values


@dataclass(frozen=True)
class Heard:
    """What a robot said last; `stamp` is when, monotonic [s]."""

    stamp: float = -math.inf
    x: float = math.nan
    y: float = math.nan
    yaw: float = math.nan
    velocity: tuple[float, float] = (math.nan, math.nan)


class Link:
    """The thread of one robot. What it heard and what it shall do are exchanged whole, so nobody waits for anybody.

    Attributes:
        heard: The newest odometry.
        scan: When the range sensors were read, their bearings and distances; None before.
        battery: Charge, 0 to 1, or NaN.
        wanted: v [m/s], ω [rad/s], and when they were given, monotonic [s].
        halted: Since when it must stand, monotonic [s]; infinity if it need not.
        trouble: Why there is no connection, for people; empty if there is one.
    """

    def __init__(
        self, name: str, address: Address, chosen: protocol.Settings, start: tuple[float, float, float]
    ) -> None:
        self.heard = Heard()
        self.scan: tuple[float, Array, Array] | None = None
        self.battery = math.nan
        self.wanted = (0.0, 0.0, -math.inf)
        self.halted = math.inf
        self.trouble = f"{address}: not connected yet"
        self._address, self._settings = address, chosen
        self._odometer = Odometer(*start)
        self._stands = True  # as far as it was told, and that was answered
        self._until = math.inf
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"{name} link", daemon=True)

    def start(self) -> None:
        """Connects, in the background and for ever."""
        self._thread.start()

    def drive(self, v: float, turn: float, now: float) -> None:
        """Must move at v [m/s], ω [rad/s] until told otherwise, or until nobody has said so for `FRESH_S`."""
        if v or turn:
            self.halted = math.inf
        self.wanted = (v, turn, now)

    def halt(self, now: float) -> None:
        """Must stand."""
        self.halted = min(self.halted, now)
        self.wanted = (0.0, 0.0, now)

    def unanswered(self, now: float) -> bool:
        """Whether it was told to stand, and is not known to."""
        return now - self.halted > ANSWER_S and not (self._stands and math.hypot(*self.heard.velocity) < STANDING)

    def end(self) -> None:
        """Has the thread stop the wheels and let go of the robot; `join` waits for it."""
        self._until = time.monotonic() + FAREWELL_S
        self._ending.set()

    def join(self) -> None:
        """Waits until the robot was let go of."""
        if self._thread.ident is not None:
            self._thread.join()

    @property
    def exhausted(self) -> bool:
        """Whether its battery is too low to drive on."""
        return self.battery < self._settings.low_battery

    def _run(self) -> None:
        while not self._over:
            try:
                wire = self._address.connect()
            except OSError as error:
                self.trouble = f"{self._address}: {error.strerror or error}; {self._remedy(error)}"
            else:
                try:
                    self._converse(KTeam(wire, self._settings) if self._address.kteam else Park(wire, self._settings))
                except TROUBLE as error:  # whatever it is, the wheels must stop
                    why = error.strerror if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
                    self.trouble = f"{self._address}: {why or error}"
                    if isinstance(error, TimeoutError):
                        self.trouble += "; another program may hold it, or it speaks the other protocol"
                finally:
                    wire.close()
                self._odometer.reconnected()
            if not self._ending.wait(RETRY_S):
                continue
            if not self._over:
                time.sleep(AGAIN_S)

    @property
    def _over(self) -> bool:
        """Whether it is let go of, which must not move then."""
        return self._ending.is_set() and (self._stands or time.monotonic() > self._until)

    def _remedy(self, error: OSError) -> str:
        if isinstance(error, BlockingIOError):
            return "end it first"
        if self._address.serial:
            return "is it plugged in, and may you use it (group dialout)?"
        if isinstance(error, ConnectionRefusedError):
            return "start the server on the robot"
        return "is the robot on, and is the address right?"

    def _converse(self, driver: Driver) -> None:
        """One connection, until it breaks or the process ends."""
        driver.begin()
        driver.drive(0.0, 0.0)
        driver.move(self._odometer)  # before it moves: one that counts from zero has been switched on anew
        self._stands = True
        period = 1.0 / self._settings.poll_hz
        ranges_due = battery_due = due = time.monotonic()
        while not self._ending.wait(max(0.0, due - time.monotonic())):
            due = max(due + period, time.monotonic())
            twist = self._due_twist()
            self._stands = self._stands and not any(twist)
            driver.drive(*twist)
            driver.move(self._odometer)
            self._stands = not any(twist)
            now, at = time.monotonic(), self._odometer
            self.heard = Heard(now, at.x, at.y, at.yaw, at.velocity)
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

    def _due_twist(self) -> tuple[float, float]:
        v, turn, since = self.wanted
        if self.exhausted or time.monotonic() - since > FRESH_S:
            return 0.0, 0.0
        return v, turn
