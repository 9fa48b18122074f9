"""A million spoilt inputs: `python -m tests.fuzz`, a part of `./zenpark test --all`.

Each target runs in a process of its own, so that a crash, a hang or a thirst for memory ends that alone; what was tried
last is then known all the same. `--replay FILE` tries one kept input again.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import mmap
import multiprocessing
import queue
import resource
import sys
import tempfile
import time
import warnings
from collections.abc import Sequence
from multiprocessing.queues import Queue
from pathlib import Path
from typing import Any

from tests.fuzz.fuzz import Tally, drive, generator, replay, save
from tests.fuzz.mutate import LARGEST
from tests.fuzz.places import PLACES

MILLION = 1_000_000
BLOCK = 1000  # inputs between two lines of progress, at most
HANG_S = 60.0  # without a word for so long a target hangs
ROOM = 4 << 30  # [bytes] a target may map


def run(name: str, inputs: int, seed: int, slot_file: str, told: Queue[Tally | str]) -> None:
    """The process of one target."""
    faulthandler.enable()
    warnings.simplefilter("error")
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_AS, (ROOM, resource.RLIM_INFINITY))
    try:
        with (
            Path(slot_file).open("r+b") as file,
            mmap.mmap(file.fileno(), LARGEST + 8) as slot,
            PLACES[name].open() as target,
        ):
            done = 0
            while done < inputs:
                tally = Tally()
                count = min(BLOCK, inputs - done)
                drive(target, count, generator(seed, name, done // BLOCK), tally, slot=slot, bombs=done > 0)
                done += count
                told.put(tally)
    finally:
        told.put("over")


def fuzz(name: str, inputs: int, seed: int, folder: Path) -> tuple[Tally, list[Path]]:
    """Drives one target in a process of its own; what escaped is kept in the folder."""
    context = multiprocessing.get_context("spawn")
    whole, files, begun = Tally(), list[Path](), time.monotonic()
    with tempfile.NamedTemporaryFile() as slot:
        slot.truncate(LARGEST + 8)
        told: Any = context.Queue()
        process = context.Process(target=run, args=(name, inputs, seed, slot.name, told))
        process.start()
        trouble, heard = "", time.monotonic()
        while True:
            try:
                news = told.get(timeout=1.0)
            except queue.Empty:
                if not process.is_alive():
                    trouble = f"ended with {process.exitcode}"
                    break
                if time.monotonic() - heard > HANG_S:
                    trouble = f"hung for {HANG_S:g} s"
                    break
                continue
            heard = time.monotonic()
            if isinstance(news, str):
                break
            for way, times in news.escaped.items():
                whole.escaped[way] += times
            files += [save(folder, name, kept) for kept in news.kept if _new(kept, whole.kept)]
            whole.kept += news.kept
            whole.inputs, whole.refused = whole.inputs + news.inputs, whole.refused + news.refused
            whole.taken, whole.slowest = whole.taken + news.taken, max(whole.slowest, news.slowest)
            if sys.stderr.isatty():
                print(f"\r{_line(name, whole, inputs)}", end="", file=sys.stderr, flush=True)
        if trouble:
            process.kill()
        process.join()
        if trouble or process.exitcode:
            slot.seek(0)
            raw = slot.read()
            data = raw[4 : 4 + int.from_bytes(raw[:4], "little")]
            whole.escaped[trouble or f"exit code {process.exitcode}"] += 1
            files.append(save(folder, name, (data, trouble or f"exit code {process.exitcode}")))
    ended = "\r" if sys.stderr.isatty() else ""
    print(f"{ended}{_line(name, whole, inputs)}, {time.monotonic() - begun:.0f} s", file=sys.stderr, flush=True)
    return whole, files


def _new(kept: tuple[bytes, str], before: Sequence[tuple[bytes, str]]) -> bool:
    """Whether this way to fail was not met before: by the last lines of its traceback."""
    return all(kept[1].splitlines()[-4:-1] != other[1].splitlines()[-4:-1] for other in before)


def _line(name: str, tally: Tally, inputs: int) -> str:
    each = 1e6 * tally.taken / max(1, tally.inputs)
    escaped = sum(tally.escaped.values())
    return (
        f"{name:<18} {tally.inputs:>7} of {inputs:>7} inputs, {tally.refused:>7} refused, {escaped:>4} escaped, "
        f"{each:6.0f} µs each, slowest {tally.slowest[0]:.3f} s"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=MILLION, metavar="N", help="in all, shared out by the table")
    parser.add_argument("--seed", type=int, default=0, help="of the inputs; 0: of today, and printed")
    parser.add_argument("--target", action="append", choices=sorted(PLACES), help="only these, with all the inputs")
    parser.add_argument("--found", default="fuzz-found", metavar="FOLDER", help="where what escapes is kept")
    parser.add_argument("--replay", metavar="FILE", help="try a kept input again")
    chosen = parser.parse_args(arguments)
    if chosen.replay:
        file = Path(chosen.replay)
        print(replay(PLACES[file.name.partition("--")[0]], file.read_bytes()))
        return 0
    seed = chosen.seed or int(time.time()) // 86400
    names = chosen.target or list(PLACES)
    shares = sum(PLACES[name].inputs for name in names)
    print(f"{chosen.inputs} inputs on {len(names)} targets, seed {seed}", file=sys.stderr, flush=True)
    begun, done, bad = time.monotonic(), 0, list[Path]()
    for name in names:
        tally, files = fuzz(name, -(-chosen.inputs * PLACES[name].inputs // shares), seed, Path(chosen.found))
        done += tally.inputs
        bad += files
        for way, times in tally.escaped.items():
            print(f"  {times} × {way}", file=sys.stderr, flush=True)
        for kept in files:
            print(f"  try again: python -m tests.fuzz --replay {kept}", file=sys.stderr, flush=True)
    print(f"{done} inputs in {time.monotonic() - begun:.0f} s: {len(bad) or 'nothing'} escaped", file=sys.stderr)
    return 1 if bad else 0
