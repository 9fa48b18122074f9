"""Protocol twin of a Vicon: a DataStream server with the true poses of the other twins.

`python -m twins.devices.vicon CF01 KH01` receives the true poses on Zenoh; the class takes them directly.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Final

import msgspec
import numpy as np
import zenoh
from msgspec import Meta

from agents.clock import Clock, uptime
from agents.network import messages, pubsub, validation
from agents.network import session as network
from agents.network.keys import Keys
from agents.network.shutdown import Farewell, closing_cleanly, end
from agents.protocols import vicon_datastream
from agents.protocols.vicon_datastream import BlockKind, Framer, MalformedBlock, Segment
from agents.runtime import command_line
from agents.runtime.command_line import NetworkLaunch, on_termination
from agents.runtime.lifeline import Lifeline
from agents.ticks import Ticks
from twins.arrays import Array
from twins.devices.device import Capture, CaptureFault, Faults, FaultyLink, Server, serve_until_next

BACKLOG: Final = 1 << 18  # [bytes] largest queue of a client; a slower client misses frames
VALID_BOX: Final = (1e3, 1e3, 1e3)  # [m] bounds of valid positions: any room
FRESH_S: Final = 0.5  # a robot with an older true pose is not visible


def upright(yaw: float) -> Array:
    """Rotation (3, 3) to the world of an upright body at `yaw` [rad]."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


@dataclass(eq=False)
class _Client:
    """Connection of a client."""

    framer: Framer = field(default_factory=Framer)
    unsent: bytearray = field(default_factory=bytearray)
    streams: bool = False
    asked: int = 0  # single frames requested
    named: bool = False  # names of the subjects were sent


