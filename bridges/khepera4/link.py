"""Link to one Khepera IV: a thread that runs one of its two protocols and reconnects after a loss."""

from __future__ import annotations

import contextlib
import fcntl
import math
import os
import socket
import sys
import termios
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final
from urllib.parse import parse_qsl, urlsplit

from agents.body.interface import FRESH_S, UNANSWERED_S, BodyError
from agents.clock import uptime
from agents.ticks import Ticks
from bridges.khepera4 import protocol
from bridges.khepera4.drivers import FIRST_ANSWER_S, Driver, KTeam, Wire, WrongServer, identify
from bridges.khepera4.odometry import Odometer

CONNECT_S: Final = 1.5
RETRY_S: Final = 0.5  # pause between the end of a connection and the next attempt
STOPS: Final = 3  # stop commands at the end of the link
RANGES_S: Final = 0.2
BATTERY_S: Final = 5.0
STOP_TRIES_S: Final = 3.0  # time for attempts to stop a robot after its connection broke in motion
STOP_RETRY_S: Final = 0.1  # pause between two such attempts
STANDING: Final = 0.02  # [m/s] slower robots stand
AGAIN_S: Final = 0.2  # period of stops to a silent robot, which obeys as soon as it receives again
KEEP_S: Final = 20.0  # time of stops to a silent robot over the same connection: most servers accept no other
TCP_THIN_LINEAR_TIMEOUTS: Final = 16  # option of Linux: the first repetitions of lost bytes wait no longer
FORM: Final = (
    "write khepera4://HOST for Robotic Park's server, kteam://HOST:PORT or kteam:///dev/ttyS0 for K-Team's kh4server"
)


