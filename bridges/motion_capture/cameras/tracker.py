"""Poses of bodies from the images of several cameras, which need not expose together.

A pure machine: images in, frames out. Corners of a camera are taken at the time of the frame, between two of its
images. A camera counts while it sees floor tags where they were when it was calibrated.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from math import inf
from typing import Final

import numpy as np

from agents.body.capture_reader import MeasuredPose
from bridges.motion_capture.cameras.file import CamerasFile, CamerasFileError, MeasuredCamera, TaggedBody
from bridges.motion_capture.cameras.vision import CameraModel, TagDetector, View, in_space, on_floor, square
from twins.arrays import Array

WHOLE_S: Final = 1.0  # period in which a camera's image is searched as a whole [s]
SEARCH_S: Final = 0.25  # likewise while a body is not seen [s]
LOST_S: Final = 0.2  # a body that was not seen for longer is searched in whole images [s]
LIVE_S: Final = 0.3  # a camera that is silent for longer is not waited for [s]
TOGETHER_S: Final = 0.002  # exposures that differ less count as one [s]
KEPT: Final = 6  # images of which corners are kept
MARGIN_PX: Final = 14.0  # border of a box around the place where a tag is expected [px]
MOVED_PX: Final = 2.0  # floor tags that are farther from their places mean that a camera was moved

Poses = dict[str, MeasuredPose | None]


class TrackedCamera:
    """Camera, and the tags in its last images."""

    def __init__(self, measured: MeasuredCamera, numbers: Sequence[int]) -> None:
        self.camera = CameraModel(measured)
        self.detector = TagDetector(numbers, half_turn=measured.half_turn)
        self.whole_at = -inf  # time of the last image that was searched as a whole [s]
        self.seen: deque[tuple[float, dict[int, Array]]] = deque(maxlen=KEPT)  # time of exposure [s], corners [px]
        self.twice: set[int] = set()  # numbers that were there twice in the last whole image
        self.places: bool | None = None  # whether floor tags are in their places; None: none was seen yet

    @property
    def newest(self) -> float:
        """Time of the last exposure [s]."""
        return self.seen[-1][0] if self.seen else -inf

    def expected(self, number: int, t: float) -> Array | None:
        """Corners (4, 2) of a tag at `t` [s] by its way in the last two images [px]; None if these have it not."""
        if not self.seen or (now := self.seen[-1][1].get(number)) is None:
            return None
        if len(self.seen) < 2 or (before := self.seen[-2][1].get(number)) is None:
            return now
        since = self.seen[-1][0] - self.seen[-2][0]
        return now + (now - before) * min(1.0, (t - self.newest) / since)

    def at(self, number: int, t: float) -> Array | None:
        """Corners (4, 2) of a tag at `t` [s], between two images [px]; None if one of them has it not."""
        later: tuple[float, dict[int, Array]] | None = None
        for time, corners in reversed(self.seen):
            if abs(time - t) <= TOGETHER_S:
                return corners.get(number)
            if time < t:
                one, other = corners.get(number), later[1].get(number) if later else None
                if later is None or one is None or other is None:
                    return None
                return one + (t - time) / (later[0] - time) * (other - one)
            later = time, corners
        return None


class Tracker:
    """Frames of bodies from images."""

    def __init__(self, file: CamerasFile, print_line: Callable[[str], None]) -> None:
        """Track the bodies of a file by its calibrated cameras; raises CamerasFileError if there is none."""
        if not file.measured:
            raise CamerasFileError("no camera is calibrated; run ./zenpark cameras calibrate")
        self._bodies, self._print_line = file.bodies, print_line
        self._floor = {n: square(file.floor.size, *place) for n, place in file.floor.tags.items()}
        numbers = [*(body.tag for body in file.bodies.values()), *self._floor]
        self.cameras = {name: TrackedCamera(each, numbers) for name, each in file.measured.items()}
        self._last: dict[str, tuple[float, Array]] = {}  # time [s] and centre of the tag [m] of each body when seen
        self._time = -inf  # time of the last frame [s]
        self._period = 0.6 / file.rate_hz  # least time between frames [s]; cameras may expose apart
        self._said: dict[str, str] = {}

    def see(self, name: str, exposed: float, grey: Array) -> tuple[float, Poses] | None:
        """Take in the image (height, width) of a camera; returns time [s] and poses of a frame that is complete."""
        tracked = self.cameras.get(name)
        if tracked is None or exposed <= tracked.newest:
            return None
        if grey.shape[::-1] != tracked.camera.size:
            width, height = tracked.camera.size
            size = "{1} x {0}".format(*grey.shape)
            self._say(name, f"camera {name} gives images of {size}, and was calibrated with {width} x {height}: unused")
            return None
        corners = self._search(name, tracked, exposed, grey)
        tracked.seen.append((exposed, corners))
        t = min(each.newest for each in self.cameras.values() if each.newest > exposed - LIVE_S)
        if t < self._time + self._period:
            return None
        self._time = t
        return t, {name: self._located(name, body, t) for name, body in self._bodies.items()}

    def _search(self, name: str, tracked: TrackedCamera, t: float, grey: Array) -> dict[int, Array]:
        """Corners of the tags in an image; whole ones also tell whether the camera was moved."""
        lost = [body for body in self._bodies if t - self._last.get(body, (-inf,))[0] > LOST_S]
        period = 0.0 if len(lost) == len(self._bodies) else SEARCH_S if lost else WHOLE_S
        found: dict[int, Array] = {}
        # one camera after the other, as a frame waits for the slowest; silent ones have no turn
        live = [each for each in self.cameras.values() if each is tracked or each.newest > t - LIVE_S]
        turn = min(live, key=lambda each: each.whole_at) is tracked
        if tracked.places is None or (t - tracked.whole_at >= period and (turn or not period)):
            tracked.whole_at = t
            # tags of bodies that are not seen while others are may be too small
            found, tracked.twice = tracked.detector.whole(grey, 2 if 0 < len(lost) < len(self._bodies) else 1)
            self._check_places(name, tracked, found)
        boxes = {}
        for body, table in self._bodies.items():
            number = table.tag
            if number in found or number in tracked.twice:
                continue
            expected = tracked.expected(number, t)
            if expected is None and body not in lost:
                centre = self._last[body][1]
                expected = tracked.camera.project(centre + square(table.size))
            if expected is not None and np.isfinite(expected).all():
                side = float(np.abs(expected - np.roll(expected, 1, axis=0)).max())
                boxes[number] = expected.mean(axis=0), side + MARGIN_PX
        return found | tracked.detector.near(grey, boxes)

    def _check_places(self, name: str, tracked: TrackedCamera, found: dict[int, Array]) -> None:
        floor = [number for number in self._floor if number in found]
        if not floor:
            if tracked.places is None:
                self._say(name, f"camera {name} sees no floor tag: unused, as it may have been moved")
            return
        expected = tracked.camera.project(np.concatenate([self._floor[number] for number in floor]))
        away = np.concatenate([found[number] for number in floor]) - expected
        off = float(np.median(np.linalg.norm(away.reshape(-1, 4, 2).mean(axis=1), axis=1)))
        tracked.places = off <= MOVED_PX
        text = f"camera {name} sees {len(floor)} floor tags in their places"
        if not tracked.places:
            text = f"camera {name} was moved: floor tags are {off:.1f} px off; unused until it is calibrated again"
        self._say(name, text)

    def _located(self, name: str, body: TaggedBody, t: float) -> MeasuredPose | None:
        views: list[View] = []
        for each in self.cameras.values():
            corners = each.at(body.tag, t) if each.places and body.tag not in each.twice else None
            if corners is not None:
                views.append((each.camera, corners))
        found = None
        if views:
            found = on_floor(views, body.size, body.height) if body.on_floor else in_space(views, body.size)
        if found is None:
            return None
        centre, rotation = found
        self._last[name] = t, centre
        x, y, z = (centre - body.height * rotation[:, 2]).tolist()
        return MeasuredPose((x, y, z), tuple(rotation.ravel().tolist()))

    def _say(self, camera: str, text: str) -> None:
        if self._said.get(camera) != text.split(":", maxsplit=1)[0]:
            self._said[camera] = text.split(":", maxsplit=1)[0]
            self._print_line(text)
