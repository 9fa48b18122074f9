"""The router process: `python -m agents.router`. Light to start, for every experiment on one machine starts one."""

from __future__ import annotations

import argparse
import sys
import threading
import time
from collections.abc import Sequence
from typing import Final

import zenoh

from agents.lifeline import Lifeline
from agents.process import told_to_end
from agents.session import DEFAULT_ENDPOINT, EndpointError, deserted, serve_router

EMPTY_S: Final = 1.0  # nobody connected for this long: whoever lost its connection would have it again
LOOK_S: Final = 0.1


def serve(endpoints: Sequence[str], *, lifeline: bool = False, linger_s: float = 0.0) -> int:
    """Runs a router until SIGINT, SIGTERM or the loss of its lifeline; returns the exit code of the process.

    Prints one line when clients can connect.

    Args:
        endpoints: Where to listen, on loopback.
        lifeline: Whether standard input is a lifeline.
        linger_s: How long it stays after its lifeline was lost, so that landing robots can still be seen [s]; less when
            nobody is connected any more.

    Raises:
        EndpointError: If it cannot listen there.
    """
    stop, lost = threading.Event(), threading.Event()
    rope = Lifeline(lost)

    def leave(session: zenoh.Session) -> None:
        lost.wait()
        end = time.monotonic() + linger_s
        empty = time.monotonic()
        while (now := time.monotonic()) < end and not stop.wait(LOOK_S):
            if not deserted(session):
                empty = now
            elif now - empty > EMPTY_S:
                break
        stop.set()

    def ready(session: zenoh.Session) -> None:
        print(f"router ready on {', '.join(endpoints)}", flush=True)
        if lifeline:
            rope.start()
            threading.Thread(target=leave, args=(session,), name="linger", daemon=True).start()

    with told_to_end(stop.set):
        serve_router(endpoints, stop, ready=ready)
    if rope.reason is not None:
        print(f"router: {rope.reason}", file=sys.stderr)
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line of the router process."""
    parser = argparse.ArgumentParser(prog="zenpark router", description="A Zenoh router on this machine.")
    parser.add_argument("--listen", action="append", metavar="ENDPOINT", help=f"default: {DEFAULT_ENDPOINT}")
    parser.add_argument("--lifeline", action="store_true", help="end when standard input ends or is silent for 3 s")
    parser.add_argument("--linger", type=float, default=0.0, metavar="SECONDS", help="and then stay for so long")
    chosen = parser.parse_args(arguments)
    try:
        return serve(chosen.listen or [DEFAULT_ENDPOINT], lifeline=chosen.lifeline, linger_s=chosen.linger)
    except EndpointError as error:
        print(f"zenpark: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
