"""Targets: places where bytes from outside are read, made ready, with sockets for those that need one."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

Inputs = Generator[None, bytes, None]  # takes an input at each `yield`


@dataclass(frozen=True)
class Target:
    """A place where bytes from outside are read, made ready.

    Attributes:
        examples: What it is meant to read.
        take: Reads one input.
        refusals: What it may raise: what its callers catch and say.
    """

    examples: Sequence[bytes]
    take: Callable[[bytes], object]
    refusals: tuple[type[Exception], ...] = ()


@dataclass(frozen=True)
class Place:
    """A target that has yet to be made.

    Attributes:
        make: Makes it ready, as a context manager.
        inputs: Its share of a million: more for what is fast, and for what the whole network may reach.
        quick: Inputs in the ordinary tests.
    """

    make: Callable[[], Iterator[Target]]
    inputs: int
    quick: int = 200

    def open(self):
        """The target, ready, in a `with`."""
        return contextmanager(self.make)()


class Renewed:
    """Something with a memory, made anew after a number of inputs: one that was told too much refuses all the rest.

    It is a generator that is sent an input at each `yield`; its end, by an error too, is its `finally`.
    """

    def __init__(self, make: Callable[[], Inputs], every: int) -> None:
        self._make, self._every, self._left = make, every, 0
        self._made: Inputs | None = None

    def __call__(self, data: bytes) -> None:
        if not self._left:
            self.close()
            self._made, self._left = self._make(), self._every
            next(self._made)
        assert self._made is not None
        self._left -= 1
        try:
            self._made.send(data)
        except StopIteration:
            self._left = 0  # it has no use for more
        except Exception:
            self._left = 0  # it has ended, half-way through something
            raise

    def close(self) -> None:
        if self._made is not None:
            self._made.close()


class Wire:
    """A socket without a network, fed by hand."""

    def __init__(self) -> None:
        self.waiting: deque[bytes] = deque()

    def recvfrom(self, most: int) -> tuple[bytes, tuple[str, int]]:
        if not self.waiting:
            raise BlockingIOError
        return self.waiting.popleft()[:most], ("127.0.0.1", 9)

    def recv(self, most: int) -> bytes:
        return self.recvfrom(most)[0]

    def sendto(self, packet: bytes, _to: object = None) -> int:
        assert isinstance(packet, bytes | bytearray)
        return len(packet)

    send = sendto

    def close(self) -> None:
        pass

    def setsockopt(self, *_: object) -> None:
        pass

    setblocking = setsockopt

    def getsockname(self) -> tuple[str, int]:
        return "127.0.0.1", 1
