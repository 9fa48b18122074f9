"""Messages come back in both encodings; any other payload is `Malformed`, never anything worse."""

import math
from contextlib import suppress
from itertools import chain

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.network import messages as wire
from agents.network import validation
from agents.network.messages import JSON, MSGPACK, Malformed, Order, Pose, PoseReceipt, State, Stop
from tests.cases import examples, for_each
from tests.fuzz.messages import good

FEW = examples(60)
KINDS = (Pose, State, wire.Status, Order, wire.Reply, Stop, wire.Event, wire.Goal, wire.CentreState)
POSE = Pose("KH01", 3, 1000.0, (0.1, -0.2, 0.0), (0.01, 0.0, 0.0), 1.5)
VALID_BOX = (2.0, 2.0, 3.5)
encodings = pytest.mark.parametrize("encoding", ["json", "msgpack"])

GOOD = [*chain(*good("CF01").values()), Stop("ana", "fire"), wire.Event(1.0, "a", "b", "c"), POSE]


@encodings
@for_each("message", GOOD)
def test_round_trip(encoding, message):
    payload = wire.encode(message, encoding)
    for mime in (wire.MIME[encoding], wire.MIME[encoding] + ";v=1"):
        assert wire.decode(payload, mime, type(message)) == message


@encodings
@FEW
@given(st.sampled_from(GOOD), st.binary(max_size=200), st.data())
def test_damaged_message_is_decoded_or_malformed(encoding, message, noise, data):
    payload = bytearray(wire.encode(message, encoding))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(payload[: data.draw(st.integers(0, len(payload)))])
    for kind in KINDS:
        with suppress(Malformed):
            assert isinstance(wire.decode(cut, wire.MIME[encoding], kind), kind)
        with pytest.raises(Malformed):
            wire.decode(noise, wire.MIME[encoding], kind)


LARGE = [b"[" * 50_000, b"\x91" * 50_000, b"x" * 1_000_000, wire.encode(Stop("w" * 9999, "\n\x1b[2J\u202e"))]


@FEW
@given(st.binary(max_size=200), st.sampled_from([JSON, MSGPACK, "zenoh/bytes", ""]))
def test_any_payload_is_a_stop_with_printable_text(payload, mime):
    for each in (payload, *LARGE):
        stop = wire.read_stop(each, mime)
        assert stop.operator
        assert stop.words.isprintable()
        assert 0 < len(stop.words) < 3 * wire.MAX_WORDS


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


@pytest.mark.parametrize("mime", ["zenoh/bytes", "application/x-www-form-urlencoded", "text/plain", ""])
def test_unmarked_payload_is_read_as_json(mime):
    assert wire.decode(b'{"order": "land"}', mime, Order) == Order("land")
    with pytest.raises(Malformed, match="not a Order"):
        wire.decode(b"land", mime, Order)


@for_each(
    "payload, mime",
    [
        (b"", JSON),
        (b"[" * 60_000, JSON),
        (b'{"robot":' * 6_000, JSON),
        (b"\x91" * 60_000, MSGPACK),
        (b"\xdf\xff\xff\xff\xff", MSGPACK),  # a table of four thousand million entries, it says
        (b"\xdb\xff\xff\xff\xff", MSGPACK),
        (b'{"robot":"KH01","seq":' + b"9" * 5_000 + b"}", JSON),
        (b'{"robot":"KH01","seq":1e999}', JSON),
        (b'{"robot":"\xff\xfe"}', JSON),
        (wire.encode(POSE).replace(b"1000.0", b"1" + b"0" * 400), JSON),
        (wire.encode(POSE).replace(b"1000.0", b"NaN"), JSON),
        (wire.encode(POSE).replace(b'"KH01"', b'"\\ud800"'), JSON),
        (wire.encode(POSE).replace(b"0.1,-0.2,0.0", b"0.1,-0.2"), JSON),
        (wire.encode(POSE).replace(b'"seq":3', b'"seq":true'), JSON),
        (wire.encode(POSE).replace(b'"seq":3', b'"seq":3,"more":1'), JSON),
        (wire.encode(POSE) + b"{}", JSON),
        (wire.encode(POSE, "msgpack") + b"\x00", MSGPACK),
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
