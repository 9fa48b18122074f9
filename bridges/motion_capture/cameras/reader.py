"""CaptureReader of cameras with AprilTags: `cameras://cameras.toml`, a file beside the experiment.

OpenCV is imported with the first connection: a file that names cameras is checked without it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from importlib import import_module
from types import ModuleType
from typing import ClassVar

import msgspec

from agents.body.capture_reader import CaptureFrame, CaptureReader
from agents.clock import uptime
from agents.errors import ExplainedError
from bridges.motion_capture.cameras import file

NEEDED = "cameras need an extra library: ./zenpark install opencv-python-headless, or pip install -e '.[cameras]'"


class MissingLibraryError(ExplainedError):
    """OpenCV is not installed."""


def tool(name: str) -> ModuleType:
    """The module `calibrate` or `coverage`; raises MissingLibraryError without OpenCV."""
    try:
        return import_module(f"bridges.motion_capture.cameras.{name}")
    except ImportError as error:
        raise MissingLibraryError(NEEDED) from error


class CamerasReader(CaptureReader):
    """Images of all cameras of a file, and poses from them; `FILE@HOST:PORT` is a file with the images of a twin."""

    PORT: ClassVar = 0
    FILE: ClassVar = True
    METRES: ClassVar = True
    HINT: ClassVar = "Does each camera of that file show images, in a browser or in a viewer of webcams?"
    TWIN: ClassVar = "bridges.motion_capture.twin.cameras:CamerasTwin"

    def __init__(self, host: str, port: int = 0, timeout_s: float = 2.0) -> None:
        try:
            from bridges.motion_capture.cameras.images import Images  # noqa: PLC0415 - as said above
            from bridges.motion_capture.cameras.tracker import Tracker  # noqa: PLC0415
            from bridges.motion_capture.cameras.vision import placed  # noqa: PLC0415
        except ImportError as error:
            raise MissingLibraryError(NEEDED) from error
        path, _, twin = host.partition("@")
        lab = file.read(path)
        if twin:
            measured = placed(lab)
            cameras = {name: file.CameraTable(f"http://{twin}/{name}") for name in measured}
            lab = msgspec.structs.replace(lab, cameras=cameras, measured=measured)
        self._tracker = Tracker(lab, lambda line: print(f"cameras: {line}", file=sys.stderr, flush=True))
        self._images, self._number = Images(lab), 0
        self._ahead: CaptureFrame | None = None  # frame of the connection
        self._ahead = self.newest(timeout_s)
        if self._ahead is None:
            self.close()
            raise OSError(self._images.troubles or "no frame of all cameras")

    def newest(self, timeout_s: float) -> CaptureFrame | None:
        frame, self._ahead = self._ahead, None
        deadline = time.monotonic() + timeout_s
        while frame is None and (left := deadline - time.monotonic()) > 0.0:
            for name, exposed, grey in self._images.newest(left):
                if (found := self._tracker.see(name, exposed, grey)) is not None:
                    self._number += 1
                    frame = CaptureFrame(self._number, found[1], uptime() - found[0], "z")
        return frame

    def close(self) -> None:
        self._images.close()

    @classmethod
    def parse(cls, address: str) -> tuple[str, int]:
        if not address:
            raise file.CamerasFileError("no file of cameras is named")
        return address, 0

    @classmethod
    def check(cls, text: str, label: str, flies: Mapping[str, bool], *, simulated: bool = False) -> None:
        lab = file.parse(text, label)
        for body, flying in flies.items():
            table = lab.bodies.get(body)
            if table is None:
                known = ", ".join(lab.bodies) or "none"
                raise file.CamerasFileError(f"{label}: no [bodies.{body}]; there are: {known}")
            if flying and table.on_floor:
                raise file.CamerasFileError(f"{label}: [bodies.{body}] is on_floor, but flies; leave on_floor out")
        if not (lab.measured or (simulated and any(camera.planned for camera in lab.cameras.values()))):
            planned = "give each the key `planned`, or " if simulated else ""
            hint = f"{planned}run ./zenpark cameras calibrate {label}"
            raise file.CamerasFileError(f"{label}: no camera is calibrated; {hint}")
