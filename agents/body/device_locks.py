"""Exclusive use of a device on this machine: a lock on it, held while its body is open.

The locks are files of all runtime folders of the user (`agents.user_folder`): a process with another environment has
another one first. They end with their process. Other machines and other users are not excluded; root finds the
locks of all users.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from agents.body.device_address import DeviceAddress, resolved
from agents.body.interface import BodyError, BodyRequest
from agents.plugins import registry
from agents.user_folder import foreign_folders, runtime_folders

LONGEST: Final = 200  # [bytes] longest description of a holder


class Claims:
    """Locks on the devices of robots, held between `take` and `release`.

    A device has a lock of its own, and shares one for each part of its address that others may leave out.
    """

    def __init__(self, devices: Sequence[tuple[str, DeviceAddress]] = ()) -> None:
        """`devices` and the names of their robots."""
        self._wanted = devices
        self._locks: list[tuple[Path, int]] = []  # open files

    @classmethod
    def of(cls, request: BodyRequest) -> Claims:
        """Devices of all rows of a request, by the classes of their bodies; raises BodyError for wrong addresses."""
        devices = []
        for robot in request.entries():
            body = registry.load(registry.BODIES, registry.body_name(robot.address))
            if (device := body.device_of(robot, request.endpoints)) is not None:
                devices.append((robot.name, device))
        return cls(devices)

    def take(self) -> None:
        """Locks all devices, or none, before the first byte goes to one; raises BodyError with the holder.

        Takes at most `RESOLVE_S` of `agents.body.device_address` and some files' time.
        """
        hosts = resolved({host for _, device in self._wanted for host in device.hosts})
        for name, device in self._wanted:
            try:
                for key, own in device.lock_keys(hosts):
                    mode = fcntl.LOCK_EX if own else fcntl.LOCK_SH
                    file = f"device-{hashlib.sha256(key.encode()).hexdigest()[:32]}.lock"
                    found = [each / file for each in foreign_folders() if (each / file).is_file()]
                    for path in [*(each / file for each in runtime_folders()), *found]:
                        self._locks.append((path, _lock(path, name, device.address, mode)))
            except OSError as error:
                self.release()
                raise BodyError(
                    f"no lock on {device.address}, which keeps other processes off {name}: {error}; "
                    "set ZENPARK_RUNTIME_DIR to a folder that is yours alone (mode 0700)"
                ) from error
            except BodyError:
                self.release()
                raise

    def release(self) -> None:
        while self._locks:
            path, lock = self._locks.pop()
            with suppress(OSError):
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # fails while others share it
                path.unlink()  # still locked: a process that waits at this file finds that it is gone
            os.close(lock)


def _lock(path: Path, name: str, address: str, mode: int) -> int:
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(file, mode | fcntl.LOCK_NB)
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
