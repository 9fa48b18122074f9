"""Drives a target: counts what is refused, keeps what escapes, and what takes too long or too much memory."""

from __future__ import annotations

import hashlib
import mmap
import resource
import time
import traceback
import zlib
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tests.fuzz.mutate import Mutator
from tests.fuzz.target import Place, Target

SLOW_S = 1.0  # CPU time that no input of 64 kB may take
HUGE_KB = 100 * 1024  # by which no input may make the process larger


@dataclass
class Tally:
    """What came of the inputs of a target.

    Attributes:
        inputs: How many were tried.
        refused: How many were refused as they should be.
        escaped: Ways to fail, each with how often it was met.
        kept: One input of each way to fail, and what it ended in.
        slowest: The most CPU time that an input took [s], and its length.
        taken: CPU time of all [s].
    """

    inputs: int = 0
    refused: int = 0
    escaped: Counter[str] = field(default_factory=Counter)
    kept: list[tuple[bytes, str]] = field(default_factory=list)
    slowest: tuple[float, int] = (0.0, 0)
    taken: float = 0.0

    def keep(self, way: str, data: bytes, text: str) -> None:
        """One more failure."""
        self.escaped[way] += 1
        if self.escaped[way] <= 1:
            self.kept.append((data, text))


def generator(seed: int, name: str, block: int) -> np.random.Generator:
    """What the inputs of a block of a target are drawn with: the same wherever and after whatever it runs."""
    return np.random.default_rng([seed, zlib.crc32(name.encode()), block])


def drive(
    target: Target, inputs: int, rng: np.random.Generator, tally: Tally, *, slot: mmap.mmap | None = None, bombs: bool
) -> None:
    """Tries so many inputs.

    Args:
        target: To be driven.
        inputs: How many.
        rng: Draws them.
        tally: What came of them is added there.
        slot: Where each input is written before it is tried, for whoever looks after a crash.
        bombs: Whether time and memory count as well.
    """
    mutator = Mutator(target.examples, rng)
    cpu = time.process_time
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begun = cpu()
    last = begun
    for _ in range(inputs):
        data = mutator.spoilt()
        if slot is not None:
            slot[: 4 + len(data)] = len(data).to_bytes(4, "little") + data
        try:
            target.take(data)
        except target.refusals:
            tally.refused += 1
        except Exception as error:  # noqa: BLE001 - whatever escapes is what is looked for
            tally.keep(way_of(error), data, "".join(traceback.format_exception(error)))
        if bombs:
            now = cpu()
            if now - last > tally.slowest[0]:
                tally.slowest = (now - last, len(data))
                if now - last > SLOW_S:
                    tally.keep("time", data, f"{now - last:.1f} s of CPU for {len(data)} bytes")
            grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory
            memory += max(0, grown)
            if grown > HUGE_KB:
                tally.keep("memory", data, f"{grown // 1024} MB more for {len(data)} bytes")
            last = cpu()
    tally.inputs += inputs
    tally.taken += cpu() - begun


def way_of(error: Exception) -> str:
    """Where and how it failed: the last line of ours, not of the tests."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "site-packages" not in frame.filename and "/lib/python" not in frame.filename]
    inner = [frame for frame in ours if "/tests/" not in frame.filename] or ours or list(frames)
    return f"{type(error).__name__} in {Path(inner[-1].filename).name}:{inner[-1].lineno}"


def save(folder: Path, name: str, kept: tuple[bytes, str]) -> Path:
    """Keeps an input, and what it ended in beside it."""
    data, text = kept
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{name}--{hashlib.sha256(data + text.encode('utf-8', 'replace')[-200:]).hexdigest()[:12]}.bin"
    file.write_bytes(data)
    file.with_suffix(".txt").write_text(text, encoding="utf-8", errors="backslashreplace")
    return file


def replay(place: Place, data: bytes) -> str:
    """What becomes of one input: "read", or why it is refused; raises what escapes."""
    with place.open() as target:
        try:
            target.take(data)
        except target.refusals as error:
            return f"refused: {type(error).__name__}: {error}"
    return "read"
