"""Topics that viewers draw without settings: transforms and markers, as ROS 2 messages of standard types.

Types and constants are those of tf2_msgs and visualization_msgs of ROS 2 Humble, in their public definitions.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import chain
from typing import Final

from agents.network.messages import Setpoint, State, Vector
from experiments.recording.ros2.payload import LITTLE_ENDIAN

FRAME: Final = "map"  # the arena, as RViz and Nav2 name the fixed frame; the ROS 2 bridge says the same

TF: Final = "tf2_msgs/msg/TFMessage"
MARKERS: Final = "visualization_msgs/msg/MarkerArray"
POSE: Final = "geometry_msgs/msg/PoseStamped"
SEPARATOR: Final = "=" * 80 + "\n"
_HEADER: Final = (
    "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n",
    "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n",
)
_POINT: Final = (
    "MSG: geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    "MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n",
)
_QUATERNION: Final = "MSG: geometry_msgs/Quaternion\nfloat64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n"
POSE_SCHEMA: Final = SEPARATOR.join(
    ["std_msgs/Header header\ngeometry_msgs/Pose pose\n", *_HEADER, *_POINT, _QUATERNION]
)
_VECTOR: Final = "MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
TF_SCHEMA: Final = SEPARATOR.join(
    [
        "geometry_msgs/TransformStamped[] transforms\n",
        "MSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\n"
        "geometry_msgs/Transform transform\n",
        "MSG: geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
        _VECTOR,
        *_HEADER,
        _QUATERNION,
    ]
)
MARKERS_SCHEMA: Final = SEPARATOR.join(
    [
        "visualization_msgs/Marker[] markers\n",
        "MSG: visualization_msgs/Marker\nstd_msgs/Header header\nstring ns\nint32 id\nint32 type\nint32 action\n"
        "geometry_msgs/Pose pose\ngeometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\n"
        "builtin_interfaces/Duration lifetime\nbool frame_locked\ngeometry_msgs/Point[] points\n"
        "std_msgs/ColorRGBA[] colors\nstring texture_resource\nsensor_msgs/CompressedImage texture\n"
        "visualization_msgs/UVCoordinate[] uv_coordinates\nstring text\nstring mesh_resource\n"
        "visualization_msgs/MeshFile mesh_file\nbool mesh_use_embedded_materials\n",
        *_HEADER,
        *_POINT,
        _QUATERNION,
        _VECTOR,
        "MSG: std_msgs/ColorRGBA\nfloat32 r\nfloat32 g\nfloat32 b\nfloat32 a\n",
        "MSG: builtin_interfaces/Duration\nint32 sec\nuint32 nanosec\n",
        "MSG: sensor_msgs/CompressedImage\nstd_msgs/Header header\nstring format\nuint8[] data\n",
        "MSG: visualization_msgs/UVCoordinate\nfloat32 u\nfloat32 v\n",
        "MSG: visualization_msgs/MeshFile\nstring filename\nuint8[] data\n",
    ]
)

CUBE, CYLINDER, LINE_STRIP, LINE_LIST, TEXT = 1, 3, 4, 5, 9  # types of a marker
Colour = tuple[int, int, int]
Draw = Callable[[float, dict[str, Vector]], "Sequence[Marker]"]  # asks for the time [s, UTC] and the places [m]
LEVEL: Final[Setpoint] = (1.0, 0.0, 0.0, 0.0)  # quaternion w, x, y, z


class Unencodable(ValueError):
    """A number that its ROS 2 type cannot hold."""


@dataclass(frozen=True)
class Marker:
    """A marker; its number is its place in the array."""

    group: str
    type: int
    scale: Vector  # [m]; of lines the width, x
    colour: Colour
    opacity: float = 1.0
    frame: str = FRAME
    position: Vector = (0.0, 0.0, 0.0)  # [m] place in its frame
    attitude: Setpoint = LEVEL
    points: Sequence[Vector] = ()  # [m] points of lines
    colours: Sequence[Colour] = ()  # one a point, or none
    text: str = ""
    # CDR behind the stamp, by number and place in the message modulo 8: most markers are drawn again and again
    _encoded: dict[tuple[int, int], bytes] = field(default_factory=dict, init=False, repr=False, compare=False)

    def encoded(self, number: int, place: int) -> bytes:
        """Everything behind the stamp as CDR."""
        if (number, place) in self._encoded:
            return self._encoded[number, place]
        out = _Cdr()
        out.data += bytes(place)
        out.text(self.frame)
        out.text(self.group)
        out.numbers("i", number, self.type, 0)
        w, *turned = self.attitude
        out.numbers("d", *self.position, *turned, w, *self.scale)
        out.colours([self.colour], self.opacity)
        out.numbers("i", 0, 0)  # stays until it is replaced
        out.numbers("B", self.frame != FRAME)
        out.numbers("I", len(self.points))
        if self.points:
            out.numbers("d", *chain.from_iterable(self.points))
        out.numbers("I", len(self.colours))
        out.colours(self.colours, self.opacity)
        out.text("")  # texture
        out.numbers("I", 0, 0)
        out.text("")
        out.text("")
        out.numbers("I", 0, 0)
        out.text(self.text)
        out.text("")  # mesh
        out.text("")
        out.numbers("I", 0)
        out.numbers("B", 0)
        self._encoded[number, place] = bytes(out.data[place:])
        return self._encoded[number, place]


class _Cdr:
    """CDR, value by value: numbers aligned to their sizes."""

    def __init__(self) -> None:
        self.data = bytearray()

    def numbers(self, code: str, *values: float) -> None:
        size = struct.calcsize(f"<{code}")
        self.data += bytes(-len(self.data) % size) + struct.pack(f"<{len(values)}{code}", *values)

    def text(self, value: str) -> None:
        self.numbers("I", len(value.encode()) + 1)
        self.data += value.encode() + b"\0"

    def colours(self, colours: Sequence[Colour], opacity: float) -> None:
        self.numbers("f", *(part for r, g, b in colours for part in (r / 255.0, g / 255.0, b / 255.0, opacity)))


def _moment(stamp: float) -> tuple[int, int]:
    return divmod(round(stamp * 1e9), 1_000_000_000)


def markers(stamp: float, drawn: Sequence[Marker]) -> bytes:
    """A `MarkerArray` at a UTC stamp [s]; raises Unencodable if a number is none of its type."""
    out = _Cdr()
    try:
        out.numbers("I", len(drawn))
        for number, each in enumerate(drawn):
            out.numbers("I", *_moment(stamp))
            out.data += each.encoded(number, len(out.data) % 8)
    except (struct.error, OverflowError, ValueError) as error:
        raise Unencodable(f"{MARKERS}: {error}") from None
    return LITTLE_ENDIAN + bytes(out.data)


@cache
def _layout(counts: int, *texts: str) -> tuple[struct.Struct, bytes]:
    """Layout of a stamped place and attitude behind `counts` numbers; the texts of its header are constant."""
    out = _Cdr()
    out.numbers("I", *[0] * (counts + 2))
    for text in texts:
        out.text(text)
    behind = bytes(out.data[4 * (counts + 2) :])
    return struct.Struct(f"<4s{counts}IiI{len(behind)}s{-len(out.data) % 8}x7d"), behind


def _stamped(kind: str, state: State, counts: Sequence[int], *texts: str) -> bytes:
    """A message that is a robot's place, true if known, else as measured, and its attitude, if known, else its yaw."""
    layout, behind = _layout(len(counts), *texts)
    place = state.position if state.true_position is None else state.true_position
    yaw = state.yaw if state.true_yaw is None else state.true_yaw
    half = 0.5 * (yaw or 0.0)
    w, *turned = state.attitude or (math.cos(half), 0.0, 0.0, math.sin(half))
    assert place is not None
    try:
        return layout.pack(LITTLE_ENDIAN, *counts, *_moment(state.stamp), behind, *place, *turned, w)
    except (struct.error, TypeError, OverflowError, ValueError) as error:
        raise Unencodable(f"{kind}: {error}") from None


def pose(state: State) -> bytes:
    """The `PoseStamped` of a robot in the arena; raises `Unencodable`."""
    return _stamped(POSE, state, (), FRAME)


def transform(state: State) -> bytes:
    """The `TFMessage` of a robot, from the arena to its body, in a frame with its name; raises `Unencodable`."""
    return _stamped(TF, state, (1,), FRAME, state.robot)
