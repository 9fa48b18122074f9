"""Protocol twin of a Vicon: a DataStream server with the true poses of the other twins.

`python -m twins.devices.vicon --robots CF01 KH01` receives the true poses on Zenoh; the class takes them directly.
"""

from __future__ import annotations

import argparse
import select
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final

import msgspec
import numpy as np
import zenoh

from agents.arrays import Array
from agents.clock import Clock
from agents.network import messages, pubsub, validation
from agents.network import session as network
from agents.network.endpoints import EndpointError
from agents.network.keys import Keys
from agents.network.shutdown import Farewell
from agents.protocols import vicon_datastream
from agents.protocols.vicon_datastream import Framer, Kind, Malformed, Segment
from agents.runtime.command_line import add_network, on_termination, reached
from agents.runtime.lifeline import Lifeline
from twins.devices.device import Faults

BACKLOG: Final = 1 << 18  # [bytes] largest queue of a client; a slower client misses frames
REACH: Final = (1e3, 1e3, 1e3)  # [m] bounds of valid positions: any room
FRESH_S: Final = 0.5  # a robot whose true pose is older is not visible


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


class ViconTwin:
    """DataStream server for subjects whose poses are set by `place`."""

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
        """Start to listen.

        Args:
            subjects: Names of the bodies, as clients see them.
            rate_hz: Frames per second.
            sigma: White noise of the positions, per axis [m].
            rng: Generator of the noise.
            faults: Silence, delay, occlusion.
            host: Address to listen on.
            port: 0 for any free port.

        Raises:
            OSError: If listening fails.
        """
        self._subjects = list(subjects)
        self._rate, self._sigma, self._rng = rate_hz, sigma, rng or np.random.default_rng(0)
        self._faults = faults or Faults()
        self._position = np.zeros((len(self._subjects), 3))
        self._rotation = np.repeat(np.eye(3)[None], len(self._subjects), axis=0)
        self._visible = np.zeros(len(self._subjects), dtype=bool)
        self.latency_s = 0.0  # reported age of the frames
        self._frames = 0
        self._delayed: deque[tuple[float, bytes]] = deque()
        self._names = b"".join(
            [vicon_datastream.pack_stream_info(rate_hz), vicon_datastream.pack_axes()]
            + [vicon_datastream.pack_subject(number, name) for number, name in enumerate(self._subjects)]
        )
        self._listener = socket.create_server((host, port))
        self._listener.setblocking(False)
        self._clients: dict[socket.socket, _Client] = {}
        self.address = f"{host}:{self._listener.getsockname()[1]}"

    def place(self, row: int, position: Array, rotation: Array) -> None:
        """Set position (3,) [m] and rotation to the world (3, 3) of a subject, and make it visible."""
        self._position[row], self._rotation[row], self._visible[row] = position, rotation, True

    def hide(self, row: int) -> None:
        """Make a subject invisible."""
        self._visible[row] = False

    def set_faults(self, faults: Faults) -> None:
        """Replace the injected faults."""
        self._faults = faults

    def sockets(self) -> Sequence[socket.socket]:
        """See `twins.devices.device.Device.sockets`."""
        return [self._listener, *self._clients]

    def serve(self, ready: socket.socket, t: float) -> None:
        """See `twins.devices.device.Device.serve`."""
        if ready is self._listener:
            self._accept()
        elif ready in self._clients:
            self._receive(ready, t)

    def advance(self, t: float) -> None:
        """Send the frame that is due at `t` [s], if any."""
        due = int(t * self._rate + 1e-6)
        if due > self._frames:
            self._frames = due  # missed frames are not repeated
            if not self._faults.silent(t):
                self._delayed.append((t + self._faults.delay_s, self._frame(t)))
        while self._delayed and self._delayed[0][0] <= t:
            self._send(self._delayed.popleft()[1])
        for connection, client in list(self._clients.items()):
            self._flush(connection, client)

    def close(self) -> None:
        """See `twins.devices.device.Device.close`."""
        for connection in (self._listener, *self._clients):
            connection.close()
        self._clients.clear()

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:  # the client has left already
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._clients[connection] = _Client(unsent=bytearray(vicon_datastream.pack_kinds(vicon_datastream.POSES)))
        self._flush(connection, self._clients[connection])

    def _receive(self, connection: socket.socket, t: float) -> None:
        client = self._clients[connection]
        try:
            received = connection.recv(65536)
            if not received:
                raise ConnectionResetError
            if self._faults.silent(t):
                return
            for body in client.framer.feed(received):
                for kind, payload in vicon_datastream.blocks(body):
                    if kind == Kind.REQUEST_FRAME:
                        client.streams = payload[:1] == b"\x01"
                        client.asked += not client.streams
                    elif kind == Kind.REQUEST_NEXT_FRAME:
                        client.asked += 1
        except BlockingIOError:
            return
        except (OSError, Malformed):
            self._drop(connection)

    def _drop(self, connection: socket.socket) -> None:
        del self._clients[connection]
        connection.close()

    def _frame(self, t: float) -> bytes:
        """Blocks of the current frame."""
        position = self._position
        if self._sigma > 0.0:
            position = position + self._rng.normal(0.0, self._sigma, position.shape)
        seen = self._visible & (not self._faults.occluded(t))
        frame = [
            vicon_datastream.pack_frame_number(self._frames),
            vicon_datastream.pack_latency([("Data Collected", self.latency_s)]),
        ]
        poses = zip(seen.tolist(), position.tolist(), self._rotation.reshape(-1, 9).tolist(), strict=True)
        for number, (visible, (x, y, z), rotation) in enumerate(poses):
            segments = [Segment(0, (x, y, z), tuple(rotation))] if visible else []
            frame.append(vicon_datastream.pack_segments(number, segments))
        return b"".join(frame)

    def _send(self, frame: bytes) -> None:
        for client in self._clients.values():
            if not (client.streams or client.asked) or len(client.unsent) > BACKLOG:
                continue
            client.unsent += vicon_datastream.packet(frame if client.named else self._names + frame)
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
        check = partial(validation.check_position, now=now, reach=REACH)
        for row, inbox in enumerate(self._inboxes):
            for truth in inbox.read(check):
                self._stamp[row] = truth.stamp
                vicon.place(row, np.array(truth.position), upright(truth.yaw or 0.0))
        age = now - self._stamp
        fresh = age <= FRESH_S
        for row in np.flatnonzero(~fresh).tolist():
            vicon.hide(row)
        vicon.latency_s = max(0.0, float(age[fresh].mean())) if fresh.any() else 0.0


