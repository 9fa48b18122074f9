"""Targets: places where bytes from outside are read, made ready, with sockets for those that need one."""

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import closing, contextmanager, redirect_stdout
from dataclasses import dataclass
from io import StringIO

from tests.network import Net


@dataclass(frozen=True)
class Target:
    """A place where bytes from outside are read, made ready."""

    examples: Sequence[bytes]  # what it is meant to read
    take: Callable  # reads one input
    refusals: tuple = ()  # what it may raise: what its callers catch and say


@dataclass(frozen=True)
class Place:
    """A target that has yet to be made."""

    make: Callable  # makes it ready, as a context manager
    inputs: int  # its share of a million: more for what is fast, and for what the whole network may reach
    quick: int = 200  # inputs in the ordinary tests

    def open(self):
        """The target, ready, in a `with`."""
        return contextmanager(self.make)()


class Renewed:
    """Something with a memory, made anew after a number of inputs: one that was told too much refuses all the rest.

    It is a generator that is sent an input at each `yield`; its end, by an error too, is its `finally`.
    """

    def __init__(self, make, every):
        self._make, self._every, self._left, self._made = make, every, 0, None

    def __call__(self, data):
        if not self._left:
            self.close()
            self._made, self._left = self._make(), self._every
            next(self._made)
        left, self._left = self._left, 0  # after an end or an error it has no use for more
        try:
            self._made.send(data)
        except StopIteration:
            return
        self._left = left - 1

    def close(self):
        if self._made is not None:
            self._made.close()


def renewed(every, examples, refusals=()):
    """Decorator of a generator that is sent inputs: a target with these examples, a function, made anew each time."""

    def decorate(make):
        def target():
            with closing(Renewed(make, every)) as take:
                yield Target(examples(), take, refusals)

        return target

    return decorate


def networked(every, examples):
    """As `renewed`, of a generator that gets a network without channels."""

    def decorate(make):
        def target():
            def begin():
                net.forget()
                return make(net)

            with Net().worn() as net, redirect_stdout(StringIO()), closing(Renewed(begin, every)) as take:
                yield Target(examples(), take)

        return target

    return decorate


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

    def setsockopt(self, *_):
        pass

    send, close, setblocking = sendto, setsockopt, setsockopt

    def getsockname(self):
        return "127.0.0.1", 1
