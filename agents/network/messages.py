"""Messages on the network: their structs, their two encodings, and the decoding of payloads.

JSON is the default (every Zenoh tool prints it), MessagePack a setting for thin links. A sample without the encoding of
MessagePack is read as JSON, since many tools set no encoding, or another one. `decode` raises `Malformed` for a payload
that is not the struct, `agents.network.validation` for impossible values. Unknown numbers are left out of
messages: JSON has no NaN.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from math import inf, isfinite, remainder, tau
from typing import Final, Literal, TypeVar

import msgspec

Vector = tuple[float, float, float]
Setpoint = tuple[float, float, float, float]
Encoding = Literal["json", "msgpack"]
OrderKind = Literal["takeoff", "start", "hold", "resume", "leave", "land", "stop", "get", "set", "inspect", "go"]
ChangeKind = Literal["remove", "restart", "replace", "add"]

JSON: Final = "application/json"  # plain, without a schema suffix: REST and command-line tools then print it
MSGPACK: Final = "application/msgpack"
MIME: Final[dict[Encoding, str]] = {"json": JSON, "msgpack": MSGPACK}

EMERGENCY: Final = "emergency stop"
UNKNOWN: Final = "an unknown sender"
MAX_WORDS: Final = 200  # characters of a stop that are shown
MAX_PAYLOAD: Final = 64 * 1024  # [bytes]; `payloads` splits what is longer
STILL: Final[Vector] = (0.0, 0.0, 0.0)
_NUMBER: Final = re.compile(r"(?<![\w.])[-+−]?\d[\d.]*")


class Malformed(ValueError):
    """A payload that is no valid message of its kind."""


class Message(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of everything that is sent by itself."""


class Variable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Variable of a law."""

    name: str
    value: list[float]


class BarePose(Message, frozen=True, omit_defaults=True):
    """Pose of a robot."""

    robot: str
    seq: int  # grows by one with each pose
    stamp: float  # [s] UTC of the measurement
    position: Vector  # [m]
    velocity: Vector | None = None  # [m/s]
    yaw: float | None = None  # [rad]


class Pose(BarePose, frozen=True, omit_defaults=True):
    """Pose of a robot for its neighbours, with what its law says."""

    shared: list[Variable] = []  # left out while the law says nothing


class LawMemory(Message, frozen=True, omit_defaults=True):
    """Memory and measures of a robot's law, for recorder and viewers; unknown variables are left out."""

    robot: str
    seq: int
    stamp: float  # [s] UTC
    memory: list[Variable] = []
    measures: list[Variable] = []  # quantities of one number each

    @property
    def variables(self) -> dict[str, list[float]]:
        """The memory by name."""
        return {each.name: each.value for each in self.memory}

    @property
    def numbers(self) -> dict[str, float]:
        """The measures by name."""
        return {each.name: each.value[0] for each in self.measures if each.value}


