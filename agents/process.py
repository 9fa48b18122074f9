"""What processes that stand by themselves have in common: arguments of the network, and how they are told to end."""

from __future__ import annotations

import argparse
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from agents.endpoint import DEFAULT_ENDPOINT, EndpointError
from agents.keys import Keys
from agents.lab import LabError, secured
from agents.lifeline import SILENCE_S


@contextmanager
def told_to_end(end: Callable[[], object]) -> Iterator[None]:
    """Inside, SIGINT and SIGTERM call `end`, as often as they come; afterwards they do what they did before."""

    def heed(_signal: int, _frame: FrameType | None) -> None:
        end()

    before = {number: signal.signal(number, heed) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def add_network(parser: argparse.ArgumentParser, identity: str) -> None:
    """Adds `--connect`, `--lab`, `--as` (by itself `identity`), `--realm` and `--lifeline`; `reached` reads them."""
    parser.add_argument("--connect", action="append", metavar="ENDPOINT", help=f"default: {DEFAULT_ENDPOINT}")
    parser.add_argument("--lab", metavar="FOLDER", help="certificates of a lab (`zenpark keys init`)")
    parser.add_argument("--as", dest="identity", default=identity, metavar="NAME", help="whose certificate, in a lab")
    parser.add_argument("--realm", default=Keys().realm, help="first chunk of the robots' keys")
    parser.add_argument(
        "--lifeline", action="store_true", help=f"end when standard input ends or is silent for {SILENCE_S:g} s"
    )


def reached(chosen: argparse.Namespace) -> list[str]:
    """The endpoints that were chosen by `--connect` and `--lab`.

    Raises:
        EndpointError: If one asks for no certificates, and there is a lab.
    """
    try:
        return secured(chosen.connect or [], chosen.lab) or [DEFAULT_ENDPOINT]
    except LabError as error:
        raise EndpointError(str(error)) from None
