"""The folder of a run: its place and name, and the copy of its experiment file."""

from __future__ import annotations

import itertools
import shutil
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Final

import msgspec

from experiments.file.document import Document
from experiments.file.problems import DocumentError, Problem
from experiments.recording.version import Provenance

RUNS: Final = Path("runs")
SOURCE: Final = "experiment.toml"
ORIGIN: Final = "run.json"


class RunOrigin(msgspec.Struct, frozen=True, omit_defaults=True):
    """Origin of a run, in `run.json` of its folder: enough to do it again."""

    command: str = ""  # how to do the run again, for people
    date: str = ""  # when it was, for people
    title: str = ""  # of the experiment
    file: str = ""  # experiment file, or name in the catalogue, as it was given
    virtual: bool = False  # in virtual time
    cases: list[str] = []  # that were chosen; empty: all
    changes: list[str] = []  # behind `--set` and `--seed`
    seeds: int = 1  # so many, from that of the file on
    bodies: str | None = None  # behind `--bodies`
    here: bool = False  # all robots on this machine
    anyway: bool = False  # although the check found errors
    tags: list[str] = []  # by which people find it again
    begun: float = 0.0  # [s] UTC
    ended: float | None = None  # [s] UTC; None while it goes on, or if it was killed
    load_after: float | None = None  # see `Provenance.load`
    made_by: Provenance | None = None  # code, versions and machine


def read_origin(folder: Path) -> RunOrigin | None:
    """Origin of the run in a folder; None if the folder has none, or another file of that name."""
    try:
        return msgspec.json.decode((folder / ORIGIN).read_bytes(), type=RunOrigin)
    except (OSError, ValueError, RecursionError):  # a case may be called "run"
        return None


def keep_origin(folder: Path, origin: RunOrigin) -> None:
    """Write the origin of a run into its folder."""
    fresh = folder / f"{ORIGIN}.new"
    fresh.write_bytes(msgspec.json.format(msgspec.json.encode(origin), indent=2) + b"\n")
    fresh.replace(folder / ORIGIN)


def new_folder(read: Document, out: str | None, what: str = "") -> Path:
    """Makes the folder of a run: `out`, or one below `runs` with experiment and time in its name, and `what`, if given.

    Raises:
        DocumentError: If it holds something already, or cannot be made.
    """
    folder = RUNS if out is None else Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if out is None:
            return _folder_of_now(folder, "-".join(part for part in (read.path.stem, what) if part))
        taken = any(folder.iterdir())
    except OSError as error:
        hint = "choose a place that may be written to with --out"
        raise DocumentError([Problem(str(folder), 0, 0, f"cannot be made: {error.strerror}", hint)]) from None
    if taken:
        raise DocumentError([Problem(str(folder), 0, 0, "holds something already", "name a new folder with --out")])
    return folder


def _folder_of_now(runs: Path, name: str) -> Path:
    """Makes a folder of its own, however many runs begin in the same second."""
    stamp = datetime.now().astimezone().strftime("%Y-%m-%dT%H-%M-%S")
    for number in itertools.count(1):
        folder = runs / (f"{name}-{stamp}" if number == 1 else f"{name}-{stamp}-{number}")
        with suppress(FileExistsError):
            folder.mkdir()
            return folder
    raise AssertionError


def remove_unused(folder: Path) -> None:
    """Removes the folder of a run without a recording and without a process's log."""
    if not any(folder.glob("*.mcap")) and not any(folder.glob("logs/*")):
        shutil.rmtree(folder, ignore_errors=True)