def serve(vicon: ViconTwin, truth: TruthSubscription, rate_hz: float, over: Callable[[], bool]) -> None:
    """Serve until `over()`, with a frame every 1 / `rate_hz` [s]."""
    zero, clock = time.monotonic(), Clock()
    frame = 0
    while not over():
        wait = zero + (frame + 1) / rate_hz - time.monotonic()
        ready, _, _ = select.select(vicon.sockets(), [], [], max(0.0, wait))
        t = time.monotonic() - zero
        for waiting in ready:
            vicon.serve(waiting, t)
        if int(t * rate_hz) > frame:
            frame = int(t * rate_hz)
            truth.update(vicon, clock.utc())
        vicon.advance(t)


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not (host and port.isascii() and port.isdigit() and int(port) < 65536):
        raise argparse.ArgumentTypeError(f"'{text}' is not HOST:PORT, such as 127.0.0.1:801")
    return host, int(port)


def _faults(text: str) -> Faults:
    try:
        return msgspec.json.decode(text, type=Faults)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise argparse.ArgumentTypeError(f"{error}; write it like '{{\"occluded_from_s\": 5}}'") from None


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line of the process."""
    parser = argparse.ArgumentParser(prog="vicon twin", description="A simulated Vicon that sees simulated robots.")
    parser.add_argument("--robots", nargs="+", required=True, metavar="ROBOT", help="their names are the subjects'")
    parser.add_argument("--listen", type=_address, default=("127.0.0.1", 0), metavar="HOST:PORT")
    add_network(parser, "twin")
    parser.add_argument("--rate", type=float, default=100.0, metavar="HZ", help="frames per second")
    parser.add_argument("--sigma", type=float, default=0.0003, metavar="METRES", help="noise of the positions")
    parser.add_argument("--seed", type=int, default=0, help="of the noise")
    parser.add_argument("--faults", type=_faults, default=Faults(), metavar="JSON", help="injected faults")
    chosen = parser.parse_args(arguments)
    if not (1.0 <= chosen.rate <= 1000.0 and 0.0 <= chosen.sigma < 1.0 and chosen.seed >= 0):
        parser.error("--rate is 1 to 1000 Hz, --sigma 0 to 1 m, --seed not negative")
    stop, lost = threading.Event(), threading.Event()

    if chosen.lifeline:
        Lifeline(lost).start()
    host, port = chosen.listen
    try:
        with (
            on_termination(stop.set),
            network.open_session(reached(chosen), name="vicon-twin", stop=stop, identity=chosen.identity) as session,
        ):
            vicon = ViconTwin(
                chosen.robots,
                rate_hz=chosen.rate,
                sigma=chosen.sigma,
                rng=np.random.default_rng(chosen.seed),
                faults=chosen.faults,
                host=host,
                port=port,
            )
            print(f"vicon ready on {vicon.address}", flush=True)
            try:
                keys = Keys(chosen.realm)
                farewell = Farewell(session, keys, chosen.robots, lost)
                truth = TruthSubscription(session, keys, chosen.robots)
                serve(vicon, truth, chosen.rate, lambda: stop.is_set() or farewell.over())
            finally:
                vicon.close()
    except (network.Unreachable, EndpointError) as error:
        print(f"vicon twin: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"vicon twin: cannot listen on {host}:{port}: {error.strerror}; choose another port", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
