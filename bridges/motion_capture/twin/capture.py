"""Protocol twins of motion capture systems: servers with the true poses of the other twins, and their faults.

`python -m bridges.motion_capture.twin.capture vicon CF01 KH01` receives the true poses on Zenoh; the classes take them
directly.
"""

from __future__ import annotations

import pkgutil
import socket
import threading
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, ClassVar, Final, Literal

import msgspec
import numpy as np
import zenoh
from msgspec import Meta

from agents.body.byte_stream import Framer, MalformedStream
from agents.body.coordinates import Coordinates
from agents.clock import Clock, uptime
from agents.network import messages, pubsub, validation
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.shutdown import Farewell, closing_cleanly, end
from agents.plugins import registry
from agents.runtime import command_line
from agents.runtime.command_line import NetworkLaunch, on_termination
from agents.runtime.lifeline import Lifeline
from agents.ticks import Ticks
from twins.arrays import Array
from twins.device import Capture, CaptureFault, Faults, FaultyLink, Server, serve_until_next

BACKLOG: Final = 1 << 18  # [bytes] largest queue of a client; a slower client misses frames
FRESH_S: Final = 0.5  # a robot with an older true pose is not visible


def upright(yaw: float) -> Array:
    """Rotation (3, 3) to the world of an upright body at `yaw` [rad]."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class SeenBody:
    """Body in a frame: its name, position (3,) [m], rotation to the world (3, 3), and whether it is tracked."""

    name: str
    position: Array
    rotation: Array
    tracked: bool


class CaptureTwin(Server):
    """Motion capture of bodies with poses set by `place`.

    Attributes:
        link: Its faults, and what waits to be sent.
        latency_s: Reported age of the frames [s].
    """

    address: str  # HOST:PORT of the server

    def __init__(
        self,
        bodies: Sequence[str],
        *,
        rate_hz: float = 100.0,
        sigma: float = 0.0,
        rng: np.random.Generator | None = None,
        faults: Faults | None = None,
        host: str = "127.0.0.1",
        port: int = 0,
    ) -> None:
        """Start to listen; raises OSError if listening fails.

        Args:
            bodies: Names of the bodies, as clients see them.
            sigma: White noise of the positions, per axis [m].
            port: 0 for any free port.
        """
        self._bodies = list(bodies)
        self._rate, self._sigma = rate_hz, sigma
        self._rng = rng or np.random.default_rng(0)
        self.link = FaultyLink[bytes](faults or Faults(), self._rng)
        self._position = np.zeros((len(self._bodies), 3))
        self._rotation = np.repeat(np.eye(3)[None], len(self._bodies), axis=0)
        self._visible = np.zeros(len(self._bodies), dtype=bool)
        self.latency_s = 0.0
        # fault of the last frame, its subject and its size
        self._fault: tuple[CaptureFault, int, float] = "", 0, 0.0
        self._capture = Capture(self._rng)
        self._last: tuple[int, list[SeenBody]] = 0, []  # number and bodies of the last frame without a fault
        self._overtaken: bytes | None = None  # frame that the next one overtakes
        self.frames_sent = 0
        self._listen(host, port)

    def place(self, row: int, position: Array, rotation: Array) -> None:
        """Set position (3,) [m] and rotation to the world (3, 3) of a body, and make it visible."""
        self._position[row], self._rotation[row] = position, rotation
        self._visible[row] = True

    def hide(self, row: int) -> None:
        """Make a body invisible."""
        self._visible[row] = False

    def advance(self, t: float) -> None:
        """Send the frame that is due at `t` [s], if any."""
        self.link.t = t
        due = int(t * self._rate + 1e-6)
        if due > self.frames_sent:
            self.frames_sent = due  # missed frames are not repeated
            if not self.link.lost():
                self._send_frame(t)
        for frame in self.link.due():
            self._deliver(frame)

    def _send_frame(self, t: float) -> None:
        before, self._fault = self._fault, self.link.faults.captured(t)
        fault, subject, _ = self._fault
        if before != self._fault and "renamed" in (before[0], fault):
            self._rename()
        if fault not in ("frozen", "repeated"):
            swapped = [subject, subject + 1] if fault == "swapped" else []
            self._last = self.frames_sent, self._poses(t, swapped)
        number, bodies = self._last
        if fault == "missing":
            bodies = [body for row, body in enumerate(bodies) if row != subject % len(bodies)]
        frame = self._encode(number if fault == "repeated" else self.frames_sent, t, bodies)
        if fault == "damaged":
            places = self._rng.integers(0, len(frame), 1 + len(frame) // 20)
            changed = bytearray(frame)
            for place in places.tolist():
                changed[place] = int(self._rng.integers(0, 256))
            frame = bytes(changed)
        if fault == "overtaking" and self._overtaken is None:
            self._overtaken = frame
            return
        self.link.put(frame)
        if self._overtaken is not None:
            self.link.put(self._overtaken)
            self._overtaken = None

    def _names(self) -> list[str]:
        """Names of the bodies now."""
        names = list(self._bodies)
        fault, subject, _ = self._fault
        if fault == "renamed":
            names[subject % len(names)] += "-renamed"
        return names

    def _poses(self, t: float, swapped: Sequence[int]) -> list[SeenBody]:
        """Poses of all bodies, of which two may be swapped."""
        position, rotation = self._position.copy(), self._rotation.copy()
        position, rotation, turn = self._capture.measured(self.link.faults, t, position, rotation)
        if self._sigma > 0.0:
            position = position + self._rng.normal(0.0, self._sigma, position.shape)
        rows = list(range(len(self._bodies)))
        for one, other in zip(swapped, reversed(swapped), strict=True):
            rows[one % len(rows)] = other % len(rows)
        seen = self._visible & (not self.link.faults.occluded(t))
        return [
            SeenBody(name, position[row], rotation[row] @ upright(turn[row]), bool(seen[row]))
            for name, row in zip(self._names(), rows, strict=True)
        ]

    @abstractmethod
    def _listen(self, host: str, port: int) -> None:
        """Open the sockets, and set `address`."""

    @abstractmethod
    def _encode(self, number: int, t: float, bodies: Sequence[SeenBody]) -> bytes:
        """A frame as the protocol has it; its clock is `t` [s]."""

    @abstractmethod
    def _deliver(self, frame: bytes) -> None:
        """Send a frame to the clients."""

    @abstractmethod
    def _rename(self) -> None:
        """Note that a name has changed."""


@dataclass(eq=False)
class CaptureClient:
    """Connection of a client over TCP."""

    framer: Framer
    unsent: bytearray
    streams: bool = False
    asked: int = 0  # single frames requested
    named: bool = False  # names of the bodies were sent
    camera: str = ""  # name of the camera of which it gets the images


class StreamTwin(CaptureTwin):
    """Motion capture over TCP."""

    WELCOME: ClassVar = b""  # first bytes to a client
    framer: ClassVar[Callable[[], Framer]]  # framer of the packets of a client
    clients: dict[socket.socket, CaptureClient]

    def _listen(self, host: str, port: int) -> None:
        self._listener = socket.create_server((host, port))
        self._listener.setblocking(False)
        self.clients = {}
        self.address = f"{host}:{self._listener.getsockname()[1]}"

    def sockets(self) -> Sequence[socket.socket]:
        return [self._listener, *self.clients]

    def serve(self, ready: socket.socket, t: float) -> None:
        if ready is self._listener:
            self._accept()
        elif ready in self.clients:
            self._receive(ready, t)

    def advance(self, t: float) -> None:
        super().advance(t)
        for connection, client in list(self.clients.items()):
            self._flush(connection, client)

    def close(self) -> None:
        for connection in (self._listener, *self.clients):
            connection.close()
        self.clients.clear()

    @abstractmethod
    def _answer(self, client: CaptureClient, kind: int, payload: bytes) -> None:
        """Take in a packet of a client; raises MalformedStream for what the protocol has not."""

    @abstractmethod
    def _packet(self, client: CaptureClient, frame: bytes) -> bytes:
        """The packet with which a client gets a frame."""

    def _rename(self) -> None:
        for client in self.clients.values():
            client.named = False

    def new_client(self) -> CaptureClient:
        """A client that has just connected."""
        return CaptureClient(type(self).framer(), bytearray(self.WELCOME))

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:  # the client has left already
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BACKLOG)
        self.clients[connection] = self.new_client()
        self._flush(connection, self.clients[connection])

    def _receive(self, connection: socket.socket, t: float) -> None:
        client = self.clients[connection]
        try:
            received = connection.recv(65536)
            if not received:
                raise ConnectionResetError
            if not self.link.silent(t):
                for kind, payload in client.framer.feed(received):
                    self._answer(client, kind, payload)
        except BlockingIOError:
            return
        except (OSError, MalformedStream):
            self._drop(connection)
        else:
            self._flush(connection, client)

    def _drop(self, connection: socket.socket) -> None:
        del self.clients[connection]
        connection.close()

    def _deliver(self, frame: bytes) -> None:
        for client in self.clients.values():
            if not (client.streams or client.asked) or len(client.unsent) > BACKLOG:
                continue
            client.unsent += self._packet(client, frame)
            client.named = True
            client.asked = max(0, client.asked - 1)

    def _flush(self, connection: socket.socket, client: CaptureClient) -> None:
        if not client.unsent:
            return
        try:
            del client.unsent[: connection.send(client.unsent)]
        except BlockingIOError:
            return
        except OSError:
            self._drop(connection)


class TruthSubscription:
    """True poses of the robots' twins, received on Zenoh."""

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        robots: Sequence[str],
        coordinates: Coordinates = Coordinates(),  # noqa: B008 - frozen
    ) -> None:
        """Subscribe to the true poses of `robots`; `coordinates` of the arena in the system."""
        self._robots, self._coordinates = list(robots), coordinates
        self._inboxes = [
            pubsub.Inbox(pubsub.subscriber(session, keys.truth(robot), 4), messages.Position, keys=keys)
            for robot in robots
        ]
        self._stamp = np.full(len(self._robots), -np.inf)

    def update(self, capture: CaptureTwin, now: float) -> None:
        """Place every robot with a fresh pose at UTC time `now` [s], and hide the others."""
        check = partial(validation.check_position, now=now, valid_box=validation.ANY_ROOM)
        for row, inbox in enumerate(self._inboxes):
            for truth in inbox.read(check):
                self._stamp[row] = truth.stamp
                position, yaw = self._coordinates.measured(truth.position, truth.yaw or 0.0)
                capture.place(row, np.array(position), upright(yaw))
        age = now - self._stamp
        fresh = age <= FRESH_S
        for row in np.flatnonzero(~fresh).tolist():
            capture.hide(row)
        capture.latency_s = max(0.0, float(age[fresh].mean())) if fresh.any() else 0.0


