"""A lab with cameras in its corners, for tests: its file, its truth, and images of it."""

import msgspec
import numpy as np

from bridges.motion_capture.cameras import file, vision
from bridges.motion_capture.cameras.file import PlannedCamera
from bridges.motion_capture.cameras.vision import FLAT, CameraModel, square
from bridges.motion_capture.twin.cameras import CameraImages, sheet

CORNERS = {"A": (-1.7, -1.7, 2.6), "C": (1.7, 1.7, 2.6), "B": (1.7, -1.5, 2.6), "D": (-1.7, 1.6, 2.6)}
FLOOR = {20: (-1.2, -1.2), 21: (1.2, -1.2), 22: (1.2, 1.2), 23: (-1.2, 1.2), 24: (0.0, -1.2), 25: (0.0, 1.2)}


def hung(place, aim=(0.0, 0.0, 0.3), size=(1280, 720), view_deg=83.27):
    """A camera at `place` that looks at `aim`, with a lens that bends straight lines."""
    straight = vision.hung(PlannedCamera(place, aim, size, view_deg))
    return msgspec.structs.replace(straight, lens=(-0.08, 0.01, 0.0, 0.0, 0.0))


def text(bodies, cameras="ABCD", rate_hz=10.0, **settings):
    """The text of a file of cameras that are calibrated; bodies by name: tag, size, height, whether on the floor."""
    lines = [f"rate_hz = {rate_hz}"]
    lines += [f'[cameras.{name}]\nsource = "http://192.168.0.20:8080/{name}"' for name in cameras]
    lines += ["[floor]\nsize = 0.2", "[floor.tags]", *(f"{n} = [{x}, {y}, 0.0]" for n, (x, y) in FLOOR.items())]
    for name, (tag, size, height, on_floor) in bodies.items():
        lines.append(f"[bodies.{name}]\ntag = {tag}\nsize = {size}\nheight = {height}")
        lines += ["on_floor = true"] if on_floor else []
    return file.with_measured("\n".join(lines), {name: hung(CORNERS[name], **settings) for name in cameras})


class Room:
    """Images of a lab by its cameras, of bodies at any poses."""

    def __init__(self, lab, seed=1, floor=None):
        rng = np.random.default_rng(seed)
        floor = lab.floor.tags if floor is None else floor
        tags = [sheet(number, square(lab.floor.size, *place)) for number, place in floor.items()]
        self.bodies = lab.bodies
        self.images = {name: CameraImages(CameraModel(each), tags, rng) for name, each in lab.measured.items()}

    def image(self, camera, poses):
        """Image of a camera; poses by name: position (3,) [m] and rotation (3, 3)."""
        sheets = []
        for name, (position, rotation) in poses.items():
            body = self.bodies[name]
            centre = np.array(position) + body.height * rotation[:, 2]
            sheets.append(sheet(body.tag, centre + body.size * FLAT @ rotation.T))
        return self.images[camera].image(sheets)


def moved(measured, by):
    """The calibration of a camera that hangs elsewhere by `by` [m]."""
    return msgspec.structs.replace(measured, place=tuple((np.array(measured.place) + by).tolist()))
