"""Exclusive use of a device on this machine: a lock on its address, held while a body is open.

The locks are files of all runtime folders of the user (`agents.user_folder`): a process with another environment has
another one first. They end with their process. Other machines and other users are not excluded; root finds the
locks of all users.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import socket
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from agents.body.interface import BodyError
from agents.user_folder import foreign_folders, runtime_folders

LONGEST: Final = 200  # [bytes] longest description of a holder


def numeric(host: str) -> str:
    """The IPv4 address of a host, equal for all its names; the name itself if it cannot be resolved."""
    try:
        return socket.gethostbyname(host)
    except (OSError, UnicodeError):
        return host.lower()


class Claims:
    """Locks on the devices of a body, held between `take` and `release`."""

    def __init__(self, names: Sequence[str], addresses: Sequence[str]) -> None:
        """`addresses` are canonical: equal ones are the same device."""
        self._wanted = list(zip(names, addresses, strict=True))
        self._locks: dict[Path, int] = {}  # open files

    def take(self) -> None:
        """Locks all devices, or none, before the first byte goes to one; raises BodyError with the holder."""
        try:
            for name, address in self._wanted:
                file = f"device-{hashlib.sha256(address.encode()).hexdigest()[:32]}.lock"
                there = [each / file for each in foreign_folders() if (each / file).is_file()]
                for path in [*(each / file for each in runtime_folders()), *there]:
                    self._locks[path] = _lock(path, name, address)
        except OSError as error:
            self.release()
            raise BodyError(
                f"no lock on {address}, which keeps other processes off {name}: {error}; "
                "set ZENPARK_RUNTIME_DIR to a folder that is yours alone (mode 0700)"
            ) from error
        except BodyError:
            self.release()
            raise

    def release(self) -> None:
        while self._locks:
            path, lock = self._locks.popitem()
            with suppress(OSError):
                path.unlink()  # still locked: a process that waits at this file finds that it is gone
            os.close(lock)


def _lock(path: Path, name: str, address: str) -> int:
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _still_at(path, file):
                os.ftruncate(file, 0)
                os.write(file, f"{os.getpid()} {name}".encode())
                return file
        except BlockingIOError:
            holder, _, other = os.read(file, LONGEST).decode(errors="replace").partition(" ")
            os.close(file)
            driver = "this process" if holder == str(os.getpid()) else f"process {holder or '(not known yet)'}"
            of = f" for {other}" if other else ""
            raise BodyError(f"{name}: {address} is in use: {driver} drives it{of}; end that first") from None
        except BaseException:
            os.close(file)
            raise
        os.close(file)


def _still_at(path: Path, file: int) -> bool:
    """Whether an open file still has this path; its last holder may have removed it meanwhile."""
    try:
        return os.path.samestat(path.lstat(), os.fstat(file))
    except FileNotFoundError:
        return False