class CaptureTwinLaunch(NetworkLaunch, frozen=True, kw_only=True, rename="kebab"):
    """A simulated motion capture system that sees simulated robots."""

    system: Annotated[str, Meta(title="SYSTEM", description="vicon, optitrack, qualisys or cameras")]
    robots: Annotated[list[str], Meta(title="ROBOT[=BODY]", description="robots, and their names in the system")]
    listen: Annotated[str, Meta(title="HOST:PORT")] = "127.0.0.1:0"
    rate: Annotated[float, Meta(ge=1, le=1000, title="HZ", description="frames per second")] = 100.0
    sigma: Annotated[float, Meta(ge=0, lt=1, title="METRES", description="noise of the positions")] = 0.0003
    seed: Annotated[int, Meta(ge=0, description="of the noise")] = 0
    faults: Annotated[str, Meta(title="JSON", description="such as '{\"occluded_from_s\": 5}'")] = "{}"
    up: Annotated[Literal["y", "z"] | None, Meta(title="AXIS", description="axis that points up, of optitrack")] = None
    origin: Annotated[str, Meta(title="X,Y,Z", description="centre of the arena's floor in the system [m]")] = "0,0,0"
    heading: Annotated[float, Meta(title="RAD", description="yaw of the arena's x axis in the system")] = 0.0
    unit: Annotated[Literal["m"], Meta(title="UNIT", description="m")] = "m"
    version: Annotated[str | None, Meta(title="MAJOR.MINOR", description="version of NatNet, of optitrack")] = None
    multicast: Annotated[bool, Meta(description="frames go to a group on this machine, of optitrack")] = False
    file: Annotated[str | None, Meta(title="FILE", description="cameras and tags, of cameras")] = None

    def twin(self, faults: Faults) -> CaptureTwin:
        """The twin; raises OSError where it cannot listen, ValueError for a system without twin."""
        path = registry.load(registry.POSITIONING, self.system).TWIN
        if not path:
            raise ValueError(f"{self.system} has no protocol twin")
        host, port = parse_address(self.listen)
        special: dict[str, Any] = {
            "up": self.up, "multicast": self.multicast or None, "version": self.version, "file": self.file
        }  # fmt: skip
        made: CaptureTwin = pkgutil.resolve_name(path)(
            [robot.partition("=")[2] or robot for robot in self.robots],
            rate_hz=self.rate, sigma=self.sigma, rng=np.random.default_rng(self.seed), faults=faults, host=host,
            port=port, **{name: value for name, value in special.items() if value is not None},
        )  # fmt: skip
        return made


