"""What processes that stand by themselves have in common: arguments of the network, and how they are told to end."""

from __future__ import annotations

import argparse
import io
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any

from agents.network.endpoints import DEFAULT_ENDPOINT, EndpointError
from agents.network.keys import Keys
from agents.network.lab import LabError, secured
from agents.runtime.lifeline import SILENCE_S


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


class Output(io.TextIOBase):
    """Writes to a file descriptor what fits; the rest is lost: printing must neither stop nor end a flying robot."""

    def __init__(self, fd: int) -> None:
        """Makes the descriptor one that does not block."""
        super().__init__()
        self._fd = fd
        os.set_blocking(fd, False)

    def write(self, text: str) -> int:
        """Writes at once, as far as that goes without waiting."""
        rest = text.encode(errors="replace")
        try:
            while rest:
                rest = rest[os.write(self._fd, rest) :]
        except OSError:  # nobody is there, or the pipe is full
            pass
        return len(text)

    def writable(self) -> bool:
        """It is."""
        return True


def detach() -> None:
    """Puts such outputs in the place of standard output and standard error."""
    sys.stdout, sys.stderr = Output(1), Output(2)


if TYPE_CHECKING:
    pass


class Interrupts:
    """Ctrl-C, SIGTERM and SIGHUP as a question: the first asks to land, the second ends at once.

    A SIGHUP that `nohup` has set aside stays so.
    """

    def __init__(self) -> None:
        self.asked = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interrupts:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._ask)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def __call__(self) -> bool:
        return self.asked

    def _ask(self, _signal: int, _frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
