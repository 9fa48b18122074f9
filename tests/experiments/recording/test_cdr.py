"""Two other implementations of CDR read our bytes, and one of them writes the same bytes."""

import math
import re
import struct
from functools import partial
from types import NoneType
from typing import get_args, get_origin

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from agents.network.messages import Event, Pose, State, Status
from experiments.recording.ros2 import viewers
from experiments.recording.ros2.cdr import Codec, Undecodable, Unencodable, codec
from experiments.recording.topics import SentPose

Inner = msgspec.defstruct("Inner", [("flag", bool), ("label", str), ("place", tuple[float, float])])
KINDS = [
    bool, bool, int, bool, float, str, bool, int, Inner, list[bool], list[int], list[float], list[str], list[Inner],
    dict[str, int], float | None, tuple[float, float, float] | None, str,
]  # fmt: skip
Everything = msgspec.defstruct("Everything", [(f"field{k}", kind) for k, kind in enumerate(KINDS)])
Pair = msgspec.defstruct("Pair", [("one", Inner), ("two", list[Inner])])
Nest = msgspec.defstruct("Nest", [("pair", Pair), ("more", Inner)])

PLAIN = {
    bool: st.booleans(),
    int: st.integers(-(2**63), 2**63 - 1),
    float: st.floats(allow_nan=False),
    str: st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9),
}


def values(kind):
    """Strategy of the values of an annotation."""
    given, parts = get_origin(kind), [values(part) for part in get_args(kind) if part is not NoneType]
    if kind in PLAIN:
        return PLAIN[kind]
    if given is None:
        return st.builds(kind, **{field.name: values(field.type) for field in msgspec.structs.fields(kind)})
    made = {list: partial(st.lists, max_size=5), dict: partial(st.dictionaries, max_size=4), tuple: st.tuples}
    return made[given](*parts) if given in made else st.none() | parts[0]


