"""Two other implementations of CDR read our bytes, and one of them writes the same bytes."""

import math
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


class Inner(msgspec.Struct):
    flag: bool
    label: str
    place: tuple[float, float]


class Everything(msgspec.Struct):
    first: bool
    second: bool
    count: int
    third: bool
    value: float
    name: str
    fourth: bool
    fifth: int
    inner: Inner
    flags: list[bool]
    counts: list[int]
    values: list[float]
    names: list[str]
    inners: list[Inner]
    table: dict[str, int]
    maybe: float | None
    perhaps: tuple[float, float, float] | None
    last: str


class Pair(msgspec.Struct):
    one: Inner
    two: list[Inner]


class Nest(msgspec.Struct):
    pair: Pair
    more: Inner


vector = st.tuples(*[st.floats(allow_nan=False)] * 3)
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


def plain(value):
    """A message of either library as lists and dictionaries, NaN as None."""
    if isinstance(value, np.ndarray | list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float | np.floating):
        return None if math.isnan(value) else float(value)
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, str):
        return value
    names = getattr(value, "__dataclass_fields__", None) or value.__slots__
    return {name: plain(getattr(value, name)) for name in names if not name.startswith("__")}


def expected(value, kind=None):
    """The same of one of ours: what is unknown is None, in each part of a vector."""
    if isinstance(value, msgspec.Struct):
        pairs = {}
        for field in msgspec.structs.fields(value):
            part = getattr(value, field.name)
            if isinstance(part, dict):
                pairs |= {f"{field.name}_keys": list(part), f"{field.name}_values": list(part.values())}
            else:
                pairs[field.name] = expected(part, field.type)
        return pairs
    if isinstance(value, list | tuple):
        return [expected(item) for item in value]
    vectors = [part for part in get_args(kind) if get_origin(part) is tuple]
    return [None] * len(get_args(vectors[0])) if value is None and vectors else value


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
        assert plain(theirs) == plain(decoder(data)) == expected(message)
        assert bytes(store.serialize_cdr(theirs, made.name)) == data
        assert made.decode(data) == message

    survives()


def test_schema_is_ros2msg_with_each_definition_once():
    assert codec(Nest).schema.count("MSG: zenpark_msgs/Inner\n") == 1
    assert codec(State).name == "zenpark_msgs/msg/State"
    text = codec(State).schema
    assert text.startswith("string robot\nint64 seq\nfloat64 stamp\n")
    assert "float64[4] setpoint\n" in text
    assert "zenpark_msgs/PoseReceipt[] received\n" in text
    assert f"{'=' * 80}\nMSG: zenpark_msgs/PoseReceipt\nstring sender\n" in text


def test_nan_stands_for_what_is_unknown():
    made = codec(State)
    message = State("a", 1, 2.0, "run", *[(0.0,) * 3] * 2, 0.0, (0.0,) * 3, (0.0,) * 4, 0.0, None, None)
    assert math.isnan(ros(made)[1](made.encode(message)).true_yaw)
    part = msgspec.structs.replace(message, true_position=(1.0, math.nan, 2.0), true_yaw=math.nan)
    back = made.decode(made.encode(part))
    assert back.true_position is not None
    assert back.true_position[0] == 1.0
    assert math.isnan(back.true_position[1])
    assert back.true_yaw is None


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
    ids=str,
)
def test_what_the_annotations_exclude_is_refused(wrong):
    with pytest.raises(Unencodable, match=type(wrong).__name__):
        codec(type(wrong)).encode(wrong)


@pytest.mark.slow
@given(values(State), st.data())
def test_a_message_cut_short_is_refused(message, data):
    made = codec(State)
    whole = made.encode(message)
    cut = data.draw(st.integers(0, len(whole) - 1))
    with pytest.raises(Undecodable):
        made.decode(whole[:cut])


@pytest.mark.parametrize("item", [bool, int, float, str, Inner])
def test_a_count_that_lies_is_refused(item):
    made = codec(struct_of(list[item]))
    data = bytearray(made.encode(made.decode(b"\0\1\0\0\0\0\0\0")))
    struct.pack_into("<I", data, 4, 0xFFFFFFF0)
    with pytest.raises(Undecodable):
        made.decode(bytes(data))


def test_big_endian_is_refused():
    with pytest.raises(Undecodable, match="little-endian"):
        codec(Event).decode(b"\0\0\0\0" + codec(Event).encode(Event(1.0, "k", "s", "t"))[4:])


def struct_of(annotation, name="field"):
    return msgspec.defstruct("Made", [(name, annotation)])


@pytest.mark.parametrize(
    "annotation",
    [bytes, tuple[int, int], list[tuple[float, float]], dict[str, float], bool | None, list[float | None], set[int]],
)
def test_types_that_ros_cannot_hold_are_named(annotation):
    with pytest.raises(TypeError, match=r"Made\.field: no ROS message"):
        codec(struct_of(annotation))


@pytest.mark.parametrize("name", ["Upper", "a__b", "end_", "_begin"])
def test_names_that_ros_does_not_allow_are_named(name):
    with pytest.raises(TypeError, match=rf"Made\.{name}"):
        codec(struct_of(int, name))


def test_an_empty_struct_is_no_message():
    with pytest.raises(TypeError, match="no fields"):
        codec(msgspec.defstruct("Nothing", []))


HUMBLE = get_typestore(Stores.ROS2_HUMBLE)


def drawn_messages(stamp, position=(0.0, 0.0, 0.0), yaw=0.0, attitude=None):
    return viewers.pose(State("CF01", 1, stamp, "running", position, yaw=yaw, attitude=attitude))


@pytest.mark.slow
@given(st.floats(0, 2**31 - 1), vector, st.floats(-10, 10))
def test_pose_stamped_is_what_rosbags_writes(stamp, position, yaw):
    data = drawn_messages(stamp, position, yaw)
    theirs = HUMBLE.deserialize_cdr(data, viewers.POSE)
    assert theirs.header.stamp.sec * 10**9 + theirs.header.stamp.nanosec == round(stamp * 1e9)
    assert theirs.header.frame_id == viewers.FRAME
    assert (theirs.pose.position.x, theirs.pose.position.y, theirs.pose.position.z) == position
    turn = theirs.pose.orientation
    assert (turn.x, turn.y) == (0.0, 0.0)
    assert math.remainder(2.0 * math.atan2(turn.z, turn.w) - yaw, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)
    assert bytes(HUMBLE.serialize_cdr(theirs, viewers.POSE)) == data


def test_an_attitude_stands_for_the_yaw():
    data = drawn_messages(1.0, yaw=3.0, attitude=(0.1, 0.2, 0.4, 0.8))
    turn = HUMBLE.deserialize_cdr(data, viewers.POSE).pose.orientation
    assert (turn.w, turn.x, turn.y, turn.z) == (0.1, 0.2, 0.4, 0.8)


def test_schema_of_pose_stamped_is_the_standard():
    own, store = get_types_from_msg(viewers.POSE_SCHEMA, viewers.POSE), get_typestore(Stores.EMPTY)
    store.register(own)
    for name in own:
        assert store.hash_rihs01(name) == HUMBLE.hash_rihs01(name)


@pytest.mark.parametrize("stamp", [math.nan, math.inf, 2.0**31, -(2.0**32)])
def test_a_stamp_that_ros_cannot_hold_is_refused(stamp):
    with pytest.raises(Unencodable, match="PoseStamped"):
        drawn_messages(stamp)
