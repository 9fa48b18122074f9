"""Finished runs of a sweep, on disk, so that none is ever repeated.

A line of `runs.jsonl` holds some runs of one cell under the digest of the cell and of the code. A changed file, or
another zenpark, leads to other digests; lines with former digests are ignored. A line that was cut off while it was
written is ignored as well.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final, Self

import msgspec

from agents.errors import replacing
from experiments.file.problems import DocumentError, refusal
from experiments.sweep.runs import RunMetrics, WorkResult

RUNS: Final = "runs.jsonl"
ORIGIN: Final = "origin.json"


class _Line(msgspec.Struct, frozen=True):
    cell: str
    code: str
    runs: list[RunMetrics]
    failed: dict[int, str] = {}


class StoreOrigin(msgspec.Struct, frozen=True):
    """Origin of a folder: version, digests of code and of file (with its `--set`)."""

    version: str
    code: str
    file: str


class Store:
    """The runs in a folder; a context manager, because two sweeps must not write into one folder."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._path = folder, folder / RUNS
        self._known: dict[tuple[str, str], dict[int, RunMetrics | str]] = {}  # reasons of those that failed

    def __enter__(self) -> Self:
        """Opens the folder, and reads what is there.

        Raises DocumentError if it cannot be made or written, or another sweep is at work in it.
        """
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._file = self._path.open("ab")
        except OSError as error:
            raise refusal(
                str(self._folder), f"cannot be written: {error.strerror}", "choose a place with --out"
            ) from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._file.close()
            raise refusal(str(self._folder), "another sweep is at work in it", "wait for it, or choose --out") from None
        self._read()
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def changed_since(self, now: StoreOrigin) -> list[str]:
        """Changes since the folder was last used, in words; keeps `now` from then on."""
        path = self._folder / ORIGIN
        try:
            before = msgspec.json.decode(path.read_bytes(), type=StoreOrigin)
        except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            before = now
        try:
            with replacing(path) as fresh:
                fresh.write_bytes(msgspec.json.format(msgspec.json.encode(now), indent=2) + b"\n")
        except OSError as error:
            raise self._full(error) from None
        found = []
        if before.version != now.version:
            found.append(f"this is zenpark {now.version}, not {before.version}: all runs are repeated")
        elif before.code != now.code:
            found.append("the code of zenpark or of a plug-in has changed: the runs with that code are repeated")
        if before.file != now.file:
            found.append("the experiment file has changed: affected runs are repeated")
        return found

    def known(self, cell: str, code: str) -> Mapping[int, RunMetrics | str]:
        """Runs of a cell that are done, by seed; of one that failed the reason."""
        return self._known.get((cell, code), {})

    def add(self, cell: str, code: str, outcome: WorkResult) -> None:
        """Keeps results of some seeds; they are on the disk when this returns.

        Raises DocumentError if the disk is full.
        """
        line = _Line(cell, code, outcome.runs, outcome.failed)
        try:
            self._file.write(msgspec.json.encode(line) + b"\n")
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            raise self._full(error) from None
        self._keep(line)

    def _full(self, error: OSError) -> DocumentError:
        return refusal(str(self._folder), f"cannot be written: {error.strerror}", "make room, then go on")

    def _read(self) -> None:
        content = self._path.read_bytes()
        if content and not content.endswith(b"\n"):
            self._file.write(b"\n")  # a line that was cut off must not swallow the next
            self._file.flush()
        for text in content.splitlines():
            with suppress(msgspec.DecodeError, UnicodeDecodeError, RecursionError):
                self._keep(msgspec.json.decode(text, type=_Line))

    def _keep(self, line: _Line) -> None:
        known = self._known.setdefault((line.cell, line.code), {})
        known |= line.failed | {run.seed: run for run in line.runs}
