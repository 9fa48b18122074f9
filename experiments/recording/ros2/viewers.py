"""What viewers draw without settings: transforms and markers, as ROS 2 messages of standard types.

Types and constants are those of tf2_msgs and visualization_msgs of ROS 2 Humble, in their public definitions.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Final

from agents.network.messages import Setpoint, State, Vector
from experiments.recording.ros2.cdr import LITTLE_ENDIAN, POSE_STAMPED_SCHEMA, SEPARATOR, Unencodable

FRAME: Final = "map"  # the arena, as RViz and Nav2 name the fixed frame; the ROS 2 bridge says the same

TF: Final = "tf2_msgs/msg/TFMessage"
MARKERS: Final = "visualization_msgs/msg/MarkerArray"
_POSE: Final = POSE_STAMPED_SCHEMA.split(SEPARATOR)  # Header, Time, Pose, Point, Quaternion behind the message itself
_VECTOR: Final = "MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
TF_SCHEMA: Final = SEPARATOR.join(
    [
        "geometry_msgs/TransformStamped[] transforms\n",
        "MSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\n"
        "geometry_msgs/Transform transform\n",
        "MSG: geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
        _VECTOR,
        *(part for part in _POSE[1:] if not part.startswith(("MSG: geometry_msgs/Pose\n", "MSG: geometry_msgs/Point"))),
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
        *_POSE[1:],
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
Draw = Callable[[float, dict[str, Vector]], "Sequence[Marker]"]  # of the time [s, UTC] and the places [m] of robots
LEVEL: Final[Setpoint] = (1.0, 0.0, 0.0, 0.0)  # quaternion w, x, y, z


@dataclass(frozen=True)
class Marker:
    """A marker; its number is its place in the array."""

    group: str
    type: int
    scale: Vector  # [m]; of lines the width, x
    colour: Colour
    opacity: float = 1.0
    frame: str = FRAME
    position: Vector = (0.0, 0.0, 0.0)  # [m] in its frame
    attitude: Setpoint = LEVEL
    points: Sequence[Vector] = ()  # [m] of lines
    colours: Sequence[Colour] = field(default=())  # one a point, or none
    text: str = ""


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

    def header(self, seconds: int, nanoseconds: int, frame: str) -> None:
        self.numbers("I", seconds, nanoseconds)
        self.text(frame)

    def colour(self, colour: Colour, opacity: float) -> None:
        self.numbers("f", *(part / 255.0 for part in colour), opacity)


def _moment(stamp: float) -> tuple[int, int]:
    return divmod(round(stamp * 1e9), 1_000_000_000)


def markers(stamp: float, drawn: Sequence[Marker]) -> bytes:
    """A `MarkerArray` at a UTC stamp [s].

    Raises:
        Unencodable: If a number is none of its type.
    """
    out, (seconds, nanoseconds) = _Cdr(), _moment(stamp)
    try:
        out.numbers("I", len(drawn))
        for number, each in enumerate(drawn):
            out.header(seconds, nanoseconds, each.frame)
            out.text(each.group)
            out.numbers("i", number, each.type, 0)
            w, *turned = each.attitude
            out.numbers("d", *each.position, *turned, w, *each.scale)
            out.colour(each.colour, each.opacity)
            out.numbers("i", 0, 0)  # stays until it is replaced
            out.numbers("B", each.frame != FRAME)
            out.numbers("I", len(each.points))
            for point in each.points:
                out.numbers("d", *point)
            out.numbers("I", len(each.colours))
            for colour in each.colours:
                out.colour(colour, each.opacity)
            out.text("")  # texture
            out.header(0, 0, "")
            out.text("")
            out.numbers("I", 0, 0)
            out.text(each.text)
            out.text("")  # mesh
            out.text("")
            out.numbers("I", 0)
            out.numbers("B", 0)
    except (struct.error, OverflowError, ValueError) as error:
        raise Unencodable(f"{MARKERS}: {error}") from None
    return LITTLE_ENDIAN + bytes(out.data)


@cache
def _transform_layout(robot: str) -> tuple[struct.Struct, bytes]:
    """Layout of the transform of a robot; its name and that of the frame are constant."""
    out = _Cdr()
    out.numbers("I", 1)
    out.header(0, 0, FRAME)
    out.text(robot)
    names = bytes(out.data[12:])
    return struct.Struct(f"<4sIII{len(names)}s{-(12 + len(names)) % 8}x7d"), names


def transform(state: State) -> bytes:
    """The `TFMessage` of a robot: from the arena to its body, whose frame has the robot's name.

    Raises:
        Unencodable: If a number is none of its type.
    """
    layout, names = _transform_layout(state.robot)
    place = state.position if state.true_position is None else state.true_position
    yaw = state.yaw if state.true_yaw is None else state.true_yaw
    half = 0.5 * (yaw or 0.0)
    w, *turned = state.attitude or (math.cos(half), 0.0, 0.0, math.sin(half))
    assert place is not None
    try:
        return layout.pack(LITTLE_ENDIAN, 1, *_moment(state.stamp), names, *place, *turned, w)
    except (struct.error, OverflowError, ValueError) as error:
        raise Unencodable(f"{TF}: {error}") from None
