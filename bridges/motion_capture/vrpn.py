"""CaptureReader of VRPN by the library `motioncapture`, in a process of its own, which may hang or be killed.

The library tells poses by name alone: no latency, no frame number, no upward axis; hidden bodies are left out.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import signal
import subprocess
import sys
import time
from typing import BinaryIO, ClassVar, Final

import msgspec

from agents.body.capture_reader import CHUNK, CaptureFrame, CaptureReader, MeasuredPose, rotation_of
from agents.errors import ExplainedError

WITH_PARENT: Final = 1  # PR_SET_PDEATHSIG of Linux
Poses = dict[str, tuple[float, float, float, float, float, float, float]]  # position, and quaternion x, y, z, w
NEEDED: Final = "VRPN needs an extra library: ./zenpark install motioncapture, or pip install -e '.[vrpn]'"


class MissingVrpnError(ExplainedError):
    """The library is not installed."""


class VrpnReader(CaptureReader):
    """Frames of a child process, as lines of JSON; it is killed when it is silent, and another one is started."""

    PORT: ClassVar = 3883
    PROGRAM: ClassVar = "the VRPN server"

    def __init__(self, host: str, port: int = 3883, timeout_s: float = 2.0) -> None:
        if importlib.util.find_spec("motioncapture") is None:
            raise MissingVrpnError(NEEDED)
        self._number, self._rest = 0, b""
        self._names = set[str]()  # bodies that were seen: hidden ones are left out
        read, write = os.pipe()
        os.set_blocking(read, False)
        command = [sys.executable, "-m", "bridges.motion_capture.vrpn", f"{host}:{port}", str(write)]
        silent = subprocess.DEVNULL
        self._frames: BinaryIO = os.fdopen(read, "rb", buffering=0)
        try:
            self._child = subprocess.Popen(command, stdin=silent, stdout=silent, pass_fds=[write])
        finally:
            os.close(write)
        try:
            self._first = self._wait(timeout_s)
            if self._first is None:
                raise TimeoutError("no answer")
        except OSError:
            self.close()
            raise

    def newest(self, timeout_s: float) -> CaptureFrame | None:
        poses, self._first = self._first or self._wait(timeout_s), None
        if poses is None:
            return None
        self._number += 1
        hidden = dict.fromkeys(self._names - poses.keys())
        self._names |= poses.keys()
        seen = {name: MeasuredPose((x, y, z), rotation_of(turn)) for name, (x, y, z, *turn) in poses.items()}
        return CaptureFrame(self._number, hidden | seen)

    def close(self) -> None:
        self._child.kill()
        self._child.wait()
        self._frames.close()

    def _wait(self, timeout_s: float) -> Poses | None:
        """Poses of the last whole line; None at the timeout [s]."""
        deadline = time.monotonic() + timeout_s
        while True:
            while part := self._frames.read(CHUNK):
                self._rest += part
            if part is not None:  # the end of the pipe
                raise ConnectionResetError(f"the library motioncapture has ended ({self._child.wait()})")
            *lines, self._rest = self._rest.rsplit(b"\n", 1)
            if lines:
                return msgspec.json.decode(lines[0].rpartition(b"\n")[2], type=Poses)
            if time.monotonic() >= deadline:
                return None
            time.sleep(0.002)


def tell(server: str, pipe: BinaryIO) -> None:
    """Write the frames of a server to a pipe, without end."""
    import motioncapture  # noqa: PLC0415 - in the child alone

    capture = motioncapture.connect("vrpn", {"hostname": server})
    while True:
        capture.waitForNextFrame()
        poses = {
            name: (*map(float, body.position), body.rotation.x, body.rotation.y, body.rotation.z, body.rotation.w)
            for name, body in capture.rigidBodies.items()
        }
        if poses:
            pipe.write(msgspec.json.encode(poses) + b"\n")


if __name__ == "__main__":
    if sys.platform == "linux":  # a library that hangs does not notice the end of its parent
        ctypes.CDLL(None).prctl(WITH_PARENT, signal.SIGKILL)
    tell(sys.argv[1], os.fdopen(int(sys.argv[2]), "wb", buffering=0))
