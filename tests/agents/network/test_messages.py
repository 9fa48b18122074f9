"""Messages, and inboxes that decode, check, count and pass them on: any other payload is refused, and no worse."""

import math
from functools import partial
from itertools import chain
from math import inf, nan

import msgspec
import numpy as np
import pytest

from agents.network import messages as wire
from agents.network import pubsub, validation
from agents.network.keys import Keys
from agents.network.messages import JSON, MSGPACK, Malformed, Order, Pose, PoseReceipt, State, Stop
from tests.cases import for_each
from tests.fuzz.messages import good
from tests.network import Channel, Net, Query, Sample

POSE = Pose("KH01", 3, 1000.0, (0.1, -0.2, 0.0), (0.01, 0.0, 0.0), 1.5)
VALID_BOX = (2.0, 2.0, 3.5)
encodings = pytest.mark.parametrize("encoding", ["json", "msgpack"])

SAMPLES = [*chain(*good("CF01").values()), Stop("ana", "fire"), wire.Event(1.0, "a", "b", "c"), POSE]


@encodings
@for_each("message", SAMPLES)
def test_round_trip(encoding, message):
    payload = wire.encode(message, encoding)
    for mime in (wire.MIME[encoding], wire.MIME[encoding] + ";v=1"):
        assert wire.decode(payload, mime, type(message)) == message


@encodings
@pytest.mark.parametrize("number", [np.float32, np.float64])
def test_numbers_of_numpy_are_sent(encoding, number):
    state = State("CF01", 1, 1000.0, "running", goal=(number(0.5), number(-1.0), 0.0), error=number(0.25))
    plain = State("CF01", 1, 1000.0, "running", goal=(0.5, -1.0, 0.0), error=0.25)
    assert wire.encode(state, encoding) == wire.encode(plain, encoding)


WHOLE = b'{"operator": "ana", "reason": "fire"}'


@for_each(
    "payload, mime, words",
    [  # by zenpark; by z_put and zenoh-cli; by `curl -X PUT -d`, with a header, with --json; by anything at all
        (WHOLE, JSON, " by ana: fire"),
        (WHOLE, "application/x-www-form-urlencoded", " by ana: fire"),
        (b"stop it", "text/plain", " by an unknown sender: stop it"),
        (b'"stop"', JSON, " by an unknown sender: stop"),
        (b'{"operator": "ana"}', JSON, " by ana"),
        (b"{}", JSON, " by an unknown sender: {}"),
        (b"", "zenoh/bytes", " by an unknown sender"),
        (b"\x81\xa8operator\xa3ana", MSGPACK, " by ana"),
        (b"\xff\x00\x1b[2J", "image/png", " by an unknown sender: \N{REPLACEMENT CHARACTER}  [2J"),
    ],
)
def test_stop_in_any_form_names_its_sender(payload, mime, words):
    assert wire.read_stop(payload, mime).words == wire.EMERGENCY + words


@for_each("payload", [b"[" * 50_000, b"\x91" * 50_000, b"x" * 1_000_000, wire.encode(Stop("w" * 9999, "\n\u202e"))])
def test_stop_of_any_size_is_shown_shortly(payload):
    for mime in (JSON, MSGPACK, "zenoh/bytes", ""):
        words = wire.read_stop(payload, mime).words
        assert words.isprintable()
        assert 0 < len(words) < 3 * wire.MAX_WORDS


@pytest.mark.parametrize("mime", ["zenoh/bytes", "application/x-www-form-urlencoded", "text/plain", ""])
def test_unmarked_payload_is_read_as_json(mime):
    assert wire.decode(b'{"order": "land"}', mime, Order) == Order("land")
    with pytest.raises(Malformed, match="no valid Order"):
        wire.decode(b"land", mime, Order)