class PoseReceipt(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A neighbour's pose as a robot received it."""

    sender: str
    seq: int
    stamp: float  # [s] UTC of the measurement
    arrived: float  # [s] UTC of the reception
    position: Vector  # [m]
    velocity: Vector  # [m/s]


class GoalReceipt(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A goal as its robot received it."""

    seq: int
    stamp: float  # [s] UTC of sending
    pose: float  # [s] UTC of the measurement of the pose from which it was computed
    acted: float  # [s] UTC from which it was used


class State(Message, frozen=True, omit_defaults=True):
    """Telemetry of a body and its decision, for recorder and viewers; unknown numbers are left out.

    Several states of one `seq` are one sample: `payloads` splits a state if its `received` or `goal_receipts` is too
    long for one payload.
    """

    robot: str
    seq: int
    stamp: float  # [s] UTC
    phase: str
    position: Vector | None = None  # [m]
    velocity: Vector | None = None  # [m/s]
    yaw: float | None = None  # [rad]
    goal: Vector | None = None  # [m]
    # x, y, z, yaw [m, rad] for a body that takes positions; v_x, v_y, v_z [m/s], yaw rate [rad/s] for velocities;
    # v [m/s], ω [rad/s], 0, 0 for twists
    setpoint: Setpoint | None = None
    error: float | None = None  # [m] Σ|d − distance| over the links of the robot, by its own knowledge
    true_position: Vector | None = None  # [m] known of a twin
    true_yaw: float | None = None  # [rad] known of a twin
    received: list[PoseReceipt] = []  # poses of neighbours since the last state
    attitude: Setpoint | None = None  # quaternion w, x, y, z, of bodies that measure more than yaw
    shadow_position: Vector | None = None  # [m] place of the twin beside a real robot
    shadow_yaw: float | None = None  # [rad]
    goal_receipts: list[GoalReceipt] = []  # receipts since the last state


class Incident(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Begin, worsening or end of a hazard of a robot; numbered since the start of its process."""

    seq: int
    stamp: float
    text: str


class Status(Message, frozen=True):
    """Condition of a robot, and its counters since the start of its process."""

    robot: str
    stamp: float  # [s] UTC
    phase: str  # word of the lifecycle
    reason: str  # cause of the phase
    body: str = ""  # report of the body
    battery: float | None = None  # charge, 0 to 1
    sent: int = 0  # poses
    received: int = 0  # poses of neighbours
    lost: dict[str, int] = {}  # samples by neighbour that never arrived, by their sequence numbers
    dropped: dict[str, int] = {}  # samples by neighbour that the modelled channel dropped
    malformed: int = 0  # refused payloads
    refused: int = 0  # orders
    ticks: int = 0  # count since the common start
    missed: int = 0  # ticks that were skipped
    decisions: int = 0  # ticks with a goal that was computed or received
    interventions: int = 0  # ticks on which safety changed the decision
    avoided: int = 0  # ticks on which avoidance changed goal or setpoint
    late_s: float = 0.0  # [s] largest lateness of a tick since the last status
    started: float = 0.0  # [s] UTC of the start of the experiment; 0 before
    missing: list[str] = []  # neighbours that were never received, or are gone
    pid: int = 0
    cpu_s: float = 0.0
    rss_mb: float = 0.0
    origin: Setpoint | None = None  # start of the robot, or of its plan: x, y, z [m], yaw [rad]
    # worst present hazard and its outcome: "hold: minimum separation: 0.18 m from CF03 (limit 0.25 m)"
    hazard: str = ""
    incidents: list[Incident] = []  # the last ones, repeated in each status so that a lost status loses none
    stale: dict[str, int] = {}  # samples by neighbour that were older than a known one
    foreign: dict[str, int] = {}  # samples by neighbour from another source than its process
    ended: float = 0.0  # [s] UTC at which it began to land, or was stopped; 0 before

    def incidents_since(self, before: Status | None) -> list[Incident]:
        """Incidents since an earlier status; all, if that is of another process."""
        known = before.incidents if before is not None and before.pid == self.pid else []
        return [each for each in self.incidents if not known or each.seq > known[-1].seq]


class Position(Message, frozen=True, omit_defaults=True):
    """Pose of a robot, measured or known from outside of it.

    Pass on all digits of a measurement: a pose that equals the one before to the last bit counts as frozen, and is not
    used. The stamp is the time of the measurement, not of sending: late positions make drones swing.
    """

    robot: str
    stamp: float  # [s] UTC
    position: Vector  # [m]
    yaw: float | None = None  # [rad]


class BareGoal(Message, frozen=True):
    """Goal for a robot that does not decide for itself."""

    robot: str
    # grows for ever: a new sender begins at a number that no former one has reached, such as the time in milliseconds
    seq: int
    stamp: float  # [s] UTC of the decision
    position: Vector  # [m]
    yaw: float | None  # [rad]
    pose: float  # [s] UTC of the measurement of the robot's pose from which the goal was computed


class Goal(BareGoal, frozen=True, omit_defaults=True):
    """Goal for a robot that does not decide for itself; of a law that gives velocities, with one."""

    # x, y [m/s] and, unless the height is held, z; left out: the robot goes to the position, which it else stands at
    velocity: list[float] | None = None


class CentreState(Message, frozen=True):
    """Report of the central controller, at 1 Hz; counters since the start of its process.

    Pose counts cover poses measured during the run.
    """

    stamp: float  # [s] UTC
    robots: list[str]  # guided
    missing: list[str] = []  # needed, but never received, or gone
    load: float = 0.0  # share of a core in the last second
    late_s: float = 0.0  # [s] largest lateness of a decision in the last second
    decisions: int = 0
    missed: int = 0  # decisions that were skipped because they were late
    goals: int = 0  # sent
    received: dict[str, int] = {}  # poses
    lost: dict[str, int] = {}  # samples missing by their sequence numbers
    dropped: dict[str, int] = {}  # samples dropped by the modelled channel
    malformed: int = 0
    pid: int = 0
    cpu_s: float = 0.0
    rss_mb: float = 0.0


class Command(Message, frozen=True):
    """Command to a body in another process."""

    robot: str
    seq: int
    stamp: float  # [s] UTC
    action: Literal["drive", "takeoff", "land", "stop"]
    setpoint: Setpoint | None = None  # argument of `drive`, see `State`
    height: float | None = None  # [m] argument of `takeoff`


class Ranges(Message, frozen=True):
    """Sweep of the range sensors of a robot."""

    robot: str
    stamp: float  # [s] UTC
    bearing: list[float]  # [rad] angles from the robot's nose
    elevation: list[float]  # [rad]
    distance: list[float | None]  # [m]; None: nothing in reach


class Contact(Message, frozen=True):
    """Begin of a contact in the world."""

    stamp: float  # [s] UTC
    first: str  # robot
    second: str  # robot, obstacle, or "wall" of the arena
    impulse: float  # [N s]
    overlap: float  # [m]


class ObstaclePose(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Pose of an obstacle."""

    name: str
    pose: Vector  # x, y [m], yaw [rad]


class WorldState(Message, frozen=True):
    """Report of the world, at 1 Hz and on every change."""

    stamp: float  # [s] UTC
    engine: str
    time: float  # [s] simulated since the start
    factor: float  # simulated over real time in the last second
    load: float  # share of the last second that was worked
    paused: bool
    robots: list[str]  # simulated here
    mirrored: list[str] = []  # robots of other processes that are seen here
    obstacles: list[ObstaclePose] = []
    contacts: int = 0
    refused: int = 0
    malformed: int = 0
    trouble: str = ""


class WorldOrder(Message, frozen=True):
    """Order of an operator to a world."""

    order: Literal["pause", "resume", "reset"]
    name: str | None = None  # argument of reset: a robot (left out: all)


class WorldReply(Message, frozen=True):
    """Reply of a world to an order."""

    ok: bool
    paused: bool
    time: float
    reason: str = ""


class Order(Message, frozen=True):
    """Order of an operator to a robot.

    "leave" lands a robot and undeclares its token; its process ends with the last of its robots.
    """

    order: OrderKind
    at: float | None = None  # [s] UTC of a start; of a take-off into a run under way, when that began
    name: str | None = None  # name of the parameter to get or set
    value: float | None = None  # value of the parameter to set
    goal: tuple[float, float] | None = None  # x, y [m] of go: where a leader goes, in a straight line
    # of both: `Status.origin` of the robot's former process; its plan goes on from there
    origin: Setpoint | None = None


class Inspection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Facts about a robot's device before a run; None: this kind of body has none."""

    firmware: str | None = None  # version as the device reports it, such as "2025.02"
    volts: float | None = None  # [V] present voltage of the battery
    packets_hz: float | None = None  # [1/s] packets that this process's robots ask of the radio of this one
    capacity_hz: float | None = None  # [1/s] packets that this radio carries
    flying: bool = False  # motors of a drone on
    age_s: float | None = None  # [s] age of its position
    delay_s: float | None = None  # [s] delay of positions from outside, whatever their stamps say, in the last climb
    ahead_s: float | None = None  # [s] stamp of the last external position less the time of its arrival


class Reply(Message, frozen=True):
    """Reply of a robot to an order."""

    robot: str
    ok: bool
    phase: str
    reason: str = ""
    value: float | None = None
    inspection: Inspection | None = None  # answer to "inspect"


class RunOrder(Message, frozen=True):
    """Order of an operator to the conductor of a run."""

    order: ChangeKind
    robots: list[str]
    operator: str = ""  # name of the operator
    spare: str | None = None  # argument of replace: robot of the experiment file that takes over
    body: str | None = None  # argument of replace: address of the new body
    at: tuple[float, float] | None = None  # [m] x, y of its start
    yaw: float = 0.0  # [rad] yaw at its start


class RunReply(Message, frozen=True):
    """Reply of a conductor when all is done."""

    done: dict[str, str] = {}  # result by robot
    refused: dict[str, str] = {}  # reason by robot
    reason: str = ""  # cause of a refusal of the whole order


class Stop(Message, frozen=True):
    """Emergency stop for all robots; see `read_stop`."""

    operator: str  # name of the sender
    reason: str

    @property
    def words(self) -> str:
        """Reason that robots and runs report."""
        return f"{EMERGENCY} by {self.operator}" + (f": {self.reason}" if self.reason else "")


class Event(Message, frozen=True):
    """Event of a run."""

    stamp: float  # [s] UTC
    kind: str  # phase, start, lost, ...
    source: str  # robot or process
    text: str


class HostClock(Message, frozen=True):
    """Offset of the clock of a host from that of the conductor."""

    host: str
    stamp: float  # [s] UTC of the conductor
    offset: float  # [s] reading of the host less that of the conductor
    uncertainty: float  # [s]
    robots: list[str]  # robots of the host
    # [s] correction that the robots subtract from their stamps from now on, reached at the rate `agents.clock.SLEW`;
    # None: the offset of the first such message of a run
    applied: float | None = None


M = TypeVar("M", bound=Message)

# plug-ins may give numbers of numpy, which are no floats to msgspec
_json = msgspec.json.Encoder(enc_hook=float)
_msgpack = msgspec.msgpack.Encoder(enc_hook=float)
_decoders: dict[tuple[type, Encoding], msgspec.json.Decoder[object] | msgspec.msgpack.Decoder[object]] = {}


def number(value: float) -> float | None:
    """A number for a message: None if it is not finite."""
    return value if -inf < value < inf else None


def vector(values: Sequence[float]) -> Vector | None:
    """Three numbers for a message: None if one of them is not finite."""
    x, y, z = values
    return (x, y, z) if isfinite(x) and isfinite(y) and isfinite(z) else None


def heading(yaw: float) -> float | None:
    """A yaw for a message, within ±π [rad]; None if it is not finite."""
    return remainder(yaw, tau) if isfinite(yaw) else None


def pose(
    robot: str, seq: int, stamp: float, position: Sequence[float], velocity: Sequence[float],
    *, yaw: float, words: Iterable[tuple[str, Sequence[float]]] = (),
) -> Pose:  # fmt: skip
    """A pose to send, rounded to micrometres and microradians: a third fewer bytes, far below any sensor's noise.

    `velocity` [m/s] and `yaw` [rad] are left out of the message if they are not finite. `words` are variables by name.
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
        variables(words) if words else [],
    )


def variables(values: Iterable[tuple[str, Sequence[float]]]) -> list[Variable]:
    """Variables to send, by name; those that are not finite are left out."""
    return [Variable(name, list(value)) for name, value in values if all(map(isfinite, value))]


def memory(
    robot: str, seq: int, stamp: float, variables_: Mapping[str, Sequence[float]], measures: Mapping[str, float]
) -> LawMemory:
    """Message with the memory and the measures of a law."""
    numbers = ((name, (value,)) for name, value in measures.items())
    return LawMemory(robot, seq, stamp, variables(variables_.items()), variables(numbers))


def wanted(velocity: Sequence[float]) -> list[float] | None:
    """Velocity of a goal to send, rounded as in poses; None without one."""
    known = [round(each, 6) for each in velocity if isfinite(each)]
    return known if len(known) > 1 else None


def position(robot: str, stamp: float, place: Sequence[float], yaw: float) -> Position:
    """A measured position to send; `yaw` [rad] is left out if it is not finite."""
    x, y, z = place
    return Position(robot, round(stamp, 6), (x, y, z), heading(yaw))


def payloads(state: State, encoding: Encoding) -> Iterator[bytes]:
    """The payloads of telemetry: several if the received poses are too long for one; each then has a part of them."""
    payload = encode(state, encoding)
    received, receipts = state.received, state.goal_receipts
    if len(payload) <= MAX_PAYLOAD or len(received) + len(receipts) < 2:
        yield payload
        return
    i, j = (len(received) + 1) // 2, len(receipts) // 2
    for part in ((received[:i], receipts[:j]), (received[i:], receipts[j:])):
        yield from payloads(msgspec.structs.replace(state, received=part[0], goal_receipts=part[1]), encoding)


def encode(message: Message | PoseReceipt, encoding: Encoding = "json") -> bytes:
    """The payload of a message, or a part of one."""
    return _json.encode(message) if encoding == "json" else _msgpack.encode(message)


def encoding_of(mime: str) -> Encoding:
    """Encoding of a payload by its MIME type."""
    return "msgpack" if mime.startswith(MSGPACK) else "json"


def decode(payload: bytes, mime: str, kind: type[M]) -> M:
    """The message in a payload, by its MIME type; raises Malformed if the payload is too large, or not a `kind`."""
    if len(payload) > MAX_PAYLOAD:
        raise Malformed(f"{len(payload)} bytes are more than a {kind.__name__} can have")
    encoding = encoding_of(mime)
    decoder = _decoders.get((kind, encoding))
    if decoder is None:
        decoder = msgspec.json.Decoder(kind) if encoding == "json" else msgspec.msgpack.Decoder(kind)
        _decoders[kind, encoding] = decoder
    try:
        message = decoder.decode(payload)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise Malformed(f"no valid {kind.__name__}: {error}") from None
    assert isinstance(message, kind)
    return message


def without_numbers(text: str) -> str:
    """A text without its numbers, except those in names: one that counts seconds is news once."""
    return _NUMBER.sub("", text)


def read_stop(payload: bytes, mime: str) -> Stop:
    """The emergency stop in any payload: JSON or MessagePack with or without its fields, text, garbage, or nothing.

    Sender and reason are read as far as possible, on one line of at most `MAX_WORDS` characters each.
    """
    decoded: object = None
    with suppress(Exception):  # unreadable is a stop as well
        decoded = (msgspec.msgpack if mime.startswith(MSGPACK) else msgspec.json).decode(payload[:MAX_PAYLOAD])
    sender, reason = "", payload[:MAX_PAYLOAD].decode(errors="replace")
    if isinstance(decoded, str):
        reason = decoded
    elif isinstance(decoded, dict) and not decoded.keys().isdisjoint(Stop.__struct_fields__):
        sender, reason = (
            text if isinstance(text := decoded.get(field), str) else "" for field in Stop.__struct_fields__
        )
    return Stop(_printable(sender) or UNKNOWN, _printable(reason))


def _printable(text: str) -> str:
    """Text of others on one line, without what could steer a terminal."""
    return "".join(letter if letter.isprintable() else " " for letter in text[:MAX_WORDS]).strip()
