"""Messages come back in both encodings; any other payload is `Malformed`, never anything worse."""

import math
from contextlib import suppress
from typing import get_args

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.network import messages as wire
from agents.network import validation
from agents.network.messages import JSON, MSGPACK, Malformed, Order, Pose, PoseReceipt, State, Stop
from tests.cases import examples
from tests.fuzz.messages import good

FEW = examples(60)
KINDS = (Pose, State, wire.Status, Order, wire.Reply, Stop, wire.Event, wire.Goal, wire.CentreState)
ENCODINGS = ("json", "msgpack")

number = st.floats(allow_nan=False, allow_infinity=False)
vector = st.tuples(number, number, number)
count = st.integers(0, 2**53)
word = st.text(max_size=12)
heard = st.builds(PoseReceipt, word, count, number, number, vector, vector)
messages = st.one_of(
    st.builds(Pose, word, count, number, vector, vector, number),
    st.builds(
        State, word, count, number, word, vector, vector, number, st.none() | vector,
        st.none() | st.tuples(number, number, number, number), number, st.none() | vector, st.none() | number,
        st.lists(heard, max_size=3),
    ),
    st.builds(wire.Reply, word, st.booleans(), word, word, st.none() | number),
    st.builds(Stop, word, word),
    st.builds(
        Order, st.sampled_from(get_args(wire.OrderKind)), st.none() | number, st.none() | word, st.none() | number,
        st.none() | st.tuples(number, number), st.none() | st.tuples(number, number, number, number),
    ),
    st.builds(
        wire.Goal, word, count, number, vector, st.none() | number, number, st.none() | st.lists(number, max_size=3)
    ),
    st.builds(wire.Event, number, word, word, word),
    st.sampled_from([message for kind in good("CF01").values() for message in kind]),
)  # fmt: skip
POSE = Pose("KH01", 3, 1000.0, (0.1, -0.2, 0.0), (0.01, 0.0, 0.0), 1.5)
VALID_BOX = (2.0, 2.0, 3.5)


@pytest.mark.parametrize("encoding", ENCODINGS)
@FEW
@given(messages)
def test_round_trip(encoding, message):
    payload = wire.encode(message, encoding)
    assert wire.decode(payload, wire.MIME[encoding], type(message)) == message
    assert wire.decode(payload, wire.MIME[encoding] + ";v=1", type(message)) == message


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("mime", [JSON, MSGPACK])
@FEW
@given(payload=st.binary(max_size=200))
def test_random_bytes_are_malformed(kind, mime, payload):
    with pytest.raises(Malformed):
        wire.decode(payload, mime, kind)


@pytest.mark.parametrize("encoding", ENCODINGS)
@FEW
@given(messages, st.data())
def test_damaged_message_is_decoded_or_malformed(encoding, message, data):
    payload = bytearray(wire.encode(message, encoding))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(payload[: data.draw(st.integers(0, len(payload)))])
    for kind in KINDS:
        with suppress(Malformed):
            assert isinstance(wire.decode(cut, wire.MIME[encoding], kind), kind)


@FEW
@given(st.binary(max_size=200), st.sampled_from([JSON, MSGPACK, "zenoh/bytes", "text/plain", ""]))
def test_any_payload_is_a_stop_with_printable_text(payload, mime):
    stop = wire.read_stop(payload, mime)
    assert stop.operator
    assert stop.words.isprintable()


@pytest.mark.parametrize("mime", [JSON, MSGPACK, "zenoh/bytes"])
def test_stop_of_any_size_is_shown_shortly(mime):
    payloads = (b"[" * 50_000, b"\x91" * 50_000, b"x" * 1_000_000, wire.encode(Stop("w" * 9999, "\n\x1b[2J\u202e")))
    for payload in payloads:
        assert 0 < len(wire.read_stop(payload, mime).words) < 3 * wire.MAX_WORDS


@pytest.mark.parametrize("mime", ["zenoh/bytes", "application/x-www-form-urlencoded", "text/plain", ""])
def test_unmarked_payload_is_read_as_json(mime):
    assert wire.decode(b'{"order": "land"}', mime, Order) == Order("land")
    with pytest.raises(Malformed, match="not a Order"):
        wire.decode(b"land", mime, Order)


anything = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=5)
    | st.binary(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=8,
)  # fmt: skip