@for_each(
    "payload, mime",
    [
        (b"", JSON),
        (b"[" * 60_000, JSON),
        (b"\x91" * 60_000, MSGPACK),
        (b"\xdf\xff\xff\xff\xff", MSGPACK),  # a table of four thousand million entries, it says
        (b'{"robot":"KH01","seq":' + b"9" * 5_000 + b"}", JSON),
        (b'{"robot":"\xff\xfe"}', JSON),
        (wire.encode(POSE).replace(b"1000.0", b"NaN"), JSON),
        (wire.encode(POSE).replace(b'"seq":3', b'"seq":true'), JSON),
        (wire.encode(POSE).replace(b'"seq":3', b'"seq":3,"more":1'), JSON),
        (wire.encode(POSE) + b"{}", JSON),
        (wire.encode(POSE), MSGPACK),
        (wire.encode(POSE, "msgpack"), JSON),
        (b" " * (wire.MAX_PAYLOAD + 1), JSON),
    ],
)
def test_malformed(payload, mime):
    with pytest.raises(Malformed):
        wire.decode(payload, mime, Pose)


def test_a_pose_is_rounded_to_what_sensors_know():
    made = wire.pose("KH01", 7, 1.23456789, [1 / 3, -2 / 3, 0.0], [1e-9, 1.0, -1.0], yaw=2.0000004)
    assert made == Pose("KH01", 7, 1.234568, (0.333333, -0.666667, 0.0), (0.0, 1.0, -1.0), 2.0)


@encodings
def test_unknown_numbers_are_left_out(encoding):
    nothing = [math.nan] * 3
    for said in (
        wire.pose("A", 1, 1000.0, [0.1, 0.2, 0.3], nothing, yaw=math.nan),
        State("A", 1, 1000.0, "ready", wire.vector([0.1, 0.2, math.nan]), wire.vector(nothing), wire.heading(math.inf)),
        wire.position("A", 1000.0, [0.1, 0.2, 0.3], math.nan),
    ):
        payload = wire.encode(said, encoding)
        assert not any(word in payload for word in (b"null", b"velocity", b"yaw", b"received"))
        assert wire.decode(payload, wire.MIME[encoding], type(said)) == said


@for_each("yaw", [0.0, 3.1, -3.1, 1000.5, -1e6, 1e9])
def test_yaw_stays_within_half_a_turn(yaw):
    """Yaw of robots on wheels is counted on; beyond 1000 rad every reader refused the pose (159 turns)."""
    pose = wire.pose("KH01", 1, 999.0, [0.0] * 3, [0.0] * 3, yaw=yaw)
    position = wire.position("KH01", 999.0, [0.0] * 3, yaw)
    for said in (pose, position):
        assert abs(said.yaw) <= math.pi
        assert math.cos(said.yaw - yaw) == pytest.approx(1.0, abs=1e-9)
    validation.check_pose(pose, now=1000.0, valid_box=VALID_BOX)
    validation.check_position(position, now=1000.0, valid_box=VALID_BOX)
    assert wire.heading(1.234567890123) == 1.234567890123


@encodings
@pytest.mark.parametrize(("heard", "followed"), [(1, 1), (3000, 0), (0, 3000), (1500, 700)])
def test_long_telemetry_goes_in_several_payloads(encoding, heard, followed):
    state = State(
        "A", 7, 1000.0, "running", (0.1, 0.2, 0.3),
        received=[PoseReceipt("KH01", k, 1000.0 + k, 1000.1 + k, (0.123456,) * 3, (0.0,) * 3) for k in range(heard)],
        goal_receipts=[wire.GoalReceipt(k, 1000.0 + k, 1000.1 + k, 1000.2 + k) for k in range(followed)],
    )  # fmt: skip
    payloads = list(wire.payloads(state, encoding))
    parts = [wire.decode(payload, wire.MIME[encoding], State) for payload in payloads]
    assert (len(parts) == 1) == (len(wire.encode(state, encoding)) <= wire.MAX_PAYLOAD)
    assert [each for part in parts for each in part.received] == state.received
    assert [each for part in parts for each in part.goal_receipts] == state.goal_receipts
    bare = msgspec.structs.replace(state, received=[], goal_receipts=[])
    assert all(msgspec.structs.replace(part, received=[], goal_receipts=[]) == bare for part in parts)


KEYS = Keys("park")
ORDER = KEYS.order("A")