def ros(made: Codec):
    """The type in rosbags' own system, and mcap-ros2's decoder."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(made.schema, made.name))
    decoder = DecoderFactory().decoder_for("cdr", Schema(1, made.schema.encode(), "ros2msg", made.name))
    assert decoder is not None
    return store, decoder


def assert_same(theirs, given):
    """A message of another library has the values of one of ours; what is unknown is NaN."""
    if isinstance(given, msgspec.Struct):
        for name in given.__struct_fields__:
            part = getattr(given, name)
            if isinstance(part, dict):
                assert_same(getattr(theirs, f"{name}_keys"), list(part))
                assert_same(getattr(theirs, f"{name}_values"), list(part.values()))
            else:
                assert_same(getattr(theirs, name), part)
    elif isinstance(given, list | tuple):
        for other, item in zip(theirs, given, strict=True):
            assert_same(other, item)
    else:
        assert np.isnan(theirs).all() if given is None else theirs == given


@pytest.mark.parametrize(
    "kind", [pytest.param(Everything, marks=pytest.mark.slow), State, Status, Pose, SentPose, Event, Nest]
)
def test_both_libraries_read_what_was_meant(kind):
    made = codec(kind)
    store, decoder = ros(made)

    @given(values(kind))
    def survives(message):
        data = made.encode(message)
        theirs = store.deserialize_cdr(data, made.name)
        assert_same(theirs, message)
        assert_same(decoder(data), message)
        assert bytes(store.serialize_cdr(theirs, made.name)) == data
        assert made.decode(data) == message

    survives()


def test_schema_is_ros2msg_with_each_definition_once():
    name, text = codec(State).name, codec(State).schema
    assert (name, codec(Nest).schema.count("MSG: zenpark_msgs/Inner\n")) == ("zenpark_msgs/msg/State", 1)
    assert text.startswith("string robot\nint64 seq\nfloat64 stamp\n")
    for part in ("float64[4] setpoint\n", f"{'=' * 80}\nMSG: zenpark_msgs/PoseReceipt\nstring sender\n"):
        assert part in text


def test_nan_stands_for_what_is_unknown():
    message = State("a", 1, 2.0, "run", *[(0.0,) * 3] * 2, 0.0, (0.0,) * 3, (0.0,) * 4, 0.0, None, None)
    part = msgspec.structs.replace(message, true_position=(1.0, math.nan, 2.0), true_yaw=math.nan)
    back = codec(State).decode(codec(State).encode(part))
    assert (*back.true_position, back.true_yaw) == (1.0, pytest.approx(math.nan, nan_ok=True), 2.0, None)


@pytest.mark.parametrize(
    "wrong",
    [
        Event("now", "k", "s", "t"),
        Event(None, "k", "s", "t"),
        Event(10**400, "k", "s", "t"),
        Event(1.0, "k", "s", "\ud800"),
        Pose("a", 2**63, 1.0, (0.0,) * 3, (0.0,) * 3, 0.0),
        Pose("a", 1, 1.0, (0.0,) * 2, (0.0,) * 3, 0.0),
        Pose("a", 1, 1.0, None, (0.0,) * 3, 0.0),
    ],
)
def test_what_the_annotations_exclude_is_refused(wrong):
    with pytest.raises(Unencodable, match=type(wrong).__name__):
        codec(type(wrong)).encode(wrong)


@pytest.mark.slow
@given(values(State), st.data())
def test_a_message_cut_short_is_refused(message, data):
    whole = codec(State).encode(message)
    with pytest.raises(Undecodable):
        codec(State).decode(whole[: data.draw(st.integers(0, len(whole) - 1))])


@pytest.mark.parametrize("item", [bool, int, float, str, Inner])
def test_a_count_that_lies_is_refused(item):
    decode = codec(struct_of(list[item])).decode
    decode(b"\0\1" + bytes(6))
    for data, says in ((b"\0\1\0\0" + struct.pack("<I", 0xFFFFFFF0), None), (bytes(8), "little-endian")):
        with pytest.raises(Undecodable, match=says):
            decode(data)


def struct_of(annotation, name="field"):
    return msgspec.defstruct("Made", [(name, annotation)])


ODD = (bytes, tuple[int, int], list[tuple[float, float]], dict[str, float], bool | None, list[float | None], set[int])


@pytest.mark.parametrize(
    ("made", "says"),
    [(struct_of(kind), "Made.field: no ROS message") for kind in ODD]
    + [(struct_of(int, name), f"Made.{name}") for name in ("Upper", "a__b", "end_", "_begin")]
    + [(msgspec.defstruct("Nothing", []), "no fields")],
)
def test_what_ros_does_not_allow_is_named(made, says):
    with pytest.raises(TypeError, match=re.escape(says)):
        codec(made)


HUMBLE = get_typestore(Stores.ROS2_HUMBLE)


def drawn_messages(stamp, position=(0.0, 0.0, 0.0), yaw=0.0, attitude=None):
    return viewers.pose(State("CF01", 1, stamp, "running", position, yaw=yaw, attitude=attitude))


@pytest.mark.slow
@given(st.floats(0, 2**31 - 1), values(tuple[float, float, float]), st.floats(-10, 10))
def test_pose_stamped_is_what_rosbags_writes(stamp, position, yaw):
    data = drawn_messages(stamp, position, yaw)
    theirs = HUMBLE.deserialize_cdr(data, viewers.POSE)
    header, place, turn = theirs.header, theirs.pose.position, theirs.pose.orientation
    assert header.stamp.sec * 10**9 + header.stamp.nanosec == round(stamp * 1e9)
    assert (header.frame_id, place.x, place.y, place.z, turn.x, turn.y) == (viewers.FRAME, *position, 0.0, 0.0)
    assert math.remainder(2.0 * math.atan2(turn.z, turn.w) - yaw, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)
    assert bytes(HUMBLE.serialize_cdr(theirs, viewers.POSE)) == data


def test_schema_of_pose_stamped_is_the_standard():
    own, store = get_types_from_msg(viewers.POSE_SCHEMA, viewers.POSE), get_typestore(Stores.EMPTY)
    store.register(own)
    assert all(store.hash_rihs01(name) == HUMBLE.hash_rihs01(name) for name in own)
    data = drawn_messages(1.0, yaw=3.0, attitude=(0.1, 0.2, 0.4, 0.8))
    turn = HUMBLE.deserialize_cdr(data, viewers.POSE).pose.orientation
    assert (turn.w, turn.x, turn.y, turn.z) == (0.1, 0.2, 0.4, 0.8), "an attitude stands for the yaw"


@pytest.mark.parametrize("stamp", [math.nan, math.inf, 2.0**31, -(2.0**32)])
def test_a_stamp_that_ros_cannot_hold_is_refused(stamp):
    with pytest.raises(Unencodable, match="PoseStamped"):
        drawn_messages(stamp)