@FEW
@given(anything, st.sampled_from([f.encode_name for f in msgspec.structs.fields(Pose)]))
def test_fields_of_other_types_are_malformed(value, field):
    whole = msgspec.to_builtins(POSE)
    payload = msgspec.msgpack.encode({**whole, field: value})
    try:
        pose = wire.decode(payload, MSGPACK, Pose)
    except Malformed:
        return
    assert isinstance(value, int | float | str | list) or (value is None and field in {"velocity", "yaw"})
    try:
        validation.check_pose(pose, now=1000.0, valid_box=VALID_BOX)
    except Malformed:
        return
    assert all(map(math.isfinite, (*pose.position, *(pose.velocity or ()), pose.yaw or 0.0, pose.stamp)))


@pytest.mark.parametrize(
    ("payload", "mime"),
    [
        (b"", JSON),
        (b"[" * 60_000, JSON),
        (b'{"robot":' * 6_000, JSON),
        (b"\x91" * 60_000, MSGPACK),
        (b"\xdf\xff\xff\xff\xff", MSGPACK),  # a table of four thousand million entries, it says
        (b"\xdd\xff\xff\xff\xff" * 100, MSGPACK),
        (b"\xdb\xff\xff\xff\xff", MSGPACK),
        (b'{"robot":"KH01","seq":' + b"9" * 5_000 + b"}", JSON),
        (b'{"robot":"KH01","seq":1e999}', JSON),
        (b'{"robot":"\xff\xfe"}', JSON),
        *(
            (wire.encode(POSE).replace(part, wrong), JSON)
            for part, wrong in (
                (b"1000.0", b"1" + b"0" * 400),
                (b"1000.0", b"NaN"),
                (b'"KH01"', b'"\\ud800"'),
                (b"0.1,-0.2,0.0", b"0.1,-0.2"),
                (b'"seq":3', b'"seq":true'),
                (b'"seq":3', b'"seq":3,"more":1'),
            )
        ),
        (wire.encode(POSE) + b"{}", JSON),
        (wire.encode(POSE, "msgpack") + b"\x00", MSGPACK),
        (wire.encode(POSE), MSGPACK),
        (wire.encode(POSE, "msgpack"), JSON),
        (b" " * (wire.MAX_PAYLOAD + 1), JSON),
    ],
    ids=range(21),
)
def test_malformed(payload, mime):
    with pytest.raises(Malformed):
        wire.decode(payload, mime, Pose)


def test_the_largest_honest_state_fits():
    neighbours = [
        PoseReceipt(f"Robot{k:03}", 12345, 1.7e9 + k, 1.7e9 + k, (-0.123456, -1.234567, 0.123456), (-0.123456,) * 3)
        for k in range(100)
    ]
    state = State("Robot000", 12345, 1.7e9, "running", (0.1, 0.2, 0.3), (0.0, 0.0, 0.0), 0.0, received=neighbours)
    payload = wire.encode(state)
    assert len(payload) < wire.MAX_PAYLOAD / 3
    assert wire.decode(payload, JSON, State).received == neighbours


def test_a_pose_is_rounded_to_what_sensors_know():
    made = wire.pose("KH01", 7, 1.23456789, [1 / 3, -2 / 3, 0.0], [1e-9, 1.0, -1.0], yaw=2.0000004)
    assert made == Pose("KH01", 7, 1.234568, (0.333333, -0.666667, 0.0), (0.0, 1.0, -1.0), 2.0)


@pytest.mark.parametrize("encoding", ENCODINGS)
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


def test_yaw_stays_within_half_a_turn():
    """Yaw of robots on wheels is counted on; beyond 1000 rad every reader refused the pose (159 turns)."""
    for yaw in (0.0, 3.1, -3.1, 1000.5, -1e6, 1e9):
        poses = (
            wire.pose("KH01", 1, 999.0, [0.0] * 3, [0.0] * 3, yaw=yaw),
            wire.position("KH01", 999.0, [0.0] * 3, yaw),
        )
        for said in poses:
            assert abs(said.yaw) <= math.pi
            assert math.cos(said.yaw - yaw) == pytest.approx(1.0, abs=1e-9)
        validation.check_pose(poses[0], now=1000.0, valid_box=VALID_BOX)
        validation.check_position(poses[1], now=1000.0, valid_box=VALID_BOX)
    assert wire.heading(1.234567890123) == 1.234567890123


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(("heard", "followed"), [(0, 0), (1, 1), (3000, 0), (0, 3000), (1500, 700)])
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