def add(channel, robot, seq=1, of=None):
    """An order to stop a robot, on its key or on that `of` another one."""
    channel.add(Sample(KEYS.setpoint(of or robot), wire.JSON, wire.encode(wire.Command(robot, seq, 1.0, "stop"))))


def odd(command):
    if command.seq % 2 == 0:
        raise Malformed("an even number")


def test_inbox_passes_valid_messages_and_counts_the_rest():
    channel, refused = Channel(KEYS.setpoint("*")), []
    inbox = pubsub.Inbox(
        channel, wire.Command, keys=KEYS, robots={"A", "B"}, on_refusal=lambda *refusal: refused.append(refusal)
    )
    assert list(inbox.read()) == []
    add(channel, "A")
    add(channel, "B", of="A")
    add(channel, "B", 2)
    channel.add(Sample(KEYS.setpoint("B"), wire.JSON, b"{}"))
    channel.add(Sample(KEYS.setpoint("C"), wire.JSON, b"not decoded"))
    add(channel, "D")
    add(channel, "B", 3)
    read = list(inbox.read_samples(odd, lambda key: key != KEYS.setpoint("C")))
    assert [(command.robot, command.seq, str(sample.key_expr)) for command, sample in read] == [
        ("A", 1, KEYS.setpoint("A")), ("B", 3, KEYS.setpoint("B")),
    ]  # fmt: skip
    assert inbox.malformed == 3
    assert refused == [
        (KEYS.setpoint("A"), "command of 'B' on the key of 'A'"), (KEYS.setpoint("B"), "an even number"),
        (KEYS.setpoint("B"), inbox.trouble),
    ]  # fmt: skip
    assert list(inbox.read()) == []


@pytest.fixture
def orders():
    net = Net()
    made = pubsub.Orders(net.session, ORDER, Order)

    def ask(payload, times=1, encoding="json", key=ORDER):
        for _ in range(times):
            query = Query(key, wire.MIME[encoding], payload)
            net.channels[0].add(query)
        return query

    return made, ask


def test_a_malformed_order_is_answered_and_counted(orders):
    orders, ask = orders
    wrong = [ask(payload) for payload in (b"{}", b"nonsense", b'{"order": "fly"}', b"")]
    reader, right = ask(b"", key="park/**"), ask(b'{"order": "land"}')
    assert list(orders.read()) == [(right, Order("land"))]
    assert [query.answers for query in wrong] == [1] * 4
    assert wrong[-1].error == pubsub.NO_ORDER.encode()
    assert (reader.answers, right.answers, orders.malformed) == (0, 0, 3)


@pytest.mark.parametrize("encoding", ["json", "msgpack"])
@pytest.mark.parametrize("order", ["land", "stop"])
def test_flood_of_queries_displaces_no_landing(order, encoding, orders):
    orders, ask = orders
    start, ends, hold = (wire.encode(Order(name), encoding) for name in ("start", order, "hold"))
    ask(start, 5, encoding)
    ask(ends, 1, encoding)
    ask(hold, 40, encoding)
    assert len(orders.queue) == pubsub.ORDERS
    assert [given.order for _, given in orders.read()] == [order] + ["hold"] * (pubsub.ORDERS - 1)
    ask(ends, 40, encoding)
    ask(hold, 40, encoding)
    assert [given.order for _, given in orders.read()] == [order] * pubsub.ORDERS


def test_last_value_answers_a_plain_get():
    net = Net()
    last = pubsub.LastValue(net.session, KEYS.pose("A"), wire.JSON)
    queries = [Query("park/*/pose", "", b""), Query(KEYS.pose("A"), "", b"")]
    net.channels[0].add(queries[0])
    assert (last.answer(), queries[0].answer) == (1, None)
    last.hold(b"1")
    last.hold(b"2")
    net.channels[0].add(queries[1])
    assert last.answer() == 1
    assert queries[1].answer == (KEYS.pose("A"), b"2", wire.JSON)


