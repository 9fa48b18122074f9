"""Random numbers of one robot: each purpose has its own stream, so noise is the same alone and in a swarm.

Reading is quiet; `refill` is rare, and alone needs numpy.
"""

from __future__ import annotations

import zlib
from array import array
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    import numpy as np

BLOCK: Final = 64  # draws per refill: spreads the generator's overhead over this many ticks


def stream(name: str, seed: int, purpose: str) -> np.random.Generator:
    """Generator of a robot's noise: one for each name, seed and purpose."""
    import numpy as np  # noqa: PLC0415 - a robot without noise needs no numpy

    return np.random.default_rng([seed, zlib.crc32(name.encode()), zlib.crc32(purpose.encode())])


class Noise:
    """White Gaussian noise, `len(scale)` numbers per draw; a reader takes them from `ahead` and moves `next` on."""

    __slots__ = ("_block", "_generator", "_scale", "ahead", "end", "next", "present")

    present: bool  # a scale is not 0
    ahead: array[float]  # numbers drawn ahead, one draw after the other
    next: int  # index of the next draw in `ahead`
    end: int  # value of `next` at which `refill` is due; −1 without noise
    _scale: tuple[float, ...]  # standard deviations of the numbers of a draw
    _block: int  # draws per refill
    _generator: np.random.Generator  # only where there is noise

    def __init__(self, name: str, seed: int, purpose: str, scale: Sequence[float], block: int = BLOCK) -> None:
        """`scale`: standard deviations. The stream does not depend on `block`, the draws per refill."""
        self.present = any(scale)
        self.ahead, self.next = array("d"), 0
        self.end = -1
        self._scale, self._block = tuple(scale), block
        if self.present:
            self._generator = stream(name, seed, purpose)
            self.refill()

    def refill(self) -> None:
        """Draw the next block."""
        self.ahead, self.next = self._drawn(self._block), 0
        self.end = len(self.ahead)

    def reserve(self, draws: int) -> None:
        """Draw as much ahead as `draws` take."""
        if self.present:
            left = self.ahead[self.next :]
            more = draws - len(left) // len(self._scale)
            self.ahead, self.next = left + self._drawn(more) if more > 0 else left, 0
            self.end = len(self.ahead)

    def _drawn(self, draws: int) -> array[float]:
        import numpy as np  # noqa: PLC0415 - as above

        drawn = array("d", (0.0,)) * (draws * len(self._scale))
        table = np.frombuffer(drawn).reshape(draws, len(self._scale))
        self._generator.standard_normal(out=table)
        table *= self._scale
        return drawn


def refill(*noises: Noise) -> None:
    """Refill what is used up; due after every step of a reader."""
    for noise in noises:
        if noise.next == noise.end:
            noise.refill()