class ViconTwin(Server):
    """DataStream server for subjects with poses set by `place`.

    Attributes:
        link: Its faults, and what waits to be sent.
        latency_s: Reported age of the frames [s].
    """

    def __init__(
        self,
        subjects: Sequence[str],
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
            subjects: Names of the bodies, as clients see them.
            sigma: White noise of the positions, per axis [m].
            port: 0 for any free port.
        """
        self._subjects = list(subjects)
        self._rate, self._sigma = rate_hz, sigma
        self._rng = rng or np.random.default_rng(0)
        self.link = FaultyLink[bytes](faults or Faults())
        self._position = np.zeros((len(self._subjects), 3))
        self._rotation = np.repeat(np.eye(3)[None], len(self._subjects), axis=0)
        self._visible = np.zeros(len(self._subjects), dtype=bool)
        self.latency_s = 0.0
        self._told: tuple[CaptureFault, int, float] = "", 0, 0.0  # fault of the last frame, its subject and its size
        self._capture = Capture(self._rng)
        self._last = b"", b""  # the last frame without a fault: its number, its poses
        self.frames_sent = 0
        self._listener = socket.create_server((host, port))
        self._listener.setblocking(False)
        self.clients: dict[socket.socket, _Client] = {}
        self.address = f"{host}:{self._listener.getsockname()[1]}"

    def place(self, row: int, position: Array, rotation: Array) -> None:
        """Set position (3,) [m] and rotation to the world (3, 3) of a subject, and make it visible."""
        self._position[row], self._rotation[row] = position, rotation
        self._visible[row] = True

    def hide(self, row: int) -> None:
        """Make a subject invisible."""
        self._visible[row] = False

    def sockets(self) -> Sequence[socket.socket]:
        return [self._listener, *self.clients]

    def serve(self, ready: socket.socket, t: float) -> None:
        if ready is self._listener:
            self._accept()
        elif ready in self.clients:
            self._receive(ready, t)

    def advance(self, t: float) -> None:
        """Send the frame that is due at `t` [s], if any."""
        self.link.t = t
        due = int(t * self._rate + 1e-6)
        if due > self.frames_sent:
            self.frames_sent = due  # missed frames are not repeated
            if not self.link.silent(t):
                self.link.put(self._frame(t))
        for frame in self.link.due():
            self._send(frame)
        for connection, client in list(self.clients.items()):
            self._flush(connection, client)

    def close(self) -> None:
        for connection in (self._listener, *self.clients):
            connection.close()
        self.clients.clear()

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:  # the client has left already
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.clients[connection] = _Client(unsent=bytearray(vicon_datastream.pack_kinds(vicon_datastream.POSES)))
        self._flush(connection, self.clients[connection])

    def _receive(self, connection: socket.socket, t: float) -> None:
        client = self.clients[connection]
        try:
            received = connection.recv(65536)
            if not received:
                raise ConnectionResetError
            if self.link.silent(t):
                return
            for body in client.framer.feed(received):
                for kind, payload in vicon_datastream.blocks(body):
                    if kind == BlockKind.REQUEST_FRAME:
                        client.streams = payload[:1] == b"\x01"
                        client.asked += not client.streams
                    elif kind == BlockKind.REQUEST_NEXT_FRAME:
                        client.asked += 1
        except BlockingIOError:
            return
        except (OSError, MalformedBlock):
            self._drop(connection)

    def _drop(self, connection: socket.socket) -> None:
        del self.clients[connection]
        connection.close()

    def _names(self) -> bytes:
        """Blocks that describe the subjects."""
        names = list(self._subjects)
        fault, subject, _ = self._told
        if fault == "renamed":
            names[subject % len(names)] += "-renamed"
        return b"".join(
            [vicon_datastream.pack_stream_info(self._rate), vicon_datastream.pack_axes()]
            + [vicon_datastream.pack_subject(number, name) for number, name in enumerate(names)]
        )

    def _frame(self, t: float) -> bytes:
        """Blocks of the current frame."""
        before, self._told = self._told, self.link.faults.captured(t)
        fault, subject, _ = self._told
        if before != self._told and "renamed" in (before[0], fault):
            for client in self.clients.values():
                client.named = False
        head = vicon_datastream.pack_frame_number(self.frames_sent) + vicon_datastream.pack_latency(
            [("Data Collected", self.latency_s)]
        )
        if fault not in ("frozen", "repeated"):
            self._last = head, self._poses(t, [subject, subject + 1] if fault == "swapped" else [])
        return (self._last[0] if fault == "repeated" else head) + self._last[1]

    def _poses(self, t: float, swapped: Sequence[int]) -> bytes:
        """Blocks of the poses of all subjects, of which two may be swapped."""
        position, rotation, turn = self._capture.told(self.link.faults, t, self._position.copy(), self._rotation.copy())
        if self._sigma > 0.0:
            position = position + self._rng.normal(0.0, self._sigma, position.shape)
        rows = list(range(len(self._subjects)))
        for one, other in zip(swapped, reversed(swapped), strict=True):
            rows[one % len(rows)] = other % len(rows)
        seen = self._visible & (not self.link.faults.occluded(t))
        frame = b""
        for number, row in enumerate(rows):
            x, y, z = position[row].tolist()
            turned = tuple((rotation[row] @ upright(turn[row])).reshape(9).tolist())
            frame += vicon_datastream.pack_segments(number, [Segment(0, (x, y, z), turned)] if seen[row] else [])
        return frame

    def _send(self, frame: bytes) -> None:
        for client in self.clients.values():
            if not (client.streams or client.asked) or len(client.unsent) > BACKLOG:
                continue
            client.unsent += vicon_datastream.packet(frame if client.named else self._names() + frame)
            client.named = True
            client.asked = max(0, client.asked - 1)

    def _flush(self, connection: socket.socket, client: _Client) -> None:
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

    def __init__(self, session: zenoh.Session, keys: Keys, robots: Sequence[str]) -> None:
        self._robots = list(robots)
        self._inboxes = [
            pubsub.Inbox(pubsub.subscriber(session, keys.truth(robot), 4), messages.Position, keys=keys)
            for robot in robots
        ]
        self._stamp = np.full(len(self._robots), -np.inf)

    def update(self, vicon: ViconTwin, now: float) -> None:
        """Place every robot with a fresh pose at UTC time `now` [s], and hide the others."""
        check = partial(validation.check_position, now=now, valid_box=VALID_BOX)
        for row, inbox in enumerate(self._inboxes):
            for truth in inbox.read(check):
                self._stamp[row] = truth.stamp
                vicon.place(row, np.array(truth.position), upright(truth.yaw or 0.0))
        age = now - self._stamp
        fresh = age <= FRESH_S
        for row in np.flatnonzero(~fresh).tolist():
            vicon.hide(row)
        vicon.latency_s = max(0.0, float(age[fresh].mean())) if fresh.any() else 0.0


class ViconTwinLaunch(NetworkLaunch, frozen=True, kw_only=True, rename="kebab"):
    """A simulated Vicon that sees simulated robots."""

    robots: Annotated[list[str], Meta(title="ROBOT", description="their names are the subjects'")]
    listen: Annotated[str, Meta(title="HOST:PORT")] = "127.0.0.1:0"
    rate: Annotated[float, Meta(ge=1, le=1000, title="HZ", description="frames per second")] = 100.0
    sigma: Annotated[float, Meta(ge=0, lt=1, title="METRES", description="noise of the positions")] = 0.0003
    seed: Annotated[int, Meta(ge=0, description="of the noise")] = 0
    faults: Annotated[str, Meta(title="JSON", description="such as '{\"occluded_from_s\": 5}'")] = "{}"


def parse_address(text: str) -> tuple[str, int]:
    """Host and port of "HOST:PORT"; raises ValueError if it is none."""
    host, _, port = text.rpartition(":")
    if not (host and port.isascii() and port.isdigit() and int(port) < 65536):
        raise ValueError(f"'{text}' is not HOST:PORT, such as 127.0.0.1:801")
    return host, int(port)


def run(launch: ViconTwinLaunch) -> int:
    """Run the twin until a signal, or until its lifeline is lost and the robots are gone; returns the exit code."""
    host, port = parse_address(launch.listen)
    faults = msgspec.json.decode(launch.faults, type=Faults)
    stop, lost = threading.Event(), threading.Event()
    if launch.lifeline:
        Lifeline(lost).start()
    identity = launch.identity or "twin"
    with (
        on_termination(stop.set),
        closing_cleanly(
            network.open_session(launch.endpoints(), name="vicon-twin", stop=stop, identity=identity)
        ) as opened,
    ):
        session, declared = opened
        rng = np.random.default_rng(launch.seed)
        try:
            vicon = ViconTwin(
                launch.robots, rate_hz=launch.rate, sigma=launch.sigma, rng=rng, faults=faults, host=host, port=port
            )
        except OSError as error:
            raise ValueError(f"cannot listen on {launch.listen}: {error.strerror}; choose another port") from None
        print(f"vicon ready on {vicon.address}", flush=True)
        try:
            keys = Keys(launch.realm)
            farewell = Farewell(session, keys, launch.robots, lost)
            truth = TruthSubscription(session, keys, launch.robots)
            declared += [farewell, truth]
            ticks, clock = Ticks(launch.rate, clock=uptime), Clock()
            while not (stop.is_set() or farewell.over()):
                t = serve_until_next(vicon, ticks)
                truth.update(vicon, clock.utc())
                vicon.advance(t)
        finally:
            vicon.close()
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line of the process."""
    return command_line.run("vicon twin", ViconTwinLaunch, run, arguments, (ValueError, RecursionError))


if __name__ == "__main__":
    end(main())
