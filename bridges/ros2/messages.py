"""ROS 2 on Zenoh as bytes: message types and CDR, key expressions, attachments and liveliness tokens.

Two middlewares put ROS 2 on Zenoh. zenoh-bridge-ros2dds ("ros2dds") passes the CDR of DDS topics on under plain keys.
rmw_zenoh ("rmw") is ROS 2 itself on Zenoh: its keys name type and type hash, and every sample carries an attachment.
Its liveliness tokens are the graph that `ros2 topic list` shows. Sources: rmw_zenoh, docs/design.md, and the tokens and
attachments that its `liveliness_utils` and `attachment_helpers` write; zenoh-plugin-ros2dds, `liveliness_mgt`.

`rosbags` and `xxhash` are the extra `ros`; they are imported when the first `Types` is made.
"""

from __future__ import annotations

import struct
from functools import cache
from math import atan2, cos, floor, sin
from typing import Any, Final, Literal, NamedTuple, TypeAlias

from agents.body.interface import BodyError

Style = Literal["ros2dds", "rmw"]
Distro = Literal["humble", "jazzy", "kilted", "lyrical", "rolling"]
Role = Literal["MP", "MS"]  # publishes, subscribes
Message: TypeAlias = Any  # the classes are made at run time, from the definitions of the distribution

TWIST: Final = "geometry_msgs/msg/Twist"
TWIST_STAMPED: Final = "geometry_msgs/msg/TwistStamped"
POSE_STAMPED: Final = "geometry_msgs/msg/PoseStamped"
ODOMETRY: Final = "nav_msgs/msg/Odometry"
LASER_SCAN: Final = "sensor_msgs/msg/LaserScan"
BATTERY_STATE: Final = "sensor_msgs/msg/BatteryState"
DIAGNOSTIC_ARRAY: Final = "diagnostic_msgs/msg/DiagnosticArray"
TRANSFORM_STAMPED: Final = "geometry_msgs/msg/TransformStamped"
TF_MESSAGE: Final = "tf2_msgs/msg/TFMessage"
MARKER_ARRAY: Final = "visualization_msgs/msg/MarkerArray"

STORES: Final[dict[Distro, str]] = {
    "humble": "ROS2_HUMBLE",
    "jazzy": "ROS2_JAZZY",
    "kilted": "ROS2_KILTED",
    "lyrical": "ROS2_LYRICAL",
    "rolling": "LATEST",
}
NO_HASH: Final = "TypeHashNotSupported"  # what rmw_zenoh writes where ROS 2 Humble knows no type hashes
MAX_DOMAIN: Final = 232  # ROS 2 has no larger domain, for those of DDS would run out of ports

_ATTACHMENT: Final = struct.Struct("<qqB16s")


class UnknownMessage(ValueError):
    """A payload that is no message of the type of its topic."""


