"""What goes over the network: the structs, their two encodings, and the check of what arrives.

JSON is the default (every Zenoh tool prints it), MessagePack a setting for thin links; a reader tells them apart by
the sample's encoding. What arrives is checked before it is believed: `decode` raises `Malformed` for anything that is
not the struct, `check_pose` for a pose that no robot can have.
"""

from __future__ import annotations

import math
from typing import Final, Literal, TypeVar

import msgspec

Vector = tuple[float, float, float]
Setpoint = tuple[float, float, float, float]
Encoding = Literal["json", "msgpack"]
OrderKind = Literal["takeoff", "start", "hold", "land", "stop", "get", "set"]

JSON: Final = "application/json"  # plain, without a schema suffix: REST and command-line tools then print it
MSGPACK: Final = "application/msgpack"
MIME: Final[dict[Encoding, str]] = {"json": JSON, "msgpack": MSGPACK}

MAX_PAYLOAD: Final = 64 * 1024  # [bytes]; the largest honest message (state of a robot with 100 neighbours) has 20 kB
FUTURE_S: Final = 5.0  # a stamp further ahead is a broken clock or a forgery, and would silence honest samples
MAX_SPEED: Final = 50.0  # [m/s]; nothing here moves faster
ABSURD: Final = 1e6  # [m, m/s, rad, rad/s] no setpoint is that large; NaN is not smaller either
MAX_RAYS: Final = 720  # of one sweep; the finest scanner here has 360
MAX_RANGE: Final = 100.0  # [m]; no range sensor here sees farther


class Malformed(ValueError):
    """A payload that is not what its key promises."""


