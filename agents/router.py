"""The router process: `python -m agents.router`. Light to start, for every experiment on one machine starts one."""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Sequence

from agents.lifeline import Lifeline
from agents.process import told_to_end
from agents.session import DEFAULT_ENDPOINT, EndpointError, serve_router


def serve(endpoints: Sequence[str], *, lifeline: bool = False, linger_s: float = 0.0) -> int:
    """Runs a router until SIGINT, SIGTERM or the loss of its lifeline; returns the exit code of the process.

    Prints one line when clients can connect.

    Args:
        endpoints: Where to listen, on loopback.
        lifeline: Whether standard input is a lifeline.
        linger_s: How long it stays after its lifeline was lost, so that landing robots can still be seen [s].

    Raises:
        EndpointError: If it cannot listen there.
    """
    stop, lost = threading.Event(), threading.Event()
    rope = Lifeline(lost)

    def leave() -> None:
        lost.wait()
        stop.wait(linger_s)
        stop.set()

    with told_to_end(stop.set):
        if lifeline:
            rope.start()
            threading.Thread(target=leave, name="linger", daemon=True).start()
        serve_router(endpoints, stop, ready=lambda: print(f"router ready on {', '.join(endpoints)}", flush=True))
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
