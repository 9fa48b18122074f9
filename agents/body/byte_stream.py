"""Checked reading of bytes that came from a network."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, Final

WORD: Final = struct.Struct("<I")
Packet = tuple[int, bytes]  # last value of the head, and body


class MalformedStream(ValueError):
    """Bytes that are not in the format of the system that is said to send them."""


class Cursor:
    """Reads a packet from its begin; raises MalformedStream, never another error, where it is cut off or wrong."""

    def __init__(self, data: bytes, at: int = 0) -> None:
        self.data, self.at = data, at

    @property
    def left(self) -> int:
        """Number of bytes that are not read yet."""
        return len(self.data) - self.at

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        """The next values."""
        return layout.unpack(self.bytes(layout.size))

    def count(self) -> int:
        """The next number of four bytes."""
        (number,) = self.take(WORD)
        return int(number)

    def bytes(self, length: int) -> bytes:
        """The next `length` bytes."""
        begin, end = self.at, self.at + length
        if length < 0 or end > len(self.data):
            raise MalformedStream(f"{length} bytes where {len(self.data) - begin} are left: cut off")
        self.at = end
        return self.data[begin:end]

    def text(self) -> str:
        """The next text, which ends with a zero byte."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise MalformedStream("a text without an end")
        text = self.data[self.at : end].decode(errors="replace")
        self.at = end + 1
        return text


class Framer:
    """Cuts a stream of bytes into packets of a head and a body."""

    def __init__(self, head: struct.Struct, length: Callable[..., int]) -> None:
        """Take the layout of a head, and the length of its body by its values, which may raise MalformedStream."""
        self._head, self._length = head, length
        self._unread = bytearray()

    def feed(self, received: bytes) -> list[Packet]:
        """Last value of the head, and body, of the packets that are complete now, oldest first."""
        unread = self._unread
        unread += received
        found, at = list[Packet](), 0
        while len(unread) - at >= self._head.size:
            values = self._head.unpack_from(unread, at)
            begin = at + self._head.size
            end = begin + self._length(*values)
            if end > len(unread):
                break
            found.append((values[-1], bytes(unread[begin:end])))
            at = end
        del unread[:at]
        return found
