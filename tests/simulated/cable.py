"""Cable between robots and routers, which SIGSTOP cuts: `python -m tests.simulated.cable NEAR FAR [NEAR FAR...]`.

A TCP relay between ports on loopback: what was sent waits until the process goes on. It ends with its standard input.
"""

from __future__ import annotations

import asyncio
import sys
from contextlib import closing, suppress
from typing import Final

HOST: Final = "127.0.0.1"
READ_BYTES: Final = 65536


async def _carry(source: asyncio.StreamReader, target: asyncio.StreamWriter) -> None:
    """Carry one direction of a connection to its end, and end it there as well."""
    with suppress(OSError), closing(target):
        while data := await source.read(READ_BYTES):
            target.write(data)
            await target.drain()


async def _lay(near: int, far: int) -> asyncio.Server:
    async def connect(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError), closing(writer):
            answers, requests = await asyncio.open_connection(HOST, far)
            await asyncio.gather(_carry(reader, requests), _carry(answers, writer))

    return await asyncio.start_server(connect, HOST, near)


async def _serve(ports: list[int]) -> None:
    laid = [await _lay(near, far) for near, far in zip(ports[::2], ports[1::2], strict=True)]
    await asyncio.to_thread(sys.stdin.buffer.read)
    for server in laid:
        server.close()


if __name__ == "__main__":
    asyncio.run(_serve([*map(int, sys.argv[1:])]))
