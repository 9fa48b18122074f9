"""Drives a target: counts what is refused, keeps what escapes, and what takes too long or too much memory."""

import hashlib
import resource
import time
import traceback
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from tests.fuzz import targets_devices, targets_drones, targets_files, targets_network, targets_ros
from tests.fuzz.mutate import Mutator

SLOW_S = 1.0  # CPU time that no input of 64 kB may take
HUGE_KB = 100 * 1024  # by which no input may make the process larger
MODULES = (targets_network, targets_drones, targets_devices, targets_ros, targets_files)
PLACES = {name: place for module in MODULES for name, place in module.PLACES.items()}


@dataclass
class Tally:
    """Results of the inputs of a target."""

    inputs: int = 0
    refused: int = 0  # as they should be
    escaped: Counter = field(default_factory=Counter)  # number of times of each way to fail
    kept: dict = field(default_factory=dict)  # first input of each way to fail, and what it ended in
    slowest: tuple = (0.0, 0)  # largest CPU time of an input [s], and its length
    taken: float = 0.0  # CPU time of all [s]

    def keep(self, way, data, text):
        """Add a failure."""
        self.escaped[way] += 1
        self.kept.setdefault(way, (data, text))

    def add(self, other):
        """Add the results of further inputs."""
        for name in ("inputs", "refused", "escaped", "taken"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.kept, self.slowest = other.kept | self.kept, max(self.slowest, other.slowest)


def drive(target, inputs, seed, *, slot=None, bombs=False):
    """Results of spoilt inputs.

    Args:
        seed: Inputs are the same for the same seed.
        slot: Where each input is written before it is tried, for whoever looks after a crash.
        bombs: Whether time and memory count as well.
    """
    mutator, tally = Mutator(target.examples, seed), Tally(inputs)
    begun = last = time.process_time()
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
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
            taken, grown = time.process_time() - last, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory
            tally.slowest, memory = max(tally.slowest, (taken, len(data))), memory + max(0, grown)
            if taken > SLOW_S:
                tally.keep("time", data, f"{taken:.1f} s of CPU for {len(data)} bytes")
            if grown > HUGE_KB:
                tally.keep("memory", data, f"{grown // 1024} MB more for {len(data)} bytes")
            last = time.process_time()
    tally.taken = time.process_time() - begun
    return tally


def way_of(error):
    """Where and how it failed: the last line of ours, not of the tests."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "site-packages" not in frame.filename and "/lib/python" not in frame.filename]
    inner = [frame for frame in ours if "/tests/" not in frame.filename] or ours or list(frames)
    return f"{type(error).__name__} in {Path(inner[-1].filename).name}:{inner[-1].lineno}"


def save(folder, name, data, text):
    """Keeps an input, and what it ended in beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{name}--{hashlib.sha256(data + text.encode('utf-8', 'replace')[-200:]).hexdigest()[:12]}.bin"
    file.write_bytes(data)
    file.with_suffix(".txt").write_text(text, encoding="utf-8", errors="backslashreplace")
    return file


def replay(file, size=None):
    """Result of a kept input, or of its first bytes: "read", or the reason of the refusal; raises any other error."""
    with PLACES[file.name.partition("--")[0]].open() as target:
        try:
            target.take(file.read_bytes()[:size])
        except target.refusals as error:
            return f"refused: {type(error).__name__}: {error}"
    return "read"
