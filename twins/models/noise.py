"""Random numbers in rows: each row has its own streams, so its noise is the same alone and in a swarm."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np

from agents.arrays import Array

BLOCK = 256  # draws per refill: spreads the generator's overhead over this many ticks


class Noise:
    """White Gaussian noise, (n, width) per draw, of unit variance times `scale`."""

    scale: Array | float = 1.0  # (n, width); set it before the first draw

    def __init__(
        self, names: Sequence[str], seeds: Sequence[int], purpose: str, width: int, block: int = BLOCK
    ) -> None:
        """One stream for each name, seed and purpose; it does not depend on `block`, the draws per refill."""
        self._width, self._size = width, block
        self._generators = [
            np.random.default_rng([seed, zlib.crc32(name.encode()), zlib.crc32(purpose.encode())])
            for name, seed in zip(names, seeds, strict=True)
        ]
        self._block: Array = np.zeros((0, len(self._generators), width))
        self._next = 0

    def draw(self) -> Array:
        """The next (n, width)."""
        if self._next == len(self._block):
            self._block = np.stack([g.standard_normal((self._size, self._width)) for g in self._generators], axis=1)
            self._block *= self.scale
            self._next = 0
        drawn: Array = self._block[self._next]
        self._next += 1
        return drawn
