"""Calibration of cameras, and the sheets for it: `./zenpark cameras calibrate FILE`, `./zenpark cameras print FILE`.

The lens by a ChArUco board that is moved about before the camera; the place by tags on the floor.
"""

from __future__ import annotations

import time
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

import cv2
import msgspec
import numpy as np

from agents.errors import ExplainedError, replacing
from bridges.motion_capture.cameras import file
from bridges.motion_capture.cameras.file import CamerasFile, FloorTags, MeasuredCamera
from bridges.motion_capture.cameras.images import Images
from bridges.motion_capture.cameras.vision import FAMILY, CameraModel, TagDetector, square
from twins.arrays import Array

BOARD: Final = cv2.aruco.CharucoBoard((8, 6), 1.0, 0.75, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
VIEWS: Final = 15  # number of views of the board
LEAST: Final = 12  # corners of the board in a view
NEW: Final = 0.06  # part of the image's width by which a view differs from all others
AREAS: Final = [f"{row} {column}" for row in ("upper", "middle", "lower") for column in ("left", "middle", "right")]
GOOD_PX: Final = 1.0  # largest mean error of a lens
PLACE_PX: Final = 1.5  # likewise of a place: corners of large tags are found 1 px inside of them
FLOOR_TAGS: Final = 3  # least number for a place
FIRST_S: Final = 10.0  # time for the first image of each camera [s]
FLOOR_IMAGES: Final = 10  # images, of which the median corners are taken


class CalibrationError(ExplainedError):
    """A camera that cannot be calibrated, with the remedy."""


class LensViews:
    """Views of the board by a camera."""

    def __init__(self) -> None:
        self._detector = cv2.aruco.CharucoDetector(BOARD)
        self._points: list[tuple[Array, Array]] = []
        self._outlines: list[Array] = []
        self._areas: set[str] = set()
        self.size = 0, 0

    @property
    def count(self) -> int:
        """Number of views so far."""
        return len(self._points)

    @property
    def unseen(self) -> list[str]:
        """Areas of the image in which the board was not yet."""
        return [area for area in AREAS if area not in self._areas]

    @property
    def enough(self) -> bool:
        """Whether the lens can be computed."""
        return self.count >= VIEWS and not self.unseen

    def add(self, grey: Array) -> bool:
        """Take an image in; whether it has the board at a new place."""
        corners, numbers, _, _ = self._detector.detectBoard(grey)
        if numbers is None or len(numbers) < LEAST:
            return False
        height, width = grey.shape
        self.size = width, height
        flat, pixels = BOARD.matchImagePoints(corners, numbers)
        turned, _ = cv2.findHomography(flat[..., :2], pixels)
        if turned is None:
            return False
        edges = np.array([[[0.0, 0.0], [8.0, 0.0], [8.0, 6.0], [0.0, 6.0]]])
        outline = cv2.perspectiveTransform(edges, turned)[0]
        if any(np.abs(outline - other).max() < NEW * width for other in self._outlines):
            return False
        self._outlines.append(outline)
        self._points.append((flat, pixels))
        for x, y in (pixels.reshape(-1, 2) * (2.999 / width, 2.999 / height)).astype(int).tolist():
            self._areas.add(AREAS[3 * y + x])
        return True

    def lens(self) -> tuple[Array, Array, float]:
        """Matrix (3, 3), distortion (5,) and mean error [px] of the lens."""
        flat, pixels = [each for each, _ in self._points], [each for _, each in self._points]
        error, matrix, lens, _, _ = cv2.calibrateCamera(flat, pixels, self.size, None, None)
        return matrix, lens.ravel()[:5], float(error)


def hang(name: str, seen: Mapping[int, Array], floor: FloorTags, lens: MeasuredCamera) -> tuple[MeasuredCamera, float]:
    """A camera in its place, and the mean error [px], from corners (4, 2) of tags on the floor [px].

    Raises CalibrationError for too few tags, or tags that do not lie where the file says.
    """
    numbers = sorted(seen.keys() & floor.tags.keys())
    if len(numbers) < FLOOR_TAGS:
        sees = ", ".join(map(str, numbers)) or "none"
        raise CalibrationError(f"camera {name} sees of the floor tags {sees}; it needs {FLOOR_TAGS}")
    trials = [_hung(numbers, seen, floor, lens, half_turn=half_turn) for half_turn in (False, True)]
    placed, errors = min(trials, key=lambda one: float(np.mean(one[1])))
    if (error := float(np.mean(errors))) > PLACE_PX:
        others = {n: [each for each in numbers if each != n] for n in numbers if len(numbers) > FLOOR_TAGS}
        without = {
            n: float(np.mean(_hung(rest, seen, floor, lens, half_turn=placed.half_turn)[1]))
            for n, rest in others.items()
        }
        worst = min(without, key=without.__getitem__, default=None)
        wrong = "the floor tags lie" if worst is None or without[worst] > PLACE_PX else f"floor tag {worst} lies"
        said = f"camera {name}: {wrong} elsewhere than [floor] says ({error:.1f} px); measure again"
        raise CalibrationError(f"{said}, or calibrate the lens again with --lens")
    return placed, error


def _hung(
    numbers: Sequence[int], seen: Mapping[int, Array], floor: FloorTags, lens: MeasuredCamera, *, half_turn: bool
) -> tuple[MeasuredCamera, Array]:
    """The camera where these tags put it, and the error of each tag [px]."""
    camera = CameraModel(lens)
    room = np.concatenate([square(floor.size, *floor.tags[number]) for number in numbers])
    pixels = np.concatenate([np.roll(seen[number], 2 if half_turn else 0, axis=0) for number in numbers])
    _, turn, shift = cv2.solvePnP(room, pixels, camera.matrix, camera.lens, flags=cv2.SOLVEPNP_SQPNP)
    turn, shift = cv2.solvePnPRefineLM(room, pixels, camera.matrix, camera.lens, turn, shift)
    place = -cv2.Rodrigues(turn)[0].T @ shift.ravel()
    hung = msgspec.structs.replace(
        lens, place=tuple(place.tolist()), turn=tuple(turn.ravel().tolist()), half_turn=half_turn
    )
    away = np.linalg.norm(CameraModel(hung).project(room) - pixels, axis=1)
    return hung, away.reshape(-1, 4).mean(axis=1)


def calibrate(
    lab: CamerasFile,
    images: Images,
    say: Callable[[str], None],
    *,
    again: bool,
    limit_s: float,
    first_s: float = FIRST_S,
) -> dict[str, MeasuredCamera]:
    """Calibration of all cameras of a lab; raises CalibrationError.

    Args:
        again: Whether lenses that are known are measured again.
        limit_s: Time for the lenses, and for the places [s].
        first_s: Time for the first image of each camera [s].
    """
    _wait_for_images(images, set(lab.cameras), first_s)
    lenses = {} if again else dict(lab.measured)
    views = {name: LensViews() for name in lab.cameras if name not in lenses}
    if views:
        say(f"move the board about before {', '.join(views)}: near, far, tilted, into each corner of the image")
    deadline = time.monotonic() + limit_s
    while views:
        for name, _, grey in images.newest(1.0):
            if name not in views or not views[name].add(grey):
                continue
            each = views[name]
            without = f"; not yet {', '.join(each.unseen)}" if each.unseen else ""
            say(f"camera {name}: view {each.count} of {VIEWS}{without}")
            if each.enough:
                lenses[name] = _measured_lens(name, views.pop(name), say)
        if views and time.monotonic() > deadline:
            rest = ", ".join(f"{name}: {each.count} of {VIEWS} views" for name, each in views.items())
            raise CalibrationError(f"the board was not seen often enough ({rest}); {images.troubles or 'more light?'}")
    say("take the board away; the floor tags must be free")
    detector = TagDetector(lab.floor.tags)
    corners: dict[str, dict[int, list[Array]]] = {name: {} for name in lab.cameras}
    counts = dict.fromkeys(lab.cameras, 0)
    deadline = time.monotonic() + limit_s
    while min(counts.values()) < FLOOR_IMAGES:
        for name, _, grey in images.newest(1.0):
            if grey.shape[::-1] != lenses[name].size:
                raise CalibrationError(f"camera {name} gives images of another size than before; use --lens")
            counts[name] += 1
            for number, found in detector.whole(grey)[0].items():
                corners[name].setdefault(number, []).append(found)
        if time.monotonic() > deadline:
            raise CalibrationError(f"no images: {images.troubles}")
    measured = {}
    for name, tags in corners.items():
        seen = {number: np.median(found, axis=0) for number, found in tags.items() if len(found) > counts[name] // 2}
        measured[name], error = hang(name, seen, lab.floor, lenses[name])
        x, y, z = measured[name].place
        kind = ", tags of the AprilTag project" if measured[name].half_turn else ""
        say(f"camera {name} hangs at ({x:.2f}, {y:.2f}, {z:.2f}) m: {len(seen)} floor tags, {error:.2f} px{kind}")
    return measured


def _wait_for_images(images: Images, silent: set[str], first_s: float) -> None:
    """Wait until each of the cameras has given an image; raises CalibrationError after `first_s`."""
    deadline = time.monotonic() + first_s
    while silent:
        silent = silent - {name for name, _, _ in images.newest(1.0)}
        if silent and time.monotonic() > deadline:
            raise CalibrationError(f"no image in {first_s:g} s from {images.troubles}")


def _measured_lens(name: str, views: LensViews, say: Callable[[str], None]) -> MeasuredCamera:
    matrix, lens, error = views.lens()
    if not error < GOOD_PX:
        remedy = "is the board flat, the image sharp, the lens no fish-eye?"
        raise CalibrationError(f"camera {name}: the lens fits no better than {error:.1f} px; {remedy}")
    say(f"camera {name}: lens measured, {error:.2f} px")
    values = [float(matrix[k]) for k in ((0, 0), (1, 1), (0, 2), (1, 2))]
    made = {"size": views.size, "matrix": values, "lens": lens.tolist(), "place": [0.0] * 3, "turn": [0.0] * 3}
    return msgspec.convert(made, MeasuredCamera)


def calibrate_file(path: Path, *, again: bool, limit_s: float) -> None:
    """Calibrate the cameras of a file, and write that into it; arguments as of `calibrate`."""
    lab = file.read(path)
    images = Images(lab)
    try:
        measured = calibrate(lab, images, lambda line: print(line, flush=True), again=again, limit_s=limit_s)
    finally:
        images.close()
    text = file.with_measured(path.read_text("utf-8"), measured)
    file.parse(text, str(path))
    with replacing(path) as fresh:
        fresh.write_text(text, "utf-8")


def print_sheets(path: Path, page: Path) -> None:
    """Write a page with the tags of a file and the board, to print in true size."""
    lab = file.read(path)
    tags = [(f"floor, tag {n}: arrow along x at yaw 0", n, lab.floor.size) for n in lab.floor.tags]
    tags += [(f"{name}, tag {body.tag}: arrow to the nose", body.tag, body.size) for name, body in lab.bodies.items()]
    figures = [
        _figure(f"&uarr; {text}; black square {1e3 * size:g} mm", cv2.aruco.generateImageMarker(FAMILY, n, 8), size)
        for text, n, size in tags
    ]
    board = BOARD.generateImage((1600, 1200), marginSize=0)
    figures.append(_figure("board for the lens: flat on a plate, or on a screen; of any size", board, 0.24))
    style = "figure { page-break-inside: avoid; margin: 12mm; } img { display: block; image-rendering: pixelated; }"
    how = "<p>Print at 100 %. Leave a white border of an eighth of the square.</p>"
    head = f"<!doctype html><meta charset=utf-8><title>Tags</title><style>{style}</style>"
    page.write_text(head + how + "".join(figures), "utf-8")


def _figure(text: str, picture: Array, width: float) -> str:
    data = b64encode(cv2.imencode(".png", picture)[1].tobytes()).decode()
    return f'<figure><img style="width:{1e3 * width:g}mm" src="data:image/png;base64,{data}"><p>{text}</p></figure>'
