"""Cables between robots and routers that can be cut, be slow, lose, and flip bits: TCP relays on loopback.

Why a relay: it needs neither root nor a kernel with a network emulator, works wherever zenpark does, and does to a TCP
connection what a bad cable does. Nothing is ever lost inside such a connection; what a network loses comes later, and
all behind it waits. So a lost segment is one that waits for its retransmission timeouts.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
from collections.abc import Coroutine
from dataclasses import dataclass, field
from typing import Final, Self

import numpy as np

READ_BYTES: Final = 65536
SEGMENTS: Final = 256  # more than this under way: the sender must wait
RETRANSMIT_S: Final = 0.2  # the least timeout of Linux; it doubles each time
CONNECT_S: Final = 1.0


@dataclass(frozen=True)
class Condition:
    """Faults of a cable, in both directions."""

    cut: bool = False  # nothing passes; what was sent waits
    delay_s: float = 0.0  # on top of the delay that it has anyway
    loss: float = 0.0  # share of segments that are lost and sent again
    flips: float = 0.0  # share of segments in which one bit is wrong


GOOD: Final = Condition()


@dataclass
class _Cable:
    """From a port on loopback to a router."""

    name: str
    condition: Condition = GOOD
    whole: asyncio.Event = field(default_factory=asyncio.Event)  # while it is not cut


class Cables:
    """All cables, served by an event loop in one thread; a context manager."""

    def __init__(self, random: np.random.Generator) -> None:
        """`random` decides which segments suffer."""
        self._random = random
        self._cables: list[_Cable] = []
        self._tasks: set[asyncio.Task[None]] = set()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="cables", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        async def end() -> None:
            tasks = asyncio.all_tasks() - {asyncio.current_task()}
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

        asyncio.run_coroutine_threadsafe(end(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def lay(self, name: str, endpoint: str) -> str:
        """A new cable to a router at `endpoint` (tcp/HOST:PORT); the endpoint of its near end."""
        host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
        server = socket.create_server(("127.0.0.1", 0))
        server.setblocking(False)
        near = f"tcp/127.0.0.1:{server.getsockname()[1]}"

        async def begin() -> None:
            cable = _Cable(name)
            cable.whole.set()
            self._cables.append(cable)
            self._keep(self._accept(cable, server, (host, int(port))))

        asyncio.run_coroutine_threadsafe(begin(), self._loop).result()
        return near

    def set(self, condition: Condition, name: str | None = None) -> None:
        """Change the condition of the cables of that name; of all cables without a name."""

        async def change() -> None:
            for cable in self._cables:
                if name is None or cable.name == name:
                    cable.condition = condition
                    (cable.whole.clear if condition.cut else cable.whole.set)()

        asyncio.run_coroutine_threadsafe(change(), self._loop).result()

    # ------------------------------------------------------------------ the thread

    def _keep(self, work: Coroutine[None, None, None]) -> None:
        task = self._loop.create_task(work)
        self._tasks.add(task)  # a loop holds its tasks weakly
        task.add_done_callback(self._tasks.discard)

    async def _accept(self, cable: _Cable, server: socket.socket, router: tuple[str, int]) -> None:
        with server:
            while True:
                await cable.whole.wait()  # a client of a cut cable waits in the backlog
                near, _ = await self._loop.sock_accept(server)
                self._keep(self._connect(cable, near, router))

    async def _connect(self, cable: _Cable, near: socket.socket, router: tuple[str, int]) -> None:
        """Carry both directions of a connection until one of them ends."""
        with near, socket.socket() as far:
            for end in (near, far):
                end.setblocking(False)
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with contextlib.suppress(OSError, TimeoutError):
                await cable.whole.wait()
                await asyncio.wait_for(self._loop.sock_connect(far, router), CONNECT_S)
                ways = [asyncio.create_task(self._carry(cable, *pair)) for pair in ((near, far), (far, near))]
                try:
                    await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
                finally:
                    for way in ways:
                        way.cancel()
                    await asyncio.gather(*ways, return_exceptions=True)

    async def _carry(self, cable: _Cable, source: socket.socket, target: socket.socket) -> None:
        """Carry one direction of a connection to its end."""
        under_way: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(SEGMENTS)

        async def read() -> None:
            data, last = b"any", 0.0
            while data:
                await cable.whole.wait()
                try:
                    data = await self._loop.sock_recv(source, READ_BYTES)
                except OSError:
                    data = b""
                due, data = self._suffer(cable.condition, data)
                last = max(last, due)  # in order, always
                await under_way.put((last, data))

        reading = asyncio.create_task(read())
        try:
            while True:
                due, data = await under_way.get()
                if (wait_s := due - self._loop.time()) > 0.0:
                    await asyncio.sleep(wait_s)
                await cable.whole.wait()
                if not data:
                    return
                await self._loop.sock_sendall(target, data)
        finally:
            reading.cancel()

    def _suffer(self, condition: Condition, data: bytes) -> tuple[float, bytes]:
        """Arrival time of a segment at the other end, and its bits there."""
        if data and condition.flips and self._random.random() < condition.flips:
            spoilt = bytearray(data)
            spoilt[self._random.integers(len(data))] ^= 1 << int(self._random.integers(8))
            data = bytes(spoilt)
        due, again = self._loop.time() + condition.delay_s, RETRANSMIT_S
        while condition.loss and self._random.random() < condition.loss:
            due, again = due + again, 2.0 * again
        return due, data