class Types:
    """The message types of one distribution: classes, CDR and hashes; BodyError if the extra `ros` is missing."""

    def __init__(self, distro: Distro) -> None:
        try:
            from rosbags.serde import SerdeError  # noqa: PLC0415 - an extra, and 80 ms
            from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
        except ImportError:
            raise _missing() from None
        self.distro: Distro = distro
        self._store = get_typestore(Stores[STORES[distro]])
        self._malformed = SerdeError
        self._hashes: dict[str, str] = {}

    def make(self, kind: str, **fields: Message) -> Message:
        """A message of a type such as "geometry_msgs/msg/Twist"."""
        return self._store.types[kind](**fields)

    def encode(self, message: Message, kind: str) -> bytes:
        """CDR, little endian, with its encapsulation header."""
        return bytes(self._store.serialize_cdr(message, kind, little_endian=True))

    def decode(self, payload: bytes, kind: str) -> Message:
        """The message in a payload; raises UnknownMessage if it is not a `kind`."""
        try:
            return self._store.deserialize_cdr(payload, kind)
        except self._malformed as error:
            raise UnknownMessage(f"not a {kind}: {error}") from None

    def hash(self, kind: str) -> str:
        """RIHS01 hash of a type (REP 2016), or its substitute on Humble."""
        if self.distro == "humble":
            return NO_HASH
        if kind not in self._hashes:
            self._hashes[kind] = self._store.hash_rihs01(kind)
        return self._hashes[kind]

    def header(self, stamp: float, frame: str) -> Message:
        """A std_msgs/Header for a UTC time [s]."""
        seconds = floor(stamp)  # split first: today's UTC in nanoseconds has more digits than a float
        nanoseconds = min(round((stamp - seconds) * 1e9), 999_999_999)
        time = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame)

    def vector(self, x: float, y: float, z: float) -> Message:
        """A geometry_msgs/Vector3."""
        return self.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def twist(self, linear: tuple[float, float, float], angular: tuple[float, float, float]) -> Message:
        """A geometry_msgs/Twist [m/s, rad/s]."""
        return self.make(TWIST, linear=self.vector(*linear), angular=self.vector(*angular))

    def pose(self, x: float, y: float, z: float, yaw: float) -> Message:
        """An upright geometry_msgs/Pose [m, rad]."""
        point = self.make("geometry_msgs/msg/Point", x=x, y=y, z=z)
        return self.make("geometry_msgs/msg/Pose", position=point, orientation=self.turn(yaw))

    def transform(self, x: float, y: float, z: float, yaw: float) -> Message:
        """An upright geometry_msgs/Transform [m, rad]."""
        return self.make("geometry_msgs/msg/Transform", translation=self.vector(x, y, z), rotation=self.turn(yaw))

    def turn(self, yaw: float) -> Message:
        """A geometry_msgs/Quaternion about the z axis [rad]."""
        return self.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=sin(0.5 * yaw), w=cos(0.5 * yaw))


def yaw_of(q: Message) -> float:
    """Yaw [rad] of a geometry_msgs/Quaternion."""
    return atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))


def stamp_of(header: Message) -> float:
    """Time [s] of a std_msgs/Header, on the clock of its sender."""
    return float(header.stamp.sec) + 1e-9 * float(header.stamp.nanosec)


@cache
def types(distro: Distro) -> Types:
    """The types of a distribution; cached, since that takes 0.1 s."""
    return Types(distro)


def _missing() -> BodyError:
    return BodyError("ROS 2 messages need rosbags and xxhash: ./zenpark hardware")


# ---------------------------------------------------------------------- names


def dds_type(kind: str) -> str:
    """The type's name on DDS: geometry_msgs::msg::dds_::Twist_ of geometry_msgs/msg/Twist."""
    package, what, name = kind.split("/")
    return f"{package}::{what}::dds_::{name}_"


def mangle(name: str) -> str:
    """A name with slashes as one chunk of an rmw_zenoh token."""
    return name.replace("/", "%")


def absolute(namespace: str, topic: str) -> str:
    """The full name of a topic, "/tb3_0/odom": a topic with a leading slash stands in no namespace."""
    if topic.startswith("/"):
        return topic
    return f"/{namespace}/{topic}" if namespace else f"/{topic}"


def topic_key(style: Style, topic: str, kind: str, *, domain: int, types: Types) -> str:
    """The key expression of a topic that is given by its full name."""
    name = topic.removeprefix("/")
    return name if style == "ros2dds" else f"{domain}/{name}/{dds_type(kind)}/{types.hash(kind)}"


# ---------------------------------------------------------------------- quality of service, as in tokens


def qos(*, best_effort: bool = False, depth: int = 10) -> str:
    """Volatile, keep-last quality of service; what is rmw_zenoh's default (reliable, depth 42, ...) is left out."""
    return f"{2 if best_effort else ''}::,{'' if depth == 42 else depth}:,:,:,,"


RELIABLE: Final = qos()
SENSOR_DATA: Final = qos(best_effort=True, depth=5)
TRANSFORMS: Final = qos(depth=100)  # profile of tf2_ros


# ---------------------------------------------------------------------- tokens and attachments


