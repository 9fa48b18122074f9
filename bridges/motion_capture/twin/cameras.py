"""Twin of cameras: images of the tags of simulated robots, by lenses with distortion, blur and noise, over HTTP."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final, cast

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from agents.body.byte_stream import Framer, MalformedStream, Packet
from bridges.motion_capture.cameras import file as files
from bridges.motion_capture.cameras.vision import FAMILY, FLAT, CameraModel, placed, square
from bridges.motion_capture.twin.capture import CaptureClient, SeenBody, StreamTwin
from twins.arrays import Array

CELLS: Final = 10  # cells of a tag, per axis, with its white border
CELL_PX: Final = 16  # texture of a cell
FINER: Final = 2  # samples of a pixel, per axis
SHIFTS: Final = 4  # number of patterns of noise: images that follow each other differ
DARK, BRIGHT = 20, 235  # grey levels of ink and paper

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Sheet:
    """Flat picture in the room: its corners lie clockwise from the upper left one."""

    picture: Image
    corners: Array  # (4, 3) [m]


@cache
def tag_picture(number: int) -> Image:
    """Picture of a tag with its white border."""
    picture = np.full((CELLS * CELL_PX,) * 2, BRIGHT, np.uint8)
    inside = cv2.aruco.generateImageMarker(FAMILY, number, (CELLS - 2) * CELL_PX)
    picture[CELL_PX:-CELL_PX, CELL_PX:-CELL_PX] = np.where(inside > 0, BRIGHT, DARK)
    return picture


def sheet(number: int, corners: Array) -> Sheet:
    """Tag with the corners (4, 3) of its black square [m]."""
    centre = corners.mean(axis=0)
    return Sheet(tag_picture(number), centre + CELLS / (CELLS - 2) * (corners - centre))


class CameraImages:
    """Images of a camera in a room with tags."""

    def __init__(
        self,
        camera: CameraModel,
        floor: Iterable[Sheet],
        rng: np.random.Generator,
        *,
        noise: float = 3.0,
        blur: float = 0.7,
    ) -> None:
        """`noise` in grey levels, `blur` in pixels, both standard deviations."""
        self._camera, self._blur = camera, blur
        width, height = camera.size
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 1, 2).astype(float)
        flat = cv2.undistortPoints(pixels, camera.matrix, camera.lens)
        self._flat = flat.reshape(height, width, 2).astype(np.float32)
        coarse = rng.normal(125.0, 14.0, (45, 80)).astype(np.float32)
        self._floor: Image = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC).astype(np.uint8)
        for each in floor:
            self._draw(self._floor, each)
        self._noise = rng.normal(0.0, noise, (height + SHIFTS, width + SHIFTS)).astype(np.int16)
        self._noisy = [self._with_noise(self._floor, shift, 0, 0) for shift in range(SHIFTS)]
        self._shift = 0

    def image(self, sheets: Iterable[Sheet]) -> Image:
        """Image of these sheets, of which higher ones hide lower ones."""
        self._shift = (self._shift + 1) % SHIFTS
        image, clean = self._noisy[self._shift].copy(), self._floor.copy()
        boxes = [self._draw(clean, each) for each in sorted(sheets, key=lambda one: float(one.corners[:, 2].mean()))]
        for top, bottom, left, right in boxes:
            image[top:bottom, left:right] = self._with_noise(clean[top:bottom, left:right], self._shift, top, left)
        return image

    def _with_noise(self, image: Image, shift: int, top: int, left: int) -> Image:
        height, width = image.shape
        noise = self._noise[top + shift : top + shift + height, left + shift : left + shift + width]
        return cast("Image", cv2.add(image, noise, dtype=cv2.CV_8U)) if image.size else image

    def _draw(self, image: Image, sheet: Sheet) -> tuple[int, int, int, int]:
        """Draw a sheet; returns the rows and columns that have changed."""
        camera, corners = self._camera, sheet.corners
        pixels = camera.project(corners)
        if not np.isfinite(pixels).all():
            return 0, 0, 0, 0
        left, top = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 4, 0).tolist()
        right, bottom = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 5, camera.size).tolist()
        if right - left < 2 or bottom - top < 2:
            return 0, 0, 0, 0
        # from rays to the plane of the sheet: upper left corner, and edges along rows and columns
        plane = np.stack([corners[1] - corners[0], corners[3] - corners[0], corners[0] - camera.place], axis=1)
        inverse = np.linalg.inv(camera.rotation @ plane)
        size = ((right - left) * FINER, (bottom - top) * FINER)
        rays = cv2.resize(self._flat[top:bottom, left:right], size, interpolation=cv2.INTER_LINEAR)
        u, v, w = (rays[..., 0] * row[0] + rays[..., 1] * row[1] + row[2] for row in inverse)
        height, width = sheet.picture.shape
        x, y = (width * (u / w) - 0.5).astype(np.float32), (height * (v / w) - 0.5).astype(np.float32)
        inside = ((x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)).astype(np.float32)
        seen = cv2.remap(sheet.picture.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        coarse = (right - left, bottom - top)
        mask = cv2.resize(inside, coarse, interpolation=cv2.INTER_AREA)
        seen = cv2.resize(seen * inside, coarse, interpolation=cv2.INTER_AREA)
        if self._blur:
            mask, seen = (cv2.GaussianBlur(each, (0, 0), self._blur) for each in (mask, seen))
        part = image[top:bottom, left:right]
        part[:] = np.rint(seen + (1.0 - mask) * part)
        return top, bottom, left, right


class RequestFramer(Framer):
    """Waits for the end of a request of HTTP."""

    def __init__(self) -> None:
        self._unread = bytearray()

    def feed(self, received: bytes) -> list[Packet]:
        self._unread += received
        if b"\r\n\r\n" in self._unread:
            request, self._unread = bytes(self._unread), bytearray()
            return [(0, request)]
        if len(self._unread) > 1 << 16:
            raise MalformedStream("no request of HTTP")
        return []


class CamerasTwin(StreamTwin):
    """Cameras of a file, as streams of JPEG over HTTP at `/NAME`, with the UTC of each exposure.

    A body that is not tracked has no tag in the images; one that is frozen is in images that repeat themselves.
    """

    framer = RequestFramer

    def __init__(self, bodies: Sequence[str], *, file: str, **settings: Any) -> None:  # noqa: ANN401 - as of the base
        """Settings as of `CaptureTwin`; raises ValueError for a file that lacks a body, or the place of a camera."""
        lab = files.read(file)
        if strangers := [body for body in bodies if body not in lab.bodies]:
            raise ValueError(f"{file}: no [bodies.{strangers[0]}]")
        cameras = placed(lab)
        if not cameras:
            raise ValueError(f"{file}: no camera is calibrated or planned; run ./zenpark cameras calibrate {file}")
        self._file, self._tags = file, lab.bodies
        rng = settings["rng"] = settings.get("rng") or np.random.default_rng(0)
        floor = [sheet(number, square(lab.floor.size, *place)) for number, place in lab.floor.tags.items()]
        self._images = {name: CameraImages(CameraModel(each), floor, rng) for name, each in cameras.items()}
        self._drawn: tuple[Sequence[SeenBody], dict[str, bytes]] = [], {}
        settings["rate_hz"] = min(settings.get("rate_hz", lab.rate_hz), lab.rate_hz)
        super().__init__(bodies, **settings)

    def _listen(self, host: str, port: int) -> None:
        super()._listen(host, port)
        self.address = f"{self._file}@{self.address}"

    def _answer(self, client: CaptureClient, kind: int, payload: bytes) -> None:
        if client.streams:
            return
        client.camera = payload.split(b" ")[1].decode("latin-1").strip("/") if b" " in payload else ""
        client.streams = client.camera in self._images
        status = "200 OK" if client.streams else "404 Not Found"
        client.unsent += f"HTTP/1.0 {status}\r\nContent-Type: multipart/x-mixed-replace;boundary=image\r\n\r\n".encode()

    def _packet(self, client: CaptureClient, frame: bytes) -> bytes:
        try:
            exposed, images = msgspec.msgpack.decode(frame, type=tuple[float, dict[str, bytes]])
            image = images[client.camera]
        except (msgspec.DecodeError, UnicodeDecodeError, KeyError):  # damaged
            return b""
        head = f"--image\r\nContent-Length: {len(image)}\r\nX-Timestamp: {exposed:.6f}\r\n\r\n"
        return head.encode() + image + b"\r\n"

    def _encode(self, number: int, t: float, bodies: Sequence[SeenBody]) -> bytes:
        exposed = time.time() - self.latency_s
        if bodies is not self._drawn[0]:
            sheets = []
            for body in bodies:
                tag = self._tags.get(body.name)
                if tag is not None and body.tracked:
                    centre = body.position + tag.height * body.rotation[:, 2]
                    sheets.append(sheet(tag.tag, centre + tag.size * FLAT @ body.rotation.T))
            drawn = {name: jpeg(images.image(sheets)) for name, images in self._images.items()}
            self._drawn = bodies, drawn
        return msgspec.msgpack.encode((exposed, self._drawn[1]))


def jpeg(image: Image) -> bytes:
    """An image as JPEG."""
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