@dataclass(frozen=True)
class KheperaAddress:
    """Address and protocol of a robot: `khepera4://HOST[:PORT][?server=2023-01-07]`, `kteam://HOST:PORT` or
    `kteam:///dev/ttyS0`.
    """

    kteam: bool
    host: str
    port: int
    serial: str
    server: str | None  # name among Robotic Park's; None: not named

    @classmethod
    def parse(cls, robot: str, address: str) -> KheperaAddress:
        """Parse an address; raises BodyError if it has none of the three forms."""
        try:
            parts = urlsplit(address)
            host, port = parts.hostname or "", parts.port
        except ValueError as error:
            raise BodyError(f"{robot}: '{address}': {error}; {FORM}") from error
        kteam = parts.scheme == "kteam"
        if kteam and not host and parts.path:
            return cls(kteam, "", 0, parts.path, None)
        if parts.scheme not in ("khepera4", "kteam") or not host or (kteam and not port):
            raise BodyError(f"{robot}: '{address}' is no Khepera's address; {FORM}")
        asked = dict(parse_qsl(parts.query, keep_blank_values=True))
        server = asked.pop("server", None)
        if asked or (server is not None and (kteam or server not in protocol.PARK)):
            raise BodyError(
                f"{robot}: '{address}' asks for something else; after '?' comes server=, for Robotic Park's: "
                f"{', '.join(protocol.PARK)}"
            )
        return cls(kteam, host, port or protocol.PARK_PORT, "", server)

    def server_of(self, robot: str, chosen: protocol.Khepera4Settings) -> str | None:
        """The server by address and `device` table, None if neither names one; raises BodyError if they differ."""
        named = chosen.server or self.server
        if named is not None and ((named == "kteam") != self.kteam or (self.server or named) != named):
            raise BodyError(
                f"{robot}: device.server is '{chosen.server}', but {self} is the address of "
                f"{self.server or ('K-Team' if self.kteam else 'Robotic Park')}'s server; leave server out"
            )
        return named

    def __str__(self) -> str:
        return self.serial or f"{self.host}:{self.port}"

    def connect(self) -> Wire:
        """Open the connection or line; raises OSError if that fails."""
        if not self.serial:
            wire = socket.create_connection((self.host, self.port), CONNECT_S)
            wire.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if sys.platform == "linux":
                wire.setsockopt(socket.IPPROTO_TCP, TCP_THIN_LINEAR_TIMEOUTS, 1)
            return Wire(wire.fileno(), wire.close)
        line = os.open(self.serial, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            fcntl.flock(line, fcntl.LOCK_EX | fcntl.LOCK_NB)  # locked first: another process may drive the robot
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


@dataclass(frozen=True)
class KheperaOdometry:
    """Newest odometry of a robot, in the experiment's frame."""

    stamp: float = -math.inf  # time of reception [s, `uptime`]
    x: float = math.nan  # [m]
    y: float = math.nan  # [m]
    yaw: float = math.nan  # [rad]
    velocity: tuple[float, float] = (math.nan, math.nan)  # [m/s]


class Khepera4Link:
    """Thread of one robot. Odometry and setpoint are exchanged as whole objects, so neither side waits."""

    def __init__(
        self,
        name: str,
        address: KheperaAddress,
        chosen: protocol.Khepera4Settings,
        start: tuple[float, float, float],
        first_answer_s: float = FIRST_ANSWER_S,
    ) -> None:
        self.odometry = KheperaOdometry()
        self.scan: tuple[float, Sequence[float], Sequence[float]] | None = (
            None  # time [s, `uptime`], bearings [rad], distances [m]
        )
        self.battery = math.nan  # charge, 0 to 1
        self.setpoint = (0.0, 0.0, -math.inf)  # v [m/s], ω [rad/s], time [s, `uptime`] of what it was decided on
        self.halted_since = math.inf  # [s, `uptime`]; infinity while the robot may move
        self.refused = False  # the server must not be driven; it is not tried again
        self.server = ""  # name by the robot's answers; empty while not known
        self.trouble = f"{address}: not connected yet"  # reason for users; empty while connected
        self._address, self._settings = address, chosen
        self._server = address.server_of(name, chosen)
        self._odometer, self._first_answer_s = Odometer(*start), first_answer_s
        self._stands = True  # True by the last command that was answered
        self._stop_deadline = math.inf
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"{name} link", daemon=True)

    def start(self) -> None:
        """Start the thread, which connects and reconnects until `end`."""
        self._thread.start()

    def drive(self, v: float, turn: float, decided: float) -> None:
        """Drive at v [m/s], ω [rad/s], `decided` on the state of that time [s, `uptime`], for `FRESH_S` from then."""
        if v or turn:
            if decided < self.halted_since < math.inf:
                return  # a stop from another thread came after that decision
            self.halted_since = math.inf
        self.setpoint = (v, turn, decided)

    def halt(self, now: float) -> None:
        """Stop the robot."""
        self.halted_since = min(self.halted_since, now)
        self.setpoint = (0.0, 0.0, -math.inf)

    def unanswered(self, now: float) -> bool:
        """Whether a halt is not confirmed by odometry in time."""
        return now - self.halted_since > UNANSWERED_S and not (
            self._stands and math.hypot(*self.odometry.velocity) < STANDING
        )

    def end(self) -> None:
        """Ask the thread to stop the wheels and end; `join` waits for it."""
        self._stop_deadline = uptime() + STOP_TRIES_S
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
            except Exception as error:  # noqa: BLE001 - of any kind: it is tried again
                self.trouble = f"{self._address}: {_text(error)}; {self._remedy(error)}"
            else:
                try:
                    if self._address.kteam:
                        self.server = "kteam"
                        self._run_connection(KTeam(wire, self._settings))
                    else:
                        park = identify(
                            wire, self._settings, self._server, self._first_answer_s, lambda: self._finished
                        )
                        self.server = next(name for name, kind in protocol.PARK.items() if kind is park.server)
                        self._run_connection(park)
                except Exception as error:  # noqa: BLE001 - of any kind: the wheels must stop
                    self.trouble = f"{self._address}: {_text(error)}"
                    if isinstance(error, TimeoutError):
                        self.trouble += "; another program may hold it, or the robot uses the other protocol"
                    if isinstance(error, WrongServer) and self.odometry.stamp == -math.inf:  # else noise
                        self.refused = True
                        return
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
        return self._ending.is_set() and (self._stands or uptime() > self._stop_deadline)

    def _remedy(self, error: Exception) -> str:
        if isinstance(error, BlockingIOError):
            return "end it first"
        if self._address.serial:
            return "is the line plugged in, and are you permitted to use it (group dialout)?"
        if isinstance(error, ConnectionRefusedError):
            return "start the server on the robot"
        return "is the robot on, and is the address right?"

    def _run_connection(self, driver: Driver) -> None:
        """Loop of one connection, until it breaks or the link ends; first and last command are stops."""
        driver.begin()
        try:
            self._exchange(driver)
        except Exception:
            with contextlib.suppress(Exception):  # most servers drive on without a client, some accept no other
                driver.drive(0.0, 0.0)
            raise

    def _exchange(self, driver: Driver) -> None:
        driver.move(self._odometer)  # asked before any motion: counters at zero show a restart of the robot
        self._stands = True
        ticks = Ticks(self._settings.poll_hz, clock=uptime)
        ranges_due = battery_due = answered = ticks.zero
        silent = False
        while not self._ending.wait(ticks.until_next()):
            ticks.begin()
            v, turn, until = (0.0, 0.0, math.inf) if silent else self.current_twist()
            moves = v != 0.0 or turn != 0.0
            self._stands = self._stands and not moves
            try:
                driver.drive(v, turn, until)
                driver.move(self._odometer)
            except TimeoutError as error:
                # stops wait in the connection until the robot receives again; the next exchange after that stops it
                self.trouble = f"{self._address}: {error}; it gets stops until it answers"
                silent, driver.patience_s = True, AGAIN_S
                if uptime() - answered > KEEP_S:
                    raise
                continue
            silent, driver.patience_s = False, self._settings.silence_s
            self._stands = not moves
            now, at = uptime(), self._odometer
            answered = now
            self.odometry = KheperaOdometry(now, at.x, at.y, at.yaw, at.velocity)
            self.trouble = ""
            try:
                if driver.ranged and now >= ranges_due:
                    ranges_due = now + RANGES_S
                    bearing, distance = driver.ranges()
                    self.scan = (now, bearing, distance)
                if now >= battery_due:
                    battery_due = now + BATTERY_S
                    self.battery = driver.battery()
            except TimeoutError:
                silent = True
        self._stop_and_confirm(driver)

    def _stop_and_confirm(self, driver: Driver) -> None:
        """Stop the robot at the end of the link, until an answer shows that it has read that."""
        while True:
            try:
                for _ in range(STOPS):
                    driver.drive(0.0, 0.0)
                driver.move(self._odometer)
            except TimeoutError:
                if uptime() > self._stop_deadline:
                    raise
                continue
            self._stands = True
            return

    def current_twist(self) -> tuple[float, float, float]:
        """v [m/s], ω [rad/s], and until when they may be sent [s, `uptime`]."""
        v, turn, decided = self.setpoint
        if self.battery_empty or uptime() > decided + FRESH_S:
            return 0.0, 0.0, math.inf
        return v, turn, decided + FRESH_S


def _text(error: Exception) -> str:
    return error.strerror or str(error) if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
