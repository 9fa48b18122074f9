"""AprilTags in images, and poses from their corners: closed forms, with OpenCV for lens and detection.

Corners are clockwise from the tag's upper left one; its x axis points to its upper edge, its y axis to the left. Poses
need no perspective solution of single images: that has two answers, and OpenCV's for squares fails for a camera that
looks straight down.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from math import radians, tan
from typing import Any, Final

import cv2
import numpy as np

from bridges.motion_capture.cameras.file import CamerasFile, MeasuredCamera, PlannedCamera
from twins.arrays import Array

FAMILY: Final = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
FLAT: Final = np.array([[0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0], [-0.5, 0.5, 0.0]])  # corners of side 1
APART: Final = 0.03  # least 1 - cos of the angle between two rays: at 14° a pixel is 4 times as much in depth
WRONG_PX: Final = 2.5  # largest mean error of a pose in the images: views of two tags, or of a camera that has moved
UPRIGHT: Final = 0.5  # least cosine of a tag's tilt
LEAST: Final = 0.03  # least perimeter of a tag as a share of an image's width
BOX: Final = 0.5  # likewise in a box: noise has thousands of small squares
ENLARGED_PX: Final = 60.0  # boxes of a smaller half side are enlarged twice: at 12 px three times as many tags are seen


def square(size: float, x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> Array:
    """Corners (4, 3) of a tag that lies on the floor [m]."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    corners: Array = size * FLAT @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]) + (x, y, 0.0)
    return corners


class CameraModel:
    """Projection of a calibrated camera."""

    def __init__(self, measured: MeasuredCamera) -> None:
        fx, fy, cx, cy = measured.matrix
        self.size = measured.size
        self.matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        self.lens = np.array(measured.lens)
        self.turn = np.array(measured.turn)
        self.rotation: Array = cv2.Rodrigues(self.turn)[0]  # turns vectors of the room into those of the camera
        self.place = np.array(measured.place)
        self.shift = -self.rotation @ self.place

    def project(self, points: Array) -> Array:
        """Pixels (n, 2) of points (n, 3) [m]; NaN for those that are not in front of the camera."""
        pixels: Array = cv2.projectPoints(points, self.turn, self.shift, self.matrix, self.lens)[0].reshape(-1, 2)
        pixels[(points @ self.rotation[2] + self.shift[2]) < 0.05] = np.nan
        return pixels

    def rays(self, pixels: Array) -> Array:
        """Directions (n, 3) of length 1 in the room through pixels (n, 2)."""
        flat = cv2.undistortPoints(pixels.reshape(-1, 1, 2), self.matrix, self.lens).reshape(-1, 2)
        rays: Array = np.column_stack([flat, np.ones(len(flat))]) @ self.rotation
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        return rays


def hung(plan: PlannedCamera) -> MeasuredCamera:
    """A camera without distortion as it is planned."""
    ahead = np.subtract(plan.aim, plan.place) / np.linalg.norm(np.subtract(plan.aim, plan.place))
    right = np.cross(ahead, (0.0, 0.0, 1.0) if np.hypot(ahead[0], ahead[1]) > 1e-3 else (0.0, 1.0, 0.0))
    right /= np.linalg.norm(right)
    turn = cv2.Rodrigues(np.stack([right, np.cross(ahead, right), ahead]))[0].ravel().tolist()
    width, height = plan.size
    focal = 0.5 * width / tan(0.5 * radians(plan.view_deg))
    matrix = focal, focal, 0.5 * width, 0.5 * height
    return MeasuredCamera(plan.size, matrix, (0.0,) * 5, plan.place, tuple(turn))


def placed(lab: CamerasFile) -> dict[str, MeasuredCamera]:
    """Cameras by name where they hang, else where they are planned; those that are neither are left out."""
    plans = {name: camera.planned for name, camera in lab.cameras.items() if name not in lab.measured}
    return {**lab.measured, **{name: hung(plan) for name, plan in plans.items() if plan is not None}}


View = tuple[CameraModel, Array]  # a camera, and the corners (4, 2) of a tag in its image [px]


def on_floor(views: Sequence[View], size: float, height: float) -> tuple[Array, Array] | None:
    """Centre (3,) [m] and rotation (3, 3) of a level tag at a known height; None where the views do not agree."""
    corners, weights = np.zeros((4, 3)), 0.0
    for camera, pixels in views:
        rays = camera.rays(pixels)
        if (rays[:, 2] > -0.05).any():  # parallel to the floor, or upwards
            return None
        ranges = (height - camera.place[2]) / rays[:, 2]
        weight = 1.0 / float(ranges.mean()) ** 2
        corners += weight * (camera.place + ranges[:, None] * rays)
        weights += weight
    corners /= weights
    centre = corners.mean(axis=0)
    arms = corners - centre
    cos, sin = (FLAT * arms).sum(), (FLAT[:, 0] * arms[:, 1] - FLAT[:, 1] * arms[:, 0]).sum()
    yaw = np.arctan2(sin, cos)
    rotation = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    return _agreed(views, size, centre, rotation)