SEEN = {"now": 1000.0, "valid_box": (2.0, 2.0, 3.5)}
GOOD = {
    "pose": Pose("KH01", 3, 1000.0, (0.1, -0.2, 0.0), (0.01, 0.0, 0.0), 1.5),
    "state": State("KH01", 1, 1000.0, "running", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.5, None, None, 0.0),
    "goal": wire.Goal("KH01", 7, 999.9, (0.5, -0.5, 0.0), 0.25, 999.85),
    "ranges": wire.Ranges("KH01", 1000.0, [0.0, 1.5], [0.0, 0.0], [0.25, None]),
    "drive": wire.Command("KH01", 1, 1.0, "drive", (0.1, 0.0, 0.0, 0.0)),
    "takeoff": wire.Command("KH01", 1, 1.0, "takeoff", None, 0.5),
}
CHECKS = {
    "pose": partial(validation.check_pose, **SEEN),
    "state": partial(validation.check_state, **SEEN),
    "goal": partial(validation.check_goal, oldest_s=1.0, **SEEN),
    "ranges": partial(validation.check_ranges, now=1000.0),
    "drive": validation.check_command,
    "takeoff": validation.check_command,
}
HONEST = [
    *((what, {}) for what in GOOD),
    ("pose", {"stamp": 1.0}),  # late joiners get old ones
    ("goal", {"yaw": None, "stamp": 1000.5, "pose": 1001.0}),  # clocks that differ a little
    ("goal", {"stamp": 999.0}),
]
IMPOSSIBLE = {
    "seq": [0, 2**53],
    "stamp": [0.0, nan, 1006.0],
    "position": [(2.01, 0.0, 0.0), (0.0, -2.01, 0.0), (0.0, 0.0, 9.0), (0.0, nan, 0.0)],
    "velocity": [(0.0, 0.0, 51.0), (0.0, nan, 0.0), (-51.0, 0.0, 0.0)],
    "yaw": [nan, 1e4, -inf],
}
IN_KIND = {"pose": IMPOSSIBLE, "goal": IMPOSSIBLE, "state": IMPOSSIBLE.keys() - {"seq"}, "ranges": ["stamp"]}
REFUSED = [
    *((what, field, IMPOSSIBLE[field]) for what, fields in IN_KIND.items() for field in fields),
    ("goal", "stamp", [998.9]),
    ("goal", "pose", [nan, 0.0, 1005.5]),
    ("ranges", "distance", [[0.25], [0.25, inf], [-0.1, None], []]),
    ("ranges", "elevation", [[0.0, 0.0, 0.0], [-90.0, 0.0]]),
    ("ranges", "bearing", [[0.0, nan], [0.0, 90.0]]),
    ("drive", "seq", [0]),
    ("drive", "setpoint", [None, (0.0, nan, 0.0, 0.0), (0.0, 0.0, 0.0, -inf)]),
    ("takeoff", "height", [None, -0.5, 0.0]),
]


def check(what, **changes):
    CHECKS[what](msgspec.structs.replace(GOOD[what], **changes))


@for_each("what, changes", HONEST)
def test_honest_messages_pass(what, changes):
    check(what, **changes)


@for_each("what, field, values", REFUSED)
def test_impossible_messages_are_refused(what, field, values):
    for value in values:
        with pytest.raises(Malformed):
            check(what, **{field: value})


def test_sweep_has_1_to_720_rays():
    rays = [0.0] * 721
    for some in (rays[:1], rays[:720]):
        check("ranges", distance=some, bearing=some, elevation=some)
    with pytest.raises(Malformed, match="721 rays"):
        check("ranges", distance=rays, bearing=rays, elevation=rays)


def test_gap_counts_at_most_what_time_allows():
    said = {  # the last number, the next one and the time between them [s]: lost numbers
        (1, 2, 0.02): 0,
        (1, 5, 0.08): 3,
        (1, 5, 10.0): 3,  # it speaks when it has something to say
        (7, 1, 3.0): 0,  # began anew
        (7, 3, 3.0): 2,
        (7, 99_999_999, 0.02): 1,  # forged: at 50 Hz one can have been said in that time
        (99_999_999, 9, 0.02): 1,
    }
    assert {each: validation.missed(*each, 50.0) for each in said} == said
