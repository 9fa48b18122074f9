"""What goes over the network: the structs, their two encodings, and the check of what arrives.

JSON is the default (every Zenoh tool prints it), MessagePack a setting for thin links: a sample is MessagePack if its
encoding says so, and JSON otherwise, since many tools set no encoding, or another one. What arrives is checked before
it is believed: `decode` raises `Malformed` for anything that is not the struct, `agents.network.validation` for one
that cannot be true. Unknown numbers are left out of messages: JSON has no NaN.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from math import inf, isfinite, remainder, tau
from typing import Final, Literal, TypeVar

import msgspec

Vector = tuple[float, float, float]
Setpoint = tuple[float, float, float, float]
Encoding = Literal["json", "msgpack"]
OrderKind = Literal["takeoff", "start", "hold", "resume", "leave", "land", "stop", "get", "set"]
ChangeKind = Literal["pause", "resume", "remove", "restart", "replace", "add"]

JSON: Final = "application/json"  # plain, without a schema suffix: REST and command-line tools then print it
MSGPACK: Final = "application/msgpack"
MIME: Final[dict[Encoding, str]] = {"json": JSON, "msgpack": MSGPACK}

EMERGENCY: Final = "emergency stop"
UNKNOWN: Final = "an unknown sender"
MAX_WORDS: Final = 200  # characters of a stop that are shown
MAX_PAYLOAD: Final = 64 * 1024  # [bytes]; `payloads` splits what is longer
STILL: Final[Vector] = (0.0, 0.0, 0.0)


class Malformed(ValueError):
    """A payload that is not what its key promises."""


class Pose(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Pose of a robot for its neighbours: position [m], UTC `stamp` [s], running `seq`, and if known velocity [m/s] and
    yaw [rad]."""

    robot: str
    seq: int
    stamp: float
    position: Vector
    velocity: Vector | None = None
    yaw: float | None = None


