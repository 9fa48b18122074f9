"""File of the cameras of a lab: where their images come from, tags on the floor and on robots, and the calibration."""

from __future__ import annotations

import tomllib
from collections import Counter
from pathlib import Path
from typing import Annotated, Final

import msgspec
from msgspec import Meta

from agents.errors import ExplainedError
from agents.vectors import NotNegative

HIGHEST_TAG: Final = 586  # last number of the family 36h11
MARK: Final = "# ---- measured by ./zenpark cameras calibrate: everything below is written again ----"

Length = Annotated[float, Meta(gt=0, le=10)]
Number = Annotated[float, Meta(ge=-1e6, le=1e6)]
Pixels = Annotated[int, Meta(ge=16, le=20000)]
TagNumber = Annotated[int, Meta(ge=0, le=HIGHEST_TAG)]
Triple = tuple[Number, Number, Number]


class CamerasFileError(ExplainedError, ValueError):
    """A file of cameras that cannot be used, with place and remedy."""


class PlannedCamera(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Camera that does not hang yet, for its coverage."""

    place: Triple  # position in the arena [m]
    aim: Triple  # point in the middle of its image [m]
    size: tuple[Pixels, Pixels] = (1280, 720)  # width and height of its images [px]
    view_deg: Annotated[float, Meta(gt=0, le=150)] = 78.0  # horizontal field of view [degrees]

    def __post_init__(self) -> None:
        if self.aim == self.place:
            raise ValueError("aim is its place; write a point in the middle of its image")


class CameraTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Camera of the lab."""

    # http://HOST[:PORT]/PATH with a stream of JPEG, /dev/video0, a video file
    source: Annotated[str, Meta(pattern=r"^(http://\S+|[^:]+)$")]
    latency_s: NotNegative = 0.0  # age of its images on arrival, where they bring no time of exposure [s]
    planned: PlannedCamera | None = None


class FloorTags(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Tags that lie on the floor of the arena."""

    size: Length  # side of the black square [m]
    tags: dict[TagNumber, Triple]  # centre x, y [m] and yaw [rad], by number


class TaggedBody(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Tag on a robot, level, its upper edge to the robot's left."""

    tag: TagNumber
    size: Length  # side of the black square [m]
    height: NotNegative  # height of the tag above the robot's lowest point [m]
    on_floor: bool = False  # a robot on wheels: one view is enough. All others count as seen by two cameras only.


class MeasuredCamera(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Calibration of a camera."""

    size: tuple[int, int]  # width and height of its images [px]
    matrix: tuple[Number, Number, Number, Number]  # focal lengths and centre, x and y [px]
    lens: tuple[Number, Number, Number, Number, Number]  # distortion k1, k2, p1, p2, k3
    place: Triple  # position in the arena [m]
    turn: Triple  # rotation vector from the arena to the camera [rad]
    half_turn: bool = False  # tags are those of the AprilTag project, which has them turned by 180°


class CamerasFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Cameras and tags of a lab."""

    cameras: Annotated[dict[str, CameraTable], Meta(min_length=1)]
    floor: FloorTags
    bodies: dict[str, TaggedBody] = {}
    rate_hz: Annotated[float, Meta(gt=0, le=1000)] = 30.0  # images per second
    measured: dict[str, MeasuredCamera] = {}


def parse(text: str, label: str = "cameras.toml") -> CamerasFile:
    """The file with this text; raises CamerasFileError with the place of what is wrong."""
    try:
        given = tomllib.loads(text)
        read = msgspec.convert(given, CamerasFile, strict=False)
    except (tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise CamerasFileError(f"{label}: {error}") from None
    numbers = Counter([*read.floor.tags, *(body.tag for body in read.bodies.values())])
    if twice := sorted(number for number, times in numbers.items() if times > 1):
        raise CamerasFileError(f"{label}: tag {twice[0]} stands twice; give each tag its own number")
    if strangers := sorted(read.measured.keys() - read.cameras.keys()):
        raise CamerasFileError(f"{label}: [measured.{strangers[0]}] is of no camera; calibrate again")
    return read


def read(path: str | Path) -> CamerasFile:
    """The file at a path; raises CamerasFileError for a file that cannot be read, or is none."""
    try:
        return parse(Path(path).read_text("utf-8"), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise CamerasFileError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from None


def with_measured(text: str, measured: dict[str, MeasuredCamera]) -> str:
    """The text of a file with this calibration in the place of its former one."""
    lines = [text.partition(MARK)[0].rstrip(), "", MARK]
    for name, camera in measured.items():
        lines += ["", f"[measured.{name}]"]
        for key, value in msgspec.structs.asdict(camera).items():
            lines.append(f"{key} = {msgspec.json.encode(value).decode()}")
    return "\n".join(lines) + "\n"
