"""Folders of the user: for files of running processes, emptied by the system at a restart; and for caches."""

from __future__ import annotations

import os
import stat
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Final

OWN: Final = stat.S_IRWXU


def runtime_folder() -> Path:
    """The user's folder, created if missing; raises OSError if it cannot be created, or others could write there."""
    chosen, runtime = os.environ.get("ZENPARK_RUNTIME_DIR"), os.environ.get("XDG_RUNTIME_DIR")
    if chosen:
        folder = Path(chosen)
    elif runtime and os.access(runtime, os.W_OK):
        folder = Path(runtime) / "zenpark"
    else:
        folder = Path(tempfile.gettempdir()) / f"zenpark-{os.getuid()}"
    with suppress(FileExistsError):
        folder.mkdir(OWN)
    about = folder.lstat()
    if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.getuid() or stat.S_IMODE(about.st_mode) & ~OWN:
        raise PermissionError(f"{folder} is no folder of yours alone: `chmod 700` it, or name another")
    return folder


def cache_folder() -> Path:
    """The user's folder for what can be made again, which need not exist; raises RuntimeError for a user without one.

    `ZENPARK_CACHE_DIR` names another one.
    """
    if chosen := os.environ.get("ZENPARK_CACHE_DIR"):
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "zenpark"