class Pose(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where a robot says that it is: position [m], velocity [m/s], yaw [rad], UTC `stamp` [s], running `seq`."""

    robot: str
    seq: int
    stamp: float
    position: Vector
    velocity: Vector
    yaw: float


class Heard(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A pose that reached its listener: whose, which one, when it was taken and when it was heard (UTC [s])."""

    speaker: str
    seq: int
    stamp: float
    arrived: float
    position: Vector
    velocity: Vector


class State(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Telemetry of a body and its decision, for recorder and viewers.

    `setpoint` is x, y, z, yaw [m, rad] for a body that takes positions, v_x, v_y, v_z [m/s], yaw rate [rad/s] for
    velocities, and v [m/s], ω [rad/s], 0, 0 for twists; goal and setpoint are None while a robot has none. `error` [m]
    is Σ|d − distance| over the robot's links as the robot itself sees it. `true_position` and `true_yaw` are known of
    twins only, `attitude` (quaternion w, x, y, z) of bodies that know more than yaw, the shadow's pose of robots that
    have a twin beside them.
    """

    robot: str
    seq: int
    stamp: float
    phase: str
    position: Vector
    velocity: Vector
    yaw: float
    goal: Vector | None
    setpoint: Setpoint | None
    error: float
    true_position: Vector | None = None
    true_yaw: float | None = None
    heard: list[Heard] = []
    attitude: Setpoint | None = None
    shadow_position: Vector | None = None
    shadow_yaw: float | None = None


class Status(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a robot is: lifecycle phase, what holds it, what its body says, its counters since the process began.

    `missing` names neighbours that were never heard or are gone; `lost` counts, per neighbour, samples that the
    sequence numbers prove were sent and never heard. `late_s` is the largest lateness of a tick since the last status.
    `started` is the UTC time at which the robot began to run the experiment (0 before). From there `ticks` count, and
    `decisions`, at which it computed its goal. `interventions` are ticks on which safety changed what had been decided,
    `avoided` those of them, and of changed goals, that kept clear of something.
    """

    robot: str
    stamp: float
    phase: str
    reason: str
    body: str
    battery: float | None
    sent: int
    heard: int
    lost: dict[str, int]
    malformed: int
    refused: int
    ticks: int
    missed: int
    decisions: int
    interventions: int
    avoided: int
    late_s: float
    started: float
    missing: list[str]
    pid: int
    cpu_s: float
    rss_mb: float


class Position(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where a robot is, as something outside of it measured or knows: position [m], yaw [rad] if known, UTC [s]."""

    robot: str
    stamp: float
    position: Vector
    yaw: float | None = None


class Command(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a body in another process must do.

    `setpoint` (see `State`) belongs to `drive`, `height` [m] to `takeoff`.
    """

    robot: str
    seq: int
    stamp: float
    action: Literal["drive", "takeoff", "land", "stop"]
    setpoint: Setpoint | None = None
    height: float | None = None


class Ranges(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One sweep of a robot's range sensors: bearing and elevation [rad] from its nose, distance [m], None: nothing."""

    robot: str
    stamp: float
    bearing: list[float]
    elevation: list[float]
    distance: list[float | None]


class Contact(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The beginning of a contact in the world: robots or obstacles by name ("wall" is the arena's), [N s], [m]."""

    stamp: float
    first: str
    second: str
    impulse: float
    overlap: float


class WorldState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a world says of itself, at 1 Hz and on every change.

    `factor` is simulated over real time of the last second, `load` the share of it that the work took; `time` is
    simulated since it began [s]. `robots` are carried, `mirrored` are elsewhere and seen here; `obstacles` by name
    with x, y [m], yaw [rad].
    """

    stamp: float
    engine: str
    time: float
    factor: float
    load: float
    paused: bool
    robots: list[str]
    mirrored: list[str]
    obstacles: dict[str, Vector]
    contacts: int
    refused: int
    malformed: int
    trouble: str = ""


class WorldOrder(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What an operator asks of a world.

    `steps` belongs to step (ticks, then it is paused again); `name` to spawn and remove, and to reset (left out: all);
    `kind`, `at` (x, y [m]) and `yaw` to spawn of a robot, `obstacle` (as in the experiment file) to one of an obstacle.
    """

    order: Literal["pause", "resume", "step", "reset", "spawn", "remove"]
    steps: int = 1
    name: str | None = None
    kind: str | None = None
    at: tuple[float, float] | None = None
    yaw: float = 0.0
    obstacle: dict[str, object] | None = None


class WorldReply(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A world's answer to an order."""

    ok: bool
    paused: bool
    time: float
    reason: str = ""


class Order(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What an operator asks of a robot: `at` is a UTC start time [s]; `name` and `value` belong to get and set."""

    order: OrderKind
    at: float | None = None
    name: str | None = None
    value: float | None = None


class Reply(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A robot's answer to an order."""

    robot: str
    ok: bool
    phase: str
    reason: str = ""
    value: float | None = None


class Stop(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Emergency stop for everyone, with who asks and why."""

    who: str
    reason: str


class Event(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Something that happened in a run: `kind` is a word (`phase`, `start`, `lost`, ...), `source` who or what."""

    stamp: float
    kind: str
    source: str
    text: str


class HostClock(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a host's clock lies to the conductor's at `stamp` (the conductor's, UTC [s]).

    `offset` is the host's reading less the conductor's [s], within `uncertainty` [s]. `robots` run there; what they say
    is stamped on the clock of the first such message of a run, taken off by its `offset`.
    """

    host: str
    stamp: float
    offset: float
    uncertainty: float
    robots: list[str]


Message = (
    Pose
    | State
    | Status
    | Position
    | Command
    | Ranges
    | Order
    | Reply
    | Stop
    | Event
    | Contact
    | HostClock
    | WorldState
    | WorldOrder
    | WorldReply
)
M = TypeVar(
    "M",
    Pose,
    State,
    Status,
    Position,
    Command,
    Ranges,
    Order,
    Reply,
    Stop,
    Event,
    Contact,
    HostClock,
    WorldState,
    WorldOrder,
    WorldReply,
)

_json = msgspec.json.Encoder()
_msgpack = msgspec.msgpack.Encoder()
_decoders: dict[tuple[type, bool], msgspec.json.Decoder[object] | msgspec.msgpack.Decoder[object]] = {}


def pose(robot: str, seq: int, stamp: float, position: list[float], velocity: list[float], yaw: float) -> Pose:  # noqa: PLR0917
    """A pose to send, rounded to micrometres and microradians: a third fewer bytes, far below any sensor's noise."""
    x, y, z = position
    u, v, w = velocity
    return Pose(
        robot,
        seq,
        round(stamp, 6),
        (round(x, 6), round(y, 6), round(z, 6)),
        (round(u, 6), round(v, 6), round(w, 6)),
        round(yaw, 6),
    )


def encode(message: Message, encoding: Encoding = "json") -> bytes:
    """The payload of a message."""
    return _json.encode(message) if encoding == "json" else _msgpack.encode(message)


def decode(payload: bytes, mime: str, kind: type[M]) -> M:
    """The message in a payload, by its MIME type.

    Raises:
        Malformed: If the payload is too large, of another encoding, or not a `kind`.
    """
    if len(payload) > MAX_PAYLOAD:
        raise Malformed(f"{len(payload)} bytes are more than a {kind.__name__} can have")
    packed = mime.startswith(MSGPACK)
    if not packed and not mime.startswith(JSON):
        raise Malformed(f"encoding '{mime}' is neither {JSON} nor {MSGPACK}")
    decoder = _decoders.get((kind, packed))
    if decoder is None:
        decoder = msgspec.msgpack.Decoder(kind) if packed else msgspec.json.Decoder(kind)
        _decoders[kind, packed] = decoder
    try:
        message = decoder.decode(payload)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise Malformed(f"not a {kind.__name__}: {error}") from None
    assert isinstance(message, kind)
    return message


def check_position(measured: Position, *, robot: str, now: float, reach: Vector) -> None:
    """Refuses a measured position that cannot be true.

    Raises:
        Malformed: As `check_pose`.
    """
    if measured.robot != robot:
        raise Malformed(f"position of '{measured.robot}' on the key of '{robot}'")
    if not (math.isfinite(measured.stamp) and 0.0 < measured.stamp < now + FUTURE_S):
        raise Malformed(f"stamp {measured.stamp} is impossible")
    if not all(abs(value) <= limit for value, limit in zip(measured.position, reach, strict=True)):
        raise Malformed(f"position {measured.position} is outside the arena")
    if measured.yaw is not None and not abs(measured.yaw) <= 1e3:
        raise Malformed(f"yaw {measured.yaw} is impossible")


def check_ranges(ranges: Ranges, *, robot: str, now: float) -> None:
    """Refuses a sweep of range sensors that cannot be true.

    Raises:
        Malformed: If the name is another's, the stamp is not finite or lies in the future, there is no ray or too many,
            the lists differ in length, an angle or a distance is not finite, or a distance is no sensor's.
    """
    if ranges.robot != robot:
        raise Malformed(f"ranges of '{ranges.robot}' on the key of '{robot}'")
    if not (math.isfinite(ranges.stamp) and 0.0 < ranges.stamp < now + FUTURE_S):
        raise Malformed(f"stamp {ranges.stamp} is impossible")
    if not 1 <= len(ranges.distance) <= MAX_RAYS:
        raise Malformed(f"{len(ranges.distance)} rays; a sweep has 1 to {MAX_RAYS}")
    if not len(ranges.bearing) == len(ranges.elevation) == len(ranges.distance):
        raise Malformed("bearings, elevations and distances differ in number")
    if not all(abs(angle) <= 2.0 * math.pi for angle in (*ranges.bearing, *ranges.elevation)):  # NaN fails too
        raise Malformed("a bearing or an elevation is no angle in radians")
    if not all(value is None or 0.0 <= value <= MAX_RANGE for value in ranges.distance):
        raise Malformed(f"a distance is not between 0 and {MAX_RANGE:g} m")


def check_command(command: Command, *, robot: str) -> None:
    """Refuses a command that no body can carry out.

    Raises:
        Malformed: If the name is another's, the sequence number is impossible, `drive` has no finite setpoint, or
            `takeoff` no height.
    """
    if command.robot != robot:
        raise Malformed(f"command of '{command.robot}' on the key of '{robot}'")
    if not 0 < command.seq < 2**53:
        raise Malformed(f"sequence number {command.seq} is impossible")
    if command.action == "drive":
        x, y, z, w = command.setpoint or (math.nan,) * 4
        # a world checks twenty thousand of these in a second: a generator would cost it three times as much
        if not (abs(x) <= ABSURD and abs(y) <= ABSURD and abs(z) <= ABSURD and abs(w) <= ABSURD):
            raise Malformed(f"drive with the setpoint {command.setpoint}")
    elif command.action == "takeoff" and not (command.height is not None and 0.0 < command.height <= MAX_RANGE):
        raise Malformed(f"takeoff with the height {command.height}")


def check_state(state: State, *, robot: str, now: float, reach: Vector) -> None:
    """Refuses telemetry whose pose cannot be true.

    Raises:
        Malformed: As `check_pose`.
    """
    if state.robot != robot:
        raise Malformed(f"state of '{state.robot}' on the key of '{robot}'")
    if not (math.isfinite(state.stamp) and 0.0 < state.stamp < now + FUTURE_S):
        raise Malformed(f"stamp {state.stamp} is impossible")
    if not all(abs(value) <= limit for value, limit in zip(state.position, reach, strict=True)):
        raise Malformed(f"position {state.position} is outside the arena")
    if not all(abs(value) <= MAX_SPEED for value in state.velocity) or not abs(state.yaw) <= 1e3:
        raise Malformed(f"velocity {state.velocity} or yaw {state.yaw} is impossible")


def check_pose(pose: Pose, *, robot: str, now: float, reach: Vector) -> None:
    """Refuses a pose that cannot be true.

    Args:
        pose: What arrived.
        robot: Whose key it arrived on.
        now: UTC time of arrival [s].
        reach: Largest |x|, |y|, |z| [m] that a robot of this experiment can have.

    Raises:
        Malformed: If the name is another's, a number is not finite, the stamp lies in the future, the position is out
            of reach, or the velocity is no robot's.
    """
    if pose.robot != robot:
        raise Malformed(f"pose of '{pose.robot}' on the key of '{robot}'")
    if not (0 < pose.seq < 2**53 and math.isfinite(pose.stamp) and 0.0 < pose.stamp < now + FUTURE_S):
        raise Malformed(f"sequence number {pose.seq} or stamp {pose.stamp} is impossible")
    if not all(abs(value) <= limit for value, limit in zip(pose.position, reach, strict=True)):  # NaN fails too
        raise Malformed(f"position {pose.position} is outside the arena")
    if not all(abs(value) <= MAX_SPEED for value in pose.velocity) or not abs(pose.yaw) <= 1e3:
        raise Malformed(f"velocity {pose.velocity} or yaw {pose.yaw} is impossible")
