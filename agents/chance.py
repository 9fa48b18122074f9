"""Random numbers that can be looked up: each belongs to a key and a counter, and no draw depends on another one.

Whoever knows the key has the same number for the same counter, in whatever order and process it asks. That is how a
sample has one fate, on the virtual network and at the listener of a real one.
"""

from __future__ import annotations

import hashlib
from typing import Final

import numpy as np
from numpy.typing import NDArray

from agents.rows import Array

Words = NDArray[np.uint64]
Counter = NDArray[np.integer] | int

# SplitMix64 (Steele, Lea and Flood, Fast splittable pseudorandom number generators, OOPSLA 2014) is a counter with an
# odd step, and a mixer behind it: here the counter is given, not kept.
_STEP: Final = np.uint64(0x9E3779B97F4A7C15)
_MIXERS: Final = (np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB))
_SHIFTS: Final = (np.uint64(30), np.uint64(27), np.uint64(31))
_SPARE: Final = np.uint64(11)  # bits that a float has no place for


def key(seed: int, *names: str) -> int:
    """A key of 64 bits: another one for another seed, or other names, or the same ones in another order."""
    text = "\0".join([str(seed), *names])
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")


def uniform(keys: Words, counter: Counter) -> Array:
    """Numbers in [0, 1), multiples of 2⁻⁵³: one for each key and counter, whose shapes are broadcast.

    Args:
        keys: (M, ...) see `key`.
        counter: Which number of each.
    """
    first, second, last = _SHIFTS
    word = keys + _STEP * np.asarray(counter, dtype=np.int64).astype(np.uint64)  # wraps, as it must
    word = (word ^ (word >> first)) * _MIXERS[0]
    word = (word ^ (word >> second)) * _MIXERS[1]
    word ^= word >> last
    return np.asarray((word >> _SPARE) * 2.0**-53)
