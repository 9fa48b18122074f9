"""Targets: places where bytes from outside are read, made ready, with sockets for those that need one."""

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack, contextmanager, redirect_stdout, suppress
from dataclasses import dataclass
from inspect import signature
from io import StringIO

from tests.network import Net

PLACES = {}  # by name


@dataclass(frozen=True)
class Target:
    """A place where bytes from outside are read, made ready."""

    examples: Sequence[bytes]  # what it is meant to read
    take: Callable  # reads one input
    refusals: tuple = ()  # what it may raise: what its callers catch and say


@dataclass(frozen=True)
class Place:
    """A target that has yet to be made."""

    open: Callable  # makes it ready, as a context manager
    inputs: int  # its share of a million: more for what is fast, and for what the whole network may reach
    quick: int  # inputs in the ordinary tests


def place(inputs, quick=200, name=None):
    """Decorator of a generator that yields a target, whose name it gives to a place."""

    def decorate(make):
        PLACES[name or make.__name__.replace("_", "-")] = Place(contextmanager(make), inputs, quick)
        return make

    return decorate


def renewed(every, examples, inputs, quick=200, refusals=()):
    """Decorator of a generator that is sent inputs: a place of a target that reads them.

    It is made anew after its end, which is its `finally`, and after a number of inputs, for what was told too much
    refuses all the rest. If it has a parameter, that is a network without channels.
    """

    def decorate(make):
        def target():
            made, left, nets = None, 0, []

            def close():
                if made is not None:
                    made.close()

            def take(data):
                nonlocal made, left
                if not left:
                    close()
                    for net in nets:
                        net.forget()
                    made, left = make(*nets), every
                    next(made)
                rest, left = left - 1, 0  # after an end or an error it has no use for more
                with suppress(StopIteration):
                    made.send(data)
                    left = rest

            with ExitStack() as stack:
                if signature(make).parameters:
                    nets.append(stack.enter_context(Net().worn()))
                    stack.enter_context(redirect_stdout(StringIO()))
                stack.callback(close)
                yield Target(examples(), take, refusals)

        return place(inputs, quick, make.__name__.replace("_", "-"))(target)

    return decorate


def split(data):
    """Text before the first zero byte, and bytes behind it."""
    head, _, rest = data.partition(b"\0")
    return head.decode("utf-8", "replace"), rest


class Wire:
    """A socket without a network, fed by hand."""

    def __init__(self):
        self.queue = deque()

    def recvfrom(self, most):
        if not self.queue:
            raise BlockingIOError
        return self.queue.popleft()[:most], ("127.0.0.1", 9)

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
