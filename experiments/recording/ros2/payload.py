"""Payloads of the network inside of ROS 2 messages of one field, `data`: text of JSON, or bytes of MessagePack.

`ros2 bag` refuses a file in which not all messages are CDR, and rosbags one with schemas in another language. In this
form both open a recording, and the payload is still the one that went over the network.
"""

from __future__ import annotations

import struct
from functools import cache
from typing import Final

import msgspec

from agents.network.messages import Encoding, Malformed, Message

LITTLE_ENDIAN: Final = b"\0\1\0\0"  # the encapsulation header of plain CDR; alignment counts from behind it
NAMES: Final[dict[Encoding, str]] = {"json": "zenpark_msgs/msg/{}", "msgpack": "zenpark_msgs/msg/{}Packed"}
FIELDS: Final[dict[Encoding, str]] = {"json": "string data\n", "msgpack": "uint8[] data\n"}
ENDS: Final[dict[Encoding, bytes]] = {"json": b"\0", "msgpack": b""}  # a string of ROS ends with a zero
_HEAD: Final = struct.Struct("<4sI")  # encapsulation, length of the string or of the array


def type_name(kind: type[Message], encoding: Encoding) -> str:
    """Type of the ROS 2 message around the payload of a kind of message."""
    return NAMES[encoding].format(kind.__name__)


@cache
def schema(kind: type[Message], encoding: Encoding) -> str:
    """Definition of that type as ros2msg text, with the JSON Schema of the payload as a comment."""
    described = msgspec.json.encode(msgspec.json.schema(kind)).decode()
    return f"# JSON Schema of the payload:\n# {described}\n{FIELDS[encoding]}"


def wrap(payload: bytes, encoding: Encoding) -> bytes:
    """The ROS 2 message around a payload, in CDR."""
    end = ENDS[encoding]
    return _HEAD.pack(LITTLE_ENDIAN, len(payload) + len(end)) + payload + end


def unwrap(data: bytes, encoding: Encoding) -> bytes:
    """The payload in a ROS 2 message; raises Malformed if it is none."""
    size = len(data) - _HEAD.size
    if size < 0 or _HEAD.unpack_from(data) != (LITTLE_ENDIAN, size):
        raise Malformed("cut short, or not little-endian CDR")
    return data[_HEAD.size : len(data) - len(ENDS[encoding])]