def in_space(views: Sequence[View], size: float) -> tuple[Array, Array] | None:
    """Centre (3,) [m] and rotation (3, 3) of a tag from two views or more.

    Each corner is where its rays come nearest to each other; the rotation is that of Kabsch (1976). None for a single
    view, for rays that are nearly parallel, for a tag that is tilted by more than 60°, and for views that do not agree.
    """
    if len(views) < 2:
        return None
    matrix, vector = np.zeros((4, 3, 3)), np.zeros((4, 3))
    for camera, pixels in views:
        rays = camera.rays(pixels)
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        matrix += across
        vector += across @ camera.place
    if np.linalg.eigvalsh(matrix[0])[0] < APART:
        return None
    corners = np.linalg.solve(matrix, vector[:, :, None])[:, :, 0]
    centre = corners.mean(axis=0)
    left, _, right = np.linalg.svd((corners - centre).T @ FLAT)
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return _agreed(views, size, centre, rotation) if rotation[2, 2] > UPRIGHT else None


def _agreed(views: Sequence[View], size: float, centre: Array, rotation: Array) -> tuple[Array, Array] | None:
    corners = size * FLAT @ rotation.T + centre
    errors = [camera.project(corners) - pixels for camera, pixels in views]
    return (centre, rotation) if np.sqrt(2.0 * np.mean(np.square(errors))) < WRONG_PX else None  # NaN fails


class TagDetector:
    """Finds tags by number."""

    def __init__(self, numbers: Iterable[int], *, half_turn: bool = False) -> None:
        """`half_turn`: tags are those of the AprilTag project, which OpenCV has turned by 180°."""
        self._numbers = sorted(numbers)
        family = cv2.aruco.Dictionary(FAMILY.bytesList[self._numbers], FAMILY.markerSize, FAMILY.maxCorrectionBits)
        self._roll = 2 if half_turn else 0
        settings = cv2.aruco.DetectorParameters()
        # lines fitted to the edges: half the error of the other ways at 20 px, which take two cells for a corner
        settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_CONTOUR
        # two thresholds instead of three: 98 % of the tags in half of the time
        settings.adaptiveThreshWinSizeMin, settings.adaptiveThreshWinSizeMax = 5, 15
        settings.perspectiveRemovePixelPerCell = 8
        settings.minMarkerPerimeterRate = BOX
        settings.errorCorrectionRate = 1.0  # 5 of 36 bits; in whole images too many squares would pass for a tag
        self._box = cv2.aruco.ArucoDetector(family, settings)
        settings.errorCorrectionRate = 0.6
        settings.minMarkerPerimeterRate = LEAST
        settings.adaptiveThreshConstant = 10  # noise is no edge
        self._whole = cv2.aruco.ArucoDetector(family, settings)

    def whole(self, grey: Array, scale: int = 1) -> tuple[dict[int, Array], set[int]]:
        """Corners (4, 2) by number in a whole image [px], and numbers that are there twice.

        Enlarged by `scale`, smaller tags are found too; time grows with its square.
        """
        found = self._found(self._whole, grey, scale)
        times = Counter(number for number, _ in found)
        return {n: corners for n, corners in found if times[n] == 1}, {n for n in times if times[n] > 1}

    def near(self, grey: Array, boxes: Mapping[int, tuple[Array, float]]) -> dict[int, Array]:
        """Corners (4, 2) by number of tags in boxes alone: the centre (2,) and half the side of each [px]."""
        seen = {}
        for number, (centre, half) in boxes.items():
            left, top = np.maximum((centre - half).astype(int), 0).tolist()
            right, bottom = np.ceil(centre + half).astype(int).tolist()
            part = grey[top:bottom, left:right]
            if min(part.shape) < 16:
                continue
            for each, corners in self._found(self._box, part, 2 if half < ENLARGED_PX else 1):
                if each == number:
                    seen[number] = corners + np.array([left, top])
        return seen

    def _found(self, detector: Any, grey: Array, scale: int) -> list[tuple[int, Array]]:  # noqa: ANN401 - of OpenCV
        enlarged = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        corners, rows, _ = detector.detectMarkers(enlarged)
        placed = [np.roll((each.reshape(4, 2) + 0.5) / scale - 0.5, self._roll, axis=0) for each in corners]
        numbers = [] if rows is None else np.ravel(rows).tolist()
        return [(self._numbers[row], each) for row, each in zip(numbers, placed, strict=True)]