def parse_address(text: str) -> tuple[str, int]:
    """Host and port of "HOST:PORT"; raises ValueError if it is none."""
    host, _, port = text.rpartition(":")
    if not (host and port.isascii() and port.isdigit() and int(port) < 65536):
        raise ValueError(f"'{text}' is not HOST:PORT, such as 127.0.0.1:801")
    return host, int(port)


def run(launch: CaptureTwinLaunch) -> int:
    """Run the twin until a signal, or until its lifeline is lost and the robots are gone; returns the exit code."""
    parse_address(launch.listen)
    faults = msgspec.json.decode(launch.faults, type=Faults)
    coordinates = Coordinates.parse(launch.up, launch.unit, launch.origin, launch.heading)
    robots = [robot.partition("=")[0] for robot in launch.robots]
    stop, lost = threading.Event(), threading.Event()
    if launch.lifeline:
        Lifeline(lost).start()
    identity = launch.identity or "twin"
    with (
        on_termination(stop.set),
        closing_cleanly(
            network.open_session(launch.endpoints(), name=f"{launch.system}-twin", stop=stop, identity=identity)
        ) as opened,
    ):
        session, declared = opened
        try:
            capture = launch.twin(faults)
        except OSError as error:
            raise ValueError(f"cannot listen on {launch.listen}: {error.strerror}; choose another port") from None
        print(f"{launch.system} ready on {capture.address}", flush=True)
        try:
            keys = Keys(launch.realm)
            farewell = Farewell(session, keys, robots, lost)
            truth = TruthSubscription(session, keys, robots, coordinates)
            declared += [farewell, truth]
            ticks, clock = Ticks(launch.rate, clock=uptime), Clock()
            while not (stop.is_set() or farewell.over()):
                t = serve_until_next(capture, ticks)
                truth.update(capture, clock.utc())
                capture.advance(t)
        finally:
            capture.close()
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line of the process."""
    return command_line.run("motion capture twin", CaptureTwinLaunch, run, arguments, (ValueError, RecursionError))


if __name__ == "__main__":
    end(main)
