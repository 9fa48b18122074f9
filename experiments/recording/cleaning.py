"""Removal of past runs: which folders may go, and in which order, so that what is in use stays."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from experiments.recording.run_folder import ORIGIN, SOURCE, read_origin

LAST: Final = (ORIGIN, SOURCE)  # files that show a folder to be that of a run


class InUse(OSError):
    """Folder in which a run, or another removal, is at work."""


@contextmanager
def using(folder: Path) -> Iterator[None]:
    """Inside, a folder is in use by this process, as every `clean` on this machine sees."""
    with locked(folder, fcntl.LOCK_SH | fcntl.LOCK_NB):
        yield


@contextmanager
def locked(folder: Path, how: int) -> Iterator[bool]:
    """Inside, a folder is locked if its file system has locks, which it yields; the system frees it with the process.

    Raises InUse if it is locked otherwise.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(descriptor, how)
        except BlockingIOError:
            raise InUse(f"{folder} is in use") from None
        except OSError:  # raised by some network file systems
            yield False
        else:
            yield True
    finally:
        os.close(descriptor)


def in_use(folder: Path) -> bool:
    """Whether a run is at work in a folder, as far as its file system has locks."""
    try:
        with locked(folder, fcntl.LOCK_EX | fcntl.LOCK_NB):
            return False
    except InUse:
        return True


def removable(folder: Path) -> bool:
    """Whether a folder is that of a run that zenpark made: what else holds an experiment file is a user's own."""
    origin = read_origin(folder)
    return origin is not None and origin.begun > 0.0 and (folder / SOURCE).is_file() and not folder.is_symlink()


def remove(folder: Path, parts: Sequence[Path] | None = None, *, really: bool = True) -> None:
    """Remove the folder of a run, or some parts of it; if not `really`, only check that nothing is in the way.

    Raises:
        InUse: If a run is at work in it or below it, or may be, where locks are unknown.
        OSError: If something of it cannot be removed; what is left is still known as a run.
    """
    with locked(folder, fcntl.LOCK_EX | fcntl.LOCK_NB) as certain:
        origin = read_origin(folder)
        if not certain and origin is not None and origin.ended is None:
            raise InUse(f"{folder} may be in use: it has no end, and its file system has no locks")
        if parts is None:
            for below in (file.parent for file in folder.rglob(ORIGIN) if file.parent != folder):  # other runs
                with locked(below, fcntl.LOCK_EX | fcntl.LOCK_NB):
                    pass
        if not really:
            return
        for part in sorted(folder.iterdir(), key=lambda part: part.name in LAST) if parts is None else parts:
            _remove(part)
        if parts is None:
            folder.rmdir()


def _remove(part: Path) -> None:
    """Remove a file, a folder, or a link but not what it leads to."""
    if part.is_dir() and not part.is_symlink():
        shutil.rmtree(part)
    else:
        part.unlink(missing_ok=True)
