"""Geometry of positioning systems: files of Lighthouse base stations, anchors of Loco, checked before they are sent.

A Crazyflie believes whatever geometry it is given: one in millimetres, or mirrored, is found out in flight.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final

import msgspec
import numpy as np
from msgspec import Meta

from agents.body.interface import BodyError
from agents.plugins.files import MAX_FILE_BYTES
from agents.vectors import Vector

FARTHEST: Final = 50.0  # [m] largest distance of a station or an anchor from the origin, along each axis
ORTHONORMAL: Final = 0.01  # largest error of R Rᵀ against the identity, and of the determinant against 1
FLAT: Final = 0.1  # [m] standard deviation of anchors from a plane or line below which they lie in it
STEEP: Final = 0.9  # vertical part of the normal of a plane that counts as horizontal
FLOOR: Final = 0.5  # [m] anchors in a horizontal plane this near to the floor do not show heights there
FEWEST: Final = 4  # anchors for a position in space

Three = Annotated[list[float], Meta(min_length=3, max_length=3)]


class Geometry(msgspec.Struct, frozen=True):
    """Position and orientation of a base station."""

    origin: Three
    rotation: Annotated[list[Three], Meta(min_length=3, max_length=3)]


class Sweep(msgspec.Struct, frozen=True):
    """Calibration of one of the two light planes of a base station."""

    phase: float
    tilt: float
    curve: float
    gibmag: float
    gibphase: float
    ogeemag: float
    ogeephase: float


class Calibration(msgspec.Struct, frozen=True):
    """Calibration of a base station."""

    sweeps: Annotated[list[Sweep], Meta(min_length=2, max_length=2)]
    uid: int


class StationFile(msgspec.Struct, frozen=True, kw_only=True, rename={"system_type": "systemType"}):
    """A Lighthouse configuration as the Crazyflie client saves it."""

    type: str
    version: str
    system_type: Annotated[int, Meta(ge=1, le=2)] = 2
    geos: dict[int, Geometry] = {}
    calibs: dict[int, Calibration] = {}


def stations(path: str, count: int) -> StationFile:
    """The Lighthouse configuration in a file, for `count` base stations at most.

    Raises BodyError if there is none, or no room has base stations as it says.
    """
    try:
        if Path(path).exists() and not Path(path).is_file():  # a pipe would be waited for
            raise BodyError(f"{path} is no file; save one in the Crazyflie client, tab Lighthouse")
        if (size := Path(path).stat().st_size) > MAX_FILE_BYTES:
            raise BodyError(f"{path} has {size} bytes: it is no Lighthouse configuration")
        # not strict: YAML reads 1e-05, which other writers than Python's give, as text
        read = msgspec.yaml.decode(Path(path).read_bytes(), type=StationFile, strict=False)
    except OSError as error:
        raise BodyError(f"{path}: {error.strerror}; save it in the Crazyflie client, tab Lighthouse") from error
    except msgspec.DecodeError as error:
        raise BodyError(f"{path} is no Lighthouse configuration: {error}") from error
    if (read.type, read.version) != ("lighthouse_system_configuration", "1"):
        raise BodyError(f"{path} is no Lighthouse configuration of version 1; save it again in the Crazyflie client")
    beyond = sorted(number for number in read.geos.keys() | read.calibs.keys() if not 0 <= number < count)
    if beyond:
        raise BodyError(f"{path} has base station {beyond[0] + 1}, the firmware knows {count} by base_stations")
    for number, geometry in sorted(read.geos.items()):
        if wrong := _impossible(geometry):
            raise BodyError(f"{path}: base station {number + 1} {wrong}")
    for number, calibration in sorted(read.calibs.items()):
        if not np.isfinite([msgspec.structs.astuple(sweep) for sweep in calibration.sweeps]).all():
            remedy = "save it again in the Crazyflie client"
            raise BodyError(f"{path}: a calibration of base station {number + 1} is no number; {remedy}")
    return read


def _impossible(geometry: Geometry) -> str:
    """Reason that no base station can stand so, with the remedy; empty if one can."""
    again = "estimate the geometry again in the Crazyflie client"
    origin, rotation = np.array(geometry.origin), np.array(geometry.rotation)
    if not (np.isfinite(origin).all() and np.isfinite(rotation).all()):
        return f"has a place or rotation that is no number; {again}"
    if np.abs(origin).max() > FARTHEST:
        place = ", ".join(f"{value:g}" for value in geometry.origin)
        return f"is at ({place}) m, farther than {FARTHEST:g} m from the origin; give metres, not millimetres"
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if error > ORTHONORMAL:
        return f"has a rotation with rows that are not orthonormal, by {error:.2g}; {again}"
    if (determinant := np.linalg.det(rotation)) < 1.0 - ORTHONORMAL:
        return f"has a rotation that mirrors, with the determinant {determinant:.3g} in place of 1; {again}"
    return ""


def check_anchors(anchors: Sequence[Vector]) -> None:
    """Raise BodyError for anchors, from number 0 on, with which a drone cannot know where it is; none are right."""
    if not anchors:
        return
    for number, place in enumerate(anchors):
        if not (np.isfinite(place).all() and np.abs(place).max() <= FARTHEST):
            where = ", ".join(f"{value:g}" for value in place)
            message = f"anchor {number} is at ({where}) m, farther than {FARTHEST:g} m from the origin"
            raise BodyError(f"{message}; give metres, not millimetres")
    if len(anchors) < FEWEST:
        raise BodyError(f"{len(anchors)} anchors tell no position in space; give the places of {FEWEST} or more")
    spread, normal = _spread(anchors)
    if spread[1] < FLAT:
        raise BodyError("all anchors stand in one line, around which ranges are equal; move one out of it")
    level = float(np.mean([z for _, _, z in anchors]))
    if spread[2] < FLAT and abs(normal[2]) > STEEP and abs(level) < FLOOR:
        message = f"all anchors stand in one plane at {level:.2g} m, near which they do not show heights"
        raise BodyError(f"{message}; raise one or more of them by 1 m or more")


def in_one_plane(anchors: Sequence[Vector]) -> bool:
    """Whether anchors lie in one plane, on both sides of which ranges are equal."""
    return len(anchors) >= FEWEST and bool(_spread(anchors)[0][2] < FLAT)


def _spread(anchors: Sequence[Vector]) -> tuple[list[float], list[float]]:
    """Standard deviations [m] of anchors along their principal axes, the largest first; unit vector of the last one."""
    places = np.array(anchors, dtype=float)
    _, sizes, axes = np.linalg.svd(places - places.mean(axis=0), full_matrices=False)
    return (sizes / np.sqrt(len(places))).tolist(), axes[2].tolist()
