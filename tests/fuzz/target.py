"""What a target is: a place where bytes from outside are read."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass


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
    """Something with a memory, made anew after so many inputs: one that was told too much refuses all the rest."""

    def __init__(self, make: Callable[[], Callable[[bytes], object]], every: int) -> None:
        self._make, self._every, self._left = make, every, 0
        self._take: Callable[[bytes], object] = lambda _: None

    def __call__(self, data: bytes) -> object:
        if not self._left:
            self._take, self._left = self._make(), self._every
        self._left -= 1
        try:
            return self._take(data)
        except Exception:
            self._left = 0  # it may be half-way through something
            raise
