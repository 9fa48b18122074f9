"""An intruder as a process: `python -m tools.bench.intruder_process KIND ENDPOINT IDENTITY KEY`, until
SIGTERM.

For `./zenpark bench intruders`. At the end it prints its rate per second. It yields the processor to all other
processes: a real intruder has a machine of its own.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from typing import Final

import zenoh

from agents.network import lab, messages
from agents.network import session as network

RATE_HZ: Final = 10_000.0
GARBAGE_HZ: Final = 200.0
HALF_OPEN: Final = 60
HELLO: Final = b"\x16\x03\x01"  # how a TLS handshake begins
NONSENSE: Final = (b"", b"{", b"[" * 1000, b"\xff" * 200, b'{"robot":null}', b"null", b'"' + b"a" * 1000 + b'"')
LARGE: Final = 65_537
LARGE_HZ: Final = 1_000.0  # half a gigabit per second


def flood(
    endpoint: str, identity: str, key: str, what: Callable[[int], bytes], *, rate_hz: float, over: threading.Event
) -> None:
    """Send something so many times a second, report how often, and end the process."""
    with network.open_session([endpoint], name="intruder", identity=identity) as session:
        publisher = session.declare_publisher(key, encoding=messages.JSON)

        def once(count: int) -> None:
            publisher.put(what(count))

        begin = time.monotonic()
        done = _at(rate_hz, once, over)
        _report(done, begin)
        os._exit(0)  # a session takes its time to close when the other end is in no hurry to read


def _at(rate_hz: float, once: Callable[[int], None], over: threading.Event) -> int:
    begin, done = time.monotonic(), 0
    while not over.is_set():
        wanted = int((time.monotonic() - begin) * rate_hz)
        while done < wanted and not over.is_set():
            once(done)
            done += 1
        over.wait(0.001)
    return done


def half_open(endpoint: str, over: threading.Event) -> int:
    """Begin handshakes without completing them; begin again when the router has dropped one."""
    address = _address(endpoint)
    held: list[socket.socket] = []
    begun = 0
    while not over.wait(0.05):
        for one in list(held):
            try:
                closed = not one.recv(64)
            except BlockingIOError:
                continue
            except OSError:
                closed = True
            if closed:
                one.close()
                held.remove(one)
        while len(held) < HALF_OPEN:
            with contextlib.suppress(OSError):
                one = socket.create_connection(address, timeout=1.0)
                one.sendall(HELLO)
                one.setblocking(False)
                held.append(one)
                begun += 1
    return begun


def garbage(endpoint: str, over: threading.Event) -> int:
    """Connect, or send datagrams, with bytes that are no handshake."""
    address = _address(endpoint)
    datagrams = endpoint.startswith("quic")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:

        def once(_count: int) -> None:
            if datagrams:
                sender.sendto(os.urandom(1200), address)
                return
            with contextlib.suppress(OSError), socket.create_connection(address, timeout=1.0) as one:
                one.sendall(b"GET / HTTP/1.0\r\n\r\n")

        return _at(GARBAGE_HZ, once, over)


def _address(endpoint: str) -> tuple[str, int]:
    host, _, port = lab.bare([endpoint])[0].partition("/")[2].rpartition(":")
    return host, int(port)


def main() -> int:
    """The command line of the process."""
    kind, endpoint, identity, key = sys.argv[1:]
    over = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: over.set())
    os.nice(19)
    begin = time.monotonic()
    robot = key.split("/")[1]
    old = messages.encode(messages.pose(robot, 1, time.time() - 10.0, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], 0.0))
    payloads: dict[str, Callable[[int], bytes]] = {
        "nonsense": lambda count: NONSENSE[count % len(NONSENSE)],
        "large": lambda _: b" " * LARGE,
        "replay": lambda _: old,
        "denied": lambda _: old,
    }
    try:
        if kind in payloads:
            rate_hz = LARGE_HZ if kind == "large" else RATE_HZ
            flood(endpoint, identity, key, payloads[kind], rate_hz=rate_hz, over=over)
        _report({"half-open": half_open, "garbage": garbage}[kind](endpoint, over), begin)
    except (network.Unreachable, zenoh.ZError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def _report(done: int, begin: float) -> None:
    print(json.dumps({"rate": done / (time.monotonic() - begin)}), flush=True)


if __name__ == "__main__":
    sys.exit(main())
