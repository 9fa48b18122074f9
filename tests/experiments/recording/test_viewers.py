"""Other readers of ROS 2 recordings take our bytes: payloads inside of messages, and what viewers draw."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from agents.network.messages import Malformed, Pose, State
from experiments.recording.ros2 import payload, viewers
from experiments.recording.topics import TOPICS

TEXT = st.text(st.characters(codec="utf-8", exclude_characters="\0")).map(str.encode)


@pytest.mark.parametrize("encoding", ["json", "msgpack"])
@pytest.mark.parametrize("kind", [topic.message for topic in TOPICS])
def test_both_libraries_read_a_payload(kind, encoding):
    name, definition = payload.type_name(kind, encoding), payload.schema(kind, encoding)
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition, name))
    decoder = DecoderFactory().decoder_for("cdr", Schema(1, definition.encode(), "ros2msg", name))

    @given(TEXT)
    def survives(content):
        data = payload.wrap(content, encoding)
        theirs = store.deserialize_cdr(data, name)
        for found in (theirs.data, decoder(data).data):
            assert (found.encode() if encoding == "json" else bytes(found)) == content
        assert bytes(store.serialize_cdr(theirs, name)) == data
        assert payload.unwrap(data, encoding) == content

    survives()


def test_schema_holds_the_payloads_json_schema():
    text = payload.schema(Pose, "json")
    assert '"robot":{"type":"string"}' in text
    assert text.endswith("}\nstring data\n")
    assert payload.type_name(Pose, "msgpack") == "zenpark_msgs/msg/PosePacked"


@pytest.mark.parametrize("data", [b"", b"\0\1\0\0", bytes(12), payload.wrap(b"{}", "json")[:-1]])
def test_a_message_cut_short_is_refused(data):
    with pytest.raises(Malformed, match="cut short"):
        payload.unwrap(data, "json")


HUMBLE = get_typestore(Stores.ROS2_HUMBLE)


def drawn_messages(stamp, position=(0.0, 0.0, 0.0), yaw=0.0, attitude=None):
    return viewers.pose(State("CF01", 1, stamp, "running", position, yaw=yaw, attitude=attitude))


@pytest.mark.slow
@given(st.floats(0, 2**31 - 1), st.tuples(*[st.floats(allow_nan=False)] * 3), st.floats(-10, 10))
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
    with pytest.raises(viewers.Unencodable, match="PoseStamped"):
        drawn_messages(stamp)
