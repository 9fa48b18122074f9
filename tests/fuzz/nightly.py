"""A million spoilt inputs: `python -m tests.fuzz`, a part of `./zenpark test --all`.

Each target runs in a process of its own: a crash, a hang or a thirst for memory ends that alone; the last input is
known. `--replay FILE` tries one kept input again.
"""

import argparse
import contextlib
import faulthandler
import mmap
import multiprocessing
import resource
import sys
import tempfile
import time
import warnings
from pathlib import Path

from tests.fuzz.fuzz import PLACES, Tally, drive, replay, save
from tests.fuzz.mutate import LARGEST

MILLION = 1_000_000
BLOCK = 1000  # inputs between two lines of progress, at most
HANG_S = 60.0  # without news of a block a target hangs
ROOM = 4 << 30  # [bytes] a target may map


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
                    print(f"\r{line(name, whole, inputs)}", end="", file=sys.stderr, flush=True)
            trouble = f"hung for {HANG_S:g} s"
            process.kill()
        except EOFError:  # it has ended
            pass
        process.join()
        if process.exitcode:
            trouble, raw = trouble or f"ended with {process.exitcode}", Path(slot.name).read_bytes()
            whole.keep(trouble, raw[4 : 4 + int.from_bytes(raw[:4], "little")], trouble)
    ended = "\r" if sys.stderr.isatty() else ""
    print(f"{ended}{line(name, whole, inputs)}, {time.monotonic() - begun:.0f} s", file=sys.stderr, flush=True)
    return whole


def line(name, tally, inputs):
    each = f"{1e6 * tally.taken / max(1, tally.inputs):6.0f} µs each, slowest {tally.slowest[0]:.3f} s"
    counts = f"{tally.refused:>7} refused, {tally.escaped.total():>4} escaped"
    return f"{name:<18} {tally.inputs:>7} of {inputs:>7} inputs, {counts}, {each}"


def main(arguments=None):
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=MILLION, metavar="N", help="in all, shared out by the table")
    parser.add_argument("--seed", type=int, default=0, help="of the inputs; 0: of today, and printed")
    parser.add_argument("--target", action="append", choices=sorted(PLACES), help="only these, with all the inputs")
    parser.add_argument("--found", default="fuzz-found", metavar="FOLDER", help="where what escapes is kept")
    parser.add_argument("--replay", metavar="FILE", help="try a kept input again")
    chosen = parser.parse_args(arguments)
    if chosen.replay:
        print(replay(Path(chosen.replay)))
        return 0
    seed = chosen.seed or int(time.time()) // 86400
    names = chosen.target or list(PLACES)
    shares = sum(PLACES[name].inputs for name in names)
    print(f"{chosen.inputs} inputs on {len(names)} targets, seed {seed}", file=sys.stderr, flush=True)
    begun, done, bad = time.monotonic(), 0, 0
    for name in names:
        tally = fuzz(name, -(-chosen.inputs * PLACES[name].inputs // shares), seed)
        done, bad = done + tally.inputs, bad + len(tally.kept)
        for way, (data, text) in tally.kept.items():
            kept = save(Path(chosen.found), name, data, text)
            print(f"  {tally.escaped[way]} × {way}: python -m tests.fuzz --replay {kept}", file=sys.stderr, flush=True)
    print(f"{done} inputs in {time.monotonic() - begun:.0f} s: {bad or 'nothing'} escaped", file=sys.stderr)
    return 1 if bad else 0
