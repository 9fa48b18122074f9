"""A million spoilt inputs: `python -m tests.fuzz`, a part of `./zenpark test --all`.

What is refused is counted; what escapes, and what takes too long or too much memory, is kept. Each target runs in a
process of its own: a crash, a hang or a thirst for memory ends that alone; the last input is known.
"""

import argparse
import contextlib
import faulthandler
import hashlib
import mmap
import multiprocessing
import resource
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from tests.fuzz import targets_devices, targets_files, targets_network, targets_ros  # noqa: F401
from tests.fuzz.mutate import LARGEST, Mutator
from tests.fuzz.target import PLACES

SLOW_S = 1.0  # CPU time that no input of 64 kB may take
HUGE_KB = 100 * 1024  # by which no input may make the process larger
BLOCK = 1000  # inputs between two lines of progress, at most
HANG_S = 60.0  # without news of a block a target hangs
ROOM = 4 << 30  # [bytes] a target may map


@dataclass
class Tally:
    """Results of the inputs of a target."""

    inputs: int = 0
    refused: int = 0  # as they should be
    escaped: Counter = field(default_factory=Counter)  # number of times of each way to fail
    kept: dict = field(default_factory=dict)  # first input of each way to fail, and what it ended in
    slowest: float = 0.0  # largest CPU time of an input [s]
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
            tally.slowest, memory = max(tally.slowest, taken), memory + max(0, grown)
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


def replay(file, size=None):
    """Result of a kept input, or of its first bytes: "read", or the reason of the refusal; raises any other error."""
    with PLACES[file.name.partition("--")[0]].open() as target:
        try:
            target.take(file.read_bytes()[:size])
        except target.refusals as error:
            return f"refused: {type(error).__name__}: {error}"
    return "read"


def run(name, inputs, seed, slot_file, news):
    """The process of one target."""
    faulthandler.enable()
    warnings.simplefilter("error")
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_AS, (ROOM, resource.RLIM_INFINITY))
    with Path(slot_file).open("r+b") as file, mmap.mmap(file.fileno(), 0) as slot, PLACES[name].open() as target:
        for begin in range(0, inputs, BLOCK):
            block = min(BLOCK, inputs - begin)
            news.send(drive(target, block, (seed, name, begin), slot=slot, bombs=begin > 0))


def fuzz(name, inputs, seed):
    """Drives one target in a process of its own."""
    whole, begun = Tally(), time.monotonic()
    context = multiprocessing.get_context("spawn")
    reader, writer = context.Pipe(duplex=False)

    def show(begin="\r", end=""):
        each = f"{1e6 * whole.taken / max(1, whole.inputs):6.0f} µs each, slowest {whole.slowest:.3f} s"
        counts = f"{whole.refused:>7} refused, {whole.escaped.total():>4} escaped"
        text = f"{name:<18} {whole.inputs:>7} of {inputs:>7} inputs, {counts}, {each}"
        print(f"{begin * sys.stderr.isatty()}{text}", end=end, file=sys.stderr, flush=True)

    with tempfile.NamedTemporaryFile() as slot:
        slot.truncate(LARGEST + 8)
        process = context.Process(target=run, args=(name, inputs, seed, slot.name, writer))
        process.start()
        writer.close()  # its end in the other process alone is left: that process' end is read here
        trouble = ""
        try:
            while reader.poll(HANG_S):
                whole.add(reader.recv())
                if sys.stderr.isatty():
                    show()
            trouble = f"hung for {HANG_S:g} s"
            process.kill()
        except EOFError:  # it has ended
            pass
        process.join()
        if process.exitcode:
            trouble, raw = trouble or f"ended with {process.exitcode}", Path(slot.name).read_bytes()
            whole.keep(trouble, raw[4 : 4 + int.from_bytes(raw[:4], "little")], trouble)
    show(end=f", {time.monotonic() - begun:.0f} s\n")
    return whole


def main(arguments=None):
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=1_000_000, metavar="N", help="in all, shared out by the table")
    parser.add_argument("--seed", type=int, default=0, help="of the inputs; 0: of today, and printed")
    parser.add_argument("--target", action="append", choices=sorted(PLACES), help="only these, with all the inputs")
    parser.add_argument("--found", default="fuzz-found", metavar="FOLDER", help="where what escapes is kept")
    parser.add_argument("--replay", metavar="FILE", help="try a kept input again")
    chosen = parser.parse_args(arguments)
    if chosen.replay:
        print(replay(Path(chosen.replay)))
        return 0
    seed, folder = chosen.seed or int(time.time()) // 86400, Path(chosen.found)
    names = chosen.target or list(PLACES)
    shares = sum(PLACES[name].inputs for name in names)
    print(f"{chosen.inputs} inputs on {len(names)} targets, seed {seed}", file=sys.stderr, flush=True)
    begun, done, bad = time.monotonic(), 0, 0
    for name in names:
        tally = fuzz(name, -(-chosen.inputs * PLACES[name].inputs // shares), seed)
        done, bad = done + tally.inputs, bad + len(tally.kept)
        for way, (data, text) in tally.kept.items():
            folder.mkdir(parents=True, exist_ok=True)
            digest = hashlib.sha256(data + text.encode("utf-8", "replace")[-200:]).hexdigest()[:12]
            kept = folder / f"{name}--{digest}.bin"
            kept.write_bytes(data)
            kept.with_suffix(".txt").write_text(text, encoding="utf-8", errors="backslashreplace")
            print(f"  {tally.escaped[way]} × {way}: python -m tests.fuzz --replay {kept}", file=sys.stderr, flush=True)
    print(f"{done} inputs in {time.monotonic() - begun:.0f} s: {bad or 'nothing'} escaped", file=sys.stderr)
    return 1 if bad else 0