class Heard(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A pose that reached its listener: whose, which one, when it was taken and when it was heard (UTC [s])."""

    speaker: str
    seq: int
    stamp: float
    arrived: float
    position: Vector
    velocity: Vector


class GoalReceipt(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A goal that reached its robot: when it was sent, when the pose was taken on which it rests, and when it was acted
    on (UTC [s])."""

    seq: int
    stamp: float
    pose: float
    acted: float


class State(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Telemetry of a body and its decision, for recorder and viewers; unknown numbers are left out.

    Several states of one `seq` are one sample: `payloads` splits those whose `heard` or `followed` is too long for one
    payload.
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
    position: Vector | None = None
    velocity: Vector | None = None
    yaw: float | None = None
    goal: Vector | None = None
    setpoint: Setpoint | None = None
    error: float | None = None
    true_position: Vector | None = None
    true_yaw: float | None = None
    heard: list[Heard] = []
    attitude: Setpoint | None = None
    shadow_position: Vector | None = None
    shadow_yaw: float | None = None
    followed: list[GoalReceipt] = []


class Incident(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Something was found wrong with a robot, has become worse, or is over; numbered since its process began."""

    seq: int
    stamp: float
    text: str


class Status(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a robot is: lifecycle phase, what holds it, what its body says, its counters since the process began.

    `missing` names neighbours that were never heard or are gone; `lost` counts, per neighbour, samples that the
    sequence numbers prove were sent and never came, `dropped` those that came and that the modelled network dropped
    (`agents.network.channel_model`), and `stale` those that came and were left out, because a newer one was known or
    the process that sent them is gone (names without any are left out of both). `late_s` is the largest lateness of a
    tick since the last status. `started` is the UTC time at which the robot began to run the experiment (0 before).
    From there `ticks` count, and `decisions`, at which it computed its goal (or was told one). `interventions` are
    ticks on which safety changed what had been decided, `avoided` those of them, and of changed goals, that kept clear
    of something. `origin` is where it, or its plan, began: x, y, z [m] and yaw [rad]. `hazard` is the worst of what is
    wrong with it now and what is done about that, such as "hold: minimum separation: 0.18 m from CF03 (limit 0.25 m)";
    `incidents` are the last few beginnings and ends of such, again in every status, so that none is lost with one.
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
    dropped: dict[str, int]
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
    origin: Setpoint | None = None
    hazard: str = ""
    incidents: list[Incident] = []
    stale: dict[str, int] = {}


class Position(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Where a robot is, as something outside of it measured or knows: position [m], yaw [rad] if known, UTC [s]."""

    robot: str
    stamp: float
    position: Vector
    yaw: float | None = None


class Goal(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where a guided robot must go: position [m], yaw [rad] if one is wanted, when it was decided (UTC `stamp` [s]).

    `pose` is when that robot's own pose was taken on which the goal rests (UTC [s]). The running `seq` grows for ever:
    whoever decides begins at a number that nobody before him had reached, such as the time in milliseconds.
    """

    robot: str
    seq: int
    stamp: float
    position: Vector
    yaw: float | None
    pose: float


class CentreState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the centre says of itself, at 1 Hz.

    `robots` are guided; `missing` are those that it needs and never heard, or that are gone. `load` is the share of a
    core that it took in the last second, `late_s` the largest lateness of a decision in it. The others count since its
    process began: `decisions`, and `missed` ones that were too late to be made, and `goals` sent. Of poses only those
    count that were taken in the run, per robot: `heard`, `lost` by their numbers, `dropped` by the modelled network.
    """

    stamp: float
    robots: list[str]
    missing: list[str]
    load: float
    late_s: float
    decisions: int
    missed: int
    goals: int
    heard: dict[str, int]
    lost: dict[str, int]
    dropped: dict[str, int]
    malformed: int
    pid: int
    cpu_s: float
    rss_mb: float


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


class ObstaclePose(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An obstacle by name, with x, y [m] and yaw [rad]."""

    name: str
    pose: Vector


class WorldState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a world says of itself, at 1 Hz and on every change.

    `factor` is simulated over real time of the last second, `load` the share of it that the work took; `time` is
    simulated since it began [s]. `robots` are carried, `mirrored` are elsewhere and seen here.
    """

    stamp: float
    engine: str
    time: float
    factor: float
    load: float
    paused: bool
    robots: list[str]
    mirrored: list[str]
    obstacles: list[ObstaclePose]
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
    """What an operator asks of a robot: `at` is a UTC start time [s]; `name` and `value` belong to get and set.

    `origin` belongs to the start of a robot that comes back: x, y, z [m] and yaw [rad] of the `Status.origin` that its
    name had. Its plan goes on from there.

    A robot that is told to leave lands and takes its token back; its process ends with the last of its robots.
    """

    order: OrderKind
    at: float | None = None
    name: str | None = None
    value: float | None = None
    origin: Setpoint | None = None


class Reply(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A robot's answer to an order."""

    robot: str
    ok: bool
    phase: str
    reason: str = ""
    value: float | None = None


class RunOrder(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What an operator asks of the conductor of a run under way; `who` is what the operator goes by.

    The others belong to replace: the `spare` of the experiment file that takes over, or the address of a `body`; `at`
    is where it starts, x, y [m], with `yaw` [rad].
    """

    order: ChangeKind
    robots: list[str]
    who: str = ""
    spare: str | None = None
    body: str | None = None
    at: tuple[float, float] | None = None
    yaw: float = 0.0


class RunReply(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A conductor's answer, when all is done: by robot what was done, and why not; `reason` refuses the whole order."""

    done: dict[str, str] = {}
    refused: dict[str, str] = {}
    reason: str = ""


class Stop(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Emergency stop for everyone, with who asks and why; see `read_stop`."""

    who: str
    reason: str

    @property
    def words(self) -> str:
        """The stop as robots and runs give it for their reason."""
        return f"{EMERGENCY} by {self.who}" + (f": {self.reason}" if self.reason else "")


class Event(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Something that happened in a run: `kind` is a word (`phase`, `start`, `lost`, ...), `source` who or what."""

    stamp: float
    kind: str
    source: str
    text: str


class HostClock(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a host's clock lies to the conductor's at `stamp` (the conductor's, UTC [s]).

    `offset` is the host's reading less the conductor's [s], within `uncertainty` [s]. `robots` run there; from then on
    they take `applied` [s] off what they stamp, going there by `agents.clock.SLEW` from what they took off before.
    None: the offset of the first such message of a run.
    """

    host: str
    stamp: float
    offset: float
    uncertainty: float
    robots: list[str]
    applied: float | None = None


Message = (
    Pose
    | State
    | Status
    | Position
    | Goal
    | CentreState
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
    | RunOrder
    | RunReply
)
M = TypeVar("M", bound=Message)

_json = msgspec.json.Encoder()
_msgpack = msgspec.msgpack.Encoder()
_decoders: dict[tuple[type, bool], msgspec.json.Decoder[object] | msgspec.msgpack.Decoder[object]] = {}


def number(value: float) -> float | None:
    """A number as messages have it: None if it is not known."""
    return value if -inf < value < inf else None


def vector(values: Sequence[float]) -> Vector | None:
    """Three numbers as messages have them: None if one of them is not known."""
    x, y, z = values
    return (x, y, z) if isfinite(x) and isfinite(y) and isfinite(z) else None


def heading(yaw: float) -> float | None:
    """A yaw as messages have it, within ±π [rad]: bodies count on over full turns, messages do not."""
    return remainder(yaw, tau) if isfinite(yaw) else None


def pose(robot: str, seq: int, stamp: float, position: Sequence[float], velocity: Sequence[float], yaw: float) -> Pose:  # noqa: PLR0917
    """A pose to send, rounded to micrometres and microradians: a third fewer bytes, far below any sensor's noise.

    `velocity` [m/s] and `yaw` [rad] are left out of the message if they are not finite.
    """
    x, y, z = position
    moves, toward = vector(velocity), heading(yaw)
    return Pose(
        robot,
        seq,
        round(stamp, 6),
        (round(x, 6), round(y, 6), round(z, 6)),
        None if moves is None else (round(moves[0], 6), round(moves[1], 6), round(moves[2], 6)),
        None if toward is None else round(toward, 6),
    )


def position(robot: str, stamp: float, place: Sequence[float], yaw: float) -> Position:
    """A measured position to send; `yaw` [rad] is left out if it is not finite."""
    x, y, z = place
    return Position(robot, round(stamp, 6), (x, y, z), heading(yaw))


def payloads(state: State, encoding: Encoding) -> Iterator[bytes]:
    """The payloads of telemetry: one, unless what was heard is too long for it; each then has a part of that."""
    payload = encode(state, encoding)
    heard, followed = len(state.heard), len(state.followed)
    if len(payload) <= MAX_PAYLOAD or heard + followed < 2:
        yield payload
        return
    i, j = (heard + 1) // 2, followed // 2
    yield from payloads(msgspec.structs.replace(state, heard=state.heard[:i], followed=state.followed[:j]), encoding)
    yield from payloads(msgspec.structs.replace(state, heard=state.heard[i:], followed=state.followed[j:]), encoding)


def encode(message: Message, encoding: Encoding = "json") -> bytes:
    """The payload of a message."""
    return _json.encode(message) if encoding == "json" else _msgpack.encode(message)


def decode(payload: bytes, mime: str, kind: type[M]) -> M:
    """The message in a payload, by its MIME type.

    Raises:
        Malformed: If the payload is too large, or not a `kind`.
    """
    if len(payload) > MAX_PAYLOAD:
        raise Malformed(f"{len(payload)} bytes are more than a {kind.__name__} can have")
    packed = mime.startswith(MSGPACK)
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


def read_stop(payload: bytes, mime: str) -> Stop:
    """The emergency stop in any payload: JSON or MessagePack with or without its fields, text, garbage, or nothing.

    Sender and reason are read as far as possible, on one line of at most `MAX_WORDS` characters each.
    """
    said: object = None
    with suppress(Exception):  # unreadable is a stop as well
        said = (msgspec.msgpack if mime.startswith(MSGPACK) else msgspec.json).decode(payload[:MAX_PAYLOAD])
    who, reason = "", payload[:MAX_PAYLOAD].decode(errors="replace")
    if isinstance(said, str):
        reason = said
    elif isinstance(said, dict) and not said.keys().isdisjoint(Stop.__struct_fields__):
        who, reason = (text if isinstance(text := said.get(field), str) else "" for field in Stop.__struct_fields__)
    return Stop(_shown(who) or UNKNOWN, _shown(reason))


def _shown(text: str) -> str:
    """Text of others on one line, without what could steer a terminal."""
    return "".join(letter if letter.isprintable() else " " for letter in text[:MAX_WORDS]).strip()
