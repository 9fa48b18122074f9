"""Images of cameras as they come: streams of JPEG over HTTP, webcams, video files; the newest of each."""

from __future__ import annotations

import http.client
import math
import os
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

import cv2
import numpy as np

from agents.clock import uptime
from bridges.motion_capture.cameras.file import CamerasFile, CameraTable
from twins.arrays import Array

SILENCE_S: Final = 2.0  # time without an image after which a camera is connected again [s]
AGAIN_S: Final = 1.0  # pause before that [s]
LARGEST: Final = 1 << 25  # size of an image [bytes]
OLDEST_S: Final = 1.0  # an older time of exposure is that of another clock [s]


class CameraThread(threading.Thread):
    """Receives the images of a camera, and connects again after errors."""

    def __init__(self, table: CameraTable, rate_hz: float, arrived: threading.Condition) -> None:
        super().__init__(daemon=True)
        self._table, self._rate, self._arrived = table, rate_hz, arrived
        self.newest: tuple[float, bytes | Array] | None = None  # time of exposure by `uptime` [s], and the image
        self.trouble = "no image yet"
        self.over = threading.Event()

    def run(self) -> None:
        web = self._table.source.startswith("http://")
        while not self.over.is_set():
            try:
                for exposed, image in self._streamed() if web else self._captured():
                    if self.over.is_set():
                        return
                    with self._arrived:
                        self.newest, self.trouble = (exposed, image), ""
                        self._arrived.notify()
            except (OSError, http.client.HTTPException, ValueError) as error:
                self.trouble = getattr(error, "strerror", None) or str(error) or type(error).__name__
            self.over.wait(AGAIN_S)

    def _streamed(self) -> Iterator[tuple[float, bytes]]:
        """Images of a multipart stream; one that repeats the last to the bit is of a camera that stands still."""
        address = urlsplit(self._table.source)
        connection = http.client.HTTPConnection(address.hostname or "", address.port or 80, timeout=SILENCE_S)
        try:
            connection.request("GET", f"{address.path or '/'}{'?' + address.query if address.query else ''}")
            answer = connection.getresponse()
            if answer.status != http.client.OK:
                raise OSError(f"{answer.status} {answer.reason}")
            last = b""
            while True:
                headers = _headers(answer)
                image = answer.read(int(headers.get("content-length", "0")))
                arrived = uptime()
                if image and image != last:
                    yield arrived - self._age(headers.get("x-timestamp", "")), image
                last = image
        finally:
            connection.close()

    def _age(self, stamp: str) -> float:
        """Age of an image [s] by the UTC of its exposure, if that is of a clock in step with ours."""
        try:
            age = time.time() - float(stamp)
        except ValueError:
            return self._table.latency_s
        return age if 0.0 <= age < OLDEST_S else self._table.latency_s

    def _captured(self) -> Iterator[tuple[float, Array]]:
        """Images of a webcam, or of a video file at its own pace."""
        source = self._table.source
        webcam = source.startswith("/dev/")
        if not Path(source).exists():
            raise OSError(f"{source} is not there")
        if not os.access(source, os.R_OK):
            raise OSError(f"{source} may not be read by you (group video)")
        device: Any = cv2.VideoCapture(source, cv2.CAP_V4L2 if webcam else cv2.CAP_ANY)
        try:
            if not device.isOpened():
                raise OSError(f"{source} cannot be opened")
            if webcam:  # a lens that focuses is another lens
                device.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
                device.set(cv2.CAP_PROP_FPS, self._rate)
                device.set(cv2.CAP_PROP_AUTOFOCUS, 0)
            while True:
                good, image = device.read()
                if not good:
                    raise OSError(f"{source} has ended")
                age = time.monotonic() - 1e-3 * device.get(cv2.CAP_PROP_POS_MSEC) if webcam else math.nan
                yield uptime() - (age if 0.0 <= age < OLDEST_S else self._table.latency_s), image
                if not webcam:
                    time.sleep(1.0 / self._rate)
        finally:
            device.release()


def _headers(answer: http.client.HTTPResponse) -> Mapping[str, str]:
    """Headers of the next part of a multipart stream; raises OSError at its end."""
    headers: dict[str, str] = {}
    while True:
        line = answer.readline(1 << 16)
        if not line:
            raise OSError("the stream has ended")
        name, colon, value = line.decode("latin-1").partition(":")
        if colon:
            headers[name.strip().lower()] = value.strip()
        elif not line.strip() and headers:
            break
    if not 0 < int(headers.get("content-length", "0")) < LARGEST:
        raise OSError("no stream of JPEG images: a part has no Content-Length")
    return headers


class Images:
    """Newest images of all cameras of a file."""

    def __init__(self, file: CamerasFile) -> None:
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)  # warnings of each attempt at a webcam
        cv2.setNumThreads(1)  # its threads wait for each other for longer than they compute
        self._arrived = threading.Condition()
        self._threads = {n: CameraThread(each, file.rate_hz, self._arrived) for n, each in file.cameras.items()}
        for thread in self._threads.values():
            thread.start()

    def newest(self, timeout_s: float) -> list[tuple[str, float, Array]]:
        """Cameras with a new image, times of exposure by `uptime` [s] and grey images, in the order of time."""
        with self._arrived:
            self._arrived.wait_for(lambda: any(each.newest for each in self._threads.values()), timeout_s)
            taken = [(name, each.newest) for name, each in self._threads.items() if each.newest is not None]
            for each in self._threads.values():
                each.newest = None
        images = []
        for name, (exposed, image) in sorted(taken, key=lambda one: one[1][0]):
            if isinstance(image, bytes):
                grey = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_GRAYSCALE)
            else:
                grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
            if grey is not None:
                images.append((name, exposed, grey))
        return images

    @property
    def troubles(self) -> str:
        """Cameras without images, and why; empty if all give some."""
        return ", ".join(f"{name}: {each.trouble}" for name, each in self._threads.items() if each.trouble)

    def close(self) -> None:
        for thread in self._threads.values():
            thread.over.set()
        for thread in self._threads.values():
            thread.join(SILENCE_S)
