"""Cables between robots and routers that can be cut: TCP relays on loopback.

Why a relay: it needs neither root nor a kernel with a network emulator, works wherever zenpark does, and does to a TCP
connection what a bad cable does. Nothing is ever lost inside such a connection: what was sent waits.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from typing import Final, Self

READ_BYTES: Final = 65536
CONNECT_S: Final = 1.0


class Cables:
    """All cables, served by an event loop in one thread; a context manager."""

    def __init__(self) -> None:
        self._whole: dict[str, asyncio.Event] = {}  # by name: set while its cables are not cut
        self._servers: list[asyncio.Server] = []
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="cables", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        async def end() -> None:
            for server in self._servers:
                server.close()
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
        whole = self._whole.setdefault(name, asyncio.Event())

        async def connect(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            with contextlib.closing(writer), contextlib.suppress(OSError, TimeoutError):
                await whole.wait()
                far = await asyncio.wait_for(asyncio.open_connection(host, int(port)), CONNECT_S)
                with contextlib.closing(far[1]):
                    ways = [asyncio.ensure_future(_carry(whole, *way)) for way in ((reader, far[1]), (far[0], writer))]
                    try:
                        await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
                    finally:
                        for way in ways:
                            way.cancel()
                        await asyncio.gather(*ways, return_exceptions=True)

        async def serve() -> str:
            whole.set()
            self._servers.append(await asyncio.start_server(connect, "127.0.0.1", 0))
            return f"tcp/127.0.0.1:{self._servers[-1].sockets[0].getsockname()[1]}"

        return asyncio.run_coroutine_threadsafe(serve(), self._loop).result()

    def cut(self, name: str) -> None:
        """Let nothing pass through the cables of that name any more."""
        self._loop.call_soon_threadsafe(self._whole[name].clear)

    def mend(self) -> None:
        """Let everything pass through all cables, first what has waited."""
        for whole in self._whole.values():
            self._loop.call_soon_threadsafe(whole.set)


async def _carry(whole: asyncio.Event, source: asyncio.StreamReader, target: asyncio.StreamWriter) -> None:
    """Carry one direction of a connection to its end."""
    data = b"any"
    while data:
        await whole.wait()
        data = await source.read(READ_BYTES)
        await whole.wait()
        target.write(data)
        await target.drain()
