"""The folder of a run: its place and name, and the copy of its experiment file."""

from __future__ import annotations

import itertools
import shutil
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Final

from experiments.file.document import Document
from experiments.file.problems import DocumentError, Problem

RUNS: Final = Path("runs")
SOURCE: Final = "experiment.toml"


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
