"""Coverage of a room by cameras, before or after they hang: `./zenpark cameras coverage FILE`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

import numpy as np

from bridges.motion_capture.cameras import file
from bridges.motion_capture.cameras.file import CamerasFileError, TaggedBody
from bridges.motion_capture.cameras.vision import CameraModel, View, in_space, on_floor, placed, square
from twins.arrays import Array

FOUND_PX: Final = 14.0  # shortest side of a tag of which 98 % are found by boxes; at 12 px 69 %
STEPS: Final = 13  # places along x and y
HEIGHTS: Final = 6  # heights of drones
SIZES: Final = (0.04, 0.05, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2)  # tags that are proposed [m]
SHORTEST_M, LONGEST_M = 0.1, 100.0  # sides of a room
ENOUGH: Final = 0.99  # share of the places that is good enough


def is_seen(cameras: list[CameraModel], body: TaggedBody, size: float, place: tuple[float, float, float]) -> bool:
    """Whether a body at a place [m], with a level tag of a size [m], is seen by as many cameras as it needs."""
    corners, views = square(size) + place + np.array([0.0, 0.0, body.height]), list[View]()
    for camera in cameras:
        pixels = camera.project(corners)
        sides = np.linalg.norm(pixels - np.roll(pixels, 1, axis=0), axis=1)
        border = 0.2 * sides.max()
        inside = (pixels > border).all() and (pixels < np.array(camera.size) - border).all()  # NaN is not
        if inside and sides.min() >= FOUND_PX:
            views.append((camera, pixels))
    if body.on_floor:
        return bool(views) and on_floor(views, size, body.height) is not None
    return in_space(views, size) is not None


def shares(
    cameras: list[CameraModel], body: TaggedBody, size: float, room: tuple[float, float, float]
) -> Mapping[float, Array]:
    """By height of a body [m]: whether it is seen (STEPS, STEPS), rows along y, over a room around the origin [m]."""
    heights = [0.0] if body.on_floor else np.linspace(0.0, room[2], HEIGHTS).round(2).tolist()
    x, y = (np.linspace(-0.5 * side, 0.5 * side, STEPS).tolist() for side in room[:2])
    return {z: np.array([[is_seen(cameras, body, size, (a, b, z)) for a in x] for b in y]) for z in heights}


def _least(found: Mapping[float, Array]) -> float:
    return min(float(seen.mean()) for seen in found.values())


def report(path: Path, room: tuple[float, float, float]) -> Iterator[str]:
    """Lines about each kind of tag of a file, in a room of three sides [m]; raises CamerasFileError."""
    if not all(SHORTEST_M <= side <= LONGEST_M for side in room):
        given = " ".join(f"{side:g}" for side in room)
        raise CamerasFileError(f"--room {given}: write three sides of {SHORTEST_M:g} to {LONGEST_M:g} m")
    lab = file.read(path)
    if missing := sorted(lab.cameras.keys() - (known := placed(lab)).keys()):
        example = "{ place = [-1.7, -1.7, 2.6], aim = [0.0, 0.0, 0.3], view_deg = 78.0 }"
        hint = f"write {missing[0]}.planned = {example}"
        raise CamerasFileError(f"camera {missing[0]} is neither calibrated nor planned; {hint}")
    cameras, kinds = [CameraModel(each) for each in known.values()], set[tuple[float, float, bool]]()
    for name, body in lab.bodies.items():
        if (key := (body.size, body.height, body.on_floor)) in kinds:
            continue
        kinds.add(key)
        needed = "one camera" if body.on_floor else "two cameras"
        yield f"{name}, tag of {body.size:g} m: places of {room[0]:g} x {room[1]:g} m where {needed} or more see it"
        found = shares(cameras, body, body.size, room)
        yield from (f"  {z:4.2f} m high: {seen.mean():4.0%}" for z, seen in found.items())
        if _least(found) >= ENOUGH:
            continue
        worst = min(found, key=lambda z: float(found[z].mean()))
        yield f"  at {worst:.2f} m (#: seen; y upwards, x to the right):"
        yield from ("    " + " ".join("#" if one else "." for one in row) for row in found[worst][::-1])
        larger = (size for size in SIZES if size > body.size)
        fits = next((size for size in larger if _least(shares(cameras, body, size, room)) >= ENOUGH), None)
        if fits:
            wider = fits / body.size
            yield f"  a tag of {fits:g} m is seen everywhere, or this one in images {wider:.2g} times as wide"
        else:
            yield "  no larger tag is seen everywhere: more cameras, or hang and turn them otherwise"
