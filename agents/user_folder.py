"""Folders of the user: for files of running processes, emptied by the system at a restart; and for caches."""

from __future__ import annotations

import os
import stat
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Final

OWN: Final = stat.S_IRWXU


SESSIONS: Final = Path("/run/user")  # a folder for each user who is logged in, on Linux with systemd
TEMPORARY: Final = Path("/tmp")  # folder where no variable names another one


def runtime_folders() -> list[Path]:
    """The user's folders, created if missing; raises OSError if none can be, or others could write to all of them.

    A shell with another environment (su, sudo, cron) has another one of them first: what it must find lies in each.
    With `ZENPARK_RUNTIME_DIR` there is that one alone.
    """
    usable, trouble = _usable()
    if not usable:
        raise trouble[0] if trouble else FileNotFoundError("there is no folder for temporary files")
    return usable


def _usable() -> tuple[list[Path], list[OSError]]:
    usable: list[Path] = []
    trouble: list[OSError] = []
    for folder in _of_user():
        try:
            with suppress(FileExistsError):
                folder.mkdir(OWN)
            _check(folder, os.getuid())
            usable.append(folder)
        except OSError as error:
            trouble.append(error)
    return usable, trouble


def runtime_folder() -> Path:
    """The first of the user's folders; raises OSError as `runtime_folders`."""
    return runtime_folders()[0]


def readable_folders() -> tuple[list[Path], list[OSError]]:
    """Folders where something may lie, for root those of all users; and why others of the user cannot be trusted."""
    usable, trouble = _usable()
    return usable + foreign_folders(), trouble


def foreign_folders() -> list[Path]:
    """Folders of the other users, each of which belongs to its user alone; empty for all but root."""
    if os.getuid() != 0 or os.environ.get("ZENPARK_RUNTIME_DIR"):
        return []
    found = [*SESSIONS.glob("*/zenpark"), *(each for place in _temporary() for each in place.glob("zenpark-*"))]
    foreign = []
    for folder in dict.fromkeys(found):
        with suppress(OSError):
            user = folder.lstat().st_uid
            _check(folder, user)
            foreign += [folder] if user else []
    return foreign


def private(folder: Path) -> Path:
    """A folder of the user alone, made if it is missing; raises PermissionError for one that others could write to."""
    folder.mkdir(OWN, parents=True, exist_ok=True)
    _check(folder, os.getuid())
    return folder


def _check(folder: Path, user: int) -> None:
    """Raises PermissionError for a folder to which others than its user could write."""
    about = folder.lstat()
    if not stat.S_ISDIR(about.st_mode) or about.st_uid != user or stat.S_IMODE(about.st_mode) & ~OWN:
        raise PermissionError(f"{folder} is no folder of yours alone: `chmod 700` it, or name another")


def _of_user() -> list[Path]:
    """The folders that the user may have, the usual one of this environment first."""
    if chosen := os.environ.get("ZENPARK_RUNTIME_DIR"):
        return [Path(chosen)]
    me, runtime = os.getuid(), os.environ.get("XDG_RUNTIME_DIR")
    sessions = [*([Path(runtime)] if runtime else []), SESSIONS / str(me)]
    found = [*(each / "zenpark" for each in sessions), *(each / f"zenpark-{me}" for each in _temporary())]
    found = [folder.parent.resolve() / folder.name for folder in found if os.access(folder.parent, os.W_OK)]
    return list(dict.fromkeys(found))  # each once, by whatever path it is known


def _temporary() -> list[Path]:
    return [Path(tempfile.gettempdir()), TEMPORARY]


def cache_folder() -> Path:
    """The user's folder for what can be made again, which need not exist; raises RuntimeError for a user without one.

    `ZENPARK_CACHE_DIR` names another one.
    """
    if chosen := os.environ.get("ZENPARK_CACHE_DIR"):
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "zenpark"
