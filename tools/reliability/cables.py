"""Cables between robots and routers that can be cut, be slow, lose, and flip bits: TCP relays on loopback.

Why a relay: it needs neither root nor a kernel with a network emulator, works wherever zenpark does, and does to a TCP
connection what a bad cable does. Nothing is ever lost inside such a connection; what a network loses comes later, and
all behind it waits. So a lost segment is one that waits for its retransmission timeouts.
"""

from __future__ import annotations

import contextlib
import heapq
import selectors
import socket
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from typing import Final, Self

import numpy as np

READ_BYTES: Final = 65536
FULL_BYTES: Final = 1 << 20  # more than this under way: what comes must wait at its sender
RETRANSMIT_S: Final = 0.2  # the least timeout of Linux; it doubles each time
IDLE_S: Final = 0.2


@dataclass(frozen=True)
class Condition:
    """What a cable does to what goes through it, in both directions.

    Attributes:
        cut: Nothing passes; what was sent waits.
        delay_s: On top of what it takes anyway.
        loss: Share of segments that are lost and sent again.
        flips: Share of segments in which one bit is wrong.
    """

    cut: bool = False
    delay_s: float = 0.0
    loss: float = 0.0
    flips: float = 0.0


GOOD: Final = Condition()


@dataclass
class _Way:
    """One direction of a connection: what waits to be delivered, and when each part is due."""

    source: socket.socket
    target: socket.socket
    waiting: deque[tuple[float, bytes]] = field(default_factory=deque)
    size: int = 0
    last: float = 0.0
    over: bool = False  # the source will say no more


class Cable:
    """From a port on loopback to an endpoint of a router; made by `Cables.lay`."""

    def __init__(self, name: str, router: tuple[str, int], listener: socket.socket) -> None:
        self.name, self.router, self.listener = name, router, listener
        self.condition = GOOD
        self.ways: list[_Way] = []

    @property
    def endpoint(self) -> str:
        """Where to connect to."""
        return f"tcp/127.0.0.1:{self.listener.getsockname()[1]}"


class Cables:
    """All of them, served by one thread; a context manager."""

    def __init__(self, random: np.random.Generator) -> None:
        """`random` decides which segments suffer."""
        self._random = random
        self._cables: list[Cable] = []
        self._selector = selectors.DefaultSelector()
        self._lock = threading.Lock()
        self._over = False
        self._thread = threading.Thread(target=self._serve, name="cables", daemon=True)

    def __enter__(self) -> Self:
        self._wake, self._woken = socket.socketpair()
        self._selector.register(self._woken, selectors.EVENT_READ, None)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over = True
        self._stir()
        self._thread.join()
        for cable in self._cables:
            for way in list(cable.ways):
                self._drop(cable, way)
            cable.listener.close()
        self._wake.close()
        self._woken.close()
        self._selector.close()

    def lay(self, name: str, endpoint: str) -> str:
        """A new cable to a router at `endpoint` (tcp/HOST:PORT); the endpoint of its near end."""
        host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
        listener = socket.create_server(("127.0.0.1", 0))
        listener.setblocking(False)
        cable = Cable(name, (host, int(port)), listener)
        with self._lock:
            self._cables.append(cable)
            self._selector.register(listener, selectors.EVENT_READ, cable)
        self._stir()
        return cable.endpoint

    def set(self, condition: Condition, name: str | None = None) -> None:
        """From now on the cables of that name are so; all of them without a name."""
        with self._lock:
            for cable in self._cables:
                if name is None or cable.name == name:
                    cable.condition = condition
        self._stir()

    # ------------------------------------------------------------------ the thread

    def _stir(self) -> None:
        with contextlib.suppress(OSError):
            self._wake.send(b"!")

    def _serve(self) -> None:
        while not self._over:
            with self._lock:
                due = self._deliver(time.monotonic())
            ready = self._selector.select(max(0.0, min(due - time.monotonic(), IDLE_S)))
            now = time.monotonic()
            with self._lock:
                for key, _ in ready:
                    if key.data is None:
                        self._woken.recv(4096)
                    elif isinstance(key.data, Cable):
                        self._accept(key.data)
                    else:
                        cable, way = key.data
                        self._read(cable, way, now)

    def _accept(self, cable: Cable) -> None:
        if cable.condition.cut:
            self._selector.unregister(cable.listener)  # who knocks waits
            return
        with contextlib.suppress(OSError):
            near, _ = cable.listener.accept()
            try:
                far = socket.create_connection(cable.router, timeout=1.0)
            except OSError:
                near.close()
                return
            for end in (near, far):
                end.setblocking(False)
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            for way in (_Way(near, far), _Way(far, near)):
                cable.ways.append(way)
                self._selector.register(way.source, selectors.EVENT_READ, (cable, way))

    def _read(self, cable: Cable, way: _Way, now: float) -> None:
        condition = cable.condition
        if condition.cut or way.size > FULL_BYTES:
            self._selector.unregister(way.source)  # nobody reads: the sender has to wait
            return
        try:
            data = way.source.recv(READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            way.over = True
            self._selector.unregister(way.source)
            return
        if condition is GOOD and not way.waiting:
            data = data[self._send(way, data) :]
            if not data:
                return
        if condition.flips and self._random.random() < condition.flips:
            spoilt = bytearray(data)
            spoilt[self._random.integers(len(data))] ^= 1 << int(self._random.integers(8))
            data = bytes(spoilt)
        due, again = now + condition.delay_s, RETRANSMIT_S
        while condition.loss and self._random.random() < condition.loss:
            due, again = due + again, 2.0 * again
        way.last = max(way.last, due)  # in order, always
        way.waiting.append((way.last, data))
        way.size += len(data)

    def _deliver(self, now: float) -> float:
        """Sends on what is due; when something is due next."""
        later = [now + IDLE_S]
        for cable in self._cables:
            if cable.condition.cut:
                continue
            self._open(cable.listener, cable)
            for way in list(cable.ways):
                while way.waiting and way.waiting[0][0] <= now:
                    due, data = way.waiting[0]
                    sent = self._send(way, data)
                    way.size -= sent
                    if sent < len(data):
                        way.waiting[0] = (due, data[sent:])
                        heapq.heappush(later, now + 0.005)
                        break
                    way.waiting.popleft()
                if way.waiting:
                    heapq.heappush(later, max(way.waiting[0][0], now + 0.001))
                if way.over and not way.waiting:
                    self._drop(cable, way)
                elif not way.over and way.size <= FULL_BYTES:
                    self._open(way.source, (cable, way))
        return later[0]

    def _open(self, end: socket.socket, data: object) -> None:
        """Listens to an end again, if it does not."""
        if end.fileno() >= 0 and end not in self._selector.get_map():
            self._selector.register(end, selectors.EVENT_READ, data)

    @staticmethod
    def _send(way: _Way, data: bytes) -> int:
        try:
            return way.target.send(data)
        except BlockingIOError:
            return 0
        except OSError:
            way.over = True
            return len(data)  # nobody will ever get it

    def _drop(self, cable: Cable, way: _Way) -> None:
        """Ends a connection: both of its ways."""
        for end in (way.source, way.target):
            if end.fileno() >= 0 and end in self._selector.get_map():
                self._selector.unregister(end)
            end.close()
        cable.ways[:] = [each for each in cable.ways if each.source.fileno() >= 0]
