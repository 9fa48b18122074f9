"""Targets: places where bytes from outside are read, made ready, with sockets for those that need one."""

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

    def __init__(self, make, every):
        self._make, self._every, self._left = make, every, 0
        self._made = None

    def __call__(self, data):
        if not self._left:
            self.close()
            self._made, self._left = self._make(), self._every
            next(self._made)
        self._left -= 1
        try:
            self._made.send(data)
        except StopIteration:
            self._left = 0  # it has no use for more
        except Exception:
            self._left = 0  # it has ended, half-way through something
            raise

    def close(self):
        if self._made is not None:
            self._made.close()


class Wire:
    """A socket without a network, fed by hand."""

    def __init__(self):
        self.waiting = deque()

    def recvfrom(self, most):
        if not self.waiting:
            raise BlockingIOError
        return self.waiting.popleft()[:most], ("127.0.0.1", 9)

    def recv(self, most):
        return self.recvfrom(most)[0]

    def sendto(self, packet, _to=None):
        assert isinstance(packet, bytes | bytearray)
        return len(packet)

    send = sendto

    def close(self):
        pass

    def setsockopt(self, *_):
        pass

    setblocking = setsockopt

    def getsockname(self):
        return "127.0.0.1", 1