def node_token(domain: int, zid: str, node: int, namespace: str, name: str) -> str:
    """Liveliness token of an rmw_zenoh node; `zid` is the session's, `node` counts entities of the session."""
    return f"@ros2_lv/{domain}/{zid}/{node}/{node}/NN/%/%{mangle(namespace)}/{name}"


def endpoint_token(  # noqa: PLR0917 - in the order of the chunks
    domain: int, zid: str, node: int, entity: int, role: Role, namespace: str, name: str, rest: str
) -> str:
    """Liveliness token of an rmw_zenoh publisher or subscriber; `rest` is of `endpoint_topic`."""
    return f"@ros2_lv/{domain}/{zid}/{node}/{entity}/{role}/%/%{mangle(namespace)}/{name}/{rest}"


def endpoint_topic(topic: str, kind: str, quality: str, types: Types) -> str:
    """The part of an endpoint's token that tells the topic, by its full name, and how it is typed."""
    return f"{mangle(topic)}/{dds_type(kind)}/{types.hash(kind)}/{quality}"


def dds_token(zid: str, role: Role, topic: str, kind: str) -> str:
    """Liveliness token by which zenoh-bridge-ros2dds announces a topic of its DDS side (no key, reliable, volatile)."""
    return f"@/{zid}/@ros2_lv/{role}/{topic.removeprefix('/').replace('/', '§')}/{kind.replace('/', '§')}/:1:0:0,10"


def endpoints(style: Style, role: Role, topic: str, *, domain: int | None = None) -> str:
    """Key expression of the tokens of publishers or subscribers of a topic by its full name; "*", or None, for any."""
    if style == "ros2dds":
        return f"@/*/@ros2_lv/{role}/{topic.removeprefix('/').replace('/', '§')}/**"
    return f"@ros2_lv/{'*' if domain is None else domain}/*/*/*/{role}/*/*/*/{mangle(topic)}/**"


class TopicEndpoint(NamedTuple):
    """Publisher or subscriber by its token; ros2dds knows neither type hashes nor domains."""

    topic: str  # full name, "/tb3_0/odom"
    kind: str  # "nav_msgs/msg/Odometry"
    hash: str = ""
    domain: int = 0


def announced(style: Style, token: str) -> TopicEndpoint:
    """The endpoint that a token announces; raises ValueError if it announces none."""
    chunks = token.split("/")
    if style == "ros2dds" and len(chunks) >= 6:
        return TopicEndpoint("/" + chunks[4].replace("§", "/"), chunks[5].replace("§", "/"))
    if style == "rmw" and len(chunks) >= 13:  # rmw_zenoh 0.10.5 adds one for topics with a uint8[]
        kind = chunks[10].replace("::dds_::", "/").replace("::", "/").removesuffix("_")
        return TopicEndpoint(chunks[9].replace("%", "/"), kind, chunks[11], int(chunks[1]))
    raise ValueError(f"'{token}' announces no publisher or subscriber")


def gid(token: str) -> bytes:
    """The 16 bytes by which rmw_zenoh knows an endpoint: XXH3-128 of its token, low half first, little endian."""
    try:
        import xxhash  # noqa: PLC0415 - an extra
    except ImportError:
        raise _missing() from None
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")


def attachment(sequence: int, stamp_ns: int, source: bytes) -> bytes:
    """Attachment of rmw_zenoh to a sample: running number from 1 on, UTC [ns], and the gid of its publisher."""
    return _ATTACHMENT.pack(sequence, stamp_ns, 16, source)


def attached(raw: bytes) -> tuple[int, int, bytes]:
    """Running number, UTC [ns] and gid of an attachment; raises UnknownMessage if it is none of rmw_zenoh's."""
    if len(raw) != _ATTACHMENT.size or raw[16] != 16:
        raise UnknownMessage(f"{len(raw)} bytes are no attachment of rmw_zenoh")
    sequence, stamp_ns, _, source = _ATTACHMENT.unpack(raw)
    return sequence, stamp_ns, source
