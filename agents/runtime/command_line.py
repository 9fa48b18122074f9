"""Command line, signals and output of a process: options from the fields of a struct, SIGTERM, non-blocking stdout."""

from __future__ import annotations

import argparse
import gc
import io
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Annotated, Any, TypeVar, get_origin

import msgspec
from msgspec import Meta

from agents.errors import ExplainedError
from agents.fields import bare, fields_of
from agents.network.endpoints import DEFAULT_ENDPOINT
from agents.network.keys import Keys
from agents.network.lab import secured


@contextmanager
def on_termination(end: Callable[[], object], *more: signal.Signals) -> Iterator[None]:
    """Inside, each SIGINT and SIGTERM, and each of `more`, calls `end`; afterwards the former handlers hold."""

    def handle(_signal: int, _frame: FrameType | None) -> None:
        end()

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM, *more)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class NetworkLaunch(msgspec.Struct, frozen=True, kw_only=True, rename="kebab"):
    """Options of a process that joins a network without an experiment."""

    connect: Annotated[list[str], Meta(title="ENDPOINT", description=f"default: {DEFAULT_ENDPOINT}")] = []
    lab: Annotated[str | None, Meta(title="FOLDER", description="certificates of a lab (`./zenpark lab init`)")] = None
    identity: Annotated[str, Meta(title="NAME", description="name of the certificate, in a lab")] = msgspec.field(
        default="", name="as"
    )
    realm: Annotated[str, Meta(description="first chunk of the robots' keys")] = Keys().realm
    lifeline: Annotated[bool, Meta(description="end when standard input ends or is silent")] = False

    def endpoints(self) -> list[str]:
        """Routers, the usual one if none is named, each with its lab if there is one; raises LabError."""
        return secured(self.connect, self.lab) or [DEFAULT_ENDPOINT]


L = TypeVar("L", bound=msgspec.Struct)


def run(
    prog: str,
    kind: type[L],
    serve: Callable[[L], int],
    arguments: Sequence[str] | None = None,
    more: tuple[type[BaseException], ...] = (),
) -> int:
    """Runs a process from its command line; prints errors that are explained, and `more`. Returns the exit code."""
    launch = parse(prog, kind, arguments)
    if getattr(launch, "lifeline", False):
        detach()  # a full disk, which takes no output, ends no process of a run
    explained: tuple[type[BaseException], ...] = (ExplainedError, *more)
    try:
        return serve(launch)
    except explained as error:
        print(f"zenpark: {error}", file=sys.stderr)
        return 2


def parse(prog: str, kind: type[L], arguments: Sequence[str] | None = None) -> L:
    """A struct from a command line; ends the process on a wrong one."""
    parser = parser_of(prog, kind)
    try:
        return msgspec.convert(vars(parser.parse_args(arguments)), kind, strict=False)
    except msgspec.ValidationError as error:
        parser.error(str(error))


def parser_of(prog: str, kind: type[msgspec.Struct]) -> argparse.ArgumentParser:
    """Parser of the fields of a struct: required ones are positional, the others options of the same name.

    Description and metavar are those of `msgspec.Meta(description=..., title=...)`.
    """
    parser = argparse.ArgumentParser(prog=prog, description=(kind.__doc__ or "").partition("\n")[0])
    for name, field in fields_of(kind).items():
        plain, meta = bare(field.type)
        options: dict[str, Any] = {"help": meta.description}
        if plain is bool:
            options["action"] = "store_true"
        elif meta.title is not None:
            options["metavar"] = meta.title
        if get_origin(plain) is list:
            options |= {"nargs": "+"} if field.required else {"action": "append"}
        if field.required:
            parser.add_argument(name, **options)
        else:
            parser.add_argument(f"--{name}", dest=name, default=argparse.SUPPRESS, **options)
    return parser


class Output(io.TextIOBase):
    """Non-blocking stdout: output is dropped, never waited for, when the reader is slow or gone.

    Printing must neither stop nor end a flying robot.
    """

    def __init__(self, fd: int) -> None:
        """Write to the descriptor `fd`. A terminal is opened again: its flags are shared with the shell."""
        super().__init__()
        self._fd = fd
        if not os.isatty(fd):
            os.set_blocking(fd, False)
            return
        with suppress(OSError):  # a terminal of another container has no name here
            self._fd = os.open(os.ttyname(fd), os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)

    def write(self, text: str) -> int:
        """Writes the part that fits without waiting."""
        rest = text.encode(errors="replace")
        try:
            while rest:
                rest = rest[os.write(self._fd, rest) :]
        except OSError:  # no reader, a full pipe or disk, or a terminal that Ctrl-S has stopped
            pass
        return len(text)

    def writable(self) -> bool:
        return True


def detach() -> None:
    """Replaces standard output and standard error by non-blocking ones."""
    sys.stdout, sys.stderr = Output(1), Output(2)


def spare_imports() -> None:
    """Keep the garbage collector off imported objects, which live as long as the process, in a loop that begins now."""
    gc.collect()
    gc.freeze()


@contextmanager
def interrupts() -> Iterator[Callable[[], bool]]:
    """Inside, Ctrl-C, SIGTERM and SIGHUP are polled: the first asks to land, the second ends at once.

    Yields whether one has asked. A SIGHUP that `nohup` ignores stays ignored.
    """
    asked = False

    def ask() -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True

    hang_up = () if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN else (signal.SIGHUP,)
    with on_termination(ask, *hang_up):
        yield lambda: asked
